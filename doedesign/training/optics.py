"""The optics inside a training step: from a DOE's parameters to the developed capture, differentiable throughout.

`TrainingDoe.sources` describes a point source on the host, once per scene and in double precision; `TrainingDoe.psf`
turns it into PSFs within a compiled step.
"""

from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from doedesign.capture.camera import CaptureModel
from doedesign.design.levels.parametrize import LevelParametrization
from doedesign.design.levels.quantisation import Rounding
from sim.imaging.scene import Scene
from sim.optic import ON_AXIS, HeightOptic, RingOptic, colour_energies
from sim.psf_bank import BankOptic
from sim.rigorous.edge_optic import EdgeOptic


class TrainingDoe(eqx.Module):
    """The DOE of a training: one whose heights follow from parameters, or PSFs of one that stays as it is.

    Every line of the optic has a plan of propagation.
    """

    optic: HeightOptic | EdgeOptic | RingOptic | BankOptic
    plans: tuple[Any, ...]
    parametrization: LevelParametrization | None = eqx.field(static=True, default=None)

    @classmethod
    def at_rest(cls, optic: BankOptic) -> "TrainingDoe":
        """A DOE that stays as it is."""
        return cls(optic, tuple(optic.plan(line, np.inf) for line in optic.lines))

    def sources(self, depth_m: float, field_rad: tuple[float, float] = ON_AXIS) -> tuple[Any, ...]:
        """A point source, for every line; ValueError for one off the axis of a DOE of rings."""
        return tuple(self.optic.source(line, depth_m, field_rad) for line in self.optic.lines)

    def psf(self, free: Array | None, rounding: Rounding, sources: tuple[Any, ...]) -> Float[Array, "c y x"]:
        """PSF of every colour, energy per pixel.

        Args:
            free: the parameters; None for a DOE that stays as it is.
            rounding: of the quantisation (`doedesign.design.levels.quantisation.rounding_at`).
            sources: see `sources`.
        """
        optic = self.optic if free is None else self.learnt.with_heights(self.learning.height_m(free, rounding))
        return colour_energies(optic, self.plans, sources)

    @property
    def learning(self) -> LevelParametrization:
        """The parametrization of a DOE that is learnt."""
        assert self.parametrization is not None
        return self.parametrization

    @property
    def learnt(self) -> HeightOptic | EdgeOptic | RingOptic:
        """The optic of a DOE that is learnt."""
        return cast("HeightOptic | EdgeOptic | RingOptic", self.optic)


class TrainingScene(NamedTuple):
    """One obstruction before a background, in the camera's colours, with the `TrainingDoe.sources` in both."""

    scene: Scene
    far: Any
    near: Any


class Capture(NamedTuple):
    """Developed captures, linear light with noise and white 1, and the PSFs of background and obstruction behind it."""

    capture: Float[Array, "*b c y x"]
    far: Float[Array, "*b c ky kx"]
    near: Float[Array, "*b c ky kx"]


def shots(
    seen: TrainingScene,
    doe: TrainingDoe,
    free: Array | None,
    rounding: Rounding,
    bench: CaptureModel,
    keys: Key[Array, " b"],
) -> Capture:
    """Photograph a batch, one scene after the other: every array of `seen`, and `keys`, has a first axis for it.

    Through a DOE with these parameters and rounding (`TrainingDoe.psf`), with noise of these keys.
    """

    def shot(given: tuple[TrainingScene, Key[Array, ""]]) -> Capture:
        one, key = given
        far, near = (doe.psf(free, rounding, sources) for sources in (one.far, one.near))
        return Capture(bench.developed(jax.tree.map(jnp.asarray, one.scene), far, near, key), far, near)

    if len(keys) == 1:
        return jax.tree.map(lambda leaf: leaf[None], shot(jax.tree.map(lambda leaf: leaf[0], (seen, keys))))
    return jax.lax.map(shot, (seen, keys))
