import numpy as np
import pytest

from fab.grid import Grid
from sim.aperture import circle_coverage, clear_area_m2


@pytest.mark.parametrize(("cells", "share"), [(40, 1.0), (41, 0.9), (64, 0.73), (5, 0.5)])
def test_coverage_equals_counting_fine_points(cells: int, share: float):
    grid = Grid((cells, cells), 2e-6)
    diameter = share * cells * 2e-6
    fine = Grid((cells * 100, cells * 100), 2e-8).inside_circle(diameter)
    counted = fine.reshape(cells, 100, cells, 100).mean(axis=(1, 3))
    # 100 x 100 points leave about one part in a hundred of an edge cell's width uncertain.
    np.testing.assert_allclose(circle_coverage(grid, diameter), counted, atol=6e-3)


def test_total_area_is_the_circles():
    grid = Grid((1000, 1000), 1.85e-6)
    coverage = circle_coverage(grid, grid.extent_m[0])
    # The module states 1e-7 of the circle for a thousand cells.
    area = float(coverage.sum(dtype=np.float64)) * grid.pitch_m**2
    assert area == pytest.approx(clear_area_m2(grid.extent_m[0]), rel=1e-7)


def test_coverage_is_full_inside_empty_outside_and_symmetric():
    grid = Grid((30, 30), 1e-6)
    coverage = circle_coverage(grid, 20e-6)
    assert coverage.dtype == np.float32
    assert coverage.min() == 0
    assert coverage.max() == 1
    assert np.all(coverage[grid.inside_circle(20e-6 - 1.5e-6)] == 1)
    assert np.all(coverage[~grid.inside_circle(20e-6 + 1.5e-6)] == 0)
    # Mirrored strips are summed in another order.
    np.testing.assert_allclose(coverage, coverage[::-1], atol=1e-6)
    np.testing.assert_allclose(coverage, coverage[:, ::-1], atol=1e-6)


def test_a_wider_opening_covers_more():
    grid = Grid((33, 33), 1e-6)
    areas = [circle_coverage(grid, d * 1e-6).sum(dtype=np.float64) for d in (3.0, 3.5, 8.0, 20.0, 33.0)]
    assert all(np.diff(areas) > 0)


def test_a_grid_wholly_inside_is_open():
    assert np.all(circle_coverage(Grid((8, 12), 1e-6), 1e-4) == 1)
