"""The picture of a height map: as a whole and cell by cell, and how much area stands at each height."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fab.figure import CHROME, HEIGHTS, INK, MARK, SMALL, aperture_text, length_text, panels, shrunk
from fab.plots.maps import box_mm, frame_window, outline_of, show_map, window_around
from fab.units import NM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from fab.height import HeightMap
    from fab.levels import Levels

_WINDOW = 48
_MOST = 672
_FINE_BINS = 96


def plot_height(
    height: "HeightMap", levels: "Levels | None" = None, title: str = "", ax: "Axes | None" = None
) -> "FigureBase":
    """Draw a height map: the whole, a window at the centre and one at the edge, and the share of area at every height.

    The overview is a smooth mean where there are more cells than dots, and says so; the windows show single cells.
    Outside the relief, where chrome covers the glass, all is grey. With `levels` the axis names their heights,
    and a map that stands on them is counted per level. The picture takes the place of `ax`; a new figure by default.
    """
    from matplotlib import colormaps

    grid = height.grid
    inside = height.relief.inside(grid)
    heights = height.height_m[inside]
    ends = _range_m(heights, levels)
    style = {"cmap": colormaps[HEIGHTS].with_extremes(bad=CHROME), "vmin": ends[0] / NM, "vmax": ends[1] / NM}
    with panels(ax, (10.1, 5.35), f"{title}: height map" if title else "Height map") as figure:
        at = figure.subplot_mosaic(
            [["whole", "centre", "scale", "shares"], ["whole", "edge", "scale", "shares"]],
            width_ratios=(4.2, 1.95, 0.16, 1.75),
        )
        _draw_whole(at["whole"], height, inside, style)
        right_m = height.relief.extent_m[1] / 2 - _WINDOW / 2 * grid.pitch_m
        for name, x_m in (("centre", 0.0), ("edge", right_m)):
            window = window_around(grid, 0.0, x_m, _WINDOW)
            cells = np.ma.array(height.height_m[window] / NM, mask=~inside[window])
            show_map(at[name], cells, grid, window, f"{name}, {length_text(grid.pitch_m)} cells", **style)
            frame_window(at["whole"], grid, window, name)
        _draw_shares(figure, at["scale"], at["shares"], heights, levels, ends, style)
    return figure


def _range_m(heights: NDArray[np.floating], levels: "Levels | None") -> tuple[float, float]:
    """Heights at the two ends of the colours: half a step round the staircase, and more where the map goes beyond."""
    low, high = (float(heights.min()), float(heights.max())) if heights.size else (0.0, 0.0)
    if levels is not None:
        half = levels.step_m / 2
        return min(low, 0.0) - half, max(high, levels.total_m) + half
    return (low, high) if high > low else (low - NM, high + NM)


def _draw_whole(axes: "Axes", height: "HeightMap", inside: NDArray[np.bool_], style: dict[str, Any]) -> None:
    grid = height.grid
    # Cells under the chrome have a height too; it must not tint the mean along the edge.
    covered = shrunk(inside.astype(np.float32), _MOST, "smooth")
    mean = shrunk(np.where(inside, height.height_m, 0), _MOST, "smooth") / np.maximum(covered, 1e-3)
    shown = np.ma.array(mean / NM, mask=covered < 0.5)
    axes.imshow(shown, origin="lower", extent=box_mm(grid), interpolation="auto", **style)
    axes.add_patch(outline_of(height.relief, fill=False, ec=MARK, lw=1.2, ls="--", clip_on=False))
    factor = max(grid.shape) / _MOST
    averaged = f", mean over about {factor:.2g} × {factor:.2g}" if factor > 1 else ""
    axes.set_title(f"{grid.shape[1]} × {grid.shape[0]} cells{averaged}")
    axes.set_title(f"relief {aperture_text(height.relief)}", loc="right", fontsize=SMALL, color=MARK)
    axes.set_xlabel("x (mm)")
    axes.set_ylabel("y (mm)")
    axes.locator_params(nbins=6, steps=[1, 2, 5, 10])


def height_shares(
    heights: NDArray[np.floating], levels: "Levels | None", ends_m: tuple[float, float]
) -> tuple[NDArray[np.floating], NDArray[np.float64]]:
    """Return edges of bins in metres, and the share of cells (heights in metres, ``(n,)``) in each; they sum to 1.

    There is one bin per level where every height is a level, and narrow ones between the ends otherwise.
    """
    edges = np.linspace(*ends_m, _FINE_BINS + 1)
    if levels is not None and heights.size and not levels.is_binary:
        stairs = levels.by_height()[1]
        between = (stairs[1:] + stairs[:-1]) / 2
        if np.abs(heights - stairs[np.searchsorted(between, heights)]).max() < 1e-3 * levels.step_m:
            edges = np.concatenate([stairs[:1], between, stairs[-1:]])
            edges[[0, -1]] += np.array([-0.5, 0.5]) * levels.step_m
    elif levels is not None and heights.size:
        steps = heights / levels.step_m
        whole = np.rint(steps)
        # float32 keeps a level to 1e-6 of a step; a thousandth is far below what any process distinguishes.
        if np.abs(steps - whole).max() < 1e-3:
            first, last = min(0, int(whole.min())), max(levels.count - 1, int(whole.max()))
            edges = (np.arange(first, last + 2) - 0.5) * levels.step_m
    counts, _ = np.histogram(heights, edges)
    return edges, counts / max(heights.size, 1)


def _draw_shares(
    figure: "FigureBase",
    scale: "Axes",
    axes: "Axes",
    heights: NDArray[np.floating],
    levels: "Levels | None",
    ends_m: tuple[float, float],
    style: dict[str, Any],
) -> None:
    """Draw the colour scale and, along it, the share of the relief's area at every height."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    norm = Normalize(style["vmin"], style["vmax"])
    bar = figure.colorbar(ScalarMappable(norm, style["cmap"]), cax=scale, ticklocation="left")
    bar.set_label("height above the deepest floor (nm)")
    if levels is not None:
        bar.set_ticks((levels.by_height()[1] / NM)[:: max(1, levels.count // 16)].tolist())
    edges, shares = height_shares(heights, levels, ends_m)
    middles = (edges[:-1] + edges[1:]) / 2 / NM
    fine = len(shares) == _FINE_BINS
    thickness = np.diff(edges) / NM * (1.0 if fine else 0.8)
    axes.barh(middles, 100 * shares, thickness, color=style["cmap"](norm(middles)), ec=INK, lw=0.0 if fine else 0.4)
    axes.set_ylim(style["vmin"], style["vmax"])
    axes.set_yticks([])
    axes.set_xlim(left=0)
    axes.set_xlabel(f"area per {(edges[1] - edges[0]) / NM:.3g} nm (%)" if fine else "area per level (%)")
    axes.set_title("share of the relief")
    axes.spines[["top", "right"]].set_visible(False)
