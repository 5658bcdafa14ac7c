import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fab.layout.polygons import (
    MAX_VERTICES,
    annulus_sectors,
    doubled_area,
    paint,
    rectangles,
    run_lengths,
    smallest_runs,
)

BITMAPS = hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12), elements=st.integers(0, 1))


def edges_of(bitmap):
    return tuple(np.arange(n + 1, dtype=np.int32) for n in bitmap.shape)


def painted(rects, bitmap):
    y_edges, x_edges = edges_of(bitmap)
    canvas = np.zeros(bitmap.shape, dtype=np.uint8)
    return canvas, paint(rects, x_edges, y_edges, 0, canvas)


def require_identity(bitmap):
    canvas, found = painted(rectangles(bitmap), bitmap)
    assert np.array_equal(canvas, bitmap)
    assert (found.overlaps, found.strays, found.first_stray) == (0, 0, -1)


@given(BITMAPS)
def test_painting_the_rectangles_gives_the_bitmap_back_without_overlap(bitmap):
    require_identity(bitmap)


@pytest.mark.parametrize(
    "bitmap",
    [
        np.zeros((5, 7), np.uint8),
        np.ones((5, 7), np.uint8),
        np.ones((1, 1), np.uint8),
        np.indices((9, 6)).sum(axis=0).astype(np.uint8) % 2,  # kissing corners everywhere
        np.tri(7, 11, dtype=np.uint8),
        np.pad(np.zeros((3, 3), np.uint8), 2, constant_values=1),  # a hole
    ],
    ids=["empty", "full", "one", "checkerboard", "stairs", "hole"],
)
def test_special_bitmaps(bitmap):
    require_identity(bitmap)


def test_rectangles_are_maximal_runs_merged_upward_and_sorted():
    bitmap = np.array([[1, 1, 0, 1], [1, 1, 0, 0], [1, 0, 0, 1]], dtype=np.uint8)
    assert rectangles(bitmap).tolist() == [[0, 0, 2, 2], [3, 0, 4, 1], [0, 2, 1, 3], [3, 2, 4, 3]]


def test_rectangles_take_the_coordinates_of_the_edges():
    bitmap = np.array([[0, 1]], dtype=np.uint8)
    x_edges, y_edges = np.array([-7, 0, 9], dtype=np.int32), np.array([-3, 4], dtype=np.int32)
    assert rectangles(bitmap, x_edges, y_edges).tolist() == [[0, -3, 9, 4]]


def test_a_bitmap_of_booleans_and_a_turned_one_are_fine():
    bitmap = np.arange(12).reshape(3, 4) % 3 == 0
    for view in (bitmap, bitmap.T, bitmap[:, ::-1]):
        require_identity(view.astype(np.uint8))
        assert np.array_equal(rectangles(view), rectangles(view.astype(np.uint8)))


def test_covering_a_pixel_twice_is_counted():
    bitmap = np.zeros((4, 4), dtype=np.uint8)
    _, found = painted(np.array([[0, 0, 2, 2], [1, 1, 3, 3]], dtype=np.int32), bitmap)
    assert found.overlaps == 1


@pytest.mark.parametrize("stray", [[0, 0, 5, 1], [-1, 0, 2, 1], [0, -2, 1, 1], [0, 0, 1, 6]])
def test_edges_off_the_raster_are_found_and_not_painted(stray):
    canvas, found = painted(np.array([[0, 0, 1, 1], stray], dtype=np.int32), np.zeros((4, 4), dtype=np.uint8))
    assert (found.strays, found.first_stray) == (1, 1)
    assert canvas.sum() == 1


def test_each_bit_of_a_canvas_is_a_plane_of_its_own():
    canvas = np.zeros((2, 2), dtype=np.uint8)
    edges = np.arange(3, dtype=np.int32)
    whole = np.array([[0, 0, 2, 2]], dtype=np.int32)
    assert paint(whole, edges, edges, 0, canvas).overlaps == 0
    assert paint(whole, edges, edges, 7, canvas).overlaps == 0
    assert np.all(canvas == 0b10000001)


@given(BITMAPS)
def test_smallest_runs_agree_with_a_plain_search(bitmap):
    widths, spaces = [], []
    for line in [*bitmap, *bitmap.T]:
        text = "".join(map(str, line))
        widths += [len(run) for run in text.split("0") if run]
        spaces += [len(run) for run in text.strip("0").split("1") if run]
    assert smallest_runs(bitmap) == (min(widths, default=None), min(spaces, default=None))


@given(BITMAPS)
def test_run_lengths_agree_with_a_plain_search(bitmap):
    wanted = np.zeros(bitmap.shape, dtype=int)
    for y, line in enumerate(bitmap):
        text = "".join(map(str, line))
        x = 0
        for run in text.replace("10", "1 0").replace("01", "0 1").split():
            if run[0] == "1":
                wanted[y, x : x + len(run)] = len(run)
            x += len(run)
    found = run_lengths(bitmap)
    assert found.dtype == np.uint8
    assert np.array_equal(found, wanted)


def test_run_lengths_end_at_255_and_take_any_bit_for_set():
    bitmap = np.ones((2, 300), dtype=np.uint8)
    bitmap[1, 255] = 0
    assert np.all(run_lengths(bitmap)[0] == 255)
    assert run_lengths(bitmap)[1].tolist() == [255] * 255 + [0] + [44] * 44
    assert np.array_equal(run_lengths(bitmap * np.uint8(8)), run_lengths(bitmap))
    # A turned view, as openings are measured along y.
    assert np.array_equal(run_lengths(bitmap.T), bitmap.T * run_lengths(bitmap.T))
    assert run_lengths(bitmap.T).max() == 2


@pytest.mark.parametrize(("inner", "outer"), [(2_215_000, 3_700_000), (1000, 2000), (9_025_000, 13_300_000)])
def test_the_annulus_is_a_true_circle_within_the_chord_error(inner, outer):
    sectors = annulus_sectors(inner, outer, 5.0)
    assert len(sectors) % 4 == 0
    assert max(map(len, sectors)) <= MAX_VERTICES
    vertices = np.concatenate(sectors).astype(float)
    radius = np.hypot(*vertices.T)
    near = radius < (inner + outer) / 2
    # Rounding moves a vertex by up to half a unit in x and in y.
    assert np.abs(radius[near] - inner).max() <= math.sqrt(0.5)
    assert np.abs(radius[~near] - outer).max() <= math.sqrt(0.5)
    angle = np.sort(np.arctan2(vertices[near, 1], vertices[near, 0]))
    assert inner * (1 - math.cos(np.diff(angle).max() / 2)) <= 5.0
    area = sum(doubled_area(sector) for sector in sectors) / 2
    assert all(doubled_area(sector) > 0 for sector in sectors)
    # Inscribed polygons of n corners lose the fraction 1 - sin(t)/t, t = 2 pi / n; rounding adds less.
    turn = 2 * math.pi / (sum(map(len, sectors)) / 2 - len(sectors))
    exact = math.pi * (outer**2 - inner**2) * math.sin(turn) / turn
    assert area == pytest.approx(exact, abs=2 * math.pi * (outer + inner) * 0.5)


def test_neighbouring_sectors_share_their_radial_edge():
    sectors = annulus_sectors(50_000, 80_000, 5.0)
    for one, other in zip(sectors, sectors[1:] + sectors[:1], strict=True):
        half = len(one) // 2
        assert np.array_equal(one[half - 1], other[0])
        assert np.array_equal(one[half], other[-1])


@pytest.mark.parametrize("numbers", [(0, 5, 1.0), (5, 5, 1.0), (2, 5, 0.0)])
def test_impossible_annuli_are_refused(numbers):
    with pytest.raises(ValueError, match="0 < inner < outer"):
        annulus_sectors(*numbers)


def test_area_is_exact_at_the_limit_of_the_coordinates():
    far = 2**31 - 1
    square = np.array([[-far, -far], [far, -far], [far, far], [-far, far]], dtype=np.int32)
    assert doubled_area(square // 2) == 2 * (2 * (far // 2) + 1) ** 2
    assert doubled_area(square) == -doubled_area(square[::-1]) == 2 * (2 * far) ** 2  # nearly 2**65
