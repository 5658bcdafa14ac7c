"""A patch: a small square window of a relief that somebody asked for, at full resolution.

As STEP it is one box per rectangle of equal height, side by side and not united: uniting takes minutes at the size that
is allowed here. As a mesh it may be larger. CAD programs choke on more than a few thousand boxes and viewers on some
millions of triangles, so either has a cap.
"""

import math
from dataclasses import dataclass
from numbers import Real
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.grid import Grid
from fab.layout.polygons import rectangles
from fab.level_map import LevelMap
from fab.solids.columns import BASE_M, PixelWindow
from fab.solids.step import Body, boxes, write_step
from fab.units import format_length

_MOST_BOXES = 2000
_MOST_PIXELS = 1000


@dataclass(frozen=True)
class Patch:
    """A square window, in the coordinates of the DOE: the origin is the centre of the clear aperture, +y up.

    Attributes:
        x_m: its middle, metres.
        y_m: the same along y.
        width_m: its edge, metres; the nearest whole number of pixels is taken.
        step: whether it is wanted as STEP, too, and not only as a mesh.

    Raises:
        InputError: something other than a number of metres.
    """

    x_m: float
    y_m: float
    width_m: float
    step: bool = True

    def __post_init__(self) -> None:
        for name in ("x_m", "y_m", "width_m"):
            if not isinstance(value := getattr(self, name), Real):  # one beyond the map, or NaN, is told with its size
                raise InputError(f"patch: {name}", "must be a number of metres", repr(value), "For example 50e-6.")

    def window(self, grid: Grid) -> PixelWindow:
        """Return the pixels nearest to the patch, which must lie on the map."""
        (ny, nx), pitch_m = grid.shape, grid.pitch_m
        count = round(self.width_m / pitch_m) if abs(self.width_m) < math.inf else 0
        middles = (self.y_m, ny), (self.x_m, nx)
        row, column = (round(at / pitch_m + (n - count) / 2) if abs(at) < math.inf else -1 for at, n in middles)
        if not (count >= 1 and 0 <= row <= ny - count and 0 <= column <= nx - count):
            height, width = (format_length(extent) for extent in grid.extent_m)
            rule = f"must lie on the map, {width} x {height} about its middle"
            got = f"{format_length(self.width_m)} about {format_length(self.x_m)}, {format_length(self.y_m)}"
            raise InputError("patch", rule, got, 'Give its middle and its edge, such as "0 um, 100 um, 50 um".')
        return PixelWindow(row, column, count, count)

    def require(self, level_map: LevelMap) -> None:
        """Check that a mesh, and if wanted a STEP file, of the patch stay small enough to be opened."""
        window = self.window(level_map.grid)
        if window.rows > _MOST_PIXELS:
            rule = f"a mesh at full resolution may have at most {_MOST_PIXELS} x {_MOST_PIXELS} pixels"
            cure = f"Choose an edge of at most {format_length(_MOST_PIXELS * level_map.grid.pitch_m)}."
            raise InputError("patch", rule, f"{window.rows} x {window.columns}", cure)
        if self.step:
            _tops(level_map, window)


def _tops(level_map: LevelMap, window: PixelWindow) -> dict[int, NDArray[np.int32]]:
    """Return the rectangles of every level in a window, or refuse too many."""
    cut = window.cut(level_map.level)
    tops = {int(level): rectangles((cut == level).astype(np.uint8)) for level in np.unique(cut)}
    count = sum(len(found) for found in tops.values())
    if count > _MOST_BOXES:
        rule = f"a STEP patch may have at most {_MOST_BOXES} boxes (a file of about 7 kB each)"
        cure = "Choose a shorter edge, or take the mesh alone."
        raise InputError("patch", rule, f"{count} in {window.rows} x {window.columns} pixels", cure)
    return tops


def patch_body(level_map: LevelMap, window: PixelWindow) -> Body:
    """Return volume and centre of all the boxes that `patch_step` writes."""
    levels, grid = level_map.levels, level_map.grid
    heights_m = levels.heights_m()[window.cut(level_map.level)] + BASE_M
    x_m, y_m = ((edges[1:] + edges[:-1]) / 2 for edges in window.edges_m(grid))
    total = math.fsum(heights_m.ravel())
    bottom_m = -float(levels.heights_m().max()) - BASE_M
    centre_m = (
        math.fsum(heights_m.sum(axis=0) * x_m) / total,
        math.fsum(heights_m.sum(axis=1) * y_m) / total,
        bottom_m + math.fsum(np.square(heights_m).ravel()) / 2 / total,
    )
    return Body(total * grid.pitch_m**2, centre_m)


def patch_step(path: str | Path, level_map: LevelMap, window: PixelWindow) -> None:
    """Write a window of a map as STEP: part PATCH, boxes on `BASE_M` of glass, 7 kB of file each."""
    window.require(level_map.grid)
    tops = _tops(level_map, window)
    x_m, y_m = window.edges_m(level_map.grid)
    heights_m = level_map.levels.heights_m()
    z_m = heights_m - heights_m.max()
    bottom = float(z_m.min()) - BASE_M
    corners = (
        (float(x_m[x0]), float(y_m[y0]), bottom, float(x_m[x1]), float(y_m[y1]), float(z_m[level]))
        for level, found in tops.items()
        for x0, y0, x1, y1 in found
    )
    write_step(path, "DOE_PATCH", {"PATCH": boxes(corners)})
