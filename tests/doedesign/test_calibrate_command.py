"""`doedesign calibrate` from the command line to its files, on a plate of 64 x 64 cells with four levels."""

import json
from pathlib import Path

import numpy as np
import pytest

from doedesign.build import process_from_spec
from doedesign.reference.other_numbers import OTHER_GROUPS
from doedesign.runs.folder import open_run
from doedesign.runs.level_maps import open_design
from doedesign.spec import load_process, load_variation
from fab.files import sha256_file
from tests.doedesign.calibration_fakes import light_of, photograph, usual_process
from tests.doedesign.small_runs import call, finished_run

SPEC = """
name = "small"

[optics]
focal_length = "0.4 mm"
wavelengths = ["550 nm"]
design_wavelength = "550 nm"

[doe]
samples = 64
pitch = "1.85 um"
aperture = "118.4 um"
material = "fused_silica"

[process]
levels = 4
level_step = "300 nm"

[process.errors]
overlay_x = "0.5 um"
overlay_y = "0.5 um"
common_depth_scale = 0.03
common_cd_bias = "0.15 um"
roughness = { mean = "2 nm", sigma = "0.5 nm" }

[scene]
near = ["3 mm"]
far = ["inf"]

[sensor]
pitch = "1.85 um"
resolution = [640, 480]
window = 40

[optimize]
start = "random"
steps = 0

[[objective]]
name = "far_spot"
"""
HIDDEN = {"common_depth_scale": 0.02, "overlay_y_m[1]": 0.4e-6, "overlay_x_m[1]": -0.6e-6, "common_cd_bias_m": 0.1e-6}
LIMITS = {"common_depth_scale": 0.005, "overlay_y_m": 0.1e-6, "overlay_x_m": 0.1e-6, "common_cd_bias_m": 0.05e-6}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small")
    finished_run(folder, SPEC)
    design = open_design(open_run(folder / "run"))
    depths = (3e-3, np.inf)
    photograph(folder, light_of(design, usual_process(design), HIDDEN, depths), depths, electrons=1e7)
    return folder / "run"


@pytest.fixture(scope="module")
def fitted(run: Path) -> tuple[int, str, str]:
    return call("calibrate", run, run.parent / "measurement.toml", "--json")


def test_the_files_say_what_was_found(run: Path, fitted: tuple[int, str, str]):
    code, out, said = fitted
    assert code == 0, said
    answer = json.loads(out)
    folder = run / "calibration"
    assert answer["paths"] == [str(folder), *map(str, sorted(folder.iterdir()))]
    assert {path.name for path in folder.iterdir()} == {
        *("calibration.json", "check.png", "errors.png", "manifest.json", "plate.toml", "process-estimate.toml"),
        "psfs.png",
    }
    record = json.loads((folder / "calibration.json").read_text())
    assert answer["explained"] == record["explained"]
    for error in record["errors"]:
        key = error["name"].partition("[")[0]
        assert abs(error["value"] - HIDDEN[error["name"]]) < LIMITS[key], error["name"]
        assert error["determined"]
    assert set(record["measurement_sha256"]) == {path.name for path in run.parent.iterdir() if path.is_file()} - {
        "small.toml"
    }
    assert [image["name"] for image in record["images"]] == ["near0", "far1"]
    assert "overlay x, mask 2" in said
    manifest = json.loads((folder / "manifest.json").read_text())
    for name, digest in manifest["results_sha256"].items():
        assert sha256_file(folder / name) == digest
    tables = {name: record.pop(name) for name in ("errors", "camera", "images", "readings")}
    names = {*record, *(name for rows in tables.values() for row in rows for name in row)}
    defined = next(group.numbers for group in OTHER_GROUPS if group.title == "Calibrations")
    assert names - {"run", "measurement_sha256"} == set(defined)


@pytest.mark.study
def test_the_estimate_is_a_process_like_any_other(run: Path, fitted: tuple[int, str, str]):
    folder = run / "calibration"
    record = json.loads((folder / "calibration.json").read_text())
    text = (folder / "process-estimate.toml").read_text()
    for name, digest in record["measurement_sha256"].items():
        assert f"# {name}: sha256 {digest}" in text
    process = process_from_spec(load_process(folder / "process-estimate.toml"))
    for error in record["errors"]:
        spread = process.spreads[error["name"]]
        assert (spread.mean, spread.sigma) == (error["value"], error["sigma"])
    assert process.spreads["overlay_x_m[0]"] == (0.0, 0.0) if "overlay_x_m[0]" in process.spreads else True
    assert process.spreads["roughness_m"].mean == 2e-9  # what was not looked for stays what was believed
    plate = load_variation(folder / "plate.toml")
    assert plate.value("overlay_x_m[1]") == process.spreads["overlay_x_m[1]"].mean
    # And other commands take it.
    code, out, said = call("psf", run, "--fabricated", "--process", folder / "process-estimate.toml", "--json")
    assert code == 0, said
    assert json.loads(out)["paths"]


@pytest.mark.slow
def test_the_same_measurement_gives_the_same_bytes(run: Path, fitted: tuple[int, str, str], tmp_path: Path):
    code, out, said = call("calibrate", run, run.parent / "measurement.toml", "--out", tmp_path / "again")
    assert code == 0, said
    assert out.splitlines()[0] == str(tmp_path / "again")
    for path in (run / "calibration").iterdir():
        if path.name != "manifest.json":  # which names the folder's kind
            assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes(), path.name


@pytest.mark.slow
def test_two_numbers_give_a_family(run: Path):
    numbers = ("--ring-to-disc", 2.0, "--throughput", 0.5, "--probe", "520 nm", "--depth", "3 mm")
    code, out, said = call("calibrate", run, *numbers, "--errors", "overlay_x", "--errors", "depth", "--reach", 2)
    assert code == 0, said
    folder = run / "explanations"
    assert out.splitlines() == [str(folder), *map(str, sorted(folder.iterdir()))]
    assert {path.name for path in folder.iterdir()} == {
        *("explanations.json", "explanations.png", "explanations.txt", "manifest.json")
    }
    record = json.loads((folder / "explanations.json").read_text())
    assert record["targets"]["ring_to_disc"] == 2.0
    assert set(record["curves"]) == {
        *("common_depth_scale", "depth_scale[0]", "depth_scale[1]", "overlay_x_m[0]", "overlay_x_m[1]")
    }
    text = (folder / "explanations.txt").read_text()
    assert "measured: ring:disc 2, throughput 50 %" in text
    assert "a published one may be another" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "must be given a measurement or a ring:disc ratio, but got neither"),
        (("{toml}", "--ring-to-disc", 1), "but got both"),
        (("--ring-to-disc", 1, "--depth", "3 mm"), "--probe: must be given with --ring-to-disc"),
        (("--ring-to-disc", 1, "--probe", "520 nm"), "--depth: must be given with --ring-to-disc"),
        (("--ring-to-disc", 1, "--probe", "520", "--depth", "3 mm"), "--probe: must be a length with a unit"),
        (("--ring-to-disc", 1, "--probe", "520 nm", "--depth", "0 mm"), "--depth: must be positive"),
        (("--ring-to-disc", 1, "--probe", "520 nm", "--depth", "3 mm", "--throughput", 86), "--throughput: must be"),
        (("--ring-to-disc", -1, "--probe", "520 nm", "--depth", "3 mm"), "--ring-to-disc: must be positive"),
        (("{folder}/nothing.toml",), "nothing.toml: the file must exist"),
        (("{toml}", "--errors", "weather"), "--errors: must be an error that a plate has in a definite way"),
        (("{toml}", "--process", "{toml}"), "measurement.toml: process: must be given"),
    ],
)
def test_mistakes_end_with_two_and_say_what(run: Path, arguments: tuple[object, ...], message: str):
    places = {"toml": run.parent / "measurement.toml", "folder": run.parent}
    code, out, said = call("calibrate", run, *(str(a).format(**places) for a in arguments))
    assert code == 2
    assert not out
    assert message in said
    assert "Traceback" not in said


def test_other_peoples_files_are_not_replaced(run: Path, tmp_path: Path):
    (tmp_path / "mine.txt").write_text("keep")
    code, _, said = call("calibrate", run, run.parent / "measurement.toml", "--out", tmp_path)
    assert code == 2
    assert "must be empty or an earlier result" in said
    assert (tmp_path / "mine.txt").read_text() == "keep"


def test_a_missing_image_is_named(run: Path, tmp_path: Path):
    text = (run.parent / "measurement.toml").read_text()
    (tmp_path / "measurement.toml").write_text(text)
    code, _, said = call("calibrate", run, tmp_path / "measurement.toml")
    assert code == 2
    assert "image0_1s.tiff: the file must exist" in said
    assert not any(path.name.startswith(".") for path in run.iterdir())
