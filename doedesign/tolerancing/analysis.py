"""Statistics of a sample of fabricated DOEs: a table of their metrics, moments, limits and yield."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from doedesign.spec import LimitSpec, validated
from doedesign.spec.process import leading_quantity
from doedesign.tolerancing.pool import OutOfModel, Rows
from fab.errors import InputError
from fab.units import format_length, parse_length
from sim.metrics import METRICS, Metric

CONFIDENCE = 0.95

# The metrics that limits can be set for, and their worst values.
QUANTITIES: Mapping[str, Metric] = {name: metric for name, metric in METRICS.items() if metric.worse is not None}
_WORST = {name: math.inf if metric.worse == "high" else -math.inf for name, metric in QUANTITIES.items()}


class Yield(NamedTuple):
    """Share of good DOEs, 0-1, with its 95 % confidence interval (Wilson), and the numbers of good ones and of all."""

    share: float
    low: float
    high: float
    good: int
    plates: int

    def __str__(self) -> str:
        """For example "87.0 % (78.6 to 92.4 %)"."""
        return f"{100 * self.share:.1f} % ({100 * self.low:.1f} to {100 * self.high:.1f} %)"


def yield_of(good: Bool[np.ndarray, " draw"]) -> Yield:
    """Yield of draws that are good or not; a ValueError without draws."""
    from scipy.stats import binomtest

    if not len(good):
        raise ValueError("a yield needs at least one draw, but got none")
    count = int(good.sum())
    interval = binomtest(count, len(good)).proportion_ci(CONFIDENCE, "wilson")
    return Yield(count / len(good), float(interval.low), float(interval.high), count, len(good))


@dataclass(frozen=True, eq=False)
class Sample:
    """Metrics of some draws, and the limits that a good DOE obeys.

    Attributes:
        keys: the draws.
        places: colour and depth of every row; depths in metres, `inf` for a star.
        values: `[draw, row]` of every quantity; NaN where a row has no such metric, and infinitely bad for a draw
            beyond the model.
        limits: what a good DOE obeys.
    """

    keys: tuple[str, ...]
    places: tuple[tuple[str, float], ...]
    values: Mapping[str, Float[np.ndarray, "draw row"]]
    limits: tuple[LimitSpec, ...] = ()

    @property
    def colours(self) -> tuple[str, ...]:
        """Colours, in the order of the camera."""
        return tuple(dict.fromkeys(colour for colour, _ in self.places))

    @property
    def rows(self) -> list[dict[str, Any]]:
        """A dictionary per draw, colour and depth (`depth_m`, metres); metrics that a row does not have are missing."""
        within = self.within
        return [
            {"key": key, "colour": colour, "depth_m": depth}
            | {name: float(values[i, j]) for name, values in self.values.items() if not math.isnan(values[i, j])}
            for i, key in enumerate(self.keys)
            for j, (colour, depth) in enumerate(self.places)
            if within[i]
        ]

    def rows_of(self, quantity: str, colour: str | None = None, depth_m: float | None = None) -> list[int]:
        """Rows that have this quantity, of one colour and depth or of all."""
        has = np.any(~np.isnan(self.values[quantity]), axis=0)
        return [
            i
            for i, (name, depth) in enumerate(self.places)
            if has[i] and colour in (None, name) and (depth_m is None or math.isclose(depth, depth_m, rel_tol=1e-6))
        ]

    def colours_of(self, quantity: str) -> tuple[str, ...]:
        """Colours that have this quantity: what is aimed at has it in its own alone."""
        return tuple(dict.fromkeys(self.places[row][0] for row in self.rows_of(quantity)))

    def worst(self, quantity: str, colour: str | None = None, depth_m: float | None = None) -> Float[np.ndarray, " d"]:
        """The worst value of every draw over the rows of a colour and depth, or over all of them."""
        chosen = self.values[quantity][:, self.rows_of(quantity, colour, depth_m)]
        return chosen.max(axis=1) if QUANTITIES[quantity].worse == "high" else chosen.min(axis=1)

    @property
    def within(self) -> Bool[np.ndarray, " draw"]:
        """Draws that the model describes."""
        beyond = np.zeros(len(self.keys), dtype=bool)
        for name, values in self.values.items():
            beyond |= np.any(values == _WORST[name], axis=1)
        return ~beyond

    def of(self, keys: Sequence[str]) -> "Sample":
        """Subset of the draws."""
        positions = {key: i for i, key in enumerate(self.keys)}
        chosen = [positions[key] for key in keys]
        values = {name: values[chosen] for name, values in self.values.items()}
        return Sample(tuple(keys), self.places, values, self.limits)

    def obeys(self, limit: LimitSpec) -> Bool[np.ndarray, " draw"]:
        """Whether every row of a draw that a limit concerns obeys it; one beyond the model obeys none.

        Raises:
            InputError: a limit that concerns no row.
        """
        rows = self.rows_of(limit.quantity, limit.colour, limit.depth_m) if limit.quantity in self.values else []
        if not rows:
            rule = "must match a colour and depth"
            places = ", ".join(f"{c} at {format_length(z)}" for c, z in self.places)
            raise InputError(f"limit on {limit.quantity}", rule, limit_text(limit), f"One of {places}.")
        values = self.values[limit.quantity][:, rows]
        low, high = -math.inf if limit.min is None else limit.min, math.inf if limit.max is None else limit.max
        return self.within & np.all((values >= low) & (values <= high), axis=1)

    @property
    def good(self) -> Bool[np.ndarray, " draw"]:
        """Whether a draw obeys every limit; one beyond the model does not."""
        return np.logical_and.reduce([self.within, *map(self.obeys, self.limits)])

    @property
    def yield_(self) -> Yield | None:
        """Share of draws that obey every limit; None where there are no limits."""
        return yield_of(self.good) if self.limits else None

    @property
    def worst_draw(self) -> str:
        """Key of the draw farthest beyond a limit, or nearest to one; without limits, the worst by `leading_quantity`.

        Draws beyond the model are passed over.
        """
        margins = np.full(len(self.keys), np.inf)
        if not self.limits:
            quantity = leading_quantity(self.values)
            margins = self.worst(quantity) * (1 if QUANTITIES[quantity].worse == "low" else -1)
        for limit in self.limits:
            values = self.values[limit.quantity][:, self.rows_of(limit.quantity, limit.colour, limit.depth_m)]
            for bound, sign in ((limit.min, 1.0), (limit.max, -1.0)):
                if bound is not None:
                    # Against the size of the bound, so that limits of different quantities can be compared.
                    margin = sign * (values - bound) / (abs(bound) or 1.0)
                    margins = np.minimum(margins, margin.min(axis=1))
        return self.keys[int(np.argmin(np.where(self.within, margins, np.inf)))]

    def statistics(self) -> list[dict[str, Any]]:
        """Mean, spread and percentiles of every quantity: of the worst row of every draw, and of every row by itself.

        Draws beyond the model are left out.

        Returns:
            rows with quantity, colour and depth_m (both None for the worst row), mean, std, min, p05, median, p95, max.
        """
        found = self.of([key for key, one in zip(self.keys, self.within, strict=True) if one])
        rows = []
        for name in found.values:
            for colour, depth in [(None, None), *(found.places[i] for i in found.rows_of(name))]:
                place = {"quantity": name, "colour": colour, "depth_m": depth}
                rows.append({**place, **_moments(found.worst(name, colour, depth))})
        return rows


def sample_of(draws: Mapping[str, Rows | OutOfModel], limits: Sequence[LimitSpec] = ()) -> Sample:
    """Sample of the results of some draws.

    A ring:disc ratio of None, as a DOE without any light in the disc has, counts as infinite. What tells of spots,
    areas and foci comes first.

    Raises:
        ValueError: no draw has rows, or two have different colours or depths.
    """
    first = next((found for found in draws.values() if not isinstance(found, OutOfModel)), None)
    if first is None:
        raise ValueError("`draws` must hold at least one draw with rows, but there is none")
    places = _places(first)
    known = [name for name in QUANTITIES if any(name in row for row in first)]
    present = sorted(known, key=lambda name: not METRICS[name].aimed)
    values = {name: np.full((len(draws), len(places)), np.nan) for name in present}
    for i, (key, found) in enumerate(draws.items()):
        beyond = isinstance(found, OutOfModel)
        if not beyond and _places(found) != places:
            raise ValueError(f"all draws must have the same rows, but {key} has others")
        for j, row in enumerate(first if beyond else found):
            for name in present:
                if name in row:
                    values[name][i, j] = _WORST[name] if beyond else math.inf if row[name] is None else row[name]
    return Sample(tuple(draws), places, values, tuple(limits))


def _places(rows: Rows) -> tuple[tuple[str, float], ...]:
    """Colour and depth of every row."""
    depths = (math.inf if row["depth_m"] is None else float(row["depth_m"]) for row in rows)
    return tuple((str(row["colour"]), depth) for row, depth in zip(rows, depths, strict=True))


def _moments(values: Float[np.ndarray, " draw"]) -> dict[str, float]:
    with np.errstate(invalid="ignore"):  # an infinite ratio has no mean
        p05, median, p95 = np.percentile(values, [5, 50, 95]) if np.isfinite(values).all() else _ranks(values)
        mean, std = values.mean(), values.std(ddof=1) if len(values) > 1 else 0.0
    names = ("mean", "std", "min", "p05", "median", "p95", "max")
    return dict(zip(names, map(float, (mean, std, values.min(), p05, median, p95, values.max())), strict=True))


def _ranks(values: Float[np.ndarray, " draw"]) -> list[float]:
    """The same percentiles of numbers of which some are infinite; numpy's next to an infinite one are NaN."""
    ordered, places = np.sort(values), np.array([0.05, 0.5, 0.95]) * (len(values) - 1)
    found = []
    for place in np.round(places, 9):
        low, share = math.floor(place), place % 1
        below, above = ordered[low], ordered[min(low + 1, len(values) - 1)]
        found.append(float(below if share == 0 or below == above else below + share * (above - below)))
    return found


_LIMIT = re.compile(r"\s*(\w+)\s*(<=|>=)\s*([-+\d.eE]+)\s*(%?)(?:\s+for\s+([\w-]+))?(?:\s+at\s+(.+?))?\s*")


def limit_from_text(text: str) -> LimitSpec:
    """A limit from words such as "zeroth_order <= 5 %", "ring_to_disc >= 2 for 656nm" or "far_spot >= 0.3 at 5 m".

    Raises:
        InputError: no limit, or on something that is no metric.
    """
    found = _LIMIT.fullmatch(text)
    cure = f'For example "zeroth_order <= 5 %" or "far_spot >= 0.3 for 656nm at 5 m". Of: {", ".join(QUANTITIES)}.'
    try:
        if found is None or found[1] not in QUANTITIES:
            raise ValueError(text)  # noqa: TRY301 - explained below, as any other mistake
        bound = float(f"{float(found[3]) / (100 if found[4] else 1):.15g}")
        depth = None if found[6] is None else math.inf if found[6] == "inf" else parse_length(found[6])
    except ValueError as error:
        raise InputError("limit", "must be a quantity, <= or >=, and a number", f'"{text}"', cure) from error
    side = {"max" if found[2] == "<=" else "min": bound}
    # What is a limit in form may still ask for the impossible, such as a share of 150 %: its own rule says so.
    given = {"quantity": found[1], **side, "colour": found[5], "depth_m": depth}
    return validated(LimitSpec, given, f'limit "{text}"', si=True)


def limit_text(limit: LimitSpec) -> str:
    """A limit in words: "zeroth_order <= 0.05 for 656nm"."""
    bounds = [f"{sign} {bound:g}" for sign, bound in ((">=", limit.min), ("<=", limit.max)) if bound is not None]
    place = f" for {limit.colour}" if limit.colour else ""
    place += f" at {format_length(limit.depth_m)}" if limit.depth_m is not None else ""
    return f"{limit.quantity} {' and '.join(bounds)}{place}"
