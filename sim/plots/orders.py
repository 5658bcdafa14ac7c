"""The picture of a certificate: rows and squares as thin elements and with edges against Maxwell's equations."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fab.figure import FAINT, INK, LINE, MARK, panels
from fab.units import NM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from sim.rigorous.certificate import CertifiedPiece, CertifiedRow

_KINDS = (("scalar", "thin element", MARK, "o"), ("edges", "with edges", LINE, "s"))
_SHOWN = 2  # wavelengths


def plot_certificate(
    rows: "Sequence[CertifiedRow]",
    name: str = "",
    ax: "Axes | None" = None,
    *,
    pieces: "Sequence[CertifiedPiece]" = (),
) -> "FigureBase":
    """Draw how far every row and square is off, and the orders of the ones of each wavelength where thin is worst.

    Of more than two wavelengths the shortest and the longest are shown. A ValueError for no rows.
    """
    if not rows:
        raise ValueError("`rows` must not be empty")
    wavelengths = sorted({one.wavelength_m for one in rows})
    shown = wavelengths if len(wavelengths) <= _SHOWN else [wavelengths[0], wavelengths[-1]]
    title = f"{name}: light at its walls".lstrip(": ")
    note = (
        "Parts cut out of the design, solved as gratings that repeat, by Maxwell's equations; squares of more than 2 x "
        "2 cells are continued by mirrors. Off: root of the summed squares of differences of all orders in the band, "
        "over that of the rigorous orders; circles and squares are means of both polarisations, bars reach from one to "
        "the other."
    )
    with panels(ax, (8.6, 2.3 + 2.3 * len(shown)), title, note) as figure:
        ratios = [1.15] + [1.0] * len(shown)
        widths = [len(rows), max(0.4 * len(rows), len(pieces))]
        grid = figure.subplots(
            len(ratios),
            2 if pieces else 1,
            squeeze=False,
            height_ratios=ratios,
            width_ratios=widths if pieces else None,
        )
        _plot_errors(grid[0, 0], rows, wavelengths)
        if pieces:
            _plot_errors(grid[0, 1], pieces, wavelengths)
            ny, nx = pieces[0].piece.height_m.shape
            grid[0, 0].set_title(f"rows of up to {max(len(one.row.height_m) for one in rows)} cells", loc="right")
            grid[0, 1].set(title=f"squares of {ny} x {nx} cells", ylabel="")
            grid[0, 1].sharey(grid[0, 0])
            grid[0, 0].autoscale(axis="y")
            grid[0, 1].tick_params(axis="y", which="both", labelleft=False)
            grid[0, 1].get_legend().remove()
        for line, wavelength in zip(grid[1:], shown, strict=True):
            _plot_orders(line[0], _worst([one for one in rows if one.wavelength_m == wavelength]))
            if pieces:
                _plot_piece_orders(line[1], _worst([one for one in pieces if one.wavelength_m == wavelength]))
    return figure


def _worst(found: "Sequence[Any]") -> Any:
    return max(found, key=lambda one: one.orders.error(one.orders.scalar).max())


def _plot_errors(axes: "Axes", found: "Sequence[CertifiedRow | CertifiedPiece]", wavelengths: Sequence[float]) -> None:
    places = np.arange(len(found))
    ordered = sorted(found, key=lambda one: one.wavelength_m)
    for kind, label, hue, marker in _KINDS:
        errors = np.array([100 * one.orders.error(getattr(one.orders, kind)) for one in ordered])
        axes.vlines(places, errors.min(1), errors.max(1), color=hue, lw=1.2)
        axes.plot(places, errors.mean(1), marker, color=hue, ms=3.5, label=label)
    starts = [next(i for i, one in enumerate(ordered) if one.wavelength_m == w) for w in wavelengths]
    for start in starts[1:]:
        axes.axvline(start - 0.5, color=FAINT, lw=0.8)
    middles = [(a + b - 1) / 2 for a, b in zip(starts, [*starts[1:], len(found)], strict=True)]
    axes.set_xticks(middles, [f"{w / NM:.0f} nm" for w in wavelengths])
    axes.set(yscale="log", ylabel="off by (%)", xlim=(-0.7, len(found) - 0.3))
    axes.grid(True, axis="y")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.2, ncols=2)


def _plot_orders(axes: "Axes", one: "CertifiedRow") -> None:
    orders = one.orders
    _plot_shares(axes, orders.number, orders.scalar, orders.edges.mean(0), orders.rigorous.mean(0))
    axes.set(xlabel="order", ylabel="share of the light (%)")
    radius = np.hypot(*one.row.centre_m)
    words = f"{one.wavelength_m / NM:.0f} nm, unpolarised, along {one.row.axis}, {1e3 * radius:.2f} mm from the axis"
    axes.set_title(words, color=INK)
    axes.set_ylim(top=1.25 * axes.get_ylim()[1])  # for the legend
    axes.legend(loc="upper right", ncols=3)


def _plot_piece_orders(axes: "Axes", one: "CertifiedPiece") -> None:
    """Draw all orders of a square side by side, those of one number along y together."""
    orders = one.orders
    ny, nx = orders.scalar.shape
    places = (np.arange(ny)[:, None] * (nx + 1) + np.arange(nx)).ravel()
    kinds = (orders.scalar, orders.edges.mean(0), orders.rigorous.mean(0))
    _plot_shares(axes, places, *(kind.ravel() for kind in kinds))
    middles = np.arange(ny) * (nx + 1) + nx // 2
    axes.set_xticks(middles, [f"{number:d}" for number in range(-(ny // 2), ny // 2 + 1)])
    axes.set_xlabel(f"order along y, of each {-(nx // 2)} ... {nx // 2} along x")
    axes.set_title(f"{1e3 * np.hypot(*one.piece.centre_m):.2f} mm from the axis", color=INK)


def _plot_shares(axes: "Axes", places: np.ndarray, scalar: np.ndarray, edges: np.ndarray, rigorous: np.ndarray) -> None:
    style: dict[str, Any] = {"ls": "", "ms": 5}
    axes.bar(places, 100 * rigorous, 0.8, color=FAINT, alpha=0.6, label="rigorous")
    axes.plot(places, 100 * scalar, "o", color=MARK, mfc="none", label="thin element", **style)
    axes.plot(places, 100 * edges, "+", color=LINE, label="with edges", **style)
