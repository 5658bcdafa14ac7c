"""LevelMap: the state of a quantised DOE. Everything else, heights and masks alike, is derived from it.

A level map says for every pixel of a grid which level of a staircase it has. Outside the relief, where chrome
covers the plate, it holds the top level, blank glass: that is seen to here, once, when a map is made. A file of one
(`write_level_map`) keeps the bit planes of the level numbers, packed eight pixels to a byte, and loses nothing.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fab.aperture import Aperture, MaskAperture, RectangularAperture, RoundAperture, aperture_from, diameter_of
from fab.archive import read_archive, write_archive
from fab.errors import InputError
from fab.files import path_of, sha256_bytes
from fab.grid import Grid
from fab.height import HeightMap, as_array, require_filled
from fab.levels import Levels, height_of, level_map_from_planes, planes, quantise, quantise_wrapped, require_levels
from fab.units import format_length, require_kind

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

FORMAT = "doedesign level map 1"


@dataclass(frozen=True, eq=False)
class LevelMap:
    """Level numbers of every pixel of a DOE.

    Two maps are equal only if they are the same object, so that a map may be the key of a cache; compare `digest`.

    Attributes:
        level: ``[y, x]`` uint8 level numbers, row 0 at the lowest y; blank glass (the top level) outside the aperture,
            whatever was given there. Read-only.
        levels: the staircase.
        grid: the raster.
        aperture: outline of the relief (`fab.aperture`); a number is the diameter of a round one, metres, infinite
            where all of the raster is relief, as in a piece that was cut out of a DOE.
        name: the owner's name for it.

    Raises:
        InputError: an argument of another kind, the array is no level map of the staircase, its shape is not the
            grid's, or the aperture does not fit the raster.
    """

    level: NDArray[np.uint8]
    levels: Levels
    grid: Grid
    aperture: Aperture | float
    name: str = "doe"

    def __post_init__(self) -> None:
        require_kind("levels", self.levels, Levels, "Give a fab.Levels(count, step_m).")
        require_kind("grid", self.grid, Grid, "Give a fab.Grid(shape, pitch_m).")
        require_filled(self.level, "level map")
        checked = require_levels(as_array(self.level, "level map"), self.levels)
        if checked.shape != self.grid.shape:
            rule = f"must have the grid's shape {self.grid.shape}"
            raise InputError("level map", rule, checked.shape, "Use its own grid.")
        relief = aperture_from(self.aperture)
        if isinstance(relief, MaskAperture) and (relief.shape, relief.pitch_m) != (self.grid.shape, self.grid.pitch_m):
            rule = f"a mask must have the raster's {self.grid.shape} pixels of {format_length(self.grid.pitch_m)}"
            got = f"{relief.shape} of {format_length(relief.pitch_m)}"
            raise InputError("aperture", rule, got, "Give a mask of the same raster.")
        sides = zip(relief.extent_m, self.grid.extent_m, strict=True)
        if not all(0 < side <= most * (1 + 1e-9) for side, most in sides) and relief.narrowest_m != math.inf:
            rule = f"must lie from 0 to the shorter side of the raster, {format_length(min(self.grid.extent_m))}"
            if not isinstance(relief, RoundAperture):
                rule = f"must lie on the raster, {RectangularAperture(self.grid.extent_m)}"
            raise InputError("aperture", rule, str(relief), "Give the diameter of the relief, or its width and height.")
        blank = np.where(relief.inside(self.grid), checked, np.uint8(self.levels.count - 1))
        blank.setflags(write=False)
        object.__setattr__(self, "aperture", relief)
        object.__setattr__(self, "level", blank)

    @classmethod
    def from_height(cls, height: HeightMap, levels: Levels, name: str = "doe", *, wrapped: bool = False) -> "LevelMap":
        """Give every pixel of a height map the nearest level; if `wrapped`, heights repeat after one wave.

        Raises:
            InputError: something other than a height map or levels, a height above the staircase that is not to be
                wrapped, or the aperture does not fit.
        """
        require_kind("height", height, HeightMap, "Give a fab.HeightMap(height_m, grid, aperture).")
        require_kind("levels", levels, Levels, "Give a fab.Levels(count, step_m).")
        level = (quantise_wrapped if wrapped else quantise)(height.height_m, levels)
        return cls(level, levels, height.grid, height.relief, name)

    @property
    def relief(self) -> Aperture:
        """The outline of the relief."""
        return aperture_from(self.aperture)

    @property
    def aperture_m(self) -> float:
        """Diameter of a round relief, metres; an InputError for another."""
        return diameter_of(self.relief)

    @property
    def shape(self) -> tuple[int, int]:
        """Pixels ``(ny, nx)``."""
        return self.grid.shape

    @cached_property
    def height_m(self) -> NDArray[np.float32]:
        """``[y, x]`` height above the deepest floor, metres; blank glass outside the aperture. Read-only."""
        height = height_of(self.level, self.levels).astype(np.float32)
        height.setflags(write=False)
        return height

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the level numbers, row by row."""
        return level_digest(self.level)

    def planes(self) -> NDArray[np.uint8]:
        """Etch masks ``[bit, y, x]``: 1 where mask `bit` is open (`fab.levels.planes`)."""
        return planes(self.level, self.levels)

    def with_level(self, level: NDArray[np.integer]) -> "LevelMap":
        """The same DOE with other level numbers ``[y, x]``."""
        return replace(self, level=level)

    @property
    def shown_relief(self) -> Aperture:
        """The outline of the relief as pictures draw it: beyond the raster where all of it is relief."""
        whole = RoundAperture(math.hypot(*self.grid.extent_m))
        return whole if self.relief.widest_m == math.inf else self.relief

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw heights as a whole and cell by cell, and the share of area at every level (`fab.plots.height`)."""
        from fab.plots.height import plot_height

        return plot_height(HeightMap(self.height_m, self.grid, self.shown_relief), self.levels, self.name, ax)

    def _repr_html_(self) -> str:
        from fab.figure import aperture_text, html_of, length_text

        ny, nx = self.shape
        rows = {
            "pixels": f"{ny} × {nx} of {length_text(self.grid.pitch_m)}",
            "levels": str(self.levels),
            "relief": aperture_text(self.relief),
            "SHA-256": self.digest[:12],
        }
        return html_of(self.name, rows, self.plot())

    def __str__(self) -> str:
        """Return "quick: 320 x 320 pixels of 1.85 um in 16 levels of 75 nm"."""
        ny, nx = self.shape
        return f"{self.name}: {ny} x {nx} pixels of {format_length(self.grid.pitch_m)} in {self.levels}"


def level_digest(level: NDArray[np.uint8]) -> str:
    """Return the SHA-256 of level numbers ``[y, x]``, row by row."""
    return sha256_bytes(np.ascontiguousarray(level).data)


def write_level_map(path: str | Path, level_map: LevelMap) -> None:
    """Write a level map without loss to `path`; the same `level_map` gives the same bytes. Lengths in it are metres."""
    path = path_of(path)
    require_kind("level_map", level_map, LevelMap, "A design has one: design.level_map.")
    levels, grid = level_map.levels, level_map.grid
    header = {
        "format": FORMAT,
        "name": level_map.name,
        "shape": list(grid.shape),
        "pitch_m": grid.pitch_m,
        "aperture_m": None if level_map.relief.widest_m == math.inf else level_map.relief.record(),
        "levels": levels.count,
        "level_step_m": levels.step_m,
        "etch_depths_m": list(levels.depths_m),
        "units": "SI; planes[k] is 1 where mask k is open, eight pixels to a byte along x, row 0 at the lowest y",
    }
    write_archive(path, header, {"planes": np.packbits(level_map.planes(), axis=-1)})


def read_level_map(path: str | Path) -> LevelMap:
    """Read what `write_level_map` wrote to `path`.

    Raises:
        InputError: the file is missing, damaged, changed since it was written, or no level map.
    """
    path = path_of(path)
    cure = "Write it again from its run."
    header, arrays = read_archive(path, "level map", cure)
    try:
        if header["format"] != FORMAT:
            raise InputError(str(path), f'must say format "{FORMAT}"', repr(header["format"]), cure)
        ny, nx = (int(n) for n in header["shape"])
        depths_m = tuple(float(depth) for depth in header["etch_depths_m"])
        levels = Levels(int(header["levels"]), float(header["level_step_m"]), depths_m)
        grid = Grid((ny, nx), float(header["pitch_m"]))
        packed = arrays["planes"]
        if packed.shape != (levels.bits, ny, -(-nx // 8)):  # before memory is asked for by the header alone
            raise InputError(str(path), f"must hold {levels.bits} planes of {ny} x {nx}", packed.shape, cure)
        bits = np.unpackbits(packed, axis=-1, count=nx)
        level = level_map_from_planes(bits, levels)
        aperture = math.inf if header["aperture_m"] is None else header["aperture_m"]
        relief = aperture_from(aperture, where=f"{path}: aperture_m", shape=grid.shape)
        return LevelMap(level, levels, grid, relief, str(header["name"]))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        if not isinstance(error, InputError):
            rule = "must be a level map"
            raise InputError(str(path), rule, f"{type(error).__name__}: {error}", cure) from error
        if error.where.startswith(str(path)):
            raise
        raise InputError(f"{path}: {error.where}", error.rule, error.got, cure) from error
