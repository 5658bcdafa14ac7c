"""Modulation transfer of lens, DOE and pixel, before sampling.

The OTF of an incoherent image is the autocorrelation of the pupil at the lag lambda d nu (J. W. Goodman,
*Introduction to Fourier Optics*, §6.3). For square cells that autocorrelation is a sum over cells at whole-cell lags
and linear between them, so nothing is approximated but the source wave within a cell. It counts all light behind the
DOE, also what misses any window, and does not depend on where on the pixel grid the image falls. The transform of a
sampled PSF does: pixels of 3.7 um sample an Airy disc of 1.3 um far below its Nyquist rate, and the lens alone would
seem to resolve nothing at the sensor's own limit.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim.aperture import circle_coverage
from sim.camera import Camera, source_path_m, wrapped_waves
from sim.propagation.pupil import PhaseRows, block_size, in_blocks, phase_pupil


class TransferBank(NamedTuple):
    """MTF along x for every colour and depth, and where it was taken.

    Attributes:
        transfer: `[wavelength, depth, frequency]` |OTF|, 1 at frequency 0.
        frequencies_per_m: spatial frequencies on the sensor, cycles per metre.
        depths_m: source depths, metres.
    """

    transfer: Float[np.ndarray, "w d f"]
    frequencies_per_m: Float[np.ndarray, " f"]
    depths_m: tuple[float, ...]


@jax.jit
def _row_spectra(rows: PhaseRows, waves_per_metre: Array) -> Array:
    """Sum over y of |FFT along x|² of the rows padded to twice their length, `[2 cells]`."""

    def add(total: Array, block: PhaseRows) -> tuple[Array, None]:
        spectrum = jnp.fft.fft(phase_pupil(block, waves_per_metre), len(total))
        return total + jnp.sum(spectrum.real**2 + spectrum.imag**2, axis=0), None

    count, cells = rows.height_m.shape
    return jax.lax.scan(add, jnp.zeros(2 * cells), in_blocks(rows, block_size(count)))[0]


def transfer_bank(
    camera: Camera, height_m: Float[np.ndarray, "y x"], depths_m: Sequence[float], count: int = 160
) -> TransferBank:
    """MTF of a height map along x, from zero to the sensor's Nyquist frequency.

    Args:
        camera: optics.
        height_m: `[y, x]` the map, metres.
        depths_m: source depths on the axis, metres.
        count: number of frequencies.
    """
    frequencies = np.linspace(0.0, 0.5 / camera.pixel_m, count)
    height = jnp.asarray(height_m, jnp.float32)
    coverage = jnp.asarray(circle_coverage(camera.grid, camera.aperture_m))
    otf = np.zeros((len(camera.colours), len(depths_m), count), np.complex128)
    lags = np.arange(camera.grid.shape[1])
    for d, depth in enumerate(depths_m):
        path = source_path_m(camera, depth)
        for c, colour in enumerate(camera.colours):
            for wavelength, weight in zip(colour.wavelengths_m, colour.weights, strict=True):
                rows = PhaseRows(height, jnp.asarray(wrapped_waves(path, wavelength)), coverage)
                power = np.asarray(_row_spectra(rows, jnp.float32(camera.waves_per_metre(wavelength))), np.float64)
                correlation = np.fft.ifft(power)[: len(lags)] / power.mean()
                lag = wavelength * camera.sensor_distance_m * frequencies / camera.grid.pitch_m
                otf[c, d] += weight * np.interp(lag, lags, correlation.real, right=0.0)
                otf[c, d] += 1j * weight * np.interp(lag, lags, correlation.imag, right=0.0)
    pixel = np.sinc(camera.pixel_m * camera.fill * frequencies)
    return TransferBank(np.abs(otf * pixel), frequencies, tuple(depths_m))
