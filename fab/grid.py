"""Grid: the pixel raster of a plate, where its centre is, and its edges moved both ways."""

import math
from dataclasses import dataclass
from numbers import Integral
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.units import number_of

# One part in so many keeps points that are exactly on a rim inside it.
SLACK = 1e-12


def moved_edges(edges: NDArray[Any], move: Any) -> tuple[NDArray[Any], NDArray[np.int64], NDArray[np.int64]]:
    """Return the raster of one axis' edges moved both ways, and which cells lie within the move of each of its own.

    Args:
        edges: edges of cells along an axis, rising.
        move: how far, in their unit.

    Returns:
        The lines of the raster, rising, and the first and end cell for every part between two of them.
    """
    moved = np.unique(np.concatenate([edges - move, edges + move]))
    # A cell reaches a part if it begins before the part ends, less the move, and ends after it begins.
    first = np.searchsorted(edges[1:] + move, moved[:-1], side="right")
    end = np.searchsorted(edges[:-1] - move, moved[1:], side="left")
    return moved, first, end


_PITCHES_M = 1e-20, 1e20  # far beyond what is drawn; squares of lengths and counts of pixels stay numbers


@dataclass(frozen=True)
class Grid:
    """A raster of square pixels centred on the optical axis.

    The origin lies in the middle of the raster: between two samples for an even count, on the middle sample for an odd
    one. Row 0 is the lowest y.

    Attributes:
        shape: pixels ``(ny, nx)``.
        pitch_m: edge of one pixel, metres.

    Raises:
        InputError: a shape that is not two integers of at least one, or a pitch that is not a number from 1e-20 m to
            1e20 m.
    """

    shape: tuple[int, int]
    pitch_m: float

    def __post_init__(self) -> None:
        try:
            ny, nx = self.shape
        except (TypeError, ValueError) as error:
            rule, cure = "must be two counts of pixels (ny, nx)", "Give array.shape of a map [y, x]."
            raise InputError("grid: shape", rule, repr(self.shape), cure) from error
        if not all(isinstance(n, Integral) for n in (ny, nx)):
            rule = "must count whole pixels"
            raise InputError("grid: shape", rule, self.shape, "Give integers, such as array.shape.")
        if ny < 1 or nx < 1:
            raise InputError("grid: shape", "must have at least one pixel per axis", self.shape, "Give a filled map.")
        object.__setattr__(self, "shape", (int(ny), int(nx)))  # of numpy, they would not go into JSON
        pitch_m = number_of(self.pitch_m)
        if not _PITCHES_M[0] <= pitch_m <= _PITCHES_M[1]:
            rule = "must be positive, from 1e-20 m to 1e20 m"
            raise InputError("grid: pitch", rule, repr(self.pitch_m), "Give the pixel pitch in metres, 2e-6 for 2 um.")
        object.__setattr__(self, "pitch_m", pitch_m)

    @property
    def extent_m(self) -> tuple[float, float]:
        """Height and width ``(y, x)`` of the raster from edge to edge, metres."""
        return self.shape[0] * self.pitch_m, self.shape[1] * self.pitch_m

    def axis_m(self, axis: Literal["x", "y"]) -> NDArray[np.float64]:
        """Return the pixel centres along ``"x"`` or ``"y"``, metres: ``(i - (n - 1) / 2) * pitch_m``, ``(n,)``."""
        if not isinstance(axis, str) or axis not in ("x", "y"):
            raise InputError("axis", 'must be "x" or "y"', repr(axis), "Choose one of them.")
        n = self.shape[1] if axis == "x" else self.shape[0]
        return (np.arange(n, dtype=np.float64) - (n - 1) / 2) * np.float64(self.pitch_m)

    def inside_circle(self, diameter_m: float) -> NDArray[np.bool_]:
        """Return ``[y, x]`` true where a pixel's centre lies inside a centred circle (diameter in metres) or on it."""
        x_squared, rests = self._circle(diameter_m)
        inside = np.empty(self.shape, dtype=np.bool_)
        for row, rest in enumerate(rests):
            np.less_equal(x_squared, rest, out=inside[row])
        return inside

    def count_inside_circle(self, diameter_m: float) -> int:
        """Return the number of pixels `inside_circle`, without drawing them."""
        x_squared, rests = self._circle(diameter_m)
        return int(np.searchsorted(np.sort(x_squared), rests, side="right").sum())

    def _circle(self, diameter_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return squared x of every column, and the greatest inside the circle for every row."""
        limit = (diameter_m / 2) ** 2 * (1 + SLACK)
        return self.axis_m("x") ** 2, limit - self.axis_m("y") ** 2


def fewest_pixels(length_m: float, pitch_m: float) -> int:
    """Return the fewest pixels of a pitch that are not shorter than a length; at least 1."""
    # Both are decimal numbers in binary: 2 um are two pixels of 1 um, and not three.
    return max(1, math.ceil(length_m / pitch_m * (1 - 1e-9)))
