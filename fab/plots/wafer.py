"""The picture of a whole photomask: blank, wafer, dies, alignment sites, test structures and labels."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from fab.figure import CHROME, FAINT, INK, LINE, MARK, SMALL, length_text, single
from fab.plots.maps import outline_of
from fab.units import MM

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fab.aperture import Aperture
    from fab.layout.frame import Frame
    from fab.layout.geometry import Shapes
    from fab.layout.wafer import Wafer

_CENTRED: Any = {"ha": "center", "va": "center", "fontsize": SMALL}
# The layer of its outline.
_WAFER = 101
_SITES = {"SITE": "A", "TEST": "M"}


def plot_wafer(
    wafer: "Wafer", frame: "Frame", relief: "Aperture", dbu_m: float, title: str = "", ax: "Axes | None" = None
) -> "Axes":
    """Draw where everything lies on a photomask, seen from the etched side.

    The cells around the DOE are the frame (`fab.layout.frame.draw_frame`); dies that draw it differently bear their
    number. `relief` is its outline; the database unit is metres.
    """
    from matplotlib.patches import Circle, Polygon, Rectangle

    cells = {cell.name: cell for cell in frame.cells}
    top, around = frame.cells[-1], frame.cells[-2]
    # Patches are added as artists, since limits are given: looking for those of each takes a third of the time.
    with single(ax, (7.0, 7.6), title, _words(wafer, frame)) as axes:
        half = wafer.blank_m / 2 / MM
        axes.add_artist(Rectangle((-half, -half), 2 * half, 2 * half, facecolor="#f3f3f1", edgecolor=INK, lw=1.2))
        (outline,) = next(drawn for layer, drawn in around.shapes.items() if layer.number == _WAFER).polygons
        axes.add_artist(Polygon(outline * (dbu_m / MM), facecolor="white", edgecolor=LINE, lw=1.2))
        usable = (wafer.diameter_m / 2 - wafer.edge_exclusion_m) / MM
        axes.add_artist(Circle((0, 0), usable, fill=False, edgecolor=FAINT, lw=0.8, ls="--"))
        side = frame.die_m / MM
        for (x_m, y_m), split in zip(frame.dies, frame.splits, strict=True):
            x, y = x_m / MM, y_m / MM
            axes.add_artist(Rectangle((x - side / 2, y - side / 2), side, side, fill=False, ec=FAINT, lw=0.8))
            axes.add_artist(outline_of(relief, (x, y), facecolor=CHROME, edgecolor="none"))
            if split:
                axes.text(x - 0.46 * side, y + 0.46 * side, f"{split}", va="top", fontsize=SMALL)
        for reference in around.references:
            kind = reference.cell.rpartition("_")[2]
            if kind in _SITES:
                at, letter = (reference.x, reference.y), {"color": "white", "weight": "bold", **_CENTRED}
                x0, y0, x1, y1 = _box(axes, cells[reference.cell].shapes.values(), at, dbu_m)
                axes.text((x0 + x1) / 2, (y0 + y1) / 2, _SITES[kind], **letter)
        labels = [shapes for layer, shapes in top.shapes.items() if layer.datatype == 3]
        x0, _, x1, y1 = _box(axes, labels, (0, 0), dbu_m)
        axes.text((x0 + x1) / 2, y1 + 1.3, "labels, one per mask", **_CENTRED)
        for layer, shapes in top.shapes.items():
            for box in shapes.rectangles.tolist() if layer.datatype == 1 else ():
                _fill(axes, box, dbu_m)
        axes.set(xlim=(-half - 1, half + 1), ylim=(-half - 1, half + 1), aspect="equal")
        axes.set(xlabel="x (mm)", ylabel="y (mm)")
    return axes


def _words(wafer: "Wafer", frame: "Frame") -> str:
    numbered = " Numbered dies: splits, drawn differently on purpose; the manifest and the run sheet say how."
    return (
        f"Blank of {length_text(wafer.blank_m)}, wafer of {length_text(wafer.diameter_m)} and "
        f"{length_text(wafer.thickness_m)}, {len(frame.dies)} dies {length_text(frame.pitch_m)} apart. "
        f"Seen from the etched side, +y up; {wafer.reading}. Grey: reliefs. "
        "A: alignment sites, M: process monitors. Dashed: edge exclusion." + (numbered if any(frame.splits) else "")
    )


def _box(axes: "Axes", drawn: "Iterable[Shapes]", at: tuple[int, int], dbu_m: float) -> tuple[float, ...]:
    """Fill the box around some shapes where they are placed, and return its edges in millimetres."""
    low_x, low_y, high_x, high_y = zip(*(shapes.box for shapes in drawn if shapes.box is not None), strict=True)
    x, y = at
    return _fill(axes, (min(low_x) + x, min(low_y) + y, max(high_x) + x, max(high_y) + y), dbu_m)


def _fill(axes: "Axes", box: "Sequence[int]", dbu_m: float) -> tuple[float, ...]:
    """Fill a box of database units, and return its edges in millimetres."""
    from matplotlib.patches import Rectangle

    x0, y0, x1, y1 = edges = tuple(edge * dbu_m / MM for edge in box)
    axes.add_artist(Rectangle((x0, y0), x1 - x0, y1 - y0, facecolor=MARK, edgecolor="none", alpha=0.75))
    return edges
