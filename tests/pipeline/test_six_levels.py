"""Six levels, which three masks make, through every command: `[process] levels = 6`."""

import json

import numpy as np
import pytest

from doedesign.runs.level_maps import open_design
from fab.levels import Levels
from fab.manifest.records import read_manifest
from sim.store import read_bank

pytestmark = pytest.mark.usefixtures("without_pictures")

SIX = Levels(6, 200e-9)
TOLD = ("--set", "process.levels=6", "--set", "process.level_step=200 nm", "--set", "optimize.start=random")
ERRORS = """
[process]
levels = 6
level_step = "200 nm"

[process.errors]
depth_scale = [0.01, 0.01, 0.02]
overlay_x = "0.2 um"
overlay_y = "0.2 um"
cd_bias = "0.1 um"
"""


@pytest.fixture(scope="module")
def made(tiny, cli, tmp_path_factory):
    """A run with six levels, and its order. Not to be changed."""
    folder = tmp_path_factory.mktemp("six")
    run, order = folder / "run", folder / "order"
    for arguments in (("optimize", tiny, "--out", run, *TOLD), ("masks", run, "--out", order), ("verify", order)):
        done = cli(*arguments)
        assert done.code == 0, done.err
    return run, order


def test_masks_draw_the_six_levels_of_the_run(made):
    run, order = made
    own, drawn = open_design(run, False), open_design(run, order)
    assert own.levels == drawn.levels == read_manifest(order).staircase() == SIX
    assert np.array_equal(own.level_map.level, drawn.level_map.level)
    assert np.unique(own.level_map.level).tolist() == [0, 1, 2, 3, 4, 5]
    sheet = json.loads(next(order.glob("*_RUNSHEET.json")).read_text())
    assert [step["etch"]["target_nm"] for step in sheet["steps"] if step.get("etch")] == [200, 400, 800]
    assert sheet["staircase_nm"] == [0, 200, 400, 600, 800, 1000]
    assert any("staircase 6 levels" in name for name in read_manifest(order).wafer.places_um)


@pytest.mark.slow
def test_a_design_of_six_levels_is_drawn_with_five(made, cli, tmp_path):
    done = cli("masks", made[0], "--levels", 5, "--out", tmp_path / "five")
    assert done.code == 0, done.err
    assert "designed with 6 levels and drawn with 5" in done.err
    assert read_manifest(tmp_path / "five").staircase() == Levels(5, 240e-9)
    assert cli("verify", tmp_path / "five").code == 0


@pytest.mark.slow
def test_a_bare_map_of_three_levels(cli, tmp_path):
    level = np.random.default_rng(5).integers(0, 3, (24, 24))
    np.save(tmp_path / "map.npy", level * 400e-9)
    geometry = ("--levels", 3, "--step", "400 nm", "--pitch", "2 um")
    done = cli("masks", tmp_path / "map.npy", *geometry, "--out", tmp_path / "o")
    assert done.code == 0, done.err
    assert [mask.depth_nm for mask in read_manifest(tmp_path / "o").masks] == [400, 800]


@pytest.mark.slow
def test_light_errors_and_yield_of_six_levels(made, cli, tmp_path):
    import shutil

    run, order = shutil.copytree(made[0], tmp_path / "run"), made[1]
    process = tmp_path / "process.toml"
    process.write_text(ERRORS)
    found = []
    assert cli("psf", run, "--masks", order).code == 0
    for errors in ((), ("--process", process, "--seed", 1)):
        done = cli("psf", run, "--masks", order, "--fabricated", *errors)
        assert done.code == 0, done.err
        found.append(read_bank(run / "fabricated" / "fabricated.exr").energy)
    # An ideal process: the plate as drawn.
    assert np.array_equal(found[0], read_bank(run / "psf" / "quantised.exr").energy)
    # Masks that overlap also etch what is no level.
    assert not np.allclose(found[1], found[0], rtol=1e-3)
    done = cli("tolerance", run, "--masks", order, "--process", process, "--draws", 6, "--workers", 1)
    assert done.code == 0, done.err
    draws = (run / "tolerance" / "draws.csv").read_text().splitlines()
    assert {line.partition(",")[0] for line in draws[1:]} >= {f"normal/{draw}" for draw in range(6)}


@pytest.mark.slow
def test_six_levels_by_etches_that_the_run_chooses(tiny, cli, tmp_path):
    run, order = tmp_path / "run", tmp_path / "order"
    chosen = ("--set", "process.etch_depths=optimize", "--set", "optimize.steps=20")
    for arguments in (
        ("optimize", tiny, "--out", run, *TOLD, *chosen),
        ("masks", run, "--out", order),
        ("verify", order),
        ("psf", run, "--masks", order, "--fabricated"),
    ):
        done = cli(*arguments)
        assert done.code == 0, done.err
    levels = read_manifest(order).staircase()
    assert (levels.count, levels.bits, levels.is_binary) == (6, 3, False)
    assert open_design(run, order).levels == levels
