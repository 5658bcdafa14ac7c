"""What a process makes of a design: histograms, yield, which errors matter, and how large they may be.

Every quantity has a panel of its own. "Worst" is the worst of a plate's colours and depths, which decides whether the
plate is good.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from doedesign.report.canvas import (
    FAINT,
    INK,
    LINE,
    MARK,
    SERIES,
    colour_label,
    length_text,
    line_colours,
    note,
    picture,
    place,
    wrapped,
)
from doedesign.tolerancing.analysis import QUANTITIES, PlateTable, Yield, good_plates, yield_of
from doedesign.tolerancing.budget import Budget
from doedesign.tolerancing.sensitivity import Change, Share
from fab.process import DEVIATIONS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

    from doedesign.spec import LimitSpec
    from sim.camera import Camera

_MOST_BARS = 10
_COLUMNS = 3
# Inches: a panel, room at its left and right, below it and above, and for the words under the picture.
_WIDE, _HIGH, _LEFT, _RIGHT, _BELOW, _ABOVE = 2.6, 1.7, 0.6, 0.15, 0.5, 0.3
_LOWER, _HIGHER = "#56b4e9", LINE
_BAND = {"color": LINE, "alpha": 0.18, "lw": 0}
_BAD = {"color": MARK, "alpha": 0.08, "lw": 0}


def error_label(name: str) -> str:
    """An error in words: "overlay x, mask 2" for "overlay_x_m[2]"."""
    key, _, mask = name.partition("[")
    words = key.removesuffix("_m").removesuffix("_rad").replace("_", " ")
    return f"{words}, mask {mask.removesuffix(']')}" if mask else words


def _scale(quantity: str) -> float:
    return 100.0 if QUANTITIES[quantity].share else 1.0


def _axis_label(quantity: str) -> str:
    return QUANTITIES[quantity].label + (" (%)" if QUANTITIES[quantity].share else "")


@contextmanager
def _panels(
    path: str | Path,
    quantities: Sequence[str],
    words: str,
    marks: Sequence["Line2D"] = (),
    left: float = _LEFT,
    high: float = _HIGH,
) -> "Iterator[list[Axes]]":
    """A picture with one panel per quantity; below, what the marks mean, and words."""
    columns = max(min(len(quantities), _COLUMNS), 1)
    rows = math.ceil(len(quantities) / columns)
    across = columns * (left + _WIDE + _RIGHT)
    text = wrapped(words, across - 0.3)
    lines = 0.15 * (text.count("\n") + 1)
    foot = 0.15 + lines + (0.2 if marks else 0.0)
    up = foot + rows * (_BELOW + high + _ABOVE)
    with picture(path, (across, up)) as figure:
        if marks:
            at = {"loc": "lower left", "bbox_to_anchor": (0.15 / across, (0.15 + lines) / up), "borderaxespad": 0.0}
            figure.legend(handles=marks, ncols=len(marks), borderpad=0.0, columnspacing=1.2, **at)
        axes = []
        for i, quantity in enumerate(quantities):
            row, column = divmod(i, columns)
            bottom = foot + (rows - 1 - row) * (_BELOW + high + _ABOVE) + _BELOW
            axes.append(place(figure, left + column * (left + _WIDE + _RIGHT), bottom, _WIDE, high))
            axes[-1].set_xlabel(_axis_label(quantity), labelpad=2)
            axes[-1].tick_params(length=2.5)
            axes[-1].ticklabel_format(useOffset=False)
        yield axes
        note(figure, 0.15, 0.1, text)


def _marks(camera: "Camera", **look: Any) -> "list[Line2D]":
    """A line or mark for every colour."""
    from matplotlib.lines import Line2D

    hues = zip(camera.colours, line_colours(camera.colours), strict=True)
    return [Line2D([], [], color=hue, label=colour_label(colour), **look) for colour, hue in hues]


def draw_histograms(
    path: str | Path, camera: "Camera", table: PlateTable, nominal: PlateTable, limits: Sequence["LimitSpec"] = ()
) -> None:
    """Draw how every quantity is distributed over the plates: a line per colour, the worst depth of each plate.

    Args:
        path: the PNG file.
        camera: the colours.
        table: the plates.
        nominal: the plate exactly as drawn, dotted.
        limits: what a good plate obeys; the side beyond is shaded.

    Raises:
        InputError: the system refuses the path.
    """
    hues = dict(zip((c.name for c in camera.colours), line_colours(camera.colours), strict=True))
    words = f"{len(table.keys)} plates, the worst depth of each; dotted: the plate as drawn"
    words += "; shaded: beyond the limit" if limits else ""
    missing = int((~table.within).sum())
    words += f"; {missing} beyond the model are not shown" if missing else ""
    with _panels(path, list(table.values), words, _marks(camera)) as panels:
        for axes, quantity in zip(panels, table.values, strict=True):
            scale = _scale(quantity)
            series = {c: scale * _finite(table.worst(quantity, c)) for c in table.colours}
            design = {c: scale * float(nominal.worst(quantity, c)[0]) for c in table.colours}
            bins = _bins(np.concatenate([*series.values(), _finite(np.array(list(design.values())))]), len(table.keys))
            for colour, values in series.items():
                axes.hist(values, bins, histtype="stepfilled", color=hues[colour], alpha=0.15)
                axes.hist(values, bins, histtype="step", color=hues[colour], lw=1.2)
                if math.isfinite(design[colour]):
                    axes.axvline(design[colour], color=hues[colour], ls=":", lw=1.2)
            axes.set_xlim(bins[0], bins[-1])
            _shade(axes, [one for one in limits if one.quantity == quantity], scale)
            axes.set_ylabel("plates", labelpad=2)
            axes.locator_params(axis="y", integer=True)
            axes.set_title(QUANTITIES[quantity].label)


def _finite(values: Float[np.ndarray, " plate"]) -> Float[np.ndarray, " finite"]:
    return values[np.isfinite(values)]


def _bins(values: Float[np.ndarray, " value"], plates: int = 1) -> list[float]:
    """Edges of bins that hold all values, more of them for more plates."""
    if not len(values):
        return [0.0, 1.0]
    low, high = float(values.min()), float(values.max())
    room = max(0.03 * (high - low), 0.002 * max(abs(low), abs(high)), 1e-9)
    return np.linspace(low - room, high + room, round(min(max(2 * plates**0.5, 10), 40)) + 1).tolist()


def _shade(axes: "Axes", limits: Sequence["LimitSpec"], scale: float) -> None:
    """Shade what lies beyond limits; the view is widened so that the limits are in it."""
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


def draw_yield(path: str | Path, table: PlateTable, limits: Sequence["LimitSpec"] = ()) -> None:
    """Draw the yield over where the limit of each quantity lies: its share of plates whose worst row is as good.

    Args:
        path: the PNG file.
        table: the plates.
        limits: the limits as they are; one that concerns a single colour or depth has a curve of its own.

    Raises:
        InputError: a limit that speaks of no row, or the system refuses the path.
    """
    chosen = list(dict.fromkeys(one.quantity for one in limits)) or list(table.values)
    words = f"share of {len(table.keys)} plates that are good if the limit lies there, with its 95 % confidence"
    if limits:
        words += f"; all limits together: {yield_of(good_plates(table, limits))}"
    with _panels(path, chosen, words) as panels:
        for axes, quantity in zip(panels, chosen, strict=True):
            places = {(one.colour, one.depth_m) for one in limits if one.quantity == quantity} or {(None, None)}
            curves = {place: table.worst(quantity, *place) for place in sorted(places, key=str)}
            edges = _bins(_scale(quantity) * _finite(np.concatenate(list(curves.values()))))
            axes.set_xlim(edges[0], edges[-1])
            _shade(axes, [one for one in limits if one.quantity == quantity], _scale(quantity))
            for hue, (where, values) in zip(SERIES, curves.items(), strict=False):
                _plot_yield(axes, values, quantity, hue, limit_place(*where) if len(places) > 1 else "")
            axes.set_ylim(0, 103)
            axes.set_ylabel("yield (%)", labelpad=2)
            axes.grid(color=FAINT, lw=0.4, alpha=0.5)
            sign = "at most" if QUANTITIES[quantity].worse == "high" else "at least"
            axes.set_title(f"{QUANTITIES[quantity].label} {sign} ...")
            if len(places) > 1:
                axes.legend(loc="best")


def limit_place(colour: str | None, depth_m: float | None) -> str:
    """Which rows a limit concerns, in words."""
    return ", ".join([*([colour] if colour else []), *([length_text(depth_m)] if depth_m is not None else [])]) or "all"


def _plot_yield(axes: "Axes", values: Float[np.ndarray, " plate"], quantity: str, hue: str, label: str) -> None:
    """Plot the share of plates that are as good as a limit, over the whole view."""
    plates, (low, high) = len(values), axes.get_xlim()
    x = np.clip(_scale(quantity) * np.sort(values), low, high)
    if QUANTITIES[quantity].worse == "low":
        x, low, high = x[::-1], high, low
    x = np.array([low, *x, high])
    shares = [yield_of(np.arange(plates) < count) for count in (*range(plates + 1), plates)]
    least, most, share = (np.array([100 * getattr(one, side) for one in shares]) for side in ("low", "high", "share"))
    axes.fill_between(x, least, most, step="post", color=hue, alpha=0.18, lw=0)
    axes.step(x, share, where="post", color=hue, lw=1.4, label=label)


def draw_changes(path: str | Path, changes: Sequence[Change]) -> None:
    """Draw what every error does alone to the worst row of each quantity, one standard deviation to either side.

    Of more than ten errors, those that matter most to a quantity are shown.

    Args:
        path: the PNG file.
        changes: as `doedesign.tolerancing.sensitivity.one_at_a_time` gives them.

    Raises:
        InputError: the system refuses the path.
    """
    from matplotlib.lines import Line2D

    worst = [one for one in changes if one.colour is None and math.isfinite(one.expected)]
    quantities = [
        q for q in dict.fromkeys(c.quantity for c in worst) if any(_reach(c) > 0 for c in worst if c.quantity == q)
    ]
    count = min(_MOST_BARS, max((sum(c.quantity == q for c in worst) for q in quantities), default=1))
    words = "worst colour and depth; every error alone, all others at their mean (the line)"
    marks = [
        Line2D([], [], color=hue, lw=5, label=f"one sigma {side}")
        for hue, side in ((_LOWER, "lower"), (_HIGHER, "higher"))
    ]
    with _panels(path, quantities, words, marks, left=1.65, high=0.35 + 0.17 * count) as panels:
        for axes, quantity in zip(panels, quantities, strict=True):
            shown = sorted((c for c in worst if c.quantity == quantity), key=_reach, reverse=True)[:_MOST_BARS]
            _plot_changes(axes, shown, _scale(quantity))
            axes.set_title(QUANTITIES[quantity].label)


def _reach(change: Change) -> float:
    """How far an error moves its quantity."""
    moved = (abs(value - change.expected) for value in (change.low, change.high) if value is not None)
    return max((one for one in moved if math.isfinite(one)), default=0.0)


def _plot_changes(axes: "Axes", shown: Sequence[Change], scale: float) -> None:
    expected = scale * shown[0].expected
    ends = [expected]
    for position, change in enumerate(shown):
        for value, hue, offset in ((change.low, _LOWER, -0.2), (change.high, _HIGHER, 0.2)):
            if value is not None and math.isfinite(value):
                axes.barh(position + offset, scale * value - expected, 0.36, expected, color=hue)
                ends.append(scale * value)
    room = 0.06 * (max(ends) - min(ends))
    axes.axvline(expected, color=INK, lw=0.8)
    axes.set_xlim(min(ends) - room, max(ends) + room)
    axes.set_yticks(range(len(shown)), [error_label(c.error) for c in shown])
    axes.set_ylim(len(shown) - 0.4, -0.6)
    axes.grid(axis="x", color=FAINT, lw=0.4, alpha=0.5)


def draw_shares(path: str | Path, camera: "Camera", shares: Sequence[Share]) -> None:
    """Draw which share of the variance of each quantity every source of error causes.

    Bars are the worst row of a plate: dark what a source causes by itself, light with other sources together. Marks are
    the totals of single colours.

    Args:
        path: the PNG file.
        camera: the colours.
        shares: as `doedesign.tolerancing.sensitivity.sobol` gives them.

    Raises:
        InputError: the system refuses the path.
    """
    hues = dict(zip((c.name for c in camera.colours), line_colours(camera.colours), strict=True))
    quantities = list(dict.fromkeys(one.quantity for one in shares))
    sources = [s for s in dict.fromkeys(e.source for e in DEVIATIONS.values()) if any(o.source == s for o in shares)]
    sources += [s for s in dict.fromkeys(one.source for one in shares) if s not in sources]
    words = "Sobol indices of the worst colour and depth: dark alone, light together with others, with 95 % confidence"
    words += "; marks: totals of single colours"
    marks = _marks(camera, ls="", marker="|", mew=1.5)
    with _panels(path, quantities, words, marks, left=1.0, high=0.35 + 0.22 * len(sources)) as panels:
        for axes, quantity in zip(panels, quantities, strict=True):
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
            axes.set_ylim(len(sources) - 0.4, -0.6)
            axes.set_xlim(0, 105)
            axes.grid(axis="x", color=FAINT, lw=0.4, alpha=0.5)
            axes.set_xlabel("share of the variance (%)", labelpad=2)
            axes.set_title(QUANTITIES[quantity].label)


def draw_budget(path: str | Path, budget: Budget) -> None:
    """Draw the yield over the size of some errors, and where it is the wanted one.

    Args:
        path: the PNG file.
        budget: the budget.

    Raises:
        InputError: the system refuses the path.
    """
    yields: Callable[[Callable[[Yield], float]], list[float]] = lambda side: [  # noqa: E731
        100 * side(one) for one in budget.yields
    ]
    shares, low, high = yields(lambda y: y.share), yields(lambda y: y.low), yields(lambda y: y.high)
    words = wrapped(f"{budget.yields[0].plates} plates per point, 95 % confidence; {budget}", 4.6)
    foot = 0.6 + 0.15 * (words.count("\n") + 1)
    with picture(path, (5.0, foot + 2.9)) as figure:
        axes = place(figure, 0.65, foot, 4.2, 2.55)
        axes.fill_between(budget.factors, low, high, **_BAND)
        fine = np.linspace(0, budget.factors[-1], 201)
        axes.plot(fine, 100 * budget.yield_at(fine), color=LINE)
        axes.plot(budget.factors, shares, "o", color=LINE, ms=3.5, clip_on=False)
        axes.axhline(100 * budget.wanted, color=MARK, lw=1.0, ls="--")
        if budget.verdict == "found":
            axes.axvspan(budget.low, budget.high, **_BAD)
            axes.plot(budget.factor, 100 * budget.wanted, "o", color=MARK, ms=6)
        axes.set_xlim(0, budget.factors[-1])
        axes.set_ylim(0, 103)
        axes.grid(color=FAINT, lw=0.4, alpha=0.5)
        axes.set_xlabel(f"sigma of {budget.what} over that of the process", labelpad=2)
        axes.set_ylabel("yield (%)")
        axes.set_title(f"How large may {budget.what} errors be?")
        note(figure, 0.15, 0.1, words)
