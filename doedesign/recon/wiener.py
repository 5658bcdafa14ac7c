"""PSF-aware blocks: Wiener filters that undo the blur of a camera in images, or in features of any scale.

A camera's PSF has one transfer function per colour. Features are not colours, but each can undo the blur of one:
feature k follows colour k mod c, and the transfer function is broadcast over the rest, never copied. At scale
s an image's pixels are s apart, and its PSF is the camera's, summed over the s x s samples that are nearest to each of
them (a sample half way belongs to both with one half) and brought back to unit sum: means instead of sums, as in the
public release, would lend deep scales a gain of s².

The filter is periodic and pictures are not. Each edge is blended with the opposite one over the range that the PSF's
autocorrelation says (an edge taper): the far end of a row then continues its beginning.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float


class Blur(NamedTuple):
    """A PSF as images of one scale show it: its transform, and tapers.

    A taper is the share of a row (of a column) that is its own and not the opposite one's, one half at both ends.
    """

    transfer: Complex[Array, "b c y fx"]
    taper_y: Float[Array, "b c y"]
    taper_x: Float[Array, "b c x"]


def sharing(window: int, length: int, scale: int) -> Float[np.ndarray, "length window"]:
    """Share of a PSF's samples that each pixel of a scale takes, its middle moved to pixel 0 and round the end.

    Along an axis with `window` samples and `length` pixels of `scale` samples, a power of two; samples beyond half of
    the pixels are left out. ValueError for an even window, which has no middle sample.
    """
    if window % 2 == 0:
        raise ValueError(f"`window` must be odd, so that the PSF has a middle, but got {window}")
    offset = np.arange(window) - window // 2
    pixel = np.arange(-(length // 2), (length + 1) // 2)
    distance = np.abs(offset[None, :] - scale * pixel[:, None])
    share = np.where(distance < scale / 2, 1.0, np.where(distance == scale / 2, 0.5, 0.0))
    return np.roll(share, -(length // 2), axis=0).astype(np.float32)


def blur_at(psf: Float[Array, "b c ky kx"], shape: tuple[int, int], scale: int = 1, *, unit: bool = True) -> Blur:
    """The blur of PSFs with odd windows as images of a scale with `shape` (y, x) pixels show it.

    A pixel has `scale` samples of the PSF, a power of two. Without `unit` sum, light that the PSF loses stays lost.
    """
    by_y, by_x = (sharing(psf.shape[k - 2], shape[k], scale) for k in (0, 1))
    kernel = jnp.einsum("bcyx,vy,ux->bcvu", psf, by_y, by_x, precision="highest")
    if unit:
        kernel = kernel / jnp.sum(kernel, axis=(-2, -1), keepdims=True)
    still = jax.lax.stop_gradient(kernel)
    return Blur(jnp.fft.rfft2(kernel), _taper(still.sum(axis=-1)), _taper(still.sum(axis=-2)))


def _taper(profile: Float[Array, "b c n"]) -> Float[Array, "b c n"]:
    """1 - rho / 2 for the autocorrelation rho of a PSF summed along the other axis, 1 at no shift."""
    length = profile.shape[-1]
    rho = jnp.fft.irfft(jnp.abs(jnp.fft.rfft(profile)) ** 2, length)
    rho = rho / jnp.maximum(rho[..., :1], 1e-12)
    # Pixel k is k + 1/2 from the first edge: the mean of both shifts around it.
    return 1 - (rho + jnp.roll(rho, -1, axis=-1)) / 4


def tapered(image: Float[Array, "b g c y x"], blur: Blur) -> Float[Array, "b g c y x"]:
    """Blend every edge with the opposite one, so that the image continues periodically."""
    own = blur.taper_y[:, None, :, :, None]
    image = own * image + (1 - own) * image[..., ::-1, :]
    own = blur.taper_x[:, None, :, None, :]
    return own * image + (1 - own) * image[..., ::-1]


def deblurred(
    image: Float[Array, "b y x k"], blur: Blur, log_regulariser: Float[Array, " k"], *, taper: bool = True
) -> Float[Array, "b y x k"]:
    """Wiener filter conj(H) / (|H|² + e^r) of every channel, k of colour k mod c (paper §3.3, f_ZW).

    r is the logarithm of the power of noise over that of the image, one for every channel. `taper` blends the edges
    first.
    """
    b, y, x, channels = image.shape
    colours = blur.transfer.shape[1]
    planes = image.transpose(0, 3, 1, 2).reshape(b, channels // colours, colours, y, x)
    if taper:
        planes = tapered(planes, blur)
    power = jnp.exp(log_regulariser).reshape(1, channels // colours, colours, 1, 1)
    transfer = blur.transfer[:, None]
    wiener = jnp.conj(transfer) / (transfer.real**2 + transfer.imag**2 + power)
    sharp = jnp.fft.irfft2(jnp.fft.rfft2(planes) * wiener, (y, x))
    return sharp.reshape(b, channels, y, x).transpose(0, 2, 3, 1)


def sharpened(
    image: Float[Array, "b y x c"], psf: Float[Array, "b c ky kx"], log_regulariser: Float[Array, " c"]
) -> Float[Array, "b y x c"]:
    """Wiener filter of a whole picture, which goes on beyond its edges as its mirror image.

    A tapered edge is lost as far as the PSF reaches, and a plate that spreads light reaches half across a training
    picture. Light goes on beyond a frame, and its mirror image is the best guess at how; training scenes go on so, too
    (`sim.imaging.convolve`, border "reflect", which has the outermost samples once; here they stand twice, for
    transforms of even lengths). Four times the samples: for pictures, not for features. Light that the PSFs, with odd
    windows, lose is made up for; regularisers are those of `deblurred`.
    """
    y, x = image.shape[1:3]
    image = jnp.concatenate([image, image[:, ::-1]], axis=1)
    image = jnp.concatenate([image, image[:, :, ::-1]], axis=2)
    return deblurred(image, blur_at(psf, (2 * y, 2 * x), unit=False), log_regulariser, taper=False)[:, :y, :x]
