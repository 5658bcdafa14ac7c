"""Sources at any depth between those of a spec, and at any field angle of its sensor.

A step that looks at the depths that are listed, on the axis, learns nothing about what lies between and beside. Here
every step draws its own: depths evenly in their inverse, by which a wave is curved, and field angles evenly over the
sensor. To oblique light a DOE is another optical path deep, and what is as near lies farther away beside the axis
(`sim.source`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from doedesign.design.objectives import disc_radii_m
from doedesign.design.problem import Problem, SeenSource, StepSources
from doedesign.spec import Spec
from sim.metrics import participation
from sim.optic import HeightOptic
from sim.psf_bank import psf

_NODES = 9  # depths at which the plain lens is looked at; its blur is interpolated between them
_SALT = 5  # of the random numbers, beside those of looks and of plates

Dioptres = tuple[float, float]


class SourcePlaces(NamedTuple):
    """Where the sources of a step lie: near and far depths, metres, and field angles (y, x), radians."""

    near_m: tuple[float, ...]
    far_m: tuple[float, ...]
    field_rad: tuple[float, float]


@dataclass(frozen=True, eq=False)
class SourceRange:
    """Where sources may lie.

    Attributes:
        near_per_m: smallest and largest inverse of a near depth, 1/m; None where listed depths are looked at.
        far_per_m: the same of far depths, 0 for infinity.
        half_tangents: tangents (y, x) of the field angles at the sensor's borders; 0 for sources on the axis.
        nodes_per_m: `[node]` increasing inverses of near depths at which the plain lens is known.
        lens: `[colour, node]` its participation there.
    """

    near_per_m: Dioptres | None
    far_per_m: Dioptres | None
    half_tangents: tuple[float, float]
    nodes_per_m: Float[np.ndarray, " node"]
    lens: Float[np.ndarray, "w node"]

    @classmethod
    def of(cls, spec: Spec, problem: Problem, *, between: bool, beside: bool) -> "SourceRange":
        """The ranges of a spec.

        Args:
            spec: the spec.
            problem: its problem.
            between: whether depths lie anywhere between the nearest and the farthest, and not at the listed ones alone.
            beside: whether sources lie anywhere on the sensor, and not on the axis alone.
        """
        near, far = (sorted(1 / depth for depth in depths_m) for depths_m in (spec.scene.near_m, spec.scene.far_m))
        nodes, lens = np.array(near), np.zeros((len(problem.camera.colours), 0), np.float32)
        if near:
            nodes = np.linspace(near[0], near[-1], _NODES) if between and near[0] < near[-1] else np.unique(near)
            bank = psf(HeightOptic.of(problem.camera), depths=tuple(1 / nodes))
            lens = np.asarray(participation(jnp.asarray(bank.energy)))
        ends = [(side[0], side[-1]) if between and side else None for side in (near, far)]
        return cls(ends[0], ends[1], spec.half_field if beside else (0.0, 0.0), nodes, lens)

    def places(self, depths_m: tuple[Sequence[float], Sequence[float]], seed: int, step: int) -> SourcePlaces:
        """Where the sources of a step lie.

        Args:
            depths_m: near and far depths that the step would look at among the listed ones.
            seed: of the random numbers.
            step: number of the step; with the seed, it decides what is drawn.
        """
        rng = np.random.default_rng((seed, _SALT, step))
        shares, (y, x) = rng.random(2), np.arctan((2 * rng.random(2) - 1) * self.half_tangents)
        near, far = (
            tuple(depths) if ends is None else (_depth_m(ends[0] + share * (ends[1] - ends[0])),)
            for depths, ends, share in zip(depths_m, (self.near_per_m, self.far_per_m), shares, strict=True)
        )
        return SourcePlaces(near, far, (float(y), float(x)))

    def look(self, problem: Problem, listed: StepSources, places: SourcePlaces) -> StepSources:
        """Sources at these places, in place of those that a step would look at among the listed ones."""
        near, far, angles = places.near_m, places.far_m, places.field_rad
        optic = problem.optic
        sources: Any = optic.source
        near_sources, far_sources = (
            tuple(tuple(SeenSource(sources(line, depth, angles)) for depth in depths) for line in optic.lines)
            for depths in (near, far)
        )
        # The blur of a lens grows with a power of the inverse depth.
        lens = np.zeros((len(self.lens), len(near)), np.float32)
        if len(near):
            at, nodes = np.log(1 / np.asarray(near)), np.log(self.nodes_per_m)
            lens = np.array([np.exp(np.interp(at, nodes, np.log(row))) for row in self.lens], np.float32)
        disc_radius_m = jnp.asarray(disc_radii_m(problem.camera, near))
        return listed._replace(near=near_sources, far=far_sources, lens=jnp.asarray(lens), disc_radius_m=disc_radius_m)


def _depth_m(per_m: float) -> float:
    return 1 / per_m if per_m else np.inf
