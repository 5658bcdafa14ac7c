"""Deconvolution without training: the rows of Table 1 that need no network.

Both take linear light and one PSF for each colour, undo its blur as if everything seen lay at its depth, and know
nothing of obstructions. The picture is mirrored beyond its edges, as in `simulate`.

How hard they try follows from the noise of the capture. A Wiener filter weighs the power of the noise against that of
the picture; taking the picture's for white, it is the ratio of their variances. Richardson-Lucy has noise to fit once
its blurred estimate is as near to the capture as the noise is; there it stops (the discrepancy principle).

References:
    N. Wiener, *Extrapolation, Interpolation, and Smoothing of Stationary Time Series*, 1949. W. H. Richardson,
    "Bayesian-based iterative method of image restoration", JOSA 62 (1972). L. B. Lucy, "An iterative technique for the
    rectification of observed distributions", Astron. J. 79 (1974). V. A. Morozov, *Methods for Solving Incorrectly
    Posed Problems*, 1984, for the discrepancy.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.recon.wiener import sharpened
from sim.imaging.convolve import convolve, plan_otf
from sim.sensor import Sensor
from sim.sensor.noise import RELEASE_WIDTH, TSENG_SCALE, TSENG_SIGMA

ITERATIONS = 100
# Light below which a blurred estimate counts as dark: far below what any sensor tells from black.
_DARK = 1e-6


def noise_variance(capture: Float[np.ndarray, "c y x"], sensor: Sensor) -> Float[np.ndarray, " c"]:
    """Mean variance of a developed capture's noise by the model of its sensor, rounding included, in white squared."""
    light = np.maximum(capture, 0).mean(axis=(1, 2), dtype=np.float64)
    white_e = sensor.white_e(len(light))[:, 0, 0].astype(np.float64)
    by_model = {
        "physical": (light * white_e + sensor.dark_e + sensor.read_noise_e**2) / white_e**2,
        "tseng": TSENG_SCALE * light + TSENG_SIGMA**2,
        "release": np.full(len(light), RELEASE_WIDTH**2 / 3),  # of an even distribution of +-width
        "none": np.zeros(len(light)),
    }[sensor.noise]
    rounding = 0.0 if sensor.bits is None else 1 / 12
    return by_model + rounding / sensor.white_raw(len(light))[:, 0, 0].astype(np.float64) ** 2


def noise_to_signal(capture: Float[np.ndarray, "c y x"], variance: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
    """Ratio of the noise's variance (`noise_variance`) to that of the picture under it, for `wiener`.

    At most 1: a capture that is all noise is halved, not more. At least what single precision rounds, squared: a sensor
    without noise would otherwise have what no light says divided by nothing.
    """
    seen = capture.var(axis=(1, 2), dtype=np.float64)
    ratio = variance / np.maximum(seen - variance, np.maximum(variance, np.finfo(np.float32).tiny))
    return np.maximum(ratio, float(np.finfo(np.float32).eps) ** 2)


@jax.jit
def wiener(
    capture: Float[Array, "c y x"] | Float[np.ndarray, "c y x"],
    psf: Float[Array, "c ky kx"] | Float[np.ndarray, "c ky kx"],
    noise_to_signal: Float[Array, "*c"] | Float[np.ndarray, "*c"] | float,
) -> Float[Array, "c y x"]:
    """Wiener filter conj(H) / (|H|² + N/S) of linear light, as the network has it (`doedesign.recon.wiener.sharpened`).

    PSFs in energy per pixel have odd windows with the chief ray in the middle; light that they lose is given back. N/S
    is given for each colour, or one for all.
    """
    _require_odd(psf)
    ratio = jnp.broadcast_to(jnp.asarray(noise_to_signal, jnp.float32), (len(psf),))
    image = jnp.asarray(capture).transpose(1, 2, 0)[None]
    return sharpened(image, jnp.asarray(psf)[None], jnp.log(ratio))[0].transpose(2, 0, 1)


@partial(jax.jit, static_argnames="iterations")
def richardson_lucy(
    capture: Float[Array, "c y x"] | Float[np.ndarray, "c y x"],
    psf: Float[Array, "c ky kx"] | Float[np.ndarray, "c ky kx"],
    iterations: int = ITERATIONS,
    noise_variance: Float[Array, "*c"] | Float[np.ndarray, "*c"] | float = 0.0,
) -> Float[Array, "c y x"]:
    """Richardson-Lucy iteration u ← u · Aᵀ(capture / A u) / Aᵀ1 (Richardson 1972, Lucy 1974).

    A is the blur of a picture that is mirrored beyond its edges, and Aᵀ exactly its transpose, so that every iteration
    keeps u positive and the light of A u equal to that of the capture.

    PSFs are as in `wiener`; light below 0 counts as 0. A colour stops after `iterations`, or where the mean square of
    capture - A u falls below the variance of its noise (for each colour, or one for all).
    """
    _require_odd(psf)
    seen = jnp.maximum(jnp.asarray(capture, jnp.float32), 0.0)
    otf = plan_otf(jnp.asarray(psf), (seen.shape[1], seen.shape[2]), "reflect")
    enough = jnp.broadcast_to(jnp.asarray(noise_variance, jnp.float32), (len(seen),))[:, None, None]

    def blur(light: Array) -> Array:
        return convolve(light, otf)

    transpose = jax.linear_transpose(blur, seen)
    reached = jnp.maximum(transpose(jnp.ones_like(seen))[0], _DARK)

    def step(_: Any, light: Array) -> Array:
        blurred = jnp.maximum(blur(light), _DARK)  # transforms round, and may leave the dark below 0
        better = light * jnp.maximum(transpose(seen / blurred)[0], 0.0) / reached
        off = jnp.mean((seen - blurred) ** 2, axis=(1, 2), keepdims=True)
        return jnp.where(off > enough, better, light)

    # Even light of the right amount: no structure that the capture has not asked for.
    even = jnp.mean(seen, axis=(1, 2), keepdims=True) / jnp.mean(reached, axis=(1, 2), keepdims=True)
    return jax.lax.fori_loop(0, iterations, step, jnp.broadcast_to(even, seen.shape))


def _require_odd(psf: Array | np.ndarray) -> None:
    if not (psf.shape[-2] % 2 and psf.shape[-1] % 2):
        raise ValueError(f"`psf` must have odd windows, so that it has a middle, but got {psf.shape[-2:]}")
