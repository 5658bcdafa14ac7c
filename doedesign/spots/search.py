"""Phases of the spots: a search over many random starts at once, on few points.

How much light a DOE can send into spots depends on the phases that they may have among each other, and on nothing else.
Where spots lie on a lattice of directions, one period of the DOE says all; elsewhere, a few thousand random points
stand for the cells. All starts take their steps together, as matrix products; on a lattice of many orders axis by axis,
because a matrix of all spots and points would have gigabytes. Of several colours every point takes a level that suits
all of them, since a height has another phase for each.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from doedesign.spots.spots import Spots
from doedesign.spots.superposition import Staircase, WaveSet, shared_level, spot_light

_STEPS = 100
_POINTS_PER_ORDER, _FEWEST, _SCATTERED = 8, 24, 4096
_BATCH = 2**24  # values of the starts that are looked at together
_DENSE = 2**20  # values of a matrix of all spots and points; 11 x 11 orders have fewer


class FoundPhases(NamedTuple):
    """Plane waves by merit, the best first, and the efficiency of the best with these points."""

    waves: list[WaveSet]
    efficiency: float


class _Waves(NamedTuple):
    """Plane waves of all spots at any points."""

    waves: Complex[np.ndarray, "m point"]

    @classmethod
    def of(cls, spots: Spots, points_m: Float[np.ndarray, "point 2"]) -> "_Waves":
        return cls(_unit_waves(spots.waves_per_m @ points_m.T))

    def superposition(self, amplitudes: Complex[np.ndarray, "start m"]) -> Complex[np.ndarray, "start point"]:
        return amplitudes @ self.waves

    def amplitudes(self, field: Complex[np.ndarray, "start point"]) -> Complex[np.ndarray, "start m"]:
        return field @ self.waves.conj().T


class _LatticeWaves(NamedTuple):
    """The same at the points of a grid, for spots that share few directions along either axis."""

    along_y: Complex[np.ndarray, "row y"]
    along_x: Complex[np.ndarray, "column x"]
    places: tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]  # row and column of every spot

    @classmethod
    def of(cls, spots: Spots, points_m: Float[np.ndarray, "point 2"]) -> "_LatticeWaves":
        assert spots.orders is not None
        assert spots.lattice_per_m is not None
        factors, places = [], []
        for orders, step, points in zip(spots.orders.T, spots.lattice_per_m, points_m.T, strict=True):
            own, place = np.unique(orders, return_inverse=True)
            factors.append(_unit_waves(np.outer(own * step, np.unique(points))))
            places.append(place)
        return cls(factors[0], factors[1], (places[0], places[1]))

    def superposition(self, amplitudes: Complex[np.ndarray, "start m"]) -> Complex[np.ndarray, "start point"]:
        lattice = np.zeros((len(amplitudes), len(self.along_y), len(self.along_x)), amplitudes.dtype)
        lattice[:, *self.places] = amplitudes
        return (self.along_y.T @ (lattice @ self.along_x)).reshape(len(amplitudes), -1)

    def amplitudes(self, field: Complex[np.ndarray, "start point"]) -> Complex[np.ndarray, "start m"]:
        rows = self.along_y.conj() @ field.reshape(len(field), self.along_y.shape[1], -1)
        return (rows @ self.along_x.conj().T)[:, *self.places]


def _unit_waves(turns: Float[np.ndarray, "wave point"]) -> Complex[np.ndarray, "wave point"]:
    # Line by line, for double precision takes several times the memory of what is kept.
    return np.stack([np.exp(2j * np.pi * (line - np.rint(line))).astype(np.complex64) for line in turns])


def search_points(spots: Spots, seed: int, extent_m: tuple[float, float]) -> Float[np.ndarray, "point 2"]:
    """Points (y, x), metres: a grid over one period of a lattice, or random ones over the extent of the DOE."""
    if spots.orders is None or spots.lattice_per_m is None:
        return (np.random.default_rng(seed).random((_SCATTERED, 2)) - 0.5) * np.asarray(extent_m)
    axes = []
    for orders, step in zip(spots.orders.T, spots.lattice_per_m, strict=True):
        count = max(_FEWEST, _POINTS_PER_ORDER * int(np.ptp(orders))) if np.ptp(orders) else 1
        axes.append((np.arange(count) + 0.5) / count / step)
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def search_phases(
    spots: Spots,
    points_m: Float[np.ndarray, "point 2"],
    *,
    starts: int,
    seed: int,
    uniformity: float,
    staircases: Sequence[Staircase] = (),
    keep: int = 4,
) -> FoundPhases:
    """Search the plane waves whose sum is nearest to a phase alone, where the phases of spots are free.

    Args:
        spots: where light should go.
        points_m: points (y, x) that stand for the cells, metres.
        starts: random starts.
        seed: of these.
        uniformity: weight of the uniformity error beside the efficiency.
        staircases: levels that the DOE may have, in the light of every colour; any phase if there are none, which one
            colour alone can have.
        keep: how many to return.
    """
    on_grid = spots.lattice_per_m is not None and spots.count * len(points_m) > _DENSE
    waves = [(_LatticeWaves if on_grid else _Waves).of(part, points_m) for part in spots.parts]
    rng, found = np.random.default_rng((seed, 0x57A7)), []
    batch = max(1, min(starts, _BATCH // len(points_m)))
    for first in range(0, starts, batch):
        count = min(batch, starts - first)
        sets = WaveSet(np.tile(np.sqrt(spots.shares), (count, 1)), rng.uniform(0, 2 * np.pi, (count, spots.count)))
        light = _light(sets, waves, staircases)
        for _ in range(_STEPS):
            sets = sets.improved(light, spots)
            light = _light(sets, waves, staircases)
        for weights, phases, one in zip(*sets, light, strict=True):
            result = spot_light(np.abs(one) ** 2, spots.shares, spots.colours)
            found.append((result.merit(uniformity), result.efficiency, WaveSet(weights, phases)))
    found.sort(key=lambda each: -each[0])
    return FoundPhases([each[2] for each in found[:keep]], found[0][1])


def _light(
    sets: WaveSet, waves: Sequence[_Waves | _LatticeWaves], staircases: Sequence[Staircase]
) -> Complex[np.ndarray, "start m"]:
    amplitudes = np.split(sets.amplitudes.astype(np.complex64), len(waves), axis=1)
    fields = [one.superposition(own) for one, own in zip(waves, amplitudes, strict=True)]
    if staircases:
        level = shared_level(fields, staircases)
        fields = [one.light[level] for one in staircases]
    else:
        fields[0] /= np.maximum(np.abs(fields[0]), 1e-12)
    light = [one.amplitudes(field).astype(np.complex128) for one, field in zip(waves, fields, strict=True)]
    return np.concatenate(light, axis=1) / (fields[0].shape[1] * np.sqrt(len(waves)))
