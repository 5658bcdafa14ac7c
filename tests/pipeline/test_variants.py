"""Every way to parametrise, start and quantise goes from the spec to the light of its masks."""

import json

import numpy as np
import pytest

from fab.grid import Grid
from sim.propagation.hankel import radial_profile
from sim.store import read_height, write_height

pytestmark = pytest.mark.usefixtures("without_pictures")


def overrides(*pairs):
    return [part for pair in pairs for part in ("--set", pair)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        ["optimize.parametrization=radial"],
        ["optimize.quantisation=annealed"],
        ["optimize.quantisation=none", "process.levels=4", "process.level_step=300 nm"],
        ["optimize.start=fresnel", "optimize.start_options.evaluations=4"],
        ["optimize.start=random", "optimize.sampling=exact", "sensor.binning=2", "sensor.window=24"],
        ["optimize.start=flat", "optimize.steps=0", "doe.samples=65", "doe.aperture=120.25 um"],
        ["optics.propagation=fresnel"],
        # The circle then cuts cells whose centres lie outside it, which are drawn blank.
        ["process.chrome_overlap=0 nm", "process.levels=64", "process.level_step=18.75 nm"],
        # Lengths with more digits than the manifest of an order keeps.
        ["doe.pitch=1.8333333333333333 um", "doe.aperture=117.3333 um", "process.level_step=74.123456789123 nm"],
        ["scene.near=[]", 'scene.far=["inf"]', 'objective=[{name="far_spot"}]'],
        ['scene.near=["6 mm", "6.0001 mm"]'],
        ['optics.wavelengths=["656 nm", "486 nm"]', "sensor.defocus=5 um", "sensor.fill_factor=0.8"],
    ],
    ids=" ".join,
)
def test_spec_to_light(tiny, cli, tmp_path, changes):
    run, order = tmp_path / "run", tmp_path / "order"
    done = cli("optimize", tiny, "--out", run, *overrides(*changes))
    assert done.code == 0, done.err
    assert (run / "history.png").exists() == ("optimize.steps=0" not in changes)
    done = cli("masks", run, "--out", order)
    assert done.code == 0, done.err
    done = cli("psf", run, "--masks", order)
    assert done.code == 0, done.err
    assert (run / "psf" / "quantised.exr").read_bytes() == (run / "psf" / "from_masks.exr").read_bytes()
    recorded = (run / "spec.toml").read_text()
    assert all(f"--set {change}" in recorded for change in changes)
    assert json.loads((run / "manifest.json").read_text())["overrides"] == changes


@pytest.mark.slow
def test_a_radial_design_is_made_of_rings(tiny, cli, tmp_path):
    assert cli("optimize", tiny, "--out", tmp_path, *overrides("optimize.parametrization=radial")).code == 0
    stored = read_height(tmp_path / "height_continuous.exr")
    assert stored.pitch_m is not None
    assert radial_profile(stored.height_m, Grid((64, 64), stored.pitch_m)) is not None


def test_a_start_from_a_file_is_an_input_of_the_run(tiny, cli, tmp_path, content):
    spec, start, run = tmp_path / "tiny.toml", tmp_path / "start.exr", tmp_path / "run"
    spec.write_text(tiny.read_text())
    heights = np.random.default_rng(4).integers(0, 16, (64, 64)) * 75e-9
    write_height(start, heights, 1.85e-6, 118.4e-6)
    command = ("optimize", spec, "--out", run, *overrides("optimize.start=start.exr", "optimize.steps=0"))
    assert cli(*command).code == 0
    # A start that lies on the levels is drawn as it is.
    inside = Grid((64, 64), 1.85e-6).inside_circle(118.4e-6)
    assert np.array_equal(read_height(run / "height.exr").height_m[inside], heights.astype(np.float32)[inside])
    before = content(run)
    write_height(start, heights[::-1], 1.85e-6, 118.4e-6)
    done = cli(*command)
    assert done.code == 2
    assert "other input files" in done.err
    assert content(run) == before


@pytest.mark.parametrize(
    ("shape", "rule"), [((64, 63), "the grid's shape"), ((3,), "two axes"), (None, "the file must exist")]
)
def test_a_start_that_does_not_fit_leaves_no_run_behind(tiny, cli, tmp_path, shape, rule):
    spec = tmp_path / "tiny.toml"
    spec.write_text(tiny.read_text())
    if shape:
        np.save(tmp_path / "start.npy", np.zeros(shape))
    done = cli("optimize", spec, "--out", tmp_path / "run", "--set", "optimize.start=start.npy")
    assert done.code == 2
    assert rule in done.err
    assert not list((tmp_path / "run").glob("*"))


@pytest.mark.slow
def test_a_target_pattern_is_drawn_and_judged(tiny, cli, tmp_path):
    changes = [
        "scene.near=[]",
        'scene.far=["inf"]',
        'objective=[{name="target_pattern", options={pattern="square", width="30 um"}}]',
    ]
    assert cli("optimize", tiny, "--out", tmp_path, *overrides(*changes)).code == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert set(metrics["patterns"][0]) == {"on_target", "uniformity"}
    assert 0 < metrics["patterns"][0]["on_target"] < 1
    assert (tmp_path / "pattern.png").is_file()
