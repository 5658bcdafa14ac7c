"""Light of the upright walls between cells, lines and dipoles, added to that of the cells, with a gradient of its own.

Plain differentiation of the same formulas takes more than twice as long. Real and imaginary parts are apart, for
processors take several of a kind at a time.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Inexact
from numpy.polynomial.chebyshev import chebder, chebmul

from sim.propagation.pupil import cis
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
        return max(_reach(self.weights), _reach(self.dipole_weights))


def _reach(weights: Float[Array, "part tap own"]) -> int:
    return weights.shape[1] // 2


def _in_parts(weights: Inexact[np.ndarray, "tap border"]) -> Float[Array, "part tap own"]:
    if (weights == weights[:, :1]).all():
        weights = weights[:, :1]
    parts = (np.real(weights), np.imag(weights)) if np.iscomplexobj(weights) else (weights,)
    return jnp.asarray(np.stack(parts), jnp.float32)


def _weights_at(
    weights: Float[Array, "part tap border"], tap: int, first: int, count: int
) -> Float[Array, "part found"]:
    """Weights of one tap for consecutive borders, of which some may lie beyond the cells."""
    own, reach = weights[:, tap], weights.shape[1]
    if own.shape[1] == 1:
        return own
    return jnp.pad(own, ((0, 0), (reach, reach)))[:, first + reach :][:, :count]


def _numbers(series: Complex[np.ndarray, " term"]) -> Series:
    return tuple(np.real(series).tolist()), tuple(np.imag(series).tolist())


@jax.jit
def light_of_cells_and_walls(
    height_m: Float[Array, "y x"], rate: Any, across_y: Walls, across_x: Walls
) -> Complex[Array, "y x"]:
    """Transmission of cells whose far field is that of thin cells and the walls between them.

    Light is told at the mean height.

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
    return _forward(height_m, rate, across_y, across_x)[0]


def _forward(height_m: Array, rate: Any, across_y: Walls, across_x: Walls) -> tuple[Array, tuple[Any, ...]]:
    both = (across_y, across_x)
    reach = max(walls.reach for walls in both)

    def lines(around: _Cells) -> list[Parts]:
        return [_lines(around.sides(axis, _reach(walls.weights)), walls) for axis, walls in enumerate(both)]

    around = _Cells.of(height_m, rate, reach)
    cells = [around.inner()]
    for axis, (lit, walls) in enumerate(zip(_once(lines, around), both, strict=True)):
        # Cheaper to compute for every cell that has a part of it than to write down.
        dipoles = _dipoles(around.sides(axis, _reach(walls.dipole_weights)), walls)
        cells += [_to_cells(lit, walls.weights, axis), _to_cells(dipoles, walls.dipole_weights, axis)]
    return jax.lax.complex(*_sum(cells)), (around, rate, across_y, across_x)


def _backward(kept: tuple[Any, ...], cotangent: Array) -> tuple[Array, None, None, None]:
    around, rate, *both = kept
    given = cotangent.real, cotangent.imag

    def borders(*padded: Parts) -> list[list[Parts]]:
        return [
            [_to_borders(parts, w, walls.reach, axis) for w in (walls.weights, walls.dipole_weights)]
            for axis, (parts, walls) in enumerate(zip(padded, both, strict=True))
        ]

    def slopes(around: _Cells, seen: list[list[Parts]]) -> list[tuple[Array, Array, Array]]:
        return [_slopes(around.sides(axis, 1), rate, both[axis], *seen[axis]) for axis in range(2)]

    padded = [tuple(jnp.pad(part, _ends(walls.reach, axis)) for part in given) for axis, walls in enumerate(both)]
    found = _once(slopes, around, _once(borders, *padded))
    thin = around.inner()
    slope = -(2 * np.pi * rate) * (given[0] * thin[1] + given[1] * thin[0])
    for axis, (of_before, of_behind, of_plane) in enumerate(found):
        # A cell lies behind the first border and before the second.
        count = slope.shape[axis]
        place = jax.lax.broadcasted_iota(jnp.int32, slope.shape, axis)
        slope = slope + jnp.where(place > 0, _slice(of_behind, 0, count, axis), 0.0) + of_plane / slope.size
        slope = slope + jnp.where(place < count - 1, _slice(of_before, 1, count, axis), 0.0)
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


def _neighbours(values: Array, axis: int) -> Parts:
    """All values but the last, and all but the first: what lies before and behind every border."""
    last = values.shape[axis] - 1
    return _slice(values, 0, last, axis), _slice(values, 1, last, axis)


def _slice(values: Array, start: int, count: int, axis: int) -> Array:
    return jax.lax.slice_in_dim(values, start, start + count, axis=axis)


class _Sides(NamedTuple):
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
        return _each(lambda before, behind: jnp.where(self.rise_m > 0, before, behind), self.before, self.behind)


class _Cells(eqx.Module):
    """Cells, and as many of no height as lie within reach of them beyond the rim."""

    height_m: Array
    real: Array
    imag: Array
    plane_m: Array  # mean height
    reach: int = eqx.field(static=True)

    @classmethod
    def of(cls, height_m: Array, rate: Any, reach: int) -> "_Cells":
        """Cells and their light, computed once for all."""

        def around(height_m: Array) -> tuple[Array, Array, Array]:
            padded = jnp.pad(height_m, reach)
            lit = cis(padded * rate)
            return padded, lit.real, lit.imag

        padded, real, imag = _once(around, height_m)
        return cls(padded, real, imag, jnp.mean(height_m), reach)

    def inner(self) -> Parts:
        """Light of the cells themselves."""
        reach = self.reach
        return self.real[reach:-reach, reach:-reach], self.imag[reach:-reach, reach:-reach]

    def sides(self, axis: int, reach: int) -> _Sides:
        """The sides of all borders along an axis, and of as many beyond its ends as lie within a shorter reach.

        These, that of the rim among them, are no walls: both sides are alike.
        """
        own = self.reach
        size = [n - 2 * own for n in self.height_m.shape]

        def pair(values: Array) -> Parts:
            values = _slice(values, own, size[1 - axis], 1 - axis)
            before, behind = _neighbours(_slice(values, own - reach, size[axis] + 2 * reach, axis), axis)
            place = jax.lax.broadcasted_iota(jnp.int32, before.shape, axis)
            return jnp.where((place >= reach) & (place < reach + size[axis] - 1), before, behind), behind

        low, high = pair(self.height_m)
        before, behind = zip(pair(self.real), pair(self.imag), strict=True)
        return _Sides(low, high, before, behind, self.plane_m)


def _each(function: Callable[..., Array], *parts: Any) -> Parts:
    """A function of real parts, and the same of imaginary ones."""
    real, imag = zip(*parts, strict=True)
    return function(*real), function(*imag)


def _product(one: Parts, other: Parts) -> Parts:
    return one[0] * other[0] - one[1] * other[1], one[0] * other[1] + one[1] * other[0]


def _dipole(walls: Walls, rise_m: Array, foot_m: Array) -> tuple[Parts, Parts]:
    """The dipole of a wall over the step of the light, and over the sum of the light of both sides."""
    numbers, height = tuple(zip(*walls.dipole, strict=True)), jnp.abs(rise_m)
    step = _each(lambda a, b, c, d: height * ((c - a) / 2 + (d - b) / 2 * height), *numbers)
    both = _each(lambda a, b, c, d: rise_m * ((a + c) / 2 + (b + d) / 2 * height), *numbers)
    return (step[0], step[1] + walls.foot * foot_m), both


def _lines(sides: _Sides, walls: Walls) -> Parts:
    """Lines of light of walls, over the pitch."""
    share = jnp.minimum(jnp.abs(sides.rise_m) * (1 / walls.highest_m), 1.0)
    width = _each(lambda series: share * series_at(series, 2 * share - 1), walls.width)
    return _product(width, sides.lower)


def _dipoles(sides: _Sides, walls: Walls) -> Parts:
    """Dipoles of walls, over the pitch squared."""
    step, both = _dipole(walls, jnp.clip(sides.rise_m, -walls.highest_m, walls.highest_m), sides.foot_m)
    change = _each(lambda before, behind: behind - before, sides.before, sides.behind)
    total = _sum([sides.before, sides.behind])
    return _sum([_product(step, change), _product(both, total)])


def _slopes(sides: _Sides, rate: Any, walls: Walls, of_lines: Parts, of_dipoles: Parts) -> tuple[Array, Array, Array]:
    """Derivatives by the heights before and behind every border, and by that of the plane.

    The last two arguments are the derivatives by the lines and the dipoles.
    """
    turn, rise, highest = 2 * np.pi * rate, sides.rise_m, walls.highest_m
    up, within = rise > 0, jnp.abs(rise) <= highest
    share = jnp.minimum(jnp.abs(rise) * (1 / highest), 1.0)
    seen = _product(of_lines, sides.lower)
    slope, width = (_each(lambda series: series_at(series, 2 * share - 1), kind) for kind in (walls.slope, walls.width))
    of_rise = jnp.where(within, _product(slope, seen)[0], 0.0) * jnp.sign(rise)
    of_foot = -turn * share * (width[0] * seen[1] + width[1] * seen[0])
    step, both = _dipole(walls, jnp.clip(rise, -highest, highest), sides.foot_m)
    # The dipole is (both - step) before + (both + step) behind.
    before, behind = _product(of_dipoles, sides.before), _product(of_dipoles, sides.behind)
    change, total = _each(lambda before, behind: behind - before, before, behind), _sum([before, behind])
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
    return of_before, turned[1] + of_rise + jnp.where(up, 0.0, of_foot), -jnp.sum(raised)


def _dipole_slope(walls: Walls, rise_m: Array) -> tuple[Parts, Parts]:
    """Derivatives of both by the rise."""
    numbers, height, sign = tuple(zip(*walls.dipole, strict=True)), jnp.abs(rise_m), jnp.sign(rise_m)
    step = _each(lambda a, b, c, d: sign * ((c - a) / 2 + (d - b) * height), *numbers)
    return step, _each(lambda a, b, c, d: (a + c) / 2 + (b + d) * height, *numbers)


def _to_cells(lines: Parts, weights: Float[Array, "part tap border"], axis: int) -> Parts:
    """Values of cells for light at their borders, and at as many beyond either end as the weights reach."""
    reach = _reach(weights)
    count = lines[0].shape[axis] + 1 - 2 * reach

    def one(tap: int) -> Parts:
        # The first of the weights is for the cell `reach` places before the one behind a border.
        start = 2 * reach - 1 - tap
        seen = _slice(lines[0], start, count, axis), _slice(lines[1], start, count, axis)
        return _weighted(seen, _weights_at(weights, tap, start - reach, count), axis)

    return _sum([one(tap) for tap in range(2 * reach)])


def _to_borders(cells: Parts, weights: Float[Array, "part tap border"], reach: int, axis: int) -> Parts:
    """The transpose, from cells with `reach` more at either end, with a border more at either end."""
    own, count = _reach(weights), cells[0].shape[axis] + 1 - 2 * reach

    def one(tap: int) -> Parts:
        start = reach - own + tap
        seen = _slice(cells[0], start, count, axis), _slice(cells[1], start, count, axis)
        return _weighted(seen, _weights_at(weights, tap, -1, count), axis)

    return _sum([one(tap) for tap in range(2 * own)])


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
