"""Levels in the loop: named ways to round a height map while it is optimised.

All end with every cell at its nearest level; they differ in the height that a step looks at and in its gradient.

    none              continuous, and reported so: what the levels cost
    at_end            continuous; rounded at the end
    straight_through  rounded, with the gradient of the continuous height (Y. Bengio et al., arXiv:1308.3432)
    annealed          a blend of continuous and rounded, whose share of the first falls (L. Li et al., CVPR 2022)
    gumbel            a random blend of the four nearest levels that ends in one of them (E. Jang et al.,
                      arXiv:1611.01144; scores by distance as S. Choi et al., SIGGRAPH 2022)
    stochastic        one of the two nearest levels at random, so that the mean is the continuous height, with the
                      gradient of that (M. Croci et al., R. Soc. Open Sci. 9, 211631)
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

from doedesign.spec.values import RANDOM_QUANTISATIONS

# A level half a step off is as likely as its neighbour; one that is three quarters off is 55 times less so than one
# that is a quarter off: 8 (0.75² - 0.25²) = 4.
_SHARPNESS = 8.0
_WARMEST, _COLDEST = 2.0, 0.1  # temperature of the blend at the beginning and at the end


class Rounding(NamedTuple):
    """How far rounding has come at a step.

    Attributes:
        softness: 1 at first and 0 when what is looked at is what will be drawn.
        key: of what the step draws at random; None for a strategy that draws nothing.
    """

    softness: Float[Array | np.ndarray, ""]
    key: UInt32[Array, "2"] | None = None


CONTINUOUS = Rounding(np.ones((), np.float32))
ROUNDED = Rounding(np.zeros((), np.float32))


def rounding_at(quantisation: str, seed: int, step: int, steps: int) -> Rounding:
    """Rounding of a step, which the seed and the step decide."""
    remaining = float(np.clip((0.9 * steps - step) / max(0.8 * steps, 1), 0.0, 1.0))  # from a tenth to nine tenths
    softness = {
        "none": 1.0,
        "at_end": 1.0,
        "straight_through": 0.0,
        "annealed": remaining**3,
        "gumbel": (1 - np.cos(np.pi * remaining)) / 2,
        "stochastic": 0.0,
    }[quantisation]
    random = quantisation in RANDOM_QUANTISATIONS
    key = jax.random.fold_in(jax.random.PRNGKey(seed), step) if random else None
    return Rounding(jnp.float32(softness), key)


def stochastic_level(height: Float[Array, "*s"], rounding: Rounding) -> Float[Array, "*s"]:
    """One of the two nearest whole numbers, at random, with the height as its mean."""
    assert rounding.key is not None
    return jnp.floor(height + jax.random.uniform(rounding.key, height.shape))


def blended_level(height: Float[Array, "*s"], rounding: Rounding) -> Float[Array, "*s"]:
    """A random blend of the four nearest whole numbers, with its own gradient (Gumbel-softmax).

    Scores fall with the square of the distance, and the temperature with the softness.
    """
    assert rounding.key is not None
    temperature = _COLDEST + (_WARMEST - _COLDEST) * rounding.softness
    below = jax.lax.stop_gradient(jnp.floor(height))
    offsets = [below + k - height for k in (-1.0, 0.0, 1.0, 2.0)]
    noise = jax.random.gumbel(rounding.key, (4, *height.shape))
    scores = [(random - _SHARPNESS * d**2) / temperature for d, random in zip(offsets, noise, strict=True)]
    highest = jax.lax.stop_gradient(jnp.max(jnp.stack(scores), 0))
    weights = [jnp.exp(score - highest) for score in scores]
    return height + sum(w * d for w, d in zip(weights, offsets, strict=True)) / sum(weights)
