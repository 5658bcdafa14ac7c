"""Light near the axis at distances behind a DOE without a lens: the first Rayleigh-Sommerfeld integral.

A point at the distance z behind the DOE and a small x beside the axis sees a cell at r with the phase
2 pi (R - x r / R) / lambda, R = sqrt(r² + z²), and x² / (2 R) besides, in which cells hardly differ. The next term,
x² r² / (2 R³ lambda) waves, is left out: in a focus as wide as lambda z / D it is lambda / (8 z) at the rim, nothing.
The obliquity z / R and the falling off with R are kept, and cells are squares, so any angle will do.

(J. W. Goodman, *Introduction to Fourier Optics*, §3.5.)
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int
from scipy.special import j0

from sim.camera import Camera, SpectralLine

_BINS = 8192  # of direction sines; a profile is then right to 1e-5


class Octant(NamedTuple):
    """Cells of one octant, each standing for all that mirrors make of it.

    Attributes:
        y_m: distance of a cell from the x axis.
        x_m: from the y axis.
        light: field behind the open aperture, of all these cells together.
        ring: number of the ring that it lies in.
    """

    y_m: Float[np.ndarray, " cell"]
    x_m: Float[np.ndarray, " cell"]
    light: Complex[np.ndarray, " cell"]
    ring: Int[np.ndarray, " cell"]

    @classmethod
    def of(cls, camera: Camera, field: Complex[np.ndarray, "y x"], line: SpectralLine, ring_m: float) -> "Octant":
        """Open cells of a bare aperture, from the field behind it, on rings of some width."""
        grid, light = camera.grid, _flat(camera, field, line)
        rows, columns = np.nonzero(light)
        y, x = np.abs(grid.axis_m("y")[rows]), np.abs(grid.axis_m("x")[columns])
        # Whole numbers of half cells.
        short, long = (np.rint(2 * f(y, x) / grid.pitch_m).astype(int) for f in (np.minimum, np.maximum))
        key, place = np.unique(long * (long.max() + 1) + short, return_inverse=True)
        sums = [np.bincount(place, part[rows, columns]) for part in (np.real(light), np.imag(light))]
        near, far = (part * (grid.pitch_m / 2) for part in (key % (long.max() + 1), key // (long.max() + 1)))
        return cls(near, far, sums[0] + 1j * sums[1], (np.hypot(near, far) / ring_m).astype(int))

    def kernel(
        self, places_m: Float[np.ndarray, " n"], distance_m: float, line: SpectralLine, pitch_m: float, rings: int
    ) -> Complex[np.ndarray, "n ring"]:
        """Amplitude that rings of cells of unit transmission make beside the axis, the mean around it.

        Args:
            places_m: distances from the axis.
            distance_m: of the places behind the DOE.
            line: wavelength.
            pitch_m: of the cells.
            rings: number of rings.
        """
        light, path = _towards_axis(self.light, self.y_m, self.x_m, distance_m, line.wavelength_m, pitch_m)
        sines = np.hypot(self.y_m, self.x_m) / path / line.wavelength_m
        found = []
        for place in places_m:
            seen = light * j0(2 * np.pi * sines * place)
            parts = (np.bincount(self.ring, part, rings) for part in (np.real(seen), np.imag(seen)))
            found.append(next(parts) + 1j * next(parts))
        return np.stack(found)

    def ideal(self, distance_m: float, line: SpectralLine, pitch_m: float) -> float:
        """Amplitude on the axis that an ideal lens would make of this light, in the unit of `kernel`; see `profiles`.

        Args:
            distance_m: of the place behind the DOE.
            line: wavelength.
            pitch_m: of the cells.
        """
        path = np.sqrt(self.y_m**2 + self.x_m**2 + distance_m**2)
        return _ideal(self.light, path, distance_m, line.wavelength_m, pitch_m)


def _ideal(light: Any, path_m: Any, distance_m: float, wavelength_m: float, pitch_m: float) -> float:
    """Amplitude on the axis of light in step there, from points instead of cells."""
    return float(np.sum(np.abs(light) / path_m**2)) * pitch_m**2 * distance_m / wavelength_m


def _flat(camera: Camera, field: Complex[np.ndarray, "y x"], line: SpectralLine) -> Complex[np.ndarray, "y x"]:
    """The field without the curvature of a wave to the camera's own sensor."""
    square = camera.grid.axis_m("y")[:, None] ** 2 + camera.grid.axis_m("x")[None, :] ** 2
    waves = -camera.curvature_per_m() / (2 * line.wavelength_m) * square
    return field * np.exp(2j * np.pi * (waves - np.rint(waves)))


def _towards_axis(
    light: Any, y_m: Any, x_m: Any, distance_m: float, wavelength_m: float, pitch_m: float
) -> tuple[Any, Any]:
    """Amplitude that every cell makes on the axis, for light exp(i k z - i omega t) and less k z; and its path."""
    square = y_m**2 + x_m**2
    path = np.sqrt(square + distance_m**2)
    waves = square / (path + distance_m) / wavelength_m  # R - z without cancellation
    light = light * np.exp(2j * np.pi * (waves - np.rint(waves)))
    for at in (y_m, x_m):
        light = light * np.sinc(at / path * (pitch_m / wavelength_m))
    return light * (pitch_m**2 * distance_m / (1j * wavelength_m * path**2)), path


def profiles(
    camera: Camera,
    field: Complex[np.ndarray, "y x"],
    line: SpectralLine,
    places_m: Float[np.ndarray, " n"],
    distance_m: float,
) -> tuple[Complex[np.ndarray, "axis n"], float]:
    """Amplitude of a DOE along y and along x through the axis, at a distance behind it.

    Args:
        camera: cells, aperture and sensor of the DOE.
        field: behind it, as the camera's sensor wants it (`sim.optic.CellOptic.field`).
        line: wavelength.
        places_m: places along either axis.
        distance_m: of the places behind the DOE.

    Returns:
        amplitudes along y and x, whose squares are shares of the incident power per square metre, Fresnel loss left
        out; and the amplitude on the axis that an ideal lens would make of this light.
    """
    wavelength = line.wavelength_m
    y, x = camera.grid.axis_m("y")[:, None], camera.grid.axis_m("x")[None, :]
    pitch, field = camera.grid.pitch_m, _flat(camera, field, line)
    light, path = _towards_axis(field, y, x, distance_m, wavelength, pitch)
    sines = y / path / wavelength, x / path / wavelength
    scale = 1 / np.sqrt(camera.opening.area_m2)
    ideal = _ideal(field, path, distance_m, wavelength, pitch)
    return scale * np.stack([_transform(light, sine, places_m) for sine in sines]), scale * ideal


def _transform(
    light: Complex[np.ndarray, "y x"], sines: Float[np.ndarray, "y x"], places_m: Float[np.ndarray, " n"]
) -> Complex[np.ndarray, " n"]:
    """Sum of exp(-2 pi i sine place) over cells, whose sines are gathered between the two nearest of many."""
    most = float(np.abs(sines).max()) * (1 + 1e-9) or 1.0  # all are 0 across a single row of cells
    place = (sines.ravel() / most + 1) * ((_BINS - 1) / 2)
    below = np.minimum(place.astype(int), _BINS - 2)
    part = place - below
    real, imag, gathered = np.real(light).ravel(), np.imag(light).ravel(), np.zeros(_BINS, complex)
    for at, share in ((below, 1 - part), (below + 1, part)):
        gathered += np.bincount(at, real * share, _BINS) + 1j * np.bincount(at, imag * share, _BINS)
    return np.exp(-2j * np.pi * np.outer(places_m, np.linspace(-most, most, _BINS))) @ gathered
