"""Integration of an intensity known at equidistant samples over square sensor pixels.

Behind an aperture of diameter or longer side D the intensity on a sensor at the distance d holds no spatial frequency
along an axis above D / (lambda d). Its integral over a pixel is therefore a weighted sum of samples that need not be
finer than lambda d / (2D), and a short sum suffices if
the weights are chosen well. Point samples at the pixel pitch are not enough: behind an f/1.8 lens the speckle of a
rough DOE is finer than a pixel, and they miss the integral by 60-90 %.

The weights of one pixel minimise the expected squared error over fully developed speckle, whose power at spatial
frequency nu is the autocorrelation of the aperture (J. W. Goodman, *Speckle Phenomena in Optics*, §4.2), that of a disc
or else of a rectangle, plus a strong term at nu = 0 that makes energy come out right. The same expectation predicts the
error of the rule. The two axes separate; with fewer samples the rule stays the best linear estimate.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import dynamic_slice_in_dim as dynamic_slice
from jax.lax import dynamic_update_slice_in_dim as dynamic_update_slice
from jax.lax import fori_loop
from jaxtyping import Array, Float, Inexact

_FREQUENCIES = 513
# Weight of the mean intensity against all speckle together: large enough that a pixel's weights sum to
# its area to about 1e-5.
MEAN_WEIGHT = 1e3
# Out-of-band frequencies are free, so the normal equations are near-singular; this floor keeps the weights
# small there (rounding of float32 samples is then not amplified) and costs less than 1e-4 in accuracy.
_FLOOR = 3e-7
_SAMPLINGS = (2.05, 2.1, 2.2, 2.3, 2.5, 2.75, 3.0, 3.5, 4.0, 5.0, 6.0)


class PixelWeights(NamedTuple):
    """Weights `[sample, pixel]` along one axis, float64, and the predicted relative L2 error of the integrals."""

    matrix: Float[np.ndarray, "sample pixel"]
    expected_error: float


def disc_autocorrelation(frequency: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    """Normalised autocorrelation of a disc of diameter 1 (the MTF of an ideal lens), 0 beyond |frequency| = 1."""
    v = np.clip(np.abs(frequency), 0.0, 1.0)
    return 2 / np.pi * (np.arccos(v) - v * np.sqrt(1 - v * v))


def speckle_spectrum(cutoff: float, width: float, is_round: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (cycles per sample) and the power of speckle, already integrated along the other axis.

    That is the same for all frequencies behind a rectangle.
    """
    nu = np.linspace(-cutoff, cutoff, _FREQUENCIES)
    if not is_round:
        triangle = 1 - np.abs(nu) / cutoff
        return nu, triangle / triangle.sum()
    other = np.linspace(0.0, cutoff, _FREQUENCIES)
    power = disc_autocorrelation(np.hypot(nu[:, None], other[None, :]) / cutoff)
    spectrum = (power * np.sinc(width * other) ** 2).sum(axis=1)
    return nu, spectrum / spectrum.sum()


def pixel_weights(
    centres: Float[np.ndarray, " pixel"], width: float, cutoff: float, samples: int, is_round: bool = True
) -> PixelWeights:
    """Weights that integrate samples at 0 .. samples-1 over pixels; each pixel's sum is `width`.

    In units of the sample spacing: pixel centres, which must lie inside by two samples (else a ValueError), the side
    `width` of a sensitive square, and the highest spatial frequency `cutoff` of the intensity (1/2 is just enough).
    `is_round` tells light behind a disc from that behind any other aperture.
    """
    # Two samples beyond the pixel's edge on both sides: the gain of a third is below the plan's tolerance.
    taps = int(np.ceil(width)) + 5
    first = np.floor(centres - (taps - 1) / 2 + 0.5).astype(np.int64)
    if first.min() < 0 or first.max() + taps > samples:
        raise ValueError(f"pixels need samples {first.min()}..{first.max() + taps - 1}, but there are {samples}")
    nu, spectrum = speckle_spectrum(cutoff, width, is_round)
    lags = np.arange(taps)
    gram_row = (spectrum * np.cos(2 * np.pi * np.outer(lags, nu))).sum(axis=1) + MEAN_WEIGHT
    gram = gram_row[np.abs(lags[:, None] - lags[None, :])] + _FLOOR * np.eye(taps)
    offsets = first[:, None] + lags[None, :] - centres[:, None]
    target = width * np.sinc(width * nu)
    phases = np.cos(2 * np.pi * offsets[:, :, None] * nu)
    right = (phases * (spectrum * target)).sum(axis=2) + MEAN_WEIGHT * width
    weights = np.linalg.solve(gram, right.T).T
    response = np.einsum("pt,ptf->pf", weights, np.exp(2j * np.pi * offsets[:, :, None] * nu))
    error = np.sqrt((np.abs(response - target) ** 2 @ spectrum).mean() / (target**2 @ spectrum))
    matrix = np.zeros((samples, len(centres)))
    matrix[first[:, None] + lags, np.arange(len(centres))[:, None]] = weights
    return PixelWeights(matrix, float(error))


@lru_cache(maxsize=32)  # every depth asks for the same
def sampling_for(pixel: float, tolerance: float, is_round: bool = True) -> float:
    """Samples per lambda d / D with which pixels of side `pixel` (in lambda d / D) are integrated to `tolerance`.

    The error is predicted for pixels at eight positions between two samples, both axes together. Wide pixels need
    little more than the Nyquist rate of 2; pixels narrower than the Airy disc need more, because there the rule
    interpolates.
    """
    for sampling in _SAMPLINGS:
        width = pixel * sampling
        span = 2 * int(np.ceil(width) + 8)
        centres = span // 2 + np.arange(8) / 8
        if np.sqrt(2) * pixel_weights(centres, width, 1 / sampling, span, is_round).expected_error <= tolerance:
            return sampling
    return _SAMPLINGS[-1]


# A matrix of up to this many elements may be one batch of tiles, which compiles in half the time; a larger one takes
# its tiles one by one, which spares copies of its inputs and is a quarter faster.
_BATCH = 2**19


class Banded(eqx.Module):
    """A banded matrix applied along the last axis, in tiles of outputs with the window of inputs that they use.

    Complex weights are two real ones, side by side in a tile, so that both take the window from memory once.
    """

    blocks: Float[Array, "tile input parted"]  # weights: the last axis holds all outputs of every part
    starts: tuple[int, ...] = eqx.field(static=True)  # first input of every tile
    outputs: int = eqx.field(static=True)
    parts: int = eqx.field(static=True)  # 1 for real weights, 2 for complex ones
    order: Literal["in turn", "at once", "looped"] = eqx.field(static=True)  # how tiles are computed

    @staticmethod
    def from_dense(matrix: Inexact[np.ndarray, "i o"], tile: int = 64, batched: bool = False) -> "Banded":
        """Cut a real or complex matrix `[input, output]` into tiles of `tile` outputs and the inputs they use.

        With `batched`, the tiles of a small matrix are computed at once; products then differ in the last bits at most.
        """
        parts = [np.real(matrix), np.imag(matrix)] if np.iscomplexobj(matrix) else [matrix]
        inputs, outputs = matrix.shape
        columns = range(0, outputs, tile)
        used = [np.flatnonzero(np.any(matrix[:, at : at + tile] != 0, axis=1)) for at in columns]
        spans = [(int(rows[0]), int(rows[-1]) + 1) if rows.size else (0, 1) for rows in used]
        window = max(high - low for low, high in spans)
        starts = tuple(min(low, inputs - window) for low, _ in spans)
        blocks = np.zeros((len(starts), window, len(parts), min(tile, outputs)), np.float32)
        for block, low, at in zip(blocks, starts, columns, strict=True):
            for k, part in enumerate(parts):
                weights = part[low : low + window, at : at + tile]
                block[:, k, : weights.shape[1]] = weights
        order = "at once" if batched and matrix.size <= _BATCH else "in turn"
        with jax.ensure_compile_time_eval():  # plans are kept, also those made while something is traced
            return Banded(jnp.asarray(blocks.reshape(*blocks.shape[:2], -1)), starts, outputs, len(parts), order)

    @property
    def inputs(self) -> int:
        """Inputs that are used, counted from the first of all."""
        return max(self.starts) + self.blocks.shape[1]

    @property
    def looped(self) -> "Banded":
        """The same, tiles taken in a loop: to the same bits, compiled in a third of the time, a third slower."""
        return self if self.order == "at once" else replace(self, order="looped")

    def __call__(self, x: Float[Array, "... i"]) -> Float[Array, "... o"]:
        """Product of `x` with real weights along its last axis."""
        return self._products(x)[0]

    def of_complex(self, x: Float[Array, "2 ... i"]) -> Float[Array, "2 ... o"]:
        """Product of a complex array, as real and imaginary part, with the weights along its last axis."""
        product, *turned = self._products(x)
        for other in turned:
            product = product + jnp.stack([-other[1], other[0]])
        return product

    def _products(self, x: Float[Array, "... i"]) -> list[Float[Array, "... o"]]:
        """Product with every part of the weights."""
        flat, tiles, window = x.reshape(-1, x.shape[-1]), len(self.starts), self.blocks.shape[1]
        size = self.blocks.shape[2] // self.parts  # outputs of a tile

        def product(tile: Any) -> Float[Array, "n part o"]:
            start = starts[tile]
            cut = flat[:, start : start + window] if isinstance(tile, int) else dynamic_slice(flat, start, window, 1)
            return jnp.matmul(cut, self.blocks[tile], precision="highest").reshape(-1, self.parts, size)

        if self.order == "in turn":
            starts: Any = self.starts
            every = jnp.concatenate([product(tile) for tile in range(tiles)], -1)
        elif self.order == "at once":
            starts = jnp.asarray(self.starts)
            every = jnp.moveaxis(jax.vmap(product)(jnp.arange(tiles)), 0, 2)
        else:
            starts = jnp.asarray(self.starts)
            empty = jnp.zeros((len(flat), self.parts, tiles * size), flat.dtype)
            every = fori_loop(0, tiles, lambda k, out: dynamic_update_slice(out, product(k), k * size, 2), empty)
        rows = jnp.moveaxis(every.reshape(len(flat), self.parts, -1), 1, 0)
        return [row[:, : self.outputs].reshape(*x.shape[:-1], self.outputs) for row in rows]
