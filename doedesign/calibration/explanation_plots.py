"""The picture of what explains a measured ring:disc ratio: the ratio along every error, and explanations in order."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from doedesign.report.labels import error_label, value_text
from fab.figure import INK, LINE, SERIES, SMALL, length_text, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from doedesign.calibration.explanations import Explanation, ExplanationSet

__all__ = ["plot_explanations"]

_ROW = 0.27  # inches of one explanation's row
_MOST_EXPLANATIONS = 14


def plot_explanations(found: "ExplanationSet", ax: "Axes | None" = None) -> "FigureBase":
    """Draw the ring:disc ratio along every error, and the explanations of the measured ratio in order.

    `ax` are axes whose place the picture takes; a new figure by default.
    """
    shown = [*found.singles[:_MOST_EXPLANATIONS], *found.pairs[: _MOST_EXPLANATIONS // 2]]
    targets = found.targets
    title = f"what gives a ring:disc ratio of {targets.ring_to_disc:.3g} at {length_text(targets.depth_m)}"
    with panels(ax, (11.1, max(_ROW * len(shown), 3.4) + 1.6), title, _words(found)) as figure:
        curves, bars = figure.subplots(1, 2, width_ratios=(3.1, 2.2))
        _draw_curves(curves, found)
        _draw_explanations(bars, shown)
    return figure


def _words(found: "ExplanationSet") -> str:
    words = (
        "left: the model's ratio along the errors that change it most, dashed: measured; right: distance of each "
        "explanation from the process's means, in its standard deviations, with the throughput that comes with it"
    )
    throughput = found.targets.throughput
    if throughput is not None:
        words += f"; full bars: throughput within two standard deviations of the {100 * throughput:.3g} % measured"
    alone = list(map(error_label, found.unreached))
    return words + (f"; none within {found.reach:g} standard deviations: {'; '.join(alone)}" if alone else "")


def _draw_curves(axes: "Axes", found: "ExplanationSet") -> None:
    reached = list(dict.fromkeys(name for each in found.singles for name in each.scores))[: 2 * len(SERIES)]
    # Besides those that explain it, those that change it most.
    others = sorted(found.curves, key=lambda name: -np.ptp(np.log(found.curves[name].ring_to_disc)))
    shown = list(dict.fromkeys([*reached, *others]))[: max(len(reached), len(SERIES))]
    for i, name in enumerate(shown):
        curve = found.curves[name]
        style = "-" if i < len(SERIES) else ":"
        label = error_label(name)
        axes.plot(curve.scores, curve.ring_to_disc, style, color=SERIES[i % len(SERIES)], marker=".", label=label)
    axes.axhline(found.targets.ring_to_disc, color=INK, ls="--", lw=1)
    axes.set_xlabel("error, standard deviations of the process")
    axes.set_ylabel("ring:disc ratio")
    axes.grid(True)
    axes.legend(loc="best", fontsize=SMALL - 1)


def _draw_explanations(axes: "Axes", shown: "Sequence[Explanation]") -> None:
    rows = np.arange(len(shown))[::-1]
    if not shown:
        axes.text(0.5, 0.5, "none", ha="center", va="center", transform=axes.transAxes)
    for row, each in zip(rows, shown, strict=True):
        full = each.fits is not False
        axes.barh(row, each.distance, 0.6, color=LINE if full else "white", ec=LINE, lw=1.0)
        words = f"{100 * each.throughput:.1f} %"
        axes.annotate(words, (1.03, row), xycoords=("axes fraction", "data"), va="center", fontsize=SMALL)
    labels = [" + ".join(f"{error_label(n)} {value_text(n, v)}" for n, v in each.values.items()) for each in shown]
    axes.set_yticks(rows, labels, fontsize=SMALL - 1)
    axes.set_ylim(-0.6, max(len(shown), 1) - 0.4)
    axes.set_xlabel("standard deviations")
    axes.annotate("throughput", (1.03, 1.02), xycoords="axes fraction", fontsize=SMALL)
