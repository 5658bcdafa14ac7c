"""Cells that repeat, made of strokes: what they promise the rules of lithography hold."""

import numpy as np
import pytest

from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.rules.check import Rules, check
from fab.rules.strokes import Strokes


def printed(glass: np.ndarray, rules: Rules, pitch_m: float) -> bool:
    """Whether a middle part of three by three cells breaks no rule; cut across lines, which its rim may make narrow."""
    ny, nx = glass.shape
    level = np.tile(glass, (5, 5)).astype(np.uint8)
    report = check(LevelMap(level, Levels(2, 1e-6), Grid(level.shape, pitch_m), np.inf), rules)
    inner = np.array([ny, nx]) * 1.5 * pitch_m
    if not report.planes[0].breaks:
        return True
    codes = rules.codes(1 - level, pitch_m)[ny : 4 * ny, nx : 4 * nx]
    corners = [one for one in report.planes[0].places if one.what == "kissing corner"]
    return not (codes > 1).any() and not any(abs(one.y_m) < inner[0] and abs(one.x_m) < inner[1] for one in corners)


@pytest.mark.parametrize(("line", "space"), [(1, 1), (2, 2), (3, 2), (2, 4)])
def test_the_nearest_cell_can_be_printed(line: int, space: int):
    rules = Rules(line * 1e-7, space * 1e-7)
    strokes = Strokes.of(rules, 1e-7)
    assert strokes == (line, space, False)
    rng = np.random.default_rng(line + 10 * space)
    for shape in ((12, 12), (16, 10), (1, 20)):
        outline = rng.normal(size=shape)
        found = strokes.nearest(outline)
        assert found is not None
        assert strokes.follows(found)
        assert printed(found, rules, 1e-7)
        assert 0 < found.mean() < 1
        # A cell that can be printed is its own nearest.
        np.testing.assert_array_equal(strokes.nearest(np.where(found, 1.0, -1.0)), found)


def test_what_is_too_narrow_or_touches_at_a_corner_does_not_follow():
    strokes = Strokes.of(Rules(2e-7, 3e-7), 1e-7)
    glass = np.ones((12, 12), bool)
    assert strokes.follows(glass)
    glass[2:4, 2:4] = False
    assert strokes.follows(glass)
    glass[2:4, 6] = False  # a line of one pixel
    assert not strokes.follows(glass)
    glass[2:4, 7] = False  # of two, but two pixels from the other
    assert not strokes.follows(glass)
    glass[2:4, 6:8], glass[2:4, 7:9] = True, False
    assert strokes.follows(glass)
    glass[4:6, 9:11] = False
    assert not strokes.follows(glass)
    assert Strokes(2, 1, True).follows(glass)


def test_a_stroke_goes_on_across_the_rim():
    strokes = Strokes(2, 3, False)
    np.testing.assert_array_equal(strokes.stroke((4, 5), 3, 4, False), [0, 4, 15, 19])
    assert len(strokes.stroke((4, 5), 3, 4, True)) == 9
    np.testing.assert_array_equal(strokes.stroke((1, 6), 0, 5, True), [0, 1, 5])


def test_a_process_that_prints_everything_asks_for_nothing():
    strokes = Strokes.of(Rules(), 1e-7)
    assert strokes == (1, 1, True)
    checkered = np.indices((4, 4)).sum(0) % 2 == 0
    assert strokes.follows(checkered)
    np.testing.assert_array_equal(strokes.nearest(np.where(checkered, 1.0, -1.0)), checkered)
    assert not Strokes(1, 1, False).follows(checkered)
