"""Specs that `doedesign new` writes: every one loads without a warning, runs at once, and ends in a verified order."""

import json
from pathlib import Path

import pytest

import doedesign.optimization
from doedesign.cli import main
from doedesign.lab.order import write_masks
from doedesign.optimization import optimize
from doedesign.prediction import on_target
from doedesign.runs.level_maps import open_design
from doedesign.spec import load_spec, spec_warnings
from doedesign.templates import EXAMPLES, template_names, template_summary, template_text
from fab.order.verify import verify
from tests.pictures import leave_out_pictures

# Changes that leave each task what it is and make it small.
SMALL = {
    "axicon": ["doe.samples=200", "doe.aperture=0.4 mm", "sensor.distance=12 mm"],
    "bifocal": ["doe.samples=160", "doe.aperture=0.32 mm", 'focus.distances=["4 mm", "8 mm"]', "optimize.steps=60"],
    "colours": ["doe.samples=128", "doe.pitch=4 um", "optimize.steps=40"],
    "diffuser": ["doe.samples=128", "doe.aperture=0.256 mm", "optimize.steps=40"],
    "edof": ["doe.samples=100", "doe.aperture=0.3 mm", 'focus.distances=["5 mm", "20 mm"]', "optimize.steps=40"],
    "fan_out": ["doe.samples=96", "doe.aperture=0.192 mm", "spots.count=[3, 3]", "spots.period=48 um"],
    "lens": ["doe.samples=150", "doe.aperture=0.3 mm", "sensor.distance=5 mm"],
    "lens_array": ["doe.samples=240", "doe.aperture=0.48 mm", "sensor.window=256"],
    "see_through": ["doe.samples=64", "doe.aperture=0.1184 mm", 'scene.near=["6 mm"]', 'scene.far=["inf"]'],
    "splitter": ["doe.samples=128", "doe.aperture=0.256 mm", "spots.count=[3, 3]", "optimize.steps=20"],
    "top_hat": ["doe.samples=150", "doe.pitch=100 um", "optimize.steps=60"],
    "vortex": ["doe.samples=200", "doe.aperture=0.4 mm", "illumination.diameter=0.2 mm"],
}
SMALL["edof"] += ['focus.widths=["16 um", "66 um"]']
SMALL["see_through"] += ["sensor.window=48", "optimize.steps=3"]
LEAST = {
    "colours": 0.25,
    "diffuser": 0.7,
    "fan_out": 0.8,
    "splitter": 0.75,
    "top_hat": 0.9,
}  # of the light where it should go


def test_all_are_here() -> None:
    assert template_names() == sorted({*SMALL, *EXAMPLES})


@pytest.mark.parametrize("name", template_names())
def test_each_loads_without_a_warning(name: str, tmp_path: Path) -> None:
    path = tmp_path / "spec.toml"
    path.write_text(template_text(name))
    spec = load_spec(path)
    assert spec.name == name
    assert spec_warnings(spec) == []
    assert len(template_summary(name)) < 120


# The others are designed, at full size, by the pages on tasks.
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in LEAST else pytest.mark.study) for n in sorted(SMALL)]
)
def test_each_ends_in_a_verified_order(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leave_out_pictures(monkeypatch, doedesign.optimization)
    path = tmp_path / "spec.toml"
    path.write_text(template_text(name))
    optimize(load_spec(path, SMALL[name]), tmp_path / "run")
    design = open_design(tmp_path / "run")
    if name in LEAST:
        table = on_target(design, design.as_optic())
        assert table is not None
        assert table.measures()["on_target"] > LEAST[name]
    write_masks(tmp_path / "run", tmp_path / "order")
    assert verify(tmp_path / "order").passed


def test_new_lists_and_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.chdir(tmp_path)
    assert main(["new"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in template_names())
    assert main(["new", "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)) == template_names()
    assert main(["new", "top_hat"]) == 0
    assert (tmp_path / "top_hat.toml").read_text() == template_text("top_hat")
    assert main(["new", "top_hat"]) == 2
    assert "must not replace a file" in capsys.readouterr().err
    assert main(["new", "tophat"]) == 2
    assert "Did you mean `top_hat`?" in capsys.readouterr().err
    assert main(["new", "lens", "--out", "mine.toml"]) == 0
    assert (tmp_path / "mine.toml").is_file()
    assert main(["new", "--out", "other.toml"]) == 2  # of what?
    assert "--out: goes with the name of a template only" in capsys.readouterr().err
    assert not (tmp_path / "other.toml").exists()
