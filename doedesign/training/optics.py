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
from doedesign.design.parametrize import LevelParametrization
from sim.imaging.scene import Scene
from sim.optic import ON_AXIS, HeightOptic, RingOptic, colour_energies
from sim.psf_bank import BankOptic


class TrainingDoe(eqx.Module):
    """The DOE of a training: one that is learnt, or PSFs of one that stays as it is.

    Attributes:
        optic: the DOE; the heights of one that is learnt follow from its parameters.
        plans: propagation of every line of the optic.
        parametrization: parameters to heights; None for a DOE that stays as it is.
    """

    optic: HeightOptic | RingOptic | BankOptic
    plans: tuple[Any, ...]
    parametrization: LevelParametrization | None = eqx.field(static=True, default=None)

    @classmethod
    def at_rest(cls, optic: BankOptic) -> "TrainingDoe":
        """A DOE that stays as it is."""
        return cls(optic, tuple(optic.plan(line, np.inf) for line in optic.lines))

    def sources(self, depth_m: float, field_rad: tuple[float, float] = ON_AXIS) -> tuple[Any, ...]:
        """A point source, for every line.

        Raises:
            ValueError: a source off the axis of a DOE of rings.
        """
        return tuple(self.optic.source(line, depth_m, field_rad) for line in self.optic.lines)

    def psf(self, free: Array | None, softness: Array, sources: tuple[Any, ...]) -> Float[Array, "c y x"]:
        """PSF of every colour, energy per pixel.

        Args:
            free: the parameters; None for a DOE that stays as it is.
            softness: of the quantisation (`doedesign.design.parametrize.softness_at`).
            sources: see `sources`.
        """
        optic = self.optic if free is None else self.learnt.with_heights(self.learning.height_m(free, softness))
        return colour_energies(optic, self.plans, sources)

    @property
    def learning(self) -> LevelParametrization:
        """The parametrization of a DOE that is learnt."""
        assert self.parametrization is not None
        return self.parametrization

    @property
    def learnt(self) -> HeightOptic | RingOptic:
        """The optic of a DOE that is learnt."""
        return cast("HeightOptic | RingOptic", self.optic)


class TrainingScene(NamedTuple):
    """One scene as the training sees it.

    Attributes:
        scene: one obstruction before a background, colours those of the camera, depths in single precision.
        far: source in the background, (`TrainingDoe.sources`).
        near: source in the obstruction.
    """

    scene: Scene
    far: Any
    near: Any


class Capture(NamedTuple):
    """A developed capture and the PSFs behind it.

    Attributes:
        capture: `[c, y, x]` linear light with noise, white 1.
        far: `[c, y, x]` PSFs of the background.
        near: `[c, y, x]` PSFs of the obstruction.
    """

    capture: Float[Array, "c y x"]
    far: Float[Array, "c y x"]
    near: Float[Array, "c y x"]


def shot(
    seen: TrainingScene, doe: TrainingDoe, free: Array | None, softness: Array, bench: CaptureModel, key: Key[Array, ""]
) -> Capture:
    """Photograph a scene through a DOE.

    Args:
        seen: the scene.
        doe: the DOE.
        free: its parameters; None for one at rest.
        softness: of the quantisation (`doedesign.design.parametrize.softness_at`).
        bench: the rest of the camera.
        key: key of the noise.
    """
    far, near = (doe.psf(free, softness, sources) for sources in (seen.far, seen.near))
    return Capture(bench.developed(jax.tree.map(jnp.asarray, seen.scene), far, near, key), far, near)


def shots(
    seen: TrainingScene,
    doe: TrainingDoe,
    free: Array | None,
    softness: Array,
    bench: CaptureModel,
    keys: Key[Array, " b"],
) -> Capture:
    """Photograph a batch, one scene after the other: every array of `seen`, and `keys`, has a first axis for it."""
    if len(keys) == 1:
        one = shot(jax.tree.map(lambda leaf: leaf[0], seen), doe, free, softness, bench, keys[0])
        return jax.tree.map(lambda leaf: leaf[None], one)
    return jax.lax.map(lambda given: shot(given[0], doe, free, softness, bench, given[1]), (seen, keys))
