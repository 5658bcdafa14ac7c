import struct
from itertools import pairwise
from typing import Any

import gdstk
import klayout.db as kdb
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fab.errors import InputError
from fab.files import sha256_file
from fab.gds.oasis import write_oasis
from fab.gds.reader import read_gds
from fab.gds.writer import oasis_to_gds, write_gds
from fab.grid import Grid
from fab.layout.doe import mask_layout
from fab.layout.geometry import Cell, Chrome, Layer, Layout, Reference, Shapes
from fab.layout.polygons import rectangles
from fab.levels import Levels
from fab.units import NM, UM
from tests.fab.maps import wide_map

FAR = 2**31 - 1
TRIANGLE = np.array([[0, 0], [1000, 0], [0, -1000]], dtype=np.int32)


def one_layer(rects, *polygons, cell="TOP", dbu_m=NM):
    return Layout(dbu_m, (Cell(cell, {Layer(1): Shapes(np.array(rects, dtype=np.int32).reshape(-1, 4), polygons)}),))


def records(path):
    data, offset, found = path.read_bytes(), 0, []
    while offset < len(data):
        length, kind = struct.unpack(">HH", data[offset : offset + 4])
        found.append((kind, data[offset + 4 : offset + length]))
        offset += length
    return found


@pytest.fixture
def gds(tmp_path):
    return tmp_path / "a.gds"


def test_a_rectangle_is_one_boundary_of_sixty_four_bytes(gds):
    write_gds(gds, one_layer([]))
    empty = gds.stat().st_size
    write_gds(gds, one_layer([[1, 2, 3, 5], [-FAR, -FAR, FAR, FAR]]))
    assert gds.stat().st_size == empty + 128
    kinds = [kind for kind, _ in records(gds)]
    assert kinds == [0x0002, 0x0102, 0x0206, 0x0305, 0x0502, 0x0606] + 2 * [0x0800, 0x0D02, 0x0E02, 0x1003, 0x1100] + [
        0x0700,
        0x0400,
    ]
    # Closed, counter-clockwise, big-endian: a writer that dropped the byte order would give zero area.
    points = [struct.unpack(">10i", data) for kind, data in records(gds) if kind == 0x1003]
    assert points[0] == (1, 2, 3, 2, 3, 5, 1, 5, 1, 2)
    assert points[1][:4] == (-FAR, -FAR, FAR, -FAR)


def test_the_area_survives_many_batches(gds):
    # Two batches and a part of a third.
    x = np.arange(70_000, dtype=np.int32)[:, None] * 10
    rects = np.hstack([x, x, x + 7, x + 3])
    write_gds(gds, one_layer(rects))
    cells: list[Any] = gdstk.read_gds(str(gds)).cells
    # Twenty-one square nanometres each, added up in square micrometres.
    assert sum(polygon.area() for polygon in cells[0].polygons) == pytest.approx(70_000 * 21e-6, rel=1e-9)
    assert np.array_equal(read_gds(gds).cells[0].shapes[Layer(1)].rectangles, rects)


def test_names_and_times_are_fixed(gds):
    write_gds(gds, one_layer([[0, 0, 1, 1]], cell="DOE_X"))
    content = dict(records(gds))
    assert content[0x0606].rstrip(b"\0") == b"DOE_X"
    assert content[0x0102] == content[0x0502] == struct.pack(">12H", *(2000, 1, 1, 0, 0, 0) * 2)
    with pytest.raises(InputError, match="mask name"):
        write_gds(gds, one_layer([], cell="main"))


@pytest.mark.parametrize("dbu_nm", [1.0, 0.5, 0.25, 0.1])
def test_both_libraries_read_the_database_unit(gds, dbu_nm):
    write_gds(gds, one_layer([[0, 0, 4000, 2000]], dbu_m=dbu_nm * NM))
    library = gdstk.read_gds(str(gds))
    # The eight-byte real has 53 or more bits of fraction, so only float64 rounds.
    assert library.unit == pytest.approx(1e-6, rel=1e-15)
    assert library.precision == pytest.approx(dbu_nm * NM, rel=1e-14)
    layout = kdb.Layout()
    layout.read(str(gds))
    assert layout.dbu == pytest.approx(dbu_nm / 1000, rel=1e-14)
    assert layout.top_cell().dbbox().width() == pytest.approx(4 * dbu_nm, rel=1e-12)
    assert read_gds(gds).dbu_m == pytest.approx(dbu_nm * NM, rel=1e-14)


@pytest.mark.parametrize("dbu_m", [62.4e-9, 60e-9, 1e-9, 3.9e-12])
def test_reals_have_no_leading_zero(gds, dbu_m):
    """The standard wants a fraction from 1/16 on; 0.0624 um lies just below it, and so do 60 nm and 3.9 pm."""
    write_gds(gds, one_layer([], dbu_m=dbu_m))
    units = dict(records(gds))[0x0305]
    assert min(units[1], units[9]) >= 0x10
    assert read_gds(gds).dbu_m == pytest.approx(dbu_m, rel=1e-14)


@pytest.mark.parametrize("factor", [0.5, 1.5, 1 + 1e-8])
def test_another_user_unit_is_refused(gds, factor):
    """The database unit in user units and in metres tell two different micrometres."""
    write_gds(gds, one_layer([], dbu_m=1e-9))
    content = gds.read_bytes()
    start = content.index(struct.pack(">HH", 20, 0x0305)) + 4
    fraction = int.from_bytes(content[start + 1 : start + 8], "big")
    other = round(fraction * factor).to_bytes(7, "big")
    gds.write_bytes(content[: start + 1] + other + content[start + 8 :])
    with pytest.raises(InputError, match="the user unit must be 1 um"):
        read_gds(gds)


@pytest.mark.parametrize("suffix", ["gds", "oas"])
@pytest.mark.parametrize(("columns", "rows"), [(1, 1), (1, 3), (3, 1), (2, 2), (3, 2)])
def test_repeated_cells_lie_where_they_should(tmp_path, suffix, columns, rows):
    die = Cell("DIE", {Layer(1): Shapes(np.array([[0, 0, 10, 20]], np.int32))})
    placed = Reference("DIE", 5, -7, columns, rows, 100, 300)
    layout = Layout(NM, (die, Cell("TOP", {}, (placed,))))
    {"gds": write_gds, "oas": write_oasis}[suffix](tmp_path / f"a.{suffix}", layout)
    again = kdb.Layout()
    again.read(str(tmp_path / f"a.{suffix}"))
    shapes = kdb.Region(again.top_cell().begin_shapes_rec(again.find_layer(1, 0)))
    corners = {(p.bbox().left, p.bbox().bottom) for p in shapes.each()}
    assert corners == {(5 + 100 * i, -7 + 300 * j) for i in range(columns) for j in range(rows)}


def plane_region(plane):
    region = kdb.Region()
    for y, x in np.argwhere(plane).tolist():
        region.insert(kdb.Box(x, y, x + 1, y + 1))
    return region


@pytest.mark.parametrize("suffix", ["gds", "oas"])
@given(plane=hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.integers(0, 1)))
def test_klayout_sees_exactly_the_pixels(tmp_path_factory, suffix, plane):
    folder = tmp_path_factory.mktemp("xor")
    write = {"gds": write_gds, "oas": write_oasis}[suffix]
    write(folder / f"a.{suffix}", one_layer(rectangles(plane)))
    layout = kdb.Layout()
    layout.read(str(folder / f"a.{suffix}"))
    index = layout.find_layer(1, 0)
    drawn = kdb.Region() if index is None else kdb.Region(layout.top_cell().begin_shapes_rec(index))
    assert (drawn ^ plane_region(plane)).is_empty()
    assert drawn.area() == np.count_nonzero(plane)
    assert drawn.merged(2).is_empty()  # nothing is covered twice


@given(plane=hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.integers(0, 1)))
def test_gdstk_sees_exactly_the_pixels(tmp_path_factory, plane):
    folder = tmp_path_factory.mktemp("xor")
    write_gds(folder / "a.gds", one_layer(rectangles(plane)))
    cells: list[Any] = gdstk.read_gds(str(folder / "a.gds")).cells
    pixels = [gdstk.rectangle((x / 1000, y / 1000), ((x + 1) / 1000, (y + 1) / 1000)) for y, x in np.argwhere(plane)]
    assert gdstk.boolean(cells[0].polygons, pixels, "xor", precision=1e-6) == []


def test_oasis_keeps_names_repeats_and_polygons(tmp_path, level_map, levels, grid):
    layout = mask_layout(level_map, "DOE")
    write_gds(tmp_path / "a.gds", layout)
    write_oasis(tmp_path / "a.oas", layout)
    again = kdb.Layout()
    again.read(str(tmp_path / "a.oas"))
    names = [(info.layer, info.datatype, info.name) for info in again.layer_infos()]
    assert names == [(layer.number, layer.datatype, layer.name) for layer in layout.cells[0].shapes]
    for layer, shapes in layout.cells[0].shapes.items():
        region = kdb.Region(again.top_cell().begin_shapes_rec(again.find_layer(layer.number, layer.datatype)))
        assert 2 * region.area() == shapes.doubled_area
    assert (tmp_path / "a.oas").stat().st_size < (tmp_path / "a.gds").stat().st_size / 2


def test_the_same_layout_gives_the_same_bytes(tmp_path, level_map, levels, grid):
    digests = []
    for name in ("one", "two"):
        gds, oasis = tmp_path / f"{name}.gds", tmp_path / f"{name}.oas"
        layout = mask_layout(level_map, "DOE")
        write_gds(gds, layout)
        write_oasis(oasis, layout)
        digests.append((sha256_file(gds), sha256_file(oasis)))
    assert digests[0] == digests[1]


def test_a_path_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=r"file/a\.gds"):
        write_gds(tmp_path / "file" / "a.gds", one_layer([]))
    with pytest.raises(InputError, match=r"a\.oas"):
        write_oasis(tmp_path / "file" / "a.oas", one_layer([[0, 0, 1, 1]]))


def test_oasis_back_to_gds_refuses_ruins_and_floods(tmp_path):
    write_oasis(tmp_path / "a.oas", one_layer([[i * 3, 0, i * 3 + 1, 1] for i in range(50)], TRIANGLE))
    oasis_to_gds(tmp_path / "a.oas", tmp_path / "b.gds", 51)
    again = read_gds(tmp_path / "b.gds").cells[0].shapes[Layer(1)]
    assert (len(again.rectangles), len(again.polygons)) == (50, 1)
    with pytest.raises(InputError, match="51 shapes"):
        oasis_to_gds(tmp_path / "a.oas", tmp_path / "b.gds", 50)
    (tmp_path / "cut.oas").write_bytes((tmp_path / "a.oas").read_bytes()[:60])
    with pytest.raises(InputError, match=r"cut\.oas"):
        oasis_to_gds(tmp_path / "cut.oas", tmp_path / "b.gds", 50)


def test_odd_grids_are_drawn_without_gap_or_overlap(tmp_path):
    # A third of a micrometre fits no unit: neighbours must share the rounded edge.
    levels, grid = Levels(2, 75 * NM), Grid((5, 7), UM / 3)
    layout = mask_layout(wide_map(np.zeros((5, 7), dtype=np.uint8), levels, grid), "DOE", Chrome(overlap_m=0))
    rects = layout.cells[0].shapes[Layer(1)].rectangles
    assert len(rects) > 1
    region = kdb.Region()
    for rect in rects.tolist():
        region.insert(kdb.Box(*rect))
    assert region.merged().area() == sum(kdb.Box(*rect).area() for rect in rects.tolist())
    assert region.merged().count() == 1
    assert all(a[1] <= b[1] for a, b in pairwise(rects.tolist()))
