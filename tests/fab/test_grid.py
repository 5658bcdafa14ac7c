import json

import numpy as np
import pytest

from fab.errors import InputError
from fab.grid import Grid
from fab.layout.wafer import Wafer


def test_the_centre_lies_between_samples_for_even_counts_and_on_one_for_odd():
    grid = Grid((3, 4), 2.0)
    assert grid.axis_m("y").tolist() == [-2.0, 0.0, 2.0]
    assert grid.axis_m("x").tolist() == [-3.0, -1.0, 1.0, 3.0]
    assert grid.extent_m == (6.0, 8.0)


def test_numbers_of_numpy_are_those_of_python():
    """An order writes them as JSON."""
    grid = Grid((np.int64(3), np.int32(4)), np.float32(2.0))  # pyright: ignore[reportArgumentType]
    assert json.dumps([grid.shape, grid.pitch_m]) == "[[3, 4], 2.0]"
    assert json.dumps(Wafer(dies=(np.int64(1), np.int64(2))).dies) == "[1, 2]"  # pyright: ignore[reportArgumentType]


def test_a_circle_takes_the_pixels_whose_centre_is_inside_or_on_it():
    inside = Grid((5, 5), 1e-6).inside_circle(4e-6)
    expected = np.array([[0, 0, 1, 0, 0], [0, 1, 1, 1, 0], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0], [0, 0, 1, 0, 0]])
    assert np.array_equal(inside, expected)


@pytest.mark.parametrize("count", [400, 401])
def test_a_circle_has_the_area_and_the_symmetry_of_a_circle(count):
    inside = Grid((count, count), 1.0).inside_circle(count)
    # The lattice-point error of a circle stays far below one pixel per unit of circumference.
    assert abs(np.count_nonzero(inside) - np.pi * count**2 / 4) < 0.2 * count
    assert np.array_equal(inside, inside.T)
    assert np.array_equal(inside, inside[::-1])


@pytest.mark.parametrize("diameter_m", [0.0, 1.0, 4.0, 7.3, 9.0, np.inf])
@pytest.mark.parametrize("shape", [(1, 1), (5, 8), (9, 4)])
def test_pixels_in_a_circle_are_counted_as_they_are_drawn(shape, diameter_m):
    grid = Grid(shape, 1.0)
    assert grid.count_inside_circle(diameter_m) == np.count_nonzero(grid.inside_circle(diameter_m))


@pytest.mark.parametrize(
    ("shape", "pitch_m"),
    [((0, 3), 1.0), ((3, 0), 1.0), ((3, 3), 0.0), ((3, 3), float("nan")), ((3.5, 3), 1.0), ((float("nan"), 3), 1.0)],
)
def test_impossible_grids_are_refused(shape, pitch_m):
    with pytest.raises(InputError, match="grid"):
        Grid(shape, pitch_m)
