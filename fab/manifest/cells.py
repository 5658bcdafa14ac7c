"""Cells as the manifest states them: how much is drawn on each layer, what is placed where, and a digest."""

import numpy as np
from numpy.typing import NDArray

from fab.files import sha256_bytes
from fab.layout.geometry import Cell, Shapes
from fab.layout.polygons import doubled_area
from fab.manifest.records import CellEntry, LayerEntry
from fab.units import UM


def geometry(shapes: Shapes, dbu_m: float) -> dict[str, object]:
    """Return polygons, area_um2 and box_um (x0, y0, x1, y1, or None) of shapes, as the manifest states them."""
    box, unit_um = shapes.box, dbu_m / UM
    return {
        "polygons": len(shapes),
        "area_um2": round(shapes.doubled_area / 2 * unit_um**2, 6),
        "box_um": None if box is None else [round(edge * unit_um, 6) for edge in box],
    }


def _from_lowest(polygon: NDArray[np.integer]) -> bytes:
    """Return a polygon as bytes, counter-clockwise from its lowest vertex on, wherever the writer began."""
    points = np.asarray(polygon, np.int64)
    if doubled_area(points) < 0:
        points = points[::-1]
    first = int(np.lexsort((points[:, 0], points[:, 1]))[0])
    return np.roll(points, -first, axis=0).astype("<i4").tobytes()


def shapes_digest(shapes: Shapes) -> str:
    """SHA-256 of shapes, whatever their order and wherever each begins.

    The rectangles x0, y0, x1, y1 in increasing order as little-endian 32-bit numbers, then every other polygon
    counter-clockwise from its lowest leftmost vertex, the polygons in the order of their bytes.
    """
    rects = np.asarray(shapes.rectangles, np.int32).reshape(-1, 4)
    rects = rects[np.lexsort(rects.T[::-1])]
    polygons = sorted(_from_lowest(polygon) for polygon in shapes.polygons)
    return sha256_bytes(rects.astype("<i4").tobytes() + b"".join(polygons))


def cell_entry(cell: Cell, dbu_m: float) -> CellEntry:
    """Return the manifest's entry of a cell: layers and copies of placed cells sorted, empty layers left out."""
    layers = [
        LayerEntry(layer=str(layer), sha256=shapes_digest(shapes), **geometry(shapes, dbu_m))  # type: ignore[arg-type]
        for layer, shapes in sorted(cell.shapes.items(), key=lambda pair: (pair[0].number, pair[0].datatype))
        if len(shapes)
    ]
    unit_um = dbu_m / UM
    places = sorted(
        [r.cell, round((r.x + column * r.step_x) * unit_um, 6), round((r.y + row * r.step_y) * unit_um, 6)]
        for r in cell.references
        for column in range(r.columns)
        for row in range(r.rows)
    )
    return CellEntry(cell.name, layers, places)
