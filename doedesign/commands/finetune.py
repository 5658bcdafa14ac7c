"""`doedesign finetune`: a trained network on real captures, each with a picture of what was to be seen (paper §4).

    OUT/
        manifest.json       what this was made with, and the digests of all results when done
        pairs.json          names of all pairs, trained on and held out
        checkpoint.npz      everything a step changes; only while it is unfinished
        history.jsonl       one line per step (`doedesign.training.history`)
        validation/         step_000000.png (before) ...: held-out pairs as captured, as reconstructed, as they are
        network.npz         the network (`doedesign.recon.weights`)
        psf.exr             the PSFs that it was told of
        metrics.json        scores on held-out pairs, and those before
        curves.png          the history in one picture

The folder is a model: `doedesign reconstruct OUT CAPTURE` takes it. Batch, size of crops, weights of the loss and
precision are those of the model's own training, where a spec lies beside it. The step size falls along a cosine to a
tenth.

As for training, the manifest says "running" until everything else is on the disk, the same command goes on from the
last checkpoint and ends with the same bytes on the same machine (but for the seconds in its history), and SIGTERM and
Ctrl-C end it after the step it is at.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign import __version__
from doedesign.commands.psf import Say
from doedesign.recon.model import Model, PsfPair
from doedesign.recon.weights import BANK_NAME, NETWORK_NAME, write_network
from doedesign.report.history import plot_training
from doedesign.report.sheet import plot_validation
from doedesign.runs.folder import CHECKPOINT, alone_in
from doedesign.runtime.stopping import StopRequest, stoppable
from doedesign.spec import load_spec
from doedesign.spec.training import TrainSpec
from doedesign.training.checkpoint import settled, write_checkpoint
from doedesign.training.crops import PairBatch, PairData, Pairs, crop_shape, cut
from doedesign.training.evaluation import EvaluationResult, judge
from doedesign.training.finetune import FinetuneState, Tuner
from doedesign.training.history import HISTORY_NAME, read_history
from doedesign.training.loop import Callbacks, FolderLock, Schedule, is_done, perceptual_of, resumed, seal, take_steps
from doedesign.training.pairs import PairSplit, find_pairs, pairs_digest, split_pairs
from doedesign.training.perceptual import Lpips
from doedesign.training.validation import ValidationSample
from fab.errors import InputError
from fab.figure import save
from fab.files import MANIFEST_NAME, canonical_json, sha256_bytes, write_atomic
from sim.light import srgb_from_linear
from sim.store import write_bank

FORMAT = "doedesign fine-tuning 1"

_STEPS = 2000
_OPTIONS = ("steps", "batch", "learning_rate", "seed", "l1", "perceptual", "masked", "precision", "checkpointing")


@dataclass(frozen=True)
class FinetuneSettings:
    """How to fine-tune.

    Attributes:
        psf: files of PSFs to give to the network, see `doedesign.recon.model.Model.psfs`, like the next three.
        pixel_m: their pixel pitch.
        near_m: distance of the obstruction.
        far_m: distance of the scene.
        steps: steps.
        learning_rate: Adam's first step size; a tenth of that of the model's training if None.
        seed: seed of everything random.
        validation: pairs that are never trained on; a fifth, and at most eight, if None.
        size: pixels per side of a crop; those of the model's training if None, and at most what every pair has.
        lpips_weights: files with the weights of LPIPS; multi-scale SSIM stands in for it without them.
        linear: whether PNG and TIFF hold linear light; by default what is usual for their kind.
        mirrored: exchange left and right at random, of captures and PSFs.
    """

    psf: Sequence[Path] = ()
    pixel_m: float | None = None
    near_m: float | None = None
    far_m: float | None = None
    steps: int = _STEPS
    learning_rate: float | None = None
    seed: int = 0
    validation: int | None = None
    size: int | None = None
    lpips_weights: Sequence[Path] = ()
    linear: bool | None = None
    mirrored: bool = True


class FinetuneInputs(NamedTuple):
    """One fine-tuning, before its folder is looked at.

    Attributes:
        model: what to begin with.
        psfs: PSFs of the camera.
        tuner: what a step does.
        data: crops to train on.
        held_out: pairs to judge by.
        lpips: weights of LPIPS, if at hand.
        settings: everything that the result depends on.
        names: names of the pairs.
    """

    model: Model
    psfs: PsfPair
    tuner: Tuner
    data: PairData
    held_out: Pairs
    lpips: Lpips | None
    settings: dict[str, Any]
    names: dict[str, Any]

    def claim(self) -> FolderLock:
        """Whose a folder of this fine-tuning is."""
        others = "one with another model, PSFs, settings or pairs"
        return FolderLock(FORMAT, sha256_bytes(canonical_json(self.settings)), "fine-tuning", others, ("pairs.json",))

    @property
    def title(self) -> str:
        """Name of the design, for pictures."""
        return str(self.model.about.get("run", self.model.folder and self.model.folder.name))


def finetune(
    model_folder: Path,
    pairs: Path,
    out: Path | None = None,
    request: FinetuneSettings | None = None,
    say: Say = lambda _: None,
) -> Path:
    """Fine-tune a model on real pairs, or go on where an earlier call was stopped.

    Args:
        model_folder: a run with a training, RUN/trained, or a released model.
        pairs: folder of pairs, see `doedesign.training.pairs`.
        out: folder; RUN/finetuned by default.
        request: how.
        say: told what is going on.

    Returns:
        the folder.

    Raises:
        InputError: a model, pair, PSF or number that cannot be used, a folder that belongs to something else, or a loss
            that is no longer finite.
        KeyboardInterrupt: it was stopped; the same call goes on from there.
    """
    folder = out or model_folder / "finetuned"
    with stoppable() as stop:
        work = _prepared(model_folder, pairs, request or FinetuneSettings(), say)
        claim = work.claim()
        with alone_in(folder):
            if is_done(folder, claim):
                say(f"{folder} already holds this finished fine-tuning")
                return folder
            write_atomic(folder / MANIFEST_NAME, canonical_json(_manifest(work)))
            write_atomic(folder / "pairs.json", canonical_json(work.names))
            start = settled(work.tuner.initial(work.model.network))
            state = _iterate(folder, work, resumed(folder, start, claim.digest, say), stop, say)
            say("judging the network and writing results")
            _finish(folder, work, state)
    return folder


def _prepared(model_folder: Path, folder: Path, request: FinetuneSettings, say: Say) -> FinetuneInputs:
    model = Model.open(model_folder)
    psfs = model.psfs(request.psf, pixel_m=request.pixel_m, near_m=request.near_m, far_m=request.far_m)
    options = _options(model, request)
    split = split_pairs(find_pairs(folder), request.validation, request.seed, str(folder))
    if split.left_out:
        say(f"warning: {len(split.left_out)} pairs show what is held out under another name and are left out")
    training, held_out = (Pairs(files, model, request.linear) for files in split[:2])
    say(f"reading {len(training)} pairs to train on and {len(held_out)} to judge by")
    least = np.minimum(training.least_size(), held_out.least_size())
    wanted = options.size if request.size is None else request.size
    shape = crop_shape((int(least[0]), int(least[1])), wanted, model.network.layout.multiple, str(folder))
    where = f"{folder}: size of crops"
    lpips, perceptual = perceptual_of(options, min(shape), where, request.lpips_weights, say)
    settings = {
        "format": FORMAT,
        "model_sha256": dict(model.digests),
        "psfs_sha256": sha256_bytes(psfs.far.tobytes() + psfs.near.tobytes()),
        "near_m": psfs.near_m,
        "far_m": None if np.isinf(psfs.far_m) else psfs.far_m,
        "pairs_sha256": pairs_digest(split.training),
        "held_out_sha256": pairs_digest(split.held_out),
        "crop_px": list(shape),
        "mirrored": request.mirrored,
        "linear": request.linear,
        "options": {name: getattr(options, name) for name in _OPTIONS},
        "perceptual": "none" if perceptual is None else perceptual.name,
        "perceptual_sha256": "" if perceptual is None else perceptual.digest,
        "units": "SI; light is linear with white 1; arrays [y, x], row 0 at the lowest y",
    }
    data = PairData(training, shape, options.seed, options.batch, request.mirrored)
    return FinetuneInputs(
        model, psfs, Tuner.of(psfs, options, perceptual), data, held_out, lpips, settings, _names(split)
    )


def _options(model: Model, request: FinetuneSettings) -> TrainSpec:
    """How the model was trained, with what is asked for now.

    Raises:
        InputError: a number out of range.
    """
    assert model.folder is not None  # that of an opened model
    path = model.folder / "spec.toml"
    before = load_spec(path).train if path.is_file() else TrainSpec()
    rate = before.learning_rate / 10 if request.learning_rate is None else request.learning_rate
    for option, fits, rule, value in (
        ("--steps", 0 <= request.steps <= 10_000_000, "must be from 0 to 10 million", request.steps),
        ("--learning-rate", 0 < rate < np.inf, "must be positive", rate),
        ("--seed", 0 <= request.seed < 2**32, "must be from 0 to 2^32 - 1", request.seed),
    ):
        if not fits:
            raise InputError(option, rule, value, "Correct it, or leave it out.")
    asked = {"steps": request.steps, "learning_rate": rate, "seed": request.seed}
    return before.model_copy(update={"freeze": "optics", "schedule": "cosine", **asked})


def _names(split: PairSplit) -> dict[str, Any]:
    named = {name: [pair.name for pair in pairs] for name, pairs in split._asdict().items()}
    return {**named, "with_mask": [pair.name for pairs in split[:2] for pair in pairs if pair.mask is not None]}


def _manifest(work: FinetuneInputs) -> dict[str, Any]:
    said = {"settings_sha256": work.claim().digest, "state": "running", "version": __version__}
    return {**work.settings, **said}


def _iterate(folder: Path, work: FinetuneInputs, state: FinetuneState, stop: StopRequest, say: Say) -> FinetuneState:
    """Take the remaining steps."""
    tuner, options = work.tuner, work.tuner.options
    if state.step == 0:
        _look(folder, work, state)
    if state.step == options.steps:
        return state

    def step(state: FinetuneState, batch: PairBatch) -> tuple[FinetuneState, dict[str, Any]]:
        rate = tuner.rate(state.step)
        state, record = tuner.step(state, batch)
        return state, {**record._asdict(), "learning_rates": {"network": rate}}

    def save(state: FinetuneState) -> None:
        write_checkpoint(folder / CHECKPOINT, state, state.step, work.claim().digest)

    return take_steps(
        folder,
        state,
        work.data.batches(state.step, options.steps),
        Callbacks(step, lambda state: _look(folder, work, state), save),
        Schedule(options.steps, options.validate_every, options.checkpoint_every),
        title="fine-tuning",
        stop=stop,
        say=say,
    )


def _look(folder: Path, work: FinetuneInputs, state: FinetuneState) -> dict[str, Any]:
    """Look at held-out pairs; draw them, and return their scores."""
    found = _judged(work, state)
    title, words = f"{work.title}, fine-tuned by {state.step} steps", "middle of real pairs never trained on; PSNR"
    if any(pair.mask is not None for pair in work.held_out.files):
        words += ", and in brackets where it is covered"
    save(plot_validation(found.rows, title, words), folder / "validation" / f"step_{state.step:06d}.png")
    return found.means


def _judged(work: FinetuneInputs, state: FinetuneState) -> EvaluationResult:
    def looks() -> Iterator[ValidationSample]:
        for k, files in enumerate(work.held_out.files):
            pair = cut(work.held_out.get(k), work.data.shape)
            pictures = {
                "capture": srgb_from_linear(pair.capture),
                "reconstruction": work.tuner.reconstruct(state, pair.capture),
            }
            clipped = {name: np.clip(picture, 0, 1) for name, picture in pictures.items()}
            yield ValidationSample(files.name, clipped, np.clip(pair.reference, 0, 1), pair.mask)

    def to_rgb(image: Float[np.ndarray, "c y x"]) -> Float[np.ndarray, "3 y x"]:
        picture = work.model.rgb(image)
        return np.repeat(picture, 3, axis=0) if len(picture) == 1 else picture

    return judge(looks(), work.lpips, to_rgb)


def _finish(folder: Path, work: FinetuneInputs, state: FinetuneState) -> None:
    """Write the results, and mark it all as done."""
    before, after = (_judged(work, each) for each in (work.tuner.initial(work.model.network), state))
    metrics = {**after.means, "before": before.means["reconstruction"], "scenes": after.scenes}
    write_atomic(folder / "metrics.json", canonical_json(metrics))
    psfs, model = work.psfs, work.model
    write_bank(folder / BANK_NAME, psfs.bank)
    about = {
        **{name: model.about[name] for name in ("colours", "wavelengths_m", "pixel_m")},
        # At these depths it is told of the PSFs that it was tuned with.
        "near_m": [psfs.near_m],
        "far_m": None if psfs.far_m == max(psfs.bank.depths_m) else psfs.far_m,
        "run": work.title,
        "finetuned": {**work.settings, "pairs": work.names, "version": __version__},
        "before": dict(model.about),
    }
    write_network(folder / NETWORK_NAME, state.network, about)
    names = [NETWORK_NAME, BANK_NAME, "metrics.json", "pairs.json"]
    records = read_history(folder / HISTORY_NAME, state.step)
    if records:
        save(plot_training(records, work.title), folder / "curves.png")
        names += ["curves.png", HISTORY_NAME]
    seal(folder, names, _manifest(work))
