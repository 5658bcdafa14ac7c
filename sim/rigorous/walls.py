"""Light of upright walls and of corners where they meet, added to that of cells, with a gradient of its own.

Plain differentiation of the same formulas takes more than twice as long. Real and imaginary parts are apart, for
processors take several of a kind at a time. A plate is computed a few rows at a time: memory for all of it takes longer
to be had than to be filled.
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
from sim.rigorous.corner_light import CornerCell, Four, corner_light, corner_slopes
from sim.rigorous.edge_widths import EdgeTable, series_at

Parts = tuple[Array, Array]
"""Real and imaginary part."""

Series = tuple[tuple[float, ...], tuple[float, ...]]
"""Coefficients of real and imaginary part; as numbers in a program they are twice as fast as in an array."""


_ROWS = 96  # of cells that are computed together; with what lies around them


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


def _within(weights: Float[Array, "part tap own"], start: Any, count: int) -> Float[Array, "part tap found"]:
    """Weights for the borders of cells that follow each other, and for as many beyond either end as they reach."""
    reach = _reach(weights)
    if weights.shape[2] == 1:
        return weights
    wide = jnp.pad(weights, ((0, 0), (0, 0), (reach, reach)))
    return jax.lax.dynamic_slice_in_dim(wide, start, count + 2 * reach - 1, 2)


def _numbers(series: Complex[np.ndarray, " term"]) -> Series:
    return tuple(np.real(series).tolist()), tuple(np.imag(series).tolist())


@jax.jit
def light_of_cells_and_walls(
    height_m: Float[Array, "y x"], rate: Any, corner: Any, across_y: Walls, across_x: Walls
) -> Complex[Array, "y x"]:
    """Transmission of cells whose far field is that of thin cells, the walls between them and corners where they meet.

    Light is told at the mean height.

    Args:
        height_m: height of every cell.
        rate: waves per metre of height.
        corner: unit of the light of corners over the square of the pitch (`corner_unit`).
        across_y: walls between cells that are neighbours along y.
        across_x: the same along x.

    Returns:
        values of the cells; derivatives are taken with respect to the heights alone, and backwards.
    """
    return _light(height_m, rate, corner, across_y, across_x)


@jax.custom_vjp
def _light(height_m: Array, rate: Any, corner: Any, across_y: Walls, across_x: Walls) -> Array:
    return _forward(height_m, rate, corner, across_y, across_x)[0]


def _forward(
    height_m: Array, rate: Any, corner: Any, across_y: Walls, across_x: Walls
) -> tuple[Array, tuple[Any, ...]]:
    reach = max(across_y.reach, across_x.reach)
    plate = _Plate(jnp.pad(height_m, reach, mode="edge"), jnp.mean(height_m), rate, corner, reach)

    def add(number: Any, light: Array) -> Array:
        start = plate.start(number)
        of_rows = _light_of_rows(plate.cells(start), *_walls_of_rows(across_y, across_x, start, plate))
        return jax.lax.dynamic_update_slice(light, of_rows, (start, 0))

    light = jax.lax.fori_loop(0, plate.strips, add, jnp.zeros(height_m.shape, jnp.complex64))
    return light, (plate, across_y, across_x)


def _backward(kept: tuple[Any, ...], cotangent: Array) -> tuple[Array, None, None, None, None]:
    plate, across_y, across_x = kept
    reach = across_y.reach, across_x.reach
    wide = jnp.pad(cotangent, [(one, one) for one in reach])
    rows, columns = plate.rows, cotangent.shape[1]

    def add(number: Any, found: tuple[Array, Array]) -> tuple[Array, Array]:
        start = plate.start(number)
        given = jax.lax.dynamic_slice(wide, (start, 0), (rows + 2 * reach[0], columns + 2 * reach[1]))
        walls = _walls_of_rows(across_y, across_x, start, plate)
        slope, raised = _slopes_of_rows(plate.cells(start), (given.real, given.imag), start, *walls)
        # The last rows may be those of the strip before, too.
        fresh = start + jax.lax.broadcasted_iota(jnp.int32, raised.shape, 0) >= number * rows
        of_plane = found[1] - jnp.sum(jnp.where(fresh, raised, 0.0))
        return jax.lax.dynamic_update_slice(found[0], slope, (start, 0)), of_plane

    none = jnp.zeros(cotangent.shape, jnp.float32), jnp.float32(0)
    slope, of_plane = jax.lax.fori_loop(0, plate.strips, add, none)
    return slope + of_plane / slope.size, None, None, None, None


_light.defvjp(_forward, _backward)


class _Plate(eqx.Module):
    """Heights of a plate, and beyond its rim as many like the last as lie within reach: no walls are there."""

    height_m: Array
    plane_m: Array  # mean height
    rate: Any
    corner: Any
    reach: int = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, int]:
        """Of the plate itself."""
        ny, nx = self.height_m.shape
        return ny - 2 * self.reach, nx - 2 * self.reach

    @property
    def rows(self) -> int:
        """Rows of cells that are computed together."""
        return min(_ROWS, self.shape[0])

    @property
    def strips(self) -> int:
        """How often that is, to the last row."""
        return -(-self.shape[0] // self.rows)

    def start(self, strip: Any) -> Any:
        """First row of a strip; the last one ends with the plate."""
        return jnp.minimum(strip * self.rows, self.shape[0] - self.rows)

    def cells(self, start: Any) -> "_Cells":
        """Some rows of cells, with those within reach."""
        size = self.rows + 2 * self.reach, self.height_m.shape[1]
        height_m = jax.lax.dynamic_slice(self.height_m, (start, 0), size)

        def lit(height_m: Array) -> tuple[Array, Array]:
            light = cis(height_m * self.rate)
            return light.real, light.imag

        real, imag = _once(lit, height_m)
        return _Cells(height_m, real, imag, self)


def _walls_of_rows(across_y: Walls, across_x: Walls, start: Any, plate: _Plate) -> tuple[Walls, Walls]:
    """Walls with weights for the borders of some rows, and of all columns."""

    def at(walls: Walls, start: Any, count: int) -> Walls:
        own = _within(walls.weights, start, count), _within(walls.dipole_weights, start, count)
        return eqx.tree_at(lambda walls: (walls.weights, walls.dipole_weights), walls, own)

    return at(across_y, start, plate.rows), at(across_x, 0, plate.shape[1])


def _light_of_rows(around: "_Cells", across_y: Walls, across_x: Walls) -> Array:
    both = across_y, across_x

    def lines(around: _Cells) -> tuple[list[Parts], Parts]:
        of_walls = [_lines(around.sides(axis, _reach(walls.weights)), walls) for axis, walls in enumerate(both)]
        four = around.corners((_reach(across_y.weights), _reach(across_x.weights)))
        return of_walls, _each(lambda part: around.plate.corner * part, corner_light(four))

    def with_points(line: Parts, points: Parts) -> Parts:
        return _sum([line, _to_cells(points, across_x.weights, 1)])

    (along_x, along_y), points = _once(lines, around)
    cells = [around.inner()]
    for axis, (lit, walls) in enumerate(zip((_once(with_points, along_x, points), along_y), both, strict=True)):
        # Cheaper to compute for every cell that has a part of it than to write down.
        dipoles = _dipoles(around.sides(axis, _reach(walls.dipole_weights)), walls)
        cells += [_to_cells(lit, walls.weights, axis), _to_cells(dipoles, walls.dipole_weights, axis)]
    return jax.lax.complex(*_sum(cells))


def _slopes_of_rows(
    around: "_Cells", given: Parts, start: Any, across_y: Walls, across_x: Walls
) -> tuple[Array, Array]:
    """Derivatives by the heights of some rows, and what the plane has of them, less its sign, cell by cell.

    Args:
        around: the cells.
        given: derivative by the light of these cells and of all that share light with them.
        start: the first row.
        across_y: walls, as `_walls_of_rows`.
        across_x: the same along x.
    """
    both, plate = (across_y, across_x), around.plate
    reach, rate = (across_y.reach, across_x.reach), plate.rate
    own = tuple(part[reach[0] : -reach[0], reach[1] : -reach[1]] for part in given)
    tall, wide = ([part[:, reach[1] : -reach[1]] for part in given], [part[reach[0] : -reach[0]] for part in given])

    def borders(given: Parts, tall: Parts, wide: Parts) -> tuple[Parts, list[list[Parts]]]:
        of_lines = _to_borders(given, across_y.weights, reach[0], 0)
        inner = _each(lambda part: part[:, reach[1] : -reach[1]], of_lines)
        return of_lines, [
            [inner, _to_borders(tall, across_y.dipole_weights, reach[0], 0)],
            [_to_borders(wide, weights, reach[1], 1) for weights in (across_x.weights, across_x.dipole_weights)],
        ]

    def slopes(around: _Cells, seen: list[list[Parts]]) -> list[tuple[Array, Array, Array]]:
        return [_slopes(around.sides(axis, 1), rate, both[axis], *seen[axis]) for axis in range(2)]

    def at_corners(around: _Cells, of_points: Parts) -> list[Array]:
        return [2 * np.pi * rate * plate.corner * of for of in corner_slopes(around.corners((1, 1)), of_points)]

    of_lines, seen = _once(borders, given, tuple(tall), tuple(wide))
    found = _once(slopes, around, seen)
    of_points = _once(lambda lines: _to_borders(lines, across_x.weights, reach[1], 1), of_lines)
    of_corners = _once(at_corners, around, of_points)
    thin = around.inner()
    slope = -(2 * np.pi * rate) * (own[0] * thin[1] + own[1] * thin[0])
    places = [jax.lax.broadcasted_iota(jnp.int32, slope.shape, axis) + (start, 0)[axis] for axis in range(2)]
    # A cell lies behind the first border and before the second; but there is none at the rim.
    inside = [(place > 0, place < count - 1) for place, count in zip(places, plate.shape, strict=True)]
    raised = jnp.zeros_like(slope)
    for axis, (of_before, of_behind, of_plane) in enumerate(found):
        count, (behind, before) = slope.shape[axis], inside[axis]
        slope = slope + jnp.where(behind, _slice(of_behind, 0, count, axis), 0.0)
        slope = slope + jnp.where(before, _slice(of_before, 1, count, axis), 0.0)
        raised = raised + jnp.where(behind, _slice(of_plane, 0, count, axis), 0.0)
    for of, (y, x) in zip(of_corners, np.ndindex(2, 2), strict=True):
        # Cells before a corner have it at their far side.
        corner = _slice(_slice(of, 1 - y, slope.shape[0], 0), 1 - x, slope.shape[1], 1)
        slope = slope + jnp.where(inside[0][1 - y] & inside[1][1 - x], corner, 0.0)
    return slope, raised


def _once(function: Callable[..., Any], *arrays: Any) -> Any:
    """The value of a function, computed once for all who use it.

    A compiler that fuses loops computes cheap values anew for every neighbour that reads them, ten times here; it
    does not look into a branch. Heights that are not numbers give none of this light, and their own is none either.
    """
    shapes = jax.eval_shape(function, *arrays)
    none = lambda *_: jax.tree.map(lambda one: jnp.zeros(one.shape, one.dtype), shapes)  # noqa: E731
    first = jax.tree.leaves(arrays)[0]
    return jax.lax.cond(jnp.isfinite(first[0, 0]), function, none, *arrays)


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
    """Rows of cells, their light, and that of those within reach."""

    height_m: Array
    real: Array
    imag: Array
    plate: _Plate

    def inner(self) -> Parts:
        """Light of the cells themselves."""
        reach = self.plate.reach
        return self.real[reach:-reach, reach:-reach], self.imag[reach:-reach, reach:-reach]

    def sides(self, axis: int, reach: int) -> _Sides:
        """The sides of all borders along an axis, and of as many beyond its ends as lie within a shorter reach."""
        own = self.plate.reach
        size = [n - 2 * own for n in self.height_m.shape]

        def pair(values: Array) -> Parts:
            values = _slice(values, own, size[1 - axis], 1 - axis)
            return _neighbours(_slice(values, own - reach, size[axis] + 2 * reach, axis), axis)

        low, high = pair(self.height_m)
        before, behind = zip(pair(self.real), pair(self.imag), strict=True)
        return _Sides(low, high, before, behind, self.plate.plane_m)

    def corners(self, reach: tuple[int, int]) -> Four:
        """The cells at all corners, and at as many beyond the ends of either axis as lie within a shorter reach."""
        own, turn = self.plate.reach, 2 * np.pi * self.plate.rate
        ny, nx = (n - 2 * own + 2 * one - 1 for n, one in zip(self.height_m.shape, reach, strict=True))

        def cell(y: int, x: int) -> CornerCell:
            def part(values: Array) -> Array:
                return _slice(_slice(values, own - reach[0] + y, ny, 0), own - reach[1] + x, nx, 1)

            return CornerCell(turn * part(self.height_m), part(self.real), part(self.imag))

        return cell(0, 0), cell(0, 1), cell(1, 0), cell(1, 1)


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
    return of_before, turned[1] + of_rise + jnp.where(up, 0.0, of_foot), raised


def _dipole_slope(walls: Walls, rise_m: Array) -> tuple[Parts, Parts]:
    """Derivatives of both by the rise."""
    numbers, height, sign = tuple(zip(*walls.dipole, strict=True)), jnp.abs(rise_m), jnp.sign(rise_m)
    step = _each(lambda a, b, c, d: sign * ((c - a) / 2 + (d - b) * height), *numbers)
    return step, _each(lambda a, b, c, d: (a + c) / 2 + (b + d) * height, *numbers)


def _to_cells(lines: Parts, weights: Float[Array, "part tap border"], axis: int) -> Parts:
    """Values of cells for light at their borders, and at as many beyond either end as the weights reach (`_within`)."""
    reach = _reach(weights)
    count = lines[0].shape[axis] + 1 - 2 * reach

    def one(tap: int) -> Parts:
        # The first of the weights is for the cell `reach` places before the one behind a border.
        start = 2 * reach - 1 - tap
        seen = _slice(lines[0], start, count, axis), _slice(lines[1], start, count, axis)
        return _weighted(seen, weights[:, tap], start, axis)

    return _sum([one(tap) for tap in range(2 * reach)])


def _to_borders(cells: Parts, weights: Float[Array, "part tap border"], reach: int, axis: int) -> Parts:
    """The transpose, from cells with `reach` more at either end, with a border more at either end."""
    own, count = _reach(weights), cells[0].shape[axis] + 1 - 2 * reach

    def one(tap: int) -> Parts:
        start = reach - own + tap
        seen = _slice(cells[0], start, count, axis), _slice(cells[1], start, count, axis)
        return _weighted(seen, weights[:, tap], own - 1, axis)

    return _sum([one(tap) for tap in range(2 * own)])


def _weighted(parts: Parts, weights: Float[Array, "part border"], first: int, axis: int) -> Parts:
    """Products of values and weights along an axis, from a first of the weights where they are not all alike."""
    if weights.shape[1] > 1:
        weights = _slice(weights, first, parts[0].shape[axis], 1)
    along = [weight[:, None] if axis == 0 else weight for weight in weights]
    if len(along) == 1:
        return parts[0] * along[0], parts[1] * along[0]
    return parts[0] * along[0] - parts[1] * along[1], parts[0] * along[1] + parts[1] * along[0]


def _sum(taps: list[Parts]) -> Parts:
    first, *others = taps
    for parts in others:
        first = first[0] + parts[0], first[1] + parts[1]
    return first
