"""Light of the upright walls between cells, lines and dipoles, its derivatives, and its share in the cells around.

Real and imaginary parts are apart, for processors take several of a kind at a time.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Inexact
from numpy.polynomial.chebyshev import chebder, chebmul

from sim.rigorous.edge_widths import EdgeTable, series_at

Parts = tuple[Array, Array]
"""Real and imaginary part."""

Series = tuple[tuple[float, ...], tuple[float, ...]]
"""Coefficients of real and imaginary part; as numbers in a program they are twice as fast as in an array."""


class Walls(eqx.Module):
    """Walls across one axis.

    Attributes:
        width: series of their light over that of the lower cell (`sim.rigorous.width_tables.edge_table`), over the
            pitch.
        slope: series of the derivative of height / highest times that series, per metre of height.
        dipole: the four numbers of the dipoles of that table, over the pitch squared.
        foot: dipole of a wall per metre of its foot's height and step of the light, over i and the pitch squared.
        highest_m: height of the highest.
        weights: `[part, tap, border]` share of every cell in the light of a border, from the cell farthest before it to
            that farthest behind; no second part where they are real, and one border where they are alike.
        dipole_weights: the same of a dipole there; as many taps at most.
    """

    width: Series = eqx.field(static=True)
    slope: Series = eqx.field(static=True)
    dipole: Series = eqx.field(static=True)
    foot: float = eqx.field(static=True)
    highest_m: float = eqx.field(static=True)
    weights: Float[Array, "part tap border"]
    dipole_weights: Float[Array, "part few own"]

    @classmethod
    def of(
        cls,
        table: EdgeTable,
        highest_m: float,
        glass_waves: float,
        weights: tuple[Inexact[np.ndarray, "tap border"], Inexact[np.ndarray, "other border"]],
        pitch_m: float,
    ) -> "Walls":
        """Walls from a table of their light.

        Args:
            table: of walls up to the highest.
            highest_m: metres.
            glass_waves: of light in the glass, per metre.
            weights: of lines and of dipoles.
            pitch_m: of the cells.
        """
        width = table.width_m / pitch_m
        slope = chebder(chebmul(width, [0.5, 0.5])) * (2 / highest_m)
        foot = 1 / (4 * np.pi * glass_waves * pitch_m**2)
        numbers = _numbers(width), _numbers(slope), _numbers(table.dipole / pitch_m**2)
        return cls(*numbers, foot, highest_m, *(_in_parts(one) for one in weights))

    @property
    def reach(self) -> int:
        """Cells to either side of a border that take part in its light."""
        return max(reach_of(self.weights), reach_of(self.dipole_weights))


class Corners(eqx.Module):
    """Points of light where walls of both axes meet.

    Attributes:
        unit: of their light (`sim.rigorous.corner_light.corner_unit`), over the pitch squared.
        weights: `[part, tap, border]` share of the cells along x in the light of a point, as of `Walls`; along y it is
            that of a wall.
    """

    unit: Any
    weights: Float[Array, "part few own"]

    @classmethod
    def of(cls, unit: float, weights: Inexact[np.ndarray, "tap border"]) -> "Corners":
        """Points.

        Args:
            unit: of their light.
            weights: for every border along x.
        """
        return cls(unit, _in_parts(weights))


def reach_of(weights: Float[Array, "part tap own"]) -> int:
    """Cells to either side of a border that weights reach.

    Args:
        weights: of lines or dipoles (`Walls`).
    """
    return weights.shape[1] // 2


def _in_parts(weights: Inexact[np.ndarray, "tap border"]) -> Float[Array, "part tap own"]:
    if (weights == weights[:, :1]).all():
        weights = weights[:, :1]
    parts = (np.real(weights), np.imag(weights)) if np.iscomplexobj(weights) else (weights,)
    return jnp.asarray(np.stack(parts), jnp.float32)


def weights_within(weights: Float[Array, "part tap own"], start: Any, count: int) -> Float[Array, "part tap found"]:
    """Weights for the borders of cells that follow each other, and for as many beyond either end as they reach.

    Args:
        weights: of all borders along an axis, or one for all.
        start: the first cell.
        count: cells.
    """
    reach = reach_of(weights)
    if weights.shape[2] == 1:
        return weights
    wide = jnp.pad(weights, ((0, 0), (0, 0), (reach, reach)))
    return jax.lax.dynamic_slice_in_dim(wide, start, count + 2 * reach - 1, 2)


def _numbers(series: Complex[np.ndarray, " term"]) -> Series:
    return tuple(np.real(series).tolist()), tuple(np.imag(series).tolist())


class Sides(NamedTuple):
    """Heights and light of the cells before and behind every border."""

    before_m: Array
    behind_m: Array
    before: Parts  # light
    behind: Parts
    plane_m: Array

    @property
    def rise_m(self) -> Array:
        """Height of the wall, signed along the axis."""
        return self.behind_m - self.before_m

    @property
    def foot_m(self) -> Array:
        """Height of the lower side above the plane."""
        return jnp.minimum(self.before_m, self.behind_m) - self.plane_m

    @property
    def lower(self) -> Parts:
        """Light of the lower side."""
        return each(lambda before, behind: jnp.where(self.rise_m > 0, before, behind), self.before, self.behind)


def each(function: Callable[..., Array], *parts: Any) -> Parts:
    """A function of real parts, and the same of imaginary ones.

    Args:
        function: of arrays.
        parts: pairs of real and imaginary part.
    """
    real, imag = zip(*parts, strict=True)
    return function(*real), function(*imag)


def _product(one: Parts, other: Parts) -> Parts:
    return one[0] * other[0] - one[1] * other[1], one[0] * other[1] + one[1] * other[0]


def _dipole(walls: Walls, rise_m: Array, foot_m: Array) -> tuple[Parts, Parts]:
    """The dipole of a wall over the step of the light, and over the sum of the light of both sides."""
    numbers, height = tuple(zip(*walls.dipole, strict=True)), jnp.abs(rise_m)
    step = each(lambda a, b, c, d: height * ((c - a) / 2 + (d - b) / 2 * height), *numbers)
    both = each(lambda a, b, c, d: rise_m * ((a + c) / 2 + (b + d) / 2 * height), *numbers)
    return (step[0], step[1] + walls.foot * foot_m), both


def lines_of(sides: Sides, walls: Walls) -> Parts:
    """Lines of light of walls, over the pitch.

    Args:
        sides: of the walls.
        walls: what they add.
    """
    share = jnp.minimum(jnp.abs(sides.rise_m) * (1 / walls.highest_m), 1.0)
    width = each(lambda series: share * series_at(series, 2 * share - 1), walls.width)
    return _product(width, sides.lower)


def dipoles_of(sides: Sides, walls: Walls) -> Parts:
    """Dipoles of walls, over the pitch squared.

    Args:
        sides: of the walls.
        walls: what they add.
    """
    step, both = _dipole(walls, jnp.clip(sides.rise_m, -walls.highest_m, walls.highest_m), sides.foot_m)
    change = each(lambda before, behind: behind - before, sides.before, sides.behind)
    total = sum_of([sides.before, sides.behind])
    return sum_of([_product(step, change), _product(both, total)])


def slopes_of(sides: Sides, rate: Any, walls: Walls, of_lines: Parts, of_dipoles: Parts) -> tuple[Array, Array, Array]:
    """Derivatives by the heights before and behind every border, and that by the plane's less its sign.

    Args:
        sides: of the walls.
        rate: waves per metre of height.
        walls: what they add.
        of_lines: derivatives by the lines.
        of_dipoles: derivatives by the dipoles.
    """
    turn, rise, highest = 2 * np.pi * rate, sides.rise_m, walls.highest_m
    up, within = rise > 0, jnp.abs(rise) <= highest
    share = jnp.minimum(jnp.abs(rise) * (1 / highest), 1.0)
    seen = _product(of_lines, sides.lower)
    slope, width = (each(lambda series: series_at(series, 2 * share - 1), kind) for kind in (walls.slope, walls.width))
    of_rise = jnp.where(within, _product(slope, seen)[0], 0.0) * jnp.sign(rise)
    of_foot = -turn * share * (width[0] * seen[1] + width[1] * seen[0])
    step, both = _dipole(walls, jnp.clip(rise, -highest, highest), sides.foot_m)
    # The dipole is (both - step) before + (both + step) behind.
    before, behind = _product(of_dipoles, sides.before), _product(of_dipoles, sides.behind)
    change, total = each(lambda before, behind: behind - before, before, behind), sum_of([before, behind])
    grown_step, grown_both = _dipole_slope(walls, rise)
    grown = _product(grown_step, change)[0] + _product(grown_both, total)[0]
    of_rise = of_rise + jnp.where(within, grown, 0.0)
    raised = -walls.foot * change[1]
    of_foot = of_foot + raised
    turned = [
        -turn * ((both[0] + k * step[0]) * side[1] + (both[1] + k * step[1]) * side[0])
        for k, side in ((-1, before), (1, behind))
    ]
    of_before = turned[0] - of_rise + jnp.where(up, of_foot, 0.0)
    return of_before, turned[1] + of_rise + jnp.where(up, 0.0, of_foot), raised


def _dipole_slope(walls: Walls, rise_m: Array) -> tuple[Parts, Parts]:
    """Derivatives of both by the rise."""
    numbers, height, sign = tuple(zip(*walls.dipole, strict=True)), jnp.abs(rise_m), jnp.sign(rise_m)
    step = each(lambda a, b, c, d: sign * ((c - a) / 2 + (d - b) * height), *numbers)
    return step, each(lambda a, b, c, d: (a + c) / 2 + (b + d) * height, *numbers)


def to_cells(lines: Parts, weights: Float[Array, "part tap border"], axis: int) -> Parts:
    """Values of cells for light at their borders, and at as many beyond either end as the weights reach.

    Args:
        lines: light at the borders.
        weights: of these borders (`weights_within`).
        axis: along which the cells follow each other.
    """
    reach = reach_of(weights)
    count = lines[0].shape[axis] + 1 - 2 * reach

    def one(tap: int) -> Parts:
        # The first of the weights is for the cell `reach` places before the one behind a border.
        start = 2 * reach - 1 - tap
        seen = slice_of(lines[0], start, count, axis), slice_of(lines[1], start, count, axis)
        return _weighted(seen, weights[:, tap], start, axis)

    return sum_of([one(tap) for tap in range(2 * reach)])


def to_borders(cells: Parts, weights: Float[Array, "part tap border"], reach: int, axis: int) -> Parts:
    """The transpose: light at the borders of cells, and at one more at either end.

    Args:
        cells: values of the cells, and of `reach` more at either end.
        weights: of these borders (`weights_within`).
        reach: no less than that of the weights.
        axis: along which the cells follow each other.
    """
    own, count = reach_of(weights), cells[0].shape[axis] + 1 - 2 * reach

    def one(tap: int) -> Parts:
        start = reach - own + tap
        seen = slice_of(cells[0], start, count, axis), slice_of(cells[1], start, count, axis)
        return _weighted(seen, weights[:, tap], own - 1, axis)

    return sum_of([one(tap) for tap in range(2 * own)])


def _weighted(parts: Parts, weights: Float[Array, "part border"], first: int, axis: int) -> Parts:
    """Products of values and weights along an axis, from a first of the weights where they are not all alike."""
    if weights.shape[1] > 1:
        weights = slice_of(weights, first, parts[0].shape[axis], 1)
    along = [weight[:, None] if axis == 0 else weight for weight in weights]
    if len(along) == 1:
        return parts[0] * along[0], parts[1] * along[0]
    return parts[0] * along[0] - parts[1] * along[1], parts[0] * along[1] + parts[1] * along[0]


def sum_of(taps: list[Parts]) -> Parts:
    """Sum of complex numbers.

    Args:
        taps: what is added, one at least.
    """
    first, *others = taps
    for parts in others:
        first = first[0] + parts[0], first[1] + parts[1]
    return first


def slice_of(values: Array, start: int, count: int, axis: int) -> Array:
    """So many values along an axis from a first one.

    Args:
        values: of cells.
        start: the first that is kept.
        count: how many are.
        axis: 0 or 1.
    """
    return jax.lax.slice_in_dim(values, start, start + count, axis=axis)
