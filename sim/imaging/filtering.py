"""How well one linear filter undoes the blur of all depths: the least mean squared error in closed form.

A scene S of the power spectrum s(f) is seen through the transfer H_z(f) of its depth z, with white noise of the power
n: Y = H_z S + N. A filter G makes G Y of it, whose error at one depth and frequency is

    e_z = |1 - G H_z|² s + |G|² n.

Who does not know the depth has one filter for all of them. The mean of e_z over depths, <e>, is least for

    G = s <H>* / (s <|H|²> + n),        <e> = s (n + s (<|H|²> - |<H>|²)) / (s <|H|²> + n),

by setting the derivative with respect to G* to 0: noise, and the variance of H over the depths, which is what a plate
for extended depth of field has to make small. Who knows the depth has <s n / (s |H|² + n)>, which one depth alone gives
for <e>, too (N. Wiener, *Extrapolation, Interpolation, and Smoothing of Stationary Time Series*, 1949).

Scenes have the spectrum of photographs, s(f) proportional to 1 / f² (D. J. Field, J. Opt. Soc. Am. A 4, 2379, 1987), of
a variance that is stated; the mean of the picture is known. Errors are given as shares of that variance: 0 for a
perfect picture, 1 for none, whose filter gives nothing but the mean.
"""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

Transfers = Complex[Array, "*k depth side half"] | Complex[np.ndarray, "*k depth side half"]


@lru_cache(maxsize=16)
def photograph_spectrum(side: int, variance: float) -> Float[np.ndarray, "side half"]:
    """Power of photographs at the frequencies of `rfft2` of a square, `[fy, fx]`; none at 0, for the mean is known.

    Args:
        side: pixels per axis.
        variance: of a pixel, with white 1; all powers of the whole transform add up to it.

    Raises:
        ValueError: fewer than two pixels, or a variance that is not positive.
    """
    if side < 2 or not 0 < variance < np.inf:
        raise ValueError(f"`side` must be at least 2 and `variance` positive, but got {side} and {variance}")
    square = np.fft.fftfreq(side)[:, None] ** 2 + np.fft.rfftfreq(side) ** 2
    power = np.divide(1.0, square, where=square > 0, out=np.zeros_like(square))
    power = variance * power / np.sum(power * spectrum_weights(side))
    power.setflags(write=False)
    return power


def spectrum_weights(side: int) -> Float[np.ndarray, " half"]:
    """How often each column of `rfft2` of a square of `side` pixels stands in the whole transform: once or twice."""
    columns = np.arange(side // 2 + 1)
    return np.where((columns == 0) | (2 * columns == side), 1.0, 2.0)


def transfers(psf: Float[Array, "*k side side"] | Float[np.ndarray, "*k side side"]) -> Complex[Array, "*k side half"]:
    """Transfer functions of PSFs in square windows, as `rfft2` has them; the middle of the window is the origin.

    An even window has its middle on a corner of pixels: half a pixel of delay is taken off, too, so that the transfer
    of a PSF that is even about the middle is real.
    """
    side = psf.shape[-1]
    middle = (side - 1) / 2
    waves = np.fft.fftfreq(side)[:, None] + np.fft.rfftfreq(side)
    turned = np.exp(2j * np.pi * middle * waves).astype(np.complex64)
    return jnp.fft.rfft2(jnp.asarray(psf)) * turned


def common_filter(
    transfer: Transfers, signal: Float[np.ndarray, "side half"], noise: float
) -> Complex[Array, "*k side half"]:
    """The linear filter of the least mean squared error over depths.

    Args:
        transfer: `[..., depth, fy, fx]` transfer functions; all depths count alike.
        signal: power of the scene at every frequency.
        noise: power of the noise at every frequency, in the same unit: its variance over the number of pixels.
    """
    transfer = jnp.asarray(transfer)
    power = jnp.mean(transfer.real**2 + transfer.imag**2, axis=-3)
    return jnp.conj(jnp.mean(transfer, axis=-3)) * signal / (signal * power + noise)


def filter_errors(
    transfer: Transfers, signal: Float[np.ndarray, "side half"], noise: float, known: bool
) -> Float[Array, "*k depth"]:
    """Mean squared error of the filtered picture at every depth, as a share of the scene's variance.

    Args:
        transfer: as for `common_filter`.
        signal: as there.
        noise: as there, above 0.
        known: whether every depth has a filter of its own, in place of one for all.
    """
    transfer = jnp.asarray(transfer)
    if known:
        error = signal * noise / (signal * (transfer.real**2 + transfer.imag**2) + noise)
    else:
        found = common_filter(transfer, signal, noise)[..., None, :, :]
        missed = 1.0 - found * transfer
        error = (missed.real**2 + missed.imag**2) * signal + (found.real**2 + found.imag**2) * noise
    weights = spectrum_weights(transfer.shape[-2])
    return jnp.sum(error * weights * (signal > 0), axis=(-2, -1)) / float(np.sum(signal * weights))
