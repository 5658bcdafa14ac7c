"""Convolutions of the network: the same numbers as XLA's own, also for the gradient that is taken in bands."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doedesign.recon.conv import convolution, doubled
from sim.threads import cores


def plain(image: jax.Array, weights: jax.Array, stride: int) -> jax.Array:
    """The same convolution without a gradient of its own."""
    margin = weights.shape[0] // 2
    padded = jnp.pad(image, ((0, 0), (margin, margin), (margin, margin), (0, 0)), mode="reflect")
    numbers = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(padded, weights, (stride, stride), "VALID", dimension_numbers=numbers)


@pytest.mark.parametrize(
    ("side", "size", "stride", "batch"), [(128, 3, 1, 1), (144, 7, 1, 2), (32, 3, 1, 2), (64, 3, 2, 1)]
)
def test_value_and_gradients_are_those_of_the_plain_convolution(side: int, size: int, stride: int, batch: int) -> None:
    keys = jax.random.split(jax.random.key(0), 3)
    image = jax.random.normal(keys[0], (batch, side, side, 4))
    weights = jax.random.normal(keys[1], (size, size, 4, 5))
    slope = jax.random.normal(keys[2], (batch, side // stride, side // stride, 5))
    own, back = jax.vjp(jax.jit(lambda i, w: convolution(i, w, stride)), image, weights)
    other, plain_back = jax.vjp(jax.jit(lambda i, w: plain(i, w, stride)), image, weights)
    if cores() > 1:
        np.testing.assert_array_equal(own, other)
    # On one processor core XLA sums the products of some pixels in another order: a last bit of the largest.
    np.testing.assert_allclose(own, other, rtol=0, atol=1e-6 * float(jnp.abs(other).max()))
    for mine, theirs in zip(back(slope), plain_back(slope), strict=True):
        # Sums over an image of 128 x 128 in another order: a few 1e-6 of the largest.
        np.testing.assert_allclose(mine, theirs, atol=2e-5 * float(jnp.abs(theirs).max()))


def test_stride_two_keeps_every_other_pixel() -> None:
    image = jax.random.normal(jax.random.key(0), (1, 16, 16, 2))
    weights = jax.random.normal(jax.random.key(1), (3, 3, 2, 3))
    np.testing.assert_allclose(convolution(image, weights, 2), convolution(image, weights)[:, ::2, ::2], atol=1e-5)


@pytest.mark.slow
def test_half_precision_misses_by_its_rounding() -> None:
    image = jax.random.normal(jax.random.key(0), (1, 16, 16, 8))
    weights = jax.random.normal(jax.random.key(1), (3, 3, 8, 8))
    whole, half = (convolution(image, weights, half=h) for h in (False, True))
    error = float(jnp.sqrt(jnp.mean((whole - half) ** 2) / jnp.mean(whole**2)))
    # Eight bits of mantissa: 2^-9 per factor, the errors of 72 products add up like noise.
    assert 1e-4 < error < 5e-3
    assert half.dtype == jnp.float32


def test_doubling_is_the_transpose_of_a_stride() -> None:
    image = jax.random.normal(jax.random.key(0), (1, 3, 4, 2))
    weights = jax.random.normal(jax.random.key(1), (2, 2, 2, 5))
    found = doubled(image, weights)
    assert found.shape == (1, 6, 8, 5)
    np.testing.assert_allclose(found[0, 5, 2], image[0, 2, 1] @ weights[:, 1, 0], atol=1e-6)
