"""Radial maps: which maps are rasters of rings, and the rings that they stand for.

A radial design is a height per ring around the axis, every ring as wide as a pixel. Masks are drawn in pixels: each
takes the level of the ring in which its centre lies. From such a map the rings come back without loss, so nothing
but the map has to be handed on, and a map that was repaired or re-drawn is radial only if it still is one.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fab.aperture import RoundAperture
from fab.level_map import LevelMap
from fab.solids.substrate import Rings
from fab.units import NM

# A narrower rest of a ring at the aperture belongs to the ring before it.
_REST_M = 1 * NM
_CLOSEST_M = 0.3 * NM
_SAMPLES = 1 << 20
_GOLDEN_RAD = math.pi * (3 - math.sqrt(5))


@njit(cache=True)
def _ring_levels(level_map, inside, out):  # pragma: no cover - compiled
    """Write the level of every ring into `out` (-1 where no centre lies); return whether all pixels agree.

    Squared radii in pixels are multiples of a quarter and so exact. A centre on a circle may have the level of either
    ring.
    """
    ny, nx = level_map.shape
    last = out.size - 1
    for between in (False, True):
        for j in range(ny):
            y = j - (ny - 1) / 2
            for i in range(nx):
                if not inside[j, i]:
                    continue
                x = i - (nx - 1) / 2
                squared = x * x + y * y
                ring = int(math.sqrt(squared))
                if (ring > 0 and ring * ring == squared) != between:
                    continue
                level = level_map[j, i]
                here = min(ring, last)
                if between and level == out[min(ring - 1, last)]:
                    continue
                if out[here] < 0:
                    out[here] = level
                elif out[here] != level:
                    return False
    return True


def ring_levels(level_map: LevelMap) -> NDArray[np.uint8] | None:
    """Return the level of every ring ``(n,)`` from the axis on if a map is a raster of rings, otherwise None.

    Rings end at the rim of a round relief; another has none. Rings in which no pixel's centre lies are not etched.
    """
    grid, relief = level_map.grid, level_map.relief
    if not isinstance(relief, RoundAperture):
        return None
    count = max(1, math.ceil((relief.diameter_m / 2 - _REST_M) / grid.pitch_m))
    found = np.full(count, -1, dtype=np.int16)
    if not _ring_levels(level_map.level, relief.inside(grid), found):
        return None
    return np.where(found < 0, level_map.levels.count - 1, found).astype(np.uint8)


def rings_from_levels(ring_level: NDArray[np.uint8], level_map: LevelMap) -> Rings:
    """Return the rings of a map: one pixel wide each, the last one as far as the edge of the relief."""
    levels = level_map.levels
    outer_m = np.arange(1, len(ring_level) + 1) * np.float64(level_map.grid.pitch_m)
    outer_m[-1] = level_map.aperture_m / 2
    order, heights_m = levels.by_height()
    # STEP cannot tell levels apart that some sets of etch depths bring to almost one height.
    apart = np.diff(heights_m, append=np.inf) > _CLOSEST_M
    told_m = np.empty(levels.count)
    told_m[order] = heights_m[apart][np.cumsum(apart) - apart]
    return Rings(outer_m, told_m[ring_level], levels.total_m)


def pixel_share(level_map: LevelMap, ring_level: NDArray[np.uint8]) -> float:
    """Return the share of the relief, at a million even points (0.1 %), where pixels and rings differ."""
    grid, aperture_m = level_map.grid, level_map.aperture_m
    number = np.arange(_SAMPLES)
    radius_m = aperture_m / 2 * np.sqrt((number + 0.5) / _SAMPLES)
    x_m, y_m = radius_m * np.cos(number * _GOLDEN_RAD), radius_m * np.sin(number * _GOLDEN_RAD)
    ny, nx = grid.shape
    row, column = (
        np.clip(np.floor(v / grid.pitch_m + n / 2).astype(np.int64), 0, n - 1) for v, n in ((y_m, ny), (x_m, nx))
    )
    ring = np.minimum((radius_m / grid.pitch_m).astype(np.int64), len(ring_level) - 1)
    return float(np.mean(level_map.level[row, column] != ring_level[ring]))
