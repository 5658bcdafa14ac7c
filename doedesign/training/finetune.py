"""Fine-tuning: a trained network on real captures, each with a reference picture (paper §4).

The loss is that of training (eq. 13); its masked term counts where a mask is known. The optics is glass by now, so the
network alone moves. Batch, size of crops, weights of the loss and precision are those of the model's own training,
where a spec lies beside it. The step size falls along a cosine to a tenth.

A folder of a fine-tuning (`doedesign.training.job`) is a model. It has besides

    pairs.json          names of all pairs, trained on and held out
    network.npz         the network (`doedesign.recon.weights`)
    psf.exr             the PSFs that it was given
    metrics.json        scores on held-out pairs, and those before
"""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float

from doedesign import __version__
from doedesign.capture.scenes import Batch
from doedesign.recon.model import Model, PsfPair
from doedesign.recon.network import Network
from doedesign.recon.weights import BANK_NAME, NETWORK_NAME, write_network
from doedesign.runtime.compiling import compiled_step
from doedesign.runtime.stopping import stoppable
from doedesign.spec import load_spec
from doedesign.spec.training import TrainSpec
from doedesign.spec.values import MOST_STEPS
from doedesign.training.job import TrainingJob, perceptual_distance, trained_model
from doedesign.training.joint import rates_at
from doedesign.training.loss import adam_step, history_line, losses
from doedesign.training.pairs import PairData, Pairs, crop_shape, cut, find_pairs, pairs_digest, split_pairs
from doedesign.training.validation import EvaluationResult, HeldOutScene, judge
from fab.errors import InputError
from fab.files import canonical_json, path_of, sha256_bytes, write_atomic
from fab.units import require_kind
from sim.light import srgb_from_linear
from sim.store import write_bank

FORMAT = "doedesign fine-tuning 1"

STEPS = 2000
_OPTIONS = ("steps", "batch", "learning_rate", "seed", "l1", "perceptual", "masked", "precision", "checkpointing")
_log = logging.getLogger("doedesign")


def finetune(
    model: Model,
    pairs: str | Path,
    out: str | Path | None = None,
    *,
    psfs: PsfPair | None = None,
    steps: int = STEPS,
    learning_rate: float | None = None,
    seed: int = 0,
    validation: int | None = None,
    size: int | None = None,
    lpips_weights: Sequence[Path] = (),
    linear: bool | None = None,
    mirrored: bool = True,
) -> Model:
    """Fine-tune a model on real pairs.

    Args:
        model: the model.
        pairs: folder of pairs (`doedesign.training.pairs`).
        out: folder, in which a stopped fine-tuning goes on where it was stopped; a temporary one, which is removed, if
            None.
        psfs: PSFs to give to the network; the model's own if None (`Model.psfs`).
        steps: steps.
        learning_rate: Adam's first step size; a tenth of that of the model's training if None.
        seed: seed of everything random.
        validation: pairs that are never trained on; a fifth, and at most eight, if None.
        size: pixels per side of a crop; those of the model's training if None, and at most what every pair has.
        lpips_weights: files with the weights of LPIPS; multi-scale SSIM stands in for it without them.
        linear: whether PNG and TIFF hold linear light; by default what is usual for their kind.
        mirrored: exchange left and right at random, of captures and PSFs.

    Raises:
        InputError: a pair or number that cannot be used, a folder that belongs to something else, or a loss that is no
            longer finite.
        KeyboardInterrupt: it was stopped; the same call goes on from there.
    """
    require_kind("model", model, Model, 'Open one by dd.Model.open("runs/NAME/trained").')
    folder = path_of(pairs, "pairs")
    with stoppable():  # which ends the preparation, too
        options, psfs = _options(model, steps, learning_rate, seed), psfs or model.psfs()
        split = split_pairs(find_pairs(folder), validation, seed, str(folder))
        if split.left_out:
            count = len(split.left_out)
            _log.warning("%d pairs show what is held out under another name and are left out", count)
        training, held_out = (Pairs(files, model, linear) for files in split[:2])
        _log.info("reading %d pairs to train on and %d to judge by", len(training), len(held_out))
        least = np.minimum(training.least_size(), held_out.least_size())
        wanted = options.size if size is None else size
        shape = crop_shape((int(least[0]), int(least[1])), wanted, model.network.layout.multiple, str(folder))
        lpips, perceptual = perceptual_distance(options, min(shape), f"{folder}: size of crops", lpips_weights)
        settings = {
            "format": FORMAT,
            "model_sha256": dict(model.digests),
            "psfs_sha256": sha256_bytes(psfs.far.tobytes() + psfs.near.tobytes()),
            "near_m": psfs.near_m,
            "far_m": None if np.isinf(psfs.far_m) else psfs.far_m,
            "pairs_sha256": pairs_digest(split.training),
            "held_out_sha256": pairs_digest(split.held_out),
            "crop_px": list(shape),
            "mirrored": mirrored,
            "linear": linear,
            "options": {name: getattr(options, name) for name in _OPTIONS},
            "perceptual": "none" if perceptual is None else perceptual.name,
            "perceptual_sha256": "" if perceptual is None else perceptual.digest,
            "units": "SI; light is linear with white 1; arrays [y, x], row 0 at the lowest y",
        }
        names: dict[str, Any] = {name: [pair.name for pair in group] for name, group in split._asdict().items()}
        names["with_mask"] = [pair.name for group in split[:2] for pair in group if pair.mask is not None]
        job = FineTuning(
            name="fine-tuning",
            title=str(model.about.get("run", "model" if model.folder is None else model.folder.name)),
            options=options,
            settings=settings,
            inputs={"pairs.json": canonical_json(names)},
            differs="one with another model, PSFs, settings or pairs",
            validates_first=True,
            model=model,
            psfs=psfs,
            perceptual=perceptual,
            data=PairData(training, shape, seed, options.batch, mirrored),
            held_out=held_out,
            lpips=lpips,
            pairs=names,
        )
    return trained_model(job, out)


def _options(model: Model, steps: int, learning_rate: float | None, seed: int) -> TrainSpec:
    """Options of the model's own training, with those that are given now."""
    path = None if model.folder is None else model.folder / "spec.toml"
    before = load_spec(path).train if path is not None and path.is_file() else TrainSpec()
    rate = before.learning_rate / 10 if learning_rate is None else learning_rate
    for name, fits, rule, value in (
        ("steps", 0 <= steps <= MOST_STEPS, "must be from 0 to 10 million", steps),
        ("learning_rate", 0 < rate < np.inf, "must be positive", rate),
        ("seed", 0 <= seed < 2**32, "must be from 0 to 2^32 - 1", seed),
    ):
        if not fits:
            raise InputError(name, rule, value, "Correct it, or leave it out.")
    asked = {"steps": steps, "learning_rate": rate, "seed": seed}
    return before.model_copy(update={"freeze": "optics", "schedule": "cosine", **asked})


@dataclass(frozen=True, eq=False, kw_only=True)
class FineTuning(TrainingJob):
    """A training of a model on real pairs, with the PSFs of their camera; `pairs` are their names for the record."""

    model: Model
    psfs: PsfPair
    perceptual: Any
    data: PairData
    held_out: Pairs
    pairs: Mapping[str, Any]

    def initial(self) -> "FinetuneState":
        """The state before the first step."""
        network = self.model.network
        return FinetuneState(0, network, optax.scale_by_adam().init(eqx.filter(network, eqx.is_inexact_array)))

    def step(self, state: "FinetuneState", batch: Batch) -> tuple["FinetuneState", dict[str, Any]]:
        """Take one step with crops of pairs; the memory of the state that is given is used again.

        Raises:
            InputError: the loss is no longer finite.
        """
        images = (jnp.asarray(np.stack(each)) for each in zip(*(item.pair for item in batch.items), strict=True))
        capture, reference, mask = images
        mirrored, rate = [item.mirrored for item in batch.items], rates_at(self.options, state.step).network
        options = self.perceptual, self.options, jnp.float32(rate)
        given = _Given(*self._psfs(), capture, reference, mask, jnp.asarray(mirrored), *options)
        (network, moments), loss, terms = _update()(given, (state.network, state.moments))
        line = history_line("finetune", state.step, loss, terms, {"network": rate}, "Lower the learning rate.")
        return FinetuneState(state.step + 1, network, moments), line

    def _psfs(self) -> tuple[Float[Array, "c ky kx"], Float[Array, "c kv ku"]]:
        return jnp.asarray(self.psfs.far), jnp.asarray(self.psfs.near)

    def evaluate(self, state: "FinetuneState") -> EvaluationResult:
        """Judge a state by the middle of the held-out pairs."""
        far, near = (psf[None] for psf in self._psfs())

        def looks() -> Iterator[HeldOutScene]:
            for k, files in enumerate(self.held_out.files):
                pair = cut(self.held_out.get(k), self.data.shape)
                found = _reconstructed(state.network, far, near, jnp.asarray(pair.capture)[None])
                shown = {"capture": srgb_from_linear(pair.capture), "reconstruction": np.asarray(found)[0]}
                yield HeldOutScene(files.name, shown, pair.reference, pair.mask)

        return judge(looks(), self.lpips, lambda image: np.repeat(self.model.rgb(image), 3 // len(image), axis=0))

    def caption(self, state: "FinetuneState") -> tuple[str, str]:
        """Title and words for a picture of validation."""
        words = "middle of real pairs never trained on; PSNR"
        if any(pair.mask is not None for pair in self.held_out.files):
            words += ", and in brackets where it is covered"
        return f"{self.title}, fine-tuned by {state.step} steps", words

    def write_results(self, folder: Path, state: "FinetuneState") -> list[str]:
        """Write network, PSFs and scores."""
        before, after = (self.evaluate(each) for each in (self.initial(), state))
        metrics = {**after.means, "before": before.means["reconstruction"], "scenes": after.scenes}
        write_atomic(folder / "metrics.json", canonical_json(metrics))
        write_bank(folder / BANK_NAME, self.psfs.bank)
        about = {
            "colours": list(self.model.colours),
            "wavelengths_m": list(self.model.wavelengths_m),
            "pixel_m": self.model.pixel_m,
            # At these depths it is given the PSFs that it was tuned with.
            "near_m": [self.psfs.near_m],
            "far_m": None if self.psfs.far_m == max(self.psfs.bank.depths_m) else self.psfs.far_m,
            "run": self.title,
            "finetuned": {**self.settings, "pairs": self.pairs, "version": __version__},
            "before": dict(self.model.about),
        }
        write_network(folder / NETWORK_NAME, state.network, about)
        return [NETWORK_NAME, BANK_NAME, "metrics.json"]


class FinetuneState(NamedTuple):
    """Everything a step changes: steps done, the network, and Adam's moments."""

    step: int
    network: Network
    moments: optax.OptState


def mirrored_as(psf: Float[Array, "c ky kx"], mirrored: Bool[Array, " b"]) -> Float[Array, "b c ky kx"]:
    """The PSFs of every item: those of the mirrored DOE where left and right are exchanged."""
    return jnp.where(mirrored[:, None, None, None], psf[None, ..., ::-1], psf[None])


class _Given(NamedTuple):
    """All that a step depends on besides the state."""

    far: Array
    near: Array
    capture: Array
    reference: Array
    mask: Array
    mirrored: Array
    perceptual: Any
    options: TrainSpec
    rate: Array


_Learnt = tuple[Network, optax.OptState]


@partial(eqx.filter_value_and_grad, has_aux=True)
def _slopes(network: Network, given: _Given) -> tuple[Array, Array]:
    """The loss and its terms, with the gradient by the network."""
    psfs = mirrored_as(given.far, given.mirrored), mirrored_as(given.near, given.mirrored)
    half, checkpointed = given.options.precision == "mixed", given.options.checkpointing
    picture = network(given.capture, *psfs, half=half, checkpointed=checkpointed)
    return losses(picture, given.reference, given.mask, given.options, given.perceptual)


def _take(given: _Given, learnt: _Learnt) -> tuple[_Learnt, Array, Array]:
    """One step in arrays."""
    network, moments = learnt
    (loss, terms), slope = _slopes(network, given)
    return adam_step(network, slope, moments, given.rate), loss, terms


@cache
def _update() -> Callable[[_Given, _Learnt], Any]:
    """The compiled step."""
    return compiled_step(_take)


@eqx.filter_jit
def _reconstructed(network: Network, far: Array, near: Array, capture: Array) -> Array:
    return network(capture, far, near)
