import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import convolve2d

import sim.imaging.convolve
from sim.imaging.convolve import Border, convolve_tiled, fast_length, margins, result_shape, tiles

convolve, superpose = eqx.filter_jit(sim.imaging.convolve.convolve), eqx.filter_jit(sim.imaging.convolve.superpose)
plan_otf = eqx.filter_jit(sim.imaging.convolve.plan_otf)

# Float32 transforms of a thousand samples round at some 1e-7 of the largest value; sums of a kernel are of order 1.
ROUNDING = 2e-6


def direct(image: np.ndarray, kernel: np.ndarray, border: Border) -> np.ndarray:
    """Padded by numpy and convolved in float64 without any transform."""
    if border != "own":
        image = np.pad(image, [margins(n) for n in kernel.shape], mode=border)
    return convolve2d(image.astype(np.float64), kernel.astype(np.float64), mode="valid")


@pytest.fixture
def image(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(0, 1, (37, 50)).astype(np.float32)


def kernel_of(rng: np.random.Generator, *shape: int) -> np.ndarray:
    kernel = rng.uniform(0, 1, shape)
    return (kernel / kernel.sum(axis=(-2, -1), keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("border", ["reflect", "edge", "own"])
@pytest.mark.parametrize("window", [(9, 9), (5, 12), (2, 1)])
def test_is_the_linear_convolution(rng, image, border: Border, window: tuple[int, int]):
    kernel = kernel_of(rng, *window)
    result = convolve(image, plan_otf(kernel, (37, 50), border))
    assert result.shape == result_shape((37, 50), window, border)
    np.testing.assert_allclose(result, direct(image, kernel, border), atol=ROUNDING)


def test_a_window_larger_than_the_image(rng):
    image = rng.uniform(0, 1, (7, 10)).astype(np.float32)
    kernel = kernel_of(rng, 31, 24)
    for border in ("reflect", "edge"):
        result = convolve(image, plan_otf(kernel, (7, 10), border))
        np.testing.assert_allclose(result, direct(image, kernel, border), atol=ROUNDING)


def test_nothing_wraps_around():
    """A bright line along one side leaves the other side dark."""
    image = np.zeros((32, 32), np.float32)
    image[0] = 1e3
    kernel = np.full((15, 15), 1 / 225, np.float32)
    result = np.asarray(convolve(image, plan_otf(kernel, (32, 32), "edge")))
    assert np.abs(result[8:]).max() < 1e-3  # rounding of a thousand
    assert result[7, 16] == pytest.approx(1e3 / 15, rel=1e-5)


@pytest.mark.parametrize(("window", "shift"), [(15, 0.0), (16, 0.5)])
def test_odd_windows_are_registered_and_even_ones_half_a_pixel_off(window: int, shift: float):
    """The kernel is symmetric about its window's centre, where the chief ray is."""
    axis = np.arange(window) - (window - 1) / 2
    kernel = np.exp(-(axis[:, None] ** 2 + axis**2) / 8).astype(np.float32)
    point = np.zeros((41, 41), np.float32)
    point[20, 18] = 1.0
    image = np.asarray(convolve(point, plan_otf(kernel, (41, 41), "edge")), np.float64)
    y, x = (np.average(np.arange(41), weights=image.sum(axis=a)) for a in (1, 0))
    assert (y, x) == pytest.approx((20 + shift, 18 + shift), abs=1e-4)


def test_an_asymmetric_kernel_points_the_right_way():
    """Light sent toward +y and -x lands there."""
    kernel = np.zeros((9, 9), np.float32)
    kernel[4 + 3, 4 - 2] = 1.0
    point = np.zeros((20, 20), np.float32)
    point[10, 10] = 1.0
    image = np.asarray(convolve(point, plan_otf(kernel, (20, 20), "edge")))
    assert np.unravel_index(image.argmax(), image.shape) == (13, 8)


def test_leading_axes_are_broadcast_and_layers_added(rng, image):
    kernels = kernel_of(rng, 2, 3, 7, 7)
    otf = plan_otf(kernels, (37, 50), "reflect")
    each = np.asarray(convolve(image[None, None], otf))
    assert each.shape == (2, 3, 37, 50)
    np.testing.assert_allclose(each[1, 2], direct(image, kernels[1, 2], "reflect"), atol=ROUNDING)
    total = superpose([image[None], 1 - image[None]], otf)
    np.testing.assert_allclose(total, each[0] + convolve(1 - image[None], otf_of(otf, 1)), atol=2 * ROUNDING)
    np.testing.assert_allclose(otf.energy, np.ones((2, 3, 1, 1)), atol=ROUNDING)


def otf_of(otf, layer: int):
    return type(otf)(otf.transfer[layer], otf.window, otf.shape, otf.border)


@pytest.mark.parametrize("border", ["reflect", "edge", "own"])
@pytest.mark.parametrize("window", [(8, 11)])
def test_tiles_fit_without_seams(rng, border: Border, window: tuple[int, int]):
    image = rng.uniform(0, 1, (100, 131)).astype(np.float32)
    kernels = kernel_of(rng, 2, *window)
    tiled = convolve_tiled(image, kernels, border, length=(30, 32))
    whole = np.asarray(convolve(image[None], plan_otf(kernels, (100, 131), border)))
    assert tiled.shape == whole.shape
    # The promise for frames; what is found is rounding.
    assert np.abs(tiled - whole).max() < 1e-5


def test_tiles_cover_the_result_once_at_least():
    for border in ("reflect", "edge", "own"):
        count = np.zeros(result_shape((50, 64), (7, 6), border), int)
        pieces = list(tiles((50, 64), (7, 6), border, (24, 20)))
        for piece in pieces:
            count[piece.out] += 1
        assert count.min() == 1
        assert len({(len(p.rows), len(p.columns)) for p in pieces}) == 1


def test_lengths_are_products_of_small_primes():
    assert [fast_length(n) for n in (1023, 1024, 1025, 1031)] == [1024, 1024, 1080, 1080]


def test_refusals(image):
    kernel = np.ones((5, 5), np.float32)
    with pytest.raises(ValueError, match="at least as large as the window"):
        plan_otf(kernel, (4, 9), "own")
    with pytest.raises(ValueError, match="must have the shape"):
        convolve(jnp.zeros((4, 4)), plan_otf(kernel, (37, 50), "edge"))
