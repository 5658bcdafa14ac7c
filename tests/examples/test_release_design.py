"""Designs that are given away: the script that makes their folders, and the folders as they are released."""

import json
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import doedesign.optimization
from doedesign.cli import main
from doedesign.runs.folder import open_run
from doedesign.runs.level_maps import open_design
from fab.files import sha256_file
from sim.metrics import metric_rows
from sim.optic import HeightOptic
from sim.psf_bank import psf
from tests.doedesign.small_runs import SPEC
from tests.pictures import leave_out_pictures

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import release_design  # pyright: ignore[reportMissingImports]

MASKS = Path(__file__).parents[2] / "masks"
RELEASED = {
    "automotive-2400": "examples/automotive.toml",
    "automotive-robust-2400": "examples/automotive.toml",
    "dslr-2800": "examples/dslr.toml",
}
MOST_BYTES = 4_100_000  # of a folder: four bits for each of 2800 x 2800 cells, and little besides

released = pytest.mark.parametrize("name", RELEASED)
here = pytest.mark.skipif(not MASKS.is_dir(), reason="a bare installation has no released designs")


def contents(folder: Path) -> dict[str, str]:
    """Digests of the files of a folder, by name."""
    return {path.name: sha256_file(path) for path in folder.iterdir() if path.name != "manifest.json"}


@here
@released
def test_a_released_design_is_what_its_manifest_says(name: str):
    folder = MASKS / name
    manifest = json.loads((folder / "manifest.json").read_text())
    assert contents(folder) == manifest["results_sha256"]
    design = open_design(folder, False)
    assert design.level_map.level.shape == (int(name.rpartition("-")[2]),) * 2
    told = (folder / "README.md").read_text()
    assert design.level_map.digest[:16] in told
    assert f"doedesign optimize {RELEASED[name]} --out runs/{name}" in told
    assert sum(path.stat().st_size for path in folder.iterdir()) < MOST_BYTES
    tolerance = json.loads((folder / "tolerance.json").read_text())
    assert tolerance["process"] == "contact_aligner"
    assert 0 <= tolerance["plates"]["yield"]["share"] <= 1
    command = told.partition("    doedesign ")[2].partition("    python ")[0].replace("\\\n", "")
    asked = shlex.split(command)
    assert [asked[place + 1] for place, word in enumerate(asked) if word == "--set"] == manifest["overrides"]


@here
@pytest.mark.slow
@released
def test_stored_metrics_of_a_released_design_come_out_again(name: str):
    """Of the green light at the nearest depth and from the farther scene."""
    design = open_design(MASKS / name, False)
    green = replace(design.camera, colours=design.camera.colours[1:2])
    depths = (design.near_m[0], design.far_m[-1])
    optic = HeightOptic.of(green, design.height_m)
    bank, lens = (psf(each, depths=depths) for each in (optic, HeightOptic.of(green)))
    found = metric_rows(bank.metric_inputs(design.near_m, optic, lens=lens), "design")
    stored = json.loads((MASKS / name / "metrics.json").read_text())["psf"]
    for row in found:
        kept = next(one for one in stored if (one["colour"], one["depth_m"]) == (row["colour"], row["depth_m"]))
        # Single precision on another processor. The bound is left out: its spot is the best of both far depths.
        numbers = {
            key: value for key, value in row.items() if isinstance(value, float) and key != "concentration_bound"
        }
        assert numbers == pytest.approx({key: kept[key] for key in numbers}, rel=1e-4)


@pytest.mark.slow
def test_a_run_is_made_small_and_stays_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "small.toml").write_text(SPEC.replace("strehl", "far_spot").replace("min = 0.9", "min = 0.1"))
    leave_out_pictures(monkeypatch, doedesign.optimization)
    assert main(["optimize", str(tmp_path / "small.toml"), "--out", str(tmp_path / "run")]) == 0
    out = tmp_path / "small-48"
    release_design.release(tmp_path / "run", out, "small.toml", 4, workers=1)
    manifest = json.loads((out / "manifest.json").read_text())
    assert contents(out) == manifest["results_sha256"]
    again = open_design(open_run(out), False)
    assert again.level_map.digest == open_design(tmp_path / "run", False).level_map.digest
    told = (out / "README.md").read_text()
    assert "4 predicted plates" in told
    assert "| sharp spot at infinity | " in told
    assert "| 0th order | " in told
    assert main(["psf", str(out)]) == 0
    assert (out / "psf").is_dir()
