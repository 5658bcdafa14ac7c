"""The state of a quantised DOE: blank outside its aperture, derived heights, files without loss."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fab.archive import read_archive, write_archive
from fab.errors import InputError
from fab.grid import Grid
from fab.height import HeightMap
from fab.level_map import LevelMap, read_level_map, write_level_map
from fab.levels import Levels

# A few bytes that stand for gigabytes.
WIDE_MASK = {"shape": [20000, 20000], "pitch": 1e-6, "inset": 1.5e-6, "rows": [[20000, 0, 20000]]}


def random_map(seed: int = 0, count: int = 16, shape: tuple[int, int] = (31, 44), name: str = "some map") -> LevelMap:
    level = np.random.default_rng(seed).integers(0, count, shape).astype(np.uint8)
    return LevelMap(level, Levels(count, 75e-9), Grid(shape, 1.85e-6), min(shape) * 1.85e-6, name)


def test_glass_is_blank_outside_the_aperture_and_as_given_inside():
    given_levels = np.random.default_rng(1).integers(0, 4, (20, 20)).astype(np.uint8)
    made = LevelMap(given_levels, Levels(4, 0.3e-6), Grid((20, 20), 1e-6), 12e-6)
    inside = made.grid.inside_circle(12e-6)
    assert np.array_equal(made.level[inside], given_levels[inside])
    assert (made.level[~inside] == 3).all()
    assert not inside.all()


def test_masked_pixels_are_refused():
    """What lies under the mask of an array of numpy.ma would count as glass."""
    grid, mask = Grid((4, 4), 1e-6), np.eye(4, dtype=bool)
    with pytest.raises(InputError, match=r"level map: every pixel must have a value, but got 4 masked values\. Fill"):
        LevelMap(np.ma.array(np.ones((4, 4), np.uint8), mask=mask), Levels(4, 0.3e-6), grid, 4e-6)
    with pytest.raises(InputError, match=r"height map: every pixel must have a value"):
        HeightMap(np.ma.array(np.full((4, 4), 1e-7), mask=mask), grid, 4e-6)
    whole = np.ma.array(np.ones((4, 4), np.uint8))  # without masked pixels it is an array like any other
    assert LevelMap(whole, Levels(4, 0.3e-6), grid, 4e-6).level[2, 2] == 1


def test_heights_are_derived_and_nothing_can_be_written():
    made = random_map()
    assert np.allclose(made.height_m, made.level * 75e-9, rtol=1e-7)  # float32
    for array in (made.level, made.height_m):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 0


def test_heights_of_a_map_lead_back_to_it():
    made = random_map()
    again = LevelMap.from_height(HeightMap(made.height_m, made.grid, made.aperture_m), made.levels, made.name)
    assert again.digest == made.digest


@settings(max_examples=30, deadline=None)
@given(st.sampled_from([2, 4, 8, 16, 32, 64]), st.integers(1, 40), st.integers(1, 40), st.integers(0, 99))
def test_a_file_keeps_everything(tmp_path_factory, count, ny, nx, seed):
    made = random_map(seed, count, (ny, nx))
    path = tmp_path_factory.mktemp("maps") / "level_map.npz"
    write_level_map(path, made)
    again = read_level_map(path)
    assert again.digest == made.digest
    assert (again.levels, again.grid, again.aperture_m, again.name) == (
        made.levels,
        made.grid,
        made.aperture_m,
        made.name,
    )


def test_uneven_depths_and_equal_bytes(tmp_path):
    levels = Levels(4, 0.3e-6, (0.25e-6, 0.61e-6))
    made = LevelMap(np.array([[0, 1], [2, 3]]), levels, Grid((2, 2), 1e-6), 2e-6)
    for name in ("a.npz", "b.npz"):
        write_level_map(tmp_path / name, made)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert read_level_map(tmp_path / "a.npz").levels == levels


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"format": "another"}, "format"),
        ({"shape": [3]}, "level map"),
        ({"shape": [30, 44]}, "planes"),
        ({"shape": [30, 10**14]}, "planes"),
        ({"pitch_m": 10**400}, "level map"),
        ({"levels": 65}, "whole number from 2 to 64"),
        ({"levels": 12}, "one of the 12 levels"),
        ({"pitch_m": -1.0}, "pitch"),
        ({"aperture_m": 1.0}, "shorter side"),
        ({"aperture_m": WIDE_MASK}, "one of 20000 x 20000 cells for a raster of 31 x 44"),
        ({"etch_depths_m": "deep"}, "level map"),
    ],
)
def test_a_file_that_cannot_be_is_refused(tmp_path, change, word):
    path = tmp_path / "level_map.npz"
    write_level_map(path, random_map())
    header, arrays = read_archive(path, "level map", "")
    write_archive(path, header | change, arrays)
    with pytest.raises(InputError, match=word):
        read_level_map(path)


def test_a_changed_byte_is_seen(tmp_path):
    path = tmp_path / "level_map.npz"
    write_level_map(path, random_map())
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match="level map"):
        read_level_map(path)


@pytest.mark.parametrize(
    ("level", "aperture_m", "word"),
    [
        (np.zeros((3, 4), int), 2e-6, "shape"),
        (np.full((4, 4), 4), 2e-6, "levels"),
        (np.zeros((4, 4), int), 5e-6, "shorter"),
    ],
)
def test_what_is_no_level_map_is_refused(level, aperture_m, word):
    with pytest.raises(InputError, match=word):
        LevelMap(level, Levels(4, 0.3e-6), Grid((4, 4), 1e-6), aperture_m)
