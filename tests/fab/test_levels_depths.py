"""Staircases whose etches are not 2^k steps deep: the same arithmetic, other heights."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fab.aperture import RoundAperture
from fab.errors import InputError
from fab.figure import png_bytes
from fab.grid import Grid
from fab.layout.structures import codes_by_depth
from fab.levels import Levels, height_of, level_map_from_planes, planes, quantise, quantise_wrapped, wrapped_cells
from fab.manifest.records import read_manifest
from fab.order.verify import verify
from fab.order.write import write_order
from fab.plots.masks import plot_masks
from fab.process import Process
from fab.rules.check import Rules
from fab.rules.repair import repair
from fab.runsheet.recipe import depths_m
from tests.fab.maps import FEW, PLAIN, level_map_from, wide_map

NM = 1e-9
STEP_M = 300 * NM
# Level l: 0, 250, 600, 850 nm; the shallow etch is not the first level's.
UNEVEN = Levels(4, STEP_M, (250 * NM, 600 * NM))
# The deep etch comes first, so levels are no order of height: 0, 500, 150, 650 nm.
SWAPPED = Levels(4, STEP_M, (500 * NM, 150 * NM))


@st.composite
def staircases(draw: st.DrawFn) -> Levels:
    """Any number of levels, any depths that are not in each other's way."""
    count = draw(st.integers(2, 64))
    bits = (count - 1).bit_length()
    step = draw(st.floats(10 * NM, 500 * NM))
    depths = draw(st.lists(st.floats(0.3, 2.0**bits), min_size=bits, max_size=bits))
    try:
        return Levels(count, step, tuple(depth * step for depth in depths))
    except InputError:
        # Two levels met; a set that cannot meet stands in.
        return Levels(count, step, tuple(step * 2.2**k for k in range(bits)))


def test_the_height_of_a_level_is_what_the_closed_masks_leave():
    assert UNEVEN.heights_m().tolist() == [0.0, 250 * NM, 600 * NM, 250 * NM + 600 * NM]
    assert SWAPPED.by_height()[0].tolist() == [0, 2, 1, 3]
    assert (UNEVEN.total_m, UNEVEN.period_m) == (250 * NM + 600 * NM, 4 * STEP_M)
    assert [UNEVEN.etch_depth_m(bit) for bit in range(2)] == [250 * NM, 600 * NM]
    assert str(UNEVEN) == "4 levels by etches of 250 nm and 600 nm"
    assert str(Levels(2, STEP_M, (250 * NM,))) == "2 levels by an etch of 250 nm"


def test_of_fewer_levels_than_sets_of_masks_the_first_sets_remain():
    depths = (250 * NM, 600 * NM, 700 * NM)
    five = Levels(5, STEP_M, depths)
    # Etched by no mask, by 0, by 1, by 0 + 1, and by 2; the fourth is the deepest, and 0 is its height.
    np.testing.assert_allclose(850 * NM - five.heights_m()[::-1], np.array([0, 250, 600, 850, 700]) * NM, atol=1e-20)
    assert (five.total_m, five.heights_m().min()) == (pytest.approx(850 * NM, rel=1e-12), 0.0)
    assert depths_m(five) == pytest.approx(np.array([0, 250, 600, 700, 850]) * NM, rel=1e-12)
    # 250 + 700 nm is no level of five, so a mask of 950 nm may stand beside it; of six it is a level made twice.
    assert Levels(5, STEP_M, (250 * NM, 950 * NM, 700 * NM)).bits == 3
    with pytest.raises(InputError, match=r"950 nm deep both by masks 1 \(bit 0\) \+ 3 \(bit 2\) and by mask 2 "):
        Levels(6, STEP_M, (250 * NM, 950 * NM, 700 * NM))


@pytest.mark.parametrize("count", [2, 3, 4, 6, 8, 12, 16, 32, 63, 64])
def test_depths_of_2_to_the_k_steps_are_the_even_staircase_itself(count):
    step = 75 * NM
    even = Levels(count, step)
    # As text gives them back, a bit or two off.
    given_m = tuple(float(f"{2**k * 75}e-9") for k in range(even.bits))
    assert Levels(count, step, given_m) == even
    assert hash(Levels(count, step, given_m)) == hash(even)
    assert even.is_binary
    assert even.heights_m().tobytes() == (np.arange(count, dtype=np.float64) * np.float64(step)).tobytes()
    assert even.total_m == (count - 1) * step


@given(staircases(), st.integers(0, 2**32 - 1))
def test_masks_and_levels_are_inverse_for_any_depths(levels: Levels, seed: int):
    level_map = np.random.default_rng(seed).integers(0, levels.count, (5, 7)).astype(np.uint8)
    opened = planes(level_map, levels)
    assert np.array_equal(level_map_from_planes(opened, levels), level_map)
    # What is left standing is the blank glass less the etches.
    etched = np.tensordot(np.array(levels.depths_m), opened.astype(float), axes=1)
    np.testing.assert_allclose(height_of(level_map, levels), levels.total_m - etched, atol=1e-12 * levels.total_m)
    # Every height says which level it is, in single precision, too.
    for heights in (height_of(level_map, levels), height_of(level_map, levels).astype(np.float32)):
        assert np.array_equal(quantise(heights, levels), level_map)


@given(staircases(), st.integers(0, 2**32 - 1))
def test_the_nearest_level_is_the_nearest(levels: Levels, seed: int):
    rng = np.random.default_rng(seed)
    heights, found = rng.uniform(0, levels.total_m, (4, 9)), levels.heights_m()
    off = np.abs(heights - height_of(quantise(heights, levels), levels))
    np.testing.assert_allclose(off, np.abs(heights[..., None] - found).min(axis=-1), atol=1e-12 * levels.total_m)
    period = levels.period_m
    wrapped = rng.uniform(0, period, (4, 9))
    apart = np.mod(wrapped[..., None] - found, period)
    distance = np.minimum(apart, period - apart)
    chosen = quantise_wrapped(wrapped, levels)
    got = np.take_along_axis(distance, chosen[..., None].astype(int), axis=-1)[..., 0]
    np.testing.assert_allclose(got, distance.min(axis=-1), atol=1e-12 * period)


def test_halfway_goes_up_and_the_top_catches_half_a_step():
    # Sums of these are exact: 0, 2, 5, 7 and halves.
    unit = 2.0**-20
    levels = Levels(4, unit, (2 * unit, 5 * unit))
    heights = unit * np.array([[0.0, 0.999, 1.0, 3.499, 3.5, 5.999, 6.0, 7.5]])
    assert quantise(heights, levels).tolist() == [[0, 0, 1, 1, 2, 2, 3, 3]]
    with pytest.raises(
        InputError, match=r"half a step above the top level .*4 levels by etches of 1\.9\d* um and 4\.7\d* um"
    ):
        quantise(unit * np.array([[7.6]]), levels)


def test_the_wave_begins_within_the_share_of_one_level():
    edges, cells = wrapped_cells(UNEVEN)
    # 850 nm and one wave of 1200 nm: halfway at 1025 nm, beyond which the floor of the next wave is nearer.
    np.testing.assert_allclose(edges, np.array([125, 425, 725, 1025]) * NM, rtol=1e-12)
    assert cells.tolist() == [0, 1, 2, 3, 0]
    # Deeper than a wave: 300 + 1000 nm is 100 nm of the next one, and the highest place is 1000 nm. Its share ends
    # halfway to the floor of the next wave, at 1100 nm.
    edges, cells = wrapped_cells(Levels(4, STEP_M, (300 * NM, 1000 * NM)))
    np.testing.assert_allclose(edges, np.array([50, 200, 650, 1100]) * NM, rtol=1e-9)
    assert cells.tolist() == [0, 3, 1, 2, 0]
    # Places 0 (of 1200) and 500 nm: all of the wave below 250 nm and above 850 nm is nearest to the floor.
    edges, cells = wrapped_cells(Levels(2, 600 * NM, (1700 * NM,)))
    np.testing.assert_allclose(edges, np.array([250, 850]) * NM, rtol=1e-9)
    assert cells.tolist() == [0, 1, 0]


def test_an_even_staircase_is_quantised_as_ever():
    heights = np.random.default_rng(1).uniform(0, 1.16e-6, (300, 40))
    plain = np.minimum(np.floor(heights / (75 * NM) + 0.5), 15)
    assert np.array_equal(quantise(heights, Levels(16, 75 * NM)), plain)
    assert np.array_equal(quantise_wrapped(heights, Levels(16, 75 * NM)), np.mod(np.rint(heights / (75 * NM)), 16))


@pytest.mark.parametrize(
    ("depths", "message"),
    [
        ((80 * NM,), "4 levels must have 2 etches, but got 1 depths"),
        ((80 * NM, -150 * NM), "etch depths: must be positive"),
        ((80 * NM, float("nan")), "etch depths: must be positive"),
        ((0.0, 80 * NM), "etch depths: must be positive"),
        ((150 * NM, 150 * NM), "same height, but got 150 nm deep both by mask 2 .bit 1. and by mask 1 .bit 0."),
        # A thousandth of a step of 300 nm is 0.3 nm.
        ((150 * NM, 150.2 * NM), "no two levels may have the same height"),
        ((0.2 * NM, 150 * NM), "no two levels may have the same height"),
    ],
)
def test_depths_that_make_no_staircase_are_refused(depths, message):
    with pytest.raises(InputError, match=message):
        Levels(4, STEP_M, depths)


def test_three_masks_that_sum_up_to_a_fourth_are_refused():
    with pytest.raises(InputError, match=r"300 nm deep both by mask(s 1 .* and by mask 3| 3 .* and by masks 1) \(bit"):
        Levels(8, 100 * NM, (100 * NM, 200 * NM, 300 * NM))


def test_etches_go_from_shallow_to_deep():
    assert Process(UNEVEN).order == (0, 1)
    assert Process(SWAPPED).order == (1, 0)
    assert Process(SWAPPED).depths_m() == (500 * NM, 150 * NM)
    assert depths_m(SWAPPED) == pytest.approx((0.0, 150 * NM, 500 * NM, 650 * NM), rel=1e-12)
    assert codes_by_depth(SWAPPED, (0, 1)) == [0, 2, 1, 3]


@pytest.mark.slow
def test_a_repair_weighs_light_by_heights_not_by_numbers_of_levels():
    # Levels 1 and 2 are 50 nm apart, 0 and 1 are 500 nm; one pixel of level 1 or 0 lies in a field of level 2.
    levels = Levels(4, STEP_M, (500 * NM, 550 * NM))
    rate = 1 / levels.period_m
    costs = {}
    for odd in (0, 1):
        level_map = np.full((24, 24), 2, np.uint8)
        level_map[12, 12] = odd
        done = repair(level_map_from(level_map, levels), Rules(2e-6, 2e-6), rate)
        fixed, cost = done.level_map.level, done.cost
        costs[odd] = cost
        assert cost.broken_after == 0
        moved_m = height_of(fixed, levels) - height_of(level_map, levels)
        assert cost.rms_height_m == pytest.approx(float(np.sqrt(np.mean(moved_m**2))), rel=1e-9)
        light = np.mean(np.exp(2j * np.pi * rate * moved_m))
        assert cost.efficiency == pytest.approx(float(abs(light) ** 2), rel=1e-9)
    assert costs[1].rms_height_m < costs[0].rms_height_m


def test_uneven_depths_are_as_fast_as_they_must_be():
    heights = np.random.default_rng(2).uniform(0, 800 * NM, (2400, 2400)).astype(np.float32)
    begun = time.perf_counter()
    quantise(heights, UNEVEN)
    # 0.1 s alone; a machine that is busy gets much more.
    assert time.perf_counter() - begun < 3


@pytest.fixture(scope="module")
def order(tmp_path_factory):
    level_map = np.random.default_rng(7).integers(0, 8, (21, 16)).astype(np.uint8)
    levels = Levels(8, 150e-9, (520.3e-9, 160.1e-9, 330e-9))
    folder = tmp_path_factory.mktemp("orders") / "uneven"
    grid = Grid((21, 16), 1.85e-6)
    drawn, source = wide_map(level_map, levels, grid, "uneven"), {"height_map": "a test"}
    written = write_order(folder, drawn, source=source, wafer=FEW, formats=PLAIN)
    return folder, levels, written.report


def test_an_order_says_every_depth_and_gives_the_staircase_back(order):
    folder, levels, report = order
    assert report.passed
    assert verify(folder).passed
    manifest = read_manifest(folder)
    assert [mask.depth_nm for mask in manifest.masks] == [520.3, 160.1, 330.0]
    assert [mask.file.partition("_M")[2] for mask in manifest.masks] == [
        "1_520P3NM.gds",
        "2_160P1NM.gds",
        "3_330NM.gds",
    ]
    assert manifest.staircase() == levels
    assert [plate.bit for plate in manifest.plates if plate.bit is not None] == [1, 2, 0]
    assert "2^k steps;" not in manifest.conventions["masks"]
    heights = np.load(folder / f"{manifest.masks[0].cell.partition('_M')[0]}_HEIGHT.npy")
    drawn = height_of(np.load(folder / manifest.level_map_file), levels)
    assert np.array_equal(heights, drawn.astype(np.float32))


def test_the_picture_of_an_order_takes_heights_from_the_levels():
    level_map = np.arange(64, dtype=np.uint8).reshape(8, 8) % 4
    pictures = {
        png_bytes(plot_masks(level_map_from(level_map, levels, 1e-6, 8e-6), (RoundAperture(8e-6), 8e-6)))
        for levels in (UNEVEN, SWAPPED, Levels(4, STEP_M))
    }
    assert len(pictures) == 3
