"""`doedesign train`: the reconstruction network, and the plate's height map with it unless that is frozen.

    OUT/
        manifest.json       what this was made with, and the digests of all results when done
        spec.toml           the spec with every default and override filled in
        pictures.json       names of all pictures, trained on and held out, and their licence
        checkpoint.npz      everything a step changes; only while the training is unfinished
        history.jsonl       one line per step (`doedesign.recon.history`)
        validation/         step_000500.png ...: held-out scenes as captured, as reconstructed, as they are
        network.npz         the trained network (`doedesign.recon.weights`)
        psf.exr             PSFs of the trained plate at the depths of the spec and at infinity
        height.exr          the plate as it is to be drawn; height_continuous.exr before rounding, where it was trained
        metrics.json        scores on held-out scenes
        curves.png          the history in one picture
        tensorboard/        with --tensorboard

The manifest says "running" until everything else is on the disk. A training that was stopped at any moment goes on from
its last checkpoint with the same command, and ends with the same bytes on the same machine (but for the seconds in its
history). SIGTERM and Ctrl-C end it after the step it is at, with a checkpoint.
"""

import os
import time
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax

from doedesign import __version__
from doedesign.build import camera_of
from doedesign.capture import obstruction_of, occlusion_of, plain_parameters
from doedesign.commands.psf import Say
from doedesign.images import Pictures, told_skips
from doedesign.progress import meter
from doedesign.recon.checkpoint import read_checkpoint, settled, write_checkpoint
from doedesign.recon.data import Batch, SceneData
from doedesign.recon.heldout import SCENE_SEED, split_pictures
from doedesign.recon.history import HISTORY_NAME, open_board, open_history, read_history, require_tensorboard
from doedesign.recon.perceptual import Perceptual, read_lpips
from doedesign.recon.similarity import MsSsim
from doedesign.recon.train import State, Trainer, devices_mesh, layout_of, rates_at
from doedesign.report.training import draw_training, draw_validation
from doedesign.runs import CHECKPOINT, Run, alone_in, open_run, spec_with
from doedesign.spec import Spec, spec_digest, spec_to_toml
from doedesign.stopping import Stop, stoppable
from doedesign.trained import HeldOut, heights_before, plate_at_rest, validate, write_results
from fab.errors import InputError
from fab.files import MANIFEST_NAME, canonical_json, read_json, sha256_bytes, sha256_file, write_atomic
from sim.obstruction import Kind, View

FORMAT = "doedesign training 1"

_FREE = ("scene", "sensor", "obstruction", "network", "train")
_MOST_THREADS = 8


@dataclass(frozen=True)
class Request:
    """What to train on.

    Attributes:
        images: folder of pictures; scikit-image's samples if None.
        validation: folder to take the held-out pictures from; the same one if None.
        overrides: changes to [scene], [sensor], [obstruction], [network] and [train] of the run's spec.
        lpips_weights: files with the weights of LPIPS; multi-scale SSIM stands in for it without them.
        licence: licence of the pictures, for the record.
        tensorboard: write for TensorBoard, too.
        devices: number of devices; all if None.
        occlusion: occlusion model; that of the spec if None.
        obstruction: kind, or folder of masks; that of the spec if None.
    """

    images: Path | None = None
    validation: Path | None = None
    overrides: Sequence[str] = ()
    lpips_weights: Sequence[Path] = ()
    licence: str | None = None
    tensorboard: bool = False
    devices: int | None = None
    occlusion: str | None = None
    obstruction: str | None = None


class Work(NamedTuple):
    """One training, before its folder is looked at.

    Attributes:
        run: the run, with the spec of the training.
        trainer: what a step does.
        kind: obstruction.
        data: scenes to train on.
        held_out: scenes to judge by.
        settings: everything that the result depends on.
        names: names of the pictures, and their licence.
    """

    run: Run
    trainer: Trainer
    kind: Kind
    data: SceneData
    held_out: HeldOut
    settings: dict[str, Any]
    names: dict[str, Any]

    def digest(self) -> str:
        """SHA-256 of the settings."""
        return sha256_bytes(canonical_json(self.settings))


def train(run_folder: Path, out: Path | None = None, request: Request | None = None, say: Say = lambda _: None) -> Path:
    """Train a run's network, or go on where an earlier call was stopped.

    Args:
        run_folder: a finished run.
        out: folder; RUN/trained by default.
        request: what to train on.
        say: told what is going on.

    Returns:
        the folder.

    Raises:
        InputError: a run, picture or number that cannot be used, a folder that belongs to something else, or a loss
            that is no longer finite.
        KeyboardInterrupt: it was stopped; the same call goes on from there.
    """
    request = request or Request()
    if request.tensorboard:
        require_tensorboard()
    folder, leads = out or run_folder / "trained", jax.process_index() == 0
    with stoppable() as stop:
        work = _prepared(open_run(run_folder), request, say)
        with alone_in(folder) if leads else nullcontext():
            if _is_done(folder, work.digest()):
                say(f"{folder} already holds this finished training")
                return folder
            if leads:
                _begin(folder, work, request)
            state = _iterate(folder, work, _resumed(folder, work, say), request, stop, say)
            if leads:
                say("judging the network and writing results")
                _finish(folder, work, state)
    if told := " ".join(filter(None, map(told_skips, (work.data.pictures, work.held_out.data.pictures)))):
        say(told)
    return folder


def _prepared(run: Run, request: Request, say: Say) -> Work:
    source = str(run.path("spec.toml"))
    run = replace(run, spec=spec_with(run, request.overrides, _FREE))
    spec, options = run.spec, run.spec.train
    model = occlusion_of(spec, source, request.occlusion)
    kind = obstruction_of(spec, source, request.obstruction)
    camera = camera_of(spec)
    view = View((options.size, options.size), camera.pixel_m, camera.sensor_distance_m)
    lpips, perceptual = _perceptual(spec, source, request.lpips_weights, say)
    _require_possible(spec, source)
    split = split_pictures(request.images, request.validation, options.validation, options.seed)
    far = (min(spec.scene.far_m), max(spec.scene.far_m))
    trained_on, held_out = (Pictures(files, most_px=2 * options.size, say=say) for files in split)
    threads = min(_MOST_THREADS, max(2, os.cpu_count() or 1))
    data = SceneData(trained_on, kind, view, far, options.seed, options.batch, threads)
    looks = HeldOut(SceneData(held_out, kind, view, far, SCENE_SEED, mirrored=False), options.validation, lpips)
    say("preparing propagation")
    # Objectives are done with, and the files that they name lie beside the spec that the run was made from.
    bare = spec.model_copy(update={"objectives": ()})
    at_rest = plate_at_rest(run, camera)
    mesh = devices_mesh(request.devices)
    trainer = Trainer.of(bare, {}, source, model, kind, at_rest, perceptual=perceptual, mesh=mesh)
    settings = {
        "format": FORMAT,
        "run": spec.name,
        "spec_sha256": spec_digest(spec),
        "height_sha256": sha256_file(run.path("height_continuous.exr")),
        "occlusion": model,
        "obstruction": getattr(kind, "name", type(kind).__name__),
        "obstruction_parameters": plain_parameters(kind),
        "camera": options.camera,
        "pictures_sha256": trained_on.digest(),
        "held_out_sha256": held_out.digest(),
        "perceptual": "none" if perceptual is None else perceptual.name,
        "perceptual_sha256": "" if perceptual is None else perceptual.digest,
        "units": "SI; light is linear with white 1; arrays [y, x], row 0 at the lowest y",
    }
    names = {"licence": request.licence} | {
        name: [_name(path, folder) for path in files]
        for name, files, folder in (
            ("training", split.training, request.images),
            ("held_out", split.held_out, request.validation or request.images),
        )
    }
    return Work(run, trainer, kind, data, looks, settings, names)


def _name(path: Path, folder: Path | None) -> str:
    return path.name if folder is None else path.relative_to(folder).as_posix()


def _perceptual(spec: Spec, source: str, files: Sequence[Path], say: Say) -> tuple[Any, Perceptual | None]:
    """LPIPS for scores, if its weights are at hand, and the distance of the loss."""
    lpips = read_lpips(files) if files else None
    if lpips is not None and spec.train.size < lpips.least_px:
        rule = f"{lpips.name} needs pictures of at least {lpips.least_px} pixels"
        raise InputError(f"{source}: train.size", rule, spec.train.size, "Enlarge it, or leave --lpips-weights out.")
    if not spec.train.perceptual:
        return lpips, None
    if lpips is None:
        say("warning: no --lpips-weights, so 1 - MS-SSIM stands in for the perceptual loss")
    return lpips, lpips or MsSsim()


def _require_possible(spec: Spec, source: str) -> None:
    """Refuse what the tables allow each for itself.

    Raises:
        InputError: a frame larger than the sensor, or a network that the camera's colours do not fit.
    """
    side = min(spec.sensor.resolution) // spec.sensor.binning
    if spec.train.size > side:
        rule = f"must be at most the {side} binned pixels of the sensor's shorter side"
        raise InputError(f"{source}: train.size", rule, spec.train.size, "Choose a smaller size.")
    try:
        layout_of(spec, len(spec.optics.colours))
    except ValueError as error:
        rule, _, got = str(error).partition(", but got ")
        raise InputError(f"{source}: network", rule.replace("`", ""), got, "Change [network].") from error


def _is_done(folder: Path, digest: str) -> bool:
    """Whether the training is finished; clear away what a killed one was writing.

    Raises:
        InputError: the folder is that of something else, or a result was changed.
    """
    for path in (folder / "validation").glob(".*"):
        path.unlink()
    path = folder / MANIFEST_NAME
    if not path.is_file():
        if folder.is_dir() and any(not each.name.startswith(".") for each in folder.iterdir()):
            rule = "a training needs a new or empty folder, or its own"
            raise InputError(str(folder), rule, "other content", "Choose another --out.")
        return False
    found = read_json(path)
    nothing_yet = {each.name for each in folder.iterdir()} <= {MANIFEST_NAME, "spec.toml", "pictures.json"}
    if found.get("format") == FORMAT and found.get("state") != "done" and nothing_yet:
        return False  # there is nothing to lose, whatever it was
    if found.get("format") != FORMAT or found.get("settings_sha256") != digest:
        got = "one with another run, spec, occlusion model, perceptual loss or other pictures"
        cure = "Choose another --out, or remove that folder."
        raise InputError(str(folder), "the folder must belong to this training", got, cure)
    if found["state"] != "done":
        return False
    for name, expected in found["results_sha256"].items():
        if sha256_file(folder / name) != expected:
            cure = f"Restore it, or remove {folder} and train again."
            raise InputError(str(folder / name), "must be the file this training wrote", "a changed file", cure)
    (folder / CHECKPOINT).unlink(missing_ok=True)  # it was killed just before
    return True


def _manifest(work: Work, state: str, **more: Any) -> bytes:
    said = {"settings_sha256": work.digest(), "state": state, "version": __version__, "licence": work.names["licence"]}
    return canonical_json({**work.settings, **said, **more})


def _begin(folder: Path, work: Work, request: Request) -> None:
    write_atomic(folder / MANIFEST_NAME, _manifest(work, "running"))
    comments = ["every default filled in", *(f"--set {override}" for override in request.overrides)]
    write_atomic(folder / "spec.toml", spec_to_toml(work.run.spec, comments).encode())
    write_atomic(folder / "pictures.json", canonical_json(work.names))


def _resumed(folder: Path, work: Work, say: Say) -> State:
    """The state to go on from."""
    start = settled(work.trainer.initial(heights_before(work.run, work.trainer)))
    stored = read_checkpoint(folder / CHECKPOINT, start, work.digest())
    if stored is None:
        return start
    state, step = stored
    say(f"resuming after step {step}")
    if (found := len(read_history(folder / HISTORY_NAME, step))) < step:
        say(f"warning: {HISTORY_NAME} lacks {step - found} of the {step} steps before")
    return state


def _iterate(folder: Path, work: Work, state: State, request: Request, stop: Stop, say: Say) -> State:
    """Take the remaining steps."""
    options, trainer, first, leads = work.run.spec.train, work.trainer, state.step, jax.process_index() == 0
    if first == options.steps:
        return state
    with ExitStack() as stack:
        batches = stack.enter_context(work.data.batches(first, options.steps))
        history = stack.enter_context(open_history(folder / HISTORY_NAME, first)) if leads else None
        wants_board = request.tensorboard and leads
        board = stack.enter_context(open_board(folder / "tensorboard", first)) if wants_board else None
        progress = stack.enter_context(meter("training", options.steps, first))
        stack.enter_context(stop.gently())
        begun = time.monotonic()
        for batch in batches:
            rates = rates_at(options, state.step)
            state, record = trainer.step(state, _part(batch))
            line: dict[str, Any] = {**record._asdict(), "learning_rates": rates._asdict()}
            if state.step % options.validate_every == 0 or state.step == options.steps:
                line["validation"] = _look(folder, work, state)
            now = time.monotonic()
            line["seconds"], begun = round(now - begun, 4), now
            for sink in filter(None, (history, board)):
                sink.add(line)
            progress.advance(state.step, f"loss {record.loss:.4f}")
            stopping = stop.agreed()
            if history and (stopping or state.step % options.checkpoint_every == 0 or state.step == options.steps):
                history.sync()
                write_checkpoint(folder / CHECKPOINT, state, state.step, work.digest())
            if stopping:
                say(f"stopped after step {state.step} of {options.steps}, with a checkpoint in {folder}")
                raise KeyboardInterrupt
    return state


def _part(batch: Batch) -> Batch:
    """This host's part of a batch."""
    hosts, here = jax.process_count(), jax.process_index()
    if hosts == 1:
        return batch
    count = len(batch.names) // hosts
    own = slice(here * count, (here + 1) * count)
    return batch._replace(**{name: getattr(batch, name)[own] for name in batch._fields if name != "step"})


def _look(folder: Path, work: Work, state: State) -> dict[str, Any]:
    """Look at held-out scenes; draw them, and return their scores."""
    found = validate(work.trainer, state, work.held_out)
    if jax.process_index() == 0:
        words = f"occlusion model {work.settings['occlusion']}, camera {work.settings['camera']}; PSNR in brackets: "
        words += "where it is covered"
        title = f"{work.run.spec.name}, step {state.step}"
        draw_validation(folder / "validation" / f"step_{state.step:06d}.png", found.rows, title, words)
    return found.means


def _finish(folder: Path, work: Work, state: State) -> None:
    """Write the results, and mark the training done; the checkpoint is no longer needed."""
    about = {**work.settings, "steps": state.step, "pictures": work.names, "version": __version__}
    names = write_results(folder, work.run, work.trainer, state, work.held_out, work.kind, about)
    records = read_history(folder / HISTORY_NAME, state.step)
    if records:
        draw_training(folder / "curves.png", records, work.run.spec.name)
        names += ["curves.png", HISTORY_NAME]
    names += ["spec.toml", "pictures.json"]
    digests = {name: sha256_file(folder / name) for name in sorted(names)}
    write_atomic(folder / MANIFEST_NAME, _manifest(work, "done", results_sha256=digests))
    (folder / CHECKPOINT).unlink(missing_ok=True)
