"""From a spec to a design and its masks: new, optimize, refine, precompensate, masks, verify."""

import json
import shlex
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from doedesign.cli.closing import say_closing, words_to_draw
from doedesign.cli.console import print_paths, print_results, print_text, say
from doedesign.cli.options import AsJson, Flag, Overrides, Texts, length_of, refuse_options
from fab.errors import InputError

# Lengths of which the first may be negative: "-1 mm" is no option.
Place = Annotated[str | None, Parameter(allow_leading_hyphen=True)]


def new(name: str | None = None, *, out: Path | None = None, json_: AsJson = False) -> None:
    """Write a commented spec to begin with, or list those that there are.

    Args:
        name: What it should make: splitter, fan_out, diffuser, top_hat, lens ...; without one all are listed.
        out: The file; NAME.toml by default.
    """
    from doedesign.templates import template_names, template_summary, template_text
    from fab.files import write_atomic

    if name is None:
        refuse_options(new, {"out": out}, "goes with the name of a template only", "Name one: doedesign new splitter.")
        names = template_names()
        if json_:
            print_text(json.dumps({each: template_summary(each) for each in names}))
        else:
            wide = max(map(len, names))
            print_text("\n".join(f"{each:{wide}}  {template_summary(each)}" for each in names))
        return
    text, path = template_text(name), out or Path(f"{name}.toml")
    if path.exists():
        got = "a folder" if path.is_dir() else "a file of that name"
        raise InputError(str(path), "a new spec must not replace a file", got, "Give another --out.")
    write_atomic(path, text.encode())
    print_paths([path], json_)
    say(f"next: doedesign {shlex.join(['optimize', str(path)])}")


def optimize(
    spec: Path,
    *,
    out: Path | None = None,
    set_: Overrides = (),
    start: str | None = None,
    budget: float | None = None,
    overwrite: Flag = False,
    allow_code: Flag = False,
    json_: AsJson = False,
) -> None:
    """Optimise a spec into a run folder, or resume it where it was stopped.

    Args:
        spec: TOML spec, such as examples/automotive.toml.
        out: Run folder; runs/NAME by default.
        start: Start of the search in place of the spec's, short for --set optimize.start=NAME: flat, ring, nlopt ...
        budget: Seconds that the steps may take: as many as this machine makes of them, in place of optimize.steps.
        overwrite: Where the folder has the run of another spec, remove it and all that was made of it.
        allow_code: Import and run the objectives that the spec names "module:function". Only for specs you trust.
    """
    from doedesign.spec import load_spec

    if start is not None:
        set_ = (*set_, f"optimize.start={start}")
    read = load_spec(spec, set_)  # a mistake in it is told before heavy packages are loaded
    from doedesign.design.objectives import import_objectives
    from doedesign.optimization import optimize as work
    from doedesign.optimization import steps_within
    from doedesign.runs.costs import measured

    folder = out or Path("runs") / read.name
    own = import_objectives(read) if allow_code else None
    with measured(folder, "optimize") as taken:
        if budget is not None:
            set_ = (*set_, f"optimize.steps={steps_within(read, budget, None if overwrite else folder, own)}")
        work(spec, folder, overrides=set_, objectives=own, overwrite=overwrite)
    print_paths([folder], json_, metrics=str(folder / "metrics.json"))
    say_closing(folder, taken=taken)


def refine(
    run: Path,
    *,
    out: Path | None = None,
    terms: int | None = None,
    steps: int | None = None,
    overwrite: Flag = False,
    json_: AsJson = False,
) -> None:
    """Refine the unit cell of a run by Maxwell's equations and their gradient, into a run of its own, or resume it.

    For spots that are orders of a cell (spots.period) of a few wavelengths; needs the extra "rigorous".

    Args:
        run: Run folder; it stays as it is.
        out: Folder of the new run; runs/NAME_refined by default.
        terms: Orders of the rigorous solution; by default those that travel in the glass and somewhat more. Time grows
            with their third power.
        steps: Gradients that are computed; 60 by default, 300 of a row of cells.
        overwrite: Where the folder has another run, remove it and all that was made of it.
    """
    from doedesign.refinement import refine as work
    from doedesign.runs.costs import measured

    with measured(out, "refine") as taken:
        folder = taken.run = work(run, out, terms=terms, steps=steps, overwrite=overwrite).folder or Path()
    print_paths([folder], json_, metrics=str(folder / "metrics.json"))
    say_closing(folder, taken=taken)


def precompensate(
    run: Path,
    *,
    process: str | None = None,
    random: Texts = (),
    by: Literal["psfs", "loss"] | None = None,
    evaluations: int = 120,
    out: Path | None = None,
    allow_code: Flag = False,
    overwrite: Flag = False,
    json_: AsJson = False,
) -> None:
    """Find the etch depths to command and the masks' edge moves with which a process makes the plate of a run.

    Writes a run of its own with the same levels, for masks and all else; precompensation.csv says what was found.

    Args:
        run: Run folder; it stays as it is.
        process: TOML file with a [process] table, such as process-estimate.toml of a calibration, or the name of a
            stock process; the run's own by default.
        random: Errors that are drawn anew for every plate, such as overlay; they are those of the run's own process.
        by: The least difference of the PSFs from the design's, or the least loss of the spec, which may be less than
            the design's own, with another light; by default psfs, but for spots, areas and foci loss.
        evaluations: Plates of the search; 0 only undoes the mean errors of depth and line width.
        out: Folder of the new run; runs/NAME_v2 by default.
        allow_code: Import and run the objectives that the spec names "module:function". Only for specs you trust.
        overwrite: Where the folder has another run, remove it and all that was made of it.
    """
    from doedesign.design.objectives import import_objectives
    from doedesign.precompensation import precompensate as work
    from doedesign.runs.costs import measured
    from doedesign.runs.folder import open_run

    source = open_run(run)
    own = import_objectives(source.spec) if allow_code else None
    settings: dict[str, Any] = {"random": random, "by": by, "objectives": own, "evaluations": evaluations}
    with measured(out, "precompensate") as taken:
        folder = taken.run = work(source, out, process=process, **settings, overwrite=overwrite).folder or Path()
    print_paths([folder], json_, table=str(folder / "precompensation.csv"))
    say_closing(folder, taken=taken)


def masks(
    source: Path,
    *,
    levels: int | None = None,
    out: Path | None = None,
    step: str | None = None,
    etch_depths: str | None = None,
    pitch: str | None = None,
    scale: str | None = None,
    aperture: str | None = None,
    on_violation: Literal["warn", "fail", "fix"] = "warn",
    probe: str | None = None,
    patch: Place = None,
    mesh_patch: Place = None,
    as_built: Path | None = None,
    order: Path | None = None,
    process: str | None = None,
    wafer: Path | None = None,
    terms: Path | None = None,
    direct_write: Flag = False,
    plates: Literal["gds.gz", "gds"] = "gds.gz",
    combined_gds: Flag = False,
    mesh_cells: int = 200,
    one_to_one: Flag = False,
    overwrite: Flag = False,
    json_: AsJson = False,
) -> None:
    """Write the mask order of a run or of any height map, and prove it by reading it back.

    With --as-built, take the filled run sheet of a finished wafer instead and predict its plate into RUN/as-built.

    Args:
        source: Run folder, or a height map (.exr, .npy, .tif, .png).
        levels: Number of heights; the run's own by default. With others a warning says what that costs.
        out: Order folder; masks/NAME by default.
        step: Height of one level, such as "75 nm"; for a bare height map.
        etch_depths: Depth of every mask where it is not 2^k steps, such as "80 nm,150 nm"; for a bare height map.
        pitch: Pixel pitch of a bare height map, such as "1.85 um".
        scale: Height of one count of an integer map, such as "1 nm", or of 1 in a map of floats that are not metres.
        aperture: Diameter of the relief, width and height such as "2 mm,1 mm", or a picture that is white where it is;
            the map's shorter side by default.
        on_violation: Where the process cannot print a mask: warn, fail, or fix the level map and say what it costs.
        probe: Wavelength of the laser that the lab tests the plate with; 520 nm by default.
        patch: Also write a window of the relief, "X, Y, EDGE" about its middle, as STEP (at most 2000 boxes) and mesh.
        mesh_patch: Also write a window of the relief as a mesh alone, up to 1000 x 1000 pixels.
        as_built: JSON of the run sheet with measured numbers filled in.
        order: With --as-built, the order that was made; masks/NAME by default.
        process: A TOML file with another [process] table, or the name of a stock process; with --as-built, for what was
            not measured.
        wafer: A TOML file with another [wafer] table.
        terms: A TOML file with another [order] table, what a mask shop is asked for.
        direct_write: Also write one layer per level, merged, as OASIS and DXF, and a table of doses.
        plates: Files of the photomasks: GDSII packed by gzip, or plain.
        combined_gds: Write the layout of all layers as GDSII, too, and not only as OASIS.
        mesh_cells: Most columns of the mesh of the whole relief along x and y, up to 1000.
        one_to_one: Take plates at 1:1 for a stepper, too, from which the mask shop makes its reticles.
        overwrite: Where the folder has the order of another design, replace that order.
    """
    if as_built is not None:
        fixed: dict[str, object] = {"levels": levels, "step": step, "etch_depths": etch_depths, "pitch": pitch}
        fixed |= {"scale": scale, "aperture": aperture, "wafer": wafer, "terms": terms, "probe": probe}
        rule = "does not go with --as-built"
        refuse_options(masks, fixed, rule, "Leave it out: the order has its own.")
        drawn: dict[str, object] = {"out": out, "patch": patch, "mesh_patch": mesh_patch, "on_violation": on_violation}
        drawn |= {"plates": plates, "mesh_cells": mesh_cells, "direct_write": direct_write}
        drawn |= {"combined_gds": combined_gds, "one_to_one": one_to_one, "overwrite": overwrite}
        refuse_options(masks, drawn, rule, "Leave it out: nothing is drawn.")
        _predict_as_built(source, as_built, order, process, json_)
        return
    if order is not None:
        raise InputError("--order", "goes with --as-built only", order, "Leave it out.")
    if probe is not None and not source.is_dir():
        rule = "goes with a run, which says what light and what glass"
        raise InputError("--probe", rule, f"{probe} for {source}", "Leave it out.")
    from doedesign.runs.folder import require_relief

    require_relief(source)  # before heavy packages are loaded
    from doedesign.lab.order import PROBE_M, drawn_as, write_masks
    from doedesign.runs.costs import measured
    from fab.order.formats import Formats

    probe_m = length_of("--probe", probe)
    with measured(source if source.is_dir() else None, "masks", writes=out or Path("masks")) as taken:
        done = write_masks(
            source,
            out,
            levels=levels,
            on_violation=on_violation,
            probe_m=PROBE_M if probe_m is None else probe_m,
            patch=_patch(patch, mesh_patch),
            formats=Formats(plates, combined_gds, mesh_cells),
            overwrite=overwrite,
            one_to_one=one_to_one,
            process=process,
            wafer=wafer,
            terms=terms,
            direct_write=direct_write,
            step_m=length_of("--step", step),
            etch_depths_m=[
                length_of("--etch-depths", depth) or 0.0 for depth in (etch_depths or "").split(",") if depth
            ],
            pitch_m=length_of("--pitch", pitch),
            scale_m=length_of("--scale", scale),
            aperture_m=_aperture(aperture),
        )
    say(f"{len(done.report.checks)} checks passed: every pixel of every file is {drawn_as(done)}")
    print_results(done.folder, json_, checks=len(done.report.checks))
    say_closing(done.folder, source if source.is_dir() else None, taken)


def _predict_as_built(run: Path, sheet: Path, order: Path | None, process: str | None, as_json: bool) -> None:
    """Predict the plate of a filled run sheet into RUN/as-built."""
    from doedesign.lab.as_built import as_built as predict
    from doedesign.runs.costs import measured

    folder = run / "as-built"
    with measured(run, "masks") as taken:
        predict(run, sheet, order, process=process, out=folder)
    print_results(folder, as_json)
    say_closing(folder, run, taken)


def _aperture(text: str | None) -> list[float] | str | None:
    """One length, or width and height, in metres; or the name of a picture."""
    from fab.aperture.picture import MASK_FILES

    if text is not None and text.lower().endswith(MASK_FILES):
        return text
    found = [length_of("--aperture", size.strip()) for size in (text or "").split(",") if size.strip()]
    return [size for size in found if size is not None] or None


def verify(order: Path, *, json_: AsJson = False) -> None:
    """Prove a mask order from its files alone; exit 1 names what differs.

    Args:
        order: Folder that masks wrote.
    """
    _require_order(order)
    from fab.order.verify import verify as work

    report = work(order)
    if json_:
        checks = [{"file": c.file, "question": c.question, "problems": list(c.problems)} for c in report.checks]
        print_text(json.dumps({"passed": report.passed, "checks": checks, "notes": list(report.notes)}))
    report.require()
    for note in report.notes:
        say(note)
    say(f"{len(report.checks)} checks passed")
    say_closing(order)


def _require_order(folder: Path) -> None:
    """Refuse what is no folder, and a run where its mask order is wanted, and propose that."""
    rule = "must be the folder of a mask order"
    if not folder.is_dir():
        got = "a file" if folder.exists() else "no folder"
        raise InputError(str(folder), rule, got, "Draw one with: doedesign masks RUN")
    from doedesign.overview.kinds import record_of
    from doedesign.runs.orders import is_made_from, order_of_run, own_level_map
    from fab.files import MANIFEST_NAME

    record = record_of(folder) if (folder / MANIFEST_NAME).is_file() else None
    if record is None or record.kind not in ("run", "training", "released model"):
        return
    own = own_level_map(folder)
    place = order_of_run(record.name, folder, own)
    draw = f"Draw its order first: doedesign {shlex.join(words_to_draw(record.name, folder))}."
    cure = f"Give its order: {place}." if own is not None and is_made_from(place, own) else draw
    raise InputError(str(folder), rule, "a run", cure)


def _patch(step: str | None, mesh: str | None) -> Any:
    """The patch of --patch or --mesh-patch, or None."""
    if step is not None and mesh is not None:
        raise InputError("--mesh-patch", "does not go with --patch", mesh, "Leave one out; --patch writes both kinds.")
    option, text = ("--mesh-patch", mesh) if step is None else ("--patch", step)
    if text is None:
        return None
    from fab.solids.patch import Patch

    lengths = [length_of(option, part.strip()) or 0.0 for part in text.split(",")]
    if len(lengths) != 3:
        cure = f'Write x and y of its middle and its edge: {option} "0 um, 100 um, 50 um".'
        raise InputError(option, "must be three lengths", f'"{text}"', cure)
    return Patch(*lengths, step=step is not None)
