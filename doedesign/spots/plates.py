"""Spots of many plates as fabricated at once, and the exchange of cells that keeps them equal on all of these.

A plate counts once in every colour that has spots: orders of a unit cell are the same sums of cells for all colours,
and what differs is the phase of the levels. Spots of a colour are held against each other, not against other colours.

A process moves the walls of a unit cell and changes the depths of its etches. Both act on the amplitude of a spot by
sums that a change of one cell alters in a few places: a level has another phase on every plate, and beside a wall lies
a strip whose light is that of another set of masks. Strips are as wide as the masks' edges lie apart, wherever these
come to lie and whichever of them share a wall, so the sum over levels and strips holds for straight walls whatever the
errors are. `sim.surface` says what else a process does, and judges the result.

Left out: that a strip's light lies beside its wall, a part of a cell that counts little where orders are many cells
wide; that strips along x and along y overlap at corners, rounded corners, lag, roughness, rotation, magnification
and uniformity over the plate, particles. Side walls count as upright ones in the middle of their slope.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Complex, Float, Int, UInt8

from doedesign.spots.exchange import cooled, offers
from doedesign.spots.plate_sums import amplitudes_of, merit_of, sweep
from doedesign.spots.problem import SpotProblem
from fab.draws import draw_at, varying
from fab.process import Process, Variation
from sim.surface.relief import effective_bias, relief_of

_ANY = 0.3  # share of offers of another level than a neighbour's


@dataclass(frozen=True, eq=False)
class SpotPlates:
    """Effect of the errors of some plates on the spots of a unit cell.

    Of several colours, `plate` counts all plates in the light of the first, then all in that of the second, and so on.

    Attributes:
        light: `[level, plate]` transmission of a level.
        across_y: `[level, level, plate]` light that a wall adds, over that of a cell as wide as it is long, between a
            level and the one that follows it along y.
        across_x: the same along x.
        cells: `[y, spot]` and `[x, spot]` factors whose product is the light of a cell in a spot.
        borders: `[y + 1, spot]` and `[x + 1, spot]` factors of the borders before and behind the cells.
        shares: `[spot]` light of every spot over that of all, as it should be.
        colours: how many colours have these spots.
    """

    light: Complex[np.ndarray, "level plate"]
    across_y: Complex[np.ndarray, "level level plate"]
    across_x: Complex[np.ndarray, "level level plate"]
    cells: tuple[Complex[np.ndarray, "y m"], Complex[np.ndarray, "x m"]]
    borders: tuple[Complex[np.ndarray, "y_1 m"], Complex[np.ndarray, "x_1 m"]]
    shares: Float[np.ndarray, " m"]
    colours: int = 1

    @classmethod
    def of(
        cls,
        problem: SpotProblem,
        process: Process,
        waves_per_metre: Sequence[float],
        variations: Sequence[Variation],
    ) -> "SpotPlates":
        """Plates with these errors of an open unit cell.

        Args:
            problem: spots of the unit cell, orders that are the same for all colours.
            process: the process that makes it.
            waves_per_metre: phase of a metre of glass in every colour, waves.
            variations: errors of every plate.
        """
        levels, grid, sums = process.levels, problem.grid, problem.sums
        codes = levels.count - 1 - np.arange(levels.count)
        reliefs = [relief_of(process, one) for one in variations]
        depths_m = np.array([np.asarray(one.depth_m, np.float64) for one in reliefs])
        moved = np.array([np.asarray(one.shift_m, np.float64) for one in reliefs]) / grid.pitch_m  # [plate, mask, 2]
        grown = np.array([np.asarray(effective_bias(one), np.float64) for one in reliefs]) / grid.pitch_m
        etched = np.arange(1 << levels.bits)[:, None] >> np.arange(levels.bits) & 1
        by_colour = [np.exp(-2j * np.pi * waves * etched @ depths_m.T) for waves in waves_per_metre]
        across_y, across_x = (
            np.concatenate([wall_light(one, codes, moved[:, :, axis], grown) for one in by_colour], axis=2)
            for axis in (0, 1)
        )
        upper, left = (
            np.exp(-2j * np.pi * np.outer((np.arange(count + 1) - count / 2) * grid.pitch_m, waves))
            for count, waves in zip(grid.shape, sums.waves_per_m.T, strict=True)
        )
        area = float(np.prod(grid.shape))
        rows, columns = (np.ascontiguousarray(one.T, np.complex128) for one in (sums.along_y, sums.along_x))
        light, factors = np.concatenate(by_colour, axis=1)[codes], ((rows / area, columns), (upper / area, left))
        return cls(light, across_y, across_x, *factors, problem.spots.shares, len(by_colour))

    @property
    def tables(self) -> tuple[Any, ...]:
        """Everything that the light of a level map is summed from."""
        return (self.light, self.across_y, self.across_x, *self.cells, *self.borders)

    def amplitudes(self, level: UInt8[np.ndarray, "y x"]) -> Complex[np.ndarray, "m plate"]:
        """Amplitude of every spot of every plate, its square an efficiency."""
        return amplitudes_of(level, *self.tables)

    def merit(self, level: UInt8[np.ndarray, "y x"], uniformity: float) -> float:
        """Mean efficiency of the plates, in all colours, less `uniformity` times how unequal spots are (`merit_of`)."""
        return float(merit_of(self.amplitudes(level), self.shares, uniformity))

    def uniformity_errors(self, level: UInt8[np.ndarray, "y x"]) -> Float[np.ndarray, " plate"]:
        """(max - min) / (max + min) of the spots of every plate over their shares; of several colours the worst."""
        over = np.abs(self.amplitudes(level)) ** 2 / self.shares[:, None]
        return (np.ptp(over, axis=0) / (over.max(axis=0) + over.min(axis=0))).reshape(self.colours, -1).max(axis=0)

    def exchanged(
        self, level: UInt8[np.ndarray, "y x"], *, sweeps: int, seed: int, uniformity: float, heat: float
    ) -> UInt8[np.ndarray, "y x"]:
        """Change cells of a level map one by one for spots that stay bright and equal on all plates, by `merit`.

        It is simulated annealing as in `doedesign.spots.exchange.exchange`, which says how: the best map that was met
        is returned, which is never worse than the one given.
        """
        rng = np.random.default_rng((seed, 0x50B5))
        own, best = level.copy(), level.copy()
        for number in range(sweeps):
            offer = offers(rng, own.size, len(self.light), _ANY)
            sweep(own, best, self.tables, self.shares, offer, cooled(heat, number, sweeps), uniformity)
        return best


def plates_of(process: Process, count: int, seed: int) -> list[Variation]:
    """Errors of an even number of plates, drawn in pairs with errors of opposite sign."""
    rng = np.random.default_rng((seed, 0xFAB))
    half = rng.standard_normal((count // 2, len(varying(process))))
    return [draw_at(process, sign * scores) for scores in half for sign in (1, -1)]


def wall_light(
    by_code: Complex[np.ndarray, "code plate"],
    codes: Int[np.ndarray, " level"],
    moved: Float[np.ndarray, "plate mask"],
    grown: Float[np.ndarray, "plate mask"],
) -> Complex[np.ndarray, "level level plate"]:
    """Light that a straight wall adds between one level and the next, over that of a cell as wide as it is long.

    Every mask that differs across the wall has an edge there, moved with its mask, and outward from its opening as far
    as that has grown. Between the edges lie strips of other sets of masks.

    Args:
        by_code: transmission where some masks are open; bit k of the code stands for mask k.
        codes: masks that are open where a level is.
        moved: displacement of every mask across the wall, in cells.
        grown: growth of the masks' openings per edge, in cells.
    """
    found = np.zeros((len(codes), len(codes), len(moved)), complex)
    every, bits = np.arange(len(moved)), np.arange(moved.shape[1])
    for before, behind in np.ndindex(found.shape[:2]):
        masks = bits[(codes[before] ^ codes[behind]) >> bits & 1 == 1]
        if not len(masks):
            continue
        outward = np.where(codes[before] >> masks & 1, 1.0, -1.0)
        places = moved[:, masks] + grown[:, masks] * outward
        order = np.argsort(places, axis=1)
        places = np.take_along_axis(places, order, 1)
        # What is before the wall goes on up to the first edge, and what is behind it begins at the last one.
        own, next_ = by_code[codes[before]], by_code[codes[behind]]
        light = (np.maximum(places[:, 0], 0) + np.minimum(places[:, -1], 0)) * (own - next_)
        code = np.full(len(moved), codes[before])
        for edge in range(len(masks) - 1):
            code = code ^ 1 << masks[order[:, edge]]
            low, high = places[:, edge], places[:, edge + 1]
            here = by_code[code, every]
            light = light + (np.minimum(high, 0) - np.minimum(low, 0)) * (here - own)
            light = light + (np.maximum(high, 0) - np.maximum(low, 0)) * (here - next_)
        found[before, behind] = light
    return found
