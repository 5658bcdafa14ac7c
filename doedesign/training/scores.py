"""Scores of reconstructions: PSNR, SSIM and 1 - LPIPS, in the occluded region and over the full image.

The columns are those of Table 1 of the paper. How it restricts SSIM and LPIPS to a region, which backbone it takes and
where a soft mask ends is not said, so this is our own protocol:

- Pictures are display values (sRGB) and are clipped to 0..1 first, as a screen would.
- The occluded region of a picture is where its mask is at least one half.
- PSNR is taken from the mean squared error over the colours and pixels of the region.
- SSIM is scikit-image's with `gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1`, averaged
  over colours; in a region, the mean of its map over the region. A frame of 5 pixels has no SSIM and does not count.
- LPIPS in a region is the mean of its map over the region. Maps of deep features are coarse and look at the
  surroundings too, so it says less about small regions than the other two.
- Scores are taken per picture and then averaged. A picture without occluded pixels has no score there (NaN).

`paired_difference` compares two methods by the differences of every picture, not by the spread between easy and hard
ones.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Array, Bool, Float

from doedesign.training.distance.perceptual import Lpips
from doedesign.training.distance.similarity import WINDOW, Images, ssim_maps

Masks = Float[Array, "b y x"] | Float[np.ndarray, "b y x"]
Values = Sequence[float] | Float[np.ndarray, "..."]


class Region(NamedTuple):
    """Scores of every picture in one region, in the order of Table 1; higher is better.

    PSNR is in dB, infinite for equal pictures; closeness is 1 - LPIPS, None without its weights.
    """

    ssim: Float[Array, " b"]
    psnr: Float[Array, " b"]
    closeness: Float[Array, " b"] | None


class Scores(NamedTuple):
    """Scores where the mask is at least one half (NaN where it nowhere is), and over the full image."""

    occluded: Region
    full: Region


@eqx.filter_jit
def scores(recon: Images, reference: Images, mask: Masks, perceptual: Lpips | None = None) -> Scores:
    """Judge reconstructions.

    Args:
        recon: `[b, c, y, x]` display values, row 0 at the lowest y.
        reference: what should have been seen.
        mask: `[b, y, x]` share of each pixel that is blocked, 0..1.
        perceptual: weights of LPIPS, if at hand.

    Raises:
        ValueError: unlike shapes, or pictures smaller than SSIM's window or LPIPS's least size.
    """
    a, b = _shown(recon), _shown(reference)
    of_region = of_full = None
    if perceptual is not None:
        of_region = 1 - _mean_within(perceptual.map(a, b), occluded(mask))
        of_full = 1 - perceptual(a, b)
    return Scores(
        Region(ssim(a, b, mask), psnr(a, b, mask), of_region),
        Region(ssim(a, b), psnr(a, b), of_full),
    )


def scores_of_one(
    recon: Float[np.ndarray, "c y x"],
    reference: Float[np.ndarray, "c y x"],
    mask: Float[np.ndarray, "y x"],
    perceptual: Lpips | None = None,
) -> dict[str, dict[str, float | None]]:
    """Judge one reconstruction (`scores`): numbers by region and name for JSON, None for one that is not finite."""
    found = scores(recon[None], reference[None], mask[None], perceptual)
    return {
        region: {
            name: float(values[0]) if np.isfinite(values[0]) else None
            for name, values in of_region._asdict().items()
            if values is not None
        }
        for region, of_region in found._asdict().items()
    }


def occluded(mask: Masks) -> Bool[Array, "b y x"]:
    """The occluded region: where at least half of a pixel is blocked."""
    return jnp.asarray(mask) >= 0.5


def psnr(recon: Images, reference: Images, mask: Masks | None = None) -> Float[Array, " b"]:
    """Peak signal-to-noise ratio, dB: -10 log10 of the mean squared error, for a white of 1; see `scores`."""
    error = jnp.mean(jnp.square(_shown(recon) - _shown(reference)), axis=1)
    return -10 * jnp.log10(_mean_within(error, None if mask is None else occluded(mask)))


def ssim(recon: Images, reference: Images, mask: Masks | None = None) -> Float[Array, " b"]:
    """Structural similarity, averaged over colours; see `scores`."""
    values = jnp.mean(ssim_maps(_shown(recon), _shown(reference))[0], axis=1)
    frame = slice(WINDOW // 2, -(WINDOW // 2))
    return _mean_within(values, None if mask is None else occluded(mask)[:, frame, frame])


def _shown(pictures: Images) -> Float[Array, "b c y x"]:
    return jnp.clip(jnp.asarray(pictures, jnp.float32), 0, 1)


def _mean_within(values: Float[Array, "b y x"], region: Bool[Array, "b y x"] | None) -> Float[Array, " b"]:
    """Mean of each picture's values; NaN where the region is empty."""
    return jnp.mean(values, (1, 2)) if region is None else jnp.mean(values, (1, 2), where=region)


class Interval(NamedTuple):
    """A mean over `size` pictures, and the ends of its confidence interval."""

    mean: float
    low: float
    high: float
    size: int


def mean_and_interval(values: Values, confidence: float = 0.95) -> Interval:
    """Mean of scores over pictures, and over seeds where there are several, with Student's t interval.

    It takes the pictures for independent draws. Several crops of one photograph are not: average them first. With
    several seeds both are draws: the variance of the mean is that of the seeds' means plus that of the pictures' means,
    which counts what belongs to neither twice, and its degrees of freedom are Satterthwaite's (Biometrics Bulletin 2,
    110, 1946). One seed says nothing about others, and the interval then holds for that seed.

    Args:
        values: `[picture]` or `[seed, picture]` scores; a picture with a NaN (which has no score) is left out.
        confidence: how often such an interval holds the true mean, between 0 and 1; it is infinite for one picture.

    Raises:
        ValueError: no value, an infinite one, or a confidence out of range.
    """
    if not 0 < confidence < 1:
        raise ValueError(f"`confidence` must lie between 0 and 1, but got {confidence}")
    given = np.atleast_2d(np.asarray(values, np.float64))
    known = given[:, ~np.isnan(given).any(axis=0)]
    seeds, pictures = known.shape
    if not known.size or np.isinf(known).any():
        raise ValueError(f"`values` must hold at least one number and no infinite one, but got {np.asarray(values)}")
    mean = float(known.mean())
    if pictures == 1:
        return Interval(mean, -np.inf, np.inf, 1)
    freedom = np.array([n - 1 for n in (seeds, pictures) if n > 1])
    of_means = [known.mean(axis=1 - axis) for axis in (0, 1) if known.shape[axis] > 1]
    parts = np.array([np.var(means, ddof=1) / means.size for means in of_means])
    if not parts.any():
        return Interval(mean, mean, mean, pictures)
    together = np.square(parts.sum()) / np.sum(np.square(parts) / freedom)
    reach = float(scipy.stats.t.ppf(0.5 + confidence / 2, together) * np.sqrt(parts.sum()))
    return Interval(mean, mean - reach, mean + reach, pictures)


def paired_difference(a: Values, b: Values) -> Interval:
    """Mean difference of `a` over `b`, another method on the same pictures (and seeds), with its interval.

    Arguments and errors are those of `mean_and_interval`; unlike numbers of scores are a ValueError, too.
    """
    if np.shape(a) != np.shape(b):
        got = f"{np.shape(a)} and {np.shape(b)}"
        raise ValueError(f"both methods must have one score per picture (and seed), but got {got}")
    return mean_and_interval(np.asarray(a, np.float64) - np.asarray(b, np.float64))
