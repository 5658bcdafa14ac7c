"""The picture of where masks break the rules."""

import numpy as np
import pytest

from fab.figure import png_bytes
from fab.grid import Grid
from fab.levels import Levels
from fab.plots import rules as picture
from fab.rules.check import Rules, check
from tests.fab.maps import level_map_from
from tests.pictures import dots_of, panel, require_whole

UM = 1e-6
SIXTEEN = Levels(16, 75e-9)
RULES = Rules(2 * UM, 2 * UM)


def plot(level, rules=RULES, levels=SIXTEEN):
    return picture.plot_rules(check(level_map_from(level, levels, UM, min(level.shape) * UM), rules), "a set")


def draw(level):
    return np.rint(255 * dots_of(plot(level))).astype(int)


def dots(image, colour) -> int:
    """How many dots of the picture have a colour, to a rounding of each channel."""
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return int(np.count_nonzero(np.abs(image - wanted).max(axis=2) <= 2))


def blank(shape=(64, 64)):
    return np.full(shape, 15, np.uint8)


@pytest.mark.slow
def test_every_kind_of_breach_has_its_colour():
    clean = draw(blank())
    line, space = blank(), blank()
    line[20:50, 30] = 14
    space[20:50, 20:40] = 14
    space[20:50, 30] = 15
    for level, colour in ((line, picture._NARROW_LINE), (space, picture._NARROW_SPACE)):
        image = draw(level)
        # The window magnifies a strip of 30 pixels to some ten dots each.
        assert dots(clean, colour) == 0
        assert dots(image, colour) > 30 * 10 * 10
        # In the overview, too, as large or a little smaller.
        overview, window = np.array_split(image, 2)
        assert 0.3 < dots(overview, colour) / dots(window, colour) < 1.5


def test_a_kissing_corner_is_black_in_the_overview():
    level = blank()
    level[:32, :32] = level[32:, 32:] = 14
    drawn = panel(plot(level), "mask 1")
    black = [0x11 / 255] * 3
    # The pixel below and left of the corner in the middle, and the ring about it.
    image = np.asarray(drawn.images[0].get_array())
    assert np.argwhere(np.abs(image - black).max(axis=2) < 0.01).tolist() == [[31, 31]]
    (ring,) = drawn.collections
    np.testing.assert_allclose(np.asarray(ring.get_edgecolor())[:, :3], [black])


def test_one_broken_pixel_of_a_large_plate_is_ringed_in_the_overview():
    level_map = blank((1200, 1200))
    level_map[700, 300] = 14
    image = draw(level_map)
    rows, columns = np.nonzero((np.abs(image - [0x00, 0x72, 0xB2]).max(axis=2) <= 60)[: image.shape[0] // 2])
    # A ring of six points across, thinner than two dots, within the first of four masks.
    assert len(rows) > 12
    assert columns.max() < image.shape[1] / 4
    assert np.ptp(columns) < 30
    assert np.ptp(rows) < 30


def test_pixels_are_coded_by_what_is_wrong_with_them():
    plane = np.zeros((9, 12), np.uint8)
    plane[2:7, 1] = 1  # a narrow line, at two pixels from the next one
    plane[2:7, 4:7] = 1
    plane[2:7, 8:11] = 1
    codes = RULES.codes(plane, UM)
    assert np.all(codes[2:7, 1] == 3)
    assert np.all(codes[2:7, 2:4] == 0)
    assert np.all(codes[2:7, 7] == 2)
    assert np.all(codes[2:7, 4:7] == 1)
    assert np.all(codes[7:] == 0)


def test_narrow_pixels_are_those_that_the_check_counts():
    plane = np.random.default_rng(8).integers(0, 2, (40, 50)).astype(np.uint8)
    report = check(level_map_from(1 - plane, Levels(2, 1e-6)), Rules(3 * UM, 2 * UM)).planes[0]
    codes = Rules(3 * UM, 2 * UM).codes(plane, UM)
    assert np.any(codes == 2)
    assert np.any(codes == 3)
    assert int(picture._corners(plane).sum()) == report.kissing
    for place in report.places:
        y, x = (round((at - 0.25 * UM) / UM + n / 2 - 0.5) for at, n in zip(place[1:3], plane.shape, strict=True))
        if place.what != "kissing corner":
            assert codes[y, x] == {"line": 3, "space": 2}[place.what]


def test_the_worst_place_is_inside_the_window_even_at_the_rim():
    for y, x in ((0, 40), (79, 40), (40, 0), (40, 79), (41, 37)):
        level_map = blank((80, 80))
        level_map[y, x] = 14
        grid = Grid((80, 80), UM)
        found = check(level_map_from(level_map, SIXTEEN, UM, 80 * UM), RULES).planes[0]
        rows, columns = picture._window(found, grid)
        assert found.line.narrow == 2
        assert rows.start <= y < rows.stop <= 80
        assert columns.start <= x < columns.stop <= 80
        assert rows.stop - rows.start == columns.stop - columns.start == 40


@pytest.mark.parametrize("levels", [pytest.param(Levels(2, 600e-9), marks=pytest.mark.slow), Levels(64, 20e-9)])
@pytest.mark.parametrize("shape", [(1, 1), (7, 30), (61, 44)])
def test_any_number_of_masks_and_any_shape(levels, shape):
    level_map = np.random.default_rng(1).integers(0, levels.count, shape).astype(np.uint8)
    require_whole(plot(level_map, levels=levels))


def test_the_same_masks_give_the_same_bytes():
    level_map = np.random.default_rng(1).integers(0, 16, (50, 50)).astype(np.uint8)
    assert png_bytes(plot(level_map)) == png_bytes(plot(level_map))
