from dataclasses import replace
from typing import Any

import gdstk
import klayout.db as kdb
import numpy as np
import pytest

from fab.errors import InputError
from fab.gds.reader import read_gds
from fab.gds.writer import write_gds
from fab.layout.geometry import Cell, Layer, Layout, Reference, Shapes
from fab.units import NM

TRIANGLE = np.array([[0, 0], [1000, 0], [0, -1000]], dtype=np.int32)


@pytest.fixture
def gds(tmp_path):
    """Two layers, rectangles and polygons."""
    path = tmp_path / "a.gds"
    rng = np.random.default_rng(3)
    corner = rng.integers(-(10**9), 10**9, (500, 2))
    rects = np.hstack([corner, corner + rng.integers(1, 10**6, (500, 2))]).astype(np.int32)
    shapes = {Layer(2): Shapes(rects, (TRIANGLE,)), Layer(300, 7): Shapes(rects[:3], (TRIANGLE, TRIANGLE[::-1]))}
    write_gds(path, Layout(NM, (Cell("TOP", shapes),)))
    return path


def test_everything_comes_back_exactly(gds):
    layout = read_gds(gds)
    assert (layout.top.name, layout.dbu_m) == ("TOP", pytest.approx(NM, rel=1e-15))
    assert list(layout.cells[0].shapes) == [Layer(2), Layer(300, 7)]
    assert [len(s.rectangles) for s in layout.cells[0].shapes.values()] == [500, 3]
    assert np.array_equal(layout.cells[0].shapes[Layer(300, 7)].polygons[1], TRIANGLE[::-1])
    write_gds(gds.with_name("b.gds"), layout)
    assert gds.read_bytes() == gds.with_name("b.gds").read_bytes()


def test_a_file_of_another_program_is_read_alike(tmp_path):
    library = gdstk.Library(unit=1e-6, precision=1e-9)
    cell = library.new_cell("TOP")
    cell.add(gdstk.rectangle((0, 0), (1, 2), layer=1), gdstk.rectangle((3, 3), (2, 1), layer=1))
    cell.add(gdstk.Polygon([(0, 0), (0, 1), (1, 1), (1, 0)], layer=2))  # clockwise
    cell.add(gdstk.Polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], layer=2))
    library.write_gds(str(tmp_path / "a.gds"))
    layout = read_gds(tmp_path / "a.gds")
    assert layout.cells[0].shapes[Layer(1)].rectangles.tolist() == [[0, 0, 1000, 2000], [2000, 1000, 3000, 3000]]
    assert layout.cells[0].shapes[Layer(2)].rectangles.tolist() == [[0, 0, 1000, 1000]]
    assert [len(p) for p in layout.cells[0].shapes[Layer(2)].polygons] == [6]


def test_blocks_meet_without_a_seam(tmp_path):
    # More than two blocks of four megabytes, with polygons of odd length that shift the elements off the block edges.
    x = np.arange(140_000, dtype=np.int32)[:, None] * 5
    rects = np.hstack([x, -x, x + 4, -x + 3])
    shapes = {Layer(1): Shapes(rects[:70_000], (TRIANGLE,)), Layer(2): Shapes(rects[70_000:], (TRIANGLE,) * 3)}
    write_gds(tmp_path / "a.gds", Layout(NM, (Cell("TOP", shapes),)))
    again = read_gds(tmp_path / "a.gds").cells[0].shapes
    assert np.array_equal(again[Layer(1)].rectangles, rects[:70_000])
    assert np.array_equal(again[Layer(2)].rectangles, rects[70_000:])
    assert len(again[Layer(2)].polygons) == 3


def test_a_rectangle_without_area_is_no_rectangle(tmp_path):
    flat = np.array([[0, 0], [5, 0], [5, 0], [0, 0]], dtype=np.int32)
    shapes = {Layer(1): Shapes(np.empty((0, 4), dtype=np.int32), (flat,))}
    write_gds(tmp_path / "a.gds", Layout(NM, (Cell("TOP", shapes),)))
    found = read_gds(tmp_path / "a.gds").cells[0].shapes[Layer(1)]
    assert (len(found.rectangles), len(found.polygons)) == (0, 1)


def test_every_cut_is_refused_with_the_offset(gds):
    whole = gds.read_bytes()
    for length in [0, 1, 3, 4, 50, 100, 130, 131, 200, len(whole) // 2, len(whole) - 8, len(whole) - 4, len(whole) - 1]:
        gds.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"a\.gds: .*byte \d+|UNITS"):
            read_gds(gds)


def test_zeros_may_follow_the_end_and_nothing_else(gds):
    whole = gds.read_bytes()
    gds.write_bytes(whole + bytes(2048))
    assert len(read_gds(gds).cells[0].shapes) == 2
    gds.write_bytes(whole + b"\0\0x")
    with pytest.raises(InputError, match="end record"):
        read_gds(gds)


def test_a_boundary_that_does_not_close_is_refused(gds):
    whole = bytearray(gds.read_bytes())
    start = whole.index(b"\x00\x2c\x10\x03")
    whole[start + 4 + 39] ^= 1
    gds.write_bytes(whole)
    with pytest.raises(InputError, match=f"first point, but got something else at byte {start}"):
        read_gds(gds)


def test_other_elements_are_refused(tmp_path):
    library = gdstk.Library()
    cell = library.new_cell("TOP")
    cell.add(gdstk.Label("text", (0, 0)))
    library.write_gds(str(tmp_path / "a.gds"))
    with pytest.raises(InputError, match="plain boundaries"):
        read_gds(tmp_path / "a.gds")


def plate() -> Layout:
    """Cells three deep: a die with two shapes, placed on a raster, and once more beside it."""
    square = Shapes(np.array([[0, 0, 10, 20]], np.int32), (np.array([[0, 0], [5, 9], [9, 2]], np.int32),))
    die = Cell("DIE", {Layer(3): square, Layer(3, 1): Shapes(np.array([[30, 0, 40, 5]], np.int32))})
    wafer = Cell("WAFER", {}, (Reference("DIE", -100, 50, 3, 2, 200, 300), Reference("DIE", 7, -9)))
    return Layout(NM, (die, wafer, Cell("PLATE", {Layer(100): square}, (Reference("WAFER"),))))


def test_placed_cells_come_back_as_they_are_and_as_other_readers_see_them(tmp_path):
    write_gds(tmp_path / "a.gds", plate())
    again = read_gds(tmp_path / "a.gds")
    assert [cell.name for cell in again.cells] == ["DIE", "WAFER", "PLATE"]
    assert [cell.references for cell in again.cells] == [cell.references for cell in plate().cells]
    assert [list(cell.shapes) for cell in again.cells] == [[Layer(3), Layer(3, 1)], [], [Layer(100)]]
    write_gds(tmp_path / "b.gds", again)
    assert (tmp_path / "a.gds").read_bytes() == (tmp_path / "b.gds").read_bytes()
    top: Any = gdstk.read_gds(str(tmp_path / "a.gds")).top_level()[0]
    boxes = [polygon.bounding_box() for polygon in top.get_polygons(layer=3, datatype=1)]
    corners = sorted(tuple(round(1e3 * v) for v in low) for low, _ in boxes)
    expected = [(x + 30, y) for x in (-100, 100, 300) for y in (50, 350)] + [(37, -9)]
    assert corners == sorted(map(tuple, expected))
    layout = kdb.Layout()
    layout.read(str(tmp_path / "a.gds"))
    drawn = kdb.Region(layout.top_cell().begin_shapes_rec(layout.layer(3, 1)))
    assert {(b.left, b.bottom) for b in (p.bbox() for p in drawn.each())} == set(expected)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda cells: cells[1:], "'DIE' is missing"),
        (lambda cells: (*cells, Cell("LOOSE", {})), "2 cells instead of one"),
        (lambda cells: (*cells, cells[0]), "two cells are named 'DIE'"),
        (lambda cells: (replace(cells[0], references=(Reference("WAFER"),)), *cells[1:]), "places itself"),
    ],
)
def test_cells_that_make_no_drawing_are_refused(tmp_path, change, words):
    write_gds(tmp_path / "a.gds", replace(plate(), cells=change(plate().cells)))
    with pytest.raises(InputError, match=words):
        read_gds(tmp_path / "a.gds")


def test_turned_mirrored_and_slanted_references_are_refused(tmp_path):
    raster: dict[str, Any] = {"columns": 2, "rows": 2, "spacing": (1, 1)}
    ways: list[dict[str, Any]] = [{"rotation": 1.0}, {"x_reflection": True}, {**raster, "rotation": 0.1}]
    for options in ways:
        library = gdstk.Library()
        cell, top = library.new_cell("A"), library.new_cell("TOP")
        cell.add(gdstk.rectangle((0, 0), (1, 1)))
        top.add(gdstk.Reference(cell, (0, 0), **options))
        library.write_gds(str(tmp_path / "a.gds"))
        with pytest.raises(InputError, match="upright"):
            read_gds(tmp_path / "a.gds")


@pytest.mark.parametrize("nested", [False, True])
def test_flipped_bytes_never_pass_for_an_error_of_the_program(gds, nested):
    if nested:
        write_gds(gds, plate())
    whole = gds.read_bytes()
    rng = np.random.default_rng(5)
    places = [*range(150), *rng.integers(150, len(whole), 300).tolist(), *range(len(whole) - 8, len(whole))]
    refused: list[str] = []
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        gds.write_bytes(damaged)
        # Read or refused: any other exception would fail here.
        try:
            read_gds(gds)
        except InputError as error:
            refused.append(str(error))
    # Names, coordinates and times may be anything; lengths, types and units may not.
    assert len(places) / 10 < len(refused) < len(places)
    assert all(str(gds) in message for message in refused)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"missing\.gds: the file must exist"):
        read_gds(tmp_path / "missing.gds")
    with pytest.raises(InputError, match="must be a file"):
        read_gds(tmp_path)
