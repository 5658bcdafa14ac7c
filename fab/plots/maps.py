"""Windows of a map: where they are cut, where they lie, and their frame in the overview."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fab.aperture import Aperture, RoundAperture
from fab.figure import MARK, SMALL, scale_bar
from fab.grid import Grid
from fab.units import MM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage
    from matplotlib.patches import Patch


class Window(NamedTuple):
    """Rows and columns of a part of a map; indexes an array ``[y, x]``."""

    rows: slice
    columns: slice


def window_around(grid: Grid, y_m: float, x_m: float, side: int) -> Window:
    """Window of `side` pixels, or as many as there are, around a place given from the centre in metres."""

    def cut(at_m: float, count: int) -> slice:
        first = round(at_m / grid.pitch_m + count / 2 - side / 2)
        first = max(0, min(first, count - side))
        return slice(first, min(count, first + side))

    return Window(cut(y_m, grid.shape[0]), cut(x_m, grid.shape[1]))


def box_mm(grid: Grid, window: Window | None = None) -> tuple[float, float, float, float]:
    """Left, right, bottom and top of a raster or of a window of it, millimetres from the centre."""
    rows, columns = window or (slice(0, grid.shape[0]), slice(0, grid.shape[1]))
    (y0, y1), (x0, x1) = (
        ((part.start - n / 2) * grid.pitch_m / MM, (part.stop - n / 2) * grid.pitch_m / MM)
        for part, n in ((rows, grid.shape[0]), (columns, grid.shape[1]))
    )
    return x0, x1, y0, y1


def show_map(
    axes: "Axes", values: NDArray[Any], grid: Grid, window: Window | None = None, title: str = "", **style: Any
) -> "AxesImage":
    """Show a raster, or a window of it, with axes in millimetres but for their numbers, over a scale bar."""
    box = box_mm(grid, window)
    image = axes.imshow(values, origin="lower", extent=box, interpolation="nearest", **style)
    axes.set_title(title)
    scale_bar(axes, (box[1] - box[0]) * MM)
    return image


def outline_of(aperture: Aperture, at_mm: tuple[float, float] = (0.0, 0.0), **style: Any) -> "Patch":
    """Return the outline of an aperture about a place x, y, in axes with millimetres."""
    from matplotlib.patches import Circle, PathPatch
    from matplotlib.path import Path

    if isinstance(aperture, RoundAperture):
        return Circle(at_mm, aperture.diameter_m / 2 / MM, **style)
    loops = [loop / MM + at_mm for loop in aperture.outlines_m(4)]
    return PathPatch(Path.make_compound_path(*(Path(loop, closed=True) for loop in map(_closed, loops))), **style)


def _closed(loop: NDArray[Any]) -> NDArray[Any]:
    """A loop with its first corner again at the end."""
    return np.concatenate([loop, loop[:1]])


def frame_window(axes: "Axes", grid: Grid, window: Window, name: str = "") -> None:
    """Frame a window in an overview with axes in millimetres, and write its name beside it."""
    from matplotlib.patches import Rectangle

    left, right, bottom, top = box_mm(grid, window)
    axes.add_patch(Rectangle((left, bottom), right - left, top - bottom, fill=False, ec=MARK, lw=1.3, clip_on=False))
    if name:
        at_edge = right > 0.6 * box_mm(grid)[1]
        side: Any = {"ha": "right", "xytext": (-3, 3)} if at_edge else {"ha": "left", "xytext": (3, 3)}
        style = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}
        corner = (left if at_edge else right, top)
        axes.annotate(name, corner, textcoords="offset points", fontsize=SMALL, bbox=style, **side)
