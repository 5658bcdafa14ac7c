"""Pieces of cells between the lines of the masks: what is open in each, and the light that passes each.

Complex numbers are kept as real and imaginary parts here, and sums over pieces are matrix products, because that is
what compiles to fast loops.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sim.surface.cell import Cuts
from sim.surface.relief import TilePlan

TILE = 32  # cells
PRECISION = jax.lax.Precision.HIGHEST


# States of a mask along an axis: 0, 1 and 2 are before, between and behind its lines in the cell; 2 is also the first
# of the next cell, and so on.
STATES = range(-2, 5)


def mask_states(
    state: Float[Array, "side side"],
    along_y: Cuts,
    along_x: Cuts,
    mask: Int[Array, ""],
    bias: Float[Array, ""],
    kinds: range,
    plan: TilePlan,
) -> Float[Array, "j i t t"]:
    """Open share of one mask in each of its kinds of piece, for all cells of a tile.

    `state` holds the mask's pixels with a halo; of `bias`, the growth of openings, only the sign counts; `kinds` are
    the states along either axis.
    """
    cell, within = (np.array(part) for part in zip(*(divmod(kind, 2) for kind in kinds), strict=True))

    def seen(along: Cuts) -> tuple[Array, Array]:
        return plan.reach + along.low[mask, within] + cell, plan.reach + along.high[mask, within] + cell

    def joined(of: Array, pixels: tuple[Array, Array], axis: int) -> Array:
        first, second = (jax.lax.dynamic_slice_in_dim(of, pixel, TILE, axis) for pixel in pixels)
        return jnp.where(bias >= 0, jnp.maximum(first, second), jnp.minimum(first, second))

    # Loops compile to copies of rows; side by side in one expression, every element would look for its piece.
    across = jax.lax.map(lambda pixels: joined(state, pixels, 1), seen(along_x))
    return jax.lax.map(lambda pixels: joined(across, pixels, 1), seen(along_y))


@jax.custom_jvp
def light_of(height: Float[Array, "p c"], rates: Float[Array, " w"]) -> Float[Array, "p 2 w c"]:
    """Transmission of every piece, real and imaginary part apart, so that all sums over pieces are real products.

    One sine of the phase and of the phase plus a quarter, to 4e-6 like `sim.propagation.pupil.cis`: without complex
    numbers it compiles to a loop several times faster.
    """
    waves = height[:, None] * rates[None, :, None]
    waves = jnp.stack([waves + 0.25, waves], axis=1)
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

    def plus(self, other: "Pair", factor: Array) -> "Pair":
        """Sum with a multiple."""
        return Pair(self.real + factor * other.real, self.imaginary + factor * other.imaginary)


def summed(weights: Float[Array, "m ..."], values: Float[Array, "..."], kept: int = 3) -> Float[Array, "m ..."]:
    """Sum over pieces (or lines, or crossings) of values times each row of weights; the last `kept` axes stay."""
    rows, rest = weights.shape[0], values.shape[-kept:]
    product = jnp.dot(weights.reshape(rows, -1), values.reshape(-1, np.prod(rest)), precision=PRECISION)
    return product.reshape(rows, *rest)
