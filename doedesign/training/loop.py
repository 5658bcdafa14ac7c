"""What every training does beside its steps: a folder of its own, history, looks, checkpoints, and an end on request.

A training goes on from its last checkpoint with the same call. Its manifest says "running" until everything else is on
the disk, so whoever finds it "done" finds all of it.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

from doedesign.runs.folder import CHECKPOINT
from doedesign.runtime.progress import meter
from doedesign.runtime.stopping import StopRequest
from doedesign.spec.training import TrainSpec
from doedesign.training.checkpoint import read_checkpoint
from doedesign.training.history import HISTORY_NAME, open_board, open_history, read_history
from doedesign.training.perceptual import Lpips, Perceptual, read_lpips
from doedesign.training.similarity import MsSsim
from fab.errors import InputError
from fab.files import MANIFEST_NAME, canonical_json, read_json, sha256_file, write_atomic

Say = Callable[[str], None]


@runtime_checkable
class HasStep(Protocol):
    """A state that knows how many steps were done."""

    @property
    def step(self) -> int:
        """That number."""
        ...


_State = TypeVar("_State", bound=HasStep)


class FolderLock(NamedTuple):
    """Whose a folder is.

    Attributes:
        format: of the manifest.
        digest: SHA-256 of all that the result depends on.
        name: what is done, for messages: "training".
        others: in what another one of these may differ, for messages.
        first: files that are there before anything can be lost.
    """

    format: str
    digest: str
    name: str
    others: str
    first: tuple[str, ...]


def is_done(folder: Path, claim: FolderLock) -> bool:
    """Whether what the folder is claimed for is finished; clear away what a killed one was writing.

    Raises:
        InputError: the folder is that of something else, or a result was changed.
    """
    for path in (folder / "validation").glob(".*"):
        path.unlink()
    path = folder / MANIFEST_NAME
    if not path.is_file():
        if folder.is_dir() and any(not each.name.startswith(".") for each in folder.iterdir()):
            rule = f"a {claim.name} needs a new or empty folder, or its own"
            raise InputError(str(folder), rule, "other content", "Choose another --out.")
        return False
    found = read_json(path)
    nothing_yet = {each.name for each in folder.iterdir()} <= {MANIFEST_NAME, *claim.first}
    if found.get("format") == claim.format and found.get("state") != "done" and nothing_yet:
        return False  # there is nothing to lose, whatever it was
    if found.get("format") != claim.format or found.get("settings_sha256") != claim.digest:
        rule, cure = f"the folder must belong to this {claim.name}", "Choose another --out, or remove that folder."
        raise InputError(str(folder), rule, claim.others, cure)
    if found["state"] != "done":
        return False
    for name, expected in found["results_sha256"].items():
        if sha256_file(folder / name) != expected:
            rule = f"must be the file this {claim.name} wrote"
            cure = f"Restore it, or remove {folder} and start again."
            raise InputError(str(folder / name), rule, "a changed file", cure)
    (folder / CHECKPOINT).unlink(missing_ok=True)  # it was killed just before
    return True


def perceptual_of(
    options: TrainSpec, size: int, where: str, files: Sequence[Path], say: Say
) -> tuple[Lpips | None, Perceptual | None]:
    """LPIPS for scores, if its weights are at hand, and the distance of the loss, if it has one.

    Args:
        options: with the weight of the perceptual term.
        size: pixels of a crop's shorter side.
        where: what says so, for messages.
        files: weights of LPIPS.
        say: told of the stand-in.

    Raises:
        InputError: weights that cannot be used, or crops too small for them.
    """
    lpips = read_lpips(files) if files else None
    if lpips is not None and size < lpips.least_px:
        rule = f"{lpips.name} needs pictures of at least {lpips.least_px} pixels"
        raise InputError(where, rule, size, "Enlarge it, or leave --lpips-weights out.")
    if not options.perceptual:
        return lpips, None
    if lpips is None:
        say("warning: no --lpips-weights, so 1 - MS-SSIM stands in for the perceptual loss")
    return lpips, lpips or MsSsim()


def resumed(folder: Path, start: _State, owner: str, say: Say) -> _State:
    """The state to go on from: that of the last checkpoint, or the one to start with.

    Raises:
        InputError: a checkpoint that is broken, or belongs to something else.
    """
    stored = read_checkpoint(folder / CHECKPOINT, start, owner)
    if stored is None:
        return start
    state, step = stored
    say(f"resuming after step {step}")
    if (found := len(read_history(folder / HISTORY_NAME, step))) < step:
        say(f"warning: {HISTORY_NAME} lacks {step - found} of the {step} steps before")
    return state


class Schedule(NamedTuple):
    """How many steps to take, and after how many of them to do what.

    Attributes:
        steps: all of them, those done included.
        validate_every: steps between looks.
        checkpoint_every: steps between checkpoints.
    """

    steps: int
    validate_every: int
    checkpoint_every: int


class Callbacks(NamedTuple):
    """What a training does while it runs.

    Attributes:
        step: one step: state, batch -> state, line of the history.
        look: look at what was not trained on; returns its scores, for the history.
        save: write a checkpoint.
    """

    step: Callable[[Any, Any], tuple[Any, dict[str, Any]]]
    look: Callable[[Any], dict[str, Any]]
    save: Callable[[Any], None]


def take_steps(
    folder: Path,
    state: _State,
    batches: AbstractContextManager[Iterator[Any]],
    doings: Callbacks,
    pace: Schedule,
    *,
    title: str,
    stop: StopRequest,
    say: Say,
    leads: bool = True,
    board: bool = False,
) -> _State:
    """Take the remaining steps.

    Args:
        folder: where history and checkpoints go.
        state: the state to begin with.
        batches: what the steps look at, from `state.step` on; as many as there are steps left.
        doings: what is done.
        pace: when.
        title: name of it all, for the progress that is shown.
        stop: who asks for an end gets it after a step, with a checkpoint.
        say: told of it.
        leads: whether this process writes; of several hosts, one does.
        board: write for TensorBoard, too.

    Raises:
        KeyboardInterrupt: it was stopped.
        InputError: what `doings` and the history raise.
    """
    first = state.step
    with ExitStack() as stack:
        stream = stack.enter_context(batches)
        history = stack.enter_context(open_history(folder / HISTORY_NAME, first)) if leads else None
        told = stack.enter_context(open_board(folder / "tensorboard", first)) if board and leads else None
        progress = stack.enter_context(meter(title, pace.steps, first))
        stack.enter_context(stop.gently())
        begun = time.monotonic()
        for batch in stream:
            state, line = doings.step(state, batch)
            last = state.step == pace.steps
            if last or state.step % pace.validate_every == 0:
                line["validation"] = doings.look(state)
            now = time.monotonic()
            line["seconds"], begun = round(now - begun, 4), now
            for sink in filter(None, (history, told)):
                sink.add(line)
            progress.advance(state.step, f"loss {line['loss']:.4f}")
            stopping = stop.agreed()
            if history and (stopping or last or state.step % pace.checkpoint_every == 0):
                history.sync()
                doings.save(state)
            if stopping:
                say(f"stopped after step {state.step} of {pace.steps}, with a checkpoint in {folder}")
                raise KeyboardInterrupt
    return state


def seal(folder: Path, names: Sequence[str], manifest: Mapping[str, Any]) -> None:
    """Mark all as done; the checkpoint is no longer needed.

    Args:
        folder: the folder.
        names: its results.
        manifest: what its manifest says beside their digests.
    """
    digests = {name: sha256_file(folder / name) for name in sorted(names)}
    write_atomic(folder / MANIFEST_NAME, canonical_json({**manifest, "state": "done", "results_sha256": digests}))
    (folder / CHECKPOINT).unlink(missing_ok=True)
