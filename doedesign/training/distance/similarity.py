"""Structural similarity of pictures, at one scale and at several.

SSIM (Wang, Bovik, Sheikh and Simoncelli, "Image quality assessment: from error visibility to structural similarity",
IEEE TIP 2004) compares means, contrasts and structure within a small Gaussian window about every pixel. MS-SSIM (Wang,
Simoncelli and Bovik, "Multiscale structural similarity for image quality assessment", Asilomar 2003) does so again on
pictures of half the size, a quarter, and so on, so that blur over many pixels counts as well.

Windows have 11 x 11 pixels with a standard deviation of 1.5. Only those that lie wholly within the picture are taken,
so maps are smaller than pictures by 5 pixels on every side. Values are display values (sRGB) with white 1.
"""

from math import log2
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# [b, c, y, x]. Unlike shapes are refused in words, so that their axes have no common names here.
Images = Float[Array, "_ _ _ _"] | Float[np.ndarray, "_ _ _ _"]

WINDOW = 11
_SIGMA = 1.5
# (0.01 L)^2 and (0.03 L)^2 with white L = 1: eqs. 8 and 12 of the 2004 paper.
_C1, _C2 = 1e-4, 9e-4
# Table of the 2003 paper: exponents from fine to coarse.
_EXPONENTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
_FLOOR = 1e-3


Maps = Float[Array, "b c v u"]


def ssim_maps(a: Images, b: Images) -> tuple[Maps, Maps]:
    """SSIM about every pixel whose window lies within the picture, with and without the comparison of means.

    Eq. 13 of the 2004 paper, for display values `[b, c, y, x]`; maps are `[b, c, y - 10, x - 10]`.

    Raises:
        ValueError: unlike shapes, or pictures smaller than the window.
    """
    if a.shape != b.shape:
        raise ValueError(f"both pictures must have one shape, but got {a.shape} and {b.shape}")
    if min(a.shape[-2:]) < WINDOW:
        raise ValueError(f"SSIM needs pictures of at least {WINDOW} x {WINDOW} pixels, but got {a.shape[-2:]}")
    a, b = jnp.asarray(a), jnp.asarray(b)
    mean_a, mean_b = _windowed(a), _windowed(b)
    variances = _windowed(a * a) - mean_a**2 + _windowed(b * b) - mean_b**2
    covariance = _windowed(a * b) - mean_a * mean_b
    contrast = (2 * covariance + _C2) / (variances + _C2)
    return (2 * mean_a * mean_b + _C1) / (mean_a**2 + mean_b**2 + _C1) * contrast, contrast


def _windowed(image: Float[Array, "b c y x"]) -> Float[Array, "b c v u"]:
    # As matrix products: the gradient of shifted sums takes XLA eight times as long. In full precision everywhere: a
    # variance is a small difference of large numbers.
    high = jax.lax.Precision.HIGHEST
    along_y = jnp.matmul(_bands(image.shape[-2]), image, precision=high)
    return jnp.matmul(along_y, _bands(image.shape[-1]).T, precision=high)


def _bands(samples: int) -> Float[np.ndarray, "v y"]:
    """The window at every place where it fits, as the rows of a matrix."""
    weights = np.exp(-0.5 * (np.arange(WINDOW) - WINDOW // 2) ** 2 / _SIGMA**2)
    places = np.arange(samples)[None] - np.arange(samples - WINDOW + 1)[:, None]
    within = (places >= 0) & (places < WINDOW)
    return np.where(within, (weights / weights.sum())[places.clip(0, WINDOW - 1)], 0).astype(np.float32)


def ms_ssim(a: Images, b: Images) -> Float[Array, " b"]:
    """Multi-scale SSIM of display values `[b, c, y, x]`, averaged over colours; eq. 7 of the 2003 paper.

    1 for equal pictures, near 0 for unlike ones.

    Between scales two by two pixels are averaged; an odd last row or column is dropped. A picture whose shorter side
    has less than 176 pixels has room for fewer than five scales: the finest ones are taken, and their exponents brought
    back to unit sum. A scale whose mean is below 0.001, or negative (structure that is inverted), counts as 0.001 and
    has no slope: its power would be undefined, or infinitely steep.

    Raises:
        ValueError: unlike shapes, or pictures smaller than the window.
    """
    a, b = jnp.asarray(a), jnp.asarray(b)
    scales = max(1, min(len(_EXPONENTS), 1 + int(log2(min(a.shape[-2:]) / WINDOW))))
    exponents = np.array(_EXPONENTS[:scales], np.float32) / np.float32(sum(_EXPONENTS[:scales]))
    result = jnp.ones(a.shape[:2])
    for k, exponent in enumerate(exponents):
        if k:
            a, b = _halved(a), _halved(b)
        whole, contrast = ssim_maps(a, b)
        # Means are compared at the coarsest scale only.
        mean = jnp.mean(whole if k == scales - 1 else contrast, (-2, -1))
        result = result * jnp.maximum(mean, _FLOOR) ** exponent
    return jnp.mean(result, axis=1)


def _halved(image: Float[Array, "b c y x"]) -> Float[Array, "b c v u"]:
    b, c, y, x = image.shape
    even = image[..., : y // 2 * 2, : x // 2 * 2]
    return jnp.mean(even.reshape(b, c, y // 2, 2, x // 2, 2), (3, 5))


class MsSsim(eqx.Module):
    """1 - MS-SSIM as a distance, in place of LPIPS where its weights are not at hand.

    It sees structure from one pixel to some hundred, but knows nothing of things: texture that is like the true one
    without being it counts as an error, as in any comparison by pixels. A run's record has its name, and an empty
    digest, since it has no weights.
    """

    name: ClassVar[str] = "ms_ssim"
    digest: ClassVar[str] = ""

    def __call__(self, a: Images, b: Images) -> Float[Array, " b"]:
        """Distance of pictures, 0 to about 1."""
        return 1 - ms_ssim(a, b)
