"""Linear light: out of and into sRGB's display values, and how much of it a lens passes off its axis.

Everything between a scene and the sensor's electrons adds up in linear light. Pictures are stored in display values;
the curve between the two is that of IEC 61966-2-1.
"""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fab.grid import Grid

# numpy in, numpy out; jax in, jax out.
Pixels = TypeVar("Pixels", Float[Array, "*s"], Float[np.ndarray, "*s"])

_SLOPE, _OFFSET, _EXPONENT = 12.92, 0.055, 2.4
_BEND_DISPLAY, _BEND_LINEAR = 0.04045, 0.0031308


def linear_from_srgb(display: Pixels) -> Pixels:
    """Linear light of sRGB display values, 0 to 1 for 0 to 1.

    Values beyond 0 to 1 follow the same curve (negative ones its straight part), so nothing is cut off here.
    """
    xp: Any = jnp if isinstance(display, jax.Array) else np
    # The power never sees the dark side, whose gradient would be infinite or not a number there.
    bright = xp.maximum(display, _BEND_DISPLAY)
    curve = ((bright + _OFFSET) / (1 + _OFFSET)) ** _EXPONENT
    return xp.where(display <= _BEND_DISPLAY, display / _SLOPE, curve)


def srgb_from_linear(light: Pixels) -> Pixels:
    """Inverse of `linear_from_srgb`, with a finite gradient at black."""
    xp: Any = jnp if isinstance(light, jax.Array) else np
    bright = xp.maximum(light, _BEND_LINEAR)
    curve = (1 + _OFFSET) * bright ** (1 / _EXPONENT) - _OFFSET
    return xp.where(light <= _BEND_LINEAR, light * _SLOPE, curve)


def lens_shading(
    shape: tuple[int, int],
    pixel_m: float,
    focal_m: float,
    radial: tuple[float, ...] = (),
    centre_m: tuple[float, float] = (0.0, 0.0),
) -> Float[np.ndarray, "y x"]:
    """Gain of every pixel relative to the axis: cos⁴ of its chief ray's angle, times a polynomial.

    Args:
        shape: pixels (y, x) of the frame.
        pixel_m: pixel pitch, metres.
        focal_m: distance from the lens to the sensor, metres.
        radial: coefficients a, b, ... of 1 + a q² + b q⁴ + ..., where q is the distance from the axis over the
            frame's half diagonal: a measured lens' departure from the law (vignetting makes it fall faster).
        centre_m: where the middle of the frame lies on the sensor (y, x), metres from the axis, for a cut-out.

    Returns:
        `[y, x]` gain, float32, to be multiplied with a capture before noise.
    """
    grid = Grid(shape, pixel_m)
    square = (grid.axis_m("y")[:, None] + centre_m[0]) ** 2 + (grid.axis_m("x")[None, :] + centre_m[1]) ** 2
    height, width = grid.extent_m
    relative = square / ((height / 2) ** 2 + (width / 2) ** 2)
    polynomial = 1.0 + sum(a * relative ** (k + 1) for k, a in enumerate(radial))
    return (polynomial / (1 + square / focal_m**2) ** 2).astype(np.float32)
