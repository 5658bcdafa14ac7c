"""The solids and height maps of an order, for people and programs that read no masks.

    DOE_<ID>_PLATE.step     one die of glass with its chrome and the clear aperture in the datum plane; with its rings
                            as exact circles if the map is radial
    DOE_<ID>_WAFER.step     the wafer with the chrome and the clear aperture of every die
    DOE_<ID>_RELIEF.3mf     the relief as a closed mesh, block-reduced where it is large; also .glb and _MM.stl
    DOE_<ID>_PATCH.step     on request a window at full resolution, also as .3mf, .glb and _MM.stl
    DOE_<ID>_HEIGHT.tif     heights in 16 bits; also .npy, in metres
    DOE_<ID>_GREY.png       the picture for greyscale and two-photon writers
    DOE_<ID>_SAG.DAT        grid sag for ray tracers: the middle of the relief

What each of them must measure is in the manifest, and `fab.verification.models` reads every file back and compares.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fab.layout.geometry import Chrome
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.manifest.records import ModelEntry
from fab.solids.columns import Columns, Window, reduced_cells
from fab.solids.height_files import write_greymap, write_npy, write_tiff, write_zemax_sag
from fab.solids.mesh import closed_volume_m3, relief_mesh
from fab.solids.meshfile import write_3mf, write_glb, write_stl
from fab.solids.patch import Patch, patch_body, patch_step
from fab.solids.rings import pixel_share, ring_levels, rings_from_levels
from fab.solids.step import Body
from fab.solids.substrate import ChromeRing, Substrate, substrate_bodies, substrate_step, wafer_bodies, wafer_step
from fab.units import MM, format_length

__all__ = ["MESH_CELLS", "PlateModel", "write_models"]

MESH_CELLS = 400
_SAG_CELLS = 500
_BASE_M = 10e-6
# What is left of a volume: double precision in STEP; picometres as text or single precision in meshes.
_STEP_OFF, _MESH_OFF = 1e-11, 1e-6
_SINGLE = 2.0**-23


class PlateModel(NamedTuple):
    """What all models show.

    Attributes:
        level_map: the DOE.
        chrome: how the chrome is drawn.
        wafer: the glass.
        die_m: edge of the die, metres.
        dies: middles of the dies on the wafer x, y, metres.
        patch: the window that is wanted at full resolution, if any.
    """

    level_map: LevelMap
    chrome: Chrome
    wafer: Wafer
    die_m: float
    dies: Sequence[tuple[float, float]]
    patch: Patch | None = None


def write_models(folder: Path, stem: str, shown: PlateModel) -> list[ModelEntry]:
    """Write all models of a DOE.

    Args:
        folder: an order in the making.
        stem: what the names begin with.
        shown: what they show.

    Returns:
        one entry per file; a file that a small map cannot have (grid sag of fewer than 5 points) is left out.
    """
    cells = reduced_cells(shown.level_map, MESH_CELLS)
    about = f"relief on {format_length(_BASE_M)} of glass, mean height of {cells.block} x {cells.block} pixels"
    return [
        _write_plate(folder, f"{stem}_PLATE.step", shown),
        _write_wafer(folder, f"{stem}_WAFER.step", shown),
        *_write_meshes(folder, f"{stem}_RELIEF", cells, about),
        *(_write_patch(folder, f"{stem}_PATCH", shown, shown.patch) if shown.patch else ()),
        *_write_heights(folder, stem, shown.level_map),
    ]


def _write_plate(folder: Path, file: str, shown: PlateModel) -> ModelEntry:
    """Write one die, with its rings if the map is radial."""
    level_map = shown.level_map
    glass = Substrate("die", shown.die_m, shown.wafer.thickness_m)
    chrome = ChromeRing(*shown.chrome.radii_m(level_map))
    levels_of_rings, rings = ring_levels(level_map), None
    about = "millimetres; one die, relief plane at z = 0, where the clear aperture is drawn flat"
    if levels_of_rings is not None:
        rings = rings_from_levels(levels_of_rings, level_map)
        share = 100 * pixel_share(level_map, levels_of_rings)
        about = (
            f"millimetres; one die, blank surface at z = 0, relief of {len(levels_of_rings)} rings as exact circles; "
            f"the masks draw them in pixels, with another height on {share:.2g} % of the clear aperture"
        )
    substrate_step(folder / file, glass, level_map.aperture_m, chrome, rings)
    return _solid(file, about, substrate_bodies(glass, chrome, rings))


def _write_wafer(folder: Path, file: str, shown: PlateModel) -> ModelEntry:
    """Write the wafer, with a flat unless the dies need its place."""
    wafer = shown.wafer
    chrome = ChromeRing(*shown.chrome.radii_m(shown.level_map))
    glass = Substrate("wafer", wafer.diameter_m, wafer.thickness_m, wafer.usual_flat_m)
    told = f"primary flat of {format_length(glass.flat_m)} at -y, as usual for this diameter (SEMI M1)"
    if not glass.flat_m or not all(glass.holds(x, y, chrome.outer_m) for x, y in shown.dies):
        glass, told = Substrate("wafer", wafer.diameter_m, wafer.thickness_m), "no flat"
    wafer_step(folder / file, glass, shown.level_map.aperture_m, chrome, shown.dies)
    about = f"millimetres; the wafer before it is diced, {told}; chrome of {len(shown.dies)} dies, no relief"
    return _solid(file, about, wafer_bodies(glass, chrome, shown.dies))


def _write_meshes(
    folder: Path, name: str, cells: Columns, about: str, window: Window | None = None
) -> list[ModelEntry]:
    """Write a relief as a mesh in every format."""
    mesh = relief_mesh(cells, _BASE_M)
    closed_volume_m3(mesh)
    volume = {"RELIEF": (cells.volume_m3 + cells.area_m2 * _BASE_M) / MM**3}
    # In single precision walls stand aside, the more so the farther out; over a whole map that cancels out.
    aside = 0.0
    if window is not None:
        edges, closest = (np.concatenate([f(cells.x_edges_m), f(cells.y_edges_m)]) for f in (np.abs, np.diff))
        aside = _SINGLE * float(edges.max() / closest.min())
    entries = []
    for end, unit, write, off in (
        (".3mf", "millimetres", write_3mf, _MESH_OFF),
        (".glb", "metres", write_glb, _MESH_OFF + aside),
        ("_MM.stl", "millimetres", write_stl, _MESH_OFF + aside),
    ):
        write(folder / f"{name}{end}", mesh)
        entries.append(_entry(f"{name}{end}", f"{unit}; {about}", window, volumes_mm3=volume, relative_error=off))
    return entries


def _write_patch(folder: Path, name: str, shown: PlateModel, patch: Patch) -> list[ModelEntry]:
    """Write a window at full resolution."""
    level_map, grid = shown.level_map, shown.level_map.grid
    patch.require(level_map)
    window = patch.window(grid)
    middle = ", ".join(format_length(value) for value in window.centre_m(grid))
    about = (
        f"{window.rows} x {window.columns} pixels of {format_length(grid.pitch_m)} about {middle} of the DOE, "
        f"on {format_length(_BASE_M)} of glass"
    )
    entries = []
    if patch.step:
        file = f"{name}.step"
        patch_step(folder / file, level_map, window, _BASE_M)
        body = patch_body(level_map, window, _BASE_M)
        entries.append(_solid(file, f"millimetres; boxes side by side, {about}", {"PATCH": body}, window))
    return [*entries, *_write_meshes(folder, name, patch.cells(level_map), about, window)]


def _write_heights(folder: Path, stem: str, level_map: LevelMap) -> list[ModelEntry]:
    """Write the height maps."""
    tif, npy, grey, sag = (f"{stem}_{end}" for end in ("HEIGHT.tif", "HEIGHT.npy", "GREY.png", "SAG.DAT"))
    per_count = write_tiff(folder / tif, level_map)
    about = "height above the deepest floor, first row at the highest y"
    entries = [_entry(tif, about, metres_per_count=per_count)]
    write_npy(folder / npy, level_map)
    entries.append(_entry(npy, "height above the deepest floor, row 0 at the lowest y", metres_per_count=1.0))
    per_count = write_greymap(folder / grey, level_map)
    about = "white is the blank surface, first row at the highest y"
    entries.append(_entry(grey, about, metres_per_count=per_count))
    grid = level_map.grid
    rows, columns = (min(n, _SAG_CELLS) for n in grid.shape)
    if min(rows, columns) >= 5:
        window = Window((grid.shape[0] - rows) // 2, (grid.shape[1] - columns) // 2, rows, columns)
        write_zemax_sag(folder / sag, level_map, window)
        about = f"sag from the blank surface, the middle {rows} x {columns} pixels, seen as an exit face"
        entries.append(_entry(sag, about, window, metres_per_count=MM))
    return entries


def _solid(file: str, content: str, bodies: Mapping[str, Body], window: Window | None = None) -> ModelEntry:
    volumes = {name: body.volume_m3 / MM**3 for name, body in bodies.items()}
    centres = {name: [value / MM for value in body.centre_m] for name, body in bodies.items()}
    return _entry(file, content, window, volumes_mm3=volumes, centres_mm=centres, relative_error=_STEP_OFF)


def _entry(
    file: str,
    content: str,
    window: Window | None = None,
    *,
    volumes_mm3: Mapping[str, float] | None = None,
    centres_mm: Mapping[str, list[float]] | None = None,
    relative_error: float = 0.0,
    metres_per_count: float | None = None,
) -> ModelEntry:
    pixels = None if window is None else [window.row, window.column, window.rows, window.columns]
    return ModelEntry(
        file, content, dict(volumes_mm3 or {}), dict(centres_mm or {}), relative_error, metres_per_count, pixels
    )
