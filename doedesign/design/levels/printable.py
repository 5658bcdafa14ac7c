"""Level maps whose masks obey the rules of lithography at every step of an optimisation.

Phases are optimised as ever, but what a step looks at, and what it takes its gradient of, is a level map that breaks no
rule. It follows the phases by moves of small rectangles, each of which brings it nearer to them and breaks no rule
(`fab.rules.repair.follow`); the phases are pulled back toward it, so that where a rule stands in the way they do not
stray. A map that is repaired when all is done loses what this one finds.

The cells may be coarser than those of the grid (`optimize.drawn_pixel`): rules are then those of the coarse cells.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from doedesign.design.levels.parametrize import LevelParametrization
from fab.aperture import Aperture, MaskAperture
from fab.errors import InputError
from fab.grid import Grid, fewest_pixels
from fab.level_map import LevelMap
from fab.rules.check import Rules
from fab.rules.repair import WIDEST, follow, repair
from fab.units import format_length

# By how much of their distance the phases are pulled toward the map at every step. Measured on the quick example: 0.03
# and 0.3 end 0.01 higher in loss.
PULL = 0.1
_SHARE = 0.5  # of the steps, which look at such a map; the first ones look at any


@dataclass(frozen=True, eq=False)
class PrintableLevels:
    """Rules that level maps obey.

    Attributes:
        blank: a level map without etches, on the cells that are drawn.
        rules: narrowest line and space.
        waves_per_metre: waves of light per metre of height at the design wavelength.
        wall_weight: cost of walls (`fab.rules.repair.follow`).
    """

    blank: LevelMap
    rules: Rules
    waves_per_metre: float
    wall_weight: float = 0.0

    @classmethod
    def on(
        cls,
        grid: Grid,
        relief: Aperture,
        parametrization: LevelParametrization,
        min_feature_m: float,
        wall_weight: float = 0.0,
    ) -> "PrintableLevels":
        """Rules for the cells of a parametrisation.

        Args:
            grid: cells of the optics.
            relief: outline of the relief.
            parametrization: staircase, design wavelength, and size of the cells that are drawn.
            min_feature_m: narrowest line and space, metres; 0 forbids no more than corners that touch.
            wall_weight: cost of walls.

        Raises:
            InputError: a feature of more than 32 pixels.
        """
        levels, block = parametrization.levels, parametrization.block
        if block > 1:
            inside = relief.inside(grid)
            ny, nx = (count // block for count in grid.shape)
            whole = np.asarray(inside.reshape(ny, block, nx, block).all(axis=(1, 3)))
            grid = Grid((ny, nx), grid.pitch_m * block)
            relief = MaskAperture.of(whole, grid.pitch_m)
        if fewest_pixels(min_feature_m, grid.pitch_m) > WIDEST:
            rule, got = f"must not exceed {WIDEST} pixels that are drawn", format_length(min_feature_m)
            raise InputError("optimize.min_feature", rule, got, "Draw larger pixels (optimize.drawn_pixel).")
        blank = LevelMap(np.full(grid.shape, levels.count - 1, np.uint8), levels, grid, relief)
        waves = 1 / (2 * np.pi * parametrization.metres_per_radian)
        return cls(blank, Rules(min_feature_m, min_feature_m), waves, wall_weight)

    def first(self, level: UInt8[np.ndarray, "y x"]) -> UInt8[np.ndarray, "y x"]:
        """The nearest levels that break no rule."""
        return repair(self.blank.with_level(level), self.rules, self.waves_per_metre).level_map.level

    def nearer(self, level: UInt8[np.ndarray, "y x"], wanted: UInt8[np.ndarray, "y x"]) -> UInt8[np.ndarray, "y x"]:
        """Levels that break no rule, moved toward those that are wanted."""
        old = self.blank.with_level(level)
        return follow(old, wanted, self.rules, self.waves_per_metre, self.wall_weight).level


def first_printed(steps: int) -> int:
    """First of so many steps that looks at a map that can be printed."""
    return steps - int(np.ceil(_SHARE * steps))


def heights_m(level: UInt8[np.ndarray, "y x"], parametrization: LevelParametrization) -> Float[np.ndarray, "y x"]:
    """Heights of levels, metres."""
    return parametrization.levels.heights_m()[level].astype(np.float32)
