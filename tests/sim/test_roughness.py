"""Rough cells against the covariance of means over squares, by quadrature, and against a finely sampled surface."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import dblquad, quad

from fab.grid import Grid
from sim.surface.roughness import cell_roughness, cell_share

PITCH_M = 1e-6
RMS_M = 4e-9


def line_covariance(length: float, lag: float) -> float:
    """Covariance of means over two unit intervals `lag` apart, along one axis, of a field with exp(-x^2 / length^2).

    The difference of two points, one in each interval, has a triangular density about the lag.
    """
    return quad(lambda d: (1 - abs(d)) * np.exp(-(((lag + d) / length) ** 2)), -1, 1, points=[0.0, -lag])[0]


@pytest.mark.parametrize("length", [0.05, 0.3, 1.0, 4.0])
def test_the_share_that_cells_keep_is_an_average_over_two_points(length: float):
    # exp(-r^2 / L^2) is a product, and so is the average over a square.
    assert float(cell_share(jnp.float32(length))) == pytest.approx(line_covariance(length, 0.0) ** 2, rel=2e-5)


def test_the_share_is_a_plain_average_over_the_square():
    """The same once without the product: four-fold mean by quadrature over the difference of two points."""
    length = 0.7
    exact = dblquad(
        lambda y, x: (1 - abs(y)) * (1 - abs(x)) * np.exp(-(y * y + x * x) / length**2), -1, 1, -1, 1, epsrel=1e-6
    )[0]
    assert float(cell_share(jnp.float32(length))) == pytest.approx(exact, rel=1e-5)


def test_very_short_and_very_long_hills():
    assert float(cell_share(jnp.float32(0.0))) == pytest.approx(0.0, abs=1e-6)
    assert float(cell_share(jnp.float32(1e-3))) == pytest.approx(np.pi * 1e-6, rel=1e-2)  # area of the hills
    # 1 - 1 / (3 L^2) to first order; differences of squares of a hundred leave 1e-3 in float32.
    assert float(cell_share(jnp.float32(10.0))) == pytest.approx(1 - 1 / 300, abs=1e-3)


@pytest.mark.parametrize(("length", "shape"), [(0.5, (301, 256)), (2.0, (300, 257))])
def test_cells_vary_and_hang_together_as_they_should(length: float, shape: tuple[int, int]):
    field = np.asarray(cell_roughness(Grid(shape, PITCH_M), RMS_M, length * PITCH_M, 11)) / RMS_M
    assert field.shape == shape
    # As many independent hills as areas pi L^2 / 2 fit into the plate, at least one per cell.
    hills = field.size / max(np.pi * length**2 / 2, 1.0)
    for lag_y, lag_x in ((0, 0), (0, 1), (1, 0), (1, 1), (0, 3), (5, 0)):
        moved = np.roll(field, (lag_y, lag_x), axis=(0, 1))  # the field repeats at the edges
        wanted = line_covariance(length, lag_y) * line_covariance(length, lag_x)
        variance = line_covariance(length, 0.0) ** 2
        # Four standard deviations of a sample covariance.
        assert np.mean(field * moved) == pytest.approx(wanted, abs=4 * variance * np.sqrt(2 / hills))
    assert abs(field.mean()) < 4 * np.sqrt(np.pi * length**2 / field.size + 1 / field.size)


@pytest.mark.parametrize("shape", [(16, 17), (24, 9), (2, 31)])
def test_the_filter_of_white_noise_has_the_covariance_at_every_lag(shape: tuple[int, int]):
    """The field over the noise that it is made of, frequency by frequency: no sample of anything."""
    length = 0.6
    white = np.random.default_rng(4).standard_normal(shape, np.float32)
    field = np.asarray(cell_roughness(Grid(shape, PITCH_M), RMS_M, length * PITCH_M, 4), np.float64) / RMS_M
    found = np.fft.ifft2(np.abs(np.fft.fft2(field) / np.fft.fft2(white.astype(np.float64))) ** 2).real
    along_y, along_x = (
        [line_covariance(length, min(lag, count - lag)) for lag in range(count)] for count in shape
    )  # it repeats at the edges
    # Single precision, more of it where the noise happens to have little of a wave.
    np.testing.assert_allclose(found, np.outer(along_y, along_x), atol=1e-4)


def test_one_seed_gives_the_same_hills_whatever_their_height():
    grid = Grid((64, 48), PITCH_M)
    low, high, other = (
        np.asarray(cell_roughness(grid, rms, 1.5e-6, seed)) for rms, seed in ((1e-9, 3), (5e-9, 3), (1e-9, 4))
    )
    np.testing.assert_allclose(5 * low, high, rtol=1e-6)
    assert abs(np.corrcoef(low.ravel(), other.ravel())[0, 1]) < 0.2
    # Slightly longer hills are nearly the same hills, so that a derivative by their length means something.
    longer = np.asarray(cell_roughness(grid, 1e-9, 1.51e-6, 3))
    assert np.corrcoef(low.ravel(), longer.ravel())[0, 1] > 0.999


@pytest.mark.parametrize(("length", "size"), [(0.25, 10), (0.5, 10), (0.5, 11), (1.0, 10)])
def test_hills_as_long_as_the_plate_have_their_variance(length: float, size: int):
    """On a plate that is narrow along one axis; 6 % too much at half its width if nothing makes up for the cut."""
    hills = length * size
    field = np.asarray(cell_roughness(Grid((200_000, size), PITCH_M), 1.0, hills * PITCH_M, 7), np.float64)
    # Four standard deviations for as many independent squares as lengths sqrt(pi / 2) L fit along the other axis.
    spread = 4 * np.sqrt(2 * np.sqrt(np.pi / 2) * hills / len(field))
    assert np.mean(field**2) == pytest.approx(line_covariance(hills, 0.0) ** 2, rel=spread)


def test_derivatives_by_height_and_length():
    grid = Grid((32, 32), PITCH_M)
    weights = jnp.asarray(np.random.default_rng(5).normal(size=grid.shape).astype(np.float32))

    @jax.jit
    @jax.value_and_grad
    def change(errors: jax.Array) -> jax.Array:
        return jnp.sum(weights * cell_roughness(grid, errors[0], errors[1], 0)) * 1e9

    at = np.array([4e-9, 1.5e-6])
    slope = np.asarray(change(jnp.asarray(at, jnp.float32))[1])
    for i, step in ((0, 1e-9), (1, 3e-8)):
        by = step * np.eye(2)[i]
        high, low = (float(change(jnp.asarray(at + s * by, jnp.float32))[0]) for s in (1, -1))
        # A step of 2 % leaves a few parts in ten thousand, rounding of the sum a little more.
        assert (high - low) / (2 * step) == pytest.approx(slope[i], rel=5e-3)
