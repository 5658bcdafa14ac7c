"""Every example loads; the small ones run, and the narrated one goes from the spec to the light and back."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import doedesign.optimization
import doedesign.runs.psfs
from doedesign.cli import main
from doedesign.runs.level_maps import open_design
from doedesign.spec import load_spec, spec_warnings
from fab.errors import CheckFailed
from tests.pictures import leave_out_pictures

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parents[2] / "examples"
SMALL = ("doe.samples=64", "sensor.window=48", "optimize.steps=3")


def overrides(*changes: str) -> list[str]:
    return [part for change in changes for part in ("--set", change)]


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_spec_loads_without_a_warning(path: Path):
    spec = load_spec(path)
    assert spec.name == path.stem
    assert spec_warnings(spec) == []


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        # As it is, it runs with the documentation.
        pytest.param(
            "quick",
            ["doe.aperture=0.1184 mm", 'scene.near=["6 mm"]', 'scene.far=["inf"]'],
            marks=pytest.mark.study,
        ),
        ("beam_splitter", ["doe.aperture=0.128 mm", "objective.0.options.spacing=30 um"]),
    ],
)
def test_small_specs_run(name: str, changes: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run, order = tmp_path / "run", tmp_path / "order"
    spec = EXAMPLES / f"{name}.toml"
    assert main(["optimize", str(spec), "--out", str(run), *overrides(*SMALL, *changes)]) == 0
    assert main(["masks", str(run), "--out", str(order)]) == 0
    capsys.readouterr()
    assert main(["psf", str(run), "--masks", str(order)]) == 0
    printed = set(capsys.readouterr().out.splitlines())
    assert {str(run / "psf" / f"{bank}.exr") for bank in ("continuous", "quantised", "from_masks")} < printed
    metrics = json.loads((run / "metrics.json").read_text())
    assert ("patterns" in metrics) == (name != "quick")
    assert (run / "pattern.png").exists() == (name != "quick")
    for row in metrics["psf"]:
        assert 0 < row["throughput"] < 1
        assert np.isfinite([value for value in row.values() if isinstance(value, float)]).all()


@pytest.fixture(scope="module")
def demo() -> ModuleType:
    found = importlib.util.spec_from_file_location("examples_demo", EXAMPLES / "demo.py")
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A spec whose file is not called after the design."""
    text = (EXAMPLES / "quick.toml").read_text()
    for old, new in (
        ("samples = 320", "samples = 64"),
        ('aperture = "0.592 mm"', 'aperture = "0.1184 mm"'),
        ("window = 128", "window = 48"),
        ("steps = 120", "steps = 3"),
        ('["6 mm", "10 mm", "15 mm"]', '["6 mm"]'),
        ('["0.6 m", "1.2 m"]', '["inf"]'),
    ):
        assert old in text
        text = text.replace(old, new)
    path = tmp_path_factory.mktemp("spec") / "first try.toml"
    path.write_text(text)
    return path


def leave_out_report(patch: pytest.MonkeyPatch, demo: ModuleType) -> None:
    """The page of a run whose pictures are left out; `test_demo_twice` has it whole."""
    patch.setattr(demo, "write_report", lambda folder, order, out: out.write_text("<!doctype html>"))


def test_demo_twice(demo: ModuleType, small: Path, tmp_path: Path):
    runs, masks = tmp_path / "runs", tmp_path / "masks"
    summary = demo.made(small, runs, masks)
    for folder in (runs / "quick", masks / "quick", runs / "quick" / "psf"):
        assert str(folder) in summary
        assert (folder / "manifest.json").is_file()
    assert f"report    {runs / 'quick' / 'report.html'}\n" in summary
    assert (runs / "quick" / "report.html").read_text("utf-8").startswith("<!DOCTYPE html>")
    pictures = sorted(map(str, tmp_path.rglob("*.png")))
    assert pictures
    assert all(f"  {picture}\n" in f"{summary}\n" for picture in pictures)
    assert "656nm" in summary
    assert "every pixel of every file is as designed" in summary
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    assert demo.made(small, runs, masks) == summary
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == times


def test_demo_designs_the_main_plate_beside_the_small_one(
    demo: ModuleType,
    small: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
):
    caplog.set_level("INFO", "doedesign")
    leave_out_pictures(monkeypatch, doedesign.optimization, doedesign.runs.psfs)
    leave_out_report(monkeypatch, demo)
    main_spec, runs, masks = tmp_path / "main.toml", tmp_path / "runs", tmp_path / "masks"
    main_spec.write_text(small.read_text().replace('name = "quick"', 'name = "main"'))
    summary = demo.demo(small, main_spec, runs, masks)
    shown = capfd.readouterr()
    assert f"run       {runs / 'quick'}" in shown.out
    assert f"run       {runs / 'main'}" in summary
    # The small design is done, and says what to look at, before the main one is waited for.
    looks = [shown.err.index(text) for text in (f"a first look: {runs / 'quick'}", "which was begun meanwhile")]
    assert looks == sorted(looks)
    # This process found the main run finished, by the one beside it.
    assert f"{runs / 'main'} already holds the finished run" in caplog.text
    assert f"{runs / 'quick'} already holds the finished run" not in caplog.text
    assert demo.is_drawn(open_design(runs / "main"), masks / "main")


def test_demo_says_that_the_other_process_failed(demo: ModuleType, tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    (tmp_path / "log").write_text("begun\nfailed\n")
    with subprocess.Popen([sys.executable, "-c", "raise SystemExit(2)"]) as process, pytest.raises(CheckFailed):
        demo.wait(process, tmp_path / "log")
    assert capfd.readouterr().err == "failed\n"


def test_demo_takes_no_other_order_for_its_own(
    demo: ModuleType, small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    leave_out_pictures(monkeypatch, doedesign.optimization, doedesign.runs.psfs)
    leave_out_report(monkeypatch, demo)
    runs, masks = tmp_path / "runs", tmp_path / "masks"
    # Where the tests run, `make demo` may have left a masks/quick of its own.
    runs.mkdir()
    monkeypatch.chdir(runs)
    demo.made(small, runs, masks)
    run, order = runs / "quick", masks / "quick"
    assert demo.is_drawn(open_design(run), order)
    assert main(["masks", str(run), "--levels", "8", "--out", str(order)]) == 0
    assert not demo.is_drawn(open_design(run), order)
    # PSFs that were computed without the masks are not those of what was drawn.
    assert main(["psf", "quick"]) == 0
    assert not (run / "psf" / "from_masks.exr").exists()
    demo.made(small, runs, masks)
    assert demo.is_drawn(open_design(run), order)
    assert (run / "psf" / "from_masks.exr").exists()
