from contextlib import suppress

import gdstk
import numpy as np
import pytest

from fab.errors import InputError
from fab.layout import Layer, Layout, Shapes
from fab.stream import write_gds
from fab.units import NM
from fab.walker import read_gds

TRIANGLE = np.array([[0, 0], [1000, 0], [0, -1000]], dtype=np.int32)


@pytest.fixture
def gds(tmp_path):
    """Two layers, rectangles and polygons."""
    path = tmp_path / "a.gds"
    rng = np.random.default_rng(3)
    corner = rng.integers(-(10**9), 10**9, (500, 2))
    rects = np.hstack([corner, corner + rng.integers(1, 10**6, (500, 2))]).astype(np.int32)
    shapes = {Layer(2): Shapes(rects, (TRIANGLE,)), Layer(300, 7): Shapes(rects[:3], (TRIANGLE, TRIANGLE[::-1]))}
    write_gds(path, Layout("TOP", NM, shapes))
    return path


def test_everything_comes_back_exactly(gds):
    layout = read_gds(gds)
    assert (layout.cell, layout.dbu_m) == ("TOP", pytest.approx(NM, rel=1e-15))
    assert list(layout.shapes) == [Layer(2), Layer(300, 7)]
    assert [len(s.rectangles) for s in layout.shapes.values()] == [500, 3]
    assert np.array_equal(layout.shapes[Layer(300, 7)].polygons[1], TRIANGLE[::-1])
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
    assert layout.shapes[Layer(1)].rectangles.tolist() == [[0, 0, 1000, 2000], [2000, 1000, 3000, 3000]]
    assert layout.shapes[Layer(2)].rectangles.tolist() == [[0, 0, 1000, 1000]]
    assert [len(p) for p in layout.shapes[Layer(2)].polygons] == [6]


def test_blocks_meet_without_a_seam(tmp_path):
    # More than two blocks of four megabytes, with polygons of odd length that shift the elements off the block edges.
    x = np.arange(140_000, dtype=np.int32)[:, None] * 5
    rects = np.hstack([x, -x, x + 4, -x + 3])
    shapes = {Layer(1): Shapes(rects[:70_000], (TRIANGLE,)), Layer(2): Shapes(rects[70_000:], (TRIANGLE,) * 3)}
    write_gds(tmp_path / "a.gds", Layout("TOP", NM, shapes))
    again = read_gds(tmp_path / "a.gds").shapes
    assert np.array_equal(again[Layer(1)].rectangles, rects[:70_000])
    assert np.array_equal(again[Layer(2)].rectangles, rects[70_000:])
    assert len(again[Layer(2)].polygons) == 3


def test_a_rectangle_without_area_is_no_rectangle(tmp_path):
    flat = np.array([[0, 0], [5, 0], [5, 0], [0, 0]], dtype=np.int32)
    shapes = {Layer(1): Shapes(np.empty((0, 4), dtype=np.int32), (flat,))}
    write_gds(tmp_path / "a.gds", Layout("TOP", NM, shapes))
    found = read_gds(tmp_path / "a.gds").shapes[Layer(1)]
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
    assert len(read_gds(gds).shapes) == 2
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
    library = gdstk.Library()
    library.new_cell("A")
    library.new_cell("B")
    library.write_gds(str(tmp_path / "b.gds"))
    with pytest.raises(InputError, match="one cell"):
        read_gds(tmp_path / "b.gds")


def test_flipped_bytes_never_pass_for_an_error_of_the_program(gds):
    whole = gds.read_bytes()
    rng = np.random.default_rng(5)
    places = [*range(150), *rng.integers(150, len(whole), 200).tolist(), *range(len(whole) - 8, len(whole))]
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        gds.write_bytes(damaged)
        # Read or refused: any other exception would fail here.
        with suppress(InputError):
            read_gds(gds)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"missing\.gds: the file must exist"):
        read_gds(tmp_path / "missing.gds")
    with pytest.raises(InputError, match="must be a file"):
        read_gds(tmp_path)
