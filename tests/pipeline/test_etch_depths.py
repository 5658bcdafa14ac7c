"""Etches that are not 2^k steps deep, from the spec to the plate: `[process] etch_depths`."""

import json

import numpy as np
import pytest

import doedesign.optimization
from doedesign.runs.folder import open_run
from doedesign.runs.level_maps import level_map_of_run, open_design
from fab.layout.geometry import pixel_edges
from fab.levels import Levels, height_of
from fab.manifest.records import read_manifest
from fab.verification.files import read_drawn_levels
from sim.store import read_bank, read_height

pytestmark = pytest.mark.usefixtures("without_pictures")

FOUR = ("--set", "process.levels=4", "--set", "process.level_step=300 nm")
CHOSEN = (*FOUR, "--set", "process.etch_depths=optimize", "--set", "optimize.steps=20")
ERRORS = """
[process]
levels = 4
level_step = "300 nm"
etch_depths = "optimize"

[process.errors]
depth_scale = 0.01
overlay_x = "0.2 um"
"""


@pytest.fixture(scope="module")
def chosen(tiny, cli, tmp_path_factory):
    """A run that chose its depths, and its order. Not to be changed."""
    folder = tmp_path_factory.mktemp("chosen")
    run, order = folder / "run", folder / "order"
    for arguments in (("optimize", tiny, "--out", run, *CHOSEN), ("masks", run, "--out", order), ("verify", order)):
        done = cli(*arguments)
        assert done.code == 0, done.err
    return run, order


def levels_in(run) -> Levels:
    return Levels(4, 300e-9, tuple(json.loads((run / "manifest.json").read_text())["etch_depths_m"]))


def test_the_order_is_made_of_the_depths_that_the_run_chose(chosen):
    run, order = chosen
    levels = levels_in(run)
    assert not levels.is_binary
    assert all(abs(depth * 1e10 - round(depth * 1e10)) < 1e-6 for depth in levels.depths_m)
    manifest = read_manifest(order)
    assert manifest.staircase() == levels
    assert tuple(mask.depth_nm for mask in manifest.masks) == pytest.approx([d * 1e9 for d in levels.depths_m], 1e-9)
    # From the file alone: the planes and the depths of the manifest are the heights of the run, where light passes.
    rebuilt = read_drawn_levels(
        manifest.drawn_files(order), levels, pixel_edges(manifest.grid()), manifest.doe_cell, manifest.edge_moves()
    )
    stored = read_height(run / "height.exr")
    inside = manifest.relief.inside(manifest.grid())
    heights = height_of(rebuilt, manifest.staircase()).astype(np.float32)
    assert np.array_equal(heights[inside], stored.height_m[inside])
    sheet = json.loads(next(order.glob("*_RUNSHEET.json")).read_text())
    assert [step["etch"]["target_nm"] for step in sheet["steps"] if step.get("etch")] == pytest.approx(
        sorted(d * 1e9 for d in levels.depths_m)
    )
    assert sheet["staircase_nm"][-1] == pytest.approx(levels.total_m * 1e9, abs=1e-6)


def test_a_finished_run_is_opened_with_the_depths_it_chose(chosen):
    run, order = chosen
    opened, levels = open_run(run), levels_in(run)
    assert opened.spec.process.etch_depths_m == levels.depths_m
    assert level_map_of_run(opened).levels == open_design(opened, order).levels == levels
    assert 'etch_depths = "optimize"' in (run / "spec.toml").read_text()
    # Another number of levels over the same wave is even again.
    assert level_map_of_run(opened, 8).levels == Levels(8, 150e-9)


@pytest.mark.slow
def test_light_and_tolerances_are_those_of_the_chosen_depths(chosen, cli, tmp_path):
    import shutil

    run, order = shutil.copytree(chosen[0], tmp_path / "run"), chosen[1]
    process = tmp_path / "process.toml"
    process.write_text(ERRORS)
    for arguments in (
        ("psf", run, "--masks", order),
        ("psf", run, "--masks", order, "--fabricated"),
        ("tolerance", run, "--masks", order, "--process", process, "--draws", 4, "--workers", 1),
    ):
        done = cli(*arguments)
        assert done.code == 0, done.err
    nominal = read_bank(run / "fabricated" / "fabricated.exr").energy
    # An ideal process: the plate as drawn, by the same arithmetic on the same heights.
    assert np.array_equal(nominal, read_bank(run / "psf" / "quantised.exr").energy)
    assert np.array_equal(nominal, read_bank(run / "psf" / "from_masks.exr").energy)


def test_a_stopped_run_chooses_the_same(tiny, cli, chosen, content, tmp_path, monkeypatch):
    run = tmp_path / "run"
    save, stops = doedesign.optimization.save_checkpoint, iter([10])

    def save_and_stop(a_run, arrays, step, history):
        save(a_run, arrays, step, history)
        if step == next(stops, None):
            raise KeyboardInterrupt

    monkeypatch.setattr(doedesign.optimization, "save_checkpoint", save_and_stop)
    every = ("--set", "optimize.checkpoint_every=10")
    assert cli("optimize", tiny, "--out", run, *CHOSEN, *every).code == 130
    done = cli("optimize", tiny, "--out", run, *CHOSEN, *every)
    assert done.code == 0
    assert "resuming after step 10" in done.err
    for name in ("height.exr", "height_continuous.exr", "history.jsonl"):
        assert (run / name).read_bytes() == (chosen[0] / name).read_bytes()
    assert levels_in(run) == levels_in(chosen[0])


@pytest.mark.slow
def test_given_depths_go_all_the_way(tiny, cli, tmp_path):
    run, order = tmp_path / "run", tmp_path / "order"
    given = ("--set", 'process.etch_depths=["520 nm", "260 nm"]')
    assert cli("optimize", tiny, "--out", run, *FOUR, *given).code == 0
    done = cli("masks", run, "--out", order)
    assert done.code == 0, done.err
    assert read_manifest(order).staircase() == Levels(4, 300e-9, (520e-9, 260e-9))
    # The shallow etch is the first one, and the marks are its.
    assert [plate.bit for plate in read_manifest(order).plates if plate.bit is not None] == [1, 0]
    done = cli("psf", run, "--masks", order, "--fabricated")
    assert done.code == 0, done.err


def test_a_manifest_that_was_edited_is_noticed(tiny, cli, chosen, tmp_path):
    import shutil

    run = shutil.copytree(chosen[0], tmp_path / "run")
    path = run / "manifest.json"
    manifest = json.loads(path.read_text())
    first, second = manifest["etch_depths_m"]
    for depths, message in (
        ([first + 2e-9, second], "must be for 4 levels by etches of"),
        ([first], "4 levels must have 2 etches"),
        (None, 'must be a list of depths or "optimize"'),
    ):
        path.write_text(json.dumps({**manifest, "etch_depths_m": depths}))
        done = cli("masks", run, "--out", tmp_path / "order")
        assert done.code == 2
        assert message in done.err


@pytest.mark.slow
def test_a_bare_map_takes_depths_from_the_command_line(cli, tmp_path):
    levels = Levels(4, 300e-9, (250e-9, 600e-9))
    level_map = np.random.default_rng(5).integers(0, 4, (24, 24)).astype(np.uint8)
    np.save(tmp_path / "map.npy", height_of(level_map, levels))
    geometry = ("--levels", 4, "--step", "300 nm", "--pitch", "2 um")
    bare = ("masks", tmp_path / "map.npy", *geometry, "--out", tmp_path / "o")
    done = cli(*bare, "--etch-depths", "250 nm, 600 nm")
    assert done.code == 0, done.err
    manifest = read_manifest(tmp_path / "o")
    assert manifest.staircase() == levels
    inside = manifest.relief.inside(manifest.grid())
    assert np.array_equal(np.load(tmp_path / "o" / manifest.level_map_file)[inside], level_map[inside])
    for depths, message in (("250 nm", "2 etches"), ("250, 600 nm", "a length with a unit"), ("250 nm,,", "2 etches")):
        done = cli(*bare, "--etch-depths", depths)
        assert done.code == 2
        assert message in done.err


def test_a_run_brings_its_own_depths(cli, chosen):
    done = cli("masks", chosen[0], "--etch-depths", "250 nm,600 nm")
    assert done.code == 2
    assert "--etch-depths: a run brings its own geometry" in done.err
