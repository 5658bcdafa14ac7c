import json

import klayout.db as kdb
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fab.aperture import MaskAperture
from fab.errors import InputError
from fab.grid import Grid
from fab.layout.polygons import rectangles, smallest_runs
from fab.level_map import LevelMap
from fab.levels import Levels, planes
from fab.process import Process
from fab.rules import bitplanes as bits
from fab.rules.check import Rules, check
from tests.fab.maps import level_map_from

UM = 1e-6
BITMAPS = hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=14), elements=st.integers(0, 1))
TWO = Levels(2, 600e-9)
SIXTEEN = Levels(16, 75e-9)


def check_plane(plane, line=2, space=2, **more):
    """The report of a plane of pixels of 1 um, none of it outside the aperture."""
    level_map = level_map_from(1 - np.asarray(plane, np.uint8), TWO)
    return check(level_map, Rules(line * UM, space * UM, **more)).planes[0]


def region(plane) -> kdb.Region:
    found = kdb.Region()
    for x0, y0, x1, y1 in rectangles(plane).tolist():
        found.insert(kdb.Box(x0 * 1000, y0 * 1000, x1 * 1000, y1 * 1000))
    return found.merged()


def klayout_places(pairs: kdb.EdgePairs) -> set[tuple[int, ...]]:
    """The boxes between facing edges, in pixels."""
    boxes = [pair.bbox() for pair in pairs.each()]
    return {tuple(v // 1000 for v in (b.left, b.bottom, b.right, b.top)) for b in boxes}


def own_places(plane, outside, fewest) -> set[tuple[int, ...]]:
    """All narrow places as boxes, from the functions that the check is made of."""
    words = bits.pack(1 - plane, 2)[0]
    left, alone, found = words if outside == bits.NONE else ~words, np.empty_like(words), set()
    whole = left
    for axis in (0, 1):
        left = whole.copy()
        for width in range(1, fewest):
            bits.split(left, axis, outside, alone)
            for y, x, n in bits.longest_runs(alone, alone, 1 - axis, 9999, 9999).tolist():
                found.add((x, y, x + width, y + n) if axis == 1 else (x, y, x + n, y + width))
    return found


@pytest.mark.slow
@given(BITMAPS, st.integers(2, 5))
@settings(max_examples=150)
def test_the_narrow_places_are_those_of_klayout(plane, fewest):
    drawn, limit = region(plane), fewest * 1000
    # A projection of no length is a corner, which is counted as such.
    options = {"metrics": kdb.Metrics.Projection, "min_projection": 1}
    lines, spaces = drawn.width_check(limit, **options), drawn.space_check(limit, **options)
    assert own_places(plane, bits.NONE, fewest) == klayout_places(lines)
    assert own_places(plane, bits.ALL, fewest) == klayout_places(spaces)
    found = check_plane(plane, fewest, fewest)
    # A speck is too narrow along x and along y: two pairs of edges with one box.
    assert (found.line.narrow, found.space.narrow) == (lines.count(), spaces.count())


@given(BITMAPS)
def test_the_kissing_corners_are_where_four_edges_of_klayout_meet(plane):
    ends: dict[tuple[int, int], int] = {}
    for edge in region(plane).edges().each():
        for point in (edge.p1, edge.p2):
            ends[point.x, point.y] = ends.get((point.x, point.y), 0) + 1
    assert check_plane(plane).kissing == sum(count == 4 for count in ends.values())


@given(BITMAPS, st.integers(0, 4))
def test_the_smallest_width_and_space_are_those_of_the_runs(plane, fewest):
    found = check_plane(plane, fewest, fewest)
    wanted = [None if run is None else pytest.approx(run * UM) for run in smallest_runs(plane)]
    assert [found.line.smallest_m, found.space.smallest_m] == wanted


def cross_sections(plane):
    """Lengths of all runs of lines, and of all spaces between two of them, along x and y, the slow way."""
    lines, spaces = [], []
    for row in [*plane, *plane.T]:
        ends = np.flatnonzero(np.diff(np.pad(row.astype(int), 1)))
        lines += list(ends[1::2] - ends[::2])
        spaces += list(ends[2::2] - ends[1:-1:2])
    return np.array(lines, int), np.array(spaces, int)


@given(BITMAPS, st.integers(1, 4))
def test_the_narrow_share_counts_cross_sections(plane, fewest):
    found = check_plane(plane, fewest, fewest)
    for widths, runs in zip((found.line, found.space), cross_sections(plane), strict=True):
        assert widths.narrow_share == pytest.approx(np.mean(runs < fewest) if len(runs) else 0.0)


@pytest.mark.parametrize("size", [(1, 1), (63, 64), (64, 65), (128, 1), (3, 200), (70, 130)])
def test_words_of_64_pixels_leave_no_seam(size):
    plane = np.random.default_rng(4).integers(0, 2, size).astype(np.uint8)
    found = check_plane(plane, 3, 3)
    lines, spaces = cross_sections(plane)
    assert found.line.narrow_share == pytest.approx(np.mean(lines < 3) if len(lines) else 0)
    assert found.space.narrow_share == pytest.approx(np.mean(spaces < 3) if len(spaces) else 0)
    turned = check_plane(plane.T, 3, 3)
    assert (turned.line.narrow, turned.space.narrow) == (found.line.narrow, found.space.narrow)
    assert (turned.kissing, turned.line.slivers) == (found.kissing, found.line.slivers)
    assert found.density == pytest.approx(plane.mean())


@pytest.mark.parametrize("outside", [bits.NONE, bits.ALL])
@pytest.mark.parametrize("axis", [0, 1])
def test_erosion_keeps_the_pixels_that_begin_runs_of_any_length(axis, outside):
    # Three words with runs of up to all of them; full rows beside others, whose pixels must not be taken for theirs.
    plane = np.ones((192, 192), np.uint8)
    gaps = np.random.default_rng(6).integers(0, 192, (2, 96))
    plane[gaps[0], gaps[1]] = 0
    plane[[0, 1, 100]] = 1
    plane = plane if axis == 1 else np.ascontiguousarray(plane.T)
    for length in (2, 3, 63, 64, 65, 127, 128, 129, 191, 192):
        words = np.packbits(plane, axis=1, bitorder="little").view(np.uint64)
        bits.erode(words, axis, length, outside)
        beyond = [(0, length) if a == axis else (0, 0) for a in range(2)]
        padded = np.pad(plane, beyond, constant_values=int(outside != bits.NONE))
        runs = np.lib.stride_tricks.sliding_window_view(padded, length, axis)[:192, :192]
        wanted = runs.min(axis=-1)
        assert np.array_equal(np.unpackbits(words.view(np.uint8), axis=1, bitorder="little"), wanted), length


def test_the_last_row_has_no_corners_whatever_the_array_held_before():
    plane = np.zeros((4, 70), np.uint8)
    plane[[1, 2, 2, 3], [5, 6, 64, 63]] = 1
    words = bits.pack(1 - plane, 2)[0]
    found = np.full_like(words, bits.ALL)
    assert bits.corners(words, found) == 2
    wanted = np.zeros((4, 128), np.uint8)
    wanted[[1, 2], [5, 63]] = 1
    assert np.array_equal(np.unpackbits(found.view(np.uint8), axis=1, bitorder="little"), wanted)


def bar(width, length, size=(90, 90)):
    plane = np.zeros(size, np.uint8)
    plane[5 : 5 + length, 60 : 60 + width] = 1
    return plane


@pytest.mark.parametrize(("width", "narrow"), [(1, 1), (2, 1), (3, 0), (4, 0)])
def test_bars_at_the_limit_and_one_pixel_below(width, narrow):
    assert check_plane(bar(width, 40), 3, 0).line.narrow == narrow
    assert check_plane(1 - bar(width, 40), 0, 3).space.narrow == narrow


def test_a_minimum_between_two_pixels_counts_as_the_next_one():
    rules = Rules(2 * UM, 2 * UM)
    found = check(level_map_from(1 - bar(1, 40), TWO, 1.85 * UM), rules).planes[0]
    assert (found.line.narrow, found.line.smallest_m) == (1, 1.85e-6)
    assert check(level_map_from(1 - bar(2, 40), TWO, 1.85 * UM), rules).clean


@pytest.mark.parametrize(("length", "slivers"), [(5, 0), (6, 1), (70, 1)])
def test_a_sliver_is_three_times_the_minimum_long(length, slivers):
    for plane in (bar(1, length), bar(1, length).T):
        assert check_plane(plane).line.slivers == slivers
        assert check_plane(1 - plane).space.slivers == slivers


def test_places_are_where_the_mistakes_are():
    plane = bar(1, 40)
    plane[80, 10] = plane[81, 11] = 1
    places = check_plane(plane).places
    assert {p.what for p in places} == {"line", "kissing corner"}
    corner = places[0]
    assert (corner.what, corner.x_m, corner.y_m) == ("kissing corner", -34e-6, 36e-6)
    longest = next(p for p in places if p.what == "line")
    assert longest == ("line", -20e-6, 15.5e-6, 1e-6, 40e-6)


def test_the_list_of_places_is_bounded_and_shows_the_narrowest_first():
    found = check_plane(np.random.default_rng(0).integers(0, 2, (200, 200)), 4, 4)
    assert len(found.places) <= 20
    assert [p.size_m for p in found.places] == sorted(p.size_m for p in found.places)


def test_density_of_the_aperture_and_of_its_windows():
    grid = Grid((80, 80), UM)
    plane = np.zeros(grid.shape, np.uint8)
    plane[40:50, 30:40] = 1  # one whole window of 10 pixels
    plane[0, 0] = 1  # outside the circle: not etched at all
    found = check(LevelMap(1 - plane, TWO, grid, 80 * UM), Rules(window_m=10 * UM)).planes[0]
    inside = np.count_nonzero(grid.inside_circle(80 * UM))
    assert found.density == pytest.approx(100 / inside)
    assert (found.emptiest, found.fullest) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("window", "densities"), [(20, (0.5, 0.0, 1.0)), (21, (0.5, 0.0, 1.0)), (200, (0.5, 0.5, 0.5))]
)
def test_windows_of_a_mask_lie_in_its_relief_wherever_that_is(window, densities):
    """Relief in the left half, of which the lower quarter is etched all over, and the upper one not at all."""
    grid, left, level = Grid((80, 81), UM), np.zeros((80, 81), np.uint8), np.ones((80, 81), np.uint8)
    left[:, :42], level[:40, :42] = 1, 0
    for flip in (np.s_[:, :], np.s_[:, ::-1], np.s_[::-1, :], np.s_[::-1, ::-1]):
        plate = LevelMap(level[flip].copy(), TWO, grid, MaskAperture.of(left[flip], UM))
        plane = check(plate, Rules(window_m=window * UM)).planes[0]
        assert (plane.density, plane.emptiest, plane.fullest) == densities


def test_a_plate_smaller_than_the_window_is_one_window():
    found = check_plane(np.tri(4, dtype=np.uint8))
    assert found.density == found.emptiest == found.fullest == 10 / 16


@pytest.mark.parametrize("shape", [(33, 40), (40, 33), (8, 9), (1, 1)])
@pytest.mark.parametrize("share", [0.4, 0.97, 1.0])
def test_outside_the_aperture_nothing_is_etched(shape, share):
    level_map = np.random.default_rng(2).integers(0, 16, shape).astype(np.uint8)
    grid, aperture = Grid(shape, UM), share * min(shape) * UM
    report = check(LevelMap(level_map, SIXTEEN, grid, aperture), Rules(2 * UM, 3 * UM))
    blank = np.where(grid.inside_circle(aperture), level_map, np.uint8(15))
    for found, plane in zip(report.planes, planes(blank, SIXTEEN), strict=True):
        alone = check_plane(plane, 2, 3)
        assert (found.line, found.space, found.kissing, found.places) == (
            alone.line,
            alone.space,
            alone.kissing,
            alone.places,
        )


@pytest.mark.parametrize("fill", [0, 1])
def test_empty_and_full_planes_break_nothing(fill):
    found = check_plane(np.full((9, 13), fill), 3, 3)
    assert (found.breaks, found.density) == (0, fill)
    assert found.space.smallest_m is None
    assert found.line.smallest_m == (9e-6 if fill else None)


def test_an_ideal_process_is_broken_by_nothing_but_still_measured():
    report = check(level_map_from(np.indices((6, 6)).sum(axis=0) % 2, TWO), Rules.from_process(Process(TWO)))
    assert report.clean
    assert report.planes[0].kissing == 25
    assert report.planes[0].line.smallest_m == 1e-6


def test_edges_off_the_address_grid_of_the_writer():
    blank = level_map_from(np.ones((4, 5)), TWO, 1.85 * UM)
    exact = check(blank, Rules()).off_grid
    assert (exact.edges, exact.of, exact.worst_m) == (0, 11, 0.0)
    coarse = check(blank, Rules(address_m=50e-9)).off_grid
    # The six edges along x lie at odd multiples of 925 nm, those along y at multiples of 1850 nm.
    assert (coarse.edges, coarse.worst_m) == (6, 25e-9)


def test_the_headline_says_what_cannot_be_printed():
    level_map = np.full((40, 40), 15, np.uint8)
    level_map[10:30, 10] = 14
    process = Process(SIXTEEN, minimum_line_m=2 * UM, minimum_space_m=2 * UM)
    report = check(level_map_from(level_map, SIXTEEN, 1.85 * UM, 74 * UM), Rules.from_process(process))
    assert report.headlines() == (
        "mask 1 (bit 0): 95 % of its lines are narrower than the 2 um that the process prints "
        "(down to 1.85 um, in 1 places, 1 of them slivers)",
    )
    assert not report.clean


def test_the_record_is_json_and_the_same_every_time():
    level_map = np.random.default_rng(3).integers(0, 16, (40, 50)).astype(np.uint8)
    reports = [check(level_map_from(level_map, SIXTEEN, UM, 40 * UM), Rules(2 * UM, 2 * UM)) for _ in range(2)]
    texts = [json.dumps(report.as_record(), allow_nan=False) for report in reports]
    assert texts[0] == texts[1]
    record = json.loads(texts[0])
    assert [plane["mask"] for plane in record["planes"]] == [1, 2, 3, 4]
    assert record["planes"][0]["places"][0]["what"] == "kissing corner"
    assert len(record["headlines"]) == 4


@pytest.mark.parametrize(
    "wrong", [{"minimum_line_m": -1e-6}, {"minimum_space_m": float("nan")}, {"address_m": 0.0}, {"window_m": 0.0}]
)
def test_impossible_rules_are_refused(wrong):
    with pytest.raises(InputError, match=f"rules: {next(iter(wrong))}"):
        Rules(**wrong)
