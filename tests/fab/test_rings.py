"""Which maps are rasters of rings, and what the rings are."""

import numpy as np
import pytest

from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.solids.rings import pixel_share, ring_levels, rings_from_levels
from fab.units import NM, UM
from tests.fab.maps import level_map_from

SIXTEEN = Levels(16, 75 * NM)


def raster(profile, grid, aperture_m):
    """Every pixel takes the level of the ring that its centre lies in, and is blank outside."""
    radius = np.hypot(grid.axis_m("y")[:, None], grid.axis_m("x")[None, :])
    ring = np.minimum((radius / grid.pitch_m).astype(int), len(profile) - 1)
    return LevelMap(profile[ring].astype(np.uint8), SIXTEEN, grid, aperture_m)


@pytest.mark.parametrize("shape", [(40, 40), (41, 41), (101, 101), (40, 60), (7, 9)])
@pytest.mark.parametrize("share", [1.0, 0.9, 0.777])
def test_the_rings_of_a_raster_come_back(shape, share):
    # Odd sides put centres exactly on the circles between rings; 1.85 um rounds them to either side.
    grid = Grid(shape, 1.85 * UM)
    aperture_m = share * min(grid.extent_m)
    profile = np.random.default_rng(sum(shape)).integers(0, 16, 100)
    found = ring_levels(raster(profile, grid, aperture_m))
    assert found is not None
    assert len(found) == np.ceil(aperture_m / 2 / grid.pitch_m - 1e-9)
    assert np.array_equal(found, profile[: len(found)])


def test_one_pixel_that_does_not_belong_spoils_it():
    grid = Grid((30, 30), UM)
    profile = np.random.default_rng(1).integers(0, 16, 30)
    level_map = raster(profile, grid, 30 * UM)
    assert ring_levels(level_map) is not None
    for row, column in ((15, 15), (3, 12), (15, 29)):
        spoiled = level_map.level.copy()
        spoiled[row, column] = (spoiled[row, column] + 1) % 16
        assert ring_levels(level_map.with_level(spoiled)) is None
    noise = np.random.default_rng(0).integers(0, 16, (30, 30)).astype(np.uint8)
    assert ring_levels(level_map.with_level(noise)) is None


def test_rings_are_one_pixel_wide_and_end_at_the_aperture():
    grid, aperture_m = Grid((11, 11), 2 * UM), 19 * UM
    profile = np.array([3, 15, 0, 7, 9])
    level_map = raster(profile, grid, aperture_m)
    found = ring_levels(level_map)
    assert found is not None
    rings = rings_from_levels(found, level_map)
    assert rings.outer_m == pytest.approx(np.array([2, 4, 6, 8, 9.5]) * UM)
    assert rings.height_m == pytest.approx(profile * 75 * NM)
    assert rings.blank_m == pytest.approx(1125 * NM)


def test_a_plain_map_is_radial():
    plain = level_map_from(np.full((6, 5), 15), SIXTEEN, UM, 5 * UM)
    found = ring_levels(plain)
    assert found is not None
    assert found.tolist() == [15, 15, 15]
    assert rings_from_levels(found, plain).removed.volume_m3 == 0


def test_levels_that_depths_bring_to_almost_one_height_are_one_height_in_step():
    # Masks 0 and 1 together go 0.1 nm deeper than mask 2.
    levels = Levels(8, 75 * NM, (75 * NM, 150.1 * NM, 225 * NM))
    assert np.diff(levels.by_height()[1]).min() < 0.3 * NM
    rings = rings_from_levels(np.arange(8, dtype=np.uint8), level_map_from(np.zeros((16, 16)), levels, UM, 16 * UM))
    assert np.abs(rings.height_m - levels.heights_m()).max() <= 0.11 * NM
    steps = np.diff(np.unique(rings.height_m))
    assert steps.min() > 0.3 * NM
    assert len(steps) == 6


def test_the_share_of_pixels_that_differ_from_the_circles():
    # One disc in one pixel: what the square has too much lies outside the aperture, so nothing differs.
    one = level_map_from([[0]], SIXTEEN, UM, UM)
    assert pixel_share(one, np.zeros(1, np.uint8)) == 0
    # Four pixels about the middle, the disc of 1 um and its ring: the corners of the square between them differ.
    square = np.full((4, 4), 15, np.uint8)
    square[1:3, 1:3] = 0
    square = level_map_from(square, SIXTEEN, UM, 4 * UM)
    rings = ring_levels(square)
    assert rings is not None
    assert rings.tolist() == [0, 15]
    share = (4 - np.pi) / (4 * np.pi)
    # A million points that are spread evenly.
    assert pixel_share(square, rings) == pytest.approx(share, abs=1e-3)
