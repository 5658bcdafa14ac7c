"""Sensitivity analysis: the effect of each error alone, and Sobol indices of all errors at once.

One at a time needs two draws per error and shows what each does around the mean, but not what errors do together.
Sobol indices need many draws and share out the variance of every quantity over the sources of error: the first index
of a source is the variance that it causes by itself, the total index also what it causes together with others.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.tolerancing.analysis import CONFIDENCE, Sample
from fab.draws import EXPECTED, one_at_a_time_keys, sobol_keys, source_of, sources_of, varying
from fab.process import DEVIATIONS, Process, deviation_of

_UNFOLDED = 2.0  # standard deviations of a mean from zero, beyond which folding takes less than 7 % of a variance
_RESAMPLES = 500


class Effect(NamedTuple):
    """Effect of one error alone on one quantity, in the worst row of one colour or, where that is None, of all.

    `low` and `high` are the quantity one standard deviation below and above the mean; there is no lower one where the
    error strays to one side only. `variance` is about what the error alone adds to the variance, from the slope and the
    curvature of these and the one with every error at its mean.
    """

    error: str
    source: str
    quantity: str
    colour: str | None
    low: float | None
    expected: float
    high: float
    variance: float


def one_at_a_time(process: Process, sample: Sample) -> list[Effect]:
    """Effect of every error alone, from the draws of `one_at_a_time_keys` and the expected one."""
    keys = set(one_at_a_time_keys(process))
    out = []
    for quantity in sample.values:
        for colour in (None, *sample.colours_of(quantity)):
            values = dict(zip(sample.keys, sample.worst(quantity, colour).tolist(), strict=True))
            expected = values[EXPECTED]
            for name in varying(process):
                below, above = (f"one_at_a_time/{name}/{reach}" for reach in ("-1", "+1"))
                low, high = values[below] if below in keys else None, values[above]
                variance = _variance(*_strays(process, name), low, expected, high)
                out.append(Effect(name, source_of(name), quantity, colour, low, expected, high, variance))
    return out


def _strays(process: Process, name: str) -> tuple[float, bool]:
    """Variance of an error over its sigma squared, and whether one sigma below its mean it is smaller than there.

    An error that is never negative is |m + z| sigma for a mean of m sigma and a normal z: that is folded at zero.
    """
    mean, sigma = process.spreads[name]
    far = mean / sigma
    if not deviation_of(name).one_sided or far >= _UNFOLDED:
        return 1.0, True
    middle = math.sqrt(2 / math.pi) * math.exp(-(far**2) / 2) + far * math.erf(far / math.sqrt(2))
    return 1 + far**2 - middle**2, far >= 1


def _variance(strays: float, falls: bool, low: float | None, expected: float, high: float) -> float:
    """Variance of a + b z + c z² through three points for a z of variance `strays`; of a + b z where z hardly falls."""
    if low is None or not falls:
        return strays * (high - expected) ** 2
    slope, curvature = (high - low) / 2, (high + low) / 2 - expected
    return strays * (slope**2 + 2 * curvature**2)


def source_shares(effects: Sequence[Effect], quantity: str) -> dict[str, float]:
    """Approximate share of each source in a quantity's variance, if errors do not act together; largest first.

    Empty where an error leaves the model: nothing is known of what it does, and it may well do the most.
    """
    if any((one.quantity, one.colour) == (quantity, None) and _leaves(one) for one in effects):
        return {}
    variances = dict.fromkeys((error.source for error in DEVIATIONS.values()), 0.0)
    for effect in effects:
        if (effect.quantity, effect.colour) == (quantity, None) and np.isfinite(effect.variance):
            variances[effect.source] += effect.variance
    total = sum(variances.values())
    shares = {source: value / total for source, value in variances.items() if value > 0}
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def _leaves(effect: Effect) -> bool:
    """Whether one standard deviation of an error leaves the model where its mean does not."""
    ends = [end for end in (effect.low, effect.high) if end is not None]
    return bool(np.isfinite(effect.expected) and not np.isfinite(ends).all())


class SensitivityIndex(NamedTuple):
    """A Sobol index and its 95 % confidence interval (bootstrap)."""

    value: float
    low: float
    high: float


class VarianceShare(NamedTuple):
    """Share of the variance of a quantity that a source causes by itself, and in total, together with others.

    The quantity is that of the worst row of a colour, or of all where the colour is None.
    """

    source: str
    quantity: str
    colour: str | None
    first: SensitivityIndex
    total: SensitivityIndex


def sobol(process: Process, sample: Sample, count: int, seed: int = 0) -> list[VarianceShare]:
    """Sobol indices of every source from draws of `sobol_keys(process, count)` (estimators of Saltelli et al. 2010).

    Returns:
        shares of every quantity that is finite and varies: of the worst row, and of the worst row of each colour.
    """
    from scipy.stats import bootstrap

    sources = sources_of(process)
    of = sample.of(sobol_keys(process, count))
    numbers = {(q, c): _clipped(of.worst(q, c)) for q in of.values for c in (None, *of.colours_of(q))}
    outputs = [output for output, found in numbers.items() if _varies(found)]
    if not outputs:
        return []
    values = np.stack([numbers[output].reshape(2 + len(sources), count) for output in outputs], axis=1)
    found = _indices(values, np.arange(count))
    interval = bootstrap(
        [np.arange(count)],
        lambda rows: _indices(values, rows),
        vectorized=False,
        n_resamples=_RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng([seed, 3]),
    ).confidence_interval

    def index(*at: int) -> SensitivityIndex:
        return SensitivityIndex(*(float(values[at]) for values in (found, interval.low, interval.high)))

    return [
        VarianceShare(source, quantity, colour, index(0, o, s), index(1, o, s))
        for o, (quantity, colour) in enumerate(outputs)
        for s, source in enumerate(sources)
    ]


def _clipped(values: Float[np.ndarray, " draw"]) -> Float[np.ndarray, " draw"]:
    """Infinite numbers at the limits of the finite ones: a draw beyond all others counts as the worst of them."""
    finite = values[np.isfinite(values)]
    return np.clip(values, finite.min(), finite.max()) if len(finite) else values


def _varies(values: Float[np.ndarray, " draw"]) -> bool:
    """Whether numbers are finite and differ by more than rounding does."""
    return bool(np.isfinite(values).all() and np.ptp(values) > 1e-6 * np.abs(values).max())


def _indices(values: Float[np.ndarray, "sample output row"], rows: np.ndarray) -> Float[np.ndarray, "2 output source"]:
    """First and total indices from the outputs of samples A, B, and A with each source from B, in that order."""
    from scipy.stats import sobol_indices

    # One output more, of which nothing is used, keeps all axes where there is one.
    a, b, *mixed = np.concatenate([values, values[:, :1]], axis=1)[..., rows]
    mixed = np.stack([*mixed, mixed[-1]])
    found = sobol_indices(func={"f_A": a, "f_B": b, "f_AB": mixed}, n=len(rows))
    return np.stack([found.first_order[:-1, :-1], found.total_order[:-1, :-1]])
