"""Beams that light a DOE: their amplitude on its cells, for a power of one.

A Gaussian beam of quality M² is an incoherent sum of Hermite-Gaussian modes, those of a Gaussian Schell-model source
(A. Starikov and E. Wolf, J. Opt. Soc. Am. 72, 923, 1982): the shares of the modes fall like q^n with
q = (M² - 1) / (M² + 1), and all modes share a waist that is M times smaller than the beam's. A measured beam is a
picture of its intensity and has a plane wavefront. Even light is a plane wave or comes from a point.

The axis of a beam may stand aslant in two ways: by its `angle_rad`, with the sensor turned about the DOE so that its
middle stays on that axis, or by its `tilt_rad`, with the sensor where it was, so that images move on it.

Powers count from the whole beam: what misses the opening of the chrome is lost.
"""

import hashlib
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from jaxtyping import Complex, Float
from scipy.ndimage import map_coordinates

from fab.aperture import Aperture
from fab.errors import InputError
from fab.grid import Grid
from fab.height import as_array
from fab.units import number_of

_REST = 1e-3  # share of the weakest modes that is left out
Pair = tuple[float, float]


def _require_pairs(beam: Any, *names: str) -> None:
    """Make tuples of pairs of numbers (y, x) of a beam; an InputError for anything else."""
    for name in names:
        value = getattr(beam, name)
        pair = tuple(value) if isinstance(value, tuple | list | np.ndarray) else ()
        if len(pair) != 2 or not all(np.isfinite(number_of(one)) for one in pair):
            raise InputError(f"beam: {name}", "must be two numbers (y, x)", repr(value), "For example (0.0, 0.01).")
        object.__setattr__(beam, name, pair)


@dataclass(frozen=True)
class GaussianBeam:
    """A Gaussian beam.

    Attributes:
        radius_m: radii (y, x), metres, at the waist where the intensity is 1/e² of that in the middle, of the whole
            beam.
        waist_distance_m: distance of the waist before the DOE, metres, negative behind it.
        m_squared: beam quality M² (y, x), at least 1.
        centre_m: place (y, x) of its axis on the DOE, metres.
        angle_rad: angles (y, x) between its axis and that of the DOE, radians, positive where light travels toward +y
            or +x; the sensor's window follows.
        tilt_rad: angles (y, x) added to these, radians; the sensor's window stays.

    Raises:
        InputError: radii that are not two positive lengths, a beam quality below 1, or anything but numbers.
    """

    radius_m: Pair
    waist_distance_m: float = 0.0
    m_squared: Pair = (1.0, 1.0)
    centre_m: Pair = (0.0, 0.0)
    angle_rad: Pair = (0.0, 0.0)
    tilt_rad: Pair = (0.0, 0.0)

    def __post_init__(self) -> None:
        given: Any = self.radius_m
        radii = given if isinstance(given, tuple | list | np.ndarray) and len(given) == 2 else (0.0,)
        if not all(0 < number_of(radius) < np.inf for radius in radii):
            rule, cure = "must be two positive lengths (y, x), in metres", "For example (1e-3, 1e-3)."
            raise InputError("beam: radius_m", rule, repr(given), cure)
        _require_pairs(self, "radius_m", "m_squared", "centre_m", "angle_rad", "tilt_rad")
        if not all(quality >= 1 for quality in self.m_squared):
            raise InputError("beam: m_squared", "must be at least 1 and finite", self.m_squared, "Give (1.0, 1.0).")
        if not np.isfinite(number_of(self.waist_distance_m)):
            rule = "must be a finite number of metres"
            raise InputError("beam: waist_distance_m", rule, repr(self.waist_distance_m), "For example 0.1.")

    @cached_property
    def _modes(self) -> list[tuple[float, int, int]]:
        """Share and numbers (y, x) of every mode, the strongest first."""
        axes = []
        for quality in self.m_squared:
            ratio = (quality - 1) / (quality + 1)
            # Of either axis less than a quarter of what may be left out is missing.
            count = 1 if ratio == 0 else max(200, int(np.ceil(np.log(_REST / 4) / np.log(ratio))))
            axes.append([(1 - ratio) * ratio**n for n in range(count)])
        every = [(p * q, m, n) for m, p in enumerate(axes[0]) for n, q in enumerate(axes[1])]
        every.sort(key=lambda each: (-each[0], each[1:]))
        total = np.cumsum([share for share, _, _ in every])
        count = 1 + int(np.searchsorted(total, 1 - _REST))
        kept = every[:count]
        return [(share / total[count - 1], m, n) for share, m, n in kept]

    @property
    def shares(self) -> tuple[float, ...]:
        """Power of every mode; the weakest, together a thousandth, are left out and theirs is the others'."""
        return tuple(share for share, _, _ in self._modes)

    def _rayleigh_m(self, axis: int, wavelength_m: float) -> float:
        """Rayleigh length of the modes along an axis."""
        return np.pi * self.radius_m[axis] ** 2 / self.m_squared[axis] / wavelength_m

    def _at(self, axis: int, wavelength_m: float, further_m: Any = 0.0) -> tuple[Any, Any]:
        """Radius of the lowest mode, metres, and curvature of the wavefront, 1/m, so far beyond the DOE's middle."""
        distance, rayleigh = self.waist_distance_m + further_m, self._rayleigh_m(axis, wavelength_m)
        radius = self.radius_m[axis] / np.sqrt(self.m_squared[axis])
        return radius * np.sqrt(1 + (distance / rayleigh) ** 2), distance / (distance**2 + rayleigh**2)

    def curvature_per_m(self, wavelength_m: float) -> float:
        """Curvature of its wavefront at the DOE, the mean of both axes."""
        return float(sum(self._at(axis, wavelength_m)[1] for axis in (0, 1)) / 2)

    def diameters_m(self, wavelength_m: float) -> Pair:
        """Diameters (y, x) of the whole beam on the DOE, metres, where the intensity is 1/e² of that in the middle."""
        y, x = (2 * self._at(axis, wavelength_m)[0] * np.sqrt(self.m_squared[axis]) for axis in (0, 1))
        return float(y), float(x)

    def amplitude_per_m(
        self, grid: Grid, aperture: Aperture, wavelength_m: float, mode: int
    ) -> Complex[np.ndarray, "y x"]:
        """Amplitude `[y, x]` of a mode in the middle of every cell; its square times area sums to 1 over the plane.

        Its phase is less that along the axis of the beam, as for every beam. A beam that stands aslant crosses the DOE
        at other distances from its waist and in a longer footprint.
        """
        tangents = np.tan(np.add(self.angle_rad, self.tilt_rad))
        along = np.array([*tangents, 1.0]) / np.sqrt(1 + np.sum(tangents**2))  # of the axis (y, x, z)
        place = grid.axis_m("y")[:, None] - self.centre_m[0], grid.axis_m("x") - self.centre_m[1]

        def distance(direction: Float[np.ndarray, "3"]) -> Any:
            """Of every cell along a direction; an upright beam stays a product of two lines."""
            return sum(float(part) * at for part, at in zip(direction, place, strict=False) if part)

        # Two axes across the beam: that of y in the plane of y and the beam, the other normal to both.
        tall = np.array([1.0, 0.0, 0.0]) - along[0] * along
        tall = tall / np.sqrt(np.sum(tall**2))
        further, light = distance(along), np.sqrt(along[2])  # the footprint is longer by the inverse of its square
        for axis, across, number in ((0, tall, self._modes[mode][1]), (1, np.cross(along, tall), self._modes[mode][2])):
            radius, curvature = self._at(axis, wavelength_m, further)
            at, rayleigh = distance(across), self._rayleigh_m(axis, wavelength_m)
            turn = np.arctan((self.waist_distance_m + further) / rayleigh) - np.arctan(self.waist_distance_m / rayleigh)
            waves = curvature * at**2 / 2 / wavelength_m - (number + 0.5) * turn / (2 * np.pi)
            light = light * (_hermite_gaussian(number, at, radius) * np.exp(2j * np.pi * (waves - np.rint(waves))))
        return light


@dataclass(frozen=True, eq=False)
class MeasuredBeam:
    """A beam with a plane wavefront, by a picture of its intensity. Beams of the same content are equal.

    Attributes:
        intensity: `[y, x]` intensity, not negative, in any unit.
        pixel_m: distance of its pixels, metres.
        centre_m: place (y, x) of the picture's middle on the DOE, metres.
        angle_rad: angles (y, x) of its axis, radians, which the sensor's window follows.
        tilt_rad: angles (y, x) added to these, radians; the window stays.

    Raises:
        InputError: an intensity that is no array `[y, x]` of numbers, is negative or nowhere positive, pixels without a
            width, or anything but numbers.
    """

    intensity: Float[np.ndarray, "y x"] = field(repr=False)
    pixel_m: float
    centre_m: Pair = (0.0, 0.0)
    angle_rad: Pair = (0.0, 0.0)
    tilt_rad: Pair = (0.0, 0.0)

    def __post_init__(self) -> None:
        picture = as_array(self.intensity, "beam: intensity")
        if picture.ndim != 2 or picture.size == 0 or picture.dtype.kind not in "fiu":
            rule, got = "must be an array of numbers [y, x]", f"{picture.dtype} of shape {picture.shape}"
            raise InputError("beam: intensity", rule, got, "Give one plane of a picture.")
        if not (np.all(np.isfinite(picture)) and np.min(picture) >= 0 < np.max(picture)):
            rule, got = (
                "must be finite, nowhere negative and somewhere positive",
                f"{np.min(picture)} to {np.max(picture)}",
            )
            raise InputError("beam: intensity", rule, got, "Take the background off, and set what is below it to 0.")
        if not 0 < number_of(self.pixel_m) < np.inf:
            rule, cure = "must be a positive number of metres", "For example 5e-6 for 5 um."
            raise InputError("beam: pixel_m", rule, repr(self.pixel_m), cure)
        object.__setattr__(self, "intensity", picture)
        _require_pairs(self, "centre_m", "angle_rad", "tilt_rad")

    @cached_property
    def _key(self) -> tuple[object, ...]:
        picture = np.ascontiguousarray(self.intensity, np.float64)
        digest, aslant = hashlib.sha256(picture.tobytes()).hexdigest(), (self.angle_rad, self.tilt_rad)
        return picture.shape, digest, self.pixel_m, self.centre_m, *aslant

    def __eq__(self, other: object) -> bool:
        """Whether all is the same, pixel by pixel."""
        return isinstance(other, MeasuredBeam) and self._key == other._key

    def __hash__(self) -> int:
        """Hash of the content."""
        return hash(self._key)

    @property
    def shares(self) -> tuple[float, ...]:
        """One mode."""
        return (1.0,)

    def curvature_per_m(self, wavelength_m: float) -> float:
        """None."""
        return 0.0

    def amplitude_per_m(
        self, grid: Grid, aperture: Aperture, wavelength_m: float, mode: int
    ) -> Complex[np.ndarray, "y x"]:
        """Root of the intensity between its pixels, in the middle of every cell; dark beyond the picture."""
        places = [
            (grid.axis_m(name) - centre) / self.pixel_m + (count - 1) / 2
            for name, centre, count in zip(("y", "x"), self.centre_m, self.intensity.shape, strict=True)
        ]
        at = np.stack(np.meshgrid(*places, indexing="ij"))
        seen = map_coordinates(np.asarray(self.intensity, np.float64), at, order=1, mode="nearest")
        for place, count in zip(at, self.intensity.shape, strict=True):  # pixels end half a pixel beyond their centres
            seen = np.where((place < -0.5) | (place > count - 0.5), 0.0, seen)
        return np.sqrt(seen / (self.intensity.sum(dtype=np.float64) * self.pixel_m**2)).astype(complex)


@dataclass(frozen=True)
class EvenBeam:
    """Light that is as bright all over the aperture, of whose power energies are shares.

    Attributes:
        distance_m: distance of the point before the DOE that it comes from, metres; infinite for a plane wave.
        angle_rad: angles (y, x) of its chief ray, radians, which the sensor's window follows.
        tilt_rad: angles (y, x) added to these, radians; the window stays.

    Raises:
        InputError: a distance that is not positive, or anything but numbers.
    """

    distance_m: float = np.inf
    angle_rad: Pair = (0.0, 0.0)
    tilt_rad: Pair = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not number_of(self.distance_m) > 0:
            rule, cure = "must be positive, a number of metres", "For example 0.5, or infinity for a plane wave."
            raise InputError("beam: distance_m", rule, repr(self.distance_m), cure)
        _require_pairs(self, "angle_rad", "tilt_rad")

    @property
    def shares(self) -> tuple[float, ...]:
        """One mode."""
        return (1.0,)

    @property
    def _chief_rad(self) -> Pair:
        return self.angle_rad[0] + self.tilt_rad[0], self.angle_rad[1] + self.tilt_rad[1]

    def curvature_per_m(self, wavelength_m: float) -> float:
        """Curvature of its wavefront about the chief ray."""
        return float(1 / self.distance_m / np.sqrt(1 + np.sum(np.tan(self._chief_rad) ** 2)))

    def amplitude_per_m(
        self, grid: Grid, aperture: Aperture, wavelength_m: float, mode: int
    ) -> Complex[np.ndarray, "y x"]:
        """Amplitude in the middle of every cell, its phase less that along the chief ray, as for every beam."""
        waves = np.zeros(grid.shape)
        if np.isfinite(self.distance_m):
            y, x = grid.axis_m("y")[:, None], grid.axis_m("x")
            waves = path_from_point_m(y, x, self.distance_m, self._chief_rad) / wavelength_m
        return 2 / (np.sqrt(np.pi) * aperture.disc_m) * np.exp(2j * np.pi * (waves - np.rint(waves)))


def path_from_point_m(
    y_m: Float[np.ndarray, "*s"], x_m: Float[np.ndarray, "*t"], distance_m: float, chief_rad: Pair
) -> Float[np.ndarray, "*u"]:
    """Path from a point at a distance and angles (y, x) to places of the DOE, less that of the chief ray and its tilt.

    Paper eq. 1, free of cancellation; metres. Places are broadcast against each other.
    """
    square = y_m**2 + x_m**2
    y0, x0 = (-distance_m * np.tan(angle) for angle in chief_rad)
    chief = np.sqrt(y0**2 + x0**2 + distance_m**2)
    path = np.sqrt((y_m - y0) ** 2 + (x_m - x0) ** 2 + distance_m**2)
    # (path - chief) without cancellation, then without its linear part -(y0 y + x0 x) / chief.
    linear = y0 * y_m + x0 * x_m
    return (square - 2 * linear) / (path + chief) + linear / chief


def _hermite_gaussian(
    number: int, at_m: Float[np.ndarray, "..."], radius_m: float | Float[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    """Hermite-Gaussian function of unit norm, 1/sqrt(m), by its recurrence; the lowest has the radius 1/e²."""
    place = np.sqrt(2) * at_m / radius_m
    below, here = np.zeros_like(place), (2 / np.pi) ** 0.25 / np.sqrt(radius_m) * np.exp(-(place**2) / 2)
    for n in range(number):
        below, here = here, place * np.sqrt(2 / (n + 1)) * here - np.sqrt(n / (n + 1)) * below
    return here


# `shares` are the powers of the modes of which a beam is an incoherent sum; together 1.
Beam = GaussianBeam | MeasuredBeam | EvenBeam


@lru_cache(maxsize=8)
def beam_amplitude(
    beam: Beam, grid: Grid, aperture: Aperture, wavelength_m: float, mode: int
) -> Complex[np.ndarray, "y x"]:
    """Amplitude `[y, x]` of a mode of a beam on the cells of a DOE, complex64 and read-only.

    Its mean square over that clear aperture would be 1 if the beam were to end at its rim: plane light
    has the amplitude 1, and PSFs count energies over the power of the beam.
    """
    found = beam.amplitude_per_m(grid, aperture, wavelength_m, mode) * np.sqrt(np.pi) * aperture.disc_m / 2
    found = found.astype(np.complex64)
    found.setflags(write=False)
    return found


@lru_cache(maxsize=4)
def beam_irradiance(beam: Beam, grid: Grid, aperture: Aperture, wavelength_m: float) -> Float[np.ndarray, "y x"]:
    """Irradiance `[y, x]` on the cells, the sum over all modes, of which 1 is that of plane light of the same power."""
    shown = np.zeros(grid.shape)
    for mode, share in enumerate(beam.shares):
        shown += share * np.abs(beam_amplitude(beam, grid, aperture, wavelength_m, mode)) ** 2
    shown.setflags(write=False)
    return shown


@lru_cache(maxsize=4)
def power_through(beam: Beam, grid: Grid, aperture: Aperture, wavelength_m: float) -> float:
    """Share of a beam's power that passes an aperture, as the middles of the cells find it; 1 for even light."""
    if isinstance(beam, EvenBeam):
        return 1.0
    if isinstance(beam, GaussianBeam):
        # The sum of all modes is as bright as one mode of its diameters, which is a product of profiles along y and x.
        y, x = (
            _hermite_gaussian(0, grid.axis_m(axis) - centre, diameter / 2) ** 2
            for axis, centre, diameter in zip(("y", "x"), beam.centre_m, beam.diameters_m(wavelength_m), strict=True)
        )
        return float(y @ (aperture.inside(grid) @ x)) * grid.pitch_m**2
    return float(beam_irradiance(beam, grid, aperture, wavelength_m)[aperture.inside(grid)].mean())
