"""A training in a folder of its own: steps with history, validation and checkpoints, until they are done or stopped.

    OUT/
        manifest.json       what this was made with, and the digests of all results when done
        checkpoint.npz      everything a step changes; only while the training is unfinished
        history.jsonl       one line per step (`doedesign.training.history`)
        validation/         step_000500.png ...: what was never trained on, as captured, as reconstructed, as it is
        curves.png          the history in one picture
        ...                 what the kind of training adds (`doedesign.training.train`, `doedesign.training.finetune`)

A training goes on from its last checkpoint with the same call, and ends with the same bytes on the same machine (but
for the seconds in its history). Its manifest says "running" until everything else is on the disk. SIGTERM and Ctrl-C
end it after the step it is at, with a checkpoint.
"""

import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import jax

from doedesign import __version__
from doedesign.capture.scenes import Batch, SceneData
from doedesign.recon.model import Model
from doedesign.report.history import plot_training
from doedesign.report.sheet import plot_validation
from doedesign.runs.folder import CHECKPOINT, alone_in
from doedesign.runtime.progress import meter
from doedesign.runtime.stopping import StopRequest, stoppable
from doedesign.spec.training import TrainSpec
from doedesign.training.checkpoint import read_checkpoint, settled, write_checkpoint
from doedesign.training.distance.perceptual import Lpips, Perceptual, read_lpips
from doedesign.training.distance.similarity import MsSsim
from doedesign.training.history import HISTORY_NAME, open_board, open_history, read_history
from doedesign.training.hosts import gathered
from doedesign.training.pairs import PairData
from doedesign.training.validation import EvaluationResult
from fab.errors import InputError
from fab.figure import save
from fab.files import (
    MANIFEST_NAME,
    canonical_json,
    clear_killed,
    path_of,
    read_json,
    scratch_folder,
    sha256_bytes,
    sha256_file,
    write_atomic,
)

_Opened = TypeVar("_Opened")

_log = logging.getLogger("doedesign")


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingJob(ABC):
    """A training that is prepared. Its states are trees of arrays and numbers, with the number of steps as `step`.

    Attributes:
        name: "training" or "fine-tuning", for messages.
        title: name of the design, for pictures.
        options: steps, and after how many of them to validate and to write a checkpoint.
        settings: everything that the result depends on, for the manifest; its "format" tells the kinds apart.
        remarks: other entries of the manifest.
        inputs: files that are written before the first step.
        differs: in what another training of the same kind may differ, for messages.
        data: batches to train on.
        lpips: weights of LPIPS, if at hand.
        validates_first: whether to validate before the first step, too.
    """

    name: str
    title: str
    options: TrainSpec
    settings: Mapping[str, Any]
    inputs: Mapping[str, bytes]
    differs: str
    data: SceneData | PairData
    lpips: Lpips | None
    remarks: Mapping[str, Any] = field(default_factory=dict)
    validates_first: bool = False

    @abstractmethod
    def initial(self) -> Any:
        """The state before the first step."""

    def begun(self, state: Any) -> Any:
        """The state after what comes before the first step, if anything does; a signal ends that at once."""
        return state

    @abstractmethod
    def step(self, state: Any, batch: Batch) -> tuple[Any, dict[str, Any]]:
        """Take one step; return the new state and the line of the history."""

    @abstractmethod
    def evaluate(self, state: Any) -> EvaluationResult:
        """Judge a state on scenes that are never trained on."""

    @abstractmethod
    def caption(self, state: Any) -> tuple[str, str]:
        """Title of a picture of validation, and the words at its foot."""

    @abstractmethod
    def write_results(self, folder: Path, state: Any) -> list[str]:
        """Write the trained network and all that belongs to it; return the names of the files."""


def trained_model(job: TrainingJob, out: str | Path | None, *, tensorboard: bool = False) -> Model:
    """Run a training as `trained` does; return the model."""
    model = trained(job, out, Model.open, tensorboard=tensorboard)
    return replace(model, folder=None) if out is None else model


def trained(
    job: TrainingJob, out: str | Path | None, opened: Callable[[Path], _Opened], *, tensorboard: bool = False
) -> _Opened:
    """Run a training in a folder, or in a temporary one, which is removed, if it is None; return what it left.

    A signal ends it after a step, with a checkpoint (KeyboardInterrupt).

    Args:
        job: the training.
        out: the folder.
        opened: reads the results in the folder.
        tensorboard: write for TensorBoard, too.
    """
    place: AbstractContextManager[str | Path] = nullcontext(out) if out is not None else scratch_folder()
    with stoppable() as stop, place as folder:
        _run(job, path_of(folder, "out"), stop, tensorboard)
        return opened(Path(folder))


def _run(job: TrainingJob, folder: Path, stop: StopRequest, tensorboard: bool) -> None:
    """Train, or go on where an earlier call was stopped."""
    digest, leads = sha256_bytes(canonical_json(job.settings)), jax.process_index() == 0
    manifest = {**job.settings, "settings_sha256": digest, "state": "running", "version": __version__, **job.remarks}
    with alone_in(folder) if leads else nullcontext():
        # Host 0 looks, and clears away; the others hear of it.
        if any(gathered(leads and _is_done(folder, job, digest))):
            _log.info("%s already holds this finished %s", folder, job.name)
            return
        if leads:
            write_atomic(folder / MANIFEST_NAME, canonical_json(manifest))
            for name, data in job.inputs.items():
                write_atomic(folder / name, data)
        state = settled(job.initial())
        if stored := read_checkpoint(folder / CHECKPOINT, state, digest):
            state, step = stored
            _log.info("resuming after step %d", step)
            if (found := len(read_history(folder / HISTORY_NAME, step))) < step:
                _log.warning("%s lacks %d of the %d steps before", HISTORY_NAME, step - found, step)
        if len(set(steps := gathered(state.step))) > 1:
            rule, got = "every host must find the same checkpoint", f"those of steps {steps}"
            raise InputError(str(folder), rule, got, "Put the run where all hosts see it.")
        state = _take_steps(folder, job, state, digest, stop, tensorboard)
        if leads:
            _log.info("judging the network and writing results")
            names = [*job.write_results(folder, state), *job.inputs]
            if records := read_history(folder / HISTORY_NAME, state.step):
                save(plot_training(records, job.title), folder / "curves.png")
                names += ["curves.png", HISTORY_NAME]
            digests = {name: sha256_file(folder / name) for name in sorted(names)}
            done = {**manifest, "state": "done", "results_sha256": digests}
            write_atomic(folder / MANIFEST_NAME, canonical_json(done))
            (folder / CHECKPOINT).unlink(missing_ok=True)
        gathered(0)  # nobody leaves before all is written


def _is_done(folder: Path, job: TrainingJob, digest: str) -> bool:
    """Whether a training is finished; refuse the folder of another, and clear away leftovers of a killed one."""
    path = folder / MANIFEST_NAME
    if not path.is_file():
        if folder.is_dir() and any(not each.name.startswith(".") for each in folder.iterdir()):
            rule = f"a {job.name} needs a new or empty folder, or its own"
            raise InputError(str(folder), rule, "other content", "Choose another output folder.")
        return False
    found, own = read_json(path), job.settings["format"]
    nothing_yet = {each.name for each in folder.iterdir()} <= {MANIFEST_NAME, *job.inputs}
    if found.get("format") == own and found.get("state") != "done" and nothing_yet:
        return False  # there is nothing to lose, whatever it was
    if found.get("format") != own or found.get("settings_sha256") != digest:
        rule, cure = f"the folder must belong to this {job.name}", "Choose another output folder, or remove that one."
        raise InputError(str(folder), rule, job.differs, cure)
    if (folder / "validation").is_dir():
        clear_killed(folder / "validation", lambda name: name.endswith(".png"))
    if found.get("state") != "done":
        return False
    results = found.get("results_sha256")
    if not isinstance(results, dict):
        cure = f"Restore it, or remove {folder} and start again."
        raise InputError(str(path), f"must list the results of a finished {job.name}", repr(results), cure)
    for name, expected in results.items():
        if sha256_file(folder / name) != expected:
            rule = f"must be the file this {job.name} wrote"
            cure = f"Restore it, or remove {folder} and start again."
            raise InputError(str(folder / name), rule, "a changed file", cure)
    (folder / CHECKPOINT).unlink(missing_ok=True)  # it was killed just before
    return True


def _validated(folder: Path, job: TrainingJob, state: Any) -> dict[str, Any]:
    """Validate, and draw it; return the scores."""
    found = job.evaluate(state)
    if jax.process_index() == 0:
        picture = plot_validation(found.rows, *job.caption(state))
        save(picture, folder / "validation" / f"step_{state.step:06d}.png")
    return found.means


def _take_steps(folder: Path, job: TrainingJob, state: Any, digest: str, stop: StopRequest, tensorboard: bool) -> Any:
    """Take the remaining steps; of several hosts, host 0 writes."""
    options, first, leads = job.options, state.step, jax.process_index() == 0
    if job.validates_first and first == 0:
        _validated(folder, job, state)
    if first == options.steps:
        return state
    if first == 0:
        state = job.begun(state)
    with ExitStack() as stack:
        stream = stack.enter_context(job.data.batches(first, options.steps))
        history = stack.enter_context(open_history(folder / HISTORY_NAME, first)) if leads else None
        board = stack.enter_context(open_board(folder / "tensorboard", first)) if tensorboard and leads else None
        progress = stack.enter_context(meter(job.name, options.steps, first))
        stack.enter_context(stop.gently())
        begun = time.monotonic()
        for batch in stream:
            state, line = job.step(state, batch)
            last = state.step == options.steps
            if last or state.step % options.validate_every == 0:
                line["validation"] = _validated(folder, job, state)
            now = time.monotonic()
            line["seconds"], begun = round(now - begun, 4), now
            if history:
                history.add(line)
            if board:
                board(line)
            progress.advance(state.step, f"loss {line['loss']:.4f}")
            # One host that stopped alone would leave the others waiting for ever.
            stopping = any(gathered(stop.asked))
            if history and (stopping or last or state.step % options.checkpoint_every == 0):
                history.sync()
                write_checkpoint(folder / CHECKPOINT, state, state.step, digest)
            if stopping:
                _log.info("stopped after step %d of %d, with a checkpoint in %s", state.step, options.steps, folder)
                raise KeyboardInterrupt
    return state


def perceptual_distance(
    options: TrainSpec, size: int, where: str, files: Sequence[Path]
) -> tuple[Lpips | None, Perceptual | None]:
    """LPIPS for scores, if there are files of its weights, and the distance of the loss, if that has one.

    Raises:
        InputError: weights that cannot be used, or crops with a shorter side of `size` too small for them.
    """
    lpips = read_lpips(files) if files else None
    if lpips is not None and size < lpips.least_px:
        rule = f"{lpips.name} needs pictures of at least {lpips.least_px} pixels"
        raise InputError(where, rule, size, "Enlarge it, or leave the weights of LPIPS out.")
    if not options.perceptual:
        return lpips, None
    if lpips is None:
        _log.warning("no weights of LPIPS, so 1 - MS-SSIM stands in for the perceptual loss")
    return lpips, lpips or MsSsim()
