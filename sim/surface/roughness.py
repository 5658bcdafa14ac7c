"""Surface roughness as a random height per cell: Gaussian statistics with correlation exp(-r^2 / length^2).

The covariance of cell means is separable and has a closed form, so the field is white noise filtered along one axis and
then the other, with the filter whose square has that covariance. The field repeats at the plate's edges.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fab.grid import Grid
from sim.propagation.pupil import block_size, in_blocks


def _covariance(length: Array, lags: Float[Array, " lag"]) -> Float[Array, " lag"]:
    """Covariance of means over cells, along one axis, of a field of variance 1; `length` and `lags` in cells."""

    # The second antiderivative of exp(-x^2 / L^2) less its asymptote, whose second difference is at lag 0 alone.
    def tail(x: Array) -> Array:
        x = jnp.abs(x)
        square = (x / length) ** 2
        return jnp.sqrt(jnp.pi) / 2 * length * x * jax.lax.erfc(x / length) - length**2 / 2 * jnp.exp(-square)

    bend = tail(lags + 1) - 2 * tail(lags) + tail(lags - 1)
    return jnp.where(lags == 0, jnp.sqrt(jnp.pi) * length, 0.0) - bend


def _positive(length: Array) -> Array:
    # White noise is the limit of a length of zero; its cell means have no variance.
    return jnp.maximum(length, 1e-4)


# Compiled as a whole: one by one its operations take seconds to compile.
@jax.jit
def cell_share(length: Float[Array, ""]) -> Float[Array, ""]:
    """Share of the variance that means over square cells keep; `length` is the correlation length in cells."""
    return _covariance(_positive(length), jnp.zeros(1))[0] ** 2


def cell_roughness(grid: Grid, rms_m: Array | float, length_m: Array | float, seed: int) -> Float[Array, "y x"]:
    """Mean height of every cell, metres, of a surface of that rms, of which cell means keep a part (`cell_share`).

    The same seed gives the same hills for every rms and length.
    """
    noise = np.random.default_rng(seed).standard_normal(grid.shape, np.float32)
    return _hills(noise, _positive(jnp.asarray(length_m, jnp.float32) / grid.pitch_m)) * rms_m


@jax.jit
def _hills(field: Float[Array, "y x"], length: Array) -> Float[Array, "y x"]:
    for _ in range(2):  # along x, then along what was y
        size = field.shape[1]
        lags = np.arange(size // 2 + 1, dtype=np.float32)
        covariance = _covariance(length, jnp.asarray(lags))
        around = jnp.concatenate([covariance, covariance[1 : (size + 1) // 2][::-1]])
        # Rounding can push the spectrum's tail below zero.
        gain = jnp.sqrt(jnp.maximum(jnp.fft.rfft(around).real, 1e-12))
        field = _filtered_rows(field, gain).T
    return field


def _filtered_rows(field: Float[Array, "y x"], gain: Float[Array, " f"]) -> Float[Array, "y x"]:
    rows, size = field.shape

    def block(part: Array) -> Array:
        return jnp.fft.irfft(jnp.fft.rfft(part) * gain, n=size)

    return jax.lax.map(block, in_blocks(field, block_size(rows))).reshape(-1, size)[:rows]
