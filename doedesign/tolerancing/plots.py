"""Pictures of a tolerance study: histograms, yield, which errors matter, and how large they may be.

Every quantity has a panel of its own. "Worst" is the worst of a DOE's colours and depths, which decides whether the DOE
is good. A picture takes the place of axes `ax` of a subplot, or makes a new figure.
"""

import math
from collections.abc import Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from doedesign.report.labels import error_label
from doedesign.tolerancing.analysis import QUANTITIES, Sample, yield_of
from doedesign.tolerancing.budget import Budget
from doedesign.tolerancing.sensitivity import Effect, VarianceShare
from fab.figure import INK, LINE, MARK, SERIES, legend_above, length_text, panels, single
from fab.process import DEVIATIONS
from sim.plots.colours import colour_label, line_colours

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase
    from matplotlib.lines import Line2D

    from doedesign.spec import LimitSpec
    from sim.camera import Camera

_MOST_BARS = 10
_COLUMNS = 3
_LOWER, _HIGHER = SERIES[5], LINE
_BAND = {"color": LINE, "alpha": 0.18, "lw": 0}
_BAD = {"color": MARK, "alpha": 0.08, "lw": 0}


def _scale(quantity: str) -> float:
    return 100.0 if QUANTITIES[quantity].share else 1.0


@contextmanager
def _per_quantity(
    ax: "Axes | None",
    quantities: Sequence[str],
    note: str,
    title: str,
    keys: Sequence["Line2D"] = (),
    size_in: tuple[float, float] = (3.35, 2.5),
) -> "Iterator[tuple[FigureBase, list[Axes]]]":
    """One panel of a size per quantity under a title and a legend."""
    columns = max(min(len(quantities), _COLUMNS), 1)
    rows = max(math.ceil(len(quantities) / columns), 1)
    size = (max(columns * size_in[0], 4.5), rows * size_in[1] + 0.85 + (0.2 if keys else 0.0))
    with panels(ax, size, "" if keys else title, note) as figure:
        grid = list(figure.subplots(rows, columns, squeeze=False).flat)
        for axes, quantity in zip(grid, map(QUANTITIES.__getitem__, quantities), strict=False):
            axes.set(title=quantity.label, xlabel=quantity.label + (" (%)" if quantity.share else ""))
        for spare in grid[len(quantities) :]:
            spare.set_axis_off()
        if keys:
            legend_above(figure, keys, title)
        yield figure, grid[: len(quantities)]


def _hues(camera: "Camera") -> dict[str, Any]:
    return dict(zip((c.name for c in camera.colours), line_colours(camera.colours), strict=True))


def _colour_keys(camera: "Camera", **style: Any) -> "list[Line2D]":
    """A line or mark for every colour."""
    from matplotlib.lines import Line2D

    return [Line2D([], [], color=_hues(camera)[c.name], label=colour_label(c), **style) for c in camera.colours]


def plot_histograms(sample: Sample, nominal: Sample, camera: "Camera", ax: "Axes | None" = None) -> "FigureBase":
    """Draw how every quantity is distributed over the DOEs: a line per colour, the worst depth of each DOE.

    The DOE exactly as designed, `nominal`, is dotted; the side beyond the limits of the sample is shaded.
    """
    hues, plates = _hues(camera), len(sample.keys)
    words = f"{plates} plates, the worst depth of each; dotted: the plate as drawn"
    words += "; shaded: beyond the limit" if sample.limits else ""
    missing = int((~sample.within).sum())
    words += f"; {missing} beyond the model are not shown" if missing else ""
    with _per_quantity(ax, list(sample.values), words, "Plates as fabricated", _colour_keys(camera)) as (figure, grid):
        for axes, quantity in zip(grid, sample.values, strict=True):
            scale = _scale(quantity)
            colours = sample.colours_of(quantity)
            series = {c: scale * _finite(sample.worst(quantity, c)) for c in colours}
            design = {c: scale * float(nominal.worst(quantity, c)[0]) for c in colours}
            bins = _bins(np.concatenate([*series.values(), _finite(np.array(list(design.values())))]), plates)
            for colour, values in series.items():
                axes.hist(values, bins, histtype="stepfilled", color=hues[colour], alpha=0.15)
                axes.hist(values, bins, histtype="step", color=hues[colour], lw=1.2)
                if math.isfinite(design[colour]):
                    axes.axvline(design[colour], color=hues[colour], ls=":", lw=1.2)
            axes.set_xlim(bins[0], bins[-1])
            _shade(axes, sample.limits, quantity)
            axes.set_ylabel("plates")
            axes.locator_params(axis="y", integer=True)
    return figure


def _finite(values: Float[np.ndarray, " plate"]) -> Float[np.ndarray, " finite"]:
    return values[np.isfinite(values)]


def _bins(values: Float[np.ndarray, " value"], plates: int = 1) -> list[float]:
    """Edges of bins that hold all values, more of them for more plates."""
    if not len(values):
        return [0.0, 1.0]
    low, high = float(values.min()), float(values.max())
    room = max(0.03 * (high - low), 0.002 * max(abs(low), abs(high)), 1e-9)
    return np.linspace(low - room, high + room, round(min(max(2 * plates**0.5, 10), 40)) + 1).tolist()


def _shade(axes: "Axes", limits: Sequence["LimitSpec"], quantity: str) -> None:
    """Shade what lies beyond the limits of a quantity; the view is widened so that the limits are in it."""
    scale, limits = _scale(quantity), [one for one in limits if one.quantity == quantity]
    low, high = axes.get_xlim()
    bounds = [scale * b for one in limits for b in (one.min, one.max) if b is not None]
    room = 0.05 * (high - low)
    low, high = min([low, *(b - room for b in bounds)]), max([high, *(b + room for b in bounds)])
    axes.set_xlim(low, high)
    for limit in limits:
        for bound, edge in ((limit.min, low), (limit.max, high)):
            if bound is not None:
                axes.axvspan(min(scale * bound, edge), max(scale * bound, edge), **_BAD)
                axes.axvline(scale * bound, color=MARK, lw=1.2)


def plot_yield(sample: Sample, ax: "Axes | None" = None) -> "FigureBase":
    """Draw the yield over where the limit of each quantity lies: the share of DOEs whose worst row is as good.

    A limit that concerns a single colour or depth has a curve of its own.
    """
    limits = sample.limits
    chosen = list(dict.fromkeys(one.quantity for one in limits)) or list(sample.values)
    words = f"share of {len(sample.keys)} plates that are good if the limit lies there, with its 95 % confidence"
    if limits:
        words += f"; all limits together: {sample.yield_}"
    with _per_quantity(ax, chosen, words, "Yield over where the limit lies") as (figure, grid):
        for axes, quantity in zip(grid, chosen, strict=True):
            places = {(one.colour, one.depth_m) for one in limits if one.quantity == quantity} or {(None, None)}
            curves = {place: sample.worst(quantity, *place) for place in sorted(places, key=str)}
            edges = _bins(_scale(quantity) * _finite(np.concatenate(list(curves.values()))))
            axes.set_xlim(edges[0], edges[-1])
            _shade(axes, limits, quantity)
            for hue, (where, values) in zip(SERIES, curves.items(), strict=False):
                words = ", ".join([where[0] or "", *([length_text(where[1])] if where[1] is not None else [])])
                _plot_yield_curve(axes, values, quantity, hue, words.removeprefix(", ") or "all")
            sign = "at most" if QUANTITIES[quantity].worse == "high" else "at least"
            axes.set(ylim=(0, 103), ylabel="yield (%)", title=f"{QUANTITIES[quantity].label} {sign} ...")
            axes.grid(True)
            if len(places) > 1:
                axes.legend(loc="best")
    return figure


def _plot_yield_curve(axes: "Axes", values: Float[np.ndarray, " plate"], quantity: str, hue: str, label: str) -> None:
    """Plot the share of DOEs that are as good as a limit, over the whole view."""
    plates, (low, high) = len(values), axes.get_xlim()
    x = np.clip(_scale(quantity) * np.sort(values), low, high)
    if QUANTITIES[quantity].worse == "low":
        x, low, high = x[::-1], high, low
    x = np.array([low, *x, high])
    shares = [yield_of(np.arange(plates) < count) for count in (*range(plates + 1), plates)]
    least, most, share = (np.array([100 * getattr(one, side) for one in shares]) for side in ("low", "high", "share"))
    axes.fill_between(x, least, most, step="post", color=hue, alpha=0.18, lw=0)
    axes.step(x, share, where="post", color=hue, lw=1.4, label=label)


def plot_effects(effects: Sequence[Effect], ax: "Axes | None" = None) -> "FigureBase":
    """Draw the effect of every error alone on the worst row of each quantity, one standard deviation to either side.

    Of more than ten errors, those that matter most to a quantity are shown.
    """
    from matplotlib.lines import Line2D

    worst = [one for one in effects if one.colour is None and math.isfinite(one.expected)]
    quantities = [
        q for q in dict.fromkeys(c.quantity for c in worst) if any(_reach(c) > 0 for c in worst if c.quantity == q)
    ]
    count = min(_MOST_BARS, max((sum(c.quantity == q for c in worst) for q in quantities), default=1))
    words = "worst colour and depth; every error alone, all others at their mean (the line)"
    words += "; hatched: beyond the model" if any(math.isinf(_reach(one)) for one in worst) else ""
    sides = ((_LOWER, "lower"), (_HIGHER, "higher"))
    keys = [Line2D([], [], color=hue, lw=5, label=f"one sigma {side}") for hue, side in sides]
    size = (4.4, 1.1 + 0.17 * count)
    with _per_quantity(ax, quantities, words, "Effect of every error alone", keys, size) as (figure, grid):
        for axes, quantity in zip(grid, quantities, strict=True):
            shown = sorted((c for c in worst if c.quantity == quantity), key=_reach, reverse=True)[:_MOST_BARS]
            _plot_bars(axes, shown, _scale(quantity))
    return figure


def _reach(effect: Effect) -> float:
    """Distance by which an error moves its quantity; infinite where it leaves the model."""
    moved = [abs(value - effect.expected) for value in (effect.low, effect.high) if value is not None]
    return max((one for one in moved if not math.isnan(one)), default=0.0)


def _plot_bars(axes: "Axes", shown: Sequence[Effect], scale: float) -> None:
    expected = scale * shown[0].expected
    ends = [expected]
    for position, effect in enumerate(shown):
        for value, hue, offset in ((effect.low, _LOWER, -0.2), (effect.high, _HIGHER, 0.2)):
            if value is not None and math.isfinite(value):
                axes.barh(position + offset, scale * value - expected, 0.36, expected, color=hue)
                ends.append(scale * value)
    room = 0.06 * (max(ends) - min(ends)) or 0.06 * (abs(expected) or 1.0)
    for position, effect in enumerate(shown):
        for value, hue, offset in ((effect.low, _LOWER, -0.2), (effect.high, _HIGHER, 0.2)):
            if value is not None and math.isinf(value):  # beyond the model: to the end of the axis
                end = (max(ends) if value > 0 else min(ends)) + math.copysign(room, value)
                axes.barh(position + offset, end - expected, 0.36, expected, color=hue, hatch="////", edgecolor="white")
    axes.axvline(expected, color=INK, lw=0.8)
    axes.set(xlim=(min(ends) - room, max(ends) + room), ylim=(len(shown) - 0.4, -0.6))
    axes.set_yticks(range(len(shown)), [error_label(c.error) for c in shown])
    axes.grid(axis="x")


def plot_variance_shares(shares: Sequence[VarianceShare], camera: "Camera", ax: "Axes | None" = None) -> "FigureBase":
    """Draw the share of the variance of each quantity that every source of error causes.

    Bars are the worst row of a DOE: dark what a source causes by itself, light with other sources together. Marks are
    the totals of single colours.
    """
    hues = _hues(camera)
    quantities = list(dict.fromkeys(one.quantity for one in shares))
    sources = [s for s in dict.fromkeys(e.source for e in DEVIATIONS.values()) if any(o.source == s for o in shares)]
    sources += [s for s in dict.fromkeys(one.source for one in shares) if s not in sources]
    words = "Sobol indices of the worst colour and depth: dark alone, light together with others, with 95 % confidence"
    words += "; marks: totals of single colours"
    keys, size = _colour_keys(camera, ls="", marker="|", mew=1.5), (3.75, 1.1 + 0.22 * len(sources))
    with _per_quantity(ax, quantities, words, "Sources of the variance", keys, size) as (figure, grid):
        for axes, quantity in zip(grid, quantities, strict=True):
            for one in (o for o in shares if o.quantity == quantity):
                position = sources.index(one.source)
                if one.colour is not None:
                    below = 0.3 + 0.06 * list(hues).index(one.colour)  # equal ones stay visible
                    axes.plot(100 * one.total.value, position + below, "|", color=hues[one.colour], ms=5, mew=1.5)
                    continue
                axes.barh(position, 100 * one.total.value, 0.5, color=_LOWER, alpha=0.6)
                axes.barh(position, 100 * max(one.first.value, 0.0), 0.5, color=_HIGHER)
                axes.plot([100 * one.total.low, 100 * one.total.high], [position] * 2, color=INK, lw=0.9)
            axes.set_yticks(range(len(sources)), sources)
            axes.set(xlim=(0, 105), ylim=(len(sources) - 0.4, -0.6), xlabel="share of the variance (%)")
            axes.grid(axis="x")
    return figure


def plot_budget(budget: Budget, ax: "Axes | None" = None) -> "Axes":
    """Draw the yield over the size of some errors, and where it is the wanted one; on `ax` or axes of a new figure."""
    share, low, high = (100 * np.array([getattr(y, side) for y in budget.yields]) for side in ("share", "low", "high"))
    words = f"{budget.yields[0].plates} plates per point, 95 % confidence; {budget}"
    with single(ax, (5.0, 3.9), f"How large may {budget.what} errors be?", words) as axes:
        axes.fill_between(budget.factors, low, high, **_BAND)
        fine = np.linspace(0, budget.factors[-1], 201)
        axes.plot(fine, 100 * budget.yield_at(fine), color=LINE)
        axes.plot(budget.factors, share, "o", color=LINE, ms=3.5, clip_on=False)
        axes.axhline(100 * budget.wanted, color=MARK, lw=1.0, ls="--")
        if budget.verdict == "found":
            axes.axvspan(budget.low, budget.high, **_BAD)
            axes.plot(budget.factor, 100 * budget.wanted, "o", color=MARK, ms=6)
        labels = {"xlabel": f"sigma of {budget.what} over that of the process", "ylabel": "yield (%)"}
        axes.set(xlim=(0, budget.factors[-1]), ylim=(0, 103), **labels)
        axes.grid(True)
    return axes
