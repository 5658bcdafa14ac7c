"""Every command works on the quick example as a new user types it, and calibration finds what was hidden."""

import json
import re
import sys
from pathlib import Path

import pytest

from doedesign.calibration.measurement import ImageSpec, MeasurementSpec, load_measurement
from doedesign.cli import app
from doedesign.reference.files import described, folder_of
from doedesign.spec import load_spec, load_variation

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import every_command  # pyright: ignore[reportMissingImports]
import measure_psfs  # pyright: ignore[reportMissingImports]

QUICK = Path(__file__).parents[2] / "examples" / "quick.toml"
NAMES = {name for name in app if not name.startswith("-")}


def test_the_script_leaves_no_command_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    item = tmp_path / "runs" / "quick" / "simulated" / "0000_camera"
    item.mkdir(parents=True)
    for name in ("capture", "clean", "mask"):
        (item / f"{name}.exr").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(every_command, "measure", lambda run, out: out / "measurement.toml")
    assert len(NAMES) == 21
    assert {command[0] for command in every_command.commands(QUICK, "quick")} == NAMES
    assert len(list((tmp_path / "pairs").iterdir())) == 3


def test_the_commented_measurement_is_of_the_quick_example():
    spec, design = load_measurement(measure_psfs.MEASUREMENT), load_spec(QUICK)
    assert {image.depth_m for image in spec.image} <= {*design.scene.near_m, *design.scene.far_m}
    assert spec.pixel_m == design.sensor.pixel_m


def test_every_key_of_the_commented_measurement_may_be_written(tmp_path: Path):
    text, count = re.subn(r"(?m)^# (\w+ = |\[camera\])", r"\1", measure_psfs.MEASUREMENT.read_text())
    (tmp_path / "all.toml").write_text(text)
    spec = load_measurement(tmp_path / "all.toml")
    assert count == 20
    # What is left out of the file are a lab's rare needs.
    assert MeasurementSpec.model_fields.keys() - spec.model_fields_set == {"fill_factor", "allow_8bit"}
    assert ImageSpec.model_fields.keys() - spec.image[0].model_fields_set == {"black_level"}


def undescribed(folder: Path) -> list[str]:
    """Files of a folder in which every command ran that the reference of files does not have."""
    missing = []
    for path in (path for path in folder.rglob("*") if path.is_file()):
        place = path.relative_to(folder)
        if place.parts[0] in ("pairs", "measurement"):  # given to commands
            continue
        homes = [place.parents[i] for i in range(len(place.parents) - 1)]
        entries = [(folder_of(str(home)), str(place.relative_to(home))) for home in homes]
        if not any(entry is not None and described(entry, name) for entry, name in entries):
            missing.append(str(place))
    return missing


@pytest.mark.study
def test_every_command_runs_with_its_defaults(tmp_path: Path):
    assert set(every_command.every_command(tmp_path)) == NAMES
    run = tmp_path / "runs" / "quick"
    found = json.loads((run / "calibration" / "calibration.json").read_text())
    assert found["explained"]
    hidden = load_variation(tmp_path / "measurement" / "hidden.toml")
    assert {error["name"].partition("[")[0] for error in found["errors"]} == set(measure_psfs.HIDDEN)
    for error in found["errors"]:
        # Found: 22 nm and 0.13 %, some standard deviations, which know of noise alone; the prior has 500 nm and 2 %.
        limit = 40e-9 if error["name"].partition("[")[0].endswith("_m") else 0.003
        assert error["value"] == pytest.approx(hidden.value(error["name"]), abs=limit)
    assert (run.with_name("quick_v2") / "precompensation.csv").is_file()
    assert (run / "trained" / "network.npz").is_file()
    assert (run / "tolerance" / "results.json").is_file()
    assert (run / "finetuned" / "network.npz").is_file()
    assert len(list((tmp_path / "reconstructed").iterdir())) == 2
    assert undescribed(tmp_path) == []
