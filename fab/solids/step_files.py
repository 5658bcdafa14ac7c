"""The STEP files of an order: one die, the wafer, and on request a window at full resolution.

A STEP file must hold every point, plane and circle where a fresh drawing has it, and the stated parts, each with its
volume and its centre of mass.
"""

import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from fab.aperture import MaskAperture
from fab.files import scratch_folder
from fab.manifest.records import ModelEntry
from fab.solids.model import DoeModel, ModelKind, model_entry
from fab.solids.patch import patch_body, patch_step
from fab.solids.rings import pixel_share, ring_levels, rings_from_levels
from fab.solids.step import step_bodies, step_differences
from fab.solids.substrate import (
    ChromeFilm,
    Rings,
    Substrate,
    division_of,
    substrate_bodies,
    substrate_step,
    wafer_bodies,
    wafer_step,
)
from fab.units import MM, format_length

_LOG = logging.getLogger("doedesign")
# Corners of outlines, a wall each: 4500 of them take the kernel a minute, which grows with their square.
_MOST_CORNERS = 1500
# Double precision, less what the kernel loses.
_RELATIVE_ERROR = 1e-11


def _die(model: DoeModel) -> tuple[Substrate, ChromeFilm]:
    glass = Substrate("die", model.die_m, model.wafer.thickness_m)
    return glass, _chrome(model)


def _chrome(model: DoeModel) -> ChromeFilm:
    drawn = model.chrome.opening(model.level_map.relief), model.chrome.rim_m(model.level_map)
    if not model.wafer.chrome_to_edge:
        return ChromeFilm(*drawn)
    return ChromeFilm(*drawn, edge_m=model.die_m, bare_m=tuple(model.bare_m))


def _reach(model: DoeModel) -> str:
    """Return in words how far the chrome goes, and what of it is left out."""
    if not model.wafer.chrome_to_edge:
        return "chrome as a ring"
    return "chrome to the edges of a die but for the window of its marks"


def _drawable(model: DoeModel) -> bool:
    """Whether the kernel takes the outlines of relief and opening; the log says so if it does not."""
    relief = model.level_map.relief
    if not isinstance(relief, MaskAperture):
        return True
    divisions = [division_of(one) for one in (relief, model.chrome.opening(relief))]
    corners = sum(division.corners for division in divisions)
    if corners <= _MOST_CORNERS and not any(division.touches for division in divisions):
        return True
    _LOG.warning(
        "no STEP files of this plate: the outlines of its mask have %d corners (at most %d) or meet at corners; "
        "its meshes have all of it",
        corners,
        _MOST_CORNERS,
    )
    return False


def _rings(model: DoeModel) -> tuple[Rings | None, str]:
    """Return the rings of a map that is radial, and what the file shows."""
    level_map = model.level_map
    levels_of_rings = ring_levels(level_map)
    if levels_of_rings is None:
        return None, f"millimetres; one die, relief plane at z = 0, where the relief is drawn flat; {_reach(model)}"
    share = 100 * pixel_share(level_map, levels_of_rings)
    return rings_from_levels(levels_of_rings, level_map), (
        f"millimetres; one die, blank surface at z = 0, relief of {len(levels_of_rings)} rings as exact circles; "
        f"the masks draw them in pixels, with another height on {share:.2g} % of the relief; {_reach(model)}"
    )


def _die_entry(path: Path, model: DoeModel) -> ModelEntry | None:
    if not _drawable(model):
        return None
    rings, about = _rings(model)
    return model_entry(path, about, substrate_bodies(*_die(model), rings), _RELATIVE_ERROR)


def _write_die(path: Path, model: DoeModel) -> None:
    """Write one die, with its rings if the map is radial."""
    glass, chrome = _die(model)
    substrate_step(path, glass, model.level_map.relief, chrome, _rings(model)[0])


def _wafer(model: DoeModel) -> tuple[Substrate, ChromeFilm]:
    """Return the wafer, with a flat unless the dies need its place, and the chrome of a die."""
    wafer = model.wafer
    chrome = _chrome(model)
    glass = Substrate("wafer", wafer.diameter_m, wafer.thickness_m, wafer.usual_flat_m)
    if glass.flat_m and not all(glass.holds(x, y, chrome) for x, y in model.dies):
        glass = Substrate("wafer", wafer.diameter_m, wafer.thickness_m)
    return glass, chrome


def _wafer_entry(path: Path, model: DoeModel) -> ModelEntry | None:
    if not _drawable(model):
        return None
    glass, chrome = _wafer(model)
    flat = f"primary flat of {format_length(glass.flat_m)} at -y, as usual for this diameter (SEMI M1)"
    about = (
        f"millimetres; the wafer before it is diced, {flat if glass.flat_m else 'no flat'}; chrome of "
        f"{len(model.dies)} dies, no relief; {_reach(model)}"
    )
    return model_entry(path, about, wafer_bodies(glass, chrome, model.dies), _RELATIVE_ERROR)


def _write_wafer(path: Path, model: DoeModel) -> None:
    glass, chrome = _wafer(model)
    wafer_step(path, glass, model.level_map.relief, chrome, model.dies)


def _patch_entry(path: Path, model: DoeModel) -> ModelEntry | None:
    if model.patch is None or not model.patch.step or model.detail is None:
        return None
    window = model.patch.window(model.level_map.grid)
    about = f"millimetres; boxes side by side, {model.detail.about}"
    return model_entry(path, about, {"PATCH": patch_body(model.level_map, window)}, _RELATIVE_ERROR, window=window)


def _write_patch(path: Path, model: DoeModel) -> None:
    if model.patch is not None:
        patch_step(path, model.level_map, model.patch.window(model.level_map.grid))


def _problems(path: Path, entry: ModelEntry, model: DoeModel, write: Callable[[Path, DoeModel], object]) -> list[str]:
    with scratch_folder() as folder:
        again = folder / path.name
        write(again, model)
        # What differs may be made to harm the kernel, which therefore does not read it.
        if differences := step_differences(path, again):
            return differences
    found = step_bodies(path)
    problems = volume_problems(entry, {name: body.volume_m3 / MM**3 for name, body in found.items()})
    for name in sorted(entry.centres_mm.keys() & found.keys()):
        here, wanted = np.array(found[name].centre_m) / MM, np.array(entry.centres_mm[name])
        off = float(np.abs(here - wanted).max()) * MM
        # Of a whole plate the kernel loses as many digits as its size has over a tenth of a nanometre.
        if not off <= 0.1e-9:
            problems.append(f"{name}: its centre of mass lies {format_length(off)} aside")
    return problems


def volume_problems(entry: ModelEntry, found_mm3: Mapping[str, float]) -> list[str]:
    """Compare volumes by part with those of the manifest."""
    problems = []
    for name in sorted(entry.volumes_mm3.keys() | found_mm3.keys()):
        found, wanted = found_mm3.get(name, 0.0), entry.volumes_mm3.get(name, 0.0)
        if not abs(found - wanted) <= entry.relative_error * wanted:
            problems.append(f"{name}: {found:.12g} mm3 instead of {wanted:.12g} mm3")
    return problems


DIE = ModelKind("_PLATE.step", _die_entry, _write_die, partial(_problems, write=_write_die))
WAFER = ModelKind("_WAFER.step", _wafer_entry, _write_wafer, partial(_problems, write=_write_wafer))
PATCH = ModelKind("_PATCH.step", _patch_entry, _write_patch, partial(_problems, write=_write_patch))
