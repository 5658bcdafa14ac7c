"""Means of scores with intervals by the bootstrap, over pictures and over seeds of the trainings.

Pairs of one photograph are not independent draws, so whole photographs are drawn again, with all their pairs; and so
are seeds, where there are several. One seed says nothing about others: the interval then holds for that seed. Rows are
compared pair by pair: the interval of a mean difference has nothing of the spread between easy and hard pairs.

Reference:
    B. Efron and R. J. Tibshirani, "An Introduction to the Bootstrap", 1993, chapters 8 and 13 (percentile intervals).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

RESAMPLES = 2000
_SALT = 17


class BootstrapInterval(NamedTuple):
    """A mean, the ends of its 95 % interval, and the numbers of pairs, photographs and seeds behind it.

    One photograph and one seed say nothing about others: then there is no interval.
    """

    mean: float
    low: float | None
    high: float | None
    pairs: int
    pictures: int
    seeds: int


def bootstrap_mean(
    values: Float[np.ndarray, "seed pair"], pictures: Sequence[str], confidence: float = 0.95, seed: int = 0
) -> BootstrapInterval | None:
    """Mean of scores over seeds and pairs, with its interval; None where no pair has one.

    A pair without a score (NaN) of one seed is left out of all.

    Args:
        values: scores.
        pictures: photograph of every pair.
        confidence: share of intervals that hold the true mean, between 0 and 1.
        seed: seed of the draws.

    Raises:
        ValueError: unlike numbers of pairs, an infinite score, or a confidence out of range.
    """
    if values.shape[1] != len(pictures):
        raise ValueError(f"`pictures` must name one per pair, but got {len(pictures)} for {values.shape[1]}")
    if not 0 < confidence < 1:
        raise ValueError(f"`confidence` must lie between 0 and 1, but got {confidence}")
    known = ~np.isnan(values).any(axis=0)
    if not known.any() or not len(values):
        return None
    if np.isinf(values[:, known]).any():
        raise ValueError("`values` must be finite, but one is infinite")
    names, index = np.unique(np.asarray(pictures)[known], return_inverse=True)
    sums = np.stack([np.bincount(index, row, len(names)) for row in values[:, known].astype(np.float64)])
    counts = np.bincount(index, minlength=len(names)).astype(np.float64)
    mean, about = float(sums.sum() / (len(sums) * counts.sum())), (int(counts.sum()), len(names), len(sums))
    if sums.size == 1:
        return BootstrapInterval(mean, None, None, *about)
    rng = np.random.default_rng((seed, _SALT))

    def drawn(count: int) -> np.ndarray:
        """How often each is drawn in every resample; one alone is always itself."""
        return rng.multinomial(count, np.full(count, 1 / count), RESAMPLES).astype(np.float64)

    of_pictures, of_seeds = drawn(len(names)), drawn(len(sums))
    means = np.einsum("rs,sp,rp->r", of_seeds, sums, of_pictures) / (len(sums) * (of_pictures @ counts))
    tail = (1 - confidence) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return BootstrapInterval(mean, float(low), float(high), *about)
