"""Defects planted in a real order whose manifest was mended to hide them: each must fail, and be named.

The digest and the size of the spoiled file are put right in the manifest, and where a test says so also the digests of
the cells around the DOE, so that the drawing alone can give the defect away.
"""

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import klayout.db as kdb
import numpy as np
import pytest

from fab.errors import InputError
from fab.gds.reader import read_gds
from fab.gds.writer import write_gds
from fab.layout.geometry import Cell, Layer, Layout, Shapes
from fab.manifest.records import Manifest
from fab.order.verify import verify
from fab.verification.shop_checks import drawing_problems
from tests.fab.maps import SMALL
from tests.fab.mended import mend, restate, told

ALL, OASIS = f"{SMALL}_ALL.gds", f"{SMALL}_ALL.oas"
CHROME, M1, M2 = f"{SMALL}_CHROME.gds", f"{SMALL}_M1_75NM.gds", f"{SMALL}_M2_150NM.gds"
SITE = f"{SMALL}_SITE"
NOTHING = np.empty((0, 4), dtype=np.int32)


def redraw(folder: Path, file: str, cell: str, change: Callable[[Shapes], Shapes], layer: Layer | None = None) -> None:
    """Write a mask file again with the shapes of one layer of one cell changed; the cell's first layer by default."""

    def redrawn(one: Cell) -> Cell:
        which = layer or next(iter(one.shapes))
        return replace(one, shapes={**one.shapes, which: change(one.shapes[which])})

    layout = read_gds(folder / file)
    cells = tuple(redrawn(one) if one.name == cell else one for one in layout.cells)
    write_gds(folder / file, Layout(layout.dbu_m, cells))


def with_polygon(*points: tuple[int, int]) -> Callable[[Shapes], Shapes]:
    polygon = np.array(points, dtype=np.int32)
    return lambda shapes: Shapes(shapes.rectangles, (*shapes.polygons, polygon))


def circle(count: int) -> list[tuple[int, int]]:
    angles = 2 * np.pi * np.arange(count) / count
    return [(round(1e6 * np.cos(a)), round(1e6 * np.sin(a))) for a in angles]


# --- what GDSII can hold and no mask may ------------------------------------------------------------------------------


def record(kind: int, *shorts: int, data: bytes = b"") -> bytes:
    body = struct.pack(f">{len(shorts)}h", *shorts) + data
    return struct.pack(">HH", 4 + len(body), kind) + body


def points(*values: int) -> bytes:
    return record(0x1003, data=struct.pack(f">{len(values)}i", *values))


BOX = record(0x2D00) + record(0x0D02, 1) + record(0x2E02, 0) + points(0, 0, 9, 0, 9, 9, 0, 9, 0, 0) + record(0x1100)
PATH = record(0x0900) + record(0x0D02, 1) + record(0x0E02, 0) + points(0, 0, 5000, 0) + record(0x1100)
TEXT = (
    record(0x0C00) + record(0x0D02, 1) + record(0x1602, 0) + points(0, 0) + record(0x1906, data=b"HI") + record(0x1100)
)


@pytest.mark.parametrize(
    ("element", "words"),
    [(BOX, "a box at byte"), (PATH, "a path at byte"), (TEXT, "a text at byte")],
    ids=["box", "path", "text"],
)
def test_boxes_paths_and_texts_are_named(order_folder, element, words):
    data, at = (order_folder / M1).read_bytes(), 0
    while data[at + 2 : at + 4] != b"\x07\x00":  # to the end of the first cell, record by record
        at += int.from_bytes(data[at : at + 2], "big")
    (order_folder / M1).write_bytes(data[:at] + element + data[at:])
    mend(order_folder, M1)
    assert words in told(order_folder, M1)


@pytest.mark.parametrize("what", ["text", "path"])
def test_texts_and_paths_in_the_oasis_file_are_named(order_folder, what):
    layout = kdb.Layout()
    layout.read(str(order_folder / OASIS))
    shapes = layout.cell(SITE).shapes(layout.layer(1, 0))
    shapes.insert(kdb.Text("HI", 0, 0) if what == "text" else kdb.Path([kdb.Point(0, 0), kdb.Point(5000, 0)], 100))
    layout.write(str(order_folder / OASIS))
    mend(order_folder, OASIS)
    assert f"cell {SITE} holds labels or paths" in told(order_folder, OASIS)


def test_a_mirrored_plate_is_named_as_such(order_folder):
    layout = kdb.Layout()
    layout.read(str(order_folder / M1))
    options = kdb.SaveLayoutOptions()
    options.format = "GDS2"
    for instance in layout.top_cell().each_inst():
        instance.trans = kdb.Trans.M90 * instance.trans
    layout.write(str(order_folder / M1), options)
    mend(order_folder, M1)
    # Either KLayout's own records or the mirrored reference itself: no reader may take the file.
    assert "it cannot be read" in told(order_folder, M1)


# --- shapes by themselves: the cells of the manifest are put right as well -------------------------------------------

FAR = 64_000_000


@pytest.mark.parametrize(
    ("polygon", "words"),
    [
        ([(0, 0), (1000, 0), (2000, 0)], "1 polygons without area"),
        ([(0, 0), (1000, 0), (1000, 0), (0, 1000)], "1 polygons with a doubled vertex"),
        ([(0, 0), (4000, 0), (4000, 1000)], "1 polygons with an angle below 45 degrees"),
        ([(0, 0), (2000, 2000), (2000, 0), (0, 2000), (-500, 1000)], "1 polygons that cross or touch themselves"),
        ([(0, 0), (4000, 0), (4000, 2000), (2000, 0), (0, 2000)], "1 polygons that cross or touch themselves"),
        (circle(200), "1 polygons of more than 199 vertices"),
        ([(0, 0), (FAR, 0), (FAR, 900)], "beyond the blank of 127 mm"),
    ],
    ids=["flat", "doubled", "acute", "crossing", "touching", "vertices", "write area"],
)
def test_a_shape_that_no_mask_writer_takes_is_named(order_folder, polygon, words):
    redraw(order_folder, M1, SITE, with_polygon(*polygon))
    mend(order_folder, M1, cells=True)
    problems = told(order_folder, M1)
    # It is no part of the site, whatever the manifest says, ...
    assert f"cell {SITE}: layer 1/0" in problems
    # ... and no mask writer would take it.
    assert words in problems


def test_sound_polygons_are_let_through(order_folder):
    # Right angles, angles of 45 degrees whose corners were rounded, a concave shape, a circle of 199 corners.
    for polygon in ([(0, 0), (1001, 0), (0, 1000)], [(0, 0), (9, 0), (9, 9), (5, 9), (5, 4), (0, 4)], circle(199)):
        redraw(order_folder, M1, SITE, with_polygon(*polygon))
    assert drawing_problems(read_gds(order_folder / M1), 0.127) == []


def test_the_check_of_shapes_does_not_hang_on_a_file_of_many_vertices(written_order):
    layout = read_gds(written_order / M1)
    many = Shapes(NOTHING, (np.array(circle(8000), dtype=np.int32),) * 50)
    doe, *around = layout.cells
    spoiled = replace(layout, cells=(doe, *(replace(c, shapes={Layer(1): many}) for c in around)))
    assert any("more than 199 vertices" in problem for problem in drawing_problems(spoiled, 0.127))


# --- the DOE ---------------------------------------------------------------------------------------------------------


def moved(shapes: Shapes) -> Shapes:
    rects = shapes.rectangles.copy()
    rects[3, 2] += 1
    return Shapes(rects, shapes.polygons)


@pytest.mark.parametrize("file", [ALL, M1])
def test_a_vertex_off_the_raster_is_named(order_folder, file):
    redraw(order_folder, file, f"{SMALL}_DOE", moved, Layer(1))
    mend(order_folder, file)
    problems = told(order_folder, file)
    assert "layer 1/0: 1 rectangles are off the pixel raster, the first is number 3" in problems
    assert "layer 1/0: 1 shapes are no rectangles on the pixel raster" in problems


def turned(shapes: Shapes) -> Shapes:
    polygon = shapes.polygons[2].copy()
    # A nanometre along the circle: within the chord error, and hardly any area.
    polygon[5] += np.sign(np.array([-polygon[5][1], polygon[5][0]]))
    return Shapes(shapes.rectangles, (*shapes.polygons[:2], polygon, *shapes.polygons[3:]))


@pytest.mark.parametrize("file", [ALL, CHROME])
def test_a_vertex_of_the_chrome_that_moved_by_a_nanometre_is_named(order_folder, file):
    redraw(order_folder, file, f"{SMALL}_DOE", turned, Layer(5))
    mend(order_folder, file)
    assert "layer 5/0: the chrome has another vertex, or one elsewhere" in told(order_folder, file)


def test_two_layers_exchanged_in_the_review_files_are_named(order_folder):
    layout = read_gds(order_folder / ALL)
    cells = []
    for cell in layout.cells:
        names = {Layer(1): Layer(2), Layer(2): Layer(1)}
        cells.append(replace(cell, shapes={names.get(layer, layer): s for layer, s in cell.shapes.items()}))
    write_gds(order_folder / ALL, Layout(layout.dbu_m, tuple(cells)))
    mend(order_folder, ALL, cells=True)
    problems = told(order_folder, ALL)
    for layer in ("1/0", "2/0"):
        assert f"layer {layer}: " in problems
    assert "pixels differ from the level map" in problems


def test_two_mask_files_exchanged_are_named(order_folder):
    one, other = (order_folder / M1).read_bytes(), (order_folder / M2).read_bytes()
    (order_folder / M1).write_bytes(other)
    (order_folder / M2).write_bytes(one)
    mend(order_folder, M1, M2)
    assert f"the top cell is named '{SMALL}_M2_150NM' instead of '{SMALL}_M1_75NM'" in told(order_folder, M1)
    assert "layer 2/0 should be empty" in told(order_folder, M1)
    assert "layer 1/0" in told(order_folder, M2)


def mirrored(shapes: Shapes) -> Shapes:
    sign = np.array([-1, 1, -1, 1], dtype=np.int32)
    polygons = tuple(polygon[::-1] * np.array([-1, 1], dtype=np.int32) for polygon in shapes.polygons)
    return Shapes(shapes.rectangles[:, [2, 1, 0, 3]] * sign, polygons)


def test_a_plate_drawn_mirrored_is_named(order_folder):
    layout = read_gds(order_folder / M1)
    flipped = tuple(
        replace(
            cell,
            shapes={layer: mirrored(shapes) for layer, shapes in cell.shapes.items()},
            references=tuple(replace(r, x=-r.x - (r.columns - 1) * r.step_x) for r in cell.references),
        )
        for cell in layout.cells
    )
    write_gds(order_folder / M1, replace(layout, cells=flipped))
    mend(order_folder, M1)
    assert f"cell {SITE}: layer 1/0" in told(order_folder, M1)
    mend(order_folder, M1, cells=True)
    problems = told(order_folder, M1)
    assert "own reader, every pixel: layer 1/0:" in problems
    assert "gdstk, every pixel: layer 1/0:" in problems
    assert "pixels differ from the level map" in problems


@pytest.mark.parametrize("file", [ALL, M1])
def test_a_mark_that_moved_by_a_nanometre_is_named(order_folder, file):
    def shift(shapes: Shapes) -> Shapes:
        rects = shapes.rectangles.copy()
        rects[0] += 1
        return Shapes(rects, shapes.polygons)

    layout = read_gds(order_folder / file)
    site = layout.cell(SITE)
    assert site is not None
    layer = next(layer for layer in site.shapes if layer.number == 1)
    redraw(order_folder, file, SITE, shift, layer)
    mend(order_folder, file)
    assert f"cell {SITE}: layer {layer}: " in told(order_folder, file)
    assert "or elsewhere" in told(order_folder, file)


def test_a_wrong_unit_is_named(order_folder):
    layout = read_gds(order_folder / M1)
    write_gds(order_folder / M1, replace(layout, dbu_m=2e-9))
    oasis = kdb.Layout()
    oasis.read(str(order_folder / OASIS))
    oasis.dbu = 0.002
    oasis.write(str(order_folder / OASIS))
    mend(order_folder, M1, OASIS)
    for file in (M1, OASIS):
        assert "the database unit is 2 nm instead of 1 nm" in told(order_folder, file)


def test_a_missing_mask_is_named(order_folder):
    (order_folder / M2).unlink()
    assert f"{M2}: bytes as in the manifest: the file is missing" in verify(order_folder).differences
    restate(order_folder, lambda m: replace(m, files=[e for e in m.files if e.file != M2]))
    with pytest.raises(InputError, match=rf"every file must be listed.*{M2}"):
        verify(order_folder)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"area_um2": 1.0}, f"masks[{M1}].area_um2 is 1.0 instead of "),
        ({"box_um": [0.0, 0.0, 1.0, 1.0]}, f"masks[{M1}].box_um[0] is 0.0 instead of -"),
        ({"polygons": 7}, f"masks[{M1}].polygons is 7 instead of "),
        ({"smallest_space_um": 3.7}, f"masks[{M1}].smallest_space_um is 3.7 instead of 1.85"),
    ],
)
def test_wrong_numbers_of_a_mask_are_named(order_folder, change, words):
    restate(order_folder, lambda m: replace(m, masks=[replace(m.masks[0], **change), *m.masks[1:]]))
    assert words in told(order_folder, "manifest.json")


def test_a_wrong_density_is_named(order_folder):
    def change(manifest: Manifest) -> Manifest:
        first, *others = manifest.rules["planes"]
        return replace(manifest, rules={**manifest.rules, "planes": [{**first, "density": 0.5}, *others]})

    restate(order_folder, change)
    assert "rules.planes[1].density is 0.5 instead of " in told(order_folder, "manifest.json")
    restate(order_folder, lambda m: replace(m, rules={**m.rules, "rules": {"minimum_line_m": "thin"}}))
    assert "rules.rules.minimum_line_m is 'thin' instead of 0.0" in told(order_folder, "manifest.json")
