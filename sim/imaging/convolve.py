"""Linear convolution with a PSF by real FFTs, without wrap-around.

A sample of the result is out[i] = sum over k of kernel[k] · image[i - (k - c)] with c = (n - 1) // 2 for a window of n
samples. **An odd window** has the chief ray on the centre of its middle pixel, c, and the result is registered with the
image. **An even window** has it on the corner between the four middle pixels, of which c is the lower one, so the
result lies half a pixel toward +y and +x of the image. Where pixels must match, use odd windows.

Beyond the image the border `reflect` mirrors it about its outermost samples and `edge` repeats them; with `own` the
image is taken to bring its margin along and the result is smaller, by n - 1.

The transform is as long as the image with its margins, not as the full convolution: what wraps around falls on samples
that are cut off. It is done axis by axis, along x only for the rows that there are, and back only for the rows that are
kept, which saves a fifth of the two-dimensional transforms. Spectra are `[fx, fy]`, half the frequencies along x.
"""

from collections.abc import Iterator, Sequence
from functools import reduce
from typing import Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.fft
from jaxtyping import Array, Complex, Float, Int

Images = Float[Array, "*b y x"] | Float[np.ndarray, "*b y x"]
Border = Literal["reflect", "edge", "own"]
Window = tuple[int, int]


def margins(window: int) -> tuple[int, int]:
    """Samples that a result needs of the image before its first and after its last one, along one axis."""
    middle = (window - 1) // 2
    return window - 1 - middle, middle


def fast_length(samples: int) -> int:
    """The next length that is a product of 2, 3 and 5."""
    return int(scipy.fft.next_fast_len(samples, real=True))  # pyright: ignore[reportArgumentType]


def result_shape(shape: Window, window: Window, border: Border) -> Window:
    """Shape of a convolution's result; a ValueError for an unknown border, or an image smaller than its own margin."""
    if border not in get_args(Border):
        raise ValueError(f"`border` must be one of {', '.join(get_args(Border))}, but got {border!r}")
    if border != "own":
        return shape
    y, x = (samples - n + 1 for samples, n in zip(shape, window, strict=True))
    if y < 1 or x < 1:
        raise ValueError(f"an image with its own margin must be at least as large as the window {window}, got {shape}")
    return y, x


class Otf(eqx.Module):
    """Transforms `[..., fx, fy]` of kernels, ready for images of one shape."""

    transfer: Complex[Array, "*k fx fy"]
    window: Window = eqx.field(static=True)  # samples (y, x) of a kernel
    shape: Window = eqx.field(static=True)  # samples (y, x) of an image
    border: Border = eqx.field(static=True)  # what lies beyond it

    @property
    def length(self) -> Window:
        """Samples (y, x) of the transform."""
        return _length(self.shape, self.window, self.border)

    @property
    def energy(self) -> Float[Array, "*k 1 1"]:
        """Sum of every kernel."""
        return self.transfer[..., :1, :1].real


def _length(shape: Window, window: Window, border: Border) -> Window:
    y, x = result_shape(shape, window, border)
    return fast_length(y + window[0] - 1), fast_length(x + window[1] - 1)


def plan_otf(kernel: Float[Array, "*k y x"] | Float[np.ndarray, "*k y x"], shape: Window, border: Border) -> Otf:
    """Transform kernels for images of `shape`."""
    window = (kernel.shape[-2], kernel.shape[-1])
    return Otf(_transformed(jnp.asarray(kernel, jnp.float32), _length(shape, window, border)), window, shape, border)


def convolve(image: Images, otf: Otf) -> Float[Array, "*c v u"]:
    """Convolve images `[..., y, x]` of the planned shape with kernels; leading axes are broadcast."""
    return landed(spectrum(image, otf) * otf.transfer, otf)


def superpose(images: Sequence[Images], otf: Otf) -> Float[Array, "*c v u"]:
    """Convolve each image with its own entry of the kernels' first axis, and add: one transform back for all.

    The images are transformed one by one, so that two cores can work on two of them.
    """
    products = (spectrum(image, otf) * otf.transfer[k] for k, image in enumerate(images))
    return landed(reduce(jnp.add, products), otf)


def spectrum(image: Images, otf: Otf) -> Complex[Array, "*b fx fy"]:
    """Transform of images of the planned shape with their borders, to be multiplied with `Otf.transfer`."""
    if image.shape[-2:] != otf.shape:
        raise ValueError(f"`image` must have the shape {otf.shape} of the plan, but got {image.shape[-2:]}")
    if otf.border == "own":
        return _transformed(jnp.asarray(image), otf.length)
    # Filled to the transform's length, for what lies beyond the margin is not used.
    before = [margins(n)[0] for n in otf.window]
    y, x = ((b, long - b - n) for b, long, n in zip(before, otf.length, otf.shape, strict=True))
    kept = [(0, 0)] * (image.ndim - 1)
    rows = jnp.fft.rfft(jnp.pad(jnp.asarray(image), [*kept, x], mode=otf.border))
    return jnp.fft.fft(jnp.pad(jnp.swapaxes(rows, -1, -2), [*kept, y], mode=otf.border))


def landed(product: Complex[Array, "*c fx fy"], otf: Otf) -> Float[Array, "*c v u"]:
    """Back from a product of spectra, without the samples that wrapped around."""
    y, x = result_shape(otf.shape, otf.window, otf.border)
    first, second = (n - 1 for n in otf.window)
    rows = jnp.swapaxes(jnp.fft.ifft(product)[..., first : first + y], -1, -2)
    return jnp.fft.irfft(rows, otf.length[1])[..., second : second + x]


def _transformed(image: Array, length: Window) -> Array:
    """Transform `[..., fx, fy]` of images with zeros after them."""
    return jnp.fft.fft(jnp.swapaxes(jnp.fft.rfft(image, length[1]), -1, -2), length[0])


class Tile(NamedTuple):
    """A piece of a large result, and the samples of the image it needs."""

    out: tuple[slice, slice]  # rows and columns of the result
    rows: Int[np.ndarray, " r"]  # index of every image row it needs, the border applied
    columns: Int[np.ndarray, " s"]  # likewise
    corner: tuple[int, int]  # (y, x) of the first needed sample in the image's coordinates; negative beyond the border


def tile_length(shape: Window, window: Window, border: Border, limit: int = 1536) -> Window:
    """Samples (y, x) of a tile with its margins: near `limit` or three windows, no longer than the image needs."""
    whole = _length(shape, window, border)
    y, x = (min(length, fast_length(max(limit, 3 * n))) for length, n in zip(whole, window, strict=True))
    return y, x


def tiles(shape: Window, window: Window, border: Border, length: Window) -> Iterator[Tile]:
    """Cut a result into overlap-save tiles of one size, the last of an axis moved back to end with the result."""
    results = result_shape(shape, window, border)
    starts = []
    for samples, n, long in zip(results, window, length, strict=True):
        step = min(long - n + 1, samples)
        starts.append([(min(i, samples - step), step) for i in range(0, samples, step)])
    for y, height in starts[0]:
        for x, width in starts[1]:
            needs = [_needed(*given, border) for given in zip((y, x), (height, width), window, shape, strict=True)]
            (top, rows), (left, columns) = needs
            yield Tile((slice(y, y + height), slice(x, x + width)), rows, columns, (top, left))


def _needed(start: int, count: int, window: int, samples: int, border: Border) -> tuple[int, np.ndarray]:
    """First sample and index of every sample that results `start` to `start + count` need along one axis."""
    before = (0, 0) if border == "own" else margins(window)
    index = np.arange(samples) if border == "own" else np.pad(np.arange(samples), before, mode=border)
    return start - before[0], index[start : start + count + window - 1]


_tile_convolved = jax.jit(convolve)


def convolve_tiled(
    image: Float[np.ndarray, "y x"], kernel: Float[np.ndarray, "*k ky kx"], border: Border, length: Window | None = None
) -> Float[np.ndarray, "*k v u"]:
    """`convolve` of a frame too large for one transform, by overlap-save with tiles of `length` samples (y, x)."""
    shape, window = (image.shape[0], image.shape[1]), (kernel.shape[-2], kernel.shape[-1])
    out = np.empty((*kernel.shape[:-2], *result_shape(shape, window, border)), np.float32)
    otf: Otf | None = None
    for tile in tiles(shape, window, border, length or tile_length(shape, window, border)):
        patch = image[np.ix_(tile.rows, tile.columns)]
        otf = otf or plan_otf(np.asarray(kernel), patch.shape, "own")
        out[(..., *tile.out)] = _tile_convolved(jnp.asarray(patch), otf)
    return out
