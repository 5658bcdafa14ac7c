"""What training minimises (paper eq. 13): mean absolute error, perceptual distance, and the error where it was hidden.

All of it is in display values, which is how pictures are looked at. The masked term is a mean over the whole picture,
so a small obstruction weighs little; its mask is the sharp one, before any blur.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Weights(NamedTuple):
    """Weight of every term; see `losses`."""

    l1: float = 1.0
    perceptual: float = 1.0
    masked: float = 1.0


TERMS = Weights._fields


def losses(
    reconstruction: Float[Array, "b c y x"],
    reference: Float[Array, "b c y x"],
    mask: Float[Array, "b y x"],
    weights: Weights,
    perceptual: Any = None,
) -> tuple[Float[Array, ""], Float[Array, " term"]]:
    """The loss, and its terms before they are weighted.

    Args:
        reconstruction: `[b, c, y, x]` display values, not clipped.
        reference: `[b, c, y, x]` display values of the scene alone.
        mask: `[b, y, x]` share of each direction that was blocked.
        weights: weight of every term.
        perceptual: distance of two batches, `[b]` (`doedesign.training.perceptual`); left out where its weight is 0.

    Returns:
        the loss, a mean over the batch, and `[l1, perceptual, masked]`.
    """
    error = jnp.abs(reconstruction - reference)
    parts = [
        jnp.mean(error),
        jnp.mean(perceptual(reconstruction, reference)) if weights.perceptual and perceptual is not None else 0.0,
        jnp.mean(error * mask[:, None]),
    ]
    terms = jnp.stack([jnp.asarray(part, jnp.float32) for part in parts])
    return jnp.dot(jnp.asarray(weights, jnp.float32), terms), terms
