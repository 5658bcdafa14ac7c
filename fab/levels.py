"""Levels: the staircase that lithography can make, and the nearest step for every height.

Level l of L stands ``l * step`` above the deepest etched floor. The blank glass is the top level
``L - 1``; a pixel of level l is etched ``(L - 1 - l) * step`` deep.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.height import refuse_where, require_heights
from fab.units import format_length

__all__ = ["Levels", "height_of", "quantise", "require_levels"]

# Rows that are handled at once, so that a 4400 x 4400 map needs no second copy in float64.
_ROWS = 256


@dataclass(frozen=True)
class Levels:
    """An equal staircase of `count` heights, made by log2(count) etches.

    Attributes:
        count: number of levels L, a power of two from 2 to 64.
        step_m: height of one step, metres.
    """

    count: int
    step_m: float

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            InputError: a count that is not a power of two from 2 to 64, or a step that is not positive.
        """
        if self.count not in (2, 4, 8, 16, 32, 64):
            raise InputError(
                "levels", "must be a power of two from 2 to 64", self.count, "Choose 2, 4, 8, 16, 32 or 64."
            )
        if not 0 < self.step_m < float("inf"):
            raise InputError("level step", "must be positive and finite", self.step_m, 'Give a step such as "75 nm".')

    @property
    def bits(self) -> int:
        """Number of etch masks, log2 of the count."""
        return self.count.bit_length() - 1

    def heights_m(self) -> NDArray[np.float64]:
        """Return the height of every level above the deepest floor, metres, shape ``(count,)``."""
        return np.arange(self.count, dtype=np.float64) * np.float64(self.step_m)

    def etch_depth_m(self, bit: int) -> float:
        """Return how deep one mask etches.

        Args:
            bit: the mask, from 0 to ``bits - 1``.

        Returns:
            ``2**bit * step_m`` in metres.

        Raises:
            ValueError: there is no such mask.
        """
        if not 0 <= bit < self.bits:
            raise ValueError(f"`bit` must lie from 0 to {self.bits - 1}, but got {bit}")
        return 2**bit * self.step_m


def require_levels(level_map: NDArray[np.integer], levels: Levels) -> NDArray[np.uint8]:
    """Check that an array is a level map of this staircase.

    Args:
        level_map: integers ``[y, x]`` from 0 to ``levels.count - 1``.
        levels: the staircase.

    Returns:
        The same numbers as a C-ordered uint8 array.

    Raises:
        InputError: not two-dimensional, empty, not integers, or a level that the staircase lacks.
    """
    cure = "Quantise the height map with these levels first."
    if level_map.ndim != 2 or level_map.size == 0 or level_map.dtype.kind not in "iu":
        got = f"{level_map.dtype} of shape {level_map.shape}"
        raise InputError("level map", "must be a filled two-dimensional array of integers", got, cure)
    low, high = int(level_map.min()), int(level_map.max())
    if low < 0 or high >= levels.count:
        raise InputError("level map", f"levels must lie from 0 to {levels.count - 1}", f"{low} to {high}", cure)
    return np.ascontiguousarray(level_map, dtype=np.uint8)


def quantise(height_m: NDArray[np.floating], levels: Levels) -> NDArray[np.uint8]:
    """Give every pixel the nearest level; halfway goes up, and the top level catches the half step above it.

    Args:
        height_m: heights above the deepest floor, metres, ``[y, x]``, float32 or float64.
        levels: the staircase.

    Returns:
        Level numbers from 0 to ``levels.count - 1``, ``[y, x]``.

    Raises:
        InputError: heights that are NaN, infinite, negative or more than half a step above the top level
            (the message says how many and where the first is), or an array of another kind.
    """
    require_heights(height_m, "height map")
    top = (levels.count - 0.5) * levels.step_m
    # One part in 1e6 of a step keeps a float32 height that means exactly half a step above the top.
    refuse_where(
        height_m,
        height_m > top + 1e-6 * levels.step_m,
        "height map",
        f"no height may lie more than half a step above the top level ({format_length(top)} for "
        f"{levels.count} levels of {format_length(levels.step_m)})",
        "Wrap the map to one wave of height, or choose more levels or a larger step.",
    )
    level_map = np.empty(height_m.shape, dtype=np.uint8)
    for start in range(0, height_m.shape[0], _ROWS):
        rows = height_m[start : start + _ROWS].astype(np.float64)
        nearest = np.floor(rows / levels.step_m + 0.5)
        level_map[start : start + _ROWS] = np.minimum(nearest, levels.count - 1)
    return level_map


def height_of(level_map: NDArray[np.integer], levels: Levels) -> NDArray[np.float64]:
    """Return the height of every pixel of a level map.

    Args:
        level_map: level numbers ``[y, x]``.
        levels: the staircase.

    Returns:
        Heights ``level * step_m`` in metres, ``[y, x]``.

    Raises:
        InputError: the array is not a level map of this staircase.
    """
    return levels.heights_m()[require_levels(level_map, levels)]
