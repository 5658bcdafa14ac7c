"""Pieces of cells between the lines of the masks: what is open in each, and the light that passes each.

Complex numbers are kept as real and imaginary parts here, and sums over pieces are matrix products, because that is
what compiles to fast loops.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from sim.surface.cell import Cuts
from sim.surface.relief import TilePlan

TILE = 32  # cells
PRECISION = jax.lax.Precision.HIGHEST


# States of a mask along an axis: 0, 1 and 2 are before, between and behind its lines in the cell; 2 is also the first
# of the next cell, and so on. Corners are seen from cells beside their own, so these states are looked at, too.
STATES = range(-2, 5)
_NEIGHBOURS = range(STATES[0] // 2, STATES[-1] // 2 + 1)  # cells in which these states are the first or the second


def mask_states(
    states: Float[Array, "mask side side"], along_y: Cuts, along_x: Cuts, bias: Float[Array, " mask"], plan: TilePlan
) -> Float[Array, "mask 2 2 window window"]:
    """Open share of every mask in states 0 and 1 of the cells of a tile and of their `_NEIGHBOURS`.

    `states` holds the masks' pixels with a halo; of `bias`, the growth of openings, only the sign counts. The second
    and third axes are the states along y and x; see `share_of`.
    """
    window, masks = TILE + len(_NEIGHBOURS) - 1, states.shape[0]
    grows = jnp.repeat(bias >= 0, 2)

    def joined(of: Array, low: Array, high: Array, grows: Array, axis: int) -> Array:
        starts = (plan.reach + _NEIGHBOURS[0] + pixel for pixel in (low, high))
        first, second = (jax.lax.dynamic_slice_in_dim(of, start, window, axis) for start in starts)
        return jnp.where(grows, jnp.maximum(first, second), jnp.minimum(first, second))

    def pixels(along: Cuts) -> tuple[Array, Array, Array]:
        return along.low[:, :2].reshape(-1), along.high[:, :2].reshape(-1), grows

    # Loops compile to copies of rows; side by side in one expression, every element would look for its piece.
    mask = np.arange(2 * masks) // 2
    across = jax.lax.map(lambda at: joined(states[at[0]], *at[1:], axis=1), (mask, *pixels(along_x)))
    across = across.reshape(masks, 2, -1, window)
    found = jax.lax.map(lambda at: joined(across[at[0]], *at[1:], axis=1), (mask, *pixels(along_y)))
    return found.reshape(masks, 2, 2, window, window)


def share_of(shares: Shaped[Array, "mask 2 2 window window"], mask: Any, along_y: Any, along_x: Any) -> Array:
    """Open share `[y, x]` of one mask in given `STATES` along y and x, as `mask_states` has it."""
    places = [(state % 2, state // 2 - _NEIGHBOURS[0]) for state in (along_y, along_x)]
    (within_y, y), (within_x, x) = places
    return jax.lax.dynamic_slice(shares, (mask, within_y, within_x, y, x), (1, 1, 1, TILE, TILE))[0, 0, 0]


def own_states(shares: Float[Array, "mask 2 2 window window"]) -> Float[Array, "mask 3 3 cell"]:
    """Open share of every mask in its states 0, 1 and 2 along either axis of the cells of a tile."""
    masks = shares.shape[0]
    found = jax.lax.map(lambda at: share_of(shares, *at), tuple(np.indices((masks, 3, 3)).reshape(3, -1)))
    return found.reshape(masks, 3, 3, -1)


@jax.custom_jvp
def light_of(height: Float[Array, "p c"], rates: Float[Array, " w"]) -> Float[Array, "p 2 w c"]:
    """Transmission of every piece, real and imaginary part apart, so that all sums over pieces are real products.

    One sine of the phase and of the phase plus a quarter, to 4e-6 like `sim.propagation.pupil.cis`: without complex
    numbers it compiles to a loop several times faster.
    """
    quarter = jnp.array([0.25, 0.0])[:, None, None]
    waves = height[:, None, None] * rates[:, None] + quarter
    waves = waves - jnp.round(waves)
    folded = jnp.copysign(0.25 - jnp.abs(jnp.abs(waves) - 0.25), waves)
    z = folded * folded
    return folded * (6.2831853 + z * (-41.341702 + z * (81.605249 + z * (-76.704978 + z * 42.058))))


@light_of.defjvp
def _light_tangent(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    height, rates = primals
    light = light_of(height, rates)
    phase = 2 * np.pi * (tangents[0][:, None] * rates[None, :, None] + height[:, None] * tangents[1][None, :, None])
    return light, turned(light) * phase[:, None]


def turned(light: Float[Array, "... 2 w c"]) -> Float[Array, "... 2 w c"]:
    """The light times i."""
    return jnp.flip(light, -3) * jnp.array([-1.0, 1.0])[:, None, None]


class Pair(NamedTuple):
    """Complex numbers as two real arrays, for loops that the compiler can vectorise."""

    real: Array
    imaginary: Array

    def times(self, other: "Pair") -> "Pair":
        """Product."""
        return Pair(
            self.real * other.real - self.imaginary * other.imaginary,
            self.real * other.imaginary + self.imaginary * other.real,
        )

    def plus(self, other: "Pair", factor: Array | float = 1.0) -> "Pair":
        """Sum with a multiple of another."""
        return Pair(self.real + factor * other.real, self.imaginary + factor * other.imaginary)


def summed(weights: Float[Array, "m ..."], values: Float[Array, "..."], kept: int = 3) -> Float[Array, "m ..."]:
    """Sum over pieces (or lines, or crossings) of values times each row of weights; the last `kept` axes stay."""
    rows, rest = weights.shape[0], values.shape[-kept:]
    product = jnp.dot(weights.reshape(rows, -1), values.reshape(-1, np.prod(rest)), precision=PRECISION)
    return product.reshape(rows, *rest)
