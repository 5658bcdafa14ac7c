"""Slips of those who make plates in Python: what is no staircase, raster or map is told in words."""

# What is given here is of other types than annotations say, on purpose.
# pyright: reportArgumentType=false

import numpy as np
import pytest

from fab.errors import InputError
from fab.grid import Grid
from fab.height import HeightMap
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.units import NM

SIXTEEN = Levels(16, 75 * NM)
GRID = Grid((4, 4), 2e-6)
HEIGHT_M = np.zeros((4, 4))


@pytest.mark.usefixtures("annotations_unchecked")
@pytest.mark.parametrize(
    ("make", "told"),
    [
        (
            lambda: Levels(4, "100 nm"),
            r"level step: must be positive .* but got '100 nm'\. Give 75e-9 for 75 nm",
        ),
        (lambda: Levels(4, None), "level step: must be positive"),
        (lambda: Levels(4, True), "level step: must be positive"),
        (lambda: Levels(4, 100), r"level step: .*at most 1 mm, in metres, but got 100\."),
        (lambda: Levels(4, 1e-7, ("100 nm", "200 nm")), "etch depths: must be positive.*'100 nm'"),
        (lambda: Levels(4, 1e-7, 1e-7), "etch depths: must be a depth for each mask, but got 1e-07"),
        (lambda: Grid(32, 2e-6), r"grid: shape: must be two counts of pixels \(ny, nx\), but got 32"),
        (lambda: Grid((32, 32, 3), 2e-6), "grid: shape: must be two counts"),
        (lambda: Grid(None, 2e-6), "grid: shape: must be two counts"),
        (lambda: Grid((32, 32), "2 um"), "grid: pitch: must be positive.*'2 um'.*2e-6 for 2 um"),
        (lambda: Grid((32, 32), None), "grid: pitch: must be positive.*None"),
        (lambda: HeightMap(HEIGHT_M, (4, 4), 8e-6), r"grid: must be a Grid, but got a tuple\. Give a fab\.Grid"),
        (lambda: HeightMap([[0.0], [0.0, 1.0]], GRID, 8e-6), "height map: must be an array .*different lengths"),
        (lambda: LevelMap(HEIGHT_M.astype(np.uint8), 4, GRID, 8e-6), "levels: must be a Levels, but got an int"),
        (lambda: LevelMap(HEIGHT_M.astype(np.uint8), SIXTEEN, (4, 4), 8e-6), "grid: must be a Grid, but got a tuple"),
        (lambda: LevelMap.from_height(HEIGHT_M, SIXTEEN), r"height: must be a HeightMap, .*Give a fab\.HeightMap"),
        (lambda: LevelMap.from_height(HeightMap(HEIGHT_M, GRID, 8e-6), 4), "levels: must be a Levels"),
        (lambda: LevelMap.from_height(HeightMap(HEIGHT_M + 2e-6, GRID, 8e-6), SIXTEEN), r"\(wrapped=True\)"),
    ],
)
def test_arguments_of_another_kind_are_told_in_words(make, told):
    """What a first-time user types: text with a unit, whole metres, a bare array, a tuple for a raster."""
    with pytest.raises(InputError, match=told):
        make()


def test_lists_of_heights_are_a_map():
    height = HeightMap([[0.0, 75e-9], [150e-9, 0.0]], Grid((2, 2), 2e-6), 4e-6)
    assert LevelMap.from_height(height, SIXTEEN).level.tolist() == [[0, 1], [2, 0]]
