"""One small mask order, written once and copied where a test wants to damage it."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.order.write import write_order
from tests.fab.maps import FEW, PLAIN

# Odd and even sides, and a pitch whose half is a whole number of nanometres, as in the automotive design.
SHAPE = (21, 16)


@pytest.fixture(scope="session")
def levels() -> Levels:
    return Levels(16, 75e-9)


@pytest.fixture(scope="session")
def grid() -> Grid:
    return Grid(SHAPE, 1.85e-6)


@pytest.fixture(scope="session")
def level_map(levels, grid) -> LevelMap:
    level = np.random.default_rng(7).integers(0, 16, SHAPE).astype(np.uint8)
    return LevelMap(level, levels, grid, grid.extent_m[1], "small")


@pytest.fixture(scope="session")
def written_order(tmp_path_factory, level_map) -> Path:
    folder = tmp_path_factory.mktemp("orders") / "small"
    write_order(folder, level_map, source={"height_map": "a test"}, wafer=FEW, formats=PLAIN)
    return folder


@pytest.fixture
def order_folder(written_order, tmp_path) -> Path:
    """A copy of the order that a test may damage."""
    return Path(shutil.copytree(written_order, tmp_path / "order"))
