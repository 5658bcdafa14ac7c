"""The command line. stdout is data (paths, or JSON with --json), stderr is talk.

Exit codes: 0 done, 1 a check failed, 2 bad input, 130 interrupted. Heavy packages are imported where they are used, so
that --help answers at once.
"""

import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, CycloptsError, Parameter

from doedesign import __version__
from fab.errors import CheckFailed, InputError

app = App(
    name="doedesign",
    help="Design diffractive optical elements and the masks that make them.",
    version=__version__,
    # Leave both to `exit_code`.
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)

Overrides = Annotated[
    tuple[str, ...], Parameter(name="--set", negative="", help="Change one value of the spec, KEY=VALUE.")
]
AsJson = Annotated[bool, Parameter(name="--json", negative="", help="Print JSON instead of paths.")]


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _print(text: str) -> None:
    """Print a result; what the terminal's encoding lacks is escaped."""
    encoding = sys.stdout.encoding or "utf-8"
    try:
        print(text.encode(encoding, "backslashreplace").decode(encoding), flush=True)
    except OSError as error:
        # What could not be printed would be tried again, and fail again, when Python ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):  # a reader that has seen enough is no error
            raise


def _print_paths(paths: Sequence[Path], as_json: bool, **more: Any) -> None:
    names = [str(path) for path in paths]
    _print(json.dumps({"paths": names, **more}, sort_keys=True) if as_json else "\n".join(names))


def _length(option: str, text: str | None) -> float | None:
    if text is None:
        return None
    from fab.units import parse_length

    try:
        return parse_length(text)
    except ValueError as error:
        raise InputError(option, "must be a length with a unit", f'"{text}"', 'For example "75 nm".') from error


def _patch(step: str | None, mesh: str | None) -> Any:
    """The patch of --patch or --mesh-patch, or None."""
    if step is not None and mesh is not None:
        raise InputError("--mesh-patch", "does not go with --patch", mesh, "Leave one out; --patch writes both kinds.")
    option, text = ("--mesh-patch", mesh) if step is None else ("--patch", step)
    if text is None:
        return None
    from fab.patch import Patch

    lengths = [_length(option, part.strip()) or 0.0 for part in text.split(",")]
    if len(lengths) != 3:
        cure = f'Write x and y of its middle and its edge: {option} "0 um, 100 um, 50 um".'
        raise InputError(option, "must be three lengths", f'"{text}"', cure)
    return Patch(*lengths, step=step is not None)


@app.command
def optimize(spec: Path, *, out: Path | None = None, set_: Overrides = (), json_: AsJson = False) -> None:
    """Optimise a spec into a run folder, or resume it where it was stopped.

    Args:
        spec: TOML spec, such as examples/automotive.toml.
        out: Run folder; runs/NAME by default.
    """
    from doedesign.commands.optimize import optimize as work
    from doedesign.spec import load_spec, spec_warnings

    for warning in spec_warnings(load_spec(spec, set_)):
        _say(f"warning: {warning}")
    run = work(spec, out, set_, _say)
    _print_paths([run.folder], json_, metrics=str(run.path("metrics.json")))


@app.command
def masks(
    source: Path,
    *,
    levels: int | None = None,
    out: Path | None = None,
    step: str | None = None,
    etch_depths: str | None = None,
    pitch_um: float | None = None,
    scale: str | None = None,
    aperture: str | None = None,
    on_violation: Literal["warn", "fail", "fix"] = "warn",
    probe: str | None = None,
    patch: str | None = None,
    mesh_patch: str | None = None,
    as_built: Path | None = None,
    order: Path | None = None,
    process: Path | None = None,
    wafer: Path | None = None,
    json_: AsJson = False,
) -> None:
    """Write the mask order of a run or of any height map, and prove it by reading it back.

    With --as-built, take the filled run sheet of a finished wafer instead and predict its plate into RUN/as-built.

    Args:
        source: Run folder, or a height map (.exr, .npy, .tif, .png).
        levels: Number of heights; the run's own by default.
        out: Order folder; masks/NAME by default.
        step: Height of one level, such as "75 nm"; for a bare height map.
        etch_depths: Depth of every mask where it is not 2^k steps, such as "80 nm,150 nm"; for a bare height map.
        pitch_um: Pixel pitch of a bare height map in micrometres.
        scale: Height of one count of an integer map, such as "1 nm".
        aperture: Diameter of the relief; the map's shorter side by default.
        on_violation: Where the process cannot print a mask: warn, fail, or fix the level map and say what it costs.
        probe: Wavelength of the laser that the lab tests the plate with; 520 nm by default.
        patch: Also write a window of the relief, "X, Y, EDGE" about its middle, as STEP (at most 2000 boxes) and mesh.
        mesh_patch: Also write a window of the relief as a mesh alone, up to 1000 x 1000 pixels.
        as_built: JSON of the run sheet with measured numbers filled in.
        order: With --as-built, the order that was made; masks/NAME by default.
        process: A TOML file with another [process] table; with --as-built, for what was not measured.
        wafer: A TOML file with another [wafer] table.
    """
    if as_built is not None:
        if wafer is not None:
            raise InputError("--wafer", "does not go with --as-built", wafer, "Leave it out: the order has its wafer.")
        from doedesign.commands.asbuilt import as_built as work

        folder = work(source, as_built, order, process=process, say=_say)
        _print_paths([folder, *sorted(folder.iterdir())], json_)
        return
    if order is not None:
        raise InputError("--order", "goes with --as-built only", order, "Leave it out.")
    from doedesign.commands.masks import write_masks
    from doedesign.drawing import level_map_from
    from doedesign.outlook import PROBE_M

    drawing = level_map_from(
        source,
        levels,
        step_m=_length("--step", step),
        depths_m=[_length("--etch-depths", depth) or 0.0 for depth in (etch_depths or "").split(",") if depth],
        pitch_m=None if pitch_um is None else pitch_um * 1e-6,
        scale_m=_length("--scale", scale),
        aperture_m=_length("--aperture", aperture),
    )
    probe_m = PROBE_M if probe is None else _length("--probe", probe) or PROBE_M
    window = _patch(patch, mesh_patch)
    folder, report = write_masks(
        source,
        drawing,
        out,
        on_violation=on_violation,
        probe_m=probe_m,
        patch=window,
        process_file=process,
        wafer_file=wafer,
        say=_say,
    )
    _say(f"{len(report.checks)} checks passed: every pixel of every file is as designed")
    _print_paths([folder, *sorted(folder.iterdir())], json_, checks=len(report.checks))


@app.command
def verify(order: Path, *, json_: AsJson = False) -> None:
    """Prove a mask order from its files alone; exit 1 names what differs.

    Args:
        order: Folder that masks wrote.
    """
    from doedesign.commands.masks import verify as work

    report = work(order)
    if json_:
        checks = [{"file": c.file, "question": c.question, "problems": list(c.problems)} for c in report.checks]
        _print(json.dumps({"passed": report.passed, "checks": checks}))
    report.require()
    _say(f"{len(report.checks)} checks passed")


@app.command
def psf(
    run: Path,
    *,
    masks: Path | None = None,
    depths: tuple[str, ...] = (),
    field_deg: tuple[float, float] = (0.0, 0.0),
    fabricated: Annotated[bool, Parameter(negative="")] = False,
    process: Path | None = None,
    variation: Path | None = None,
    seed: int | None = None,
    draw: str = "normal/0",
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
        process: TOML file with a [process] table; the run's own by default.
        variation: TOML file with the errors of the plate.
        seed: Draw the errors of the plate from the process.
        draw: Which draw of the seed, as in a tolerance study.
    """
    if fabricated:
        if depths or any(field_deg):
            option = "--depths" if depths else "--field-deg"
            cure = "Leave it out; the depths are those of the spec, on the axis."
            raise InputError(option, "does not go with --fabricated", "a value", cure)
        from doedesign.commands.fabricated import fabricated as predict

        folder = predict(run, masks, process=process, variation=variation, seed=seed, draw=draw, say=_say)
        _print_paths([folder, *sorted(folder.iterdir())], json_)
        return
    if process is not None or variation is not None or seed is not None:
        raise InputError("--fabricated", "must be given with --process, --variation or --seed", "not there", "Add it.")
    from math import inf, radians

    from doedesign.commands.psf import psf as work

    depths_m = [inf if text == "inf" else _length("--depths", text) or 0.0 for text in depths]
    if any(not z > 0 for z in depths_m):
        raise InputError("--depths", "must be positive", ", ".join(depths), 'For example --depths "5 cm".')
    if not all(abs(angle) <= 60 for angle in field_deg):
        raise InputError("--field-deg", "must lie within 60 degrees", field_deg, "A thin lens says nothing beyond.")
    folder = work(run, masks, depths_m, (radians(field_deg[0]), radians(field_deg[1])), _say)
    _print_paths([folder, *sorted(folder.iterdir())], json_)


@app.command
def tolerance(
    run: Path,
    *,
    draws: int = 100,
    seed: int = 0,
    sensitivity: Literal["one_at_a_time", "sobol", "none"] = "one_at_a_time",
    sobol: int = 64,
    corners: Annotated[bool, Parameter(negative="")] = False,
    budget: str | None = None,
    yield_: Annotated[float, Parameter(name="--yield")] = 0.9,
    limit: Annotated[tuple[str, ...], Parameter(negative="")] = (),
    process: Path | None = None,
    masks: Path | None = None,
    draw: str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    out: Path | None = None,
    json_: AsJson = False,
) -> None:
    """Study what the errors of a process make of a run: yield, which errors matter, and how large they may be.

    Args:
        run: Run folder.
        draws: Plates of the Monte-Carlo study, and per point of the budget.
        seed: Seed of every draw.
        sensitivity: Which errors matter, each alone or as shares of variance.
        sobol: Rows of the samples behind Sobol indices, a power of two; each costs sources + 2 plates.
        corners: Look at worst-case corners, too.
        budget: Errors for which the largest sigma is sought, such as overlay, overlay_x or overlay_x[3].
        yield_: Yield that the budget is for.
        limit: What a good plate obeys, such as "zeroth_order <= 5 %"; the spec's limits by default.
        process: TOML file with a [process] table; the run's own by default.
        masks: Its mask order; masks/NAME by default.
        draw: Repeat a single plate, such as normal/17, and print its errors as TOML and its numbers.
        workers: Worker processes; as many as there are cores and memory for by default.
        scheduler: Address of a Dask scheduler whose workers are taken instead.
        out: Folder; RUN/tolerance by default. The same command resumes a stopped study.
    """
    from doedesign.commands.tolerance import Plan, one_draw
    from doedesign.commands.tolerance import tolerance as work

    settings = {"process": process, "limits": limit or None, "seed": seed, "masks": masks, "scheduler": scheduler}
    if draw is not None:
        _print(one_draw(run, draw, json_, **settings).rstrip())
        return
    plan = Plan(draws, sensitivity, sobol, corners, budget, yield_)
    folder = work(run, plan, out, _say, workers=workers, **settings)
    _print_paths([folder, *sorted(folder.iterdir())], json_, results=str(folder / "results.json"))


@app.command
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
    fabricated: Annotated[bool, Parameter(negative="")] = False,
    process: Path | None = None,
    variation: Path | None = None,
    plate_seed: int | None = None,
    draw: str = "normal/0",
    masks: Path | None = None,
    png: Annotated[bool, Parameter(negative="")] = False,
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
        process: With --fabricated, a TOML file with a [process] table; the run's own by default.
        variation: With --fabricated, a TOML file with the errors of the plate.
        plate_seed: With --fabricated, draw the errors of the plate from the process.
        draw: With --plate-seed, which draw, as in a tolerance study.
        masks: The run's mask order; masks/NAME by default.
        png: Write 16-bit PNG instead of EXR.
    """
    if not fabricated and (process is not None or variation is not None or plate_seed is not None):
        rule = "must be given with --process, --variation or --plate-seed"
        raise InputError("--fabricated", rule, "not there", "Add it.")
    from doedesign.commands.simulate import Fabrication, Request
    from doedesign.commands.simulate import simulate as work

    request = Request(images, obstruction, occlusion, count, seed, size, set_, png)
    plate = Fabrication(process, variation, plate_seed, draw) if fabricated else None
    done = work(run, out, request, masks=masks, fabrication=plate, say=_say)
    paths = [done.folder, *(done.folder / name for name in ("contact.png", "manifest.json", *done.items))]
    _print_paths(paths, json_, items=list(done.items), skipped=done.skipped)


@app.command
def train(
    run: Path,
    *,
    images: Path | None = None,
    occlusion: str | None = None,
    obstruction: str | None = None,
    out: Path | None = None,
    validation: Path | None = None,
    lpips_weights: Annotated[tuple[Path, ...], Parameter(negative="")] = (),
    licence: str | None = None,
    tensorboard: Annotated[bool, Parameter(negative="")] = False,
    devices: int | None = None,
    coordinator: str | None = None,
    hosts: int | None = None,
    host: int | None = None,
    set_: Overrides = (),
    json_: AsJson = False,
) -> None:
    """Train the reconstruction network, jointly with the optics unless those are frozen.

    Args:
        run: Run folder; its design is where the optics begin.
        images: Folder of pictures; sample pictures of scikit-image by default.
        occlusion: radiometric, reciprocal, paper or paper_release; the spec's by default.
        obstruction: Kind, such as dirt, raindrop or fence, or a folder of masks; the spec's by default.
        out: Folder; RUN/trained by default. The same command resumes a stopped training.
        validation: Folder to hold pictures out from; the same folder by default.
        lpips_weights: Files with the weights of LPIPS; multi-scale SSIM stands in without them.
        licence: Licence of the pictures, for the record.
        tensorboard: Write for TensorBoard, too.
        devices: Number of devices; all by default.
        coordinator: With several hosts, HOST:PORT of host 0, or auto where the cluster tells (SLURM, Open MPI).
        hosts: Number of hosts; each runs this command, and all see the same folders.
        host: Number of this host, from 0.
    """
    from doedesign.commands.train import Request
    from doedesign.commands.train import train as work

    several = coordinator, hosts, host
    request = Request(
        images, validation, set_, lpips_weights, licence, tensorboard, devices, occlusion, obstruction, *several
    )
    folder = work(run, out, request, _say)
    _print_paths([folder, *sorted(folder.iterdir())], json_, metrics=str(folder / "metrics.json"))


PsfFiles = Annotated[
    tuple[Path, ...],
    Parameter(
        name="--psf",
        negative="",
        help="PSFs other than the model's: one bank, or first a file of the scene and then one of the obstruction.",
    ),
]
PixelPitch = Annotated[str | None, Parameter(help='Pixel pitch of PSFs from another program, such as "3.7 um".')]
NearDepth = Annotated[
    str | None,
    Parameter(
        help='Distance of the obstruction, such as "7 cm"; the middle, in 1/z, of those trained on by default.',
    ),
]
FarDepth = Annotated[
    str | None,
    Parameter(help='Distance of the scene, such as "5 m" or inf; the farthest there is a PSF of by default.'),
]


def _psf_choice(files: Sequence[Path], pixel: str | None, near: str | None, far: str | None) -> Any:
    """The PSFs of --psf, --pixel, --near-depth and --far-depth."""
    from math import inf

    from doedesign.recon.model import PsfChoice

    pixel_m, near_m = _length("--pixel", pixel), _length("--near-depth", near)
    if pixel_m is not None and not pixel_m > 0:
        raise InputError("--pixel", "must be positive", f'"{pixel}"', 'For example --pixel "3.7 um".')
    return PsfChoice(files, pixel_m, near_m, inf if far == "inf" else _length("--far-depth", far))


@app.command
def finetune(
    run: Path,
    *,
    pairs: Path,
    psf: PsfFiles = (),
    pixel: PixelPitch = None,
    near_depth: NearDepth = None,
    far_depth: FarDepth = None,
    out: Path | None = None,
    steps: int = 2000,
    learning_rate: float | None = None,
    seed: int = 0,
    validation: int | None = None,
    size: int | None = None,
    lpips_weights: Annotated[tuple[Path, ...], Parameter(negative="")] = (),
    linear: bool | None = None,
    mirror: bool = True,
    json_: AsJson = False,
) -> None:
    """Fine-tune a trained network on real pairs of capture and reference; the result is a model for reconstruct.

    Args:
        run: Run folder with a training, or the folder of a model.
        pairs: Folder with NAME_capture.* and NAME_reference.* (and NAME_mask.* where it is known), or with folders
            capture, reference and mask.
        out: Folder; RUN/finetuned by default. The same command resumes a stopped fine-tuning.
        steps: Steps.
        learning_rate: First step size of the network; a tenth of that of its training by default.
        seed: Seed of everything random.
        validation: Pairs that are never trained on; a fifth, and at most eight, by default.
        size: Pixels per side of a crop; those of its training by default, and at most what every pair has.
        lpips_weights: Files with the weights of LPIPS; multi-scale SSIM stands in without them.
        linear: Whether PNG and TIFF hold linear light; by default those of 8 and 16 bits hold display values.
        mirror: Exchange left and right at random, of captures and PSFs.
    """
    from doedesign.commands.finetune import Request
    from doedesign.commands.finetune import finetune as work

    choice = _psf_choice(psf, pixel, near_depth, far_depth)
    request = Request(choice, steps, learning_rate, seed, validation, size, lpips_weights, linear, mirror)
    folder = work(run, pairs, out, request, _say)
    _print_paths([folder, *sorted(folder.iterdir())], json_, metrics=str(folder / "metrics.json"))


@app.command(usage="Usage: doedesign reconstruct [OPTIONS] [RUN] CAPTURE...")
def reconstruct(
    run: Path,
    captures: Annotated[tuple[Path, ...], Parameter(negative="")] = (),
    /,
    *,
    out: Path | None = None,
    psf: PsfFiles = (),
    pixel: PixelPitch = None,
    near_depth: NearDepth = None,
    far_depth: FarDepth = None,
    tile: int | None = None,
    overlap: int | None = None,
    linear: bool | None = None,
    kind: str | None = None,
    beside: Annotated[bool, Parameter(negative="")] = False,
    json_: AsJson = False,
) -> None:
    """Reconstruct what captures show behind their obstruction. With captures alone, the released model is taken.

    Args:
        run: Run folder with a training, or the folder of a model; may be left out.
        captures: PNG, TIFF, EXR or RAW files of any size.
        out: Folder; "reconstructed" by default. A later call adds to it.
        tile: The most pixels of a tile's side; 1536 by default. Less takes less memory.
        overlap: Pixels that tiles share; 256 by default.
        linear: Whether PNG and TIFF hold linear light; by default those of 8 and 16 bits hold display values.
        kind: Kind of the results: png, tif or exr; that of the capture by default.
        beside: Draw every capture and its reconstruction side by side, too.
    """
    from dataclasses import replace

    from doedesign.commands.reconstruct import Request, model_and_captures
    from doedesign.commands.reconstruct import reconstruct as work

    model, files = model_and_captures([run, *captures])
    ending = None if kind is None else f".{kind.lower().removeprefix('.')}"
    request = Request(_psf_choice(psf, pixel, near_depth, far_depth), linear=linear, kind=ending, beside=beside)
    given = {name: value for name, value in (("tile", tile), ("overlap", overlap)) if value is not None}
    paths = work(model, files, out, replace(request, **given), say=_say)
    _print_paths(paths, json_)


@app.command
def calibrate(
    run: Path,
    measurement: Path | None = None,
    *,
    errors: Annotated[tuple[str, ...], Parameter(negative="")] = (),
    process: Path | None = None,
    masks: Path | None = None,
    evaluations: int = 60,
    polish: int = 0,
    seed: int = 0,
    ring_to_disc: float | None = None,
    throughput: float | None = None,
    throughput_sigma: float = 0.02,
    probe: str | None = None,
    depth: str | None = None,
    pairs: bool = True,
    reach: float = 4.0,
    out: Path | None = None,
    json_: AsJson = False,
) -> None:
    """Find the process errors that explain measured PSFs, or list those that would explain a measured ring:disc ratio.

    With MEASUREMENT, the errors of the plate with their uncertainty go into process-estimate.toml. With --ring-to-disc
    instead, every error and pair of errors is found that would give this ratio.

    Args:
        run: Run folder.
        measurement: TOML file that names the images and says how they were taken.
        errors: Errors to look for, such as depth, overlay_x or cd_bias[3]; by default depth, line width and overlay.
        process: TOML file with a [process] table, for what is believed beforehand; the run's own by default.
        masks: The run's mask order; masks/NAME by default.
        evaluations: Plates of the global search, which begins only if it is needed.
        polish: Exact gradients to follow at the end.
        seed: Seed of the global search.
        ring_to_disc: Measured ratio of the energy outside the geometric defocus disc to that inside.
        throughput: Measured share of the light that arrives in the sensor window, 0-1.
        throughput_sigma: Its standard deviation.
        probe: Wavelength at which the ratio was measured, such as "520 nm".
        depth: Depth at which it was measured, such as "10 cm".
        pairs: Look at two errors together, too.
        reach: Standard deviations to look at.
        out: Folder; RUN/calibration or RUN/explanations by default.
    """
    if (measurement is None) == (ring_to_disc is None):
        got = "neither" if measurement is None else "both"
        cure = "Give the measurement's TOML file, or --ring-to-disc with --probe and --depth."
        raise InputError("calibrate", "must be given a measurement or a ring:disc ratio", got, cure)
    if measurement is not None:
        from doedesign.commands.calibrate import calibrate as fit

        settings = {"process": process, "masks": masks, "evaluations": evaluations, "polish": polish, "seed": seed}
        folder, result = fit(run, measurement, errors, **settings, out=out, say=_say)
        estimate = str(folder / "process-estimate.toml")
        _print_paths([folder, *sorted(folder.iterdir())], json_, estimate=estimate, explained=result.explained)
        return
    from doedesign.calibrate import Targets
    from doedesign.commands.calibrate import explain

    lengths = {}
    for option, text, example in (("--probe", probe, "520 nm"), ("--depth", depth, "10 cm")):
        if text is None:
            raise InputError(
                option, "must be given with --ring-to-disc", "nothing", f'For example {option} "{example}".'
            )
        lengths[option] = _length(option, text)
        if not lengths[option] > 0:
            raise InputError(option, "must be positive", text, f'For example {option} "{example}".')
    if throughput is not None and not 0 < throughput <= 1:
        raise InputError("--throughput", "must be a share of the light, above 0 and up to 1", throughput, "Write 0.86.")
    if not (throughput_sigma > 0 and reach > 0):
        raise InputError("--throughput-sigma, --reach", "must be positive", (throughput_sigma, reach), "Correct them.")
    targets = Targets(lengths["--probe"], lengths["--depth"], ring_to_disc or 0.0, throughput, throughput_sigma)
    folder, _ = explain(run, targets, errors, process=process, masks=masks, pairs=pairs, reach=reach, out=out, say=_say)
    _print_paths([folder, *sorted(folder.iterdir())], json_)


def exit_code(work: Callable[[], Any]) -> int:
    """Run a command's work; tell a user's mistake in one message instead of a traceback.

    Returns:
        0 done, 1 a check failed, 2 bad input, 130 interrupted.
    """
    try:
        work()
    except InputError as error:
        _say(f"doedesign: {error}")
        return 2
    except CheckFailed as error:
        _say(f"doedesign: check failed\n{error}")
        return 1
    except CycloptsError as error:
        _say(f"doedesign: {error}\nTry: doedesign --help")
        return 2
    except KeyboardInterrupt:
        _say("doedesign: interrupted; what was finished is kept, the same command goes on from there")
        return 130
    except BrokenPipeError:  # nobody listens to stderr any more
        return 130
    except OSError as error:
        from fab.files import explain_os_error

        if error.filename is None and error.errno is None:
            raise
        _say(f"doedesign: {explain_os_error(error, str(error.filename or 'output'))}")
        return 2
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the `doedesign` command."""
    return exit_code(lambda: app(arguments, exit_on_error=False, print_error=False))


if __name__ == "__main__":
    sys.exit(main())
