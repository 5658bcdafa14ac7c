"""The picture of where a mask set breaks the rules of the process: every mask as a whole, and its worst place."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from doedesign.report.canvas import MARK, length_text, note, picture, place, scale_bar, wrapped
from fab.grid import Grid
from fab.layout.polygons import run_lengths
from fab.rules.check import PlaneRules, Rules, RulesReport, shortest_run

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_rules"]

_SIDE, _GAP, _LEFT, _MOST_COLUMNS = 2.7, 0.2, 0.15, 4
_ROW = 2 * _SIDE + 1.35
_WINDOW = 40
# Two dots of the picture per block of the overview, so that a block is seen.
_MOST_BLOCKS = 216
# Up to so many broken blocks are ringed, since a lone one is hard to find.
_MOST_RINGS = 40
_SPACE, _LINE = "#eef3f7", "#9fb4c4"
_NARROW_LINE, _NARROW_SPACE, _KISSING = "#0072b2", "#d55e00", "#111111"
_OUTSIDE = "#d9dbde"
# Space, line, narrow space, narrow line: the numbers of `_codes`, and what they look like.
_COLOURS = (_SPACE, _LINE, _NARROW_SPACE, _NARROW_LINE)
_LONGEST_RUN = 255


def draw_rules(path: str | Path, report: RulesReport, title: str) -> None:
    """Draw where every etch mask breaks a rule: the whole mask, and below it the surroundings of its worst place.

    In the overview a block of pixels is coloured if anything in it is broken, the stronger the more of it is. Few
    blocks are ringed, so that a single pixel is found on the largest plate. The window shows single pixels.

    Args:
        path: the PNG file.
        report: what `fab.rules.check.check` said of a level map.
        title: what stands above the picture.

    Raises:
        InputError: the system refuses the path.
    """
    grid = report.level_map.grid
    inside = grid.inside_circle(report.level_map.aperture_m)
    shown = report.level_map.planes()
    columns = min(len(report.planes), _MOST_COLUMNS)
    rows = -(-len(report.planes) // columns)
    width = max(_LEFT + columns * (_SIDE + _GAP), 6.4)
    words = wrapped(_legend(report.rules), width - 0.3)
    below = 0.2 + 0.15 * (words.count("\n") + 1)
    with picture(path, (width, below + rows * _ROW + 0.35), title) as figure:
        for number, (found, plane) in enumerate(zip(report.planes, shown, strict=True)):
            left = _LEFT + number % columns * (_SIDE + _GAP)
            bottom = below + (rows - 1 - number // columns) * _ROW
            codes = _codes(plane, report.rules, grid.pitch_m)
            corners = _corners(plane) if found.breaks else np.zeros_like(plane)
            window = _window(found, grid)
            whole = place(figure, left, bottom + _SIDE + 0.6, _SIDE, _SIDE)
            _draw_whole(whole, codes, corners, inside, grid, window)
            whole.set_title(f"mask {found.bit + 1} (bit {found.bit})\n{_summary(found)}", linespacing=1.3)
            detail = place(figure, left, bottom + 0.25, _SIDE, _SIDE)
            _draw_window(detail, codes, corners, inside, window, grid.pitch_m)
        note(figure, _LEFT, 0.08, words)


def _legend(rules: Rules) -> str:
    return (
        f"Etched areas are lines, the rest is spaces. Blue: lines narrower than {length_text(rules.minimum_line_m)}; "
        f"orange: spaces narrower than {length_text(rules.minimum_space_m)}; black: pixels that touch only at a "
        "corner. Below each mask: the square marked in it, around its worst place, pixel by pixel."
    )


def _summary(found: PlaneRules) -> str:
    if not found.breaks:
        return "breaks no rule"
    return (
        f"{100 * found.line.narrow_share:.2g} % of lines and {100 * found.space.narrow_share:.2g} % of\n"
        f"spaces too narrow, {found.kissing} corners touch"
    )


def _codes(plane: NDArray[np.uint8], rules: Rules, pitch_m: float) -> NDArray[np.uint8]:
    """Say of every pixel whether it is space (0), line (1), or in a narrow space (2) or line (3); `[y, x]`."""
    codes = plane.copy()
    for value, minimum_m in ((0, rules.minimum_space_m), (1, rules.minimum_line_m)):
        fewest = min(shortest_run(minimum_m, pitch_m), _LONGEST_RUN)
        # A frame of blank glass: a space that reaches it lies between no two lines.
        kind = (np.pad(plane, fewest) == value).view(np.uint8)
        for runs in (run_lengths(kind), run_lengths(kind.T).T):
            narrow = (runs > 0) & (runs < fewest)
            codes[narrow[fewest:-fewest, fewest:-fewest]] = 2 + value
    return codes


def _corners(plane: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Mark the pixel below and left of every kissing corner, `[y, x]`."""
    a, b, c, d = plane[:-1, :-1], plane[:-1, 1:], plane[1:, :-1], plane[1:, 1:]
    found = np.zeros_like(plane)
    found[:-1, :-1] = (a == d) & (b == c) & (a != b)
    return found


def _window(found: PlaneRules, grid: Grid) -> tuple[int, int, int]:
    """First row, first column and side, in pixels, of the square around the longest of the narrowest places."""
    narrow = [p for p in found.places if p.length_m] or found.places
    side = min(_WINDOW, *grid.shape)
    middle = (narrow[0].y_m, narrow[0].x_m) if narrow else (0.0, 0.0)
    first = (round(at / grid.pitch_m + n / 2 - side / 2) for at, n in zip(middle, grid.shape, strict=True))
    y, x = (min(max(start, 0), n - side) for start, n in zip(first, grid.shape, strict=True))
    return y, x, side


def _colours() -> NDArray[np.float64]:
    from matplotlib.colors import to_rgb

    return np.array([to_rgb(colour) for colour in (*_COLOURS, _KISSING, _OUTSIDE)])


def _sums(values: NDArray[np.bool_], size: int) -> NDArray[np.float64]:
    """Count over blocks; those at the upper ends may be smaller."""
    padded = np.pad(values, [(0, -n % size) for n in values.shape])
    ny, nx = (n // size for n in padded.shape)
    rows = np.add.reduce(padded.reshape(ny, size, -1), axis=1, dtype=np.float32)
    return rows.reshape(ny, nx, size).sum(axis=2, dtype=np.float64)


def _draw_whole(
    axes: "Axes",
    codes: NDArray[np.uint8],
    corners: NDArray[np.uint8],
    inside: NDArray[np.bool_],
    grid: Grid,
    window: tuple[int, int, int],
) -> None:
    from matplotlib.patches import Rectangle

    size = -(-max(grid.shape) // _MOST_BLOCKS)
    colours = _colours()
    kinds = [_sums(codes == 2, size), _sums(codes == 3, size), _sums(corners > 0, size)]
    open_ = _sums(inside, size)[..., None]
    share = _sums(codes % 2 == 1, size)[..., None] / np.maximum(open_, 1)
    image = np.where(open_ > 0, colours[0] + share * (colours[1] - colours[0]), colours[5])
    broken = np.sum(kinds, axis=0)
    worst = colours[2 + np.argmax(kinds, axis=0)]
    # From a colour that is seen on any ground to the full one where all of a block is broken.
    weight = np.where(broken > 0, 0.6 + 0.4 * np.minimum(broken / size**2, 1), 0.0)[..., None]
    ny, nx = (n * size for n in broken.shape)
    axes.imshow(
        image + weight * (worst - image), origin="lower", extent=(0, nx, 0, ny), interpolation="nearest", aspect="equal"
    )
    axes.set_xlim(0, grid.shape[1])
    axes.set_ylim(0, grid.shape[0])
    rows, columns = np.nonzero(broken)
    if len(rows) <= _MOST_RINGS:
        middle = ((columns + 0.5) * size, (rows + 0.5) * size)
        rings: Any = worst[rows, columns]
        axes.scatter(*middle, s=36, facecolors="none", edgecolors=rings, linewidths=1.2)
    y, x, side = window
    axes.add_patch(Rectangle((x, y), side, side, fill=False, ec=MARK, lw=1.4))
    _finish(axes, grid.shape[1] * grid.pitch_m)


def _draw_window(
    axes: "Axes",
    codes: NDArray[np.uint8],
    corners: NDArray[np.uint8],
    inside: NDArray[np.bool_],
    window: tuple[int, int, int],
    pitch_m: float,
) -> None:
    y, x, side = window
    part = (slice(y, y + side), slice(x, x + side))
    image = _colours()[np.where(inside[part], codes[part], 5)]
    axes.imshow(image, origin="lower", extent=(0, side, 0, side), interpolation="nearest")
    ys, xs = np.nonzero(corners[part])
    axes.plot(xs + 1, ys + 1, "x", color=_KISSING, ms=3.5, mew=0.9)
    axes.set_xlim(0, side)
    axes.set_ylim(0, side)
    axes.tick_params(color=MARK)
    for spine in axes.spines.values():
        spine.set_color(MARK)
    _finish(axes, side * pitch_m)


def _finish(axes: "Axes", width_m: float) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    scale_bar(axes, width_m)
