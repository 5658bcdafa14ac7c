"""Training of a rival, as the project's own network is trained.

It sees the same pictures behind the same obstructions in the same order, with the same noise, for as many steps; only
what it is shown differs (`doedesign.evaluation.rivals.registry.Rival.given`). The loss is that of training (eq. 13),
with the terms of its own idea and, where it has an adversary, how well that is deceived; network and adversary take
their steps together. Its scenes lie on the axis, its plate stays as it is and has no errors, and it computes in single
precision.

A folder of a training (`doedesign.training.job`) has besides

    spec.toml           the spec with overrides and defaults; optional keys where they differ
    pictures.json       names of all pictures, trained on and held out, and their licence
    network.npz         the trained network (`doedesign.evaluation.rivals.files`)
    metrics.json        scores on held-out scenes
"""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Key

from doedesign import __version__
from doedesign.build import camera_from_spec
from doedesign.capture.camera import CaptureModel
from doedesign.capture.from_spec import rgb_from_channels, sensor_from_spec
from doedesign.capture.scenes import Batch, SceneData
from doedesign.design.design import Design
from doedesign.design.levels.quantisation import ROUNDED
from doedesign.evaluation.rivals.adversary import Adversary
from doedesign.evaluation.rivals.files import TrainedRival, detached, open_rival, rival_named, write_rival
from doedesign.evaluation.rivals.layers import Answer, RivalNetwork, count_of, known_of
from doedesign.evaluation.rivals.registry import Given, Rival
from doedesign.recon.weights import NETWORK_NAME, camera_facts
from doedesign.runtime.compiling import compiled_step
from doedesign.runtime.stopping import stoppable
from doedesign.spec import Spec, spec_to_resolved_toml
from doedesign.spec.training import TrainSpec
from doedesign.training.job import TrainingJob, trained
from doedesign.training.joint import LOOK_SEED, Trainer, rates_at, scenes_seen
from doedesign.training.loss import adam_step, history_line, losses
from doedesign.training.optics import TrainingDoe, TrainingScene, shots
from doedesign.training.train import Prepared, prepared, trained_near_m
from doedesign.training.validation import EvaluationResult, HeldOutScene, judge
from fab.errors import InputError
from fab.files import canonical_json, sha256_bytes, write_atomic
from sim.light import srgb_from_linear

FORMAT = "doedesign rival training 1"

ADVERSARIAL = 0.01  # weight of the adversary, as in the papers of both networks that have one
_LEAST_JUDGED = 32  # pixels per side that an adversary takes
_log = logging.getLogger("doedesign")


def train_rival(
    rival: str | Rival,
    design: Design,
    images: str | Path | None = None,
    out: str | Path | None = None,
    *,
    occlusion: str | None = None,
    obstruction: str | None = None,
    validation: str | Path | None = None,
    lpips_weights: Sequence[Path] = (),
    licence: str | None = None,
    overrides: Sequence[str] = (),
    width: int | None = None,
    adversarial: float = ADVERSARIAL,
    **options: Any,
) -> TrainedRival:
    """Train a rival behind a design, behind a plain lens, or on sharp scenes with holes, as it is meant to be shown.

    Args:
        rival: the rival, or its name.
        design: the DOE, as it is drawn; its spec says how to train. Give the one that was trained with the project's
            own network.
        images: folder of pictures; scikit-image's samples if None.
        out: folder, in which a stopped training goes on where it was stopped; a temporary one, which is removed, if
            None.
        occlusion: occlusion model (`sim.imaging.occlusion`); that of the spec if None.
        obstruction: kind, or folder of masks; that of the spec if None.
        validation: folder to take the held-out pictures from; the same one if None.
        lpips_weights: files with the weights of LPIPS; multi-scale SSIM stands in for it without them.
        licence: licence of the pictures, for the record.
        overrides: changes that led to the spec, for the record.
        width: features of the network's finest scale; its own usual width if None.
        adversarial: weight of the adversary in the loss, where the rival has one; 0 trains without it.
        options: changes to how the spec says to train (`doedesign.spec.training.TrainSpec`): `steps`, `batch`, `size`,
            `learning_rate`, `seed` and others.

    Raises:
        InputError: an unknown rival, a picture or number that cannot be used, a folder that belongs to something else,
            or a loss that is no longer finite.
        KeyboardInterrupt: it was stopped; the same call goes on from there.
    """
    chosen = rival_named(rival) if isinstance(rival, str) else rival
    if not (np.isfinite(adversarial) and adversarial >= 0):
        raise InputError("adversarial", "must be a weight of 0 or more", adversarial, "Correct it, or leave it out.")
    how_given = {**options, **rival_options(chosen)}
    with stoppable():  # which ends the preparation, too
        made = prepared(design, images, validation, occlusion, obstruction, lpips_weights, licence, how_given)
        spec, how = made.spec, made.spec.train
        if chosen.judge is None:
            adversarial = 0.0
        network = _drawn(chosen, len(spec.optics.colours), how, width, adversarial, made.source)
        view = _view_of(chosen.given, made)
        # A rival that does not look through the plate does not depend on it.
        plate = made.design.nominal_height_m.tobytes() if chosen.given == "doe capture" else None
        settings = {
            **made.settings,
            "format": FORMAT,
            "height_sha256": "" if plate is None else sha256_bytes(plate),
            **_facts(chosen, network),
            "adversarial": adversarial,
        }
        job = RivalTraining(
            name="training of a rival",
            title=f"{chosen.name}, {spec.name}",
            options=how,
            settings=settings,
            remarks={"licence": licence, "overrides": list(overrides)},
            inputs={
                "spec.toml": spec_to_resolved_toml(spec, overrides).encode(),
                "pictures.json": canonical_json(made.pictures),
            },
            differs="one of another rival, run, spec, occlusion model, loss or other pictures",
            rival=chosen,
            spec=spec,
            network=network,
            view=view,
            near_m=trained_near_m(spec, made.kind),
            adversarial=adversarial,
            data=made.data,
            held_out=made.held_out,
            lpips=made.lpips,
            pictures=made.pictures,
        )
    found = trained(job, out, open_rival)
    return detached(found) if out is None else found


def rival_options(rival: Rival) -> dict[str, Any]:
    """How a rival is trained, whatever a spec says of the project's own network."""
    camera = "doe" if rival.given == "doe capture" else "conventional"
    return {"freeze": "optics", "field": "off", "fabricated": False, "precision": "float32", "camera": camera}


def _facts(rival: Rival, network: RivalNetwork) -> dict[str, Any]:
    """Entries of a file on a rival, for JSON."""
    return {
        "rival": rival.name,
        "after": rival.after,
        "layout": network.layout,
        "parameters": count_of(network),
        "original_parameters": rival.original_parameters,
        "original_parameters_from": rival.parameters_from,
        "given": rival.given,
        "mask_given": rival.mask_given,
    }


def _drawn(
    rival: Rival, colours: int, how: TrainSpec, width: int | None, adversarial: float, source: str
) -> RivalNetwork:
    """The network before the first step; an InputError for a width or a size that it cannot have."""
    try:
        network = rival.make(colours, how.seed, **({} if width is None else {"width": width}))
    except (TypeError, ValueError, ZeroDivisionError) as error:
        rule = f"must be one that {rival.name} can have"
        raise InputError("width", rule, f'{width}, "{error}"', "Leave it out.") from error
    multiple = network.multiple
    least = max(2 * multiple, _LEAST_JUDGED if adversarial else 0)
    if how.size % multiple or how.size < least:
        rule = f"must be a multiple of {multiple} for {rival.name}, at least {least}"
        raise InputError(f"{source}: train.size", rule, how.size, "Choose another size.")
    return network


class RivalState(NamedTuple):
    """Everything a step changes: steps done, network, adversary (None without one), and Adam's moments of both."""

    step: int
    network: RivalNetwork
    adversary: Adversary | None
    moments: optax.OptState
    adversary_moments: optax.OptState | None


class RivalView(eqx.Module):
    """The way from scenes to what a rival is shown; `doe` is None for one that is shown sharp scenes."""

    doe: TrainingDoe | None
    perceptual: Any
    bench: CaptureModel = eqx.field(static=True)
    given: Given = eqx.field(static=True)

    def seen(self, batch: Batch, seed: int) -> tuple[TrainingScene, Key[Array, " b"]]:
        """Scenes of a batch for the compiled step, with a noise key for each."""

        def sources(depth_m: float, number: int) -> tuple[Any, ...]:
            del number
            return () if self.doe is None else self.doe.sources(depth_m)

        return scenes_seen(self.bench, sources, batch.items, batch.step * len(batch.items), seed)

    def pictures(self, scenes: TrainingScene, keys: Key[Array, " b"]) -> tuple[Array, Array, Array]:
        """Make what is shown `[b, y, x, c]`, what should be seen, both display values, and the masks `[b, y, x]`."""
        reference = jnp.moveaxis(srgb_from_linear(jnp.asarray(scenes.scene.background)), 1, -1)
        mask = jnp.asarray(scenes.scene.obstructions[0].mask)
        if self.doe is None:
            return reference * known_of(mask), reference, mask
        light = shots(scenes, self.doe, None, ROUNDED, self.bench, keys).capture
        return jnp.moveaxis(srgb_from_linear(light), 1, -1), reference, mask


def _view_of(given: Given, made: Prepared) -> RivalView:
    """The camera, with the PSFs of its optic where there is a capture."""
    if given == "scene with hole":
        camera = replace(camera_from_spec(made.spec), window=made.spec.sensor.window | 1)
        bench = CaptureModel.make(camera, made.kind, made.occlusion, sensor_from_spec(made.spec))
        return RivalView(None, made.perceptual, bench, given)
    _log.info("preparing propagation")
    height = made.design.nominal_height_m
    trainer = Trainer.of(made.spec, made.source, made.occlusion, made.kind, height, perceptual=made.perceptual)
    return RivalView(trainer.doe, made.perceptual, trainer.bench, given)


@dataclass(frozen=True, eq=False, kw_only=True)
class RivalTraining(TrainingJob):
    """A training of a rival; `network` is the one before the first step. Held-out scenes come one to a batch."""

    rival: Rival
    spec: Spec
    network: RivalNetwork
    view: RivalView
    near_m: tuple[float, ...]
    adversarial: float
    data: SceneData
    held_out: SceneData
    pictures: Mapping[str, Any]

    def initial(self) -> RivalState:
        """The state before the first step."""
        adam, adversary, moments = optax.scale_by_adam(), None, None
        if self.adversarial and self.rival.judge is not None:
            adversary = self.rival.judge(self.network.colours, self.options.seed)
            moments = adam.init(eqx.filter(adversary, eqx.is_inexact_array))
        # A copy: a step uses the memory of its state again.
        network = jax.tree.map(lambda leaf: jnp.array(leaf) if eqx.is_array(leaf) else leaf, self.network)
        return RivalState(0, network, adversary, adam.init(eqx.filter(network, eqx.is_inexact_array)), moments)

    def step(self, state: RivalState, batch: Batch) -> tuple[RivalState, dict[str, Any]]:
        """Take one step; the memory of the state that is given is used again.

        Raises:
            InputError: the loss is no longer finite.
        """
        how, rate = self.options, rates_at(self.options, state.step).network
        scenes, keys = self.view.seen(batch, how.seed)
        given = _Step(
            self.view, scenes, keys, how, self.rival.mask_given, jnp.float32(self.adversarial), jnp.float32(rate)
        )
        changing, loss, terms, more = _update()(given, tuple(state[1:]))
        rates = {"network": rate}
        line = history_line(f"{self.rival.name}", state.step, loss, terms, rates, "Lower train.learning_rate.")
        names = ("own", "deception", "adversary") if state.adversary is not None else ("own",)
        line["parts"] |= dict(zip(names, np.asarray(more).tolist(), strict=False))
        return RivalState(state.step + 1, *changing), line

    def evaluate(self, state: RivalState) -> EvaluationResult:
        """Judge a state by the held-out scenes; "capture" is what the rival was shown."""

        def looks() -> Iterator[HeldOutScene]:
            with self.held_out.batches(stop=self.options.validation) as batches:
                for batch in batches:
                    scenes, keys = self.view.seen(batch, LOOK_SEED)
                    found = _look(state.network, self.view, scenes, keys, self.rival.mask_given)
                    shown, picture, reference = (np.moveaxis(np.asarray(f, np.float32)[0], -1, 0) for f in found[:3])
                    pair = {"capture": shown, "reconstruction": picture}
                    yield HeldOutScene(batch.items[0].name, pair, reference, np.asarray(found[3])[0])

        return judge(looks(), self.lpips, lambda image: rgb_from_channels(image, self.view.bench.camera))

    def caption(self, state: RivalState) -> tuple[str, str]:
        """Title and words for a picture of validation."""
        words = f"occlusion model {self.settings['occlusion']}, shown: {self.rival.given}; PSNR in brackets: "
        return f"{self.title}, step {state.step}", words + "where it is covered"

    def write_results(self, folder: Path, state: RivalState) -> list[str]:
        """Write network and scores."""
        found = self.evaluate(state)
        write_atomic(folder / "metrics.json", canonical_json({**found.means, "scenes": found.scenes}))
        about = {
            **camera_facts(self.view.bench.camera, self.near_m),
            **self.settings,
            "options": {name: getattr(self.options, name) for name in _OPTIONS},
            "steps": state.step,
            "pictures": self.pictures,
            "version": __version__,
        }
        write_rival(folder / NETWORK_NAME, self.rival.name, state.network, about)
        for data in (self.data, self.held_out):
            if skips := data.pictures.skips():
                _log.info("%s", skips)
        return [NETWORK_NAME, "metrics.json"]


_OPTIONS = ("steps", "batch", "size", "learning_rate", "schedule", "seed", "l1", "perceptual", "masked")


class _Step(NamedTuple):
    """All that a step depends on besides the state."""

    view: RivalView
    scenes: TrainingScene
    keys: Array
    options: TrainSpec
    mask_given: bool
    adversarial: Array
    rate: Array


_Changing = tuple[RivalNetwork, Adversary | None, optax.OptState, optax.OptState | None]


@partial(eqx.filter_value_and_grad, has_aux=True)
def _slopes(network: RivalNetwork, adversary: Adversary | None, given: _Step, pictures: Any) -> tuple[Array, Any]:
    """The loss, its terms before they are weighted, and the answer, with the gradient by the network."""
    shown, reference, mask = pictures
    answer = network(shown, mask if given.mask_given else jnp.zeros_like(mask))
    found, wanted = (jnp.moveaxis(image, -1, 1) for image in (answer.picture, reference))
    loss, terms = losses(found, wanted, mask, given.options, given.view.perceptual)
    own = network.loss(answer, reference, mask)
    deception = jnp.float32(0) if adversary is None else adversary.deception(answer, reference)
    return loss + own + given.adversarial * deception, (terms, own, deception, answer)


@eqx.filter_value_and_grad
def _adversary_slopes(adversary: Adversary, answer: Answer, reference: Array) -> Array:
    """The adversary's error, with its gradient."""
    return adversary.error(answer, reference)


def _take(given: _Step, changing: _Changing) -> tuple[_Changing, Array, Array, Array]:
    """One step in arrays; both see what the other was before it."""
    network, adversary, moments, adversary_moments = changing
    pictures = given.view.pictures(given.scenes, given.keys)
    (loss, (terms, own, deception, answer)), slope = _slopes(network, adversary, given, pictures)
    network, moments = adam_step(network, slope, moments, given.rate)
    error = jnp.float32(0)
    if adversary is not None and adversary_moments is not None:
        fixed = jax.lax.stop_gradient(answer)
        error, slope = _adversary_slopes(adversary, fixed, pictures[1])
        adversary, adversary_moments = adam_step(adversary, slope, adversary_moments, given.rate)
    return (network, adversary, moments, adversary_moments), loss, terms, jnp.stack([own, deception, error])


@cache
def _update() -> Callable[[_Step, Any], Any]:
    """The compiled step."""
    return compiled_step(_take)


@eqx.filter_jit
def _look(
    network: RivalNetwork, view: RivalView, scenes: TrainingScene, keys: Array, mask_given: bool
) -> tuple[Array, Array, Array, Array]:
    """Return what is shown, the answer, what should be seen, and the masks."""
    shown, reference, mask = view.pictures(scenes, keys)
    answer = network(shown, mask if mask_given else jnp.zeros_like(mask))
    return shown, answer.picture, reference, mask
