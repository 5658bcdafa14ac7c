import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fab.grid import Grid
from sim.aperture import circle_coverage, displaced_circle_coverage


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
    assert area == pytest.approx(np.pi * grid.extent_m[0] ** 2 / 4, rel=1e-7)


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


def test_a_circle_that_is_not_in_the_middle():
    grid = Grid((40, 50), 2e-6)
    centre = (6e-6, -11e-6)
    whole = circle_coverage(grid, 30e-6)
    # By whole cells it is the same circle elsewhere.
    np.testing.assert_allclose(
        circle_coverage(grid, 30e-6, (6e-6, -10e-6)), np.roll(whole, (3, -5), axis=(0, 1)), atol=1e-6
    )
    y, x = (np.arange(n * 50) / 50 - (n - 1 / 50) / 2 for n in grid.shape)
    inside = np.hypot(y[:, None] * 2e-6 - centre[0], x[None, :] * 2e-6 - centre[1]) <= 15e-6
    counted = inside.reshape(40, 50, 50, 50).mean(axis=(1, 3))
    # 50 x 50 points leave about two parts in a hundred of an edge cell's width uncertain.
    np.testing.assert_allclose(circle_coverage(grid, 30e-6, centre), counted, atol=0.012)


# --- the same as a function of diameter and centre --------------------------------------------------------------------


@pytest.mark.parametrize("centre_cells", [(0.0, 0.0), (0.3, -0.7), (-2.5, 1.2)])
@pytest.mark.parametrize(("cells", "share"), [(200, 0.9), (201, 0.6)])
def test_displaced_coverage_is_that_of_the_circle(cells: int, share: float, centre_cells: tuple[float, float]):
    grid = Grid((cells, cells), 2e-6)
    diameter, centre = share * cells * 2e-6, (centre_cells[0] * 2e-6, centre_cells[1] * 2e-6)
    straight = np.asarray(displaced_circle_coverage(grid, diameter, centre))
    exact = circle_coverage(grid, diameter, centre)
    # Within a cell the circle is straight: its bow is 1 / (8 radius) of a cell. The 64 strips of the other side count
    # an edge along them to half a strip.
    np.testing.assert_allclose(straight, exact, atol=1 / (4 * share * cells) + 1 / 128)
    # In the total 1 / (12 diameter) of the edge cells' area, float32 aside.
    area = float(exact.sum(dtype=np.float64))
    edge = np.count_nonzero((exact > 0) & (exact < 1))
    assert float(straight.sum(dtype=np.float64)) == pytest.approx(area, abs=edge / (12 * share * cells) + 1e-6 * area)


def test_displaced_coverage_is_empty_outside_and_full_inside():
    coverage = np.asarray(displaced_circle_coverage(Grid((60, 80), 1e-6), 40e-6, (3e-6, -5e-6)))
    y, x = np.arange(60) - 29.5 - 3, np.arange(80) - 39.5 + 5
    radius = np.hypot(y[:, None], x[None, :])
    assert np.all(coverage[radius < 20 - 1] == 1)
    assert np.all(coverage[radius > 20 + 1] == 0)
    assert coverage.min() >= 0
    assert coverage.max() <= 1


@pytest.mark.parametrize("direction", [(0.0, 1.0), (1.0, 0.0), (1.0, 1.0), (0.3, 1.0)])
def test_a_straight_edge_across_one_cell(direction: tuple[float, float]):
    """The open share of a cell on the rim of a huge circle, over all positions of the edge, by counting points."""
    steep = np.array(direction) / np.hypot(*direction)
    radius = 5000.0
    fine = (np.arange(400) + 0.5) / 400 - 0.5
    along = fine[:, None] * steep[0] + fine[None, :] * steep[1]
    for inward in np.linspace(-0.75, 0.75, 13):
        # The cell's middle lies `inward` cells inside the edge.
        y, x = -(radius - inward) * steep
        share = float(displaced_circle_coverage(Grid((1, 1), 1.0), 2 * radius, (float(y), float(x)))[0, 0])  # pyright: ignore[reportArgumentType]
        # Points on a grid along the edge are counted or not together, a row of 400 at a time; float32 of 5000.
        assert share == pytest.approx(np.mean(along < inward), abs=4e-3)


def test_displaced_coverage_has_derivatives():
    grid = Grid((50, 50), 1e-6)
    weights = jnp.asarray(np.random.default_rng(0).random(grid.shape), jnp.float32)

    @jax.jit
    @jax.value_and_grad
    def light(errors: jax.Array) -> jax.Array:
        return jnp.sum(
            weights * displaced_circle_coverage(grid, errors[0] * 1e-6, (errors[1] * 1e-6, errors[2] * 1e-6))
        )

    at = np.array([41.3, 0.37, -0.61])
    slope = np.asarray(light(jnp.asarray(at, jnp.float32))[1])
    for i, direction in enumerate(np.eye(3)):
        high, low = (float(light(jnp.asarray(at + s * direction, jnp.float32))[0]) for s in (0.02, -0.02))
        # A sum of a thousand in float32 is good to 1e-4, so the difference to 3e-3 per cell; over the step 150 random
        # weights come and go, a few hundredths more.
        assert slope[i] == pytest.approx((high - low) / 0.04, abs=0.05)
    # An opening wider by a cell gains its rim, pi d / 2 cells of a mean weight of one half.
    assert slope[0] == pytest.approx(np.pi * 41.3 / 4, rel=0.1)


@pytest.mark.slow
def test_the_middle_of_the_circle_has_no_kink():
    """A cell in the very middle is at distance zero, where a root has no slope; the circle does not care."""
    grid = Grid((5, 5), 1e-6)
    coverage, slope = jax.value_and_grad(lambda y: displaced_circle_coverage(grid, 4e-6, (y, 0.0)).sum())(0.0)
    assert float(coverage) == pytest.approx(4 * np.pi, rel=0.03)  # so small a circle bows by that much
    assert float(slope) == pytest.approx(0.0, abs=10.0)  # per metre; one side of the rim moves by millions of cells
