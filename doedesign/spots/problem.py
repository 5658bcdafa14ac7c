"""A DOE that is to be designed for spots, of one colour or of several: from plane waves to levels, and on to light."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float, UInt8

from doedesign.spots.spots import Spots
from doedesign.spots.superposition import SpotLight, Staircase, WaveSet, judged, shared_level
from fab.grid import Grid
from sim.propagation.directions import DirectionSum


class _Designed:
    """A DOE to be designed for spots: how levels follow from plane waves, and light from levels."""

    spots: Spots

    def level(self, waves: WaveSet) -> UInt8[np.ndarray, "y x"]:
        """Level map of sums of plane waves."""
        raise NotImplementedError

    def amplitudes(self, level: UInt8[np.ndarray, "y x"]) -> Complex[np.ndarray, " m"]:
        """Amplitude of every spot, its square an efficiency."""
        raise NotImplementedError

    def light(self, level: UInt8[np.ndarray, "y x"]) -> SpotLight:
        """Sum and uniformity error of the spots' light."""
        return judged(self.amplitudes(level), self.spots)

    def step(self, waves: WaveSet) -> tuple[WaveSet, SpotLight]:
        """The next plane waves, and the light of these."""
        light = self.amplitudes(self.level(waves))
        return waves.improved(light, self.spots), judged(light, self.spots)


@dataclass(frozen=True, eq=False)
class SpotProblem(_Designed):
    """A DOE to be designed for spots.

    Attributes:
        spots: where light should go.
        staircase: its levels.
        coverage: `[y, x]` open share of every cell, times the irradiance of the beam that lights it.
        sums: the sum over its cells, for the spots' directions.
        grid: its cells.
    """

    spots: Spots
    staircase: Staircase
    coverage: Float[np.ndarray, "y x"]
    sums: DirectionSum
    grid: Grid

    @classmethod
    def on(cls, grid: Grid, coverage: Float[np.ndarray, "y x"], spots: Spots, staircase: Staircase) -> "SpotProblem":
        """The problem on the cells of a grid."""
        return cls(spots, staircase, coverage, DirectionSum(grid, spots.waves_per_m), grid)

    def coarser(self) -> "SpotProblem":
        """The same of an open unit cell, with cells twice as wide along every axis that has several."""
        ny, nx = (n // 2 if n > 1 else 1 for n in self.grid.shape)
        grid = Grid((ny, nx), 2 * self.grid.pitch_m)
        return SpotProblem.on(grid, np.ones(grid.shape, np.float32), self.spots, self.staircase)

    def level(self, waves: WaveSet) -> UInt8[np.ndarray, "y x"]:
        """Level map of a sum of plane waves."""
        return self.staircase.level(self.sums.superposition(waves.amplitudes))

    def amplitudes(self, level: UInt8[np.ndarray, "y x"]) -> Complex[np.ndarray, " m"]:
        """Amplitude of every spot, its square an efficiency."""
        field = self.coverage * self.staircase.light[level]
        return self.sums.amplitudes(field) / float(np.sum(self.coverage, dtype=np.float64))

    @property
    def cell_waves(self) -> Complex[np.ndarray, "cell m"]:
        """Share of a cell of unit light in the amplitude of every spot."""
        sums = self.sums
        waves = (sums.along_y[:, :, None] * sums.along_x[:, None, :]).reshape(self.spots.count, -1).T
        waves = waves.astype(np.complex128) / float(np.sum(self.coverage, dtype=np.float64))
        return waves * self.coverage.reshape(-1, 1)

    @property
    def level_light(self) -> Complex[np.ndarray, "level m"]:
        """Transmission of every level for the light of every spot."""
        return np.repeat(self.staircase.light.astype(np.complex128)[:, None], self.spots.count, axis=1)


@dataclass(frozen=True, eq=False)
class SharedProblem(_Designed):
    """A DOE to be designed for spots of several colours at once.

    Its light is the mean of that of all colours, its uniformity error that of the worst one.

    Attributes:
        parts: the same cells and levels in the light of every colour.
        spots: those of all colours.
    """

    parts: tuple[SpotProblem, ...]
    spots: Spots

    @classmethod
    def of(cls, parts: Sequence[SpotProblem]) -> "SharedProblem":
        """The problem of the parts of every colour."""
        return cls(tuple(parts), Spots.joined([one.spots for one in parts]))

    @property
    def grid(self) -> Grid:
        """The cells."""
        return self.parts[0].grid

    def coarser(self) -> "SharedProblem":
        """As `SpotProblem.coarser`."""
        return SharedProblem.of([one.coarser() for one in self.parts])

    def level(self, waves: WaveSet) -> UInt8[np.ndarray, "y x"]:
        """Level map of the sums of plane waves of all colours."""
        amplitudes = waves.amplitudes
        # A cell counts for a colour by its light of that colour.
        fields = [
            one.sums.superposition(amplitudes[own]) * (one.coverage / one.coverage.mean())
            for one, own in zip(self.parts, self.spots.of_colours, strict=True)
        ]
        return shared_level(fields, [one.staircase for one in self.parts])

    def amplitudes(self, level: UInt8[np.ndarray, "y x"]) -> Complex[np.ndarray, " m"]:
        """Amplitude of every spot; its square is an efficiency over the number of colours."""
        return np.concatenate([one.amplitudes(level) for one in self.parts]) / np.sqrt(len(self.parts))

    @property
    def cell_waves(self) -> Complex[np.ndarray, "cell m"]:
        """Share of a cell of unit light in the amplitude of every spot."""
        return np.concatenate([one.cell_waves for one in self.parts], axis=1) / np.sqrt(len(self.parts))

    @property
    def level_light(self) -> Complex[np.ndarray, "level m"]:
        """Transmission of every level for the light of every spot."""
        return np.concatenate([one.level_light for one in self.parts], axis=1)
