"""From a spec to a wafer order and the light behind it: the commands as a user types them."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from doedesign.runs.level_maps import drawn_in_masks
from fab.errors import InputError
from fab.files import sha256_file
from fab.level_map import read_level_map
from fab.levels import Levels, height_of
from sim.store import read_bank, read_height
from tests.orders import GDS_TOO, named

MASKS = {"M1_75NM.gds", "M2_150NM.gds", "M3_300NM.gds", "M4_600NM.gds", "CHROME.gds"}


def test_stdout_holds_paths_and_stderr_the_talk(finished):
    said = finished.said
    assert said["optimize"].out == f"{finished.run}\n"
    assert said["verify"].out == ""
    paths = [Path(line) for line in said["masks"].out.splitlines()]
    assert paths[0] == finished.order
    assert paths[1:] == sorted(finished.order.iterdir())
    assert all(done.err for done in said.values())
    assert "Traceback" not in "".join(done.err for done in said.values())


@pytest.mark.slow
def test_json_lists_the_paths(finished, cli):
    told = json.loads(finished.said["psf"].out)
    assert [Path(path) for path in told["paths"][1:]] == sorted((finished.run / "psf").iterdir())
    done = cli("verify", finished.order, "--json")
    told = json.loads(done.out)
    assert told["passed"] is True
    assert len(told["checks"]) > len(MASKS)
    assert all(check["problems"] == [] for check in told["checks"])


def test_the_run_folder_holds_what_its_manifest_lists(finished):
    manifest = json.loads((finished.run / "manifest.json").read_text())
    assert manifest["state"] == "done"
    assert manifest["name"] == "tiny"
    # What commands cost is no result.
    found = {path.name for path in finished.run.iterdir()} - {"manifest.json", "psf", "cost.jsonl"}
    assert set(manifest["results_sha256"]) == found
    expected = {
        "level_map.npz",
        "height.exr",
        "height_continuous.exr",
        "history.jsonl",
        "metrics.json",
        "spec.toml",
        "height.png",
    }
    pictures = {"psf.png", "mtf.png", "mtf.csv", "encircled.png", "encircled.csv", "history.png"}
    assert expected | pictures == found
    for name, digest in manifest["results_sha256"].items():
        assert sha256_file(finished.run / name) == digest, name


def test_the_order_holds_what_its_manifest_lists(finished):
    manifest = json.loads((finished.order / "manifest.json").read_text())
    listed = {entry["file"]: entry for entry in manifest["files"]}
    assert {path.name for path in finished.order.iterdir()} == {*listed, "manifest.json"}
    assert {name.split("_", 4)[-1] for name in listed} >= MASKS | {"ALL.gds", "ALL.oas", "PREVIEW.png"}
    for name, entry in listed.items():
        assert sha256_file(finished.order / name) == entry["sha256"]
        assert (finished.order / name).stat().st_size == entry["bytes"]
    source = manifest["source"]
    assert source == {
        "kind": "run",
        "name": "tiny",
        "level_map_sha256": read_level_map(finished.run / "level_map.npz").digest,
    }


def test_the_psf_folder_holds_what_its_manifest_lists(finished):
    folder = finished.run / "psf"
    manifest = json.loads((folder / "manifest.json").read_text())
    assert {path.name for path in folder.iterdir()} == {*manifest["results_sha256"], "manifest.json"}
    for name, digest in manifest["results_sha256"].items():
        assert sha256_file(folder / name) == digest, name
    metrics = json.loads((folder / "metrics.json").read_text())
    assert set(metrics) == {"continuous", "quantised", "from_masks", "lens", "light"}
    assert metrics["lens"] == "places follow the sine of the angle"
    assert metrics["light"] == "scalar"


def test_what_is_drawn_is_what_was_optimised(finished):
    height = read_height(finished.run / "height.exr").height_m
    level = np.load(named(finished.order, "LEVELS.npy"))
    drawn = height_of(level, Levels(16, 75e-9)).astype(np.float32)
    y, x = np.indices(height.shape) - 31.5
    inside = y**2 + x**2 <= 32**2
    assert np.array_equal(drawn[inside], height[inside])
    assert (level[~inside] == 15).all()


def test_the_masks_make_the_light_of_the_quantised_design(finished):
    banks = {name: finished.run / "psf" / f"{name}.exr" for name in ("continuous", "quantised", "from_masks")}
    assert banks["quantised"].read_bytes() == banks["from_masks"].read_bytes()
    continuous, quantised = (read_bank(banks[name]) for name in ("continuous", "quantised"))
    assert continuous.depths_m == quantised.depths_m == (0.006, 0.6)
    assert continuous.energy.shape == (1, 2, 48, 48)
    assert not np.array_equal(continuous.energy, quantised.energy)
    # Light that misses the window is reported, never made up for.
    assert (quantised.energy.sum(axis=(2, 3)) < 1).all()


def test_history_has_a_line_per_step(finished):
    records = [json.loads(line) for line in (finished.run / "history.jsonl").read_text().splitlines()]
    assert [record["step"] for record in records] == list(range(6))
    assert records[0]["names"] == ["far_spot", "near_spread"]
    assert records[0]["loss"] == pytest.approx(records[0]["terms"][0] + 2 * records[0]["terms"][1])


def test_a_finished_run_is_found_again_at_once(finished, tiny, cli, content):
    before = content(finished.run)
    times = {path: path.stat().st_mtime_ns for path in finished.run.rglob("*")}
    done = cli("optimize", tiny, "--out", finished.run)
    assert done.code == 0
    assert done.out == f"{finished.run}\n"
    assert "already holds the finished run" in done.err
    assert content(finished.run) == before
    assert {path: path.stat().st_mtime_ns for path in finished.run.rglob("*")} == times


@pytest.mark.slow
def test_two_runs_of_a_spec_have_the_same_bytes(finished, tiny, cli, content, tmp_path):
    assert cli("optimize", tiny, "--out", tmp_path / "run").code == 0
    assert cli("masks", tmp_path / "run", "--out", tmp_path / "order", *GDS_TOO).code == 0
    assert cli("psf", tmp_path / "run", "--masks", tmp_path / "order").code == 0
    assert content(tmp_path / "run") == content(finished.run)
    assert content(tmp_path / "order") == content(finished.order)


@pytest.mark.slow
def test_masks_and_psf_replace_their_earlier_results(copied, cli, content):
    before = content(copied.run), content(copied.order)
    assert cli("masks", copied.run, "--out", f"{copied.order}/", *GDS_TOO).code == 0
    assert cli("psf", copied.run, "--masks", copied.order).code == 0
    assert (content(copied.run), content(copied.order)) == before


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.slow
def test_folders_are_called_after_the_design(tiny, cli, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = "--set=name=plate_1.2-b"
    assert cli("optimize", tiny, "--set", "optimize.steps=0", name).out == "runs/plate_1.2-b\n"
    assert cli("masks", "runs/plate_1.2-b").out.splitlines()[0] == "masks/plate_1.2-b"
    assert named(tmp_path / "masks/plate_1.2-b", "ALL.oas").name.startswith("PLATE_1_2_A_1P85_")
    done = cli("psf", "runs/plate_1.2-b")
    assert "runs/plate_1.2-b/psf/from_masks.exr" in done.out.splitlines()


@pytest.mark.usefixtures("without_pictures")
def test_without_masks_psf_says_how_to_draw_them(copied, cli, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = cli("psf", copied.run)
    assert done.code == 0
    assert f"doedesign masks {copied.run}" in done.err
    assert not (copied.run / "psf" / "from_masks.exr").exists()


@pytest.mark.usefixtures("without_pictures")
def test_psf_of_other_depths_and_fields(copied, cli):
    depths = ("--depths", "8 mm", "--depths", "inf", "--depths", "8 mm")
    done = cli("psf", copied.run, "--masks", copied.order, *depths, "--field-deg", "1", "-2")
    assert done.code == 0, done.err
    bank = read_bank(copied.run / "psf" / "quantised.exr")
    assert bank.depths_m == (0.008, float("inf"))
    assert bank.field_rad == pytest.approx((np.radians(1), np.radians(-2)))
    assert (copied.run / "psf" / "from_masks.exr").read_bytes() == (copied.run / "psf" / "quantised.exr").read_bytes()
    # The 0th order and the band are known on the axis.
    told = json.loads((copied.run / "psf" / "metrics.json").read_text())["quantised"]
    assert all("throughput" in row for row in told)
    assert not any({"zeroth_order", "budget"} & set(row) for row in told)


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("depth", ["1 mm", "inf"])
def test_psf_of_one_side_of_the_scene(copied, cli, depth):
    assert cli("psf", copied.run, "--masks", copied.order, "--depths", depth).code == 0
    assert len(read_bank(copied.run / "psf" / "quantised.exr").depths_m) == 1


@pytest.mark.slow
def test_fewer_levels_come_from_the_continuous_design(finished, cli, tmp_path):
    done = cli("masks", finished.run, "--levels", 4, "--out", tmp_path / "order")
    assert done.code == 0
    manifest = json.loads((tmp_path / "order" / "manifest.json").read_text())
    assert (manifest["levels"], manifest["step_nm"]) == (4, 300)
    own = read_level_map(finished.run / "level_map.npz")
    assert manifest["source"]["level_map_sha256"] == own.digest
    level = np.load(named(tmp_path / "order", "LEVELS.npy"))
    continuous = read_height(finished.run / "height_continuous.exr").height_m
    y, x = np.indices(level.shape) - 31.5
    inside = y**2 + x**2 <= 32**2
    # Heights repeat with the full staircase, so the distance to the drawn one is at most half a step either way round.
    off = (continuous.astype(np.float64) - level * 300e-9 + 600e-9) % 1200e-9 - 600e-9
    assert np.abs(off[inside]).max() <= 150e-9 * (1 + 1e-6)
    # What it costs is said: how alike designed and drawn waves are at 550 nm, where fused silica has n = 1.45991.
    waves = (own.height_m.astype(np.float64) - level * 300e-9)[inside] * 0.45991 / 550e-9
    kept = abs(np.exp(2j * np.pi * waves).mean()) ** 2
    assert manifest["source"]["rounded"] == {"designed_levels": 16, "efficiency": pytest.approx(kept, abs=1e-4)}
    assert f"designed with 16 levels and drawn with 4: {100 * (1 - kept):.2g} % of its light" in done.err
    assert "as rounded to 4 levels, not as designed with 16" in done.err
    assert "as designed" in finished.said["masks"].err


def test_masks_of_an_earlier_run_are_not_taken_for_those_of_this_one(finished):
    own = read_level_map(finished.run / "level_map.npz")
    with pytest.raises(InputError, match="must be those of this run, but got those of another"):
        drawn_in_masks(finished.order, own.with_level(np.roll(own.level, 1, axis=0)))


@pytest.mark.slow
def test_paths_may_lead_through_links_and_upwards(finished, cli, tmp_path, monkeypatch):
    (tmp_path / "link").symlink_to(finished.order)
    (tmp_path / "deep").mkdir()
    monkeypatch.chdir(tmp_path / "deep")
    assert cli("verify", "../link/").code == 0
    assert cli("masks", os.path.relpath(finished.run), "--out", "../new/./order").code == 0
    assert cli("verify", tmp_path / "new" / "order").code == 0


@pytest.mark.slow
def test_an_order_can_be_sent_away(finished, tmp_path, start_process):
    # Only the folder is needed: another place, another process, no run, no spec.
    shutil.copytree(finished.order, tmp_path / "Auftrag für das Labor")
    process: subprocess.Popen[str] = start_process("verify", tmp_path / "Auftrag für das Labor")
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (0, "")
    assert "checks passed" in err
