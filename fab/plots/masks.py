"""The picture of a mask set: what a person looks at before the files go out.

Overviews show the mean over parts of the map, since its pixels are finer than those of the picture; the windows show
single pixels. Up is +y, as in the drawing.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from fab.aperture import Aperture, MaskAperture
from fab.figure import CHROME, HEIGHTS, INK, MARK, panels, scale_bar, shrunk
from fab.plots.maps import Window, box_mm, frame_window, outline_of, show_map, window_around
from fab.units import MM, NM, UM, format_length

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from fab.level_map import LevelMap

_MOST = 560
_WINDOW = 48
_GLASS, _ETCHED = "#eef3f7", "#14507a"
_SIDE_IN = 2.7


def plot_masks(
    level_map: "LevelMap", chrome: "tuple[Aperture, float]", title: str = "", ax: "Axes | None" = None
) -> "FigureBase":
    """Draw a mask set: heights, chrome (opening, and radius of the rim in metres), every mask whole and in a window.

    The picture takes the place of `ax`; a new figure by default.
    """
    from matplotlib.colors import LinearSegmentedColormap

    levels, grid = level_map.levels, level_map.grid
    # On the x axis, halfway between the centre and the right edge.
    window = window_around(grid, 0.0, grid.extent_m[1] / 4, _WINDOW)
    columns = max(3, levels.bits)
    upper_in, lower_in = _SIDE_IN * columns / 3 + 0.4, 2 * _SIDE_IN + 0.9
    with panels(ax, (_SIDE_IN * columns + 0.3, upper_in + lower_in + 0.4), title) as figure:
        parts: Any = figure.subfigures(2, 1, height_ratios=(upper_in, lower_in))
        above, below = parts
        heights, detail, around = above.subplots(1, 3)
        _draw_heights(above, heights, detail, level_map, window)
        _draw_chrome(around, level_map, chrome)
        style = {"cmap": LinearSegmentedColormap.from_list("etch", [_GLASS, _ETCHED]), "vmin": 0, "vmax": 1}
        panes = below.subplots(2, columns, squeeze=False)
        for bit, plane in enumerate(level_map.planes()):
            depth = format_length(levels.etch_depth_m(bit))
            words = f"mask {bit + 1}: etches {depth}\nwhere blue, {100 * np.count_nonzero(plane) / plane.size:.1f} %"
            show_map(panes[0, bit], shrunk(plane, _MOST), grid, None, words, **style)
            show_map(panes[1, bit], plane[window], grid, window, f"mask {bit + 1}, window", **style)
        for spare in panes[:, levels.bits :].flat:
            spare.set_axis_off()
    return figure


def _draw_heights(figure: "FigureBase", whole: "Axes", detail: "Axes", level_map: "LevelMap", window: Window) -> None:
    """Draw heights as a whole and through the window, with one colour scale."""
    levels, grid = level_map.levels, level_map.grid
    stairs_nm = levels.by_height()[1] / NM
    half = levels.step_m / NM / 2
    style = {"cmap": HEIGHTS, "vmin": -half, "vmax": float(stairs_nm[-1]) + half}
    heights_nm = level_map.height_m / np.float32(NM)
    ny, nx = grid.shape
    words = f"height: {nx} × {ny} pixels of {grid.pitch_m / UM:.6g} µm"
    show_map(whole, shrunk(heights_nm, _MOST), grid, None, words, **style)
    frame_window(whole, grid, window)
    image = show_map(detail, heights_nm[window], grid, window, "height, the window framed in red", **style)
    bar = figure.colorbar(image, cax=detail.inset_axes((1.03, 0, 0.05, 1)))
    bar.set_ticks(stairs_nm[:: max(1, levels.count // 16)].tolist())
    bar.set_label("height above the deepest floor (nm)")


def _draw_chrome(axes: "Axes", level_map: "LevelMap", chrome: "tuple[Aperture, float]") -> None:
    from matplotlib.patches import Circle

    opening, outer = chrome[0], chrome[1] / MM
    axes.add_patch(Circle((0, 0), outer, color=CHROME, lw=0))
    axes.add_patch(outline_of(opening, color=_GLASS, lw=0))
    axes.add_patch(outline_of(level_map.shown_relief, fill=False, ec=MARK, lw=0.8, ls="--"))
    x0, x1, y0, y1 = box_mm(level_map.grid)
    axes.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color=INK, lw=0.8)
    axes.set(xlim=(-1.03 * outer, 1.03 * outer), ylim=(-1.03 * outer, 1.03 * outer), aspect="equal")
    outlines = opening, level_map.shown_relief
    clear, relief = (" × ".join(f"{size / MM:.6g}" for size in outline.sizes_m) for outline in outlines)
    name = "clear aperture" if len(opening.sizes_m) == 1 else "clear"
    name += " within" if isinstance(opening, MaskAperture) else ""
    axes.set_title(f"chrome: {name} {clear} mm,\nrelief {relief} mm (dashed)")
    scale_bar(axes, 2.06 * outer * MM)
