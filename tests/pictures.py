"""Checks of pictures that do not depend on their pixels."""

from itertools import combinations
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

_SLACK = 1.0  # dots


def require_whole(drawn: Axes | FigureBase) -> None:
    """Require that nothing of a figure is cut off, and that no panel with its labels lies over another or a text."""
    figure: Any = drawn.get_figure(root=True)
    figure.draw_without_rendering()
    width, height = figure.bbox.size
    boxes = [(_name(axes), axes.get_tightbbox()) for axes in figure.axes]
    figures = [figure, *figure.subfigs]
    for one in figures:
        around = [one._suptitle, one._supxlabel, *one.legends]
        boxes += [(str(text), text.get_window_extent()) for text in around if text is not None]
    for name, box in boxes:
        inside = min(box.x0, box.y0, width - box.x1, height - box.y1) >= -_SLACK
        assert inside, f"{name} is cut off: {box.extents} in {width} x {height}"
    for (name, box), (other, beside) in combinations(boxes, 2):
        across = min(box.x1, beside.x1) - max(box.x0, beside.x0)
        up = min(box.y1, beside.y1) - max(box.y0, beside.y0)
        assert min(across, up) <= _SLACK, f"{name} {box.extents} lies over {other} {beside.extents}"


def _name(axes: Axes) -> str:
    return f"panel {axes.get_title(loc='left') or axes.get_title() or axes.get_ylabel()!r}"
