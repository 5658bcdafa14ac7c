"""Which errors matter: each alone, and shares of variance over all errors at once.

One at a time needs two plates per error and shows what each does around the mean, but not what errors do together.
Sobol indices need many plates and share out the variance of every quantity over the sources of error: the first index
of a source is the variance that it causes by itself, the total index also what it causes together with others.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.tolerancing.analysis import CONFIDENCE, PlateTable
from fab.draws import EXPECTED, one_at_a_time_keys, sobol_keys, sources_of
from fab.process import DEVIATIONS, Process
from fab.sampling import source_of, varying

# What a normal deviate's absolute value varies by.
_FOLDED = 1 - 2 / np.pi
_RESAMPLES = 500


class Change(NamedTuple):
    """What one error does to one quantity, in the worst row or the worst row of one colour.

    Attributes:
        error: flat name.
        source: source of error it belongs to.
        quantity: the quantity.
        colour: the colour, or None for all.
        low: the quantity one standard deviation below the mean; None where the error strays to one side only.
        expected: with every error at its mean.
        high: one standard deviation above.
        variance: about what the error alone adds to the variance, from the slope and the curvature of these three.
    """

    error: str
    source: str
    quantity: str
    colour: str | None
    low: float | None
    expected: float
    high: float
    variance: float


def one_at_a_time(process: Process, table: PlateTable) -> list[Change]:
    """What every error does alone.

    Args:
        process: the process.
        table: plates of `one_at_a_time_keys` and the expected plate.
    """
    keys = set(one_at_a_time_keys(process))
    out = []
    for quantity in table.values:
        for colour in (None, *table.colours):
            values = dict(zip(table.keys, table.worst(quantity, colour).tolist(), strict=True))
            expected = values[EXPECTED]
            for name in varying(process):
                below, above = (f"one_at_a_time/{name}/{reach}" for reach in ("-1", "+1"))
                low, high = values[below] if below in keys else None, values[above]
                out.append(
                    Change(name, source_of(name), quantity, colour, low, expected, high, _variance(low, expected, high))
                )
    return out


def _variance(low: float | None, expected: float, high: float) -> float:
    """Variance of a + b z + c z² through three points for a normal z; of a + b |z| where only one side is known."""
    if low is None:
        return _FOLDED * (high - expected) ** 2
    slope, curvature = (high - low) / 2, (high + low) / 2 - expected
    return slope**2 + 2 * curvature**2


def source_shares(changes: Sequence[Change], quantity: str, colour: str | None = None) -> dict[str, float]:
    """About which share of a quantity's variance each source causes, if errors do not act together; largest first."""
    variances = dict.fromkeys((error.source for error in DEVIATIONS.values()), 0.0)
    for change in changes:
        if (change.quantity, change.colour) == (quantity, colour) and np.isfinite(change.variance):
            variances[change.source] += change.variance
    total = sum(variances.values())
    shares = {source: value / total for source, value in variances.items() if value > 0}
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


class Index(NamedTuple):
    """A Sobol index and the interval in which it lies with 95 % confidence (bootstrap)."""

    value: float
    low: float
    high: float


class Share(NamedTuple):
    """Which share of the variance of a quantity a source causes.

    Attributes:
        source: the source of error.
        quantity: the quantity.
        colour: the colour, or None for the worst row of all.
        first: by itself.
        total: by itself and together with others.
    """

    source: str
    quantity: str
    colour: str | None
    first: Index
    total: Index


def sobol(process: Process, table: PlateTable, count: int, seed: int = 0) -> list[Share]:
    """Sobol indices of every source (estimators of Saltelli et al. 2010).

    Args:
        process: the process.
        table: plates of `sobol_keys(process, count)`.
        count: rows of the samples, a power of two.
        seed: seed of the bootstrap.

    Returns:
        shares of every quantity that is finite and varies: of the worst row, and of the worst row of each colour.
    """
    from scipy.stats import bootstrap

    sources = sources_of(process)
    of = table.of(sobol_keys(process, count))
    numbers = {(q, c): _clipped(of.worst(q, c)) for q in of.values for c in (None, *of.colours)}
    outputs = [output for output, found in numbers.items() if _varies(found)]
    if not outputs:
        return []
    values = np.stack([numbers[output].reshape(2 + len(sources), count) for output in outputs], axis=1)
    first, total = _indices(values, np.arange(count))
    found = bootstrap(
        [np.arange(count)],
        lambda rows: np.stack(_indices(values, rows)),
        vectorized=False,
        n_resamples=_RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng([seed, 3]),
    ).confidence_interval
    return [
        Share(
            source,
            quantity,
            colour,
            Index(float(first[o, s]), float(found.low[0, o, s]), float(found.high[0, o, s])),
            Index(float(total[o, s]), float(found.low[1, o, s]), float(found.high[1, o, s])),
        )
        for o, (quantity, colour) in enumerate(outputs)
        for s, source in enumerate(sources)
    ]


def _clipped(values: Float[np.ndarray, " plate"]) -> Float[np.ndarray, " plate"]:
    """Infinite numbers at the limits of the finite ones: a plate beyond all others counts as the worst of them."""
    finite = values[np.isfinite(values)]
    return np.clip(values, finite.min(), finite.max()) if len(finite) else values


def _varies(values: Float[np.ndarray, " plate"]) -> bool:
    """Whether numbers are finite and differ by more than rounding does."""
    return bool(np.isfinite(values).all() and np.ptp(values) > 1e-6 * np.abs(values).max())


def _indices(
    values: Float[np.ndarray, "sample output row"], rows: np.ndarray
) -> tuple[Float[np.ndarray, "output source"], Float[np.ndarray, "output source"]]:
    """First and total indices from the outputs of samples A, B, and A with each source from B, in that order."""
    from scipy.stats import sobol_indices

    # One output more, of which nothing is used, keeps all axes where there is one.
    a, b, *mixed = np.concatenate([values, values[:, :1]], axis=1)[..., rows]
    mixed = np.stack([*mixed, mixed[-1]])
    found = sobol_indices(func={"f_A": a, "f_B": b, "f_AB": mixed}, n=len(rows))
    return found.first_order[:-1, :-1], found.total_order[:-1, :-1]


def most_important(shares: Mapping[str, float]) -> tuple[str, float] | None:
    """The source with the largest share."""
    return max(shares.items(), key=lambda item: item[1]) if shares else None


def as_records(found: Sequence[Change] | Sequence[Share]) -> list[dict[str, Any]]:
    """The same as plain dictionaries, for JSON."""
    return [{k: v._asdict() if isinstance(v, Index) else v for k, v in one._asdict().items()} for one in found]
