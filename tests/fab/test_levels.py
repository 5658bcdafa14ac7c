import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fab.errors import InputError
from fab.levels import (
    Levels,
    height_of,
    level_map_from_planes,
    planes,
    quantise,
    quantise_wrapped,
    require_levels,
)
from fab.units import NM

SIXTEEN = Levels(16, 75 * NM)
COUNTS = st.integers(2, 64)


def test_the_papers_staircase():
    assert SIXTEEN.bits == 4
    assert [round(SIXTEEN.etch_depth_m(bit) / NM) for bit in range(4)] == [75, 150, 300, 600]
    assert SIXTEEN.heights_m()[-1] == pytest.approx(1125 * NM, rel=1e-15)
    with pytest.raises(ValueError, match="`bit`"):
        SIXTEEN.etch_depth_m(4)


def test_a_count_may_be_a_whole_number_of_numpy():
    levels = Levels(np.int64(16), 75 * NM)  # type: ignore[arg-type]
    assert levels == SIXTEEN
    assert type(levels.count) is int


@pytest.mark.parametrize("count", [0, 1, 65, 128, -2, 10**30, 6.0, np.float32(6), "6", None, True])
def test_counts_that_are_no_whole_number_from_2_to_64_are_refused(count):
    with pytest.raises(InputError, match=r"levels: must be a whole number from 2 to 64, but got"):
        Levels(count, 75 * NM)


@pytest.mark.parametrize(
    ("count", "depths_nm"),
    [(2, [1]), (3, [1, 2]), (4, [1, 2]), (5, [1, 2, 4]), (6, [1, 2, 4]), (8, [1, 2, 4]), (9, [1, 2, 4, 8])],
)
def test_as_many_masks_as_have_so_many_sets(count, depths_nm):
    levels = Levels(count, 1 * NM)
    assert [levels.etch_depth_m(bit) / NM for bit in range(levels.bits)] == pytest.approx(depths_nm, rel=1e-12)
    assert levels.is_full == (count in (2, 4, 8))
    assert levels.heights_m().tolist() == [level * NM for level in range(count)]
    assert (levels.total_m, levels.period_m) == ((count - 1) * NM, count * NM)


def test_the_masks_of_six_levels():
    levels = Levels(6, 75 * NM)
    # From the floor, 5 steps below the blank glass, up: etches of 1 + 4, 4, 1 + 2, 2, 1 and 0 steps.
    opened = planes(np.arange(6)[None], levels)[:, 0]
    assert opened.T.tolist() == [[1, 0, 1], [0, 0, 1], [1, 1, 0], [0, 1, 0], [1, 0, 0], [0, 0, 0]]
    assert np.array_equal(level_map_from_planes(opened[:, None], levels), np.arange(6)[None])


def test_masks_that_make_no_level_are_refused():
    levels = Levels(6, 75 * NM)
    opened = np.zeros((3, 4, 5), np.uint8)
    opened[2, 1, 2:] = 1
    opened[1, 1, 3:] = 1
    got = r"got 2 with a set of masks of none, the first at row 1, column 3"
    with pytest.raises(InputError, match=rf"must give every pixel one of the 6 levels, but {got}"):
        level_map_from_planes(opened, levels)
    assert level_map_from_planes(opened, Levels(7, 75 * NM))[1].tolist() == [6, 6, 2, 0, 0]


@pytest.mark.parametrize("count", [3, 5, 6, 12, 63])
def test_heights_wrap_to_the_nearest_level_of_any_count(count):
    levels = Levels(count, 75 * NM)
    heights = np.random.default_rng(count).uniform(-1e-6, 9e-6, (7, 50))
    off = np.mod(heights - height_of(quantise_wrapped(heights, levels), levels) + levels.period_m / 2, levels.period_m)
    # The rounding of float64 on numbers of this size.
    assert np.abs(off - levels.period_m / 2).max() <= 75 * NM / 2 + 1e-20


@pytest.mark.parametrize("step_m", [0.0, -1e-9, float("nan"), float("inf")])
def test_impossible_steps_are_refused(step_m):
    with pytest.raises(InputError, match="step"):
        Levels(16, step_m)


@given(COUNTS, st.data())
def test_quantising_the_height_of_a_level_map_gives_it_back(count, data):
    levels = Levels(count, 75 * NM)
    level_map = data.draw(
        hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2), elements=st.integers(0, count - 1))
    )
    assert np.array_equal(quantise(height_of(level_map, levels), levels), level_map)
    assert np.array_equal(quantise(height_of(level_map, levels).astype(np.float32), levels), level_map)


@given(hnp.arrays(np.float64, (3, 5), elements=st.floats(0, 15.5 * 75e-9)))
def test_the_nearest_level_is_at_most_half_a_step_away(height_m):
    rest = np.abs(height_of(quantise(height_m, SIXTEEN), SIXTEEN) - height_m)
    # The rounding of float64 on numbers of this size.
    assert rest.max() <= 75 * NM / 2 + 1e-21
    assert len(np.unique(quantise(height_m, SIXTEEN))) <= 16


def test_halfway_goes_up_and_the_top_level_catches_the_half_step_above():
    heights = np.array([[0.5, 1.5, 15.0, 15.5]]) * 2.0**-20
    assert quantise(heights, Levels(16, 2.0**-20)).tolist() == [[1, 2, 15, 15]]


def test_more_than_half_a_step_above_the_top_is_refused():
    heights = np.zeros((2, 3))
    heights[1, 2] = 15.6 * 75 * NM
    with pytest.raises(InputError, match=r"1 wrong pixel, the first at row 1, column 2 \(1.17 um\)"):
        quantise(heights, SIXTEEN)


@pytest.mark.parametrize(("value", "rule"), [(np.nan, "finite"), (np.inf, "finite"), (-1e-12, "negative")])
def test_bad_heights_are_counted_and_located(value, rule):
    heights = np.zeros((4, 4), dtype=np.float32)
    heights[2, 1] = heights[3, 3] = value
    with pytest.raises(InputError, match=rf"{rule}.*2 wrong pixels, the first at row 2, column 1"):
        quantise(heights, SIXTEEN)


@pytest.mark.parametrize(
    "heights", [np.zeros(4), np.zeros((2, 2), dtype=complex), np.zeros((0, 3)), np.zeros((2, 2), int)]
)
def test_other_arrays_are_refused(heights):
    with pytest.raises(InputError, match="two-dimensional"):
        quantise(heights, SIXTEEN)


@pytest.mark.parametrize("level_map", [np.full((2, 2), 16), np.full((2, 2), -1), np.zeros((2, 2)), np.zeros(3, int)])
def test_what_is_no_level_map_is_refused(level_map):
    with pytest.raises(InputError, match="level map"):
        require_levels(level_map, SIXTEEN)
