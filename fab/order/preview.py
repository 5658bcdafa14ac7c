"""The picture of a mask set: what a person looks at before the files go out.

Overviews show the mean over blocks of pixels, since the pixels of a plate are finer than those of the
picture; the windows show single pixels. Up is +y, as in the drawing. The picture holds no time and no
version, so the same masks give the same bytes.
"""

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fab.grid import Grid
from fab.level_map import LevelMap
from fab.units import MM, NM, UM, format_length

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["preview_png"]

_MOST_PIXELS = 560
_WINDOW = 48
_DPI = 110
_GLASS, _ETCHED, _CHROME, _MARK = "#eef3f7", "#14507a", "#8c8f94", "#d1495b"
_HEIGHTS = "viridis"
_TEXT = {"fontsize": 9, "color": "#222222"}


def _blocks(values: NDArray[np.uint8] | NDArray[np.float32]) -> NDArray[np.float32]:
    """Average over blocks so that neither side has more than `_MOST_PIXELS`; a rest at the edge drops out."""
    sizes = [-(-n // _MOST_PIXELS) for n in values.shape]
    ny, nx = (n // size for n, size in zip(values.shape, sizes, strict=True))
    cut = values[: ny * sizes[0], : nx * sizes[1]]
    rows = np.add.reduce(cut.reshape(ny, sizes[0], -1), axis=1, dtype=np.float32)
    return rows.reshape(ny, nx, sizes[1]).mean(axis=2) / np.float32(sizes[0])


def _window(grid: Grid) -> tuple[slice, slice]:
    """Return the rows and columns of the window: on the x axis, halfway between the centre and the right edge."""
    ny, nx = grid.shape
    row = max(0, min(ny // 2, ny - _WINDOW // 2) - _WINDOW // 2)
    column = max(0, min(3 * nx // 4, nx - _WINDOW // 2) - _WINDOW // 2)
    return slice(row, min(ny, row + _WINDOW)), slice(column, min(nx, column + _WINDOW))


def _box_mm(grid: Grid, window: tuple[slice, slice] | None = None) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top of the raster or of a window of it, millimetres."""
    rows, columns = window or (slice(0, grid.shape[0]), slice(0, grid.shape[1]))
    (y0, y1), (x0, x1) = (
        ((part.start - n / 2) * grid.pitch_m / MM, (part.stop - n / 2) * grid.pitch_m / MM)
        for part, n in ((rows, grid.shape[0]), (columns, grid.shape[1]))
    )
    return x0, x1, y0, y1


def _scale_bar(axes: "Axes", width_mm: float) -> None:
    """Draw a bar of a round length, about a quarter of the width, below the picture."""
    wanted = width_mm / 4
    power = 10.0 ** np.floor(np.log10(wanted))
    length = power * max(step for step in (1, 2, 5) if step * power <= wanted * (1 + 1e-9))
    share = length / width_mm
    axes.plot([0, share], [-0.04, -0.04], transform=axes.transAxes, color="#222222", lw=2.5, clip_on=False)
    label = format_length(float(f"{length * MM:.3g}")).replace("um", "\N{MICRO SIGN}m")
    axes.text(share + 0.02, -0.04, label, transform=axes.transAxes, va="center", **_TEXT)


def _show(
    axes: "Axes", picture: NDArray[Any], box_mm: tuple[float, float, float, float], title: str, **look: Any
) -> Any:
    image = axes.imshow(picture, origin="lower", extent=box_mm, interpolation="nearest", **look)
    axes.set_title(title, loc="left", pad=4, **_TEXT)
    axes.set_xticks([])
    axes.set_yticks([])
    _scale_bar(axes, box_mm[1] - box_mm[0])
    return image


def _draw_chrome(axes: "Axes", level_map: LevelMap, radii_m: tuple[float, float]) -> None:
    from matplotlib.patches import Circle

    grid, aperture_m = level_map.grid, level_map.aperture_m
    inner, outer = (radius / MM for radius in radii_m)
    axes.add_patch(Circle((0, 0), outer, color=_CHROME, lw=0))
    axes.add_patch(Circle((0, 0), inner, color=_GLASS, lw=0))
    axes.add_patch(Circle((0, 0), aperture_m / 2 / MM, fill=False, ec=_MARK, lw=0.8, ls="--"))
    x0, x1, y0, y1 = _box_mm(grid)
    axes.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color="#222222", lw=0.8)
    axes.set_xlim(-1.03 * outer, 1.03 * outer)
    axes.set_ylim(-1.03 * outer, 1.03 * outer)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title(
        f"chrome: opening {2 * inner:.6g} mm, clear aperture {aperture_m / MM:.6g} mm (dashed)",
        loc="left",
        pad=4,
        **_TEXT,
    )
    _scale_bar(axes, 2.06 * outer)


def _draw_heights(figure: "Figure", axes: "list[Axes]", level_map: LevelMap) -> None:
    """Draw the level map as a whole and through the window, with one colour scale."""
    from matplotlib.patches import Rectangle

    level, levels, grid = level_map.level, level_map.levels, level_map.grid
    window = _window(grid)
    step_nm = levels.step_m / NM
    heights_nm = (levels.heights_m() / NM).astype(np.float32)
    highest = (levels.count - 0.5) * step_nm if levels.is_binary else levels.total_m / NM + step_nm / 2
    look = {"cmap": _HEIGHTS, "vmin": -step_nm / 2, "vmax": highest}
    title = (
        f"height, mean over blocks: {grid.shape[1]} x {grid.shape[0]} pixels of {grid.pitch_m / UM:.6g} \N{MICRO SIGN}m"
    )
    # The means of equal steps are exact; they are what keeps the picture the same to the last bit.
    means = _blocks(level) * step_nm if levels.is_binary else _blocks(heights_nm[level])
    _show(axes[0], means, _box_mm(grid), title, **look)
    x0, x1, y0, y1 = _box_mm(grid, window)
    axes[0].add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, ec=_MARK, lw=1.5))
    title = f"height, window of {level[window].shape[1]} pixels (red in the overview)"
    shown = level[window] * step_nm if levels.is_binary else heights_nm[level[window]]
    image = _show(axes[1], shown, _box_mm(grid, window), title, **look)
    bar = figure.colorbar(image, ax=axes[1], fraction=0.046, pad=0.03)
    ticks = np.arange(levels.count) * step_nm if levels.is_binary else levels.by_height()[1] / NM
    bar.set_ticks(ticks[:: max(1, levels.count // 16)].tolist())
    bar.ax.tick_params(labelsize=7)
    bar.set_label("height above the deepest floor (nm)", **_TEXT)


def preview_png(title: str, level_map: LevelMap, chrome_m: tuple[float, float]) -> bytes:
    """Draw a mask set: heights, chrome, and every etch mask as a whole and through a window.

    Args:
        title: what stands above the picture.
        level_map: the DOE.
        chrome_m: radius of the chrome's opening and its outer radius, metres.

    Returns:
        A PNG file.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure

    levels, grid = level_map.levels, level_map.grid
    columns = max(3, levels.bits)
    figure = Figure(figsize=(4.1 * columns, 4.1 * columns / 3 + 8.6), dpi=_DPI, layout="constrained")
    figure.suptitle(title, fontsize=13, x=0.01, ha="left")
    rows = figure.add_gridspec(2, 1, height_ratios=(4.1 * columns / 3, 8.2))
    top, bottom = (figure.add_subfigure(rows[i]) for i in range(2))
    upper = top.subplots(1, 3)
    _draw_heights(figure, list(upper[:2]), level_map)
    _draw_chrome(upper[2], level_map, chrome_m)
    window = _window(grid)
    look = {"cmap": LinearSegmentedColormap.from_list("etch", [_GLASS, _ETCHED]), "vmin": 0, "vmax": 1}
    lower = bottom.subplots(2, columns, squeeze=False)
    for bit, plane in enumerate(level_map.planes()):
        depth = format_length(levels.etch_depth_m(bit))
        share = f"{100 * np.count_nonzero(plane) / plane.size:.1f} %"
        _show(
            lower[0, bit], _blocks(plane), _box_mm(grid), f"mask {bit + 1}: etches {depth} where blue, {share}", **look
        )
        _show(lower[1, bit], plane[window], _box_mm(grid, window), f"mask {bit + 1}, window", **look)
    for spare in lower[:, levels.bits :].flat:
        spare.set_axis_off()
    FigureCanvasAgg(figure)
    stream = io.BytesIO()
    # The default metadata would name the version of the drawing library.
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
