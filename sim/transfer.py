"""Modulation transfer of lens, DOE and pixel, before sampling.

The OTF of an incoherent image is the autocorrelation of the pupil at the lag lambda d nu (J. W. Goodman,
*Introduction to Fourier Optics*, §6.3). For square cells that autocorrelation is a sum over cells at whole-cell lags
and linear between them, so nothing is approximated but the source wave within a cell. It counts all light behind the
DOE, also what misses any window, and does not depend on where on the pixel grid the image falls. The transform of a
sampled PSF does: pixels of 3.7 um sample an Airy disc of 1.3 um far below its Nyquist rate, and the lens alone would
seem to resolve nothing at the sensor's own limit.
"""

import math
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fab.errors import InputError
from fab.units import is_whole
from sim.camera import Camera, SpectralLine
from sim.metrics import near_and_far
from sim.optic import ON_AXIS, CellOptic
from sim.propagation.pupil import DoeRows, SourceColumns, block_size, doe_field, in_blocks
from sim.psf_bank import Depths, depths_from, optic_of
from sim.threads import at_once

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase


_AZIMUTHS = 72  # of the half turn that a radial mean takes; even, so that x and y are among them


@dataclass(frozen=True, eq=False)
class TransferBank:
    """MTF along x for every colour and depth.

    Attributes:
        transfer: `[colour, depth, frequency]` |OTF|, 1 at frequency 0.
        frequencies_per_m: spatial frequencies on the sensor, cycles per metre.
        depths_m: source depths, metres.
        camera: lens, sensor and substrate.
    """

    transfer: Float[np.ndarray, "w d f"]
    frequencies_per_m: Float[np.ndarray, " f"]
    depths_m: tuple[float, ...]
    camera: Camera

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw the curves, near depths (a defocus disc beyond the far spot) and far ones apart."""
        from sim.plots.curves import plot_mtf

        near, far = near_and_far(self.camera, self.depths_m)
        return plot_mtf(self, self.camera, near, far, ax=ax)

    def _repr_html_(self) -> str:
        """Picture for notebooks."""
        from fab.figure import html_of

        return html_of("MTF", {"colours": ", ".join(colour.name for colour in self.camera.colours)}, self.plot())


@jax.jit
def _row_spectra(rows: DoeRows, columns: SourceColumns) -> Array:
    """Sum over y of |FFT along x|² of the rows padded to twice their length, `[2 cells]`."""

    def add(total: Array, block: DoeRows) -> tuple[Array, None]:
        spectrum = jnp.fft.fft(doe_field(block, columns), len(total))
        return total + jnp.sum(spectrum.real**2 + spectrum.imag**2, axis=0), None

    count, cells = rows.amplitude.shape
    return jax.lax.scan(add, jnp.zeros(2 * cells), in_blocks(rows, block_size(count)))[0]


def mtf(
    optic: Any,
    camera: Camera | None = None,
    depths: Depths = np.inf,
    count: int = 160,
    *,
    field_rad: tuple[float, float] = ON_AXIS,
) -> TransferBank:
    """MTF of a DOE along x, from zero to the sensor's Nyquist frequency.

    Args:
        optic: a DOE of cells, anything that carries one, or a height map `[y, x]` in metres on `camera.grid`.
        camera: lens, sensor, substrate and DOE grid of a bare height map.
        depths: one source depth or several, in metres or with a unit; "inf" for a star.
        count: number of frequencies.
        field_rad: field angles (y, x), radians; frequencies are those about the chief ray, behind a lens that images
            sines.

    Raises:
        InputError: a count of frequencies below 2.
        TypeError: an optic that is not made of cells.
    """
    if not is_whole(count, 2):
        raise InputError("count", "must be a whole number of frequencies, 2 or more", repr(count), "For example 160.")
    depths_m = depths_from(depths)
    doe = optic_of(optic, camera, depths_m)
    if not isinstance(doe, CellOptic):
        raise TypeError(f"`optic` must be made of cells for an MTF, but got {type(doe).__name__}")
    camera = doe.camera
    frequencies = np.linspace(0.0, 0.5 / camera.pixel_m, count)
    otf = np.zeros((len(camera.colours), len(depths_m), count), np.complex128)
    lags = np.arange(camera.grid.shape[1])
    shares = camera.shares
    weights = [weight for colour in camera.colours for weight in colour.weights]

    def power(asked: tuple[int, SpectralLine]) -> np.ndarray:
        """Spectrum of a line at a depth."""
        d, line = asked
        return np.asarray(_row_spectra(*doe.rows(line, doe.source(line, depths_m[d], field_rad))), np.float64)

    spectra = at_once(power, list(product(range(len(depths_m)), camera.lines)))
    for d, (k, weight) in product(range(len(depths_m)), enumerate(weights)):
        line = camera.lines[k * len(shares)]
        whole = np.sum([share * next(spectra) for share in shares], 0)  # modes add up as they pass the opening
        correlation = np.fft.ifft(whole)[: len(lags)] / whole.mean()
        lag = line.wavelength_m * camera.sensor_distance_m * frequencies / camera.grid.pitch_m
        otf[line.colour, d] += weight * np.interp(lag, lags, correlation.real, right=0.0)
        otf[line.colour, d] += 1j * weight * np.interp(lag, lags, correlation.imag, right=0.0)
    pixel = np.sinc(camera.pixel_m * camera.fill * frequencies)
    return TransferBank(np.abs(otf * pixel), frequencies, depths_m, camera)


def directional_mtf(
    doe: CellOptic, depth_m: float, frequencies_per_m: Float[np.ndarray, " f"]
) -> Float[np.ndarray, "c 3 f"]:
    """MTF of a DOE, its lens and a pixel, before sampling: the mean over all directions, along x, and along y.

    The pupil's autocorrelation is taken in two dimensions, bilinear between whole cells. The radial mean is that of
    |OTF|, for the OTF of a plate that scatters has no phase that would be worth keeping.

    Args:
        doe: the DOE.
        depth_m: of the source, metres.
        frequencies_per_m: on the sensor, cycles per metre.

    Returns:
        ``[colour, way, frequency]`` MTF, 1 at frequency 0.
    """
    from scipy.fft import fft2, ifft2, next_fast_len
    from scipy.ndimage import map_coordinates

    camera = doe.camera
    angles = np.arange(_AZIMUTHS) * np.pi / _AZIMUTHS
    y, x = (np.outer(way, frequencies_per_m) for way in (np.sin(angles), np.cos(angles)))
    otf = np.zeros((len(camera.colours), *y.shape), np.complex128)
    modes = len(camera.shares)
    for first in range(0, len(camera.lines), modes):
        alike = camera.lines[first : first + modes]  # one wavelength of one colour
        line, fields = alike[0], (np.asarray(doe.field(each, depth_m)) for each in alike)
        per_cell = line.wavelength_m * camera.sensor_distance_m / camera.grid.pitch_m
        most = min(math.ceil(per_cell * frequencies_per_m[-1]) + 1, max(camera.grid.shape))
        # Far enough that no lag that is asked for comes round from the other side.
        shape = [next_fast_len(n + most) for n in camera.grid.shape]
        power: Any = 0.0
        for share, field in zip(camera.shares, fields, strict=True):  # modes add up as they pass the opening
            spectrum: Any = fft2(field, shape, workers=-1)
            power = power + share * (spectrum.real**2 + spectrum.imag**2)
        correlation = np.asarray(ifft2(power, workers=-1))
        around = np.arange(-most, most + 1)
        part: Any = correlation[np.ix_(around, around)] / correlation[0, 0].real
        places = [lag * per_cell + most for lag in (y, x)]
        weight = sum(each.factor for each in alike) / camera.transmission(line.wavelength_m)
        for unit, values in ((1, part.real), (1j, part.imag)):
            otf[line.colour] += weight * unit * map_coordinates(values.astype(np.float64), places, order=1)
    side = camera.pixel_m * camera.fill
    transfer = np.abs(otf * np.sinc(side * y) * np.sinc(side * x))
    return np.stack([transfer.mean(axis=1), transfer[:, 0], transfer[:, _AZIMUTHS // 2]], axis=1)
