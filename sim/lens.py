"""Where on a sensor the light of a direction lands: by the sine or the tangent of its angle, and a lens's distortion.

Plain functions of direction sines and of places as shares of the sensor's distance; `sim.camera.Camera` has the
distance, in metres.
"""

import math
from collections.abc import Callable
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from fab.errors import InputError
from fab.units import number_of

Mapping = Literal["sine", "tangent"]
Distortion = tuple[float, float]
IDEAL: Distortion = (0.0, 0.0)
_INVERSIONS = 8  # steps of Newton's method that undo a distortion; five reach double precision for 20 %
# How far beyond the corners of a window the image must not be folded over: light is looked for a little outside.
_MARGIN = 1.2


def image_place(mapping: Mapping, distortion: Distortion, sine_y: Any, sine_x: Any) -> tuple[Any, Any]:
    """Place (y, x) of light with direction sines (y, x), as a share of the sensor's distance; see `Camera`."""
    y, x = sine_y, sine_x
    if mapping == "tangent":
        longer = (1.0 - y * y - x * x) ** -0.5
        y, x = y * longer, x * longer
    (k1, k2), square = distortion, y * y + x * x
    grown = 1.0 + square * (k1 + k2 * square)
    return y * grown, x * grown


def sines_at(mapping: Mapping, distortion: Distortion, y: Any, x: Any) -> tuple[Any, Any]:
    """Direction sines (y, x) of light from its place, a share of the sensor's distance: the inverse of `image_place`.

    Plain arithmetic, for numbers and arrays of numpy or jax. Meaningless where the image is folded over
    (`farthest_place`).
    """
    (k1, k2), seen, shrunk = distortion, y * y + x * x, 1.0
    for _ in range(_INVERSIONS if any(distortion) else 0):
        square = seen * shrunk * shrunk
        missed = shrunk * (1.0 + square * (k1 + k2 * square)) - 1.0
        shrunk = shrunk - missed / (1.0 + square * (3.0 * k1 + 5.0 * k2 * square))
    y, x = y * shrunk, x * shrunk
    if mapping == "tangent":
        shorter = (1.0 + y * y + x * x) ** -0.5
        y, x = y * shorter, x * shorter
    return y, x


def _turning_square(mapping: Mapping, distortion: Distortion) -> float:
    """Square of the undistorted place, in sensor distances, from which on places see no direction of their own."""
    k1, k2 = distortion
    # The height p (1 + k1 p² + k2 p⁴) stops growing where 1 + 3 k1 q + 5 k2 q² = 0 at q = p².
    turns = [1.0 if mapping == "sine" else math.inf]
    if k2:
        root = 9 * k1**2 - 20 * k2
        turns += [(-3 * k1 + sign * math.sqrt(root)) / (10 * k2) for sign in (-1, 1) if root >= 0]
    elif k1:
        turns.append(-1 / (3 * k1))
    return min(turn for turn in turns if turn > 0)


def farthest_place(mapping: Mapping, distortion: Distortion) -> float:
    """Distance from the axis up to which every place sees a direction of its own, or infinity.

    Beyond, a distortion folds the image over, or light would have to come from more than 90 degrees.
    """
    k1, k2 = distortion
    square = _turning_square(mapping, distortion)
    return math.inf if math.isinf(square) else math.sqrt(square) * (1 + square * (k1 + k2 * square))


def distorted_place(mapping: Mapping, distortion: Distortion, sine: float) -> float:
    """Distance from the axis, in sensor distances, where light of a direction sine lands; infinite where it folds."""
    place = sine if mapping == "sine" else sine / math.sqrt(1 - sine**2)
    square = place**2
    if square >= _turning_square(mapping, distortion):
        return math.inf
    return place * (1 + square * (distortion[0] + distortion[1] * square))


def check_lens(mapping: str, distortion: Distortion, corner: float, key: Callable[[str], str] = str) -> None:
    """Raise an `InputError` for a lens that cannot image a window whose corners lie `corner` from the axis.

    `key` writes the names of the two values, "mapping" and "distortion", as the user knows them.
    """
    if mapping not in get_args(Mapping):
        rule = f"must be one of {', '.join(get_args(Mapping))}"
        raise InputError(key("mapping"), rule, repr(mapping), 'Use "tangent" for a lens without distortion.')
    given: Any = distortion
    if not isinstance(given, tuple | list) or len(given) != 2 or not all(map(math.isfinite, map(number_of, given))):
        rule = "must be two finite numbers, k1 and k2"
        raise InputError(key("distortion"), rule, f"{distortion}", "Use (0, 0) for none.")
    if mapping == "sine" and not any(distortion):
        return
    farthest = farthest_place(mapping, distortion)  # pyright: ignore[reportArgumentType]
    if farthest < _MARGIN * corner:
        rule = (
            f"the image must not fold over within {_MARGIN:g} times the distance of the window's corners from the axis"
        )
        got = f"k1, k2 = {distortion[0]:g}, {distortion[1]:g}: at {farthest:.3g} sensor distances, with corners "
        cure = "Use weaker distortion or a smaller window."
        raise InputError(key("distortion"), rule, f"{got}at {corner:.3g}", cure)


def direction_sines(field_rad: tuple[float, float]) -> Float[np.ndarray, "2"]:
    """Direction sines (y, x) of the chief ray for field angles (y, x) in radians.

    The angles are those of its projections on the yz and xz planes, positive where light travels toward +y or +x.
    """
    angles = np.asarray(field_rad, dtype=np.float64)
    if not np.all(np.abs(angles) < np.pi / 2):
        rule, cure = "light must come from before the DOE, within 90 degrees of its axis", "Choose smaller angles."
        raise InputError("angles", rule, f"{np.degrees(angles).round(3).tolist()} degrees in all", cure)
    tangents = np.tan(angles)
    return tangents / np.sqrt(1.0 + np.sum(tangents**2))
