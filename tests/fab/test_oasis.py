"""OASIS files: whatever is drawn, both libraries find it again, and as cheaply as it can be said."""

import gdstk
import klayout.db as kdb
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fab.gds.oasis import write_oasis
from fab.gds.plain import plain_cells
from fab.gds.reader import read_gds
from fab.gds.writer import oasis_to_gds, write_gds
from fab.layout.geometry import Cell, Layer, Layout, Reference, Shapes
from fab.manifest.cells import cell_entry
from fab.units import NM

FAR = 10**9  # a metre: readers add steps in 32 bits
CORNER = st.integers(-FAR // 4, FAR // 4)
SIZE = st.integers(1, 300)
RECTANGLE = st.tuples(CORNER, CORNER, SIZE, SIZE).map(lambda r: [r[0], r[1], r[0] + r[2], r[1] + r[3]])
TRIANGLE = st.tuples(CORNER, CORNER, SIZE, SIZE).map(
    lambda t: np.array([[t[0], t[1]], [t[0] + t[2], t[1]], [t[0] + 7, t[1] + t[3]]], dtype=np.int32)
)
STEP = st.integers(-FAR // 100, FAR // 100).filter(bool)
COUNT = st.integers(1, 3)
PLACED = st.builds(Reference, st.just("BELOW"), CORNER, CORNER, COUNT, COUNT, STEP, STEP)


def shapes_of(rects, polygons=()):
    return Shapes(np.array(rects, dtype=np.int32).reshape(-1, 4), tuple(polygons))


SHAPES = st.builds(shapes_of, st.lists(RECTANGLE, max_size=8), st.lists(TRIANGLE, max_size=2))


def entries(layout):
    return {cell.name: cell_entry(cell, layout.dbu_m) for cell in layout.cells}


def as_polygons(cell):
    """The same cell without rectangles, since a library does not tell them from other polygons."""
    return Cell(cell.name, {layer: polygons_of(shapes) for layer, shapes in cell.shapes.items()}, cell.references)


def polygons_of(shapes):
    corners = shapes.rectangles[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 4, 2)
    return Shapes(polygons=(*corners, *shapes.polygons))


@settings(max_examples=20)
@given(low=SHAPES, here=SHAPES, placed=st.lists(PLACED, min_size=1, max_size=3))
def test_both_libraries_find_every_shape_and_every_place(tmp_path_factory, low, here, placed):
    folder = tmp_path_factory.mktemp("oasis")
    below, top = Cell("BELOW", {Layer(300, 7, "LOW"): low}), Cell("TOP", {Layer(1): here}, tuple(placed))
    layout = Layout(NM, (below, top))
    write_oasis(folder / "a.oas", layout)
    assert gdstk.oas_validate(str(folder / "a.oas"))[0]
    gdstk.read_oas(str(folder / "a.oas")).write_gds(str(folder / "gdstk.gds"), max_points=0)
    drawn, as_gds = kdb.Layout(), kdb.SaveLayoutOptions()
    drawn.read(str(folder / "a.oas"))
    as_gds.format = "GDS2"
    drawn.write(str(folder / "klayout.gds"), as_gds)
    wanted = {cell.name: cell_entry(as_polygons(cell), NM) for cell in layout.cells}
    for library in ("gdstk", "klayout"):
        found = {cell.name: cell for cell in plain_cells(folder / f"{library}.gds")}
        for name, entry in wanted.items():
            cell = found[name]
            shapes = {
                layer: Shapes(polygons=tuple(polygon for part in parts for polygon in part))
                for layer, parts in cell.polygons.items()
            }
            assert cell_entry(Cell(name, shapes, cell.references), NM) == entry


@pytest.mark.parametrize("pitch", [7, 1850])
def test_pixels_of_one_size_take_little_more_than_a_byte(tmp_path, pitch):
    x, y = np.meshgrid(np.arange(0, 200, 2), np.arange(0, 200, 2))
    low = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.int32) * pitch
    low = low[np.random.default_rng(3).random(len(low)) < 0.5]
    layout = Layout(NM, (Cell("TOP", {Layer(1): Shapes(np.hstack([low, low + pitch]))}),))
    write_oasis(tmp_path / "a.oas", layout)
    # Deflated, a step of one of a few lengths is less than a byte; 500 bytes are the frame of the file.
    assert (tmp_path / "a.oas").stat().st_size < 500 + len(low)
    oasis_to_gds(tmp_path / "a.oas", tmp_path / "b.gds", len(low))
    assert entries(read_gds(tmp_path / "b.gds")) == entries(layout)


@pytest.mark.parametrize("dbu_nm", [1.0, 0.25, 0.3])
def test_both_libraries_read_the_unit(tmp_path, dbu_nm):
    write_oasis(tmp_path / "a.oas", Layout(dbu_nm * NM, (Cell("TOP", {Layer(1): shapes_of([[0, 0, 4, 2]])}),)))
    layout = kdb.Layout()
    layout.read(str(tmp_path / "a.oas"))
    assert layout.dbu == pytest.approx(dbu_nm / 1000, rel=1e-12)
    assert gdstk.read_oas(str(tmp_path / "a.oas")).precision == pytest.approx(dbu_nm * NM, rel=1e-12)


def test_polygons_with_as_many_corners_are_read_in_one_piece(tmp_path):
    # One by one they would take a hundred times as long; more of them than are looked at first.
    triangle = np.array([[0, 0], [9, 0], [7, 5]], dtype=np.int32)
    rects = [[3 * i, 0, 3 * i + 1, 1] for i in range(100)]
    write_gds(tmp_path / "a.gds", Layout(NM, (Cell("TOP", {Layer(1): shapes_of(rects, [triangle])}),)))
    (cell,) = plain_cells(tmp_path / "a.gds")
    assert [part.shape for part in cell.polygons[Layer(1)]] == [(100, 4, 2), (1, 3, 2)]
    assert cell.polygons[Layer(1)][0][:, 0, 0].tolist() == [rect[0] for rect in rects]


def test_what_is_no_polygon_and_what_is_turned_is_told(tmp_path):
    library = gdstk.Library()
    below, top = library.new_cell("BELOW"), library.new_cell("TOP")
    below.add(gdstk.rectangle((0, 0), (1, 1)), gdstk.Label("text", (0, 0)))
    top.add(
        gdstk.Reference(below, (1, 2), rotation=1), gdstk.Reference(below, (3, 4), columns=2, rows=3, spacing=(5, 6))
    )
    library.write_gds(str(tmp_path / "a.gds"))
    found = {cell.name: cell for cell in plain_cells(tmp_path / "a.gds")}
    assert found["BELOW"].others == 1
    assert found["TOP"].references == (
        Reference("BELOW (turned, mirrored or scaled)", 1000, 2000),
        Reference("BELOW", 3000, 4000, 2, 3, 5000, 6000),
    )
    (tmp_path / "cut.gds").write_bytes((tmp_path / "a.gds").read_bytes()[:-40])
    with pytest.raises(Exception, match=r"a record|requires a buffer"):
        list(plain_cells(tmp_path / "cut.gds"))
