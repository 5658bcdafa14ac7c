import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fab.errors import InputError
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels, height_of, level_map_from_planes, planes
from fab.units import NM

COUNTS = st.sampled_from([2, 4, 8, 16, 32, 64])


@given(COUNTS, st.data())
def test_joining_undoes_splitting(count, data):
    levels = Levels(count, 75 * NM)
    level_map = data.draw(
        hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2), elements=st.integers(0, count - 1))
    )
    bit_planes = planes(level_map, levels)
    assert bit_planes.shape == (levels.bits, *level_map.shape)
    assert np.array_equal(level_map_from_planes(bit_planes, levels), level_map)


@given(COUNTS, st.data())
def test_splitting_undoes_joining(count, data):
    levels = Levels(count, 75 * NM)
    bit_planes = data.draw(hnp.arrays(np.uint8, (levels.bits, 3, 4), elements=st.integers(0, 1)))
    assert np.array_equal(planes(level_map_from_planes(bit_planes, levels), levels), bit_planes)


@given(hnp.arrays(np.uint8, (4, 5), elements=st.integers(0, 15)))
def test_the_etches_add_up_to_what_is_missing_from_the_blank(level_map):
    levels = Levels(16, 75 * NM)
    depths = np.array([levels.etch_depth_m(bit) for bit in range(levels.bits)])
    etched_m = np.tensordot(depths, planes(level_map, levels), axes=1)
    # Sums of four float64 numbers near 1e-6.
    np.testing.assert_allclose(etched_m, levels.heights_m()[-1] - height_of(level_map, levels), rtol=0, atol=1e-20)


def test_outside_the_aperture_the_glass_is_left_blank():
    levels, grid = Levels(16, 75 * NM), Grid((6, 8), 1e-6)
    made = LevelMap(np.zeros((6, 8), dtype=np.uint8), levels, grid, 4e-6)
    blank = made.level
    assert np.array_equal(blank == 0, grid.inside_circle(4e-6))
    assert set(np.unique(blank)) == {0, 15}
    assert np.array_equal(made.planes(), planes(blank, levels))
    assert not made.planes()[:, ~grid.inside_circle(4e-6)].any()


def test_mismatches_are_refused():
    levels = Levels(16, 75 * NM)
    with pytest.raises(InputError, match="16 levels need 4 planes"):
        level_map_from_planes(np.zeros((3, 2, 2), dtype=np.uint8), levels)
    with pytest.raises(InputError, match="0 or 1"):
        level_map_from_planes(np.full((4, 2, 2), 2, dtype=np.uint8), levels)
    with pytest.raises(InputError, match="0 to 15"):
        planes(np.full((2, 2), 16), levels)
