"""The picture of marks and test structures, all masks over each other."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fab.figure import CHROME, SERIES, single
from fab.units import UM

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fab.layout.geometry import Layer, Shapes
    from fab.layout.part import Part, Photomask

_ZERO, _GLASS = "#5b3a1e", "#f4f7fa"
_WIDTH_IN = 9.0

# x0, y0, x1, y1
_Box = tuple[float, float, float, float]


def plot_part(
    part: "Part", masks: "Sequence[Photomask]", title: str = "", window_m: _Box | None = None, ax: "Axes | None" = None
) -> "Axes":
    """Draw all masks of a part over each other, each in its colour, as in the drawing (polygons filled).

    The legend lists the photomasks. `window_m` is x0, y0, x1, y1 of what is shown; all by default.
    """
    from matplotlib.patches import Patch

    x0, y0, x1, y1 = (edge * part.dbu_m / UM for edge in part.box)
    margin = 0.02 * max(x1 - x0, y1 - y0)
    x0, y0, x1, y1 = x0 - margin, y0 - margin, x1 + margin, y1 + margin
    if window_m is not None:
        x0, y0, x1, y1 = (edge / UM for edge in window_m)
    window = tuple(round(edge * UM / part.dbu_m) for edge in (x0, y0, x1, y1))
    with single(ax, (_WIDTH_IN + 0.8, _WIDTH_IN * (y1 - y0) / (x1 - x0) + 1.1), title) as axes:
        for layer, shapes in part.shapes.items():
            _fill(axes, shapes, window, part.dbu_m, _colour(layer, masks))
        keys = [Patch(color=_colour(mask.on(1), masks), alpha=0.6, label=mask.name) for mask in masks]
        axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", facecolor=_GLASS, xlabel="x (µm)", ylabel="y (µm)")
        axes.legend(handles=keys, loc="lower right", bbox_to_anchor=(1, 1), ncols=len(keys), borderaxespad=0.2)
    return axes


def _colour(layer: "Layer", masks: "Sequence[Photomask]") -> str:
    mask = next(mask for mask in masks if mask.layer == layer.number)
    if mask.bit is not None:
        return SERIES[mask.bit % len(SERIES)]
    return _ZERO if mask.makes == "zero layer" else CHROME


def _fill(axes: "Axes", shapes: "Shapes", window: tuple[int, ...], dbu_m: float, colour: str) -> None:
    """Fill shapes in a window as one outline with holes, since boxes that touch would show hairlines between them."""
    from klayout import db
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    drawn = db.Region()
    for box in shapes.rectangles.tolist():
        drawn.insert(db.Box(*box))
    for polygon in shapes.polygons:
        drawn.insert(db.Polygon([db.Point(x, y) for x, y in polygon.tolist()]))
    outlines = []
    for polygon in (drawn & db.Region(db.Box(*window))).merged().each():
        loops = [polygon.each_point_hull(), *(polygon.each_point_hole(n) for n in range(polygon.holes()))]
        for loop in loops:
            points = np.array([(point.x, point.y) for point in loop]) * (dbu_m / UM)
            outlines.append(Outline(np.concatenate([points, points[:1]]), closed=True))
    if outlines:
        whole = Outline.make_compound_path(*outlines)
        axes.add_artist(PathPatch(whole, facecolor=colour, linewidth=0, alpha=0.6, snap=False))
