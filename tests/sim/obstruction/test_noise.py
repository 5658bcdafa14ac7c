import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sim.obstruction.noise import gradients, layered_noise, perlin


def one_value(lattice: np.ndarray, y: float, x: float) -> float:
    """Perlin's definition, one point at a time."""
    j, i = int(y), int(x)
    total = 0.0
    for b in (0, 1):
        for a in (0, 1):
            ramp = lattice[0, j + b, i + a] * (y - j - b) + lattice[1, j + b, i + a] * (x - i - a)
            t, s = abs(y - j - b), abs(x - i - a)
            total += (1 - t**3 * (t * (6 * t - 15) + 10)) * (1 - s**3 * (s * (6 * s - 15) + 10)) * ramp
    return total


def test_it_is_perlins_noise(rng: np.random.Generator):
    lattice = gradients(rng, (5, 7))
    np.testing.assert_allclose(np.hypot(*lattice), 1)
    y, x = rng.uniform(0, 4, 9), rng.uniform(0, 6, 11)
    expected = [[one_value(lattice, b, a) for a in x] for b in y]
    np.testing.assert_allclose(perlin(lattice, y, x), expected, atol=1e-12)


def test_corners_are_zero_and_slopes_there_are_the_gradients(rng: np.random.Generator):
    lattice = gradients(rng, (4, 5))
    corners = perlin(lattice, np.arange(3.0), np.arange(4.0))
    np.testing.assert_allclose(corners, 0, atol=1e-15)
    up = perlin(lattice, np.arange(3.0) + 1e-6, np.arange(4.0))
    np.testing.assert_allclose(up / 1e-6, lattice[0, :3, :4], atol=1e-5)


def test_the_low_pass_is_a_gaussian(rng: np.random.Generator):
    state = rng.bit_generator.state
    plain = layered_noise(rng, (160, 150), 24.0, octaves=2)
    rng.bit_generator.state = state
    # The lattice of a filtered field begins a margin further out, which moves the picture by the margin.
    smooth = layered_noise(rng, (160 - 24, 150 - 24), 24.0, octaves=2, blur=3.0)
    expected = gaussian_filter(plain.astype(np.float64), 3.0)[12:-12, 12:-12]
    np.testing.assert_allclose(smooth, expected, atol=1e-6)


def test_cells_have_the_width_asked_for():
    def width(cell: float) -> float:
        """Lag at which the correlation of rows falls to one half, mean of several fields."""
        total = np.zeros(64)
        for seed in range(12):
            field = layered_noise(np.random.default_rng(seed), (128, 256), cell)
            field = field - field.mean()
            total += [float((field[:, : 256 - lag] * field[:, lag:]).mean()) for lag in range(64)]
        return float(np.interp(-0.5, -total / total[0], np.arange(64)))

    # Twelve fields of some forty cells leave a few per cent of scatter.
    assert width(40.0) / width(20.0) == pytest.approx(2.0, rel=0.12)


def test_scales_below_two_pixels_are_left_out(rng: np.random.Generator):
    state = rng.bit_generator.state
    two = layered_noise(rng, (32, 32), 5.0, octaves=2)
    rng.bit_generator.state = state
    np.testing.assert_array_equal(layered_noise(rng, (32, 32), 5.0, octaves=9), two)
    found = []
    for cell in (0.01, 2.0):  # finer ones would need more vectors than there are pixels, without end
        rng.bit_generator.state = state
        found.append(layered_noise(rng, (32, 32), cell))
    np.testing.assert_array_equal(*found)
