"""Where the pixels of a window lie among the directions of light: the lens's mapping, and a sensor that is not perfect.

The far field is sampled at equal steps of the direction sine s, less that of the chief ray, times the distance d of
the sensor. A lens images the direction to a height on the sensor (`sim.camera.Camera.image_m`); the map here goes the
other way, from pixels to directions. Light is spread evenly over direction sines (Parseval's sum runs over them), so
that a pixel's energy is the integral over its share of them, whatever the mapping.
"""

from typing import Any

import numpy as np
from jaxtyping import Array, Float

from sim.camera import Camera
from sim.lens import direction_sines
from sim.propagation.mapped import PlaceMap

CUBIC = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
"""Powers of (y, x) of the ten terms of a cubic displacement."""


def window_places(camera: Camera, sample_m: float, field_rad: tuple[float, float] = (0.0, 0.0)) -> PlaceMap:
    """Map from the window's pixels to samples of the far field, `sample_m` metres apart on an ideal sine lens.

    The window's middle is at the chief ray of the field angles (y, x). Samples count from the light of a beam, which
    may be tilted beside it.
    """
    chief = direction_sines(field_rad)
    middle_m, moved = camera.image_m(*chief), camera.moved_sines(field_rad)
    distance, pixel = camera.sensor_distance_m, camera.pixel_m

    def places(row: Any, column: Any) -> tuple[Any, Any]:
        if camera.images_alike:
            return row * (pixel / sample_m), column * (pixel / sample_m)
        y, x = camera.sines_of(middle_m[0] + row * pixel, middle_m[1] + column * pixel)
        y, x = y - (chief[0] + moved[0]), x - (chief[1] + moved[1])
        return y * (distance / sample_m), x * (distance / sample_m)

    return places


def cubic_places(places: PlaceMap, camera: Camera, displacement_m: Float[Array, "2 term"]) -> PlaceMap:
    """The same map for a sensor whose pixels are displaced by cubic polynomials of their place in the window.

    `displacement_m` holds the coefficients of the displacements along y and along x, metres on the sensor, of the terms
    `CUBIC`, with y and x counted in half windows from the middle. A sensor turned by a small angle a, from +x toward
    +y, has its pixels displaced by (a x, -a y) half windows; one whose pixels are farther apart along x by a share b,
    by (0, b x).
    """
    half = camera.window / 2

    def displaced(row: Any, column: Any) -> tuple[Any, Any]:
        y, x = row / half, column / half
        terms = [y**p * x**q for p, q in CUBIC]
        dy, dx = (sum(c[k] * term for k, term in enumerate(terms)) for c in displacement_m)
        return places(row + dy / camera.pixel_m, column + dx / camera.pixel_m)

    return displaced


def largest_reach(places: PlaceMap, window: int) -> float:
    """Farthest sample that a window uses, from the middle one along either axis."""
    edge = np.linspace(-window / 2, window / 2, 33)
    found = [places(*way) for end in edge[[0, -1]] for way in ((edge, end), (end, edge))]
    return max(float(np.abs(part).max()) for place in found for part in place)
