"""What the tests of drawings share: how other libraries see parts and dies, and which corners only touch."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fab.layout.geometry import Cell, Layer
from fab.layout.part import Part
from fab.manifest.records import read_manifest


def chrome_of_dies(order: Path) -> Iterator[list[Any]]:
    """Polygons of the chrome of every kind of die of an order, all that its cell places included, read by gdstk."""
    import gdstk

    chrome = read_manifest(order).chrome
    cells: list[Any] = gdstk.read_gds(str(order / chrome.file)).cells
    dies = [cell for cell in cells if cell.name.endswith("_DIE")]
    assert dies
    for die in dies:
        yield [polygon for polygon in die.get_polygons() if polygon.layer == chrome.layer]


def die_chrome(order: Path) -> Any:
    """Chrome of a die of an order without its marks, all that its cell places included, merged by KLayout."""
    from klayout import db

    manifest, layout = read_manifest(order), db.Layout()
    layout.read(str(order / manifest.combined_oasis))
    die = next(cell for cell in layout.each_cell() if cell.name.endswith("_DIE"))
    return db.Region(die.begin_shapes_rec(layout.layer(manifest.chrome.layer, 0))).merged()


def marks_window_um(order: Path) -> tuple[float, float, float, float]:
    """The box x0, y0, x1, y1 around the marks of a die of an order in which it has no chrome, micrometres."""
    from klayout import db

    chrome = die_chrome(order)
    (window,) = (
        hole.bbox() for hole in (db.Region(chrome.bbox()) - chrome).each() if hole.bbox().right > 0 > hole.bbox().top
    )
    return window.left * 1e-3, window.bottom * 1e-3, window.right * 1e-3, window.top * 1e-3


def region(part: Part | Cell, *layers: Layer):
    """What KLayout makes of some layers of a part or a cell, not merged."""
    from klayout import db

    out = db.Region()
    out.merged_semantics = False
    for layer in layers:
        shapes = part.shapes[layer]
        for box in shapes.rectangles.tolist():
            out.insert(db.Box(*box))
        for polygon in shapes.polygons:
            out.insert(db.Polygon([db.Point(*vertex) for vertex in polygon.tolist()]))
    return out


def numbers(part: Part) -> list[int]:
    return sorted({layer.number for layer in part.shapes})


def layers_of(part: Part, number: int) -> list[Layer]:
    return [layer for layer in part.shapes if layer.number == number]


def kissing_corners(boxes: np.ndarray) -> int:
    """How many points are touched by two boxes from opposite sides and by nothing from the others."""
    x, y = np.unique(boxes[:, ::2]), np.unique(boxes[:, 1::2])
    plane = np.zeros((y.size + 1, x.size + 1), dtype=bool)
    columns, rows = np.searchsorted(x, boxes[:, ::2]) + 1, np.searchsorted(y, boxes[:, 1::2]) + 1
    for (x0, x1), (y0, y1) in zip(columns, rows, strict=True):
        plane[y0:y1, x0:x1] = True
    a, b, c, d = plane[:-1, :-1], plane[:-1, 1:], plane[1:, :-1], plane[1:, 1:]
    return int(np.count_nonzero((a & d & ~b & ~c) | (b & c & ~a & ~d)))


def assert_sound(part: Part, least_m: float) -> None:
    """Every mask: rectangles that share no area, no kissing corner, no line and no gap below the least."""
    least = round(least_m / part.dbu_m)
    for number in numbers(part):
        layers = layers_of(part, number)
        assert all(part.shapes[layer].polygons == () for layer in layers)
        boxes = np.concatenate([part.shapes[layer].rectangles for layer in layers])
        assert (boxes[:, :2] < boxes[:, 2:]).all()
        drawn = region(part, *layers)
        merged = drawn.merged()
        # Equal areas: nothing is drawn twice, within a datatype or between them.
        assert merged.area() == drawn.area(), number
        assert kissing_corners(boxes) == 0, number
        assert merged.width_check(least).is_empty(), number
        assert merged.space_check(least).is_empty(), number
        assert merged.notch_check(least).is_empty(), number
