"""Lens, sensor and DOE substrate of a camera, and the wave a source sends into its aperture.

The DOE sits on a thin lens in the aperture plane (paper §3.1). For a sensor at the focal distance the lens cancels the
quadratic term of Fresnel propagation and only the source's own path differences and the DOE remain (eq. 7); a sensor
out of focus leaves a quadratic remainder, which is added here.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from fab.grid import Grid
from sim.material import fresnel_transmission, refractive_index

Mapping = Literal["sine", "tangent"]
_INVERSIONS = 8  # steps of Newton's method that undo a distortion; five reach double precision for 20 %


@dataclass(frozen=True)
class Colour:
    """One colour channel: vacuum wavelengths in metres and their weights, which sum to 1."""

    name: str
    wavelengths_m: tuple[float, ...]
    weights: tuple[float, ...]


class SpectralLine(NamedTuple):
    """One wavelength of the colour channel of that number.

    `factor` is its weight in the channel times the power that passes the substrate's two faces.
    """

    colour: int
    wavelength_m: float
    factor: float


@dataclass(frozen=True)
class Camera:
    """Everything that is fixed while a DOE is designed. Hashable: it may be a static argument of `jit`.

    Attributes:
        grid: cells of the DOE.
        aperture_m: diameter of the clear aperture.
        material: substrate, a key of `sim.material.MATERIALS`.
        colours: colour channels, in the order of the bank's first axis.
        focal_length_m: focal length of the lens.
        pixel_m: centre-to-centre distance of sensor pixels, after binning.
        window: sensor pixels computed per axis, centred on the chief ray; for an even count the chief ray
            falls on the corner shared by the four middle pixels, for an odd one on the middle pixel's centre.
        fill: side of a pixel's light-sensitive square over `pixel_m`, 0-1.
        defocus_m: distance of the sensor beyond the focal plane.
        mapping: how the lens images directions: at a height d sin(angle) from the axis on a sensor at distance d, or
            at d tan(angle), as a lens without distortion does. The far field falls so by itself on a sphere ("sine").
        distortion: (k1, k2), the relative change of that height r: light lands at r (1 + k1 (r/d)² + k2 (r/d)⁴) from
            the axis. Negative numbers are a barrel, positive ones a pincushion.
    """

    grid: Grid
    aperture_m: float
    material: str
    colours: tuple[Colour, ...]
    focal_length_m: float
    pixel_m: float
    window: int
    fill: float = 1.0
    defocus_m: float = 0.0
    mapping: Mapping = "sine"
    distortion: tuple[float, float] = (0.0, 0.0)

    @property
    def is_sine(self) -> bool:
        """Whether places on the sensor are direction sines, times its distance."""
        return self.mapping == "sine" and not any(self.distortion)

    @property
    def sensor_distance_m(self) -> float:
        """Distance from the lens to the sensor."""
        return self.focal_length_m + self.defocus_m

    @property
    def lines(self) -> tuple[SpectralLine, ...]:
        """Every wavelength of every colour, colour by colour."""
        return tuple(
            SpectralLine(number, wavelength, weight * self.transmission(wavelength))
            for number, colour in enumerate(self.colours)
            for wavelength, weight in zip(colour.wavelengths_m, colour.weights, strict=True)
        )

    def axis_m(self) -> Float[np.ndarray, " window"]:
        """Pixel centres on the sensor relative to the chief ray, metres."""
        return Grid((self.window, self.window), self.pixel_m).axis_m("x")

    def image_m(self, sine_y: Any, sine_x: Any) -> tuple[Any, Any]:
        """Place (y, x) on the sensor of light with these direction sines, metres from the axis."""
        scale = self.sensor_distance_m
        if self.mapping == "tangent":
            scale = scale * (1.0 - sine_y * sine_y - sine_x * sine_x) ** -0.5
        y, x = sine_y * scale, sine_x * scale
        k1, k2 = self.distortion
        share = (y * y + x * x) / self.sensor_distance_m**2
        grown = 1.0 + share * (k1 + k2 * share)
        return y * grown, x * grown

    def sines_of(self, y_m: Any, x_m: Any) -> tuple[Any, Any]:
        """Direction sines (y, x) of the light that lands at a place on the sensor: the inverse of `image_m`.

        Plain arithmetic, for numbers and arrays of numpy or jax. Meaningless where the distortion has folded the
        image over (`farthest_image_m`).
        """
        y, x = y_m / self.sensor_distance_m, x_m / self.sensor_distance_m
        (k1, k2), seen, shrunk = self.distortion, y * y + x * x, 1.0
        for _ in range(_INVERSIONS if any(self.distortion) else 0):
            share = seen * shrunk * shrunk
            missed = shrunk * (1.0 + share * (k1 + k2 * share)) - 1.0
            shrunk = shrunk - missed / (1.0 + share * (3.0 * k1 + 5.0 * k2 * share))
        y, x = y * shrunk, x * shrunk
        if self.mapping == "tangent":
            scale = (1.0 + y * y + x * x) ** -0.5
            y, x = y * scale, x * scale
        return y, x

    def transmission(self, wavelength_m: float) -> float:
        """Power that passes both faces of the uncoated substrate."""
        return fresnel_transmission(refractive_index(self.material, wavelength_m))

    def waves_per_metre(self, wavelength_m: float, field_rad: tuple[float, float] = (0.0, 0.0)) -> float:
        """Waves of delay per metre of DOE height.

        (n - 1) / lambda on axis (eq. 2); for an oblique chief ray of direction sine s,
        (sqrt(n^2 - s^2) - sqrt(1 - s^2)) / lambda, the thin-element path difference.
        """
        square = float(np.sum(np.square(direction_sines(field_rad))))
        index = refractive_index(self.material, wavelength_m)
        return (np.sqrt(index**2 - square) - np.sqrt(1.0 - square)) / wavelength_m

    def defocus_radius_m(self, depth_m: float) -> float:
        """Radius on the sensor of the geometric blur disc: D/2 · |d/z + 1 - d/f|, or D f / (2 z) in the focal plane."""
        distance = self.sensor_distance_m
        inverse_depth = 0.0 if np.isinf(depth_m) else 1.0 / depth_m
        return self.aperture_m / 2 * abs(distance * inverse_depth + 1.0 - distance / self.focal_length_m)


def direction_sines(field_rad: tuple[float, float]) -> Float[np.ndarray, "2"]:
    """Direction sines (y, x) of the chief ray for field angles (y, x) in radians.

    The angles are those of its projections on the yz and xz planes, positive where light travels toward +y or +x.
    """
    tangents = np.tan(np.asarray(field_rad, dtype=np.float64))
    return tangents / np.sqrt(1.0 + np.sum(tangents**2))


# Colours of one depth share the path; one array is kept, and it is read-only.
@lru_cache(maxsize=1)
def source_path_m(
    camera: Camera, depth_m: float, field_rad: tuple[float, float] = (0.0, 0.0)
) -> Float[np.ndarray, "y x"]:
    """Optical path from a point source to every DOE cell, relative to the chief ray, metres in float64.

    Eq. 1 of the paper with the constant subtracted, plus r^2/2 (1/d - 1/f) for a sensor at distance d. The linear path
    of field angles (y, x), the tilt that moves the image to f tan(field), is removed: the window follows the chief ray.
    """
    y = camera.grid.axis_m("y")[:, None]
    x = camera.grid.axis_m("x")[None, :]
    path = path_at_m(camera, y, x, depth_m, field_rad)
    path.setflags(write=False)
    return path


def path_at_m(
    camera: Camera,
    y_m: Float[np.ndarray, "*s"],
    x_m: Float[np.ndarray, "*t"],
    depth_m: float,
    field_rad: tuple[float, float] = (0.0, 0.0),
) -> Float[np.ndarray, "*u"]:
    """`source_path_m` at any points (y, x) of the aperture, broadcast against each other."""
    square = y_m**2 + x_m**2
    defocus = (square / 2) * (1.0 / camera.sensor_distance_m - 1.0 / camera.focal_length_m)
    if np.isinf(depth_m):
        return defocus
    y0, x0 = (-depth_m * np.tan(angle) for angle in field_rad)
    chief = np.sqrt(y0**2 + x0**2 + depth_m**2)
    path = np.sqrt((y_m - y0) ** 2 + (x_m - x0) ** 2 + depth_m**2)
    # (path - chief) without cancellation, then without its linear part -(y0 y + x0 x) / chief.
    linear = y0 * y_m + x0 * x_m
    return (square - 2 * linear) / (path + chief) + linear / chief + defocus


def wrapped_waves(path_m: Float[np.ndarray, "*s"], wavelength_m: float) -> Float[np.ndarray, "*s"]:
    """Path in waves, wrapped to [-1/2, 1/2] in float64 and only then rounded to float32.

    5 cm from a 4.4 mm aperture the path is a hundred waves; float32 would leave 1e-5 of them.
    """
    waves = path_m / wavelength_m
    waves -= np.round(waves)
    return waves.astype(np.float32)
