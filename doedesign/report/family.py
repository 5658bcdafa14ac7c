"""What would explain a measured ring:disc ratio: the ratio along every error, and the explanations in order."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from doedesign.report.calibration import value_text
from doedesign.report.canvas import FAINT, INK, LINE, SERIES, SMALL, length_text, note, picture, place, wrapped
from doedesign.report.tolerance import error_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from doedesign.calibration import Explanation, Family

_ROW = 0.27  # inches of one explanation's row
_MOST_EXPLANATIONS = 14


def draw_family(path: str | Path, family: "Family") -> None:
    """Draw what explains a measured ring:disc ratio: the ratio along every error, and the explanations in order.

    Args:
        path: the PNG file.
        family: the explanations.

    Raises:
        InputError: the system refuses the path.
    """
    targets = family.targets
    shown = [*family.singles[:_MOST_EXPLANATIONS], *family.pairs[: _MOST_EXPLANATIONS // 2]]
    high = max(_ROW * len(shown), 3.4)
    depth = length_text(targets.depth_m)
    title = f"what gives a ring:disc ratio of {targets.ring_to_disc:.3g} at {depth}"
    words = (
        "left: the model's ratio along the errors that change it most, dashed: measured; right: distance of each "
        "explanation from the process's means, in its standard deviations, with the throughput that comes with it"
    )
    if targets.throughput is not None:
        words += (
            f"; full bars: throughput within two standard deviations of the {100 * targets.throughput:.3g} % measured"
        )
    if family.none:
        alone = [error_label(one[0]) for one in family.none if len(one) == 1]
        words += f"; none within {family.reach:g} standard deviations: {'; '.join(alone)}" if alone else ""
    text = wrapped(words, 10.6)
    foot = 0.65 + 0.15 * (text.count("\n") + 1)
    with picture(path, (11.1, foot + high + 0.6), title) as figure:
        _draw_curves(place(figure, 0.65, foot, 3.1, high), family)
        _draw_explanations(place(figure, 8.0, foot, 2.2, high), family, shown)
        note(figure, 0.15, 0.1, text)


def _draw_curves(axes: "Axes", family: "Family") -> None:
    reached = list(dict.fromkeys(name for each in family.singles for name in each.scores))[: 2 * len(SERIES)]
    # Besides those that explain it, those that change it most.
    others = sorted(family.curves, key=lambda name: -np.ptp(np.log(family.curves[name].ring_to_disc)))
    shown = list(dict.fromkeys([*reached, *others]))[: max(len(reached), len(SERIES))]
    for i, name in enumerate(shown):
        curve = family.curves[name]
        style = "-" if i < len(SERIES) else ":"
        label = error_label(name)
        axes.plot(curve.scores, curve.ring_to_disc, style, color=SERIES[i % len(SERIES)], marker=".", label=label)
    axes.axhline(family.targets.ring_to_disc, color=INK, ls="--", lw=1)
    axes.set_xlabel("error, standard deviations of the process", labelpad=2)
    axes.set_ylabel("ring:disc ratio", labelpad=2)
    axes.grid(color=FAINT, lw=0.4, alpha=0.5)
    axes.legend(loc="best", fontsize=SMALL - 1)


def _draw_explanations(axes: "Axes", family: "Family", shown: "Sequence[Explanation]") -> None:
    rows = np.arange(len(shown))[::-1]
    if not shown:
        axes.text(0.5, 0.5, "none", ha="center", va="center", transform=axes.transAxes)
    for row, each in zip(rows, shown, strict=True):
        fits = each.fits is not False
        axes.barh(row, each.distance, 0.6, color=LINE if fits else "white", ec=LINE, lw=1.0)
        axes.annotate(
            f"{100 * each.throughput:.1f} %",
            (1.03, row),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=SMALL,
        )
    labels = [" + ".join(f"{error_label(n)} {value_text(n, v)}" for n, v in each.values.items()) for each in shown]
    axes.set_yticks(rows, labels, fontsize=SMALL - 1)
    axes.set_ylim(-0.6, max(len(shown), 1) - 0.4)
    axes.set_xlabel("standard deviations", labelpad=2)
    axes.annotate("throughput", (1.03, 1.02), xycoords="axes fraction", fontsize=SMALL)
    axes.tick_params(length=2.5)
