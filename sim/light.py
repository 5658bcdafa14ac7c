"""Linear light: out of and into sRGB's display values.

Everything between a scene and the sensor's electrons adds up in linear light. Pictures are stored in display values;
the curve between the two is that of IEC 61966-2-1.
"""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# numpy in, numpy out; jax in, jax out.
Pixels = TypeVar("Pixels", Float[Array, "*s"], Float[np.ndarray, "*s"])

_SLOPE, _OFFSET, _EXPONENT = 12.92, 0.055, 2.4
_BEND_DISPLAY, _BEND_LINEAR = 0.04045, 0.0031308


def linear_from_srgb(display: Pixels) -> Pixels:
    """Linear light of sRGB display values, 0 to 1 for 0 to 1; values beyond follow the same curve, unclipped."""
    xp: Any = jnp if isinstance(display, jax.Array) else np
    # The power never sees the dark side, whose gradient would be infinite or not a number there.
    bright = xp.maximum(display, _BEND_DISPLAY)
    curve = ((bright + _OFFSET) / (1 + _OFFSET)) ** _EXPONENT
    return xp.where(display <= _BEND_DISPLAY, display / _SLOPE, curve)


def srgb_from_linear(light: Pixels) -> Pixels:
    """Display values of linear light: the inverse of `linear_from_srgb`, with a finite gradient at black."""
    xp: Any = jnp if isinstance(light, jax.Array) else np
    bright = xp.maximum(light, _BEND_LINEAR)
    curve = (1 + _OFFSET) * bright ** (1 / _EXPONENT) - _OFFSET
    return xp.where(light <= _BEND_LINEAR, light * _SLOPE, curve)
