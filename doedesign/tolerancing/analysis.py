"""What the plates of a study say together: a table of their numbers, statistics, and yield."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from doedesign.spec import LimitSpec
from doedesign.tolerancing.pool import OutOfModel, Rows
from fab.errors import InputError
from fab.units import format_length, parse_length
from sim.metrics import METRICS, Metric

CONFIDENCE = 0.95


# The metrics that limits can be set for.
QUANTITIES: Mapping[str, Metric] = {name: metric for name, metric in METRICS.items() if metric.worse is not None}


_WORST = {"high": math.inf, "low": -math.inf}


@dataclass(frozen=True)
class PlateTable:
    """The numbers of some plates.

    Attributes:
        keys: the plates.
        places: colour and depth of every row; depths in metres, `inf` for a star.
        values: `[plate, row]` of every quantity; NaN where a row has no such number, and infinitely bad for a plate
            beyond what could be evaluated.
    """

    keys: tuple[str, ...]
    places: tuple[tuple[str, float], ...]
    values: Mapping[str, Float[np.ndarray, "plate row"]]

    @property
    def colours(self) -> tuple[str, ...]:
        """Colours, in the order of the camera."""
        return tuple(dict.fromkeys(colour for colour, _ in self.places))

    def rows_of(self, quantity: str, colour: str | None = None, depth_m: float | None = None) -> list[int]:
        """Rows with a number of this quantity, of one colour and depth or of all."""
        has = np.any(~np.isnan(self.values[quantity]), axis=0)
        return [
            i
            for i, (name, depth) in enumerate(self.places)
            if has[i] and colour in (None, name) and (depth_m is None or math.isclose(depth, depth_m, rel_tol=1e-6))
        ]

    def worst(self, quantity: str, colour: str | None = None, depth_m: float | None = None) -> Float[np.ndarray, " p"]:
        """The worst number of every plate over the rows of a colour and depth, or over all of them."""
        chosen = self.values[quantity][:, self.rows_of(quantity, colour, depth_m)]
        return chosen.max(axis=1) if QUANTITIES[quantity].worse == "high" else chosen.min(axis=1)

    @property
    def within(self) -> Bool[np.ndarray, " plate"]:
        """Which plates could be evaluated."""
        beyond = np.zeros(len(self.keys), dtype=bool)
        for name, values in self.values.items():
            beyond |= np.any(values == _WORST[str(QUANTITIES[name].worse)], axis=1)
        return ~beyond

    def of(self, keys: Sequence[str]) -> "PlateTable":
        """The same of some of the plates."""
        positions = {key: i for i, key in enumerate(self.keys)}
        chosen = [positions[key] for key in keys]
        return PlateTable(tuple(keys), self.places, {name: values[chosen] for name, values in self.values.items()})


def table_of(plates: Mapping[str, Rows | OutOfModel]) -> PlateTable:
    """The table of what was found of some plates.

    A ring:disc ratio of None, as a plate without any light in the disc has, counts as infinite.

    Raises:
        ValueError: no plates with rows, or plates with different rows.
    """
    first = next((found for found in plates.values() if not isinstance(found, OutOfModel)), None)
    if first is None:
        raise ValueError("`plates` must hold at least one plate with rows, but there is none")
    places = tuple((str(row["colour"]), _depth(row["depth_m"])) for row in first)
    present = [name for name in QUANTITIES if any(name in row for row in first)]
    values = {name: np.full((len(plates), len(places)), np.nan) for name in present}
    for i, (key, rows) in enumerate(plates.items()):
        if isinstance(rows, OutOfModel):
            for name in present:
                has = [name in row for row in first]
                values[name][i, has] = _WORST[str(QUANTITIES[name].worse)]
            continue
        if [(row["colour"], _depth(row["depth_m"])) for row in rows] != list(places):
            raise ValueError(f"all plates must have the same rows, but {key} has others")
        for j, row in enumerate(rows):
            for name in present:
                if name in row:
                    values[name][i, j] = math.inf if row[name] is None else row[name]
    return PlateTable(tuple(plates), places, values)


def _depth(depth_m: float | None) -> float:
    return math.inf if depth_m is None else float(depth_m)


def statistics(table: PlateTable) -> list[dict[str, Any]]:
    """Mean, spread and percentiles of every quantity: the worst row of every plate, and every row by itself.

    Plates beyond what could be evaluated have no part in it.

    Returns:
        rows with quantity, colour and depth_m (both None for the worst row), mean, std, min, p05, median, p95, max.
    """
    table = table.of([key for key, one in zip(table.keys, table.within, strict=True) if one])
    out = []
    for name in table.values:
        places: list[tuple[str | None, float | None]] = [(None, None), *(table.places[i] for i in table.rows_of(name))]
        for colour, depth in places:
            out.append(
                {"quantity": name, "colour": colour, "depth_m": depth, **_moments(table.worst(name, colour, depth))}
            )
    return out


def _moments(values: Float[np.ndarray, " plate"]) -> dict[str, float]:
    with np.errstate(invalid="ignore"):  # an infinite ratio has no mean
        p05, median, p95 = np.percentile(values, [5, 50, 95])
        mean, std = values.mean(), values.std(ddof=1) if len(values) > 1 else 0.0
    found = {
        "mean": mean,
        "std": std,
        "min": values.min(),
        "p05": p05,
        "median": median,
        "p95": p95,
        "max": values.max(),
    }
    return {name: float(value) for name, value in found.items()}


class Yield(NamedTuple):
    """Share of good plates, with the interval in which it lies with 95 % confidence (Wilson)."""

    share: float
    low: float
    high: float
    good: int
    plates: int

    def __str__(self) -> str:
        """For example "87.0 % (78.6 to 92.4 %)"."""
        return f"{100 * self.share:.1f} % ({100 * self.low:.1f} to {100 * self.high:.1f} %)"


def yield_of(good: Bool[np.ndarray, " plate"]) -> Yield:
    """The yield of plates that are good or not.

    Raises:
        ValueError: no plates.
    """
    from scipy.stats import binomtest

    if not len(good):
        raise ValueError("a yield needs at least one plate, but got none")
    count = int(good.sum())
    interval = binomtest(count, len(good)).proportion_ci(CONFIDENCE, "wilson")
    return Yield(count / len(good), float(interval.low), float(interval.high), count, len(good))


def obeys(table: PlateTable, limit: LimitSpec) -> Bool[np.ndarray, " plate"]:
    """Whether every row of a plate that a limit speaks of obeys it.

    Raises:
        InputError: the limit speaks of no row of this study.
    """
    rows = table.rows_of(limit.quantity, limit.colour, limit.depth_m) if limit.quantity in table.values else []
    if not rows:
        places = ", ".join(f"{c} at {_depth_text(z)}" for c, z in table.places)
        raise InputError(
            f"limit on {limit.quantity}", "must match a colour and depth", limit_text(limit), f"One of {places}."
        )
    values = table.values[limit.quantity][:, rows]
    low, high = -math.inf if limit.min is None else limit.min, math.inf if limit.max is None else limit.max
    return np.all((values >= low) & (values <= high), axis=1)


def good_plates(table: PlateTable, limits: Iterable[LimitSpec]) -> Bool[np.ndarray, " plate"]:
    """Whether a plate obeys every limit; one beyond what could be evaluated does not."""
    good = table.within
    for limit in limits:
        good &= obeys(table, limit)
    return good


def worst_plate(table: PlateTable, limits: Sequence[LimitSpec]) -> str:
    """Key of the plate that is farthest beyond a limit, or nearest to one; of the lowest Strehl without limits.

    Plates beyond what could be evaluated are passed over.
    """
    if not limits:
        quantity = "strehl" if "strehl" in table.values else next(iter(table.values))
        sign = 1 if QUANTITIES[quantity].worse == "low" else -1
        return table.keys[int(np.argmin(np.where(table.within, sign * table.worst(quantity), np.inf)))]
    margins = np.full(len(table.keys), np.inf)
    for limit in limits:
        values = table.values[limit.quantity][:, table.rows_of(limit.quantity, limit.colour, limit.depth_m)]
        for bound, sign in ((limit.min, 1.0), (limit.max, -1.0)):
            if bound is not None:
                # Against the size of the bound, so that limits of different quantities can be compared.
                margin = sign * (values - bound) / (abs(bound) or 1.0)
                margins = np.minimum(margins, margin.min(axis=1))
    return table.keys[int(np.argmin(np.where(table.within, margins, np.inf)))]


_LIMIT = re.compile(
    r"\s*(\w+)\s*(<=|>=)\s*([-+\d.eE]+)\s*(%?)(?:\s+for\s+([\w-]+))?(?:\s+at\s+(.+?))?\s*",
)


def limit_from_text(text: str) -> LimitSpec:
    """A limit from words such as "zeroth_order <= 5 %", "ring_to_disc >= 2 for 656nm" or "far_spot >= 0.3 at 5 m".

    Raises:
        InputError: no limit, or on something that plates do not have.
    """
    found = _LIMIT.fullmatch(text)
    cure = f'For example "zeroth_order <= 5 %" or "far_spot >= 0.3 for 656nm at 5 m". Of: {", ".join(QUANTITIES)}.'
    try:
        if found is None or found[1] not in QUANTITIES:
            raise ValueError(text)  # noqa: TRY301 - told below, as any other mistake
        bound = float(f"{float(found[3]) / (100 if found[4] else 1):.15g}")
        depth = None if found[6] is None else math.inf if found[6] == "inf" else parse_length(found[6])
        side = {"max" if found[2] == "<=" else "min": bound}
        return LimitSpec.model_validate({"quantity": found[1], **side, "colour": found[5], "depth_m": depth})
    except ValueError as error:
        raise InputError("limit", "must be a quantity, <= or >=, and a number", f'"{text}"', cure) from error


def limit_text(limit: LimitSpec) -> str:
    """A limit in words: "zeroth_order <= 0.05 for 656nm"."""
    bounds = [f"{sign} {bound:g}" for sign, bound in ((">=", limit.min), ("<=", limit.max)) if bound is not None]
    place = f" for {limit.colour}" if limit.colour else ""
    place += f" at {_depth_text(limit.depth_m)}" if limit.depth_m is not None else ""
    return f"{limit.quantity} {' and '.join(bounds)}{place}"


def _depth_text(depth_m: float) -> str:
    return "inf" if math.isinf(depth_m) else format_length(depth_m)
