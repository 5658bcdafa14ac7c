"""Apertures of every kind: their cells, areas, outlines and records."""

import math

import numpy as np
import pytest

from fab.aperture import RectangularAperture, RoundAperture, aperture_from, diameter_of
from fab.errors import InputError
from fab.grid import Grid
from fab.layout.geometry import Chrome
from fab.level_map import LevelMap, read_level_map, write_level_map
from fab.levels import Levels

UM = 1e-6
WIDE = RectangularAperture((30 * UM, 50 * UM))


def test_a_number_is_a_diameter_and_two_are_width_and_height():
    assert aperture_from(2e-3) == RoundAperture(2e-3)
    assert aperture_from([2e-3, 1e-3]) == RectangularAperture((1e-3, 2e-3))
    assert aperture_from([2.0, 1.0], 1e-3, 18) == RectangularAperture((1e-3, 2e-3))
    assert aperture_from(WIDE) is WIDE
    assert str(aperture_from([2e-3, 1e-3])) == "2 mm x 1 mm"
    assert str(aperture_from(1.8e-3)) == "1.8 mm"
    for one in (RoundAperture(1.8e-3), WIDE):
        assert aperture_from(one.record()) == one
    with pytest.raises(InputError, match="width, height"):
        aperture_from([1.0, 2.0, 3.0])
    with pytest.raises(InputError, match=r"must be round here, but got 50 um x 30 um"):
        diameter_of(WIDE)


@pytest.mark.parametrize("value", ["wide", None, [], ["1", "a"], [[1.0]], np.ones((2, 2)), 10**400, len])
def test_what_is_no_aperture_is_refused_by_where_it_came_from(value):
    with pytest.raises(InputError, match=r"map\.exr: must be a diameter or \[width, height\]") as error:
        aperture_from(value, where="map.exr")
    assert len(str(error.value)) < 200


def test_points_on_the_rim_of_a_disc_are_inside_as_cells_are():
    # 3, 4, 5: a centre exactly on the circle, but for rounding.
    grid = Grid((9, 9), 0.1)
    disc = RoundAperture(1.0)
    y, x = grid.axis_m("y")[:, None], grid.axis_m("x")[None, :]
    np.testing.assert_array_equal(disc.contains(y, x), disc.inside(grid))
    assert disc.contains(np.array([0.1 * 3]), np.array([0.4])).all()  # 0.30000000000000004


@pytest.mark.parametrize("shape", [(40, 60), (41, 61), (30, 50)])
def test_cells_of_a_rectangle_are_those_whose_centres_lie_in_it(shape):
    grid = Grid(shape, UM)
    inside = WIDE.inside(grid)
    y, x = np.meshgrid(grid.axis_m("y"), grid.axis_m("x"), indexing="ij")
    # On a rim that passes through centres, where counts are odd, these are inside.
    wanted = (np.abs(y) <= 15 * UM + 1e-12) & (np.abs(x) <= 25 * UM + 1e-12)
    np.testing.assert_array_equal(inside, wanted)
    assert WIDE.count_inside(grid) == np.count_nonzero(wanted)
    assert RoundAperture(30 * UM).count_inside(grid) == np.count_nonzero(RoundAperture(30 * UM).inside(grid))


def test_sizes_of_both_kinds():
    assert WIDE.area_m2 == pytest.approx(1500e-12)
    assert WIDE.area_in(UM, 3) == pytest.approx(4500)
    assert RoundAperture(4.0).area_m2 == pytest.approx(4 * math.pi)
    assert (WIDE.widest_m, WIDE.narrowest_m, WIDE.reach_m) == (50 * UM, 30 * UM, pytest.approx(np.hypot(15, 25) * UM))
    assert WIDE.shrunk(5 * UM).extent_m == pytest.approx((20 * UM, 40 * UM))
    (corners,) = WIDE.outlines_m(4)
    assert np.abs(corners).max(axis=0) == pytest.approx([25 * UM, 15 * UM])


def test_a_map_with_a_rectangular_relief_is_blank_around_it_and_comes_back_from_its_file(tmp_path):
    grid, levels = Grid((40, 60), UM), Levels(4, 0.3e-6)
    made = LevelMap(np.zeros(grid.shape, np.uint8), levels, grid, WIDE, "slit")
    assert np.count_nonzero(made.level == 0) == 1500
    assert (made.level[5:35, 5:55] == 0).all()
    write_level_map(tmp_path / "map.npz", made)
    again = read_level_map(tmp_path / "map.npz")
    assert (again.relief, again.digest) == (WIDE, made.digest)
    with pytest.raises(InputError, match="must be round here"):
        _ = again.aperture_m


@pytest.mark.parametrize("size", [(41 * UM, 50 * UM), (30 * UM, 61 * UM), (0.0, 50 * UM)])
def test_a_rectangle_that_is_not_on_the_raster_is_refused(size):
    grid = Grid((40, 60), UM)
    with pytest.raises(InputError, match="aperture: must lie on the raster, 60 um x 40 um"):
        LevelMap(np.zeros(grid.shape, np.uint8), Levels(4, 0.3e-6), grid, RectangularAperture(size))


def test_the_overlap_must_leave_an_opening():
    assert Chrome(overlap_m=10 * UM).opening(WIDE).sizes_m == pytest.approx((30 * UM, 10 * UM))
    with pytest.raises(InputError, match="chrome overlap"):
        Chrome(overlap_m=15 * UM).opening(WIDE)
