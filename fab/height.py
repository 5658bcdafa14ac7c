"""HeightMap: the relief that a user brings, and the reader of its file.

A bare array (.npy) of floats is metres, ``[y, x]``, row 0 at the lowest y. A picture (.png, .tif) is stored from the
top row down, as pictures are, so it is turned: up in the picture is +y. Numbers that are not metres need a scale, the
metres that one count stands for: a 16-bit picture whose full scale 65535 means 1.2 um has the scale 1.2e-6 / 65535.
"""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fab.aperture import Aperture, MaskAperture, aperture_from
from fab.aperture.picture import MASK_FILES, read_mask
from fab.errors import InputError
from fab.files import path_of, read_npy
from fab.grid import Grid
from fab.pictures import TIFF_FILES, read_pixels
from fab.units import format_length, metres, require_kind

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

log = logging.getLogger("doedesign")

_PICTURES = (".png", *TIFF_FILES)


@dataclass(frozen=True, eq=False)
class HeightMap:
    """A relief on its raster.

    Attributes:
        height_m: heights above the deepest floor, metres, ``[y, x]``, float32 or float64, none negative; lists become
            an array.
        grid: the raster.
        aperture: outline of the relief (`fab.aperture`); a number is the diameter of a round one, metres.

    Raises:
        InputError: an argument of another kind, the shape is not the grid's, or a height is NaN, infinite or negative.
    """

    height_m: NDArray[np.floating]
    grid: Grid
    aperture: Aperture | float

    def __post_init__(self) -> None:
        require_kind("grid", self.grid, Grid, "Give a fab.Grid(shape, pitch_m).")
        require_filled(self.height_m, "height map")
        object.__setattr__(self, "height_m", as_array(self.height_m, "height map"))
        if self.height_m.shape != self.grid.shape:
            got = f"{self.height_m.shape} on {self.grid.shape}"
            raise InputError("height map", "must have the grid's shape", got, "Use its own grid.")
        relief = aperture_from(self.aperture)
        if not all(0 < side < float("inf") for side in relief.extent_m):
            raise InputError("aperture", "must be positive and finite", str(relief), "Give the diameter.")
        object.__setattr__(self, "aperture", relief)
        require_heights(self.height_m, "height map")

    @property
    def relief(self) -> Aperture:
        """The outline of the relief."""
        return aperture_from(self.aperture)

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw the map as a whole and cell by cell, and the share of area at every height (`fab.plots.height`)."""
        from fab.plots.height import plot_height

        return plot_height(self, ax=ax)

    def _repr_html_(self) -> str:
        from fab.figure import aperture_text, html_of, length_text

        ny, nx = self.grid.shape
        rows = {
            "pixels": f"{ny} × {nx} of {length_text(self.grid.pitch_m)}",
            "heights": f"{length_text(float(self.height_m.min()))} to {length_text(float(self.height_m.max()))}",
            "relief": aperture_text(self.relief),
        }
        return html_of("height map", rows, self.plot())


def refuse_where(height_m: NDArray[np.floating], wrong: NDArray[np.bool_], where: str, rule: str, cure: str) -> None:
    """Raise InputError, with how many and where the first is, if any pixel of `wrong` ``[y, x]`` breaks a rule."""
    count = int(np.count_nonzero(wrong))
    if count:
        row, column = (int(i) for i in np.unravel_index(int(np.argmax(wrong)), wrong.shape))
        value = float(height_m[row, column])
        shown = format_length(value) if np.isfinite(value) else str(value)
        pixels = "1 wrong pixel" if count == 1 else f"{count} wrong pixels"
        raise InputError(where, rule, f"{pixels}, the first at row {row}, column {column} ({shown})", cure)


def require_filled(values: NDArray[Any], where: str) -> None:
    """Raise InputError for an array of numpy.ma with masked values: what lies below them is not meant to be used."""
    if np.ma.is_masked(values):
        got = f"{np.ma.count_masked(values)} masked values"
        raise InputError(where, "every pixel must have a value", got, "Fill them, as array.filled(0) does.")


def as_array(values: Any, where: str) -> NDArray[Any]:
    """Return an array, or lists of numbers as one; an `InputError` for lists that are no array."""
    try:
        return np.asarray(values)
    except ValueError as error:
        raise InputError(where, "must be an array [y, x]", "rows of different lengths", "Fill them.") from error


def require_heights(height_m: NDArray[Any], where: str) -> None:
    """Check that an array can be a height map: two-dimensional, filled, float32 or float64, finite and not negative."""
    require_filled(height_m, where)
    if height_m.ndim != 2 or height_m.size == 0 or height_m.dtype not in (np.float32, np.float64):
        got = f"{height_m.dtype} of shape {height_m.shape}"
        rule = "must be a filled two-dimensional array of float32 or float64"
        raise InputError(where, rule, got, "Give metres, [y, x].")
    rule = "every height must be a finite number"
    refuse_where(height_m, ~np.isfinite(height_m), where, rule, "Fill the holes of the map.")
    cure = "Add a constant so that the deepest floor is at 0."
    refuse_where(height_m, height_m < 0, where, "no height may be negative", cure)


def _load(path: Path) -> NDArray[Any]:
    suffix = path.suffix.lower()
    if suffix != ".npy" and suffix not in _PICTURES:
        kinds = ", ".join(sorted((".npy", *_PICTURES)))
        raise InputError(str(path), f"the file must be one of {kinds}", path.suffix or "no suffix", "Convert it first.")
    values = read_npy(path) if suffix == ".npy" else read_pixels(path)
    if values.ndim != 2:
        rule = "a height map must have two axes, and no colours"
        raise InputError(str(path), rule, f"shape {values.shape}", "Give one plane of heights, [y, x].")
    return values


def read_height(
    path: str | Path,
    pitch: float | str | None = None,
    scale: float | str | None = None,
    aperture: Aperture | float | str | None = None,
) -> HeightMap:
    """Read a height map that a user brings; lengths are metres, or text with a unit such as ``"1.85 um"``.

    Args:
        path: ``.npy``, ``.tif``, ``.tiff`` or ``.png``.
        pitch: edge of a pixel. None of these files holds it, so it must be given.
        scale: length that one count of the file stands for. Floats are metres if it is left out; integers need it.
        aperture: diameter of the relief, its outline (`fab.aperture`), or the name of a picture of it
            (`fab.aperture.picture`); the shorter side of the map if left out.

    Returns:
        The height map, float32 if the file holds float32 or float16, otherwise float64.

    Raises:
        InputError: the file is missing, damaged, of another kind or too large, its numbers are no heights
            (`HeightMap`), or pitch or scale is missing.
    """
    path = path_of(path)
    if pitch is None:
        raise InputError(str(path), "the pixel pitch must be given", "none", "Give the pitch of a pixel.")
    values = _load(path)
    if values.dtype.kind not in "fiu":
        raise InputError(str(path), "heights must be real numbers", values.dtype, "Save floats in metres.")
    if scale is None and values.dtype.kind != "f":
        rule = "integers need a scale, the metres that one count stands for"
        raise InputError(str(path), rule, f"{values.dtype} and no scale", "Give the scale.")
    narrow = values.dtype.kind == "f" and values.dtype.itemsize <= 4
    height_m = np.ascontiguousarray(values, dtype=np.float32 if narrow else np.float64)
    if scale is not None:
        scale_m = metres(scale, "scale")
        if scale_m <= 0:
            raise InputError(str(path), "the scale must be positive and finite", scale, "Give metres per count.")
        height_m *= scale_m
    require_heights(height_m, str(path))
    grid = Grid((height_m.shape[0], height_m.shape[1]), metres(pitch, "pitch"))
    return HeightMap(height_m, grid, outline_of(height_m, grid, aperture, str(path)))


def outline_of(height_m: NDArray[Any], grid: Grid, aperture: Aperture | float | str | None, where: str) -> Aperture:
    """Return the outline of a relief, or the largest circle on the map where none is given, and say what that cuts off.

    Args:
        height_m: heights ``[y, x]``.
        grid: their raster.
        aperture: see `read_height`.
        where: the map's name, for the message.
    """
    if aperture is not None:
        return outline_on(grid, aperture)
    found = aperture_from(min(grid.extent_m))
    beyond = ~found.inside(grid)
    if beyond.any() and np.ptp(height_m[beyond]):
        said = (
            "%s: no aperture was given, so %.2g %% of it, beyond a circle of %s, stay blank glass; give another if not"
        )
        log.warning(said, where, 100 * beyond.mean(), format_length(min(grid.extent_m)))
    return found


def outline_on(grid: Grid, aperture: Aperture | float | str) -> Aperture:
    """Return the outline of a relief on a grid: itself, a diameter, or of a picture by its name (`read_height`)."""
    if isinstance(aperture, str) and aperture.lower().endswith(MASK_FILES):
        return MaskAperture.of(read_mask(aperture, grid.shape), grid.pitch_m)
    return aperture if isinstance(aperture, Aperture) else aperture_from(metres(aperture, "aperture"))
