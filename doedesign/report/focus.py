"""The picture of foci through their distances: how wide, how bright, and the light beside the axis."""

from typing import TYPE_CHECKING

import numpy as np

from fab.figure import LIGHT, LINE, MARK, panels
from fab.units import MM, UM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from doedesign.focus.depth import FocusTable

_DECADE = 10.0


def plot_focus(table: "FocusTable", ax: "Axes | None" = None) -> "FigureBase":
    """Draw the widths of foci beside those wanted, the light on the axis, and profiles."""
    foci, width = table.foci, table.width_m
    worst = "more than 4" if np.isinf(table.worst) else f"{table.worst:.2f}"
    title = f"Foci of at worst {worst} times the width wanted"
    note = (
        "Width at half of the light on the axis. Light on the axis over that of an ideal lens of the same aperture. "
        f"0th order {100 * table.zeroth_order:.2g} %."
    )
    with panels(ax, (9.6, 3.9), title, note) as figure:
        panes = figure.subplots(1, 3, width_ratios=(1.15, 1.0, 1.25))
        for number, colour in enumerate(table.camera.colours):
            own = np.flatnonzero(foci.colour == number)
            own = own[np.argsort(foci.distance_m[own])]
            distance, name = foci.distance_m[own] / MM, f"{colour.name}, " if len(table.camera.colours) > 1 else ""
            line = {"color": None if name else LINE, "marker": "o", "ms": 3, "lw": 1}
            drawn = panes[0].plot(distance, width[own].mean(1) / UM, **line, label=f"{name}as it is")
            shade = drawn[0].get_color()
            # Markers, for a line through a single focus shows nothing.
            wanted = {"color": shade if name else MARK, "marker": "x", "ms": 3, "lw": 1, "ls": ":"}
            panes[0].plot(distance, foci.width_m[own] / UM, **wanted)
            panes[1].plot(distance, 100 * table.strength[own], **(line | {"color": shade}))
            panes[1].plot(distance, 100 * table.share[own], color=shade, marker="o", mfc="none", ms=3, lw=1, ls="--")
        panes[0].set(xlabel="distance (mm)", ylabel="width (µm)")
        panes[0].legend(loc="best", title="×, dotted: wanted")
        panes[1].set(xlabel="distance (mm)", ylabel="%", yscale="log")
        _number_plainly(panes[1])
        panes[1].set_title("● light over an ideal lens's\n○ share within the width wanted", fontsize=7, loc="left")
        if foci.distance_m.max() > 4 * foci.distance_m.min():
            panes[0].set(xscale="log", yscale="log")
            panes[1].set(xscale="log")
        first = np.flatnonzero(foci.colour == foci.colour[0])
        rows = table.light[first].mean(1)
        box = (table.places[0], table.places[-1], 0, len(rows))
        shown = panes[2].imshow(rows, origin="lower", aspect="auto", cmap=LIGHT, vmin=0, vmax=1, extent=box)
        ticks = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), 6)).round().astype(int))
        panes[2].set_yticks(ticks + 0.5, [f"{foci.distance_m[first[k]] / MM:.4g}" for k in ticks])
        panes[2].set(xlabel="from the axis, over the width wanted", ylabel="distance (mm)")
        figure.colorbar(shown, ax=panes[2], label="light over that on the axis", extend="max")
    return figure


def _number_plainly(axes: "Axes") -> None:
    """Number a logarithmic axis y by 9 and 90, not by powers of ten; between these only within one decade."""
    low, high = axes.get_ylim()
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("{x:g}" if high < _DECADE * low else "")
