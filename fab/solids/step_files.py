"""The STEP files of an order: one die, the wafer, and on request a window at full resolution.

A STEP file must hold the stated parts, each with its volume and its centre of mass.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fab.level_map import LevelMap
from fab.manifest.records import ModelEntry
from fab.solids.model import DoeModel, ModelKind, model_entry
from fab.solids.patch import patch_body, patch_step
from fab.solids.rings import pixel_share, ring_levels, rings_from_levels
from fab.solids.step import step_bodies
from fab.solids.substrate import ChromeRing, Substrate, substrate_bodies, substrate_step, wafer_bodies, wafer_step
from fab.units import MM, format_length

# Double precision, less what the kernel loses.
_RELATIVE_ERROR = 1e-11


def _write_die(path: Path, model: DoeModel) -> ModelEntry:
    """Write one die, with its rings if the map is radial."""
    level_map = model.level_map
    glass = Substrate("die", model.die_m, model.wafer.thickness_m)
    chrome = ChromeRing(*model.chrome.radii_m(level_map))
    levels_of_rings, rings = ring_levels(level_map), None
    about = "millimetres; one die, relief plane at z = 0, where the relief is drawn flat"
    if levels_of_rings is not None:
        rings = rings_from_levels(levels_of_rings, level_map)
        share = 100 * pixel_share(level_map, levels_of_rings)
        about = (
            f"millimetres; one die, blank surface at z = 0, relief of {len(levels_of_rings)} rings as exact circles; "
            f"the masks draw them in pixels, with another height on {share:.2g} % of the relief"
        )
    substrate_step(path, glass, level_map.aperture_m, chrome, rings)
    return model_entry(path, about, substrate_bodies(glass, chrome, rings), _RELATIVE_ERROR)


def _write_wafer(path: Path, model: DoeModel) -> ModelEntry:
    """Write the wafer, with a flat unless the dies need its place."""
    wafer, dies = model.wafer, model.dies
    chrome = ChromeRing(*model.chrome.radii_m(model.level_map))
    glass = Substrate("wafer", wafer.diameter_m, wafer.thickness_m, wafer.usual_flat_m)
    flat = f"primary flat of {format_length(glass.flat_m)} at -y, as usual for this diameter (SEMI M1)"
    if not glass.flat_m or not all(glass.holds(x, y, chrome.outer_m) for x, y in dies):
        glass, flat = Substrate("wafer", wafer.diameter_m, wafer.thickness_m), "no flat"
    wafer_step(path, glass, model.level_map.aperture_m, chrome, dies)
    about = f"millimetres; the wafer before it is diced, {flat}; chrome of {len(dies)} dies, no relief"
    return model_entry(path, about, wafer_bodies(glass, chrome, dies), _RELATIVE_ERROR)


def _write_patch(path: Path, model: DoeModel) -> ModelEntry | None:
    if model.patch is None or not model.patch.step or model.detail is None:
        return None
    level_map, window = model.level_map, model.patch.window(model.level_map.grid)
    patch_step(path, level_map, window)
    body = patch_body(level_map, window)
    about = f"millimetres; boxes side by side, {model.detail.about}"
    return model_entry(path, about, {"PATCH": body}, _RELATIVE_ERROR, window=window)


def _problems(path: Path, entry: ModelEntry, _: LevelMap) -> list[str]:
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


DIE = ModelKind("_PLATE.step", _write_die, _problems)
WAFER = ModelKind("_WAFER.step", _write_wafer, _problems)
PATCH = ModelKind("_PATCH.step", _write_patch, _problems)
