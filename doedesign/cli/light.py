"""PSFs, certificate and captures of a design: psf, certify, simulate."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from doedesign.cli.closing import say_closing
from doedesign.cli.console import print_paths, print_results
from doedesign.cli.options import AsJson, Flag, Overrides, Texts, length_of
from fab.errors import InputError


def psf(
    run: Path,
    *,
    masks: Path | None = None,
    depths: Texts = (),
    field_deg: Annotated[tuple[float, float], Parameter(negative="")] = (0.0, 0.0),
    fabricated: Flag = False,
    process: str | None = None,
    variation: Path | None = None,
    seed: int | None = None,
    draw: str | None = None,
    json_: AsJson = False,
) -> None:
    """Compute PSF banks and pictures of the continuous, the quantised and the drawn design.

    With --fabricated, those of one plate as the process makes it: with the errors of --variation, those of --seed, or
    each at its mean.

    Args:
        run: Run folder.
        masks: Its mask order; masks/NAME by default.
        depths: Source depths, such as "5 cm" or inf; the spec's by default.
        field_deg: Field angles along y and x in degrees.
        fabricated: Predict a plate as fabricated, into RUN/fabricated.
        process: TOML file with a [process] table, or the name of a stock process; the run's own by default.
        variation: TOML file with the errors of the plate.
        seed: Draw the errors of the plate from the process.
        draw: Which draw of the seed, as in a tolerance study; normal/0 by default.
    """
    from doedesign.runs.costs import measured

    if draw is not None and seed is None:
        raise InputError("--draw", "must be given with --seed", draw, "Add --fabricated and --seed, or leave it out.")
    if fabricated:
        if depths or any(field_deg):
            option = "--depths" if depths else "--field-deg"
            cure = "Leave it out; the depths are those of the spec, on the axis."
            raise InputError(option, "does not go with --fabricated", "a value", cure)
        from doedesign.runs.fabricated import fabricated as predict

        folder = run / "fabricated"
        chosen = {} if draw is None else {"draw": draw}
        with measured(run, "psf") as taken:
            predict(run, masks, process=process, variation=variation, seed=seed, out=folder, **chosen)
        print_results(folder, json_)
        say_closing(folder, run, taken)
        return
    if process is not None or variation is not None or seed is not None:
        raise InputError("--fabricated", "must be given with --process, --variation or --seed", "not there", "Add it.")
    from math import degrees, inf, radians

    from doedesign.runs.psfs import psfs
    from sim.psf_bank import WIDEST_RAD

    depths_m = [inf if text == "inf" else length_of("--depths", text) or 0.0 for text in depths]
    if any(not z > 0 for z in depths_m):
        raise InputError("--depths", "must be positive", ", ".join(depths), 'For example --depths "5 cm".')
    if not all(abs(radians(angle)) <= WIDEST_RAD for angle in field_deg):
        rule = f"must lie within {degrees(WIDEST_RAD):.3g} degrees"
        raise InputError("--field-deg", rule, field_deg, "A thin lens says nothing beyond.")
    folder = run / "psf"
    with measured(run, "psf") as taken:
        psfs(run, masks, depths_m, (radians(field_deg[0]), radians(field_deg[1])), folder)
    print_results(folder, json_)
    say_closing(folder, run, taken)


def certify(
    run: Path,
    *,
    masks: Path | None = None,
    cells: int = 24,
    pieces: int = 3,
    side: int = 2,
    json_: AsJson = False,
) -> None:
    """Prove what light does at the walls of a design: parts of it against Maxwell's equations.

    Rows of cells and small squares are solved rigorously, in both polarisations, and compared with the design as a thin
    element and with the light of its edges; the whole design is computed both ways.

    Args:
        run: Run folder.
        masks: Its mask order; masks/NAME by default.
        cells: Cells of a row, 4 to 64; time grows with their third power.
        pieces: Number of squares, 0 to 13.
        side: Cells of a square's side, 2 to 4; time grows with their sixth power.
    """
    from doedesign.runs.certificate import certify as prove
    from doedesign.runs.costs import measured

    folder = run / "certificate"
    with measured(run, "certify") as taken:
        prove(run, masks, cells=cells, pieces=pieces, side=side, out=folder)
    print_results(folder, json_)
    say_closing(folder, run, taken)


def simulate(
    run: Path,
    *,
    images: Path | None = None,
    obstruction: str | None = None,
    occlusion: str | None = None,
    out: Path | None = None,
    count: int | None = None,
    seed: int = 0,
    size: int | None = None,
    fabricated: Flag = False,
    process: str | None = None,
    variation: Path | None = None,
    plate_seed: int | None = None,
    draw: str | None = None,
    masks: Path | None = None,
    png: Flag = False,
    set_: Overrides = (),
    json_: AsJson = False,
) -> None:
    """Photograph pictures through dirt, drops or a fence, with the plate of a run and without.

    Writes clean scenes, conventional and DOE captures, masks, alpha, depth, and a contact sheet.

    Args:
        run: Run folder.
        images: Folder of pictures; sample pictures of scikit-image by default.
        obstruction: Kind, such as dirt, raindrop or fence, or a folder of masks; the spec's by default.
        occlusion: radiometric, reciprocal, paper or paper_release; the spec's by default, which has no default.
        out: Folder; RUN/simulated by default. The same command resumes a stopped simulation.
        count: Number of items; one per picture and at most six by default.
        seed: Seed of everything.
        size: Binned pixels per side of a frame; 512 by default, or what the sensor has.
        fabricated: Look through a plate with errors: those of --variation, of --plate-seed, or the process's means.
        process: With --fabricated, a TOML file with a [process] table, or the name of a stock process; the run's own by
            default.
        variation: With --fabricated, a TOML file with the errors of the plate.
        plate_seed: With --fabricated, draw the errors of the plate from the process.
        draw: With --plate-seed, which draw, as in a tolerance study; normal/0 by default.
        masks: The run's mask order; masks/NAME by default.
        png: Write 16-bit PNG instead of EXR.
    """
    if not fabricated and (process is not None or variation is not None or plate_seed is not None):
        rule = "must be given with --process, --variation or --plate-seed"
        raise InputError("--fabricated", rule, "not there", "Add it.")
    if draw is not None and plate_seed is None:
        raise InputError("--draw", "must be given with --plate-seed", draw, "Add that, or leave it out.")
    from doedesign.capture.folder import PlateErrors, simulate_files
    from doedesign.runs.costs import measured
    from doedesign.runs.level_maps import open_design

    design, plate = open_design(run, masks, overrides=set_), None
    if fabricated:
        made_by = design.process(process)
        chosen = {} if draw is None else {"draw": draw}
        plate = PlateErrors(made_by, *design.plate_errors(made_by, variation, plate_seed, **chosen))
    how = {"obstruction": obstruction, "occlusion": occlusion, "count": count, "seed": seed, "size": size, "png": png}
    folder = out or run / "simulated"
    with measured(run, "simulate", writes=folder) as taken:
        done = simulate_files(design, folder, images, plate=plate, **how)
    paths = [done.folder, *(done.folder / name for name in ("contact.png", "manifest.json", *done.items))]
    print_paths(paths, json_, items=list(done.items), skipped=done.skipped)
    say_closing(done.folder, run, taken)
