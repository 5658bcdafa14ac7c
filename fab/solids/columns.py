"""Columns: the part of a map that a solid, a mesh or an optics program gets, because none of them takes all of it.

CAD programs, viewers and slicers choke on tens of millions of faces, so a map is either cut to a window at full
resolution or reduced: blocks of pixels become one column of their mean height, which keeps the volume.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fab.errors import InputError
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels

# Glass below the deepest floor of a mesh or a patch.
BASE_M = 10e-6
_MOST_CELLS = 4_000_000
# Heights that differ by less than this part of the relief are one height that was rounded differently.
_CLOSEST = 1e-9


@dataclass(frozen=True)
class PixelWindow:
    """A rectangle of pixels of a grid: its first row and column (0 at the lowest y and x), and how many of each."""

    row: int
    column: int
    rows: int
    columns: int

    def require(self, grid: Grid) -> None:
        """Check that the window is filled and lies on a grid."""
        ny, nx = grid.shape
        inside = 0 <= self.row < self.row + self.rows <= ny and 0 <= self.column < self.column + self.columns <= nx
        if not inside:
            got = f"{self.rows} x {self.columns} pixels from row {self.row}, column {self.column}"
            rule = f"must be filled and lie on the {ny} x {nx} pixels of the map"
            raise InputError("window", rule, got, "Choose another window.")

    def cut(self, values: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the pixels of the window, ``[y, x]``, as a view."""
        return values[self.row : self.row + self.rows, self.column : self.column + self.columns]

    def edges_m(self, grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the pixel edges along x ``(columns + 1,)`` and y ``(rows + 1,)``, metres from the grid's centre."""
        ny, nx = grid.shape
        x = self.column + np.arange(self.columns + 1) - nx / 2
        y = self.row + np.arange(self.rows + 1) - ny / 2
        pitch_m = np.float64(grid.pitch_m)
        return x * pitch_m, y * pitch_m

    def centre_m(self, grid: Grid) -> tuple[float, float]:
        """Return x and y of the window's centre, metres from the grid's centre."""
        ny, nx = grid.shape
        x = (2 * self.column + self.columns - nx) / 2 * grid.pitch_m
        return x, (2 * self.row + self.rows - ny) / 2 * grid.pitch_m


def whole(grid: Grid) -> PixelWindow:
    """Return the window that covers a grid."""
    return PixelWindow(0, 0, *grid.shape)


@dataclass(frozen=True, eq=False)
class Columns:
    """A relief of columns on a rectangular raster, its edges increasing, ``(nx + 1,)`` and ``(ny + 1,)``.

    Heights ``[y, x]`` and that of the blank surface, where z = 0 lies, are above the deepest floor; all in metres. A
    column has `block` pixels along its side; 1 is full resolution.
    """

    height_m: NDArray[np.float64]
    x_edges_m: NDArray[np.float64]
    y_edges_m: NDArray[np.float64]
    blank_m: float
    block: int = 1

    @property
    def volume_m3(self) -> float:
        """Sum of the columns above the deepest floor, cubic metres."""
        rows = self.height_m @ np.diff(self.x_edges_m)
        return math.fsum(rows * np.diff(self.y_edges_m))

    @property
    def area_m2(self) -> float:
        """Area of the raster, square metres."""
        return float((self.x_edges_m[-1] - self.x_edges_m[0]) * (self.y_edges_m[-1] - self.y_edges_m[0]))


@njit(cache=True)
def _block_means(level_map, heights, block):  # pragma: no cover - compiled
    ny, nx = level_map.shape
    out = np.zeros((-(-ny // block), -(-nx // block)))
    for j in range(out.shape[0]):
        y_end = min(ny, (j + 1) * block)
        for y in range(j * block, y_end):
            for x in range(nx):
                out[j, x // block] += heights[level_map[y, x]]
        for i in range(out.shape[1]):
            out[j, i] /= (y_end - j * block) * (min(nx, (i + 1) * block) - i * block)
    return out


def _joined(values: NDArray[np.float64], closest: float) -> NDArray[np.float64]:
    """Make values equal that only the order of a sum sets apart, so that no wall is lower than any number can say."""
    different, where = np.unique(values, return_inverse=True)
    apart = np.diff(different, prepend=-np.inf) > closest
    return different[apart][np.cumsum(apart) - 1][where].reshape(values.shape)


def _heights_m(levels: Levels) -> NDArray[np.float64]:
    """Return the heights of the levels; levels that different etches bring to one height have the same number."""
    heights = levels.heights_m()
    return _joined(heights, _CLOSEST * float(heights.max()))


def window_cells(level_map: LevelMap, window: PixelWindow) -> Columns:
    """Take a window of at most 4 million pixels at full resolution: one column per pixel, where it lies on the DOE."""
    window.require(level_map.grid)
    if window.rows * window.columns > _MOST_CELLS:
        rule = f"a mesh may have at most {_MOST_CELLS} columns"
        got = f"{window.rows} x {window.columns}"
        raise InputError("window", rule, got, "Choose a smaller window or a reduced map.")
    heights = _heights_m(level_map.levels)
    return Columns(heights[window.cut(level_map.level)], *window.edges_m(level_map.grid), float(heights.max()))


def reduced_cells(level_map: LevelMap, most: int = 1000) -> Columns:
    """Reduce a map to columns of the mean height of square blocks of pixels; the volume stays.

    The block is the smallest that leaves at most `most` columns along the longer side; at the high end of an axis
    blocks are cut. A mean across a jump of one wave stands between its two sides: fit for looking and weighing, not for
    optics.
    """
    grid = level_map.grid
    if not 1 <= most <= math.isqrt(_MOST_CELLS):
        rule = f"the columns along a side must be 1 to {math.isqrt(_MOST_CELLS)}"
        raise InputError("mesh", rule, most, "Choose another number of columns.")
    block = -(-max(grid.shape) // most)
    heights = _heights_m(level_map.levels)
    x_m, y_m = whole(grid).edges_m(grid)
    x, y = (np.append(edges[:-1:block], edges[-1]) for edges in (x_m, y_m))
    means = _joined(_block_means(level_map.level, heights, block), _CLOSEST * float(heights.max()))
    return Columns(means, x, y, float(heights.max()), block)
