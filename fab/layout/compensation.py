"""Compensation of line width: a mask drawn with its edges moved, so that the print comes back as designed.

A process that widens every etched area by b prints the design from a drawing whose edges moved by -b. An edge moves
by the same amount along x and y, as it does in the process model: what grows is the Minkowski sum with a square, what
shrinks is the complement of the grown complement. Edges between rectangles of one area are no edges and do not move.
Pixels that touch at a corner become one area when they grow, and part when they shrink.

The moved drawing lies on the raster of all pixel edges moved by + and by -. A cell of it is etched if any (growing), or
all (shrinking), of the pixels within the move of it are, so it is cut into rectangles like the plane itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fab.errors import InputError
from fab.grid import moved_edges
from fab.layout.geometry import PixelEdges, Shapes
from fab.layout.polygons import covered, rectangles, smallest_runs
from fab.units import format_length

_LIMIT = 2**31 - 1


def edge_moves(bias_m: Sequence[float], dbu_m: float) -> tuple[int, ...]:
    """Return how far the edges of every mask must move outward to undo the bias of the process, database units."""
    if not np.all(np.isfinite(bias_m)):
        raise InputError("CD bias", "must be finite", list(bias_m), "Give one length per mask.")
    return tuple(-round(bias / dbu_m) for bias in bias_m)


@njit(cache=True, nogil=True)
def _spread(plane, rows, columns, out):  # pragma: no cover - compiled
    # A cell is set if any pixel of its rows and columns is.
    merged = np.empty(plane.shape[1], np.uint8)
    for j in range(rows.shape[0]):
        merged[:] = 0
        for y in range(rows[j, 0], rows[j, 1]):
            for x in range(plane.shape[1]):
                merged[x] |= plane[y, x]
        for i in range(columns.shape[0]):
            value = np.uint8(0)
            for x in range(columns[i, 0], columns[i, 1]):
                value |= merged[x]
            out[j, i] = value


@njit(cache=True, nogil=True)
def _gather(cells, rows, columns, out):  # pragma: no cover - compiled
    # A pixel is set if every cell within the move of it is.
    out[:] = 1
    for j in range(rows.shape[0]):
        for i in range(columns.shape[0]):
            if cells[j, i]:
                continue
            for y in range(rows[j, 0], rows[j, 1]):
                for x in range(columns[i, 0], columns[i, 1]):
                    out[y, x] = 0


class _Raster(NamedTuple):
    """Lines of a moved raster, and first and end pixel within the move of its cells; shrinking grows the complement."""

    x: NDArray[np.int64]
    y: NDArray[np.int64]
    columns: NDArray[np.int64]
    rows: NDArray[np.int64]
    shrinks: bool

    @classmethod
    def of(cls, edges: PixelEdges, move_units: int) -> "_Raster":
        """Move the edges both ways."""
        move, lines = abs(move_units), [edges.x.astype(np.int64), edges.y.astype(np.int64)]
        if move_units < 0:
            lines = [np.concatenate([[axis[0] - 2 * move], axis, [axis[-1] + 2 * move]]) for axis in lines]
        (x, *columns), (y, *rows) = (moved_edges(axis, move) for axis in lines)
        worst = max(abs(int(v)) for v in (x[0], x[-1], y[0], y[-1]))
        if worst > _LIMIT:
            got = f"an edge at {worst} units"
            raise InputError("edge move", "the moved drawing must fit 32-bit coordinates", got, "Choose a smaller one.")
        return cls(x, y, np.stack(columns, axis=1), np.stack(rows, axis=1), move_units < 0)

    def cells(self, plane: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the moved plane, cell by cell."""
        out = np.empty((len(self.rows), len(self.columns)), dtype=np.uint8)
        _spread(np.pad(1 - plane, 1, constant_values=1) if self.shrinks else plane, self.rows, self.columns, out)
        return np.subtract(1, out, out=out) if self.shrinks else out

    def pixels(self, cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the plane whose move the cells are, if there is one."""
        out = np.empty((int(self.rows[-1, 1]), int(self.columns[-1, 1])), dtype=np.uint8)
        _gather(1 - cells if self.shrinks else cells, self.rows, self.columns, out)
        return 1 - out[1:-1, 1:-1] if self.shrinks else out


class MovedPlane(NamedTuple):
    """A plane as it is drawn: `cells` ``[y, x]``, 1 where etched, between lines x and y, and how far edges moved."""

    cells: NDArray[np.uint8]
    x: NDArray[np.int32]
    y: NDArray[np.int32]
    move_units: int

    def shapes(self) -> Shapes:
        """Draw it with rectangles."""
        return Shapes(rectangles(self.cells, self.x, self.y))


def grown(plane: NDArray[np.uint8], edges: PixelEdges, move_units: int) -> Shapes:
    """Draw what is `moved`."""
    return moved(plane, edges, move_units).shapes()


def moved(plane: NDArray[np.uint8], edges: PixelEdges, move_units: int) -> MovedPlane:
    """Return a plane ``[y, x]`` of 0 and 1 (1 where etched), its edges moved outward by database units, inward if < 0.

    Raises:
        InputError: moving the edges back would not give the plane, because a line or a space is not wider than twice
            the move; or coordinates beyond 32 bits.
    """
    plane = np.ascontiguousarray(plane, dtype=np.uint8)
    if move_units == 0:
        return MovedPlane(plane, edges.x, edges.y, 0)
    raster = _Raster.of(edges, move_units)
    cells = raster.cells(plane)
    if not np.array_equal(raster.pixels(cells), plane):
        line, space = smallest_runs(plane)
        what, pixels = ("line", line) if move_units < 0 else ("space", space)
        finest = "" if pixels is None else f", where the narrowest {what} has {pixels} pixels"
        rule = "edges must move by less than half the narrowest line and space"
        raise InputError("edge move", rule, f"{_text(move_units, edges)}{finest}", "Choose a smaller one.")
    return MovedPlane(cells, raster.x.astype(np.int32), raster.y.astype(np.int32), move_units)


def read_back(shapes: Shapes, edges: PixelEdges, move_units: int) -> NDArray[np.uint8]:
    """Return the plane ``[y, x]`` of which `grown` makes this drawing, and prove that it does.

    Raises:
        InputError: polygons, rectangles that overlap, an edge that is no moved pixel edge, or the area of no plane.
    """
    raster, where = _Raster.of(edges, move_units), "compensated mask"
    found = covered(shapes.rectangles, raster.x, raster.y)
    if strays := len(shapes.polygons) + found.strays:
        rule = f"every edge must be a pixel edge moved by {_text(move_units, edges)}"
        raise InputError(where, rule, f"{strays} shapes that are not", "Draw the mask again.")
    if found.overlaps:
        raise InputError(where, "rectangles must not overlap", "some that do", "Draw the mask again.")
    plane = raster.pixels(found.cells)
    if not np.array_equal(raster.cells(plane), found.cells):
        rule = f"must be a plane of pixels with its edges moved by {_text(move_units, edges)}"
        raise InputError(where, rule, "another area", "Draw the mask again.")
    return plane


def _text(move_units: int, edges: PixelEdges) -> str:
    return format_length(round(move_units * edges.dbu_m, 18))
