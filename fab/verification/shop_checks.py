"""Checks of a mask shop on receipt, whatever is drawn: every shape by itself, where all of them lie, their numbers.

A mask writer takes simple polygons of up to 199 vertices and of some area, whose edges neither cross nor meet at less
than 45 degrees, and nothing beyond the blank. These questions are put to the drawing, not to the manifest, so that a
drawing which was wrong from the beginning fails, too.
"""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.layout.geometry import Cell, Layout, placed_boxes, require_name
from fab.layout.polygons import MAX_VERTICES, doubled_area
from fab.units import format_length

_LEAST_ANGLE_RAD = math.pi / 4
# A right angle or half of one whose corners were rounded to the database unit.
_SLACK = 1e-3
# Of one layer of one cell; a sound drawing has a few dozen that are no rectangles.
_MOST_LOOKED_AT = 2000


def drawing_problems(layout: Layout, blank_m: float) -> list[str]:
    """Check every shape and name of a file, and where all of it lies; a sentence per kind of defect."""
    problems = [problem for cell in layout.cells for problem in _cell_problems(cell)]
    return problems + _place_problems(layout, blank_m)


def _cell_problems(cell: Cell) -> Iterator[str]:
    try:
        require_name(cell.name)
    except InputError as error:
        yield f"the name of cell {cell.name!r} {error.rule}"
    for layer, shapes in cell.shapes.items():
        where = f"cell {cell.name}: layer {layer}"
        defects = [defect for polygon in shapes.polygons[:_MOST_LOOKED_AT] for defect in _defects(polygon)]
        for kind in dict.fromkeys(defects):
            yield f"{where}: {defects.count(kind)} polygons {kind}"


def _defects(polygon: NDArray[np.integer]) -> Iterator[str]:
    """Yield the reasons why a mask writer would not take a polygon."""
    points = np.asarray(polygon, dtype=np.int64)
    if len(points) > MAX_VERTICES:
        yield f"of more than {MAX_VERTICES} vertices"
        return
    edges = np.roll(points, -1, axis=0) - points
    if not edges.any(axis=1).all():
        yield "with a doubled vertex"
        return
    if doubled_area(points) == 0:
        yield "without area"
        return
    back, on = -np.roll(edges, 1, axis=0).astype(np.float64), edges.astype(np.float64)
    cosine = np.sum(back * on, axis=1) / (np.hypot(*back.T) * np.hypot(*on.T))
    if np.any(cosine > math.cos(_LEAST_ANGLE_RAD) + _SLACK):
        yield "with an angle below 45 degrees"
    if _crosses(points):
        yield "that cross or touch themselves"


def _side(a: NDArray[np.int64], b: NDArray[np.int64], c: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return on which side of the line a-b the point c lies: 1, -1, or 0 on it."""
    u, v = b - a, c - a
    return np.sign(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])


def _crosses(points: NDArray[np.int64]) -> bool:
    """Whether two edges of a polygon that are no neighbours meet; a vertex on another edge counts."""
    count = len(points)
    first, second = np.triu_indices(count, 2)
    apart = (second - first) % count != count - 1
    first, second = first[apart], second[apart]
    ahead = np.roll(points, -1, axis=0)
    a, b, c, d = points[first], ahead[first], points[second], ahead[second]
    # Edges whose boxes do not meet are out of the question, and those on one line meet if their boxes do.
    meet = (np.minimum(a, b) <= np.maximum(c, d)).all(axis=1) & (np.minimum(c, d) <= np.maximum(a, b)).all(axis=1)
    a, b, c, d = a[meet], b[meet], c[meet], d[meet]
    return bool(np.any((_side(a, b, c) * _side(a, b, d) <= 0) & (_side(c, d, a) * _side(c, d, b) <= 0)))


def _place_problems(layout: Layout, blank_m: float) -> list[str]:
    """Check that all of every layer, with what its cell places, lies on the blank."""
    most = round(blank_m / 2 / layout.dbu_m)
    return [
        f"layer {layer} reaches {format_length(reach * layout.dbu_m)} from the middle, beyond the blank of "
        f"{format_length(blank_m)}"
        for layer, box in placed_boxes(layout).items()
        if (reach := max(abs(edge) for edge in box)) > most
    ]
