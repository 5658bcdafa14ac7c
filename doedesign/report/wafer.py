"""The picture of a whole mask plate: blank, wafer, dies, alignment sites, test structures and labels."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from doedesign.report.canvas import CHROME, FAINT, INK, LINE, MARK, SMALL, note, picture, place
from fab.layout.frame import Frame
from fab.layout.geometry import Cell, Reference
from fab.layout.wafer import READING, Wafer
from fab.units import MM, format_length

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_wafer"]

_WIDTH_IN, _HEIGHT_IN = 7.0, 7.6


def draw_wafer(path: Path, wafer: Wafer, frame: Frame, aperture_m: float, dbu_m: float, title: str) -> None:
    """Draw where everything lies, seen from the etched side.

    Args:
        path: the PNG file.
        wafer: the wafer.
        frame: the cells around the DOE (`fab.layout.frame.draw_frame`); dies that draw it differently bear their
            number.
        aperture_m: diameter of the clear aperture, metres.
        dbu_m: database unit of the frame, metres.
        title: what stands above.
    """
    from matplotlib.patches import Circle, Rectangle

    cells = {cell.name: cell for cell in frame.cells}
    top, around = frame.cells[-1], frame.cells[-2]
    with picture(path, (_WIDTH_IN, _HEIGHT_IN), title) as figure:
        axes = place(figure, 0.65, 0.95, 6.1, 6.1)
        half = wafer.blank_m / 2 / MM
        axes.add_patch(Rectangle((-half, -half), 2 * half, 2 * half, facecolor="#f3f3f1", edgecolor=INK, lw=1.2))
        axes.add_patch(Circle((0, 0), wafer.diameter_m / 2 / MM, facecolor="white", edgecolor=LINE, lw=1.2))
        side = frame.die_m / MM
        for (x, y), split in zip(frame.dies, frame.splits, strict=True):
            axes.add_patch(Rectangle((x / MM - side / 2, y / MM - side / 2), side, side, fill=False, ec=FAINT, lw=0.8))
            axes.add_patch(Circle((x / MM, y / MM), aperture_m / 2 / MM, facecolor=CHROME, edgecolor="none"))
            if split:
                told = {"ha": "left", "va": "top", "fontsize": SMALL, "color": INK}
                axes.text((x / MM) - 0.46 * side, y / MM + 0.46 * side, f"{split}", **told)
        words = {"SITE": "alignment site", "TEST": "test structures"}
        for reference in around.references:
            kind = reference.cell.rpartition("_")[2]
            if kind in words:
                _box(axes, cells[reference.cell], reference, dbu_m, words[kind])
        labels = {layer: shapes for layer, shapes in top.shapes.items() if layer.datatype == 3}
        _box(axes, Cell("labels", labels), Reference("labels"), dbu_m, "labels, one per mask")
        axes.set(xlim=(-half - 1, half + 1), ylim=(-half - 1, half + 1), aspect="equal")
        axes.set_xlabel("x (mm)", labelpad=2)
        axes.set_ylabel("y (mm)", labelpad=0)
        rows, columns = frame.raster
        told = (
            f"Blank of {format_length(wafer.blank_m)}, wafer of {format_length(wafer.diameter_m)} and "
            f"{format_length(wafer.thickness_m)}, {rows} x {columns} dies {format_length(frame.die_m)} apart.\n"
            f"Seen from the etched side, +y up; {READING}. Grey: clear apertures."
        )
        if any(frame.splits):
            told += "\nNumbered dies: splits, drawn differently on purpose; the manifest and the run sheet say how."
        note(figure, 0.65, 0.1, told)


def _box(axes: "Axes", cell: Cell, at: Reference, dbu_m: float, words: str) -> None:
    """Draw the box of a cell where it is placed, with its name beside it."""
    from matplotlib.patches import Rectangle

    boxes = [shapes.box for shapes in cell.shapes.values() if shapes.box is not None]
    if not boxes:
        return
    unit = dbu_m / MM
    x0, y0 = ((min(box[k] for box in boxes) + start) * unit for k, start in ((0, at.x), (1, at.y)))
    x1, y1 = ((max(box[k] for box in boxes) + start) * unit for k, start in ((2, at.x), (3, at.y)))
    axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, facecolor=MARK, edgecolor="none", alpha=0.75))
    middle: Mapping[str, Any] = {"ha": "center", "va": "center", "fontsize": SMALL, "color": INK}
    # Away from the wafer's rim, which lies below what is above it.
    axes.text((x0 + x1) / 2, y1 + 2.2 if y0 > 0 else y0 - 2.2, words, **middle)
