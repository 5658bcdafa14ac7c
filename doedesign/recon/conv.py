"""Convolution layers for images on a processor: channels last, in the forms that XLA's library is fast at.

Two of its habits cost up to ten times, with the same arithmetic. A convolution that returns only whole overlaps
("valid") of more than some 16 channels goes a slow way; one that returns all pixels, of which the margin is cut off
again, does not. And the gradient by the weights is one convolution whose kernel is the whole image: for large images
the matrix that the library gathers for it leaves the cache, unless it is taken in bands of rows. Other devices are
given the plain form.

The gradient of a mirrored margin is written out, too, which saves a tenth of a network's step.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_DIMENSIONS = ("NHWC", "HWIO", "NHWC")
# Rows of a band, and images too small to gain from it.
_BAND, _LEAST_ROWS = 16, 128


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def mirrored(image: Float[Array, "b y x c"], margin: int) -> Float[Array, "b v u c"]:
    """Extend an image by `margin` pixels on every side, mirrored at the middle of its outermost pixels."""
    if margin == 0:
        return image
    return jnp.pad(image, ((0, 0), (margin, margin), (margin, margin), (0, 0)), mode="reflect")


def _mirrored_forward(image: Array, margin: int) -> tuple[Array, None]:
    return mirrored(image, margin), None


def _mirrored_backward(margin: int, _: None, slope: Array) -> tuple[Array]:
    """Fold the margins back: what jax derives adds whole images up, of which all but the margins is zero."""
    return (slope if margin == 0 else _folded(_folded(slope, margin, 2), margin, 1),)


def _folded(slope: Array, margin: int, axis: int) -> Array:
    length = slope.shape[axis] - 2 * margin

    def part(start: int, count: int) -> Array:
        return jax.lax.slice_in_dim(slope, start, start + count, axis=axis)

    def at(start: int) -> tuple[slice, ...]:
        return (*(slice(None) for _ in range(axis)), slice(start, start + margin))

    inner = part(margin, length).at[at(1)].add(jnp.flip(part(0, margin), axis))
    return inner.at[at(length - 1 - margin)].add(jnp.flip(part(margin + length, margin), axis))


mirrored.defvjp(_mirrored_forward, _mirrored_backward)


def convolution(
    image: Float[Array, "b y x i"], weights: Float[Array, "ky kx i o"], stride: int = 1, *, half: bool = False
) -> Float[Array, "b v u o"]:
    """Correlate an image, mirrored beyond its edges, with kernels of odd size; float32.

    Output k lies on input k * `stride`. With `half`, products are in bfloat16 and sums in float32.
    """
    return _valid(mirrored(image, weights.shape[0] // 2), weights, stride, half)


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _valid(padded: Array, weights: Array, stride: int, half: bool) -> Array:
    return _plain(padded, weights, stride, half)


def _plain(padded: Array, weights: Array, stride: int, half: bool) -> Array:
    if half:
        padded, weights = padded.astype(jnp.bfloat16), weights.astype(jnp.bfloat16)
    extra = weights.shape[0] // 2 if stride == 1 and jax.default_backend() == "cpu" else 0
    found = jax.lax.conv_general_dilated(
        padded,
        weights,
        (stride, stride),
        ((extra, extra), (extra, extra)),
        dimension_numbers=_DIMENSIONS,
        preferred_element_type=jnp.float32,
    )
    return found[:, extra : found.shape[1] - extra, extra : found.shape[2] - extra]


def _forward(padded: Array, weights: Array, stride: int, half: bool) -> tuple[Array, tuple[Array, Array]]:
    return _plain(padded, weights, stride, half), (padded, weights)


def _backward(stride: int, half: bool, kept: tuple[Array, Array], slope: Array) -> tuple[Array, Array]:
    padded, weights = kept
    # In bfloat16 the transposes would add up in it, too; the gradient is taken in float32.
    (by_image,) = jax.linear_transpose(lambda p: _plain(p, weights, stride, False), padded)(slope)
    rows = slope.shape[1]
    if stride == 1 and jax.default_backend() == "cpu" and rows >= _LEAST_ROWS and rows % _BAND == 0:
        return by_image, _by_weights_in_bands(padded, slope, weights.shape[0])
    (by_weights,) = jax.linear_transpose(lambda w: _valid_overlaps(padded, w, stride), weights)(slope)
    return by_image, by_weights


def _valid_overlaps(padded: Array, weights: Array, stride: int) -> Array:
    """The convolution in the form whose gradient by the weights is fast."""
    return jax.lax.conv_general_dilated(padded, weights, (stride, stride), "VALID", dimension_numbers=_DIMENSIONS)


def _by_weights_in_bands(padded: Array, slope: Array, size: int) -> Array:
    """Gradient by the weights: the image correlated with the slope, channels as pictures, band by band."""

    def band(first: Array) -> Array:
        rows = jax.lax.dynamic_slice_in_dim(padded, first, _BAND + size - 1, 1)
        kernel = jax.lax.dynamic_slice_in_dim(slope, first, _BAND, 1)
        return _valid_overlaps(rows.transpose(3, 1, 2, 0), kernel.transpose(1, 2, 0, 3), 1)

    def add(total: Array, first: Array) -> tuple[Array, None]:
        return total + band(first), None

    shape: Any = jax.eval_shape(band, jnp.int32(0))
    total, _ = jax.lax.scan(add, jnp.zeros(shape.shape, shape.dtype), jnp.arange(0, slope.shape[1], _BAND))
    return total.transpose(1, 2, 0, 3)


_valid.defvjp(_forward, _backward)


def doubled(image: Float[Array, "b y x i"], weights: Float[Array, "i 2 2 o"]) -> Float[Array, "b v u o"]:
    """Transposed convolution of size 2 and stride 2: every pixel becomes two by two, `[b, 2 y, 2 x, output]`."""
    b, y, x, _ = image.shape
    spread = jnp.einsum("byxi,ivuo->byvxuo", image, weights)
    return spread.reshape(b, 2 * y, 2 * x, weights.shape[-1])
