"""`doedesign train`: the reconstruction network, and the plate's height map with it unless that is frozen.

    OUT/
        manifest.json       what this was made with, and the digests of all results when done
        spec.toml           the spec with every default and override filled in
        pictures.json       names of all pictures, trained on and held out, and their licence
        checkpoint.npz      everything a step changes; only while the training is unfinished
        history.jsonl       one line per step (`doedesign.training.history`)
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
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax

from doedesign import __version__
from doedesign.build import camera_from_spec
from doedesign.capture.from_spec import obstruction_from_spec, occlusion_from_spec, plain_parameters
from doedesign.capture.images import Pictures
from doedesign.capture.scenes import Batch, SceneData
from doedesign.commands.psf import Say
from doedesign.report.history import plot_training
from doedesign.report.sheet import plot_validation
from doedesign.runs.folder import CHECKPOINT, TRAINING, Run, alone_in, open_run, spec_with
from doedesign.runtime.stopping import StopRequest, stoppable
from doedesign.spec import Spec, spec_digest, spec_to_toml
from doedesign.training.checkpoint import settled, write_checkpoint
from doedesign.training.history import HISTORY_NAME, read_history, require_tensorboard
from doedesign.training.hosts import gathered, join_hosts
from doedesign.training.joint import JointState, Trainer, devices_mesh, layout_of, rates_at
from doedesign.training.loop import Callbacks, FolderLock, Schedule, is_done, perceptual_of, resumed, seal, take_steps
from doedesign.training.results import HeldOut, height_at_rest_m, heights_before, validate, write_results
from doedesign.training.validation import SCENE_SEED, split_pictures
from fab.errors import InputError
from fab.figure import save
from fab.files import MANIFEST_NAME, canonical_json, sha256_bytes, sha256_file, write_atomic
from sim.obstruction import CameraView, ObstructionKind

_FREE = ("scene", "sensor", "obstruction", "network", "train")
_MOST_THREADS = 8


@dataclass(frozen=True)
class TrainingSettings:
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
        coordinator: with several hosts, see `doedesign.training.hosts.join_hosts`, like the next two.
        hosts: their number.
        host: number of this one.
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
    coordinator: str | None = None
    hosts: int | None = None
    host: int | None = None


class TrainingInputs(NamedTuple):
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
    kind: ObstructionKind
    data: SceneData
    held_out: HeldOut
    settings: dict[str, Any]
    names: dict[str, Any]

    def digest(self) -> str:
        """SHA-256 of the settings."""
        return sha256_bytes(canonical_json(self.settings))

    def claim(self) -> FolderLock:
        """Whose a folder of this training is."""
        others = "one with another run, spec, occlusion model, perceptual loss or other pictures"
        return FolderLock(TRAINING, self.digest(), "training", others, ("spec.toml", "pictures.json"))


def train(
    run_folder: Path, out: Path | None = None, request: TrainingSettings | None = None, say: Say = lambda _: None
) -> Path:
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
    request = request or TrainingSettings()
    if request.tensorboard:
        require_tensorboard()
    if request.coordinator is not None and request.devices is not None:
        rule = "must be left out with --coordinator: every host takes all that it has"
        raise InputError("--devices", rule, request.devices, "Leave it out.")
    join_hosts(request.coordinator, request.hosts, request.host)
    folder, leads = out or run_folder / "trained", jax.process_index() == 0
    with stoppable() as stop:
        work = _prepared(open_run(run_folder), request, say)
        with alone_in(folder) if leads else nullcontext():
            # Host 0 looks, and clears away; the others hear of it.
            if any(gathered(leads and is_done(folder, work.claim()))):
                say(f"{folder} already holds this finished training")
                return folder
            if leads:
                _begin(folder, work, request)
            start = settled(work.trainer.initial(heights_before(work.run, work.trainer)))
            state = resumed(folder, start, work.digest(), say)
            if len(set(found := gathered(state.step))) > 1:
                rule, got = "every host must find the same checkpoint", f"those of steps {found}"
                raise InputError(str(folder), rule, got, "Put the run where all hosts see it.")
            state = _iterate(folder, work, state, request, stop, say)
            if leads:
                say("judging the network and writing results")
                _finish(folder, work, state)
            gathered(0)  # nobody leaves before all is written
    if skips := " ".join(filter(None, (data.pictures.skips() for data in (work.data, work.held_out.data)))):
        say(skips)
    return folder


def _prepared(run: Run, request: TrainingSettings, say: Say) -> TrainingInputs:
    source = str(run.path("spec.toml"))
    run = replace(run, spec=spec_with(run, request.overrides, _FREE))
    spec, options = run.spec, run.spec.train
    model = occlusion_from_spec(spec, source, request.occlusion)
    kind = obstruction_from_spec(spec, source, request.obstruction)
    camera = camera_from_spec(spec)
    view = CameraView((options.size, options.size), camera.pixel_m, camera.sensor_distance_m)
    lpips, perceptual = perceptual_of(options, options.size, f"{source}: train.size", request.lpips_weights, say)
    _require_possible(spec, source)
    split = split_pictures(request.images, request.validation, options.validation, options.seed)
    far = (min(spec.scene.far_m), max(spec.scene.far_m))
    trained_on, held_out = (Pictures(files, most_px=2 * options.size) for files in split)
    threads = min(_MOST_THREADS, max(2, os.cpu_count() or 1))
    data = SceneData(trained_on, kind, view, far, options.seed, options.batch, threads)
    looks = HeldOut(SceneData(held_out, kind, view, far, SCENE_SEED, mirrored=False), options.validation, lpips)
    say("preparing propagation")
    # Objectives are done with, and the files that they name lie beside the spec that the run was made from.
    bare = spec.model_copy(update={"objectives": ()})
    at_rest = height_at_rest_m(run, camera)
    mesh = devices_mesh(request.devices)
    trainer = Trainer.of(bare, {}, source, model, kind, at_rest, perceptual=perceptual, mesh=mesh)
    settings = {
        "format": TRAINING,
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
    return TrainingInputs(run, trainer, kind, data, looks, settings, names)


def _name(path: Path, folder: Path | None) -> str:
    return path.name if folder is None else path.relative_to(folder).as_posix()


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


def _manifest(work: TrainingInputs) -> dict[str, Any]:
    said = {"settings_sha256": work.digest(), "state": "running", "version": __version__}
    return {**work.settings, **said, "licence": work.names["licence"]}


def _begin(folder: Path, work: TrainingInputs, request: TrainingSettings) -> None:
    write_atomic(folder / MANIFEST_NAME, canonical_json(_manifest(work)))
    comments = ["every default filled in", *(f"--set {override}" for override in request.overrides)]
    write_atomic(folder / "spec.toml", spec_to_toml(work.run.spec, comments).encode())
    write_atomic(folder / "pictures.json", canonical_json(work.names))


def _iterate(
    folder: Path, work: TrainingInputs, state: JointState, request: TrainingSettings, stop: StopRequest, say: Say
) -> JointState:
    """Take the remaining steps."""
    options, trainer = work.run.spec.train, work.trainer
    if state.step == options.steps:
        return state

    def step(state: JointState, batch: Batch) -> tuple[JointState, dict[str, Any]]:
        rates = rates_at(options, state.step)
        state, record = trainer.step(state, _part(batch))
        return state, {**record._asdict(), "learning_rates": rates._asdict()}

    def save(state: JointState) -> None:
        write_checkpoint(folder / CHECKPOINT, state, state.step, work.digest())

    return take_steps(
        folder,
        state,
        work.data.batches(state.step, options.steps),
        Callbacks(step, lambda state: _look(folder, work, state), save),
        Schedule(options.steps, options.validate_every, options.checkpoint_every),
        title="training",
        stop=stop,
        say=say,
        leads=jax.process_index() == 0,
        board=request.tensorboard,
    )


def _part(batch: Batch) -> Batch:
    """This host's part of a batch."""
    hosts, here = jax.process_count(), jax.process_index()
    if hosts == 1:
        return batch
    count = len(batch.items) // hosts
    return batch._replace(items=batch.items[here * count : (here + 1) * count])


def _look(folder: Path, work: TrainingInputs, state: JointState) -> dict[str, Any]:
    """Look at held-out scenes; draw them, and return their scores."""
    found = validate(work.trainer, state, work.held_out)
    if jax.process_index() == 0:
        words = f"occlusion model {work.settings['occlusion']}, camera {work.settings['camera']}; PSNR in brackets: "
        words += "where it is covered"
        title = f"{work.run.spec.name}, step {state.step}"
        save(plot_validation(found.rows, title, words), folder / "validation" / f"step_{state.step:06d}.png")
    return found.means


def _finish(folder: Path, work: TrainingInputs, state: JointState) -> None:
    """Write the results, and mark the training done; the checkpoint is no longer needed."""
    about = {**work.settings, "steps": state.step, "pictures": work.names, "version": __version__}
    names = write_results(folder, work.run, work.trainer, state, work.held_out, work.kind, about)
    records = read_history(folder / HISTORY_NAME, state.step)
    if records:
        save(plot_training(records, work.run.spec.name), folder / "curves.png")
        names += ["curves.png", HISTORY_NAME]
    names += ["spec.toml", "pictures.json"]
    seal(folder, names, _manifest(work))
