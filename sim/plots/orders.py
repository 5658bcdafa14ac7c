"""The picture of a certificate: rows as thin elements and with edges against Maxwell's equations."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fab.figure import FAINT, INK, LINE, MARK, panels
from fab.units import NM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from sim.rigorous.certificate import CertifiedRow

_KINDS = (("scalar", "thin element", MARK, "o"), ("edges", "with edges", LINE, "s"))
_SHOWN = 2  # wavelengths


def plot_certificate(rows: "Sequence[CertifiedRow]", name: str = "", ax: "Axes | None" = None) -> "FigureBase":
    """Draw how far every row is off, and the orders of the row of each wavelength where a thin element is worst.

    Of more than two wavelengths the shortest and the longest are shown. A ValueError for no rows.
    """
    if not rows:
        raise ValueError("`rows` must not be empty")
    wavelengths = sorted({one.wavelength_m for one in rows})
    shown = wavelengths if len(wavelengths) <= _SHOWN else [wavelengths[0], wavelengths[-1]]
    title = f"{name}: light at its walls".lstrip(": ")
    note = (
        "Rows cut out of the design, solved as gratings that repeat by coupled waves. Off: root of the summed squares "
        "of differences of all orders in the band, over that of the rigorous orders; circles and squares are means of "
        "TE and TM, bars reach from one to the other."
    )
    with panels(ax, (8.6, 2.3 + 2.3 * len(shown)), title, note) as figure:
        grid = figure.subplots(1 + len(shown), 1, height_ratios=[1.15] + [1.0] * len(shown))
        _plot_errors(grid[0], rows, wavelengths)
        for axes, wavelength in zip(grid[1:], shown, strict=True):
            own = [one for one in rows if one.wavelength_m == wavelength]
            _plot_orders(axes, max(own, key=lambda one: one.orders.error(one.orders.scalar).max()))
    return figure


def _plot_errors(axes: "Axes", rows: "Sequence[CertifiedRow]", wavelengths: Sequence[float]) -> None:
    places = np.arange(len(rows))
    ordered = sorted(rows, key=lambda one: one.wavelength_m)
    for kind, label, hue, marker in _KINDS:
        errors = np.array([100 * one.orders.error(getattr(one.orders, kind)) for one in ordered])
        axes.vlines(places, errors.min(1), errors.max(1), color=hue, lw=1.2)
        axes.plot(places, errors.mean(1), marker, color=hue, ms=3.5, label=label)
    starts = [next(i for i, one in enumerate(ordered) if one.wavelength_m == w) for w in wavelengths]
    for start in starts[1:]:
        axes.axvline(start - 0.5, color=FAINT, lw=0.8)
    middles = [(a + b - 1) / 2 for a, b in zip(starts, [*starts[1:], len(rows)], strict=True)]
    axes.set_xticks(middles, [f"{w / NM:.0f} nm" for w in wavelengths])
    axes.set(yscale="log", ylabel="off by (%)", xlim=(-0.7, len(rows) - 0.3))
    axes.grid(True, axis="y")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.2, ncols=2)


def _plot_orders(axes: "Axes", one: "CertifiedRow") -> None:
    orders = one.orders
    style: dict[str, Any] = {"ls": "", "ms": 5}
    axes.bar(orders.number, 100 * orders.rigorous.mean(0), 0.8, color=FAINT, alpha=0.6, label="rigorous")
    axes.plot(orders.number, 100 * orders.scalar, "o", color=MARK, mfc="none", label="thin element", **style)
    axes.plot(orders.number, 100 * orders.edges.mean(0), "+", color=LINE, label="with edges", **style)
    axes.set(xlabel="order", ylabel="share of the light (%)")
    radius = np.hypot(*one.row.centre_m)
    words = f"{one.wavelength_m / NM:.0f} nm, unpolarised, along {one.row.axis}, {1e3 * radius:.2f} mm from the axis"
    axes.set_title(words, color=INK)
    axes.legend(loc="upper right")
