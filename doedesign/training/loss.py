"""The loss of training (paper eq. 13), a step of Adam along it, and its line in the history.

The loss is the mean absolute error, the perceptual distance and the error where the scene was hidden, each with its
weight, in display values, which is how pictures are looked at. The masked term is a mean over the whole picture, so a
small obstruction weighs little; its mask is the sharp one, before any blur.
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from doedesign.spec.training import TrainSpec
from fab.errors import InputError

_TERMS = ("l1", "perceptual", "masked")


def losses(
    reconstruction: Float[Array, "b c y x"],
    reference: Float[Array, "b c y x"],
    mask: Float[Array, "b y x"],
    options: TrainSpec,
    perceptual: Any = None,
) -> tuple[Float[Array, ""], Float[Array, " term"]]:
    """The loss, a mean over the batch, and its terms `[l1, perceptual, masked]` before they are weighted.

    Display values are not clipped; the mask is the share of each direction that was blocked. The perceptual distance of
    two batches (`doedesign.training.distance.perceptual`) is left out where its weight in the options is 0.
    """
    error = jnp.abs(reconstruction - reference)
    parts = [
        jnp.mean(error),
        jnp.mean(perceptual(reconstruction, reference)) if options.perceptual and perceptual is not None else 0.0,
        jnp.mean(error * mask[:, None]),
    ]
    terms = jnp.stack([jnp.asarray(part, jnp.float32) for part in parts])
    return jnp.dot(jnp.asarray((options.l1, options.perceptual, options.masked), jnp.float32), terms), terms


def adam_step(part: Any, slope: Any, moments: optax.OptState, rate: Array) -> tuple[Any, optax.OptState]:
    """One step of Adam: the moved part, and the new moments."""
    direction, moments = optax.scale_by_adam().update(slope, moments)
    return eqx.apply_updates(part, jax.tree.map(lambda d: -rate * d, direction)), moments


def history_line(
    name: str, step: int, loss: Array, terms: Array, rates: Mapping[str, float], cure: str
) -> dict[str, Any]:
    """The line of the history (`doedesign.training.history`): the loss of a step before its update.

    Raises:
        InputError: the loss is no longer finite.
    """
    if not np.isfinite(loss):
        raise InputError(f"{name}, step {step}", "the loss must stay finite", float(loss), cure)
    parts = dict(zip(_TERMS, np.asarray(terms).tolist(), strict=True))
    return {"step": step, "loss": float(loss), "parts": parts, "learning_rates": rates}
