"""`doedesign masks`: a level map becomes a mask order."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from doedesign.build import camera_from_spec, process_from_spec, require_levels, wafer_from_spec
from doedesign.design.design import Design
from doedesign.lab.predictions import PROBE_M, SheetPrediction, predict_sheet
from doedesign.runs.level_maps import Drawing
from doedesign.spec import Spec, WaferSpec, load_process, load_wafer
from fab.errors import InputError
from fab.figure import save
from fab.files import sha256_file
from fab.layout.frame import Frame
from fab.layout.geometry import Chrome
from fab.layout.marks import alignment_site
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.order.order import Order, plan_order
from fab.order.write import write_planned
from fab.plots.marks import plot_part
from fab.plots.wafer import plot_wafer
from fab.process import Process, Variation
from fab.runsheet.tables import Die, PhotomaskFile, RunSheet
from fab.runsheet.write import write_run_sheet
from fab.solids.patch import Patch
from fab.verification.verify import VerificationReport

log = logging.getLogger("doedesign")


def write_masks(
    drawing: Drawing,
    out: Path | None = None,
    *,
    on_violation: Literal["warn", "fail", "fix"] = "warn",
    probe_m: float = PROBE_M,
    patch: Patch | None = None,
    process_file: Path | None = None,
    wafer_file: Path | None = None,
) -> tuple[Path, VerificationReport]:
    """Write and prove the mask order of a level map.

    Args:
        drawing: the level map, and where it comes from.
        out: order folder; `masks/NAME` by default.
        on_violation: what to do where the process cannot print a mask: say so, refuse, or change the level map.
        probe_m: wavelength of the laser that the lab tests the plate with.
        patch: a window to write as a solid at full resolution, too.
        process_file: TOML with the process to make it with; that of the run, or an ideal one, if left out.
        wafer_file: TOML with the wafer to fill; that of the run, or the usual one, if left out.

    Returns:
        the folder and the report of its proof.

    Raises:
        InputError: the map cannot be drawn, the process cannot print it and `on_violation` is "fail", or the folder
            cannot be written.
        CheckFailed: what was read back differs from what was asked for; nothing is left behind.
    """
    level_map, design = drawing.level_map, drawing.design
    folder = out or Path("masks") / level_map.name
    spec = None if design is None else design.spec
    chrome = Chrome() if spec is None else Chrome(overlap_m=spec.process.chrome_overlap_m)
    process = _process(spec, level_map.levels, process_file)
    filled = (spec.wafer if spec else WaferSpec()) if wafer_file is None else load_wafer(wafer_file)
    order = plan_order(
        level_map,
        process=process,
        wafer=wafer_from_spec(filled),
        chrome=chrome,
        patch=patch,
        source=drawing.origin,
        on_violation=on_violation,
        waves_per_metre=None if spec is None else _waves_per_metre(spec),
    )
    if order.repair is not None and design is not None:
        repair = {**order.source["repair"], "psf": _psf_cost(design, order.level_map)}
        order = replace(order, source={**order.source, "repair": repair})

    def add(fresh: Path, order: Order, frame: Frame) -> list[str]:
        plate, marks, name = (f"{order.stem}_{what}.png" for what in ("WAFER", "MARKS", "RULES"))
        dbu_m, aperture_m = order.dbu_m, order.level_map.aperture_m
        title = f"{order.stem}: what lies where"
        save(plot_wafer(order.wafer, frame, aperture_m, dbu_m, title), fresh / plate)
        site = alignment_site(order.plates, dbu_m)
        title = f"{order.stem}: alignment site, every mask in its colour"
        save(plot_part(site, order.plates, title), fresh / marks)
        log.info("writing the run sheet")
        sheets = write_run_sheet(fresh, *_run_sheet(design, fresh, order, frame, probe_m))
        found = order.rules
        if found.clean:
            return [plate, marks, *sheets]
        title = f"{order.stem}: where the masks break the rules of {process.name}"
        save(found.plot(title=title), fresh / name)
        return [plate, marks, *sheets, name]

    written = write_planned(folder, order, add=add)
    return folder, written.report


def _waves_per_metre(spec: Spec) -> float:
    return camera_from_spec(spec).waves_per_metre(spec.optics.design_wavelength_m)


def _run_sheet(
    design: Design | None, folder: Path, order: Order, frame: Frame, probe_m: float
) -> tuple[RunSheet, bytes | None]:
    """The run sheet of an order in the making, and the picture of what the lab should see."""
    moves_m = [move * order.dbu_m for move in order.edge_moves()]
    told = None if design is None else _foretold(design, order, moves_m, probe_m)
    files = {
        plate.name: PhotomaskFile(
            file=f"{order.plate_stem(plate)}.gds",
            sha256=sha256_file(folder / f"{order.plate_stem(plate)}.gds"),
            cell=order.plate_stem(plate),
            edge_move_m=0.0 if plate.bit is None else moves_m[plate.bit],
        )
        for plate in order.plates
    }
    sheet = RunSheet(
        stem=order.stem,
        level_map=order.level_map,
        plates=order.plates,
        files=files,
        process=order.process,
        opening_m=2 * order.chrome.radii_m(order.level_map)[0],
        wafer=order.wafer,
        places=frame.places,
        dies=tuple(
            Die(f"die {number}", x, y, order.splits[split].words)
            for number, ((x, y), split) in enumerate(zip(frame.dies, frame.splits, strict=True), 1)
        ),
        predictions=None if told is None else told.predictions,
    )
    return sheet, None if told is None else told.picture


def _foretold(design: Design, order: Order, moves_m: list[float], probe_m: float) -> SheetPrediction | None:
    assert design.spec is not None  # a run has one
    drawn = replace(design, level_map=order.level_map)
    try:
        return predict_sheet(drawn, order.process, design.spec.optics.design_wavelength_m, probe_m, moves_m)
    except InputError as error:
        log.warning("the run sheet says nothing of the light: %s", error)
        return None


def _process(spec: Spec | None, levels: Levels, file: Path | None) -> Process:
    """The process of a file or a spec; for other levels than a spec's (`--levels`) what it says of the lithography."""
    if file is not None:
        return require_levels(process_from_spec(load_process(file), levels), levels, str(file))
    if spec is None:
        return Process(levels)
    made = process_from_spec(spec.process)
    if made.levels == levels:
        return made
    said = {key: getattr(made, key) for key in ("tone", "minimum_line_m", "minimum_space_m")}
    return Process(levels, name=made.name, **said)


def _psf_cost(design: Design, repaired: LevelMap) -> list[dict[str, Any]]:
    """Compare what light does with a map before and after a repair, colour by colour and depth by depth."""
    from doedesign.prediction import predict

    after = replace(design, level_map=repaired)
    rows = [predict(each, Process(design.levels), Variation()).rows for each in (design, after)]
    told = []
    for old, new in zip(*rows, strict=True):
        numbers = {key: [old[key], new[key]] for key in ("ring_to_disc", "far_spot", "zeroth_order") if key in old}
        told.append({"colour": old["colour"], "depth_m": old["depth_m"], **numbers})
    worst = max((t for t in told if "far_spot" in t), key=lambda t: t["far_spot"][0] - t["far_spot"][1], default=None)
    if worst is not None:
        log.info("far spot of %s: %.3f before, %.3f after", worst["colour"], *worst["far_spot"])
    return told
