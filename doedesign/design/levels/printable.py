"""Level maps whose masks obey the rules of lithography at every step of an optimisation.

Phases are optimised as ever, but what a step looks at, and what it takes its gradient of, is a level map that breaks no
rule. It follows the phases by moves of small rectangles, each of which brings it nearer to them and breaks no rule
(`fab.rules.repair.follow`); the phases are pulled back toward it, so that where a rule stands in the way they do not
stray. A map that is repaired when all is done loses what this one finds.

The cells may be coarser than those of the grid (`optimize.drawn_pixel`): rules are then those of the coarse cells.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, UInt8

from doedesign.design.levels.parametrize import LevelParametrization, Parameters
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
        wall_costs: cost of the walls of every mask (`fab.rules.repair.follow`); empty where they cost nothing.
    """

    blank: LevelMap
    rules: Rules
    waves_per_metre: float
    wall_costs: tuple[float, ...] = ()

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
            wall_weight: cost of a wall as long as a pixel and as deep as the period of the staircase, in units of
                1 - cos of the phase error of a pixel.

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
        costs = tuple(wall_weight * depth_m / levels.period_m for depth_m in levels.depths_m) if wall_weight else ()
        return cls(blank, Rules(min_feature_m, min_feature_m), waves, costs)

    def with_costs(self, more: Sequence[float]) -> "PrintableLevels":
        """The same with further costs of the walls of every mask."""
        return replace(
            self, wall_costs=tuple(a + b for a, b in zip(self.wall_costs or [0.0] * len(more), more, strict=True))
        )

    def first(self, level: UInt8[np.ndarray, "y x"]) -> UInt8[np.ndarray, "y x"]:
        """The nearest levels that break no rule."""
        return repair(self.blank.with_level(level), self.rules, self.waves_per_metre).level_map.level

    def nearer(self, level: UInt8[np.ndarray, "y x"], wanted: UInt8[np.ndarray, "y x"]) -> UInt8[np.ndarray, "y x"]:
        """Levels that break no rule, moved toward those that are wanted."""
        old = self.blank.with_level(level)
        return follow(old, wanted, self.rules, self.waves_per_metre, self.wall_costs).level


def moved_phases(
    optimiser: optax.GradientTransformation,
    parametrization: LevelParametrization,
    state: tuple[Any, Any],
    slope: Float[Array, "y x"],
    height_m: Float[Array, "y x"],
) -> tuple[Parameters, Any]:
    """Phases and the optimiser's moments after a step that looked at a level map.

    Args:
        optimiser: moves the phases.
        parametrization: their staircase.
        state: `Parameters` and moments before.
        slope: derivative of the loss with respect to the heights, per metre.
        height_m: heights of the level map, toward which phases are pulled, the nearer way round.
    """
    parameters, moments = state
    gradient: Any = Parameters(slope * parametrization.metres_per_radian)
    updates, moments = optimiser.update(gradient, moments)
    moved: Any = optax.apply_updates(parameters, updates)
    wave = parametrization.levels.period_m / parametrization.metres_per_radian
    away = height_m / parametrization.metres_per_radian - moved.radians
    return Parameters(moved.radians + PULL * (jnp.mod(away + wave / 2, wave) - wave / 2)), moments


def first_printed(steps: int) -> int:
    """First of so many steps that looks at a map that can be printed."""
    return steps - int(np.ceil(_SHARE * steps))
