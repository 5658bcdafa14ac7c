"""Checks of pictures that do not depend on their pixels, and commands without the time that pictures take."""

import io
from collections.abc import Callable
from contextlib import nullcontext
from itertools import combinations
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.image import imread

from fab.figure import png_bytes
from fab.files import write_atomic
from fab.order import papers, write
from fab.order.drawing import DrawnOrder

_SLACK = 3.0  # dots; boxes of texts are taller than their letters


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


def require_place_of_axes(draw: Callable[[Axes], Axes | FigureBase]) -> None:
    """Require that a picture lies where the axes were that it was given, and that all of it is seen there."""
    figure = Figure(figsize=(22, 22), layout="constrained")
    left, right = figure.subplots(1, 2)
    right.plot([0, 1])
    drawn = draw(left)
    assert drawn.get_figure(root=True) is figure
    assert drawn is left or left not in figure.axes
    require_whole(figure)
    assert all(axes.get_window_extent().x1 < right.get_window_extent().x0 for axes in figure.axes if axes is not right)


def _name(axes: Axes) -> str:
    return f"panel {axes.get_title(loc='left') or axes.get_title() or axes.get_ylabel()!r}"


def dots_of(drawn: Axes | FigureBase) -> np.ndarray:
    """Red, green and blue of every dot of the figure, 0 to 1, `[row, column, colour]` from the top."""
    return imread(io.BytesIO(png_bytes(drawn)))[..., :3]


def panel_dots(axes: Axes) -> np.ndarray:
    """Dots of one panel, without its frame."""
    dots = dots_of(axes)
    box = axes.get_window_extent()
    x0, x1, y0, y1 = (round(edge) for edge in (box.x0, box.x1, box.y0, box.y1))
    return dots[len(dots) - y1 + 2 : len(dots) - y0 - 2, x0 + 2 : x1 - 2]


def panel(drawn: Axes | FigureBase, title: str) -> Axes:
    """The panel of a figure whose title begins so."""
    figure: Any = drawn.get_figure(root=True)
    return next(axes for axes in figure.axes if axes.get_title(loc="left").startswith(title))


def leave_out_pictures(patch: pytest.MonkeyPatch, first: ModuleType, *others: ModuleType) -> None:
    """Let commands write a few bytes instead of each picture."""
    for module in (first, *others):
        for name in dir(module):
            if name.startswith("plot_"):
                patch.setattr(module, name, lambda *_, **__: None)
        if hasattr(module, "save"):
            patch.setattr(module, "save", lambda _, path: write_atomic(path, b"picture"))
        if hasattr(module, "drawn_beside"):
            patch.setattr(module, "drawn_beside", lambda: nullcontext(_left_out))


def _left_out(path: Path, plot: Callable[..., object], *given: object, **more: object) -> None:
    plot(*given, **more)
    write_atomic(path, b"picture")


def leave_out_pictures_of_orders(patch: pytest.MonkeyPatch) -> None:
    """Let orders hold a few bytes instead of each picture; drawing takes two thirds of the time of a small one."""
    pictures = papers.pictures

    def short(drawing: DrawnOrder) -> dict[str, papers.Paper]:
        return dict.fromkeys(pictures(drawing), lambda: b"picture")

    for module in (papers, write):
        patch.setattr(module, "pictures", short)
