import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.ndimage import gaussian_filter

from fab.errors import InputError
from fab.layout.polygons import smallest_runs
from fab.levels import Levels, planes
from fab.rules import repair as repair_module
from fab.rules.check import Rules, check
from fab.rules.repair import follow, repair
from tests.fab.maps import level_map_from

UM = 1e-6
SIXTEEN = Levels(16, 75e-9)
RATE = 1 / (16 * 75e-9)  # the staircase is one wave


def random_map(shape=(61, 48)):
    return np.random.default_rng(1).integers(0, 16, shape).astype(np.uint8)


def smooth_map(shape=(96, 96)):
    noise = gaussian_filter(np.random.default_rng(2).standard_normal(shape), 8)
    return (noise / noise.std() % 1 * 16).astype(np.uint8)


def radial_map(waves=7.0):
    radius = np.hypot(*(np.indices((120, 120)) - 59.5))
    return (waves * (radius / 60) ** 2 % 1 * 16).astype(np.uint8)


def repair_map(level_map, line=2, space=2, levels=SIXTEEN, aperture=None, rate=RATE):
    aperture_m = min(level_map.shape) * UM if aperture is None else aperture * UM
    given = level_map_from(level_map, levels, UM, aperture_m)
    rules = Rules(line * UM, space * UM)
    done = repair(given, rules, rate)
    report = check(done.level_map, rules)
    assert done.cost.broken_after == sum(plane.breaks for plane in report.planes)
    assert done.rules.as_record() == report.as_record()
    inside = given.grid.inside_circle(aperture_m)
    assert np.array_equal(done.level_map.level[~inside], given.level[~inside])
    return done.level_map.level, done.cost, given.level, inside


@pytest.mark.parametrize(("line", "space"), [(2, 2), (3, 3), (2, 3), (4, 2)])
@pytest.mark.parametrize("make", [random_map, smooth_map, radial_map])
def test_nothing_is_broken_after_a_repair(make, line, space):
    out, cost, _, _ = repair_map(make(), line, space)
    assert cost.broken_before > 0
    assert cost.broken_after == 0
    for plane in planes(out, SIXTEEN):
        # Measured by other code than the check's.
        found = smallest_runs(plane)
        assert all(run is None or run >= least for run, least in zip(found, (line, space), strict=True))


MAPS = hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12), elements=st.integers(0, 3))


@pytest.mark.parametrize("count", [3, 5, 6])
@pytest.mark.parametrize(("line", "space"), [(2, 2), (2, 3)])
def test_a_repair_takes_levels_only(count, line, space):
    """Masks that are repaired one by one would etch together what is no level."""
    levels = Levels(count, 150e-9)
    level = np.random.default_rng(count).integers(0, count, (61, 48)).astype(np.uint8)
    out, cost, _, _ = repair_map(level, line, space, levels, rate=1 / levels.period_m)
    assert cost.broken_before > 0
    assert cost.broken_after == 0
    assert set(np.unique(out)) <= set(range(count))
    sets = np.tensordot(1 << np.arange(levels.bits), planes(out, levels).astype(int), axes=1)
    assert sets.max() < count
    for plane in planes(out, levels):
        found = smallest_runs(plane)
        assert all(run is None or run >= least for run, least in zip(found, (line, space), strict=True))


@given(MAPS, st.integers(1, 3), st.integers(1, 3), st.floats(0.5, 1.5))
@settings(max_examples=60)
def test_no_narrow_line_or_space_is_ever_left(level_map, line, space, share):
    levels = Levels(4, 300e-9)
    aperture = min(1.0, share) * min(level_map.shape)
    out, cost, blank, _ = repair_map(level_map, line, space, levels, aperture)
    for plane in planes(out, levels):
        found = smallest_runs(plane)
        assert all(run is None or run >= least for run, least in zip(found, (line, space), strict=True))
    if cost.broken_before == 0:
        assert np.array_equal(out, blank)


def test_the_cost_is_that_of_the_two_maps():
    out, cost, blank, inside = repair_map(smooth_map())
    steps = out[inside].astype(float) - blank[inside]
    assert cost.changed_share == pytest.approx(np.mean(steps != 0))
    assert cost.rms_height_m == pytest.approx(75e-9 * np.sqrt(np.mean(steps**2)))
    assert cost.efficiency == pytest.approx(abs(np.mean(np.exp(2j * np.pi * steps / 16))) ** 2)


def test_a_repair_costs_less_light_than_coarser_pixels():
    """Squares of two pixels at the best level are the obvious repair, and they even leave corners that touch.

    Where rings are only a few squares wide the two are about equal: everything has to change.
    """
    for level_map in (smooth_map(), radial_map(waves=2.4)):
        _, cost, blank, inside = repair_map(level_map)
        light = np.exp(2j * np.pi * blank / 16)
        ny, nx = blank.shape
        coarse = np.angle(light.reshape(ny // 2, 2, nx // 2, 2).sum(axis=(1, 3)))
        squares = np.kron(np.round(coarse / (2 * np.pi) * 16), np.ones((2, 2)))
        lost = abs(np.mean((light * np.exp(-2j * np.pi * squares / 16))[inside])) ** 2
        assert cost.efficiency > lost


def test_a_lone_pixel_takes_the_level_around_it_and_nothing_else_changes():
    level_map = np.full((20, 20), 9, np.uint8)
    level_map[9, 11] = 8
    out, cost, blank, inside = repair_map(level_map, aperture=math.inf)
    assert np.array_equal(out, np.full_like(level_map, 9))
    assert cost.changed_share == pytest.approx(1 / 400)
    assert cost.efficiency == pytest.approx(abs(1 - (1 - np.exp(2j * np.pi / 16)) / 400) ** 2)
    assert inside.all()
    assert blank[9, 11] == 8


def test_levels_are_near_by_phase_and_not_by_height():
    # Between level 15 and level 0 of one wave lies one step, so the strip joins 15 and not 8.
    level_map = np.full((24, 24), 15, np.uint8)
    level_map[:, 12:] = 8
    level_map[:, 11] = 0
    out, _, _, _ = repair_map(level_map, aperture=math.inf)
    assert set(np.unique(out[:, 11])) == {15}
    assert np.array_equal(np.delete(out, 11, axis=1), np.delete(level_map, 11, axis=1))


def test_a_map_that_breaks_nothing_stays_as_it_is():
    level_map = np.kron(random_map((6, 6)), np.ones((8, 8))).astype(np.uint8)
    out, cost, blank, _ = repair_map(level_map, 1, 1, aperture=math.inf)
    kissing = cost.broken_before
    assert (kissing > 0) == (not np.array_equal(out, blank))
    flat, cost, blank, _ = repair_map(np.full((9, 9), 3, np.uint8), 0, 0, aperture=math.inf)
    assert np.array_equal(flat, blank)
    assert (cost.changed_share, cost.rms_height_m, cost.efficiency, cost.broken_before) == (0, 0, 1, 0)


def test_the_result_does_not_depend_on_who_works_on_it(monkeypatch):
    class InTurn:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            return None

        def map(self, work, parts):
            return [work(part) for part in reversed(list(parts))]

    level_map = smooth_map((300, 40))
    first, again = repair_map(level_map)[0], repair_map(level_map)[0]
    assert np.array_equal(first, again)
    monkeypatch.setattr(repair_module, "ThreadPoolExecutor", InTurn)
    assert np.array_equal(first, repair_map(level_map)[0])


def test_a_wider_minimum_costs_more():
    costs = [repair_map(smooth_map(), k, k)[1] for k in (2, 3, 5)]
    assert all(a.efficiency > b.efficiency and a.changed_share < b.changed_share for a, b in pairwise(costs))


def test_impossible_demands_are_refused():
    with pytest.raises(InputError, match="must not exceed 32 pixels"):
        repair_map(random_map(), 33, 2)
    for rate in (0.0, -1.0, math.nan):
        with pytest.raises(InputError, match="waves per metre"):
            repair_map(random_map(), rate=rate)


def depth_of_walls(level):
    """Length times depth of all walls of all masks, pixels times steps, with code of its own."""
    total = 0
    for bit, plane in enumerate(planes(level, SIXTEEN)):
        total += 2**bit * sum(
            int(np.sum(plane.take(range(1, n), k) != plane.take(range(n - 1), k))) for k, n in enumerate(plane.shape)
        )
    return total


def misses(level, wanted):
    """Mean phase error 1 - cos."""
    return np.mean(1 - np.cos(2 * np.pi * (level.astype(float) - wanted) / 16))


@pytest.mark.parametrize(("line", "space"), [(1, 1), (2, 2), (2, 3)])
def test_a_map_follows_another_and_breaks_no_rule(line, space):
    wanted, rules = smooth_map(), Rules(line * UM, space * UM)
    start = level_map_from(np.full(wanted.shape, 15, np.uint8), SIXTEEN, UM, math.inf)
    moved, errors = start, [misses(start.level, wanted)]
    for _ in range(6):
        moved = follow(moved, wanted, rules, RATE)
        errors.append(misses(moved.level, wanted))
        assert check(moved, rules).clean
    assert all(after <= before for before, after in pairwise(errors))
    # A repair looks at the whole map with all its means; moves that must not break a rule come near it.
    repaired = repair(start.with_level(wanted), rules, RATE).level_map.level
    assert errors[-1] < errors[0] / 5
    assert errors[-1] < 3 * misses(repaired, wanted)


def test_walls_that_cost_are_fewer():
    wanted, rules = smooth_map(), Rules(2 * UM, 2 * UM)
    start = repair(level_map_from(wanted, SIXTEEN, UM, math.inf), rules, RATE).level_map
    depths = np.array([1, 2, 4, 8]) / 16
    found = [follow(start, wanted, rules, RATE, list(weight * depths)).level for weight in (0.0, 0.3, 3.0)]
    walls, errors = [depth_of_walls(one) for one in found], [misses(one, wanted) for one in found]
    assert walls[0] > walls[1] > walls[2]
    assert errors[1] < errors[2]
    # No move pays more for light than it saves in walls, a wall of one step being a sixteenth of the weight; but moves
    # of one pixel bar the way to others.
    assert (errors[2] - errors[1]) * wanted.size < 1.2 * 3.0 / 16 * (walls[1] - walls[2])


def test_what_follows_stays_blank_outside_the_relief():
    wanted = random_map((64, 64))
    start = level_map_from(np.full(wanted.shape, 15, np.uint8), SIXTEEN, UM, 60 * UM)
    moved = follow(start, wanted, Rules(2 * UM, 2 * UM), RATE)
    outside = ~start.grid.inside_circle(60 * UM)
    assert np.all(moved.level[outside] == 15)
    assert np.any(moved.level != 15)
    with pytest.raises(InputError, match="waves per metre"):
        follow(start, wanted, Rules(), 0.0)
