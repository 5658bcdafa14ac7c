"""Arrays of one cell: how a DOE is drawn whose relief repeats, as that of a beam splitter does.

The cell is one period of the relief, or a few of them where the copies would be too many. It is placed wherever the
plate is the same as the cell; the rest, as at the rim of the aperture, is drawn as ever. Edges that were moved against
the bias of the process (`fab.layout.compensation`) move the outline of a cell's share along, so that copies still
touch and never overlap.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.layout.compensation import MovedPlane
from fab.layout.geometry import Cell, Layer, Layout, PixelEdges, Reference, Shapes, merged, require_name
from fab.layout.polygons import rectangles

# Copies of one cell in a DOE: few enough for a wafer of dies and for every reader's patience.
MOST_COPIES = 10_000
_LOOKED_AT = 16  # rows compared before all of them


def cell_name(doe: str) -> str:
    """Return the name of the cell that the cell of a DOE repeats."""
    return f"{doe}CELL"


def period_of(level: NDArray[np.uint8]) -> tuple[int, int] | None:
    """Return the period ``(y, x)``, pixels, of the middle of a raster ``[y, x]``, half as long and wide as it is.

    None where less than two periods lie in the middle, or all of it is alike.
    """
    ny, nx = level.shape
    middle = level[ny // 4 : ny - ny // 4, nx // 4 : nx - nx // 4]
    along_y, along_x = _along_x(middle.T), _along_x(middle)
    return None if along_y is None or along_x is None or along_y == along_x == 1 else (along_y, along_x)


def _along_x(level: NDArray[np.uint8]) -> int | None:
    row, few = level[len(level) // 2], level[:: max(1, len(level) // _LOOKED_AT)]
    lengths = range(1, row.size // 2 + 1)
    return next((p for p in lengths if _repeats(row, p) and _repeats(few, p) and _repeats(level, p)), None)


def _repeats(level: NDArray[np.uint8], period: int) -> bool:
    return np.array_equal(level[..., period:], level[..., :-period])


def arrayed(
    doe: Cell, planes: Mapping[Layer, MovedPlane], edges: PixelEdges, period: tuple[int, int]
) -> tuple[Cell, Cell] | None:
    """Draw the planes of a DOE again as arrays of a cell, and what no copy of it is; return the cell, then the DOE.

    `period` is that of the relief ``(y, x)``, pixels. None where pixels are not all of one size in database units, or
    arrays would save no shapes, as with the lines of a grating.
    """
    steps_y, steps_x = np.diff(edges.y), np.diff(edges.x)
    if np.ptp(steps_y) or np.ptp(steps_x):
        return None
    copies = (steps_y.size // period[0]) * (steps_x.size // period[1])
    pixels_y, pixels_x = (pixels * max(1, math.ceil(math.sqrt(copies / MOST_COPIES))) for pixels in period)
    starts_y, starts_x = edges.y[::pixels_y], edges.x[::pixels_x]
    shares = {layer: _Share.of(plane, starts_y, starts_x) for layer, plane in planes.items()}
    placed = np.logical_and.reduce([share.alike for share in shares.values()])
    name, step_y, step_x = require_name(cell_name(doe.name)), int(pixels_y * steps_y[0]), int(pixels_x * steps_x[0])
    references = tuple(
        Reference(name, int(starts_x[x0]), int(starts_y[y0]), int(x1 - x0), int(y1 - y0), step_x, step_y)
        for x0, y0, x1, y1 in rectangles(placed.astype(np.uint8))
    )
    one = Cell(name, {layer: share.one() for layer, share in shares.items()})
    rest = {layer: share.rest(placed) for layer, share in shares.items()}
    drawn = len(references) + sum(map(len, (*one.shapes.values(), *rest.values())))
    if drawn >= sum(len(doe.shapes[layer]) for layer in planes):
        return None
    return one, Cell(doe.name, {**doe.shapes, **rest}, references)


@dataclass(frozen=True, eq=False)
class _Share:
    """A plane cut where copies of a cell may begin.

    Attributes:
        plane: what is cut.
        rows: numbers ``(n, h)`` of the rows of cells of the plane in each row of copies; columns likewise.
        columns: see `rows`.
        alike: ``[n, m]`` which copies are the same as the one in the middle.
    """

    plane: MovedPlane
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    alike: NDArray[np.bool_]

    @classmethod
    def of(cls, plane: MovedPlane, starts_y: NDArray[np.int32], starts_x: NDArray[np.int32]) -> "_Share":
        """Cut a plane at the starts of copies, the last of which is the end of the last copy; database units."""
        (rows, even_y), (columns, even_x) = (
            _cut(lines, starts + abs(plane.move_units)) for lines, starts in ((plane.y, starts_y), (plane.x, starts_x))
        )
        blocks = plane.cells[rows[:, None, :, None], columns[None, :, None, :]]
        same = (blocks == blocks[len(rows) // 2, len(columns) // 2]).all(axis=(2, 3))
        return cls(plane, rows, columns, same & even_y[:, None] & even_x)

    def one(self) -> Shapes:
        """Draw one copy, with its first pixel's corner at the origin."""
        rows, columns = self.rows[len(self.rows) // 2], self.columns[len(self.columns) // 2]
        y, x = (
            lines[np.append(numbers, numbers[-1] + 1)] - lines[numbers[0]] + abs(self.plane.move_units)
            for lines, numbers in ((self.plane.y, rows), (self.plane.x, columns))
        )
        return Shapes(rectangles(self.plane.cells[np.ix_(rows, columns)], x, y))

    def rest(self, placed: NDArray[np.bool_]) -> Shapes:
        """Draw what no copy draws, where copies are `placed`."""
        cells = self.plane.cells.copy()
        for y, x in zip(*np.nonzero(placed), strict=True):
            cells[np.ix_(self.rows[y], self.columns[x])] = 0
        return self.plane._replace(cells=cells).shapes()


def _cut(lines: NDArray[np.int32], starts: NDArray[np.int32]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the numbers ``(n, h)`` of the cells between starts, and which are each as long as those in the middle."""
    at = np.searchsorted(lines, starts)
    middle = (at.size - 1) // 2
    within = lines[at[middle] : at[middle + 1] + 1] - lines[at[middle]]
    numbers = np.minimum(at[:-1, None] + np.arange(within.size), lines.size - 1)
    even = (lines[numbers] - lines[numbers[:, :1]] == within).all(axis=1)
    return numbers[:, :-1], even


def unfolded(layout: Layout, does: Collection[str], most: int) -> Layout:
    """Return a layout in which cells of DOEs hold themselves what they repeat (`arrayed`), and the repeated are gone.

    Raises:
        InputError: the cells of DOEs stand for more than so many shapes.
    """
    ones = {cell_name(doe): layout.cell(cell_name(doe)) for doe in does}
    cells = []
    for cell in layout.cells:
        one = ones.get(cell_name(cell.name))
        if cell.name in does and one and not one.references and {at.cell for at in cell.references} == {one.name}:
            copies = sum(at.columns * at.rows for at in cell.references)
            count = copies * sum(map(len, one.shapes.values()))
            if count > most:
                cure = "Write the order again, or fetch the file again."
                raise InputError(f"cell {cell.name}", f"must stand for at most {most} shapes", f"{count} shapes", cure)
            ones[one.name] = None  # it is gone, unless another places it
            cells.append(_holding(cell, one))
        else:
            cells.append(cell)
    gone = {name for name, one in ones.items() if one is None}
    gone -= {at.cell for cell in cells for at in cell.references}
    return replace(layout, cells=tuple(cell for cell in cells if cell.name not in gone))


def _holding(doe: Cell, one: Cell) -> Cell:
    """Return the cell of a DOE with what it places drawn into it."""
    moves = np.concatenate([np.empty((0, 2), np.int32), *map(_places, doe.references)]).astype(np.int32)
    shapes = dict(doe.shapes)
    for layer, drawn in one.shapes.items():
        boxes = (drawn.rectangles + np.tile(moves, 2)[:, None]).reshape(-1, 4)
        polygons = tuple(polygon + move for move in moves for polygon in drawn.polygons)
        shapes[layer] = merged([shapes.get(layer, Shapes()), Shapes(boxes, polygons)])
    return Cell(doe.name, shapes)


def _places(at: Reference) -> NDArray[np.int64]:
    """Where the copies of a reference lie, x and y ``(n, 2)``."""
    rows, columns = np.mgrid[: at.rows, : at.columns]
    return np.stack([at.x + columns.ravel() * at.step_x, at.y + rows.ravel() * at.step_y], axis=1)
