"""The light of a whole plate of cells, walls and corners, a few rows at a time, with a gradient of its own.

Plain differentiation of the same formulas takes more than twice as long. Memory for all of a plate takes longer to be
had than to be filled; that for some rows is at hand.
"""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from sim.propagation.pupil import cis
from sim.rigorous.corner_light import CornerCell, Four, corner_light, corner_slopes
from sim.rigorous.walls import (
    Corners,
    Parts,
    Sides,
    Walls,
    dipoles_of,
    each,
    lines_of,
    reach_of,
    slice_of,
    slopes_of,
    sum_of,
    to_borders,
    to_cells,
    weights_within,
)

_ROWS = 96  # of cells that are computed together; with what lies around them


@jax.jit
def light_of_cells_and_walls(
    height_m: Float[Array, "y x"], rate: Any, corners: Corners, across_y: Walls, across_x: Walls
) -> Complex[Array, "y x"]:
    """Transmission of cells whose far field is that of thin cells, the walls between them and corners where they meet.

    Light is told at the mean height.

    Args:
        height_m: height of every cell.
        rate: waves per metre of height.
        corners: what points at corners add; their weights reach no farther than those of walls.
        across_y: walls between cells that are neighbours along y.
        across_x: the same along x.

    Returns:
        values of the cells; derivatives are taken with respect to the heights alone, and backwards.
    """
    return _light(height_m, rate, corners, across_y, across_x)


@jax.custom_vjp
def _light(height_m: Array, rate: Any, corners: Corners, across_y: Walls, across_x: Walls) -> Array:
    return _forward(height_m, rate, corners, across_y, across_x)[0]


def _forward(
    height_m: Array, rate: Any, corners: Corners, across_y: Walls, across_x: Walls
) -> tuple[Array, tuple[Any, ...]]:
    reach = max(across_y.reach, across_x.reach)
    corners = eqx.tree_at(lambda of: of.weights, corners, weights_within(corners.weights, 0, height_m.shape[1]))
    plate = _Plate(height_m, jnp.mean(height_m), rate, corners, reach)

    def add(number: Any, light: Array) -> Array:
        start = plate.start(number)
        of_rows = _light_of_rows(plate.cells(start), *_walls_of_rows(across_y, across_x, start, plate))
        return jax.lax.dynamic_update_slice(light, of_rows, (start, 0))

    light = jax.lax.fori_loop(0, plate.strips, add, jnp.zeros(height_m.shape, jnp.complex64))
    return light, (plate, across_y, across_x)


def _backward(kept: tuple[Any, ...], cotangent: Array) -> tuple[Array, None, None, None, None]:
    plate, across_y, across_x = kept
    reach = across_y.reach, across_x.reach
    rows = plate.rows

    def add(number: Any, found: tuple[Array, Array]) -> tuple[Array, Array]:
        start = plate.start(number)
        given = _rows_around(cotangent, start, rows, reach, "constant")
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
    """Heights of a plate, and what its light is computed with."""

    height_m: Array
    plane_m: Array  # mean height
    rate: Any
    corners: Corners
    reach: int = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, int]:
        """In cells."""
        ny, nx = self.height_m.shape
        return ny, nx

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
        """Some rows of cells, with those within reach; beyond the rim there are more like the last, and no walls."""
        height_m = _rows_around(self.height_m, start, self.rows, (self.reach, self.reach), "edge")

        def lit(height_m: Array) -> tuple[Array, Array]:
            light = cis(height_m * self.rate)
            return light.real, light.imag

        real, imag = _once(lit, height_m)
        return _Cells(height_m, real, imag, self)


def _rows_around(
    values: Array, start: Any, count: int, reach: tuple[int, int], beyond: Literal["edge", "constant"]
) -> Array:
    """Some rows, with what lies around them.

    Padding the whole plate would take memory for one more.

    Args:
        values: of all cells.
        start: first row.
        count: rows.
        reach: cells around them, along y and x.
        beyond: like the last cells, or 0.
    """
    tall = count + 2 * reach[0]
    size = min(tall, len(values))
    first = jnp.clip(start - reach[0], 0, len(values) - size)

    def within(values: Array) -> Array:
        rows = jax.lax.dynamic_slice_in_dim(values, first, size)
        return jnp.pad(rows, ((0, tall - size), (0, 0)))  # a lower plate never comes here, but needs this shape

    def at_the_rim(values: Array) -> Array:
        rows = jax.lax.dynamic_slice_in_dim(values, first, size)
        rows = jnp.pad(rows, ((reach[0], reach[0] + tall - size), (0, 0)), mode=beyond)
        return jax.lax.dynamic_slice_in_dim(rows, start - first, tall)

    inside = (start >= reach[0]) & (start + count + reach[0] <= len(values))
    rows = jax.lax.cond(inside, within, at_the_rim, values)
    return jnp.pad(rows, ((0, 0), (reach[1], reach[1])), mode=beyond)


def _walls_of_rows(across_y: Walls, across_x: Walls, start: Any, plate: _Plate) -> tuple[Walls, Walls]:
    """Walls with weights for the borders of some rows, and of all columns."""

    def at(walls: Walls, start: Any, count: int) -> Walls:
        own = weights_within(walls.weights, start, count), weights_within(walls.dipole_weights, start, count)
        return eqx.tree_at(lambda walls: (walls.weights, walls.dipole_weights), walls, own)

    return at(across_y, start, plate.rows), at(across_x, 0, plate.shape[1])


def _light_of_rows(around: "_Cells", across_y: Walls, across_x: Walls) -> Array:
    both, corners = (across_y, across_x), around.plate.corners

    def lit(around: _Cells) -> tuple[list[Parts], list[Parts], Parts]:
        lines = [lines_of(around.sides(axis, reach_of(walls.weights)), walls) for axis, walls in enumerate(both)]
        dipoles = [
            dipoles_of(around.sides(axis, reach_of(walls.dipole_weights)), walls) for axis, walls in enumerate(both)
        ]
        four = around.cells_at_corners((reach_of(across_y.weights), reach_of(corners.weights)))
        return lines, dipoles, each(lambda part: corners.unit * part, corner_light(four))

    def with_points(line: Parts, points: Parts) -> Parts:
        return sum_of([line, to_cells(points, corners.weights, 1)])

    (along_x, along_y), dipoles, points = _once(lit, around)
    cells = [around.inner()]
    for axis, (lines, walls) in enumerate(zip((_once(with_points, along_x, points), along_y), both, strict=True)):
        cells += [to_cells(lines, walls.weights, axis), to_cells(dipoles[axis], walls.dipole_weights, axis)]
    return jax.lax.complex(*sum_of(cells))


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
    reach, rate, corners = (across_y.reach, across_x.reach), plate.rate, plate.corners
    own = tuple(part[reach[0] : -reach[0], reach[1] : -reach[1]] for part in given)
    tall, wide = ([part[:, reach[1] : -reach[1]] for part in given], [part[reach[0] : -reach[0]] for part in given])

    def borders(given: Parts, tall: Parts, wide: Parts) -> tuple[Parts, list[list[Parts]]]:
        of_lines = to_borders(given, across_y.weights, reach[0], 0)
        inner = each(lambda part: part[:, reach[1] : -reach[1]], of_lines)
        return of_lines, [
            [inner, to_borders(tall, across_y.dipole_weights, reach[0], 0)],
            [to_borders(wide, weights, reach[1], 1) for weights in (across_x.weights, across_x.dipole_weights)],
        ]

    def slopes(around: _Cells, seen: list[list[Parts]]) -> list[tuple[Array, Array, Array]]:
        return [slopes_of(around.sides(axis, 1), rate, both[axis], *seen[axis]) for axis in range(2)]

    def at_corners(around: _Cells, of_points: Parts) -> list[Array]:
        four = around.cells_at_corners((1, 1))
        return [2 * np.pi * rate * corners.unit * of for of in corner_slopes(four, of_points)]

    of_lines, seen = _once(borders, given, tuple(tall), tuple(wide))
    found = _once(slopes, around, seen)
    of_points = _once(lambda lines: to_borders(lines, corners.weights, reach[1], 1), of_lines)
    of_corners = _once(at_corners, around, of_points)
    thin = around.inner()
    slope = -(2 * np.pi * rate) * (own[0] * thin[1] + own[1] * thin[0])
    places = [jax.lax.broadcasted_iota(jnp.int32, slope.shape, axis) + (start, 0)[axis] for axis in range(2)]
    # A cell lies behind the first border and before the second; but there is none at the rim.
    inside = [(place > 0, place < count - 1) for place, count in zip(places, plate.shape, strict=True)]
    raised = jnp.zeros_like(slope)
    for axis, (of_before, of_behind, of_plane) in enumerate(found):
        count, (behind, before) = slope.shape[axis], inside[axis]
        slope = slope + jnp.where(behind, slice_of(of_behind, 0, count, axis), 0.0)
        slope = slope + jnp.where(before, slice_of(of_before, 1, count, axis), 0.0)
        raised = raised + jnp.where(behind, slice_of(of_plane, 0, count, axis), 0.0)
    for of, (y, x) in zip(of_corners, np.ndindex(2, 2), strict=True):
        # Cells before a corner have it at their far side.
        corner = slice_of(slice_of(of, 1 - y, slope.shape[0], 0), 1 - x, slope.shape[1], 1)
        slope = slope + jnp.where(inside[0][1 - y] & inside[1][1 - x], corner, 0.0)
    return slope, raised


def _once(function: Callable[..., Any], *arrays: Any) -> Any:
    """The value of a function, computed once for all who use it.

    A compiler that fuses loops computes cheap values anew for every neighbour that reads them, ten times here; it
    does not look into a branch. Heights that are not numbers give light that is none either.
    Arrays of one shape leave the branch two by two as complex ones, for there is one loop for every array, and one
    for real and imaginary part takes half of the time of two.
    """
    shapes, structure = jax.tree.flatten(jax.eval_shape(function, *arrays))
    pairs, first = [], 0
    while first < len(shapes):
        alike = first + 1 < len(shapes) and shapes[first].shape == shapes[first + 1].shape
        pairs.append(slice(first, first + 1 + alike))
        first += 1 + alike

    def joined(*arrays: Any) -> list[Array]:
        found = jax.tree.leaves(function(*arrays))
        return [jax.lax.complex(*of) if len(of) == 2 else of[0] for of in (found[pair] for pair in pairs)]

    def none(*arrays: Any) -> list[Array]:
        return [jnp.full(one.shape, jnp.nan, one.dtype) for one in jax.eval_shape(joined, *arrays)]

    some = jax.lax.cond(jnp.isfinite(jax.tree.leaves(arrays)[0][0, 0]), joined, none, *arrays)
    parts = [part for one in some for part in ((one.real, one.imag) if jnp.iscomplexobj(one) else (one,))]
    return jax.tree.unflatten(structure, parts)


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

    def sides(self, axis: int, reach: int) -> Sides:
        """The sides of all borders along an axis, and of as many beyond its ends as lie within a shorter reach."""
        own = self.plate.reach
        size = [n - 2 * own for n in self.height_m.shape]

        def pair(values: Array) -> Parts:
            values = slice_of(values, own, size[1 - axis], 1 - axis)
            return _neighbours(slice_of(values, own - reach, size[axis] + 2 * reach, axis), axis)

        low, high = pair(self.height_m)
        before, behind = zip(pair(self.real), pair(self.imag), strict=True)
        return Sides(low, high, before, behind, self.plate.plane_m)

    def cells_at_corners(self, reach: tuple[int, int]) -> Four:
        """The cells at all corners, and at as many beyond the ends of either axis as lie within a shorter reach."""
        own, turn = self.plate.reach, 2 * np.pi * self.plate.rate
        ny, nx = (n - 2 * own + 2 * one - 1 for n, one in zip(self.height_m.shape, reach, strict=True))

        def cell(y: int, x: int) -> CornerCell:
            def part(values: Array) -> Array:
                return slice_of(slice_of(values, own - reach[0] + y, ny, 0), own - reach[1] + x, nx, 1)

            return CornerCell(turn * part(self.height_m), part(self.real), part(self.imag))

        return cell(0, 0), cell(0, 1), cell(1, 0), cell(1, 1)


def _neighbours(values: Array, axis: int) -> Parts:
    """All values but the last, and all but the first: what lies before and behind every border."""
    last = values.shape[axis] - 1
    return slice_of(values, 0, last, axis), slice_of(values, 1, last, axis)
