"""The proof of solids and height maps: every file is read back and compared with the level map.

A STEP file must hold the stated parts, each with its volume and its centre of mass; a mesh the stated volume, and above
every column of the map a top of the right height and area; a picture, an array or a grid sag every single height.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fab.errors import CheckFailed, InputError
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.manifest.records import ModelEntry
from fab.solids.columns import Columns, Window, reduced_cells, whole, window_cells
from fab.solids.mesh import Mesh
from fab.solids.meshfile import read_mesh
from fab.solids.step import step_bodies
from fab.solids.write import MESH_CELLS
from fab.units import MM, format_length

__all__ = ["model_problems"]

_SINGLE = 2.0**-23


def model_problems(folder: Path, entry: ModelEntry, level_map: LevelMap) -> list[str]:
    """Read a model back and compare it with what the manifest says of it and with the level map.

    Args:
        folder: the order.
        entry: the model; its bytes are known to be those of the manifest.
        level_map: the DOE of the order.

    Returns:
        One sentence per difference.
    """
    path, window = folder / entry.file, _window(entry)
    try:
        if path.suffix == ".step":
            return _step_problems(path, entry)
        if entry.volumes_mm3:
            return _mesh_problems(path, entry, _cells(level_map, window))
        return _height_problems(path, entry, level_map, window)
    except (InputError, CheckFailed) as error:
        return [str(error)]


def _window(entry: ModelEntry) -> Window | None:
    if entry.window_px is None:
        return None
    row, column, rows, columns = entry.window_px
    return Window(row, column, rows, columns)


def _step_problems(path: Path, entry: ModelEntry) -> list[str]:
    found = step_bodies(path)
    problems = _volume_problems(entry, {name: body.volume_m3 / MM**3 for name, body in found.items()})
    for name in sorted(entry.centres_mm.keys() & found.keys()):
        here, wanted = np.array(found[name].centre_m) / MM, np.array(entry.centres_mm[name])
        off = float(np.abs(here - wanted).max()) * MM
        # Of a whole plate the kernel loses as many digits as its size has over a tenth of a nanometre.
        if not off <= 0.1e-9:
            problems.append(f"{name}: its centre of mass lies {format_length(off)} aside")
    return problems


def _volume_problems(entry: ModelEntry, found_mm3: dict[str, float]) -> list[str]:
    problems = []
    for name in sorted(entry.volumes_mm3.keys() | found_mm3.keys()):
        found, wanted = found_mm3.get(name, 0.0), entry.volumes_mm3.get(name, 0.0)
        if not abs(found - wanted) <= entry.relative_error * wanted:
            problems.append(f"{name}: {found:.12g} mm3 instead of {wanted:.12g} mm3")
    return problems


def _cells(level_map: LevelMap, window: Window | None) -> Columns:
    return reduced_cells(level_map, MESH_CELLS) if window is None else window_cells(level_map, window)


def _mesh_problems(path: Path, entry: ModelEntry, cells: Columns) -> list[str]:
    mesh = read_mesh(path, "mm" if path.suffix == ".stl" else None)
    return _volume_problems(entry, {"RELIEF": mesh.volume_m3 / MM**3}) + _top_problems(mesh, cells)


def _top_problems(mesh: Mesh, cells: Columns) -> list[str]:
    """Look at what faces up: it must cover every column once, at the height of that column."""
    a, b, c = (mesh.vertices_m[mesh.triangles[:, corner]] for corner in range(3))
    along, across = b - a, c - a
    areas = (along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]) / 2
    widths, depths = np.diff(cells.x_edges_m), np.diff(cells.y_edges_m)
    # The top of a column is two triangles, and walls stand upright but for the rounding of their corners.
    up = areas > 0.1 * widths.min() * depths.min()
    middles = (a[up] + b[up] + c[up]) / 3
    shape = cells.height_m.shape
    column = np.searchsorted(cells.x_edges_m, middles[:, 0], side="right") - 1
    row = np.searchsorted(cells.y_edges_m, middles[:, 1], side="right") - 1
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    place = np.where(inside, row * shape[1] + column, 0)
    tops = np.stack([a[up, 2], b[up, 2], c[up, 2]], axis=1) - (cells.height_m - cells.blank_m).ravel()[place][:, None]
    far = float(max(np.abs(cells.x_edges_m).max(), np.abs(cells.y_edges_m).max()))
    # Numbers in the files are rounded to single precision or to a picometre.
    level = np.abs(tops).max(axis=1) <= _SINGLE * max(1e-6, cells.blank_m) + 2e-12
    sound = np.bincount(place, weights=areas[up] * (inside & level), minlength=cells.height_m.size).reshape(shape)
    rounding = 4 * (1e-12 + _SINGLE * far) / min(widths.min(), depths.min())
    wrong = np.abs(sound / (depths[:, None] * widths) - 1) > rounding
    problems = []
    if wrong.any():
        count, (row, column) = np.count_nonzero(wrong), np.unravel_index(int(np.argmax(wrong)), shape)
        problems.append(
            f"{count} columns have no top of the height of the level map, the first at row {row}, column {column}"
        )
    stray = int(np.count_nonzero(~inside))
    return problems + ([f"{stray} triangles face up outside the map"] if stray else [])


def _height_problems(path: Path, entry: ModelEntry, level_map: LevelMap, window: Window | None) -> list[str]:
    levels, grid = level_map.levels, level_map.grid
    try:
        found = _HEIGHTS[path.suffix](path, entry.metres_per_count or 1.0)
    # Each library raises what it likes on a damaged file.
    except Exception as error:
        return [f"it cannot be read: {error}"]
    wanted = levels.heights_m()[(window or whole(grid)).cut(level_map.level)]
    problems = []
    if path.suffix == ".DAT":
        wanted = wanted - levels.total_m
        problems = _header_problems(path, grid, window or whole(grid))
    if found.shape != wanted.shape:
        return [*problems, f"{found.shape} heights instead of {wanted.shape}"]
    # Grey values are rounded to half a count; text and floating point to far less.
    most = 0.5001 * (entry.metres_per_count or 0.0) if path.suffix in (".png", ".tif") else 1e-12
    wrong = int(np.count_nonzero(np.abs(found - wanted) > most))
    return [*problems, f"{wrong} heights differ from the level map"] if wrong else problems


def _header_problems(path: Path, grid: Grid, window: Window) -> list[str]:
    """Compare the unit, the pitch and the place of a grid sag."""
    with open(path) as lines:
        *_, pitch_x, pitch_y, unit, x, y = lines.readline().split()
    found = [float(pitch_x), float(pitch_y), float(x), float(y)]
    wanted = [value / MM for value in (grid.pitch_m, grid.pitch_m, *window.centre_m(grid))]
    if unit != "0" or not np.allclose(found, wanted, rtol=1e-9, atol=1e-9):
        return [f"pitch and place {found} in unit {unit} instead of {wanted} in unit 0 (millimetres)"]
    return []


def _from_tiff(path: Path, per_count: float) -> NDArray[np.float64]:
    import tifffile

    return tifffile.imread(path)[::-1] * per_count


def _from_png(path: Path, per_count: float) -> NDArray[np.float64]:
    from PIL import Image

    with Image.open(path) as picture:
        return np.asarray(picture)[::-1] * per_count


def _from_npy(path: Path, _: float) -> NDArray[np.float64]:
    return np.load(path, allow_pickle=False)


def _from_sag(path: Path, per_count: float) -> NDArray[np.float64]:
    with open(path) as lines:
        columns, rows = (int(word) for word in lines.readline().split()[:2])
        sag = np.loadtxt(lines, usecols=0)
    # The first point is at the lowest x and the highest y.
    return sag.reshape(rows, columns)[::-1] * per_count


_HEIGHTS: dict[str, Callable[[Path, float], Any]] = {
    ".tif": _from_tiff,
    ".png": _from_png,
    ".npy": _from_npy,
    ".DAT": _from_sag,
}
