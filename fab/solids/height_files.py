"""The relief in the files of other tools: pictures, arrays, and the sag of an optics program.

Pictures (.tif, .png) are stored from the top row down, so what is up in the picture is +y. Arrays (.npy) are metres,
``[y, x]``, row 0 at the lowest y. Every file comes from a level map, so that a height is one of the levels and never a
rounded neighbour of it. In an order every single height of each is read back.

The grid sag of Zemax OpticStudio is the text that its manual describes: one line ``nx ny delx dely unitflag xdec ydec``
(unit flag 0: millimetres), then one line ``z dz/dx dz/dy d2z/dxdy nodata`` per point, from the corner at -x, +y along x
and then down row by row. Points are pixel centres. The derivatives are left 0; choose linear interpolation there, which
does not use them, and know that it turns a vertical wall into a slope one pixel wide. A grid phase has the same form,
with radians in the place of z; its unit flag is that of pitch and decentre alone.

Its axes are right-handed with light toward +z: whoever looks along the light with +y up has +x on the left. A map is
seen from the etched side. So x and y are those of the map where light leaves through the relief ("exit"); where it
enters there ("entry"), as everywhere else in this package, the map is mirrored, x to -x.
"""

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.files import path_of, read_npy, write_atomic
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.manifest.records import ModelEntry
from fab.pictures import read_pixels, write_pixels
from fab.solids.columns import PixelWindow, whole
from fab.solids.model import DoeModel, ModelKind, model_entry
from fab.units import MM, format_length

# OpticStudio's manual asks for this many points along either axis.
_FEWEST_ZEMAX = 5
_SAG_CELLS = 500
_ROWS = 256
Side = Literal["exit", "entry"]  # by which light leaves or enters

_Read = Callable[[Path], NDArray[Any]]


def _description(level_map: LevelMap, metres_per_count: float, counts: NDArray[np.int64]) -> str:
    levels = level_map.levels
    rounding_m = float(np.abs(counts * metres_per_count - levels.heights_m()).max())
    close = "exact" if rounding_m < 1e-15 else f"rounded by at most {rounding_m:.2e} m"
    return (
        f"Height above the deepest etched floor = count x {metres_per_count!r} m ({close}). "
        f"{levels.count} levels; the highest is the blank surface. "
        f"Square pixels of {format_length(level_map.grid.pitch_m)}. The first row is the one at the highest y, "
        "the first column the one at the lowest x; seen from the side of the relief."
    )


def _full_scale(levels: Levels, top: int) -> tuple[NDArray[np.int64], float]:
    """Return the count of every level and the metres per count if the highest level is `top`."""
    heights = levels.heights_m()
    scale = float(heights.max()) / top
    return np.rint(heights / scale).astype(np.int64), scale


def _exact_scale(levels: Levels) -> tuple[NDArray[np.int64], float]:
    """Return 16-bit counts that are a whole number per step if the levels are even, else the nearest of full scale."""
    heights = levels.heights_m()
    step = float(heights.max()) / (levels.count - 1)
    per_step = 65535 // (levels.count - 1)
    counts = np.arange(levels.count) * per_step
    if np.allclose(heights, np.arange(levels.count) * step, rtol=0, atol=1e-9 * step):
        return counts, step / per_step
    return _full_scale(levels, 65535)


def write_tiff(path: str | Path, level_map: LevelMap) -> float:
    """Write the heights as a 16-bit grey TIFF, first row at the highest y; return the metres per count.

    Even levels are exact: a step is a whole number of counts (4369 for 16 levels). Others are rounded to the nearest of
    65535 counts. The description in the file says scale, rounding, pitch and orientation.
    """
    counts, scale_m = _exact_scale(level_map.levels)
    about = _description(level_map, scale_m, counts)
    write_pixels(path, counts.astype(np.uint16)[level_map.level], about=about, pitch_m=level_map.grid.pitch_m)
    return scale_m


def write_npy(path: str | Path, level_map: LevelMap) -> float:
    """Write the heights as a bare array: float32 metres (hence 1.0), ``[y, x]``, row 0 at the lowest y."""
    stream = io.BytesIO()
    np.save(stream, level_map.levels.heights_m().astype(np.float32)[level_map.level], allow_pickle=False)
    write_atomic(path, stream.getvalue())
    return 1.0


def write_greymap(path: str | Path, level_map: LevelMap, bits: Literal[8, 16] = 16) -> float:
    """Write a grey PNG for greyscale and two-photon writers, first row at the highest y; return the metres per count.

    Black is the deepest floor and white the blank surface; between them counts are linear in height, rounded, and exact
    for 2, 4, 6, 16, 18 and 52 even levels. The text chunk "Description" says so.
    """
    counts, scale_m = _full_scale(level_map.levels, 2**bits - 1)
    pixels = counts.astype(np.uint8 if bits == 8 else np.uint16)[level_map.level]
    write_pixels(path, pixels, about=_description(level_map, scale_m, counts))
    return scale_m


def _sag_lines(levels: Levels, side: Side = "exit") -> list[str]:
    """Return the line of a point of every level."""
    heights = levels.heights_m()
    sag_mm = (heights - heights.max()) / MM * (1 if side == "exit" else -1)
    lines = [f"{sag + 0.0:12.9f} 0 0 0 0\r\n" for sag in sag_mm]  # + 0.0: no minus before a zero
    if len({len(line) for line in lines}) != 1:  # pragma: no cover - a relief deeper than a centimetre
        deepest = format_length(heights.max())
        raise InputError("grid sag", "the relief must be less than 10 mm deep", deepest, "Check it.")
    return lines


def write_zemax_sag(
    path: str | Path, level_map: LevelMap, window: PixelWindow | None = None, side: Side = "exit"
) -> None:
    """Write the relief as a grid sag of Zemax OpticStudio (millimetres, file suffix .DAT).

    The blank surface is the vertex plane, sag 0. Light runs toward +z. On the exit side (glass before the surface) the
    sag is minus the etch depth; on the entry side it is plus the etch depth, and the map is mirrored in x. A point
    takes 22 bytes: a 4400 x 4400 map makes 426 MB, so choose a window (at least 5 pixels either way); the decentre in
    the header puts it where it is.
    """
    _write_grid(path_of(path), level_map, _sag_lines(level_map.levels, side), window, side)


def write_zemax_phase(
    path: str | Path,
    level_map: LevelMap,
    waves_per_metre: float,
    window: PixelWindow | None = None,
    side: Side = "entry",
) -> None:
    """Write the phase of the relief as a grid phase of Zemax OpticStudio (radians, file suffix .DAT).

    The deepest floor has phase 0, higher glass a positive one: it is positive where light is late, so that a lens that
    makes light converge falls toward its rim. It is not wrapped. Check the sign in the program's own plot of the
    surface's phase with a lens.

    Args:
        path: the file.
        level_map: the relief.
        waves_per_metre: of height, (n - 1) / wavelength for glass in air (`sim.Camera.waves_per_metre`).
        window: part of the map, at least 5 pixels either way; the decentre in the header puts it where it is.
        side: where the relief is: "entry" where it faces the light, which mirrors the map in x; "exit" where light
            leaves through it.
    """
    phase = 2 * np.pi * waves_per_metre * level_map.levels.heights_m()
    _write_grid(path_of(path), level_map, [f"{radians:14.9f} 0 0 0 0\r\n" for radians in phase], window, side)


def _write_grid(path: Path, level_map: LevelMap, lines: list[str], window: PixelWindow | None, side: Side) -> None:
    """Write a grid of OpticStudio from the line of a point of every level."""
    if side not in get_args(Side):
        rule = f"the relief must be on one of the faces {', '.join(get_args(Side))}"
        raise InputError("side", rule, repr(side), "Choose one of them.")
    if path.suffix.upper() != ".DAT":
        raise InputError(str(path), "OpticStudio reads grids from .DAT files", path.suffix, "Use .DAT.")
    grid = level_map.grid
    window = window or whole(grid)
    window.require(grid)
    if min(window.rows, window.columns) < _FEWEST_ZEMAX:
        rule = f"OpticStudio needs at least {_FEWEST_ZEMAX} points along either axis"
        raise InputError("grid", rule, f"{window.rows} x {window.columns}", "Choose a larger window.")
    table = np.frombuffer("".join(lines).encode(), dtype=np.uint8).reshape(len(lines), -1)
    x_mm, y_mm = (value / MM for value in window.centre_m(grid))
    pitch_mm = f"{grid.pitch_m / MM:.12g}"
    pixels = window.cut(level_map.level)[::-1]
    if side == "entry":
        pixels, x_mm = pixels[:, ::-1], -x_mm + 0.0  # + 0.0: no minus before a zero
    header = f"{window.columns} {window.rows} {pitch_mm} {pitch_mm} 0 {x_mm:.12g} {y_mm:.12g}\r\n"
    body = (table[pixels[start : start + _ROWS]].tobytes() for start in range(0, window.rows, _ROWS))
    write_atomic(path, b"".join([header.encode(), *body]))


def _window(level_map: LevelMap) -> PixelWindow | None:
    """Return the middle of the map, as far as a grid sag shows it; None if it has too few points."""
    (ny, nx), (rows, columns) = level_map.shape, (min(n, _SAG_CELLS) for n in level_map.shape)
    return (
        None
        if min(rows, columns) < _FEWEST_ZEMAX
        else PixelWindow((ny - rows) // 2, (nx - columns) // 2, rows, columns)
    )


def _sag_entry(path: Path, model: DoeModel) -> ModelEntry | None:
    window = _window(model.level_map)
    if window is None:
        return None
    about = f"sag from the blank surface, the middle {window.rows} x {window.columns} pixels, seen as an exit face"
    return model_entry(path, about, metres_per_count=MM, window=window)


def _write_sag(path: Path, model: DoeModel) -> None:
    write_zemax_sag(path, model.level_map, _window(model.level_map))


def _problems(
    path: Path, _: ModelEntry, model: DoeModel, read: _Read, counts: Callable[[Levels], tuple[NDArray[Any], float]]
) -> list[str]:
    """Compare every height with that of its level, exactly."""
    wanted = counts(model.level_map.levels)[0][model.level_map.level]
    try:
        found = read(path)
    # Each library raises what it likes on a damaged file.
    except Exception as error:
        return [f"it cannot be read: {error}"]
    if found.shape != wanted.shape:
        return [f"{found.shape} heights instead of {wanted.shape}"]
    wrong = int(np.count_nonzero(found != wanted))
    return [f"{wrong} heights differ from the level map"] if wrong else []


def _sag_problems(path: Path, _: ModelEntry, model: DoeModel) -> list[str]:
    """Compare the header and every point with all its derivatives."""
    level_map, window = model.level_map, _window(model.level_map)
    if window is None:
        return ["the map has too few pixels for it"]
    try:
        problems = _header_problems(path, level_map, window)
        found = _read_sag(path)
    except (ValueError, IndexError) as error:
        return [f"it cannot be read: {error}"]
    wanted = np.array([float(line.split()[0]) for line in _sag_lines(level_map.levels)])[window.cut(level_map.level)]
    if found.shape[:2] != wanted.shape:
        return [*problems, f"{found.shape[:2]} points instead of {wanted.shape}"]
    for what, wrong in (
        ("heights differ from the level map", found[..., 0] != wanted),
        ("points have slopes or no data", found[..., 1:].any(axis=2)),
    ):
        problems += [f"{int(np.count_nonzero(wrong))} {what}"] if wrong.any() else []
    return problems


def _header_problems(path: Path, level_map: LevelMap, window: PixelWindow) -> list[str]:
    """Compare the unit, the pitch and the place of a grid sag."""
    grid = level_map.grid
    with open(path) as lines:
        *_, pitch_x, pitch_y, unit, x, y = lines.readline().split()
    found = [float(pitch_x), float(pitch_y), float(x), float(y)]
    wanted = [value / MM for value in (grid.pitch_m, grid.pitch_m, *window.centre_m(grid))]
    if unit != "0" or not np.allclose(found, wanted, rtol=1e-9, atol=1e-9):
        return [f"pitch and place {found} in unit {unit} instead of {wanted} in unit 0 (millimetres)"]
    return []


def _read_sag(path: Path) -> NDArray[np.float64]:
    """Read the points ``[y, x, 5]``, row 0 at the lowest y: sag, three derivatives, and whether there are no data."""
    with open(path) as lines:
        columns, rows = (int(word) for word in lines.readline().split()[:2])
        points = np.loadtxt(lines, ndmin=2)
    # The first point is at the lowest x and the highest y.
    return points.reshape(rows, columns, 5)[::-1]


def _kind(
    ending: str,
    content: str,
    counts: Callable[[Levels], tuple[NDArray[Any], float]],
    write: Callable[[Path, LevelMap], object],
    read: _Read,
) -> ModelKind:
    """Return the kind of a file that holds every height; `counts` gives those of the levels, and metres per count."""
    return ModelKind(
        ending,
        lambda path, model: model_entry(path, content, metres_per_count=counts(model.level_map.levels)[1]),
        lambda path, model: write(path, model.level_map),
        partial(_problems, read=read, counts=counts),
    )


_read_large = partial(read_pixels, most_px=1 << 28)  # a regular DOE of a level map's size packs well
_FLOOR, _BLANK = "height above the deepest floor", "white is the blank surface"
_TOP_ROW = "first row at the highest y"
KINDS = (
    _kind("_HEIGHT.tif", f"{_FLOOR}, {_TOP_ROW}", _exact_scale, write_tiff, _read_large),
    _kind(
        "_HEIGHT.npy",
        f"{_FLOOR}, row 0 at the lowest y",
        lambda one: (one.heights_m().astype(np.float32), 1.0),
        write_npy,
        read_npy,
    ),
    _kind("_GREY.png", f"{_BLANK}, {_TOP_ROW}", partial(_full_scale, top=65535), write_greymap, _read_large),
    ModelKind("_SAG.DAT", _sag_entry, _write_sag, _sag_problems),
)
