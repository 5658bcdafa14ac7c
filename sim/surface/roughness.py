"""Surface roughness as a random height per cell: Gaussian statistics with correlation exp(-r^2 / length^2).

The covariance of cell means is separable and has a closed form, so the field is white noise filtered along one axis and
then the other, with the filter whose square has that covariance. The field repeats at the plate's edges.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.fft
import scipy.special
from jaxtyping import Array, Float

from fab.grid import Grid
from sim.propagation.pupil import block_size, in_blocks
from sim.tracing import is_traced

# White noise is the limit of a length of zero; its cell means have no variance.
_SHORTEST = 1e-4  # cells
_THREADS = 2


def _covariance(length: Any, size: int) -> Any:
    """Covariance of means over cells, along one axis of `size` cells, of a field of variance 1; `length` in cells.

    In single precision where the length is traced.
    """
    traced = is_traced(length)
    xp, erfc = (jnp, jax.lax.erfc) if traced else (np, scipy.special.erfc)
    lags = np.arange(size // 2 + 1, dtype=np.float32 if traced else np.float64)
    length = xp.maximum(length, _SHORTEST)

    # The second antiderivative of exp(-x^2 / L^2) less its asymptote, whose second difference is at lag 0 alone.
    def tail(x: np.ndarray) -> Any:
        scaled = np.abs(x) / length
        return length**2 / 2 * (np.sqrt(np.pi) * scaled * erfc(scaled) - xp.exp(-(scaled**2)))

    bend = tail(lags + 1) - 2 * tail(lags) + tail(lags - 1)
    return xp.where(lags == 0, np.sqrt(np.pi) * length, 0.0) - bend


def cell_share(length: Any) -> Any:
    """Share of the variance that means over square cells keep; `length` is the correlation length in cells."""
    return _covariance(length, 1)[0] ** 2


def cell_roughness(grid: Grid, rms_m: Array | float, length_m: Array | float, seed: int) -> Float[Array, "y x"]:
    """Mean height of every cell, metres, of a surface of that rms, of which cell means keep a part (`cell_share`).

    The same seed gives the same hills for every rms and length.
    """
    field: Any = np.random.default_rng(seed).standard_normal(grid.shape, np.float32)
    for _ in range(2):  # along x, then along what was y
        field = _filtered_rows(field, _gain(length_m / grid.pitch_m, field.shape[1])).T
    return jnp.asarray(field) * rms_m


def _gain(length: Any, size: int) -> Any:
    """Amplitudes of the filter whose square has the covariance of cell means."""
    xp = jnp if is_traced(length) else np
    covariance = _covariance(length, size)
    around = xp.concatenate([covariance, covariance[1 : (size + 1) // 2][::-1]])
    power = xp.fft.rfft(around).real
    # Rounding can push the tail below zero, and hills of more than a quarter of the plate, which have a kink where they
    # repeat, do: what there cannot be is taken from the rest, so that the variance stays.
    there = xp.maximum(power, 1e-12)
    counts = np.where(np.arange(len(power)) * 2 % size == 0, 1, 2)  # frequencies that each stands for
    return xp.sqrt(there * ((counts * power).sum() / (counts * there).sum())).astype(np.float32)


def _filtered_rows(field: Float[Array, "y x"] | Float[np.ndarray, "y x"], gain: Any) -> Any:
    rows, size = field.shape
    if not is_traced(field, gain):
        spectrum = scipy.fft.rfft(field, workers=_THREADS) * gain
        return scipy.fft.irfft(spectrum, size, workers=_THREADS)

    def block(part: Array) -> Array:
        return jnp.fft.irfft(jnp.fft.rfft(part) * gain, n=size)

    return jax.lax.map(block, in_blocks(jnp.asarray(field), block_size(rows))).reshape(-1, size)[:rows]
