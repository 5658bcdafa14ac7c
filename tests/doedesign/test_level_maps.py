"""Where height maps come from: files of any kind, and runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from doedesign.build import camera_from_spec
from doedesign.design.design import Design
from doedesign.runs.folder import Run, begin_run, claim_run, finish_run, open_run
from doedesign.runs.level_maps import drawing_from, level_map_of_run, read_any_height, write_design
from doedesign.spec import load_spec
from fab.aperture import RoundAperture
from fab.errors import InputError
from fab.grid import Grid
from fab.height import HeightMap
from fab.level_map import LevelMap
from fab.levels import Levels
from sim.store import write_height

QUICK = Path(__file__).parents[2] / "examples" / "quick.toml"
STEP_M = 75e-9


def finished(folder: Path, continuous_m: np.ndarray, *overrides: str) -> Run:
    """A finished run of 16 x 16 cells around given heights."""
    spec = load_spec(QUICK, ["doe.samples=16", "doe.aperture=29.6 um", *overrides])
    with claim_run(folder, spec, {}, overrides) as run:
        begin_run(run)
        height = HeightMap(continuous_m, Grid((16, 16), 1.85e-6), 29.6e-6)
        level_map = LevelMap.from_height(height, Levels(16, STEP_M), "quick", wrapped=True)
        files = write_design(
            folder, Design(level_map, camera_from_spec(spec), (), (), continuous_m=continuous_m, spec=spec)
        )
        finish_run(run, files)
    return run


@pytest.fixture
def continuous_m(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(0, 16 * STEP_M, (16, 16))


def test_a_run_gives_the_levels_it_drew(tmp_path: Path, continuous_m: np.ndarray):
    run = finished(tmp_path, continuous_m)
    for count in (None, 16):
        drawing = level_map_of_run(run, count)
        assert drawing.levels == Levels(16, STEP_M)
        inside = drawing.grid.inside_circle(29.6e-6)
        assert np.array_equal(drawing.level[inside], np.mod(np.rint(continuous_m / STEP_M), 16)[inside])
        assert (drawing.level[~inside] == 15).all()
    assert drawing.name == "quick"
    assert drawing.aperture_m == 29.6e-6


@pytest.mark.parametrize("count", [2, 4, 8, 32, 64])
def test_another_number_of_levels_spans_the_same_height(tmp_path: Path, continuous_m: np.ndarray, count: int):
    drawing = level_map_of_run(finished(tmp_path, continuous_m), count)
    full = 16 * STEP_M
    assert drawing.levels.count * drawing.levels.step_m == pytest.approx(full, rel=1e-12)
    inside = drawing.grid.inside_circle(29.6e-6)
    off = (drawing.height_m - continuous_m)[inside]
    around = np.minimum(np.abs(off), full - np.abs(off))
    # Half a step, and the file's float32 heights.
    assert around.max() <= drawing.levels.step_m / 2 + 1e-7 * full


def test_a_continuous_run_is_rounded_when_it_is_drawn(tmp_path: Path, continuous_m: np.ndarray):
    drawing = level_map_of_run(finished(tmp_path, continuous_m, "optimize.quantisation=none"))
    assert drawing.levels == Levels(16, STEP_M)
    kept = read_any_height(tmp_path / "height.exr").height_m
    np.testing.assert_allclose(kept, continuous_m, rtol=1e-6)  # float32, and not rounded


def test_the_own_number_of_levels_changes_nothing(tmp_path: Path, continuous_m: np.ndarray):
    """Masks against the errors of a process are these masks with `--levels 16`, too; with others they are not."""
    run = finished(tmp_path, continuous_m, 'wafer.edge_moves=["0.1 um", "0.1 um", "0 um", "0 um"]')
    depths_m = tuple(1.01 * depth for depth in Levels(16, STEP_M).depths_m)
    run = replace(open_run(run.folder), aim_depths_m=depths_m)
    for count in (None, 16):
        design = drawing_from(run, count).design
        assert design is not None
        assert design.edge_moves_m == (1e-7, 1e-7, 0.0, 0.0)
        assert design.aim is not None
        assert design.aim.levels.depths_m == depths_m
    design = drawing_from(run, 8).design
    assert design is not None
    assert (design.edge_moves_m, design.aim) == ((), None)


@pytest.mark.parametrize("count", [0, -8, 1, 65, 128])
def test_impossible_levels(tmp_path: Path, continuous_m: np.ndarray, count: int):
    run = finished(tmp_path, continuous_m)
    with pytest.raises(InputError, match="from 2 to 64"):
        drawing_from(run.folder, count)
    np.save(tmp_path / "map.npy", continuous_m)
    with pytest.raises(InputError, match="from 2 to 64"):
        drawing_from(tmp_path / "map.npy", count, step_m=STEP_M, pitch_m=1e-6)


def test_what_an_exr_does_not_say_must_be_given(tmp_path: Path):
    path = tmp_path / "plate.exr"
    write_height(path, np.zeros((4, 6)), 2e-6, 5e-6)
    height = read_any_height(path)
    assert (height.grid.pitch_m, height.relief) == (2e-6, RoundAperture(5e-6))
    height = read_any_height(path, pitch_m=3e-6, aperture=7e-6)
    assert (height.grid.pitch_m, height.relief) == (3e-6, RoundAperture(7e-6))
    for wrong in ({"pitch_m": 0.0}, {"aperture": 0.0}):
        with pytest.raises(InputError, match="positive"):
            read_any_height(path, **wrong)


def test_heights_of_an_exr_that_are_not_metres_have_a_scale(tmp_path: Path):
    """As those of other files of floats do."""
    write_height(tmp_path / "plate.exr", np.full((4, 4), 500.0), 2e-6, 8e-6)
    np.save(tmp_path / "plate.npy", np.full((4, 4), 500.0))
    for name in ("plate.exr", "plate.npy"):
        found = read_any_height(tmp_path / name, pitch_m=2e-6, scale_m=1e-9)
        np.testing.assert_allclose(found.height_m, 500e-9, rtol=1e-6)  # float32
        for scale_m in (0.0, -1e-9):
            with pytest.raises(InputError, match="scale must be positive"):
                read_any_height(tmp_path / name, pitch_m=2e-6, scale_m=scale_m)


def test_a_folder_is_no_height_map(tmp_path: Path):
    with pytest.raises(InputError, match="a height map is a file"):
        read_any_height(tmp_path)


def test_messages_name_the_file(tmp_path: Path):
    np.save(tmp_path / "nanometres.npy", np.full((4, 4), 700.0))
    with pytest.raises(InputError, match=r"Heights are taken as metres.*scale, such as \"1 nm\""):
        drawing_from(tmp_path / "nanometres.npy", 16, step_m=STEP_M, pitch_m=1e-6)
    np.save(tmp_path / "high.npy", np.full((4, 4), 2e-6))
    with pytest.raises(InputError, match="Wrap the map to one wave of height"):
        drawing_from(tmp_path / "high.npy", 16, step_m=STEP_M, pitch_m=1e-6)
    with pytest.raises(InputError, match=r"high\.npy: no height may lie more than half a step above"):
        drawing_from(tmp_path / "high.npy", 16, step_m=STEP_M, pitch_m=1e-6)


def test_a_height_map_is_drawn_under_the_name_of_its_file_without_accents(tmp_path: Path):
    """Letters with accents were left out, and names of two files could become one."""
    for file, name in (("Müller-étalon 2.npy", "Muller_etalon_2"), ("плата.npy", "height")):
        np.save(tmp_path / file, np.zeros((4, 4)))
        drawn = drawing_from(tmp_path / file, 16, step_m=STEP_M, pitch_m=1e-6)
        assert (drawn.level_map.name, drawn.origin["name"]) == (name, file)
