"""The picture of a whole photomask: blank, wafer, dies, alignment sites, test structures and labels."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from fab.figure import CHROME, FAINT, INK, LINE, MARK, SMALL, length_text, single
from fab.units import MM

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fab.layout.frame import Frame
    from fab.layout.geometry import Shapes
    from fab.layout.wafer import Wafer

_SITES = {"SITE": "alignment site", "TEST": "test structures"}


def plot_wafer(
    wafer: "Wafer", frame: "Frame", aperture_m: float, dbu_m: float, title: str = "", ax: "Axes | None" = None
) -> "Axes":
    """Draw where everything lies on a photomask, seen from the etched side.

    The cells around the DOE are the frame (`fab.layout.frame.draw_frame`); dies that draw it differently bear their
    number. Diameter of the relief and database unit are metres.
    """
    from matplotlib.patches import Circle, Rectangle

    cells = {cell.name: cell for cell in frame.cells}
    top, around = frame.cells[-1], frame.cells[-2]
    with single(ax, (7.0, 7.6), title, _words(wafer, frame)) as axes:
        half = wafer.blank_m / 2 / MM
        axes.add_patch(Rectangle((-half, -half), 2 * half, 2 * half, facecolor="#f3f3f1", edgecolor=INK, lw=1.2))
        axes.add_patch(Circle((0, 0), wafer.diameter_m / 2 / MM, facecolor="white", edgecolor=LINE, lw=1.2))
        side = frame.die_m / MM
        for (x_m, y_m), split in zip(frame.dies, frame.splits, strict=True):
            x, y = x_m / MM, y_m / MM
            axes.add_patch(Rectangle((x - side / 2, y - side / 2), side, side, fill=False, ec=FAINT, lw=0.8))
            axes.add_patch(Circle((x, y), aperture_m / 2 / MM, facecolor=CHROME, edgecolor="none"))
            if split:
                axes.text(x - 0.46 * side, y + 0.46 * side, f"{split}", va="top", fontsize=SMALL)
        for reference in around.references:
            kind = reference.cell.rpartition("_")[2]
            if kind in _SITES:
                _box(axes, cells[reference.cell].shapes.values(), (reference.x, reference.y), dbu_m, _SITES[kind])
        labels = [shapes for layer, shapes in top.shapes.items() if layer.datatype == 3]
        _box(axes, labels, (0, 0), dbu_m, "labels, one per mask")
        axes.set(xlim=(-half - 1, half + 1), ylim=(-half - 1, half + 1), aspect="equal")
        axes.set(xlabel="x (mm)", ylabel="y (mm)")
    return axes


def _words(wafer: "Wafer", frame: "Frame") -> str:
    rows, columns = frame.raster
    numbered = " Numbered dies: splits, drawn differently on purpose; the manifest and the run sheet say how."
    return (
        f"Blank of {length_text(wafer.blank_m)}, wafer of {length_text(wafer.diameter_m)} and "
        f"{length_text(wafer.thickness_m)}, {rows} x {columns} dies {length_text(frame.die_m)} apart. "
        f"Seen from the etched side, +y up; {wafer.reading}. Grey: reliefs." + (numbered if any(frame.splits) else "")
    )


def _box(axes: "Axes", drawn: "Iterable[Shapes]", at: tuple[int, int], dbu_m: float, words: str) -> None:
    """Draw the box around some shapes where they are placed, with its name beside it."""
    from matplotlib.patches import Rectangle

    boxes = [shapes.box for shapes in drawn if shapes.box is not None]
    if not boxes:
        return
    unit = dbu_m / MM
    x0, y0 = ((min(box[k] for box in boxes) + start) * unit for k, start in ((0, at[0]), (1, at[1])))
    x1, y1 = ((max(box[k] for box in boxes) + start) * unit for k, start in ((2, at[0]), (3, at[1])))
    axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, facecolor=MARK, edgecolor="none", alpha=0.75))
    centred: Any = {"ha": "center", "va": "center", "fontsize": SMALL}
    # Away from the wafer's rim, which lies below what is above it.
    axes.text((x0 + x1) / 2, y1 + 2.2 if y0 > 0 else y0 - 2.2, words, **centred)
