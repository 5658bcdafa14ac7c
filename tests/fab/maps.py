"""Level maps for the tests."""

import math

import numpy as np
from numpy.typing import ArrayLike

from fab.grid import Grid
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.order.formats import Formats

# Every mask file as it can be read and changed without unpacking.
PLAIN = Formats("gds", combined_gds=True)

# Nine dies instead of hundreds, whose chrome and places take most of the time that a small order takes.
FEW = Wafer(dies=(3, 3))

# What the names of the order of `tests/fab/conftest.py` begin with; its last part is the digest of its geometry.
SMALL = "SMALL_A_1P85_4823"


def level_map_from(
    level: ArrayLike,
    levels: Levels = Levels(16, 75e-9),  # noqa: B008
    pitch_m: float = 1e-6,
    aperture_m: float = math.inf,
    name: str = "doe",
) -> LevelMap:
    """A level map without an aperture, unless one is asked for."""
    level = np.asarray(level, dtype=np.uint8)
    return LevelMap(level, levels, Grid((level.shape[0], level.shape[1]), pitch_m), aperture_m, name)


def wide_map(level: ArrayLike, levels: Levels, grid: Grid, name: str = "doe") -> LevelMap:
    """A level map whose aperture is as wide as its raster."""
    return LevelMap(np.asarray(level), levels, grid, min(grid.extent_m), name)
