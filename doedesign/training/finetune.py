"""One step of fine-tuning: a trained network, real pairs, and the PSFs of the camera that took them (paper §4).

The loss is that of training (eq. 13); its masked term counts where a mask is known. The optics is glass by now, so the
network alone moves. A step is a pure function of the state and the batch.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float

from doedesign.recon.model import PsfPair
from doedesign.recon.network import Network
from doedesign.runtime.compiling import compiled_step
from doedesign.spec.training import TrainSpec
from doedesign.training.crops import PairBatch
from doedesign.training.joint import TrainingRecord, rates_at
from doedesign.training.loss import TERMS, Weights, losses
from fab.errors import InputError


class FinetuneState(NamedTuple):
    """Everything a step changes.

    Attributes:
        step: number of steps done.
        network: the network.
        moments: Adam's moments.
    """

    step: int
    network: Network
    moments: optax.OptState


class Tuner(eqx.Module):
    """What stays the same from step to step. `Tuner.of` makes one.

    Attributes:
        far: `[c, y, x]` PSFs of the scene.
        near: `[c, y, x]` PSFs of the obstruction.
        perceptual: perceptual distance, or None.
        options: steps, step sizes and weights of the loss.
    """

    far: Float[Array, "c ky kx"]
    near: Float[Array, "c kv ku"]
    perceptual: Any
    options: TrainSpec = eqx.field(static=True)

    @classmethod
    def of(cls, psfs: PsfPair, options: TrainSpec, perceptual: Any = None) -> "Tuner":
        """Prepare fine-tuning.

        Args:
            psfs: PSFs of the camera.
            options: how to train; what it says of the optics is not looked at.
            perceptual: distance of two batches (`doedesign.training.perceptual`); None leaves the term out.
        """
        return cls(jnp.asarray(psfs.far), jnp.asarray(psfs.near), perceptual, options)

    def initial(self, network: Network) -> FinetuneState:
        """The state before the first step."""
        return FinetuneState(0, network, optax.scale_by_adam().init(eqx.filter(network, eqx.is_inexact_array)))

    def rate(self, step: int) -> float:
        """Step size of Adam."""
        return rates_at(self.options, step).network

    def step(self, state: FinetuneState, batch: PairBatch) -> tuple[FinetuneState, TrainingRecord]:
        """Take one step.

        Args:
            state: the state; its memory is used again.
            batch: crops of pairs.

        Raises:
            InputError: the loss is no longer finite.
        """
        given = Given(*(jnp.asarray(each) for each in batch[:4]))
        constants = self, given, jnp.float32(self.rate(state.step))
        (network, moments), loss, terms = _update()(constants, (state.network, state.moments))
        record = TrainingRecord(state.step, float(loss), dict(zip(TERMS, np.asarray(terms).tolist(), strict=True)))
        if not np.isfinite(record.loss):
            rule, cure = "the loss must stay finite", "Lower --learning-rate."
            raise InputError(f"finetune, step {state.step}", rule, record.loss, cure)
        return FinetuneState(state.step + 1, network, moments), record

    def reconstruct(self, state: FinetuneState, capture: Float[np.ndarray, "c y x"]) -> Float[np.ndarray, "c y x"]:
        """One capture through the network, in display values."""
        return np.asarray(_look(state.network, self.far[None], self.near[None], jnp.asarray(capture)[None]))[0]


def mirrored_as(psf: Float[Array, "c ky kx"], mirrored: Bool[Array, " b"]) -> Float[Array, "b c ky kx"]:
    """The PSFs of every item: those of the mirrored plate where left and right are exchanged."""
    return jnp.where(mirrored[:, None, None, None], psf[None, ..., ::-1], psf[None])


class Given(NamedTuple):
    """The arrays of a batch."""

    capture: Array
    reference: Array
    mask: Array
    mirrored: Array


def _loss(network: Network, tuner: Tuner, given: Given) -> tuple[Array, Array]:
    options = tuner.options
    picture = network(
        given.capture,
        mirrored_as(tuner.far, given.mirrored),
        mirrored_as(tuner.near, given.mirrored),
        half=options.precision == "mixed",
        checkpointed=options.checkpointing,
    )
    weights = Weights(options.l1, options.perceptual, options.masked)
    return losses(picture, given.reference, given.mask, weights, tuner.perceptual)


Learnt = tuple[Network, optax.OptState]


def _take(constants: tuple[Tuner, Given, Array], learnt: Learnt) -> tuple[Learnt, Array, Array]:
    """One step in arrays."""
    (tuner, given, rate), (network, moments) = constants, learnt
    (loss, terms), slopes = eqx.filter_value_and_grad(_loss, has_aux=True)(network, tuner, given)
    direction, moments = optax.scale_by_adam().update(slopes, moments)
    moved = eqx.apply_updates(network, jax.tree.map(lambda d: -rate * d, direction))
    return (moved, moments), loss, terms


@cache
def _update() -> Callable[[tuple[Tuner, Given, Array], Learnt], Any]:
    """The compiled step."""
    return compiled_step(_take)


@eqx.filter_jit
def _look(network: Network, far: Array, near: Array, capture: Array) -> Array:
    return network(capture, far, near)
