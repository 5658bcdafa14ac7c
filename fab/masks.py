"""Bit planes: which pixels each etch mask opens, and the level map that they make together.

Mask k opens a pixel of level l where bit k of ``L - 1 - l`` is 1. By default it etches ``2**k`` steps there, so that
the etches add up to ``(L - 1 - l)`` steps. Splitting and joining are exact inverses, whatever the depths are.
"""

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.levels import Levels, require_levels


def planes(level_map: NDArray[np.integer], levels: Levels) -> NDArray[np.uint8]:
    """Split a level map ``[y, x]`` into its etch masks ``[bit, y, x]``: 1 where mask `bit` is open (etched)."""
    etched = np.uint8(levels.count - 1) - require_levels(level_map, levels)
    out = np.empty((levels.bits, *etched.shape), dtype=np.uint8)
    for bit in range(levels.bits):
        np.bitwise_and(etched >> np.uint8(bit), np.uint8(1), out=out[bit])
    return out


def level_map_from_planes(bit_planes: NDArray[np.integer] | NDArray[np.bool_], levels: Levels) -> NDArray[np.uint8]:
    """Join etch masks ``[bit, y, x]`` of 0 and 1, mask 0 first, into the level map ``[y, x]`` that they make."""
    if bit_planes.ndim != 3 or bit_planes.shape[0] != levels.bits:
        rule = f"{levels.count} levels need {levels.bits} planes [bit, y, x]"
        raise InputError("bit planes", rule, f"shape {bit_planes.shape}", "Give one plane per mask.")
    if bit_planes.size and (bit_planes.min() < 0 or bit_planes.max() > 1):
        raise InputError("bit planes", "every value must be 0 or 1", "another value", "Threshold the planes first.")
    etched = np.zeros(bit_planes.shape[1:], dtype=np.uint8)
    for bit in range(levels.bits):
        etched |= bit_planes[bit].astype(np.uint8) << np.uint8(bit)
    return np.uint8(levels.count - 1) - etched
