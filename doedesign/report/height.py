"""The picture of a plate: its height map as a whole and cell by cell, and how much area stands at each height."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from doedesign.report.canvas import CHROME, HEIGHTS, INK, MARK, SMALL, length_text, picture, place, scale_bar, shrunk
from fab.grid import Grid
from fab.levels import Levels
from fab.units import MM, NM
from sim.camera import Camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WINDOW = 48
_MOST = 672
_FINE_BINS = 96


def draw_height(
    path: str | Path, height_m: Float[np.ndarray, "y x"], levels: Levels | None, camera: Camera, title: str
) -> None:
    """Draw a height map: the whole plate, a window at the centre and one at the edge, and the share of every height.

    The overview is a smooth mean, since a plate has more cells than the picture has pixels; its note says so.
    The windows show single cells. Outside the clear aperture, where chrome covers the glass, all is grey.

    Args:
        path: the PNG file.
        height_m: `[y, x]` heights on the camera's grid, metres, quantised or not.
        levels: the staircase whose heights the axis names, or None. A map that stands on it is counted per level.
        camera: grid and clear aperture.
        title: what stands above the picture.

    Raises:
        ValueError: the shape is not the grid's.
        InputError: the system refuses the path.
    """
    grid = camera.grid
    if height_m.shape != grid.shape:
        raise ValueError(f"`height_m` must have the grid's shape {grid.shape}, but got {height_m.shape}")
    inside = grid.inside_circle(camera.aperture_m)
    heights = height_m[inside]
    ends = _range_m(heights, levels)
    look = {"cmap": _palette(), "vmin": ends[0] / NM, "vmax": ends[1] / NM}
    # At 160 dots per inch, one dot per sample of the overview and six dots per cell of a window.
    with picture(path, (10.1, 5.35), title) as figure:
        whole = place(figure, 0.75, 0.55, 4.2, 4.2)
        _draw_whole(whole, height_m, inside, camera, look)
        for number, (name, window) in enumerate(_windows(grid, camera.aperture_m).items()):
            axes = place(figure, 5.3, 2.95 - 2.3 * number, 1.8, 1.8)
            _draw_window(axes, height_m, inside, grid, window, f"{name}, {length_text(grid.pitch_m)} cells", look)
            _mark(whole, grid, window, name)
        strip = place(figure, 7.95, 0.55, 0.16, 4.2)
        _draw_shares(strip, place(figure, 8.19, 0.55, 1.75, 4.2), heights, levels, ends, look)


def _palette() -> Any:
    from matplotlib import colormaps

    return colormaps[HEIGHTS].with_extremes(bad=CHROME)


def _range_m(heights: Float[np.ndarray, " n"], levels: Levels | None) -> tuple[float, float]:
    """Heights at the two ends of the colours: half a step round the staircase, and more where the map goes beyond."""
    low, high = (float(heights.min()), float(heights.max())) if heights.size else (0.0, 0.0)
    if levels is not None:
        half = levels.step_m / 2
        return min(low, 0.0) - half, max(high, levels.total_m) + half
    return (low, high) if high > low else (low - NM, high + NM)


def _windows(grid: Grid, aperture_m: float) -> dict[str, tuple[slice, slice]]:
    """Rows and columns of a window at the centre and of one at the right edge of the aperture, on the x axis."""
    ny, nx = grid.shape
    right = min(nx, round(nx / 2 + aperture_m / 2 / grid.pitch_m))

    def cut(start: int, count: int) -> slice:
        start = max(0, min(start, count - _WINDOW))
        return slice(start, min(count, start + _WINDOW))

    rows = cut(ny // 2 - _WINDOW // 2, ny)
    return {"centre": (rows, cut(nx // 2 - _WINDOW // 2, nx)), "edge": (rows, cut(right - _WINDOW, nx))}


def _box_mm(grid: Grid, window: tuple[slice, slice] | None = None) -> tuple[float, float, float, float]:
    """Left, right, bottom and top of the plate or of a window of it, millimetres."""
    rows, columns = window or (slice(0, grid.shape[0]), slice(0, grid.shape[1]))
    pitch = grid.pitch_m / MM
    left, right = ((end - grid.shape[1] / 2) * pitch for end in (columns.start, columns.stop))
    bottom, top = ((end - grid.shape[0] / 2) * pitch for end in (rows.start, rows.stop))
    return left, right, bottom, top


def _draw_whole(
    axes: "Axes",
    height_m: Float[np.ndarray, "y x"],
    inside: Bool[np.ndarray, "y x"],
    camera: Camera,
    look: dict[str, Any],
) -> None:
    from matplotlib.patches import Circle
    from matplotlib.ticker import MaxNLocator

    grid = camera.grid
    # Cells under the chrome have a height too; it must not tint the mean along the edge.
    covered = shrunk(inside.astype(np.float32), _MOST, "smooth")
    mean = shrunk(np.where(inside, height_m, 0), _MOST, "smooth") / np.maximum(covered, 1e-3)
    shown = np.ma.array(mean / NM, mask=covered < 0.5)
    axes.imshow(shown, origin="lower", extent=_box_mm(grid), interpolation="auto", **look)
    radius = camera.aperture_m / 2 / MM
    axes.add_patch(Circle((0, 0), radius, fill=False, ec=MARK, lw=1.2, ls="--", clip_on=False))
    factor = max(grid.shape) / _MOST
    averaged = f", mean over about {factor:.2g} × {factor:.2g}" if factor > 1 else ""
    axes.set_title(f"{grid.shape[1]} × {grid.shape[0]} cells{averaged}")
    words = f"clear aperture {length_text(camera.aperture_m)}"
    axes.text(1, -0.075, words, transform=axes.transAxes, ha="right", va="top", fontsize=SMALL, color=MARK)
    axes.set_xlabel("x (mm)", labelpad=2)
    axes.set_ylabel("y (mm)", labelpad=2)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))


def _draw_window(
    axes: "Axes",
    height_m: Float[np.ndarray, "y x"],
    inside: Bool[np.ndarray, "y x"],
    grid: Grid,
    window: tuple[slice, slice],
    title: str,
    look: dict[str, Any],
) -> None:
    cells = np.ma.array(height_m[window] / NM, mask=~inside[window])
    box = _box_mm(grid, window)
    axes.imshow(cells, origin="lower", extent=box, interpolation="nearest", **look)
    axes.set_title(title)
    axes.set_xticks([])
    axes.set_yticks([])
    scale_bar(axes, (box[1] - box[0]) * MM)


def _mark(axes: "Axes", grid: Grid, window: tuple[slice, slice], name: str) -> None:
    """Frame a window in the overview and write its name beside it."""
    from matplotlib.patches import Rectangle

    left, right, bottom, top = _box_mm(grid, window)
    axes.add_patch(Rectangle((left, bottom), right - left, top - bottom, fill=False, ec=MARK, lw=1.3, clip_on=False))
    side = {"ha": "right", "xytext": (-3, 3)} if right > 0.6 * _box_mm(grid)[1] else {"ha": "left", "xytext": (3, 3)}
    corner = (left, top) if side["ha"] == "right" else (right, top)
    style = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}
    axes.annotate(name, corner, textcoords="offset points", fontsize=SMALL, bbox=style, **side)


def height_shares(
    heights: Float[np.ndarray, " n"], levels: Levels | None, ends_m: tuple[float, float]
) -> tuple[Float[np.ndarray, " edge"], Float[np.ndarray, " bin"]]:
    """Share of the cells at every height.

    Args:
        heights: heights of the cells, metres.
        levels: the staircase, or None.
        ends_m: range that holds all heights, metres.

    Returns:
        Edges of the bins in metres and the shares, which sum to 1: one bin per level where every height is a level,
        narrow bins otherwise.
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
    strip: "Axes",
    axes: "Axes",
    heights: Float[np.ndarray, " n"],
    levels: Levels | None,
    ends_m: tuple[float, float],
    look: dict[str, Any],
) -> None:
    """Draw the colour scale and, along it, the share of the clear aperture's area at every height."""
    from matplotlib.colors import Normalize

    low, high = look["vmin"], look["vmax"]
    scale = np.linspace(low, high, 512)[:, None]
    strip.imshow(scale, origin="lower", extent=(0, 1, low, high), aspect="auto", **look)
    strip.set_xticks([])
    strip.set_ylabel("height above the deepest floor (nm)", labelpad=3)
    if levels is not None:
        strip.set_yticks((levels.by_height()[1] / NM)[:: max(1, levels.count // 16)])
    edges, shares = height_shares(heights, levels, ends_m)
    middles = (edges[:-1] + edges[1:]) / 2 / NM
    fine = len(shares) == _FINE_BINS
    thickness = np.diff(edges) / NM * (1.0 if fine else 0.8)
    hues = look["cmap"](Normalize(low, high)(middles))
    axes.barh(middles, 100 * shares, thickness, color=hues, ec=INK, lw=0.0 if fine else 0.4)
    axes.set_ylim(low, high)
    axes.set_yticks([])
    axes.set_xlim(left=0)
    axes.set_xlabel(f"area per {(edges[1] - edges[0]) / NM:.3g} nm (%)" if fine else "area per level (%)", labelpad=2)
    axes.set_title("share of the clear aperture")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
