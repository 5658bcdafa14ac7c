"""Light of the upright walls between cells, added to that of the cells, with a gradient of its own.

Plain differentiation of the same formulas takes more than twice as long. Real and imaginary parts are apart, for
processors take several of a kind at a time.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Inexact
from numpy.polynomial.chebyshev import chebder, chebmul

from sim.propagation.pupil import cis
from sim.rigorous.edge_widths import series_at

Parts = tuple[Array, Array]
"""Real and imaginary part."""

Series = tuple[tuple[float, ...], tuple[float, ...]]
"""Coefficients of real and imaginary part; as numbers in a program they are twice as fast as in an array."""


class Walls(eqx.Module):
    """Walls across one axis.

    Attributes:
        width: series of their light over that of the lower cell (`sim.rigorous.width_tables.width_series`), over the
            pitch.
        slope: series of the derivative of height / highest times that series, per metre of height.
        highest_m: height of the highest.
        weights: `[part, tap, border]` share of every cell in the light of a border, from the cell farthest before it to
            that farthest behind; no second part where they are real, and one border where they are alike.
    """

    width: Series = eqx.field(static=True)
    slope: Series = eqx.field(static=True)
    highest_m: float = eqx.field(static=True)
    weights: Float[Array, "part tap border"]

    @classmethod
    def of(
        cls,
        series_m: Complex[np.ndarray, " term"],
        highest_m: float,
        weights: Inexact[np.ndarray, "tap border"],
        pitch_m: float,
    ) -> "Walls":
        """Walls from the series of their widths, metres."""
        width = series_m / pitch_m
        slope = chebder(chebmul(width, [0.5, 0.5])) * (2 / highest_m)
        if (weights == weights[:, :1]).all():
            weights = weights[:, :1]
        parts = (np.real(weights), np.imag(weights)) if np.iscomplexobj(weights) else (weights,)
        return cls(_numbers(width), _numbers(slope), highest_m, jnp.asarray(np.stack(parts), jnp.float32))

    @property
    def reach(self) -> int:
        """Cells to either side of a border that take part in its light."""
        return self.weights.shape[1] // 2

    def weights_at(self, tap: int, first: int, count: int) -> Float[Array, "part border"]:
        """Weights of one tap for consecutive borders, of which some may lie beyond the cells."""
        own = self.weights[:, tap]
        if own.shape[1] == 1:
            return own
        around = jnp.pad(own, ((0, 0), (self.reach, self.reach)))
        return around[:, first + self.reach :][:, :count]


def _numbers(series: Complex[np.ndarray, " term"]) -> Series:
    return tuple(np.real(series).tolist()), tuple(np.imag(series).tolist())


@jax.jit
def light_of_cells_and_walls(
    height_m: Float[Array, "y x"], rate: Any, across_y: Walls, across_x: Walls
) -> Complex[Array, "y x"]:
    """Transmission of cells whose far field is that of thin cells and the walls between them.

    Args:
        height_m: height of every cell.
        rate: waves per metre of height.
        across_y: walls between cells that are neighbours along y.
        across_x: the same along x.

    Returns:
        values of the cells; derivatives are taken with respect to the heights alone, and backwards.
    """
    return _light(height_m, rate, across_y, across_x)


@jax.custom_vjp
def _light(height_m: Array, rate: Any, across_y: Walls, across_x: Walls) -> Array:
    both = (across_y, across_x)

    def lines(*heights: Array) -> list[Parts]:
        return [
            _lines(height, rate, walls, axis) for axis, (height, walls) in enumerate(zip(heights, both, strict=True))
        ]

    thin = cis(height_m * rate)
    # Where the heights of the rim go on beyond it there are no walls.
    lit = _once(lines, *(_continued(height_m, walls.reach, axis) for axis, walls in enumerate(both)))
    (real_y, imag_y), (real_x, imag_x) = (
        _to_cells(parts, walls, axis) for axis, (parts, walls) in enumerate(zip(lit, both, strict=True))
    )
    return jax.lax.complex(thin.real + real_y + real_x, thin.imag + imag_y + imag_x)


def _forward(height_m: Array, rate: Any, across_y: Walls, across_x: Walls) -> tuple[Array, tuple[Any, ...]]:
    return _light(height_m, rate, across_y, across_x), (height_m, rate, across_y, across_x)


def _backward(kept: tuple[Any, ...], cotangent: Array) -> tuple[Array, None, None, None]:
    height, rate, *both = kept

    def borders(*padded: Parts) -> list[Parts]:
        return [_to_borders(parts, walls, axis) for axis, (parts, walls) in enumerate(zip(padded, both, strict=True))]

    def slopes(heights: list[Array], of_lines: list[Parts]) -> list[Parts]:
        return [
            _slopes(height, rate, walls, axis, lines)
            for axis, (height, walls, lines) in enumerate(zip(heights, both, of_lines, strict=True))
        ]

    given = (cotangent.real, cotangent.imag)
    padded = [tuple(jnp.pad(part, _ends(walls.reach, axis)) for part in given) for axis, walls in enumerate(both)]
    heights = [_continued(height, 1, axis) for axis in range(2)]
    found = _once(slopes, heights, _once(borders, *padded))
    thin = cis(height * rate)
    slope = -(2 * np.pi * rate) * (given[0] * thin.imag + given[1] * thin.real)
    for axis, (around, (of_wall, of_lower)) in enumerate(zip(heights, found, strict=True)):
        # A cell lies behind the first wall and before the second.
        first, second = _neighbours(of_wall, axis)
        slope = slope + first - second
        first, second = _neighbours(of_lower, axis)
        rises_to, rises_behind = _neighbours(jnp.less(*_neighbours(around, axis)), axis)
        slope = slope + jnp.where(rises_to, 0.0, first) + jnp.where(rises_behind, second, 0.0)
    return slope, None, None, None


_light.defvjp(_forward, _backward)


def _once(function: Callable[..., Any], *arrays: Any) -> Any:
    """The value of a function, computed once for all who use it.

    A compiler that fuses loops computes cheap values anew for every neighbour that reads them, ten times here; it
    does not look into a branch. Heights that are not numbers give none of this light, and their own is none either.
    """
    shapes = jax.eval_shape(function, *arrays)
    none = lambda *_: jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), shapes)  # noqa: E731
    first = jax.tree.leaves(arrays)[0]
    return jax.lax.cond(jnp.isfinite(first[0, 0]), function, none, *arrays)


def _ends(size: int, axis: int) -> tuple[tuple[int, int], ...]:
    """So many places more before and behind, along one axis."""
    return tuple((size, size) if axis == k else (0, 0) for k in range(2))


def _continued(height_m: Array, size: int, axis: int) -> Array:
    return jnp.pad(height_m, _ends(size, axis), "edge")


def _neighbours(values: Array, axis: int) -> Parts:
    """All values but the last, and all but the first: what lies before and behind every border."""
    last = values.shape[axis] - 1
    return _slice(values, 0, last, axis), _slice(values, 1, last, axis)


def _slice(values: Array, start: int, count: int, axis: int) -> Array:
    return jax.lax.slice_in_dim(values, start, start + count, axis=axis)


def _share(before: Array, behind: Array, walls: Walls) -> Array:
    """Height of walls over the highest."""
    return jnp.minimum(jnp.abs(behind - before) * (1 / walls.highest_m), 1.0)


def _lines(height_m: Array, rate: Any, walls: Walls, axis: int) -> Parts:
    """Light of walls over the pitch."""
    before, behind = _neighbours(height_m, axis)
    share = _share(before, behind, walls)
    real, imag = (share * series_at(series, 2 * share - 1) for series in walls.width)
    lower = cis(jnp.minimum(before, behind) * rate)
    return real * lower.real - imag * lower.imag, real * lower.imag + imag * lower.real


def _slopes(height_m: Array, rate: Any, walls: Walls, axis: int, cotangent: Parts) -> Parts:
    """Derivatives with respect to the height of walls, signed along the axis, and to that of their lower side."""
    before, behind = _neighbours(height_m, axis)
    share = _share(before, behind, walls)
    lower = cis(jnp.minimum(before, behind) * rate)
    seen_real = cotangent[0] * lower.real - cotangent[1] * lower.imag
    seen_imag = cotangent[0] * lower.imag + cotangent[1] * lower.real
    real, imag = (series_at(series, 2 * share - 1) for series in walls.slope)
    within = jnp.abs(behind - before) <= walls.highest_m
    of_wall = jnp.where(within, real * seen_real - imag * seen_imag, 0.0) * jnp.sign(behind - before)
    real, imag = (share * series_at(series, 2 * share - 1) for series in walls.width)
    return of_wall, -(2 * np.pi * rate) * (real * seen_imag + imag * seen_real)


def _to_cells(lines: Parts, walls: Walls, axis: int) -> Parts:
    """Values of cells for lines of light at their borders, and at as many beyond either end as the weights reach."""
    reach = walls.reach
    count = lines[0].shape[axis] + 1 - 2 * reach

    def one(tap: int) -> Parts:
        # The first of the weights is for the cell `reach` places before the one behind a border.
        start = 2 * reach - 1 - tap
        seen = _slice(lines[0], start, count, axis), _slice(lines[1], start, count, axis)
        return _weighted(seen, walls.weights_at(tap, start - reach, count), axis)

    return _sum([one(tap) for tap in range(2 * reach)])


def _to_borders(cells: Parts, walls: Walls, axis: int) -> Parts:
    """The transpose, from as many cells more at either end, with a border more at either end."""
    count = cells[0].shape[axis] + 1 - 2 * walls.reach

    def one(tap: int) -> Parts:
        seen = _slice(cells[0], tap, count, axis), _slice(cells[1], tap, count, axis)
        return _weighted(seen, walls.weights_at(tap, -1, count), axis)

    return _sum([one(tap) for tap in range(2 * walls.reach)])


def _weighted(parts: Parts, weights: Array, axis: int) -> Parts:
    """Products of values and weights along an axis."""
    along = [weight[:, None] if axis == 0 else weight for weight in weights]
    if len(along) == 1:
        return parts[0] * along[0], parts[1] * along[0]
    return parts[0] * along[0] - parts[1] * along[1], parts[0] * along[1] + parts[1] * along[0]


def _sum(taps: list[Parts]) -> Parts:
    first, *others = taps
    for parts in others:
        first = first[0] + parts[0], first[1] + parts[1]
    return first
