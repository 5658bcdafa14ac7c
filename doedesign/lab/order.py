"""The mask order of a level map, with its pictures and its run sheet."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from doedesign.build import (
    is_process_file,
    process_from_spec,
    resolve_process,
    terms_from_spec,
    wafer_from_spec,
)
from doedesign.design.design import Design
from doedesign.lab.predictions import PROBE_M, predict_sheet
from doedesign.prediction import predict
from doedesign.runs.folder import Run
from doedesign.runs.level_maps import GEOMETRY, drawing_from
from doedesign.runs.orders import place_of_order, require_replaceable
from doedesign.runs.verdict import certified_orders
from doedesign.spec import OrderSpec, ProcessSpec, WaferSpec, load_order, load_process, load_wafer
from fab.errors import InputError
from fab.files import path_of
from fab.layout.geometry import Chrome
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.order.formats import Formats
from fab.order.order import Order, plan_order
from fab.order.terms import OrderTerms
from fab.order.write import WrittenOrder, write_planned
from fab.process import Process, Variation
from fab.runsheet.tables import SILICA, SheetPrediction
from fab.solids.patch import Patch
from fab.units import metres
from sim.material import material
from sim.metrics import mean_wavelength_m

log = logging.getLogger("doedesign")


def write_masks(
    source: Design | Run | str | Path,
    out: str | Path | None = None,
    *,
    levels: int | None = None,
    on_violation: Literal["warn", "fail", "fix"] = "warn",
    probe_m: float | str = PROBE_M,
    patch: Patch | None = None,
    process: Process | str | Path | None = None,
    wafer: Wafer | str | Path | None = None,
    terms: OrderTerms | str | Path | None = None,
    direct_write: bool = False,
    formats: Formats | None = None,
    overwrite: bool = False,
    one_to_one: bool = False,
    **geometry: Any,
) -> WrittenOrder:
    """Write and prove the mask order of a design or of any height map, with its run sheet.

    Args:
        source: a design, a finished run, its folder, or a height map (.exr, .npy, .tif, .png).
        out: order folder; `masks/NAME` by default. An order in it is replaced if it is of the same run or level map.
        levels: number of heights; the run's own by default.
        on_violation: what to do where the process cannot print a mask: say so, refuse, or change the level map.
        probe_m: wavelength of the laser that the lab tests the DOE with, in metres or with a unit.
        patch: a window to write as a solid at full resolution, too.
        process: a process, the name of a stock process or a TOML file; that of the run, or an ideal one, by default.
        wafer: the wafer to fill, or a TOML file with it; that of the run, or the usual one, by default. A file that
            does not say how edges are moved leaves it to the run, whose masks may be drawn against its process.
        terms: what is asked of the mask shop besides the drawing, or a TOML file with it; that of the run, or else
            revision A and blanks, by default.
        direct_write: whether to write files for direct-write and greyscale exposure, too.
        formats: in which formats it is written; packed and coarse enough to mail by default.
        overwrite: where the folder has the order of another design, replace that order.
        one_to_one: whether plates at 1:1 are taken for a stepper, too, from which a mask shop makes its reticles.
        geometry: of a bare height map: `step_m`, `etch_depths_m`, `pitch_m`, `scale_m`, `aperture_m`
            (`doedesign.runs.level_maps.drawing_from`).

    Raises:
        InputError: an argument that there is not, the probe's wavelength is not positive, the map cannot be drawn, the
            process cannot print it and `on_violation` is "fail", or the folder cannot be written or has the order of
            another design.
        CheckFailed: what was read back differs from what was asked for; nothing is left behind.
    """
    probe_m = metres(probe_m, "probe_m")
    if not probe_m > 0:
        raise InputError("probe_m", "must be positive", f"{probe_m:g} m", 'Give a wavelength, such as "520 nm".')
    if unknown := [name for name in geometry if name not in GEOMETRY]:
        rule, cure = "must be an argument that there is", f"Those of a bare height map are {', '.join(GEOMETRY)}."
        raise InputError(unknown[0], rule, repr(geometry[unknown[0]]), cure)
    level_map, origin, design = drawing_from(source, levels, **geometry)
    spec = None if design is None else design.spec
    run = None if design is None else design.folder
    folder = place_of_order(level_map, origin, run) if out is None else path_of(out, "out")
    if not overwrite:  # said before anything takes time
        require_replaceable(folder, level_map, origin, run)
    made_by = _process(process, level_map.levels, spec and spec.process)
    if not isinstance(wafer, Wafer):
        usual = spec.wafer if spec else WaferSpec()
        wafer = wafer_from_spec(usual if wafer is None else _wafer_of(load_wafer(wafer), usual))
    if not isinstance(terms, OrderTerms):
        asked = spec.order if spec else OrderSpec()
        terms = terms_from_spec(asked if terms is None else load_order(terms))
    made_of = SILICA if design is None else material(design.camera.material).title
    if made_of != SILICA:
        log.warning("the run sheet leaves cleaning, plasma and rates to the lab: its recipe is not for %s", made_of)
    order = plan_order(
        level_map,
        process=made_by,
        wafer=wafer,
        chrome=_chrome(process, level_map.levels, spec and spec.process),
        patch=patch,
        terms=terms,
        direct_write=direct_write,
        source=origin,
        on_violation=on_violation,
        waves_per_metre=design and design.camera.waves_per_metre(_design_wavelength_m(design)),
        papers=True,
        formats=formats,
        material=made_of,
        one_to_one=one_to_one,
    )
    if order.repair is not None and design is not None:
        repair = {**order.source["repair"], "psf": _psf_cost(design, order.level_map)}
        order = replace(order, source={**order.source, "repair": repair})

    # Read before anything takes time; those of the map that is drawn, as designed or repaired.
    certified = certified_orders(design and design.folder, order.level_map.digest)

    def predicted(order: Order) -> SheetPrediction | None:
        if design is None:
            return None
        drawn = replace(design, level_map=order.level_map)
        moves_m = [move * order.dbu_m for move in order.edge_moves()]
        try:
            seen = predict_sheet(drawn, order.process, _design_wavelength_m(design), probe_m, moves_m)
        except InputError as error:
            if isinstance(error.__cause__, OSError):
                raise  # a full disk is no limit of the model
            log.warning("the run sheet says nothing of the light: %s", error)
            return None
        return seen._replace(predictions=replace(seen.predictions, certified=certified))

    return write_planned(folder, order, predict=predicted)


def drawn_as(order: WrittenOrder) -> str:
    """Words on the level map that an order was proved to draw: as designed, rounded or repaired."""
    source, count = order.manifest.source, order.manifest.levels
    if "repair" in source:
        return "as repaired"
    if "rounded" in source:
        return f"as rounded to {count} levels, not as designed with {source['rounded']['designed_levels']}"
    return f"as the map rounded to {count} levels" if source.get("kind") == "height map" else "as designed"


def _design_wavelength_m(design: Design) -> float:
    """The wavelength that a design is for, metres: that of its spec, or of its first colour."""
    return design.spec.optics.design_wavelength_m if design.spec else mean_wavelength_m(design.camera.colours[0])


def _process(given: Process | str | Path | None, levels: Levels, usual: ProcessSpec | None) -> Process:
    """The process that is given or usual; for other levels than the usual ones, what that says of the lithography."""
    if given is not None or usual is None:
        return resolve_process(given, levels)
    made = process_from_spec(usual)
    if made.levels == levels:
        return made
    lithography = {key: getattr(made, key) for key in ("tone", "minimum_line_m", "minimum_space_m", "reduction")}
    return Process(levels, name=made.name, **lithography)


def _wafer_of(given: WaferSpec, usual: WaferSpec) -> WaferSpec:
    """A wafer with edges moved as it says, or else as those of a run: pre-compensation is part of its masks."""
    kept = ("edge_moves_m", "compensate")
    if given.model_fields_set & {*kept}:
        return given
    return given.model_copy(update={name: getattr(usual, name) for name in kept})


def _chrome(given: Process | str | Path | None, levels: Levels, usual: ProcessSpec | None) -> Chrome:
    """The chrome of a process file that says how far it reaches, or of the usual process."""
    if is_process_file(given):
        read = load_process(given, levels)
        if usual is None or "chrome_overlap_m" in read.model_fields_set:
            return Chrome(overlap_m=read.chrome_overlap_m)
    return Chrome() if usual is None else Chrome(overlap_m=usual.chrome_overlap_m)


def _psf_cost(design: Design, repaired: LevelMap) -> list[dict[str, Any]]:
    """Compare what light does with a map before and after a repair, colour by colour and depth by depth."""
    after = replace(design, level_map=repaired)
    rows = [predict(each, Process(design.levels), Variation()).rows for each in (design, after)]
    costs = []
    for old, new in zip(*rows, strict=True):
        numbers = {key: [old[key], new[key]] for key in ("ring_to_disc", "far_spot", "zeroth_order") if key in old}
        costs.append({"colour": old["colour"], "depth_m": old["depth_m"], **numbers})
    spots = [cost for cost in costs if "far_spot" in cost]
    if spots:
        worst = max(spots, key=lambda cost: cost["far_spot"][0] - cost["far_spot"][1])
        log.info("far spot of %s: %.3f before, %.3f after", worst["colour"], *worst["far_spot"])
    return costs
