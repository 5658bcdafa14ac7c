"""Pictures of marks and test structures: all masks over each other, and what the operator of an aligner sees."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from doedesign.report.canvas import CHROME, INK, SERIES, picture
from fab.layout.geometry import Layer
from fab.layout.part import Part, Photomask
from fab.units import UM

if TYPE_CHECKING:
    from klayout import db
    from matplotlib.axes import Axes

__all__ = ["draw_part", "draw_view"]

_ZERO = "#5b3a1e"
_GLASS = "#f4f7fa"
_PLATE = "#2b2d31"
_WIDTH_IN = 9.0


def _colour(layer: Layer, plates: Sequence[Photomask]) -> str:
    plate = next(plate for plate in plates if plate.layer == layer.number)
    if plate.bit is not None:
        return SERIES[plate.bit % len(SERIES)]
    return _ZERO if plate.makes == "zero layer" else CHROME


def _fill(axes: "Axes", drawn: "db.Region", dbu_m: float, colour: str, alpha: float = 1.0) -> None:
    """Fill what is drawn as one outline with holes, since boxes that touch would show hairlines between them."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    outlines = []
    for polygon in drawn.merged().each():
        loops = [polygon.each_point_hull(), *(polygon.each_point_hole(n) for n in range(polygon.holes()))]
        for loop in loops:
            points = np.array([(point.x, point.y) for point in loop]) * (dbu_m / UM)
            outlines.append(Outline(np.concatenate([points, points[:1]]), closed=True))
    if outlines:
        whole = Outline.make_compound_path(*outlines)
        axes.add_patch(PathPatch(whole, facecolor=colour, linewidth=0, alpha=alpha, snap=False))


def _cut(part: Part, layers: Sequence[Layer], window_um: tuple[float, float, float, float]) -> "db.Region":
    """Return what some layers hold as far as it lies in a window."""
    from klayout import db

    drawn = db.Region()
    for shapes in (part.shapes[layer] for layer in layers):
        for box in shapes.rectangles.tolist():
            drawn.insert(db.Box(*box))
        for polygon in shapes.polygons:
            drawn.insert(db.Polygon([db.Point(x, y) for x, y in polygon.tolist()]))
    return drawn & _everything(part, window_um)


def _everything(part: Part, window_um: tuple[float, float, float, float]) -> "db.Region":
    from klayout import db

    return db.Region(db.Box(*(round(edge * UM / part.dbu_m) for edge in window_um)))


def _window(part: Part, window_m: tuple[float, float, float, float] | None) -> tuple[float, float, float, float]:
    if window_m is not None:
        x0, y0, x1, y1 = (edge / UM for edge in window_m)
        return x0, y0, x1, y1
    x0, y0, x1, y1 = (edge * part.dbu_m / UM for edge in part.box)
    margin = 0.02 * max(x1 - x0, y1 - y0)
    return x0 - margin, y0 - margin, x1 + margin, y1 + margin


def _frame(axes: "Axes", window_um: tuple[float, float, float, float]) -> None:
    x0, y0, x1, y1 = window_um
    axes.set_xlim(x0, x1)
    axes.set_ylim(y0, y1)
    axes.set_aspect("equal")
    axes.set_xlabel("x (µm)")
    axes.set_ylabel("y (µm)")


def draw_part(
    path: str | Path,
    part: Part,
    plates: Sequence[Photomask],
    title: str,
    window_m: tuple[float, float, float, float] | None = None,
) -> None:
    """Draw all masks of a part over each other, each in its colour, as in the drawing (polygons filled).

    Args:
        path: the PNG file.
        part: marks or test structures.
        plates: the masks, for the legend, in the order in which they are used.
        title: what stands above.
        window_m: x0, y0, x1, y1 of what is shown, metres; all by default.

    Raises:
        InputError: the system refuses the path.
    """
    from matplotlib.patches import Patch

    window = _window(part, window_m)
    height = _WIDTH_IN * (window[3] - window[1]) / (window[2] - window[0])
    with picture(path, (_WIDTH_IN + 0.9, height + 1.3), title) as figure:
        wide, high = figure.get_size_inches()
        axes = figure.add_axes((0.7 / wide, 0.8 / high, _WIDTH_IN / wide, height / high))
        axes.set_facecolor(_GLASS)
        for layer in part.shapes:
            _fill(axes, _cut(part, [layer], window), part.dbu_m, _colour(layer, plates), alpha=0.6)
        _frame(axes, window)
        keys = [Patch(color=_colour(plate.on(1), plates), alpha=0.6, label=plate.name) for plate in plates]
        figure.legend(handles=keys, loc="lower right", ncols=len(keys), borderaxespad=0.2)


def draw_view(
    path: str | Path, part: Part, first: Photomask, plate: Photomask, title: str, name: str = "finder"
) -> None:
    """Draw what is seen in a microscope through one plate on the wafer, around the slot of the plate.

    Args:
        path: the PNG file.
        part: an alignment site.
        first: the plate that made the marks on the wafer; they are coloured.
        plate: the plate that lies on the wafer; where it is chrome, it hides the wafer.
        title: what stands above.
        name: which mark of the slot is in the middle.

    Raises:
        InputError: the system refuses the path.
    """
    x, y = part.places[f"{name}, {plate.name}"]
    window = (x / UM - 340, y / UM - 740, x / UM + 640, y / UM + 340)
    with picture(path, (6.4, 7.1), title) as figure:
        axes = figure.add_axes((0.12, 0.08, 0.86, 0.86))
        axes.set_facecolor(_GLASS)
        wafer, drawn = (_cut(part, [a for a in part.shapes if a.number == p.layer], window) for p in (first, plate))
        _fill(axes, wafer, part.dbu_m, _colour(first.on(1), (first,)))
        chrome = drawn if plate.tone == "dark" else _everything(part, window) - drawn
        _fill(axes, chrome, part.dbu_m, _PLATE, alpha=0.88)
        _frame(axes, window)
        figure.text(0.99, 0.01, f"dark: chrome of the plate; coloured: wafer, {first.name}", ha="right", color=INK)
