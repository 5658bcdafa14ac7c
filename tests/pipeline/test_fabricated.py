"""`doedesign psf --fabricated`: one plate as the process makes it."""

import json

import numpy as np
import pytest

from doedesign.runs.folder import open_run
from doedesign.runs.level_maps import level_map_of_run
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.manifest.records import read_manifest
from fab.order.write import write_order
from fab.process import Normal, Process
from sim.store import read_bank

PROCESS = """
[process]
levels = 16
level_step = "75 nm"

[process.errors]
overlay_x = "0.4 um"
common_depth_scale = { mean = 0.03, sigma = 0.01 }
"""


@pytest.fixture
def process(tmp_path):
    path = tmp_path / "process.toml"
    path.write_text(PROCESS)
    return path


@pytest.fixture
def copy_of_run(copied):
    return copied.run


def energies(run):
    return read_bank(run / "fabricated" / "fabricated.exr").energy


@pytest.mark.slow
def test_an_ideal_process_gives_the_quantised_design_to_the_last_bit(copy_of_run, cli):
    done = cli("psf", copy_of_run, "--fabricated")
    assert done.code == 0, done.err
    drawn = read_bank(copy_of_run / "psf" / "quantised.exr").energy
    assert np.array_equal(energies(copy_of_run), drawn)


@pytest.mark.slow
def test_a_seed_is_repeated_and_its_variation_file_gives_the_same_plate(copy_of_run, cli, process, tmp_path):
    assert cli("psf", copy_of_run, "--fabricated", "--process", process, "--seed", 5).code == 0
    first = energies(copy_of_run)
    plate = tmp_path / "variation.toml"
    plate.write_bytes((copy_of_run / "fabricated" / "variation.toml").read_bytes())
    bytes_before = (copy_of_run / "fabricated" / "fabricated_psf.png").read_bytes()
    assert cli("psf", copy_of_run, "--fabricated", "--process", process, "--variation", plate).code == 0
    assert np.array_equal(energies(copy_of_run), first)
    assert (copy_of_run / "fabricated" / "fabricated_psf.png").read_bytes() == bytes_before
    assert cli("psf", copy_of_run, "--fabricated", "--process", process, "--seed", 6).code == 0
    assert not np.array_equal(energies(copy_of_run), first)


@pytest.mark.slow
def test_the_budget_of_a_plate_is_whole(copy_of_run, cli, process):
    assert cli("psf", copy_of_run, "--fabricated", "--process", process).code == 0
    rows = json.loads((copy_of_run / "fabricated" / "metrics.json").read_text())
    for row in rows["fabricated"]:
        split = row["split"]
        # The three are sums of float32 maps.
        assert sum(split.values()) == pytest.approx(row["throughput"], rel=1e-5)
        assert 0 < row["strehl"] < 1
    # What passes both faces (93 % for fused silica) goes to the window or beyond; no chrome is displaced.
    for row in (*rows["nominal"], *rows["fabricated"]):
        assert row["throughput"] + row["outside_window"] == pytest.approx(0.932, abs=2e-3)
        # The circle's cells are counted in float32.
        assert row["chrome"] == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--fabricated", "--seed", 1, "--variation", "v.toml"), "--seed"),
        (("--fabricated", "--variation", "missing.toml"), "missing.toml"),
        (("--fabricated", "--process", "missing.toml"), "missing.toml"),
        (("--fabricated", "--depths", "5 cm"), "--depths"),
        (("--seed", 1), "--fabricated"),
        (("--fabricated", "--seed", 1, "--draw", "nonsense"), "nonsense"),
    ],
)
def test_bad_input_is_named(copy_of_run, cli, options, words):
    done = cli("psf", copy_of_run, *options)
    assert done.code == 2
    assert words in done.err
    assert "Traceback" not in done.err
    assert not (copy_of_run / "fabricated").exists()


def test_errors_beyond_the_model_are_named(copy_of_run, cli, tmp_path):
    plate = tmp_path / "plate.toml"
    plate.write_text('[variation]\ncommon_cd_bias = "2 um"\n')
    done = cli("psf", copy_of_run, "--fabricated", "--variation", plate)
    assert done.code == 2
    assert "cd_bias" in done.err


BIASED = """
[process]
levels = 16
level_step = "75 nm"

[process.errors]
common_cd_bias = { mean = "0.2 um" }
"""


@pytest.mark.slow
def test_masks_drawn_against_the_bias_of_the_process_give_the_design(copy_of_run, cli, tmp_path):
    """A bias of 0.2 um that the masks foresee is not seen in the light; one that nobody foresaw is."""
    run = open_run(copy_of_run)
    drawing = level_map_of_run(run)
    biased = tmp_path / "biased.toml"
    biased.write_text(BIASED)
    order = tmp_path / "moved"
    write_order(
        order,
        LevelMap(drawing.level, drawing.levels, drawing.grid, drawing.aperture_m, "tiny"),
        process=Process(drawing.levels, spreads={"common_cd_bias_m": Normal(0.2e-6)}),
        wafer=Wafer(compensate=True),
    )
    assert read_manifest(order).edge_moves() == (-200,) * 4
    wanted = read_bank(copy_of_run / "psf" / "quantised.exr").energy
    for masks, foreseen in ((("--masks", order), True), ((), False)):
        done = cli("psf", copy_of_run, "--fabricated", "--process", biased, *masks)
        assert done.code == 0, done.err
        off = np.abs(energies(copy_of_run) - wanted).max() / wanted.max()
        # In float32 two lengths of 0.2 um cancel to 1e-14 m or so; unforeseen, a fifth of a pixel moves much light.
        assert (off < 1e-4) == foreseen
