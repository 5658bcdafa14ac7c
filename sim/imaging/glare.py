"""Veiling glare of a real lens: a little of all light is scattered at its faces and lands far from where it belongs.

The glare spread function of a camera falls roughly as the square of the distance (E.-V. Talvala, A. Adams, M. Horowitz
and M. Levoy, ACM Trans. Graph. 26, 37, 2007; ISO 18844 measures its sum). Here it is

    g(r) = (1 - share) delta(r) + share s(r),    s(r) ~ (r^2 + core^2)^(-fall / 2),    sum of s = 1,

s within a square window: light that is scattered farther is left out of `share`. It acts on all colours alike and on
the light behind the plate, so that it is convolved with PSFs.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
from jaxtyping import Float

from fab.errors import InputError
from fab.units import number_of

_MOST_DRAWN = 0.5  # of the light, scattered by another lens of a kind


@dataclass(frozen=True)
class Glare:
    """Veiling glare of a lens.

    Attributes:
        share: of the light that is scattered, 0 to below 1; 0 for a perfect lens.
        fall: power of the distance by which scattered light falls, 2 for most lenses; above 0.
        core_px: radius within which it is flat, pixels; above 0.
        window: pixels of the square window of the scattered light; odd.
    """

    share: float = 0.02
    fall: float = 2.0
    core_px: float = 1.5
    window: int = 255

    def __post_init__(self) -> None:
        """Raise an InputError for a number out of range."""
        if not 0 <= number_of(self.share) < 1:
            raise InputError("glare.share", "must lie from 0 to below 1", repr(self.share), "For example 0.02.")
        for name in ("fall", "core_px"):
            if not 0 < number_of(value := getattr(self, name)) < np.inf:
                raise InputError(f"glare.{name}", "must be a positive number", repr(value), "Correct it.")
        if not number_of(self.window) >= 1 or self.window % 2 != 1:
            rule = "must be a whole, odd number, so that it has a middle pixel"
            raise InputError("glare.window", rule, repr(self.window), "Add 1.")

    def kernel(self) -> Float[np.ndarray, "v u"]:
        """The spread function `[v, u]` on the window's pixels; its sum is 1."""
        axis = np.arange(self.window) - self.window // 2
        squared = axis[:, None] ** 2.0 + axis**2.0
        scattered = (squared + self.core_px**2) ** (-self.fall / 2)
        kernel = self.share * scattered / scattered.sum()
        kernel[self.window // 2, self.window // 2] += 1 - self.share
        return kernel

    def scattered(self, psf: Float[np.ndarray, "*k y x"]) -> Float[np.ndarray, "*k v u"]:
        """PSFs with glare, on its window or on theirs, whichever is larger.

        Args:
            psf: `[..., y, x]` energy per pixel, in a square window of an odd number of pixels.

        Returns:
            `[..., v, u]` float32, the middle of the PSFs in the middle of the window. Their energy is that of the PSFs
            less what is scattered out of the window.

        Raises:
            ValueError: PSFs whose window is not square or not odd.
        """
        size = psf.shape[-1]
        if psf.shape[-2] != size or size % 2 == 0:
            raise ValueError(f"`psf` must have an odd square window, but got {psf.shape[-2:]}")
        window = max(size, self.window)
        length = int(scipy.fft.next_fast_len(size + self.window - 1, real=True))  # pyright: ignore[reportArgumentType]
        both = (length, length)
        product = np.fft.rfft2(np.asarray(psf, np.float64), both) * np.fft.rfft2(self.kernel(), both)
        first = (size + self.window - 2) // 2 - window // 2
        whole = np.fft.irfft2(product, both)
        kept = slice(first, first + window)
        # Transforms leave rounding errors of either sign where there is no light.
        return np.maximum(whole[..., kept, kept], 0.0).astype(np.float32)

    def drawn(self, rng: np.random.Generator, spread: float) -> "Glare":
        """The glare of another lens of its kind: share and fall off by a relative standard deviation.

        No draw scatters more than half of the light, or than this lens if that is more.

        Args:
            rng: where it is drawn from.
            spread: relative standard deviation of the share (of a logarithmic normal distribution, which knows no
                negative shares); of the fall it is a fifth of that.
        """
        share = self.share * float(np.exp(spread * rng.standard_normal()))
        fall = self.fall * float(np.exp(spread / 5 * rng.standard_normal()))
        return replace(self, share=min(share, max(_MOST_DRAWN, self.share)), fall=fall)
