"""Mask aperture: any open cells of a raster, about its centre, perhaps with their rim moved inward.

A rim moves by the same length along x and along y, as the edges of etched areas do (`fab.layout.compensation`): open is
what lies farther than that, along either axis, from every closed cell. Lines between open cells do not move, and parts
that are too narrow close. The moved area lies on the raster of all cell edges moved both ways.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fab.aperture.loops import loops_around
from fab.aperture.outline import Aperture
from fab.errors import InputError
from fab.grid import SLACK, Grid, moved_edges
from fab.units import format_length

_MOST_SIDE = 20_000
_CURE = "Write the file again from its source."


class OpenArea(NamedTuple):
    """An area on a raster that may be uneven: lines along y and along x, rising, and which cells between are open.

    Nothing beyond the box of the open cells is part of it; without any, it is empty.
    """

    y: NDArray[Any]
    x: NDArray[Any]
    cells: NDArray[np.bool_]


@dataclass(frozen=True)
class MaskAperture(Aperture):
    """Open cells of a raster.

    Attributes:
        shape: cells of the raster ``(ny, nx)``, centred on the origin.
        pitch_m: edge of a cell, metres.
        packed: eight cells to a byte along x, every row for itself, row 0 at the lowest y; ones are open.
        inset_m: how far the rim of the open area has moved inward, metres.

    Raises:
        InputError: a raster, an inset or a number of bytes that cannot be.
    """

    shape: tuple[int, int]
    pitch_m: float
    packed: bytes
    inset_m: float = 0.0

    def __post_init__(self) -> None:
        ny, nx = self.shape
        sound = 1 <= ny <= _MOST_SIDE and 1 <= nx <= _MOST_SIDE and len(self.packed) == ny * -(-nx // 8)
        if not (sound and 0 < self.pitch_m < math.inf and 0 <= self.inset_m < math.inf):
            got = f"{ny} x {nx} cells of {self.pitch_m:g} m in {len(self.packed)} bytes, moved by {self.inset_m:g} m"
            rule = f"a mask must have 1 to {_MOST_SIDE} cells per side, a pitch, and a rim that moves inward"
            raise InputError("aperture", rule, got, "Check the mask and its pitch.")

    @classmethod
    def of(cls, plane: NDArray[Any], pitch_m: float) -> "MaskAperture":
        """Make one of cells ``[y, x]``, open where they are not 0, of a pitch in metres."""
        ny, nx = plane.shape
        return cls((ny, nx), pitch_m, np.packbits(plane != 0, axis=1).tobytes())

    @property
    def plane(self) -> NDArray[np.bool_]:
        """Cells ``[y, x]`` that are open before the rim moves."""
        rows = np.frombuffer(self.packed, np.uint8).reshape(self.shape[0], -1)
        return np.unpackbits(rows, axis=1, count=self.shape[1]).view(np.bool_)

    @property
    def area(self) -> OpenArea:
        """The open area; lines in cells from the middle of the raster."""
        return _area_of(self)

    def area_on(self, y: NDArray[np.int64], x: NDArray[np.int64], inset: int) -> OpenArea:
        """Return what is open in a drawing, by the cell edges and the inset in it, whole units."""
        return _moved(self.plane, y, x, inset)

    @property
    def extent_m(self) -> tuple[float, float]:
        """Twice the distance of its farthest points from either axis."""
        sides = (2 * float(max(-lines[0], lines[-1])) if lines.size else 0.0 for lines in self.area[:2])
        height, width = (side * self.pitch_m for side in sides)
        return height, width

    @property
    def reach_m(self) -> float:
        """Distance of its farthest corner."""
        y, x, cells = self.area
        if not cells.size:
            return 0.0
        high, open_ = np.maximum(-y[:-1], y[1:]), cells.any(axis=1)
        left, right = x[cells.argmax(axis=1)], x[cells.shape[1] - cells[:, ::-1].argmax(axis=1)]
        return float(np.hypot(high, np.maximum(-left, right))[open_].max()) * self.pitch_m

    def area_in(self, pitch_m: float, times: int = 1) -> float:
        """Sum over its cells."""
        y, x, cells = self.area
        return times * float(np.diff(y) @ cells @ np.diff(x)) * (self.pitch_m / pitch_m) ** 2 if cells.size else 0.0

    @property
    def centroid_m(self) -> tuple[float, float]:
        """Mean of the middles of its cells."""
        y, x, cells = self.area
        rows, columns = np.diff(y) * (cells @ np.diff(x)), np.diff(x) * (np.diff(y) @ cells)
        sums = (float(part @ (lines[1:] + lines[:-1]) / 2) for part, lines in ((rows, y), (columns, x)))
        low, left = (total / self.area_in(self.pitch_m) * self.pitch_m for total in sums)
        return low, left

    def parts_closed(self, by_m: float) -> tuple[int, int]:
        """Count the parts of the open cells, and those of which nothing is open once the rim has moved further in."""
        from scipy import ndimage

        label: Any = ndimage.label
        parts, count = label(self.plane)
        y, x, cells = self.shrunk(by_m).area
        rows, columns = (
            np.floor((lines[1:] + lines[:-1]) / 2 + n / 2).astype(int)
            for lines, n in zip((y, x), self.shape, strict=True)
        )
        return count, count - len(np.unique(parts[np.ix_(rows, columns)][cells]))

    def contains(self, y_m: NDArray[np.floating], x_m: NDArray[np.floating]) -> NDArray[np.bool_]:
        """By the cell that they lie in, or by any that they touch."""
        y, x, cells = self.area
        padded = np.pad(cells, 1) if cells.size else np.zeros((1, 1), np.bool_)
        found = np.zeros(np.broadcast_shapes(np.shape(y_m), np.shape(x_m)), np.bool_)
        for side_y in (-1, 1):
            for side_x in (-1, 1):
                row, column = (
                    np.searchsorted(lines, np.asarray(at) / self.pitch_m + side * SLACK * max(self.shape))
                    for lines, at, side in ((y, y_m, side_y), (x, x_m, side_x))
                )
                found |= padded[row, column]
        return found

    def inside(self, grid: Grid) -> NDArray[np.bool_]:
        """Cells whose centres it contains."""
        return self.contains(grid.axis_m("y")[:, None], grid.axis_m("x")[None, :])

    def count_inside(self, grid: Grid) -> int:
        """Number of these cells."""
        return int(np.count_nonzero(self.inside(grid)))

    def shrunk(self, by_m: float) -> "MaskAperture":
        """The same cells with their rim moved further inward."""
        return MaskAperture(self.shape, self.pitch_m, self.packed, self.inset_m + by_m)

    def outlines_m(self, corners: int) -> list[NDArray[np.float64]]:
        """Return the outlines of all its parts, and of what is closed within them."""
        return [loop * self.pitch_m for loop in loops_around(*self.area)]

    @property
    def sizes_m(self) -> tuple[float, ...]:
        """Width and height of the smallest box around it."""
        y, x, _ = self.area
        return tuple(float(lines[-1] - lines[0]) * self.pitch_m if lines.size else 0.0 for lines in (x, y))

    def __str__(self) -> str:
        """Return "mask of 2 mm x 1 mm"."""
        return f"mask of {' x '.join(map(format_length, self.sizes_m))}"

    def record(self, unit_m: float = 1.0, digits: int | None = None) -> Any:
        """Return shape, pitch and inset, and the rows from the lowest: [how many alike, start, stop, start, stop, ...].

        A run of open cells begins with the cell `start` and ends before `stop`, counted from the lowest x.
        """
        pitch, inset = (size if unit_m == 1.0 else size / unit_m for size in (self.pitch_m, self.inset_m))
        if digits is not None:
            # A pitch has more digits than lengths that are drawn.
            pitch, inset = round(pitch, digits + 3), round(inset, digits)
        return {"shape": list(self.shape), "pitch": pitch, "inset": inset, "rows": rows_of(self.plane)}

    @classmethod
    def from_record(
        cls, record: Any, unit_m: float, digits: int | None, where: str, shape: tuple[int, int] | None = None
    ) -> "MaskAperture":
        """Make the one of a `record`; lengths, `where` and `shape` as in `fab.aperture.aperture_from`.

        Raises:
            InputError: keys, numbers or rows that no mask has, or other cells than those of `shape`.
        """
        try:
            (ny, nx), rows = record["shape"], record["rows"]
            _require_cells((ny, nx), shape)
            lengths = [float(record[key]) * unit_m for key in ("pitch", "inset")]
            pitch_m, inset_m = lengths if digits is None else (round(length, digits) for length in lengths)
            found = cls.of(plane_of(rows, (ny, nx)), pitch_m).shrunk(inset_m)
        except (TypeError, ValueError, KeyError, OverflowError) as error:
            got = error.got if isinstance(error, InputError) else str(error)
            raise InputError(where, "must hold shape, pitch, inset and rows of a mask", str(got)[:80], _CURE) from error
        return found


def _require_cells(shape: tuple[Any, Any], wanted: tuple[int, int] | None) -> None:
    """Raise a ValueError for a mask of other cells than those that are wanted, if any are."""
    if wanted is not None and shape != wanted:
        (ny, nx), (rows, columns) = shape, wanted
        raise ValueError(f"one of {ny} x {nx} cells for a raster of {rows} x {columns}")


def rows_of(plane: NDArray[np.bool_]) -> list[list[int]]:
    """Return the rows of a plane ``[y, x]``, as a `MaskAperture` records them."""
    found: list[list[int]] = []
    steps = np.diff(np.pad(plane, ((0, 0), (1, 1))).view(np.int8), axis=1)
    for row in steps:
        runs = np.flatnonzero(row).tolist()
        if found and found[-1][1:] == runs:
            found[-1][0] += 1
        else:
            found.append([1, *runs])
    return found


def plane_of(rows: Any, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the plane ``[y, x]`` of a shape that rows, as a `MaskAperture` records them, are of.

    Raises:
        ValueError: numbers that are not whole, runs that do not rise or lie beyond the raster, more or fewer rows.
    """
    ny, nx = shape
    if not all(isinstance(n, int) and not isinstance(n, bool) and 1 <= n <= _MOST_SIDE for n in shape):
        raise ValueError(f"a raster of {ny} x {nx}")
    steps, y = np.zeros((ny, nx + 1), np.int8), 0
    for row in rows:
        count, *runs = row
        whole = all(isinstance(n, int) and not isinstance(n, bool) for n in row)
        rising = all(a < b for a, b in zip([-1, *runs], [*runs, nx + 1], strict=True))
        if not (whole and rising and count >= 1 and len(runs) % 2 == 0 and y + count <= ny):
            raise ValueError(f"the row {str(list(row))[:50]} on {ny} x {nx} cells")
        steps[y : y + count, runs[::2]], steps[y : y + count, runs[1::2]] = 1, -1
        y += count
    if y != ny:
        raise ValueError(f"{y} rows instead of {ny}")
    return np.cumsum(steps[:, :nx], axis=1, dtype=np.int8).view(np.bool_)


@lru_cache(maxsize=8)
def _area_of(mask: MaskAperture) -> OpenArea:
    inset = mask.inset_m / mask.pitch_m
    # A half number of cells is meant where rounding leaves it within a part in 1e9: edges moved both ways then meet.
    halves = round(2 * inset)
    inset = halves / 2 if abs(2 * inset - halves) <= 1e-9 * max(1, halves) else inset
    y, x = (np.arange(n + 1) - n / 2 for n in mask.shape)
    found = _moved(mask.plane, y, x, inset)
    for part in found:
        part.setflags(write=False)
    return found


def _moved(plane: NDArray[np.bool_], y: NDArray[Any], x: NDArray[Any], inset: Any) -> OpenArea:
    """Move the rim of the open cells of a plane inward, by its cell edges in the unit of the inset."""
    if not inset:
        return _cropped(y, x, plane)
    # Closed cells lie around the plane, wider than the inset.
    around = (np.concatenate([edges[:1] - 3 * inset, edges, edges[-1:] + 3 * inset]) for edges in (y, x))
    (rows, low, high), (columns, left, right) = (moved_edges(edges, inset) for edges in around)
    # Number of closed cells below and left of every corner; a ring of them lies around the plane.
    closed = np.pad(~np.pad(plane, 1), ((1, 0), (1, 0))).astype(np.int32)
    np.cumsum(closed, axis=0, out=closed)
    np.cumsum(closed, axis=1, out=closed)
    above, below = closed[high], closed[low]
    none = above[:, right] - above[:, left] == below[:, right] - below[:, left]
    return _cropped(rows, columns, none)


def _cropped(y: NDArray[Any], x: NDArray[Any], cells: NDArray[np.bool_]) -> OpenArea:
    """Leave out what lies beyond the box of the open cells."""
    rows, columns = (np.flatnonzero(cells.any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        return OpenArea(y[:0], x[:0], cells[:0, :0].copy())
    (low, high), (left, right) = ((int(at[0]), int(at[-1]) + 1) for at in (rows, columns))
    return OpenArea(y[low : high + 1].copy(), x[left : right + 1].copy(), cells[low:high, left:right].copy())
