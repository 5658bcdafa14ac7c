"""The solids and height maps of an order, for people and programs that read no masks.

    DOE_<ID>_PLATE.step     one die of glass with its chrome and the clear aperture in the datum plane
    DOE_<ID>_RELIEF.3mf     the relief as a closed mesh, block-reduced where it is large; also .glb and _MM.stl
    DOE_<ID>_HEIGHT.tif     heights in 16 bits; also .npy, in metres
    DOE_<ID>_GREY.png       the picture for greyscale and two-photon writers
    DOE_<ID>_SAG.DAT        grid sag for ray tracers: the middle of the relief

What each of them must measure is in the manifest, and `model_problems` reads every file back and compares.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fab.cells import Window, reduced_cells
from fab.errors import CheckFailed, InputError
from fab.grid import Grid
from fab.layout import Chrome
from fab.levels import Levels, height_of
from fab.manifest import Manifest, ModelEntry
from fab.mesh import closed_volume_m3, relief_mesh
from fab.meshfile import read_mesh, write_3mf, write_glb, write_stl
from fab.relief import write_greymap, write_npy, write_tiff, write_zemax_sag
from fab.solid import ChromeRing, Substrate, substrate_step, substrate_volumes_m3
from fab.step import step_volumes_m3
from fab.units import MM, format_length

__all__ = ["Relief", "model_problems", "write_models"]

_MESH_CELLS, _SAG_CELLS = 400, 500
_BASE_M = 10e-6
# What is left of a volume: double precision in STEP; picometres as text or single precision in meshes.
_STEP_OFF, _MESH_OFF = 1e-11, 1e-6


class Relief(NamedTuple):
    """What all models show.

    Attributes:
        level_map: level numbers ``[y, x]``, blank outside the clear aperture.
        levels: the staircase.
        grid: the raster.
        aperture_m: diameter of the clear aperture, metres.
        chrome: how the chrome is drawn.
        die_m: edge of the die, metres.
        thickness_m: thickness of the glass, metres.
    """

    level_map: NDArray[np.uint8]
    levels: Levels
    grid: Grid
    aperture_m: float
    chrome: Chrome
    die_m: float
    thickness_m: float


def _middle(grid: Grid) -> Window:
    rows, columns = (min(n, _SAG_CELLS) for n in grid.shape)
    return Window((grid.shape[0] - rows) // 2, (grid.shape[1] - columns) // 2, rows, columns)


def write_models(folder: Path, stem: str, relief: Relief) -> list[ModelEntry]:
    """Write all models of a relief.

    Args:
        folder: an order in the making.
        stem: what the names begin with.
        relief: what they show.

    Returns:
        one entry per file; a file that a small map cannot have (grid sag of fewer than 5 points) is left out.
    """
    level_map, levels, grid = relief.level_map, relief.levels, relief.grid
    glass = Substrate("die", relief.die_m, relief.thickness_m)
    chrome = ChromeRing(*relief.chrome.radii_m(grid, relief.aperture_m))
    step = f"{stem}_PLATE.step"
    substrate_step(folder / step, glass, relief.aperture_m, chrome)
    entries = [_solid(step, "millimetres; one die, relief plane at z = 0", substrate_volumes_m3(glass, chrome))]
    cells = reduced_cells(level_map, levels, grid, _MESH_CELLS)
    mesh = relief_mesh(cells, _BASE_M)
    closed_volume_m3(mesh)
    volume = {"RELIEF": cells.volume_m3 + cells.area_m2 * _BASE_M}
    about = f"relief on {format_length(_BASE_M)} of glass, mean height of {cells.block} x {cells.block} pixels"
    for name, unit, write, off in (
        (f"{stem}_RELIEF.3mf", "millimetres", write_3mf, _MESH_OFF),
        (f"{stem}_RELIEF.glb", "metres", write_glb, _MESH_OFF),
        (f"{stem}_RELIEF_MM.stl", "millimetres", write_stl, _MESH_OFF),
    ):
        write(folder / name, mesh)
        entries.append(_solid(name, f"{unit}; {about}", volume, off))
    tif, npy, grey, sag = (f"{stem}_{end}" for end in ("HEIGHT.tif", "HEIGHT.npy", "GREY.png", "SAG.DAT"))
    per_count = write_tiff(folder / tif, level_map, levels, grid)
    entries.append(ModelEntry(tif, "height above the deepest floor, first row at the highest y", {}, 0.0, per_count))
    write_npy(folder / npy, level_map, levels)
    entries.append(ModelEntry(npy, "height above the deepest floor, row 0 at the lowest y", {}, 0.0, 1.0))
    per_count = write_greymap(folder / grey, level_map, levels, grid)
    entries.append(ModelEntry(grey, "white is the blank surface, first row at the highest y", {}, 0.0, per_count))
    window = _middle(grid)
    if min(window.rows, window.columns) >= 5:
        write_zemax_sag(folder / sag, level_map, levels, grid, window)
        content = (
            f"sag from the blank surface, the middle {window.rows} x {window.columns} pixels, seen as an exit face"
        )
        entries.append(ModelEntry(sag, content, {}, 0.0, MM))
    return entries


def _solid(file: str, content: str, volumes_m3: dict[str, float], off: float = _STEP_OFF) -> ModelEntry:
    return ModelEntry(file, content, {name: v / MM**3 for name, v in volumes_m3.items()}, off, None)


def model_problems(folder: Path, entry: ModelEntry, manifest: Manifest, level_map: NDArray[np.uint8]) -> list[str]:
    """Read a model back and compare it with what the manifest says and with the level map.

    Args:
        folder: the order.
        entry: the model; its bytes are known to be those of the manifest.
        manifest: the manifest.
        level_map: the level map of the order.

    Returns:
        One sentence per difference.
    """
    path = folder / entry.file
    levels, grid = manifest.staircase(), manifest.grid()
    try:
        if entry.volumes_mm3:
            return _volume_problems(entry, _measured_m3(path))
        found = _HEIGHTS[path.suffix](path, entry.metres_per_count or 1.0)
    except (InputError, CheckFailed) as error:
        return [str(error)]
    wanted = height_of(level_map, levels)
    if path.suffix == ".DAT":
        wanted = height_of(_middle(grid).cut(level_map), levels) - (levels.count - 1) * levels.step_m
    if found.shape != wanted.shape:
        return [f"{found.shape} heights instead of {wanted.shape}"]
    # Grey values are rounded to half a count; text and floating point to far less.
    most = 0.5001 * (entry.metres_per_count or 0.0) if path.suffix in (".png", ".tif") else 1e-12
    wrong = int(np.count_nonzero(np.abs(found - wanted) > most))
    return [f"{wrong} heights differ from the level map"] if wrong else []


def _measured_m3(path: Path) -> dict[str, float]:
    if path.suffix == ".step":
        return step_volumes_m3(path)
    return {"RELIEF": read_mesh(path, "mm" if path.suffix == ".stl" else None).volume_m3}


def _volume_problems(entry: ModelEntry, found_m3: dict[str, float]) -> list[str]:
    problems = []
    for name in sorted(entry.volumes_mm3.keys() | found_m3.keys()):
        found, wanted = found_m3.get(name, 0.0) / MM**3, entry.volumes_mm3.get(name, 0.0)
        if not abs(found - wanted) <= entry.relative_error * wanted:
            problems.append(f"{name}: {found:.12g} mm3 instead of {wanted:.12g} mm3")
    return problems


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
