"""The picture of an area of light: a map of it, and profiles through its middle."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fab.figure import DPI, LIGHT, LINE, MARK, panels, shrunk
from fab.units import MICROMETRES
from sim.plots.places import label_places, size_text, unit_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from doedesign.areas.shape import AreaTable

_SIDE = 3.4  # inches of the map
_TOP = 1.4  # end of the colour scale, over the brightest light wanted: speckle is a few times brighter
_LEGEND = 1.35  # height of the axis of profiles over that of their light: the legend lies above them
_TICKS = 5


_NOTE = "Shares of the incident light; {:.1f} % that faces reflect are left out. Contrast: root mean square where 90 % "
_NOTE += "of the light is wanted."


def plot_areas(tables: "Sequence[AreaTable]", ax: "Axes | None" = None) -> "FigureBase":
    """Draw several areas below each other, as `plot_area` does each, over the colour and the place of each."""
    note = _NOTE.format(100 * (1 - tables[0].fresnel))
    with panels(ax, (8.6, 4.1 * len(tables) + 0.35), "Light of every area", note) as figure:
        parts = figure.subfigures(len(tables), 1, squeeze=False)
        for table, part in zip(tables, parts[:, 0], strict=True):
            part.suptitle(f"{table.place}: {_title(table)}", x=0.01, ha="left", parse_math=False)
            _draw(table, part)
    return figure


def plot_area(table: "AreaTable", ax: "Axes | None" = None) -> "FigureBase":
    """Draw the light of an area over that of its flat part, and its profiles beside the wanted ones."""
    zeroth = f"0th order {100 * table.zeroth_order:.2g} %{table.zeroth_order_note}."
    note = f"{_NOTE.format(100 * (1 - table.fresnel))} {zeroth}"
    note += f" {table.wave}." if table.wave else ""
    with panels(ax, (5.2 if table.along_x is None else 8.6, 4.2), _title(table), note) as figure:
        _draw(table, figure)
    return figure


def _title(table: "AreaTable") -> str:
    """Efficiency and contrast of an area."""
    title = f"{100 * table.efficiency:.1f} % of the light, contrast {100 * table.contrast:.2g} %"
    if table.pixel_contrast is not None:
        pixels = size_text(table.camera.in_angles, table.camera.pixel_m)
        title += f" ({100 * table.pixel_contrast:.2g} % on pixels of {pixels})"
    return title


def _draw(table: "AreaTable", figure: "FigureBase") -> None:
    """Draw an area and its profiles side by side."""
    target, camera, unit = table.target, table.camera, unit_of(table.camera)
    profiles = [(name, p) for name, p in (("x", table.along_x), ("y", table.along_y)) if p is not None]
    y, _ = camera.image_m(target.sines_y, 0.0)
    _, x = camera.image_m(0.0, target.sines_x)
    box = [end / unit.scale for end in (x[0], x[-1], y[0], y[-1])]
    panes = np.atleast_1d(figure.subplots(1, 2 if profiles else 1, width_ratios=(1.0, 1.15)[: 1 + bool(profiles)]))
    image = shrunk(table.light.astype(np.float32), round(_SIDE * DPI))
    brightest = float(target.wanted.max() / target.wanted[target.flat].mean())  # a picture has parts of its own
    shown = panes[0].imshow(image, origin="lower", extent=box, vmin=0, vmax=_TOP * brightest, cmap=LIGHT)
    label_places(panes[0], unit)
    wide, high = box[1] - box[0], box[3] - box[2]
    for axis, share in (("x", wide / max(wide, high)), ("y", high / max(wide, high))):
        panes[0].locator_params(axis, nbins=max(1, round(_TICKS * share)), min_n_ticks=1)  # a line is narrow
    figure.colorbar(shown, ax=panes[0], label="light over that inside", shrink=0.8, extend="max")
    for (name, profile), colour in zip(profiles, (LINE, MARK), strict=False):
        size, place = profile.size_m, profile.in_unit(profile.place_m, MICROMETRES)
        words = "" if size is None else f": {profile.in_unit(size, MICROMETRES):.5g} {unit.name}"
        label = f"along {name}{words}"
        panes[1].plot(place, profile.light, color=colour, lw=1, label=label)
        panes[1].plot(place, profile.wanted, color=colour, lw=0.8, ls=":")
    if profiles:
        top = _LEGEND * max(1.0, *(p.light.max() for _, p in profiles))
        panes[1].set(xlabel=f"from the middle ({unit.name})", ylim=(0, top))
        panes[1].legend(loc="upper right", title="size at half the light; dots: wanted")
