"""The picture of where a mask set breaks the rules of the process: every mask as a whole, and its worst place."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fab.figure import MARK, length_text, panels, shrunk
from fab.grid import Grid
from fab.plots.maps import Window, box_mm, frame_window, show_map, window_around
from fab.units import MM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from fab.rules.check import PlaneRules, RulesReport

_MOST_COLUMNS = 4
_WINDOW = 40
# Two dots of the picture per block of the overview, so that a block is seen.
_MOST_BLOCKS = 216
# Up to so many broken blocks are ringed, since a lone one is hard to find.
_MOST_RINGS = 40
_SPACE, _LINE = "#eef3f7", "#9fb4c4"
_NARROW_LINE, _NARROW_SPACE, _KISSING = "#0072b2", "#d55e00", "#111111"
_OUTSIDE = "#d9dbde"
# Space, line, narrow space, narrow line: the numbers of `Rules.codes`; touching corners; outside the aperture.
_COLOURS = (_SPACE, _LINE, _NARROW_SPACE, _NARROW_LINE, _KISSING, _OUTSIDE)


class _Pane(NamedTuple):
    """One mask: what is wrong with its pixels, `[y, x]` each."""

    codes: NDArray[np.uint8]
    corners: NDArray[np.uint8]
    inside: NDArray[np.bool_]
    grid: Grid
    window: Window


def plot_rules(report: "RulesReport", title: str = "", ax: "Axes | None" = None) -> "FigureBase":
    """Draw where every etch mask breaks a rule: the whole mask, and below it the surroundings of its worst place.

    In the overview a block of pixels is coloured if anything in it is broken, the stronger the more of it is. Few
    blocks are ringed, so that a single pixel is found on the largest map. The window shows single pixels. The picture
    takes the place of `ax`; a new figure by default.
    """
    level_map = report.level_map
    grid, planes = level_map.grid, level_map.planes()
    inside = level_map.relief.inside(grid)
    columns = min(len(planes), _MOST_COLUMNS)
    rows = -(-len(planes) // columns)
    size = (max(2.9 * columns, 6.4), 6.9 * rows + 0.7)
    line, space = (length_text(m) for m in (report.rules.minimum_line_m, report.rules.minimum_space_m))
    note = (
        f"Etched areas are lines, the rest is spaces. Blue: lines narrower than {line}; "
        f"orange: spaces narrower than {space}; black: pixels that touch only at a "
        "corner. Below each mask: the square marked in it, around its worst place, pixel by pixel."
    )
    with panels(ax, size, title, note) as figure:
        panes = figure.subplots(2 * rows, columns, squeeze=False)
        for number, (found, plane) in enumerate(zip(report.planes, planes, strict=True)):
            row, column = divmod(number, columns)
            whole, detail = panes[2 * row : 2 * row + 2, column]
            corners = _corners(plane) if found.breaks else np.zeros_like(plane)
            pane = _Pane(report.rules.codes(plane, grid.pitch_m), corners, inside, grid, _window(found, grid))
            _draw_whole(whole, pane)
            whole.set_title(f"mask {found.bit + 1} (bit {found.bit})\n{_summary(found)}", linespacing=1.3)
            _draw_window(detail, pane)
            whole.set_anchor("W")
            detail.set_anchor("W")
        for spare in range(len(planes), rows * columns):
            for axes in panes[2 * (spare // columns) : 2 * (spare // columns) + 2, spare % columns]:
                axes.set_axis_off()
    return figure


def _summary(found: "PlaneRules") -> str:
    if not found.breaks:
        return "breaks no rule"
    return (
        f"{100 * found.line.narrow_share:.2g} % of lines and {100 * found.space.narrow_share:.2g} % of\n"
        f"spaces too narrow, {found.kissing} corners touch"
    )


def _corners(plane: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Mark the pixel below and left of every kissing corner, `[y, x]`."""
    a, b, c, d = plane[:-1, :-1], plane[:-1, 1:], plane[1:, :-1], plane[1:, 1:]
    found = np.zeros_like(plane)
    found[:-1, :-1] = (a == d) & (b == c) & (a != b)
    return found


def _window(found: "PlaneRules", grid: Grid) -> Window:
    """Surroundings of the longest of the narrowest places."""
    narrow = [p for p in found.places if p.length_m] or found.places
    y_m, x_m = (narrow[0].y_m, narrow[0].x_m) if narrow else (0.0, 0.0)
    return window_around(grid, y_m, x_m, min(_WINDOW, *grid.shape))


def _colours() -> NDArray[np.float64]:
    from matplotlib.colors import to_rgb

    return np.array([to_rgb(colour) for colour in _COLOURS])


def _draw_whole(axes: "Axes", pane: _Pane) -> None:
    grid, colours = pane.grid, _colours()
    kinds = np.array([shrunk(one, _MOST_BLOCKS) for one in (pane.codes == 2, pane.codes == 3, pane.corners > 0)])
    open_ = shrunk(pane.inside, _MOST_BLOCKS)[..., None]
    share = shrunk(pane.codes % 2 == 1, _MOST_BLOCKS)[..., None] / np.maximum(open_, 1e-9)
    image = np.where(open_ > 0, colours[0] + share * (colours[1] - colours[0]), colours[5])
    broken = kinds.sum(axis=0)
    worst = colours[2 + np.argmax(kinds, axis=0)]
    # From a colour that is seen on any ground to the full one where all of a block is broken.
    weight = np.where(broken > 0, 0.6 + 0.4 * np.minimum(broken, 1), 0.0)[..., None]
    x0, x1, y0, y1 = box_mm(grid)
    show_map(axes, image + weight * (worst - image), grid)
    rows, columns = np.nonzero(broken)
    if len(rows) <= _MOST_RINGS:
        ny, nx = broken.shape
        middle = (x0 + (columns + 0.5) / nx * (x1 - x0), y0 + (rows + 0.5) / ny * (y1 - y0))
        rings: Any = worst[rows, columns]
        axes.scatter(*middle, s=36, facecolors="none", edgecolors=rings, linewidths=1.2)
    frame_window(axes, grid, pane.window)


def _draw_window(axes: "Axes", pane: _Pane) -> None:
    window, pitch_mm = pane.window, pane.grid.pitch_m / MM
    box = box_mm(pane.grid, window)
    image = _colours()[np.where(pane.inside[window], pane.codes[window], 5)]
    show_map(axes, image, pane.grid, window)
    ys, xs = np.nonzero(pane.corners[window])
    axes.plot(box[0] + (xs + 1) * pitch_mm, box[2] + (ys + 1) * pitch_mm, "x", color=_KISSING, ms=3.5, mew=0.9)
    axes.spines[:].set_color(MARK)
