import klayout.db as kdb
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fab.errors import InputError
from fab.grid import Grid
from fab.layout.compensation import edge_moves, grown, read_back
from fab.layout.geometry import PixelEdges, Shapes, pixel_edges
from fab.layout.polygons import rectangles
from fab.levels import Levels, level_map_from_planes, planes

BITMAPS = hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9), elements=st.integers(0, 1))
PIXEL = 1850
SPECIAL = {
    "empty": np.zeros((5, 7), np.uint8),
    "full": np.ones((5, 7), np.uint8),
    "one": np.ones((1, 1), np.uint8),
    "checkerboard": np.indices((9, 6)).sum(axis=0).astype(np.uint8) % 2,
    "stairs": np.tri(7, 11, dtype=np.uint8),
    "hole": np.pad(np.zeros((1, 1), np.uint8), 1, constant_values=1),
}


def edges_of(plane, pixel_m=1.85e-6) -> PixelEdges:
    return pixel_edges(Grid(plane.shape, pixel_m))


def region(shapes: Shapes) -> kdb.Region:
    found = kdb.Region()
    for x0, y0, x1, y1 in shapes.rectangles.tolist():
        found.insert(kdb.Box(x0, y0, x1, y1))
    return found


def sized_by_klayout(plane, edges, move) -> kdb.Region:
    """Mode 2 keeps the corners of right angles square."""
    return region(Shapes(rectangles(plane, edges.x, edges.y))).merged().sized(move, move, 2).merged()


def require_same_area(plane, edges, move):
    shapes = grown(plane, edges, move)
    drawn = region(shapes)
    # Own rectangles are disjoint: their areas add up to that of what they cover.
    assert 2 * drawn.merged().area() == shapes.doubled_area
    assert (drawn ^ sized_by_klayout(plane, edges, move)).is_empty()
    assert np.array_equal(read_back(shapes, edges, move), plane)


@given(BITMAPS, st.sampled_from([1, 40, 120, 924]))
@settings(max_examples=60)
def test_growing_is_klayouts_sizing_of_the_merged_plane(plane, move):
    require_same_area(plane, edges_of(plane), move)


@given(BITMAPS, st.sampled_from([1, 40, 120, 924]))
@settings(max_examples=60)
def test_shrinking_is_klayouts_growing_of_the_complement(plane, move):
    edges = edges_of(plane)
    shapes = grown(plane, edges, -move)
    # KLayout keeps kissing corners in one polygon when it shrinks; the complement has no such choice.
    framed = np.pad(1 - plane, 1, constant_values=1)
    inner = kdb.Region(kdb.Box(int(edges.x[0]), int(edges.y[0]), int(edges.x[-1]), int(edges.y[-1])))
    wanted = inner - sized_by_klayout(framed, edges_of(framed), move)
    assert (region(shapes) ^ wanted).is_empty()
    assert np.array_equal(read_back(shapes, edges, -move), plane)


@given(BITMAPS, st.sampled_from([40, 120, 924]))
@settings(max_examples=60)
def test_a_process_with_the_opposite_bias_prints_what_was_designed(plane, bias):
    """The process widens by a square, as KLayout does; one that narrows widens what is not etched."""
    edges = edges_of(plane)
    wanted = region(Shapes(rectangles(plane, edges.x, edges.y))).merged()
    narrower, wider = region(grown(plane, edges, -bias)).merged(), region(grown(plane, edges, bias)).merged()
    assert (narrower.sized(bias, bias, 2) ^ wanted).is_empty()
    blank = kdb.Region(wanted.bbox().enlarged(9 * PIXEL, 9 * PIXEL)) if plane.any() else kdb.Region()
    assert ((blank - (blank - wider).sized(bias, bias, 2)) ^ wanted).is_empty()


@pytest.mark.parametrize("move", [-900, -1, 0, 1, 900])
@pytest.mark.parametrize("plane", SPECIAL.values(), ids=SPECIAL)
def test_special_planes_come_back(plane, move):
    edges = edges_of(plane)
    shapes = grown(plane, edges, move)
    assert 2 * region(shapes).merged().area() == shapes.doubled_area
    assert np.array_equal(read_back(shapes, edges, move), plane)


def test_a_pixel_grows_on_all_sides_and_a_shared_edge_stays():
    edges = edges_of(np.ones((1, 2)))
    assert grown(np.ones((1, 2), np.uint8), edges, 100).rectangles.tolist() == [[-1950, -1025, 1950, 1025]]
    assert grown(np.ones((1, 2), np.uint8), edges, -100).rectangles.tolist() == [[-1750, -825, 1750, 825]]
    assert grown(np.array([[1, 0]], np.uint8), edges, 100).rectangles.tolist() == [[-1950, -1025, 100, 1025]]


def test_kissing_pixels_join_when_they_grow_and_part_when_they_shrink():
    plane = np.eye(2, dtype=np.uint8)
    edges = edges_of(plane)
    assert region(grown(plane, edges, 100)).merged().count() == 1
    assert region(grown(plane, edges, -100)).merged().count() == 2


@pytest.mark.parametrize("move", [-1700, 1700])
def test_wide_features_may_move_by_more_than_half_a_pixel(move):
    plane = np.kron(np.random.default_rng(3).integers(0, 2, (5, 6)), np.ones((2, 2))).astype(np.uint8)
    edges = edges_of(plane)
    assert np.array_equal(read_back(grown(plane, edges, move), edges, move), plane)
    if move > 0:
        require_same_area(plane, edges, move)


def test_pixels_off_the_database_unit_are_moved_from_where_they_are_drawn():
    plane = np.random.default_rng(5).integers(0, 2, (7, 9)).astype(np.uint8)
    edges = edges_of(plane, 1.23456789e-6)
    assert edges.shift_m > 0  # or the test would be the one above
    require_same_area(plane, edges, 333)


@pytest.mark.parametrize(("plane", "move"), [([[1, 0, 1]], 925), ([[0, 1, 0]], -925), ([[1, 0, 1]], 5000)])
def test_moves_that_close_a_space_or_lose_a_line_are_refused(plane, move):
    plane = np.array(plane, np.uint8)
    with pytest.raises(InputError, match="edges must move by less than half the narrowest line and space"):
        grown(plane, edges_of(plane), move)


def test_a_staircase_of_two_pixels_that_would_not_come_back_is_refused():
    # Every run of the band has two pixels, yet no square wider than one fits into its bends.
    band = 1 - (np.abs(np.subtract.outer(np.arange(8), np.arange(8)) - 0.5) < 1).astype(np.uint8)
    with pytest.raises(InputError, match="edge move"):
        grown(band, edges_of(band), 1200)


def test_damage_is_found_on_reading_back():
    plane = np.random.default_rng(1).integers(0, 2, (6, 6)).astype(np.uint8)
    edges = edges_of(plane)
    good = grown(plane, edges, 120).rectangles
    moved, doubled = good.copy(), np.concatenate([good, good[:1]])
    moved[0, 2] += 1
    with pytest.raises(InputError, match="must be a pixel edge moved by 120 nm, but got 1 shapes"):
        read_back(Shapes(moved), edges, 120)
    with pytest.raises(InputError, match="must not overlap"):
        read_back(Shapes(doubled), edges, 120)
    with pytest.raises(InputError, match="another area"):
        read_back(Shapes(good[1:]), edges, 120)
    with pytest.raises(InputError, match="moved by -120 nm"):
        read_back(Shapes(good), edges, -120)


def test_a_whole_mask_set_comes_back_with_a_move_per_mask():
    levels, rng = Levels(16, 75e-9), np.random.default_rng(9)
    level_map = rng.integers(0, 16, (13, 10)).astype(np.uint8)
    edges = edges_of(level_map)
    moves = edge_moves((-120e-9, 0.0, 80e-9, -40e-9), edges.dbu_m)
    assert moves == (120, 0, -80, 40)
    back = [read_back(grown(p, edges, m), edges, m) for p, m in zip(planes(level_map, levels), moves, strict=True)]
    assert np.array_equal(level_map_from_planes(np.stack(back), levels), level_map)


def test_a_bias_that_is_no_number_is_refused():
    with pytest.raises(InputError, match="CD bias"):
        edge_moves((0.0, float("nan")), 1e-9)


def test_moves_up_to_the_last_32_bit_coordinate_are_drawn():
    ends = np.array([-(2**31 - 1 - 50), 2**31 - 1 - 50], dtype=np.int32)
    edges, plane = PixelEdges(ends, ends, 1e-9, 0.0), np.ones((1, 1), np.uint8)
    assert grown(plane, edges, 50).rectangles.tolist() == [[-(2**31 - 1)] * 2 + [2**31 - 1] * 2]
    with pytest.raises(InputError, match="must fit 32-bit coordinates, but got an edge at 2147483648 units"):
        grown(plane, edges, 51)
