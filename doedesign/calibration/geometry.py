"""Geometry of a measurement: how the camera stood, how large its pixels are, and how its lens bends straight lines.

The model's camera stands upright, has the design's focal length and sees straight lines straight; a camera on a bench
does not quite. What it is off by is the same for all images of a measurement. A pixel that lies p = (y, x) from the
chief ray, in the pitch that is stated, sees the light that an upright camera of wide enough sensor has at

    R S p (1 - distortion |p|² / d²)

R turns by `rotation` from +x toward +y, S stretches by 1 + `scale_y` along y and 1 + `scale_x` along x, and d is the
distance from the lens to the sensor. The energy in a pixel grows with the area that it sees.

A pixel sees more where the pitch is wider or the focal length shorter than stated. The distortion is the first of
`sim.camera.Camera.distortion`, and comes on top of it. Between a lens that maps a direction θ to f sin θ and one that
maps it to f tan θ lies a distortion of 1/2, the usual prior's standard deviation. Focal lengths are stated to a per
cent or a few, and a camera is turned by hand to a degree.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.report.labels import number_text
from sim.camera import Camera
from sim.propagation.places import CUBIC

QUANTITIES = ("rotation", "scale_y", "scale_x", "distortion")
USUAL_SIGMA = (math.radians(1.0), 0.02, 0.02, 0.5)
REACH = 4.0  # standard deviations within which values are looked for

_UNITS = {"rotation": (math.degrees(1.0), "°"), "distortion": (1.0, "")}
_PER_CENT = (100.0, "%")


class GeometryPrior(NamedTuple):
    """Knowledge of a camera's geometry before a calibration, in the order of `QUANTITIES`, radians and shares.

    Attributes:
        mean: of every quantity.
        sigma: its standard deviation; 0 where it is known.
    """

    mean: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    sigma: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    @property
    def unknown(self) -> tuple[int, ...]:
        """Which of the quantities are looked for."""
        return tuple(kind for kind, sigma in enumerate(self.sigma) if sigma > 0)

    @property
    def upright(self) -> bool:
        """Whether the camera is known to be as the model has it."""
        return not any(self.mean) and not self.unknown


UPRIGHT = GeometryPrior()


def places(geometry: Any, shift: Any, distance: float) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Where pixels see the light of an upright camera: a function of rows and columns from the window's middle.

    Its results (y, x) count from there, too. All lengths are in pixels; values may be traced.

    Args:
        geometry: values of `QUANTITIES`.
        shift: place (y, x) of the chief ray, about which the camera is turned and the lens bends lines.
        distance: from the lens to the sensor.
    """
    rotation, scale_y, scale_x, distortion = geometry
    cos, sin = jnp.cos(rotation), jnp.sin(rotation)

    def place(row: Any, column: Any) -> tuple[Any, Any]:
        y, x = row - shift[0], column - shift[1]
        bent = 1 - distortion / distance**2 * (y * y + x * x)
        wide_y, wide_x = (1 + scale_y) * y, (1 + scale_x) * x
        return shift[0] + bent * (cos * wide_y + sin * wide_x), shift[1] + bent * (cos * wide_x - sin * wide_y)

    return place


def displacement_m(camera: Camera, geometry: Any, shift: Any) -> Float[Array, "2 term"]:
    """Where pixels see light, over where an upright camera's do, as `sim.propagation.farfield.bent` takes it.

    Exact: the places are cubic polynomials, which their values at sixteen points tell. Arguments as of `places`.
    """
    half = camera.window / 2
    y, x = (half * points for points in _POINTS)
    found = places(geometry, shift, camera.sensor_distance_m / camera.pixel_m)(y, x)
    return camera.pixel_m * jnp.stack([_FROM_POINTS @ (end - start) for end, start in zip(found, (y, x), strict=True)])


# Places (y, x) in half windows, and the matrix from values there to coefficients.
_POINTS = tuple(axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 4), np.linspace(-1, 1, 4), indexing="ij"))
_FROM_POINTS = np.linalg.pinv(np.stack([_POINTS[0] ** p * _POINTS[1] ** q for p, q in CUBIC], axis=1))


def room_of(camera: Camera, prior: GeometryPrior) -> float:
    """Share by which a camera, off by what is looked for at most, turns, stretches and bends the image."""
    if prior.upright:
        return 0.0
    turn, scale_y, scale_x, distortion = (abs(m) + REACH * s for m, s in zip(prior.mean, prior.sigma, strict=True))
    corner = camera.window * camera.pixel_m / np.sqrt(2) / camera.sensor_distance_m
    # Along the radius a cubic changes three times as fast as its value.
    return float(turn + max(scale_y, scale_x) + 3 * distortion * corner**2)


def geometry_label(name: str) -> str:
    """A quantity in words: "camera scale x" for "scale_x"."""
    return f"camera {name.replace('_', ' ')}"


def geometry_text(name: str, value: float, sigma: float) -> str:
    """A quantity with its unit and its standard deviation: "1.002 ± 0.004 °"."""
    return number_text(value, sigma, *_UNITS.get(name, _PER_CENT))
