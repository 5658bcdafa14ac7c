"""Rectangular apertures through every command."""

import json

import pytest

from fab.aperture import RectangularAperture
from fab.manifest.records import read_manifest
from tests.pipeline.conftest import TINY

SLIT = TINY.replace('aperture = "0.1184 mm"', 'aperture = ["0.1184 mm", "0.074 mm"]').replace(
    'level_step = "75 nm"', 'level_step = "75 nm"\nstock = "contact_aligner"'
)


@pytest.mark.study  # test_mask_apertures.py takes an aperture of any outline the same way
@pytest.mark.parametrize("samples", ["64", "[64, 40]"])
def test_a_rectangular_aperture_goes_from_the_spec_to_a_proved_order_and_to_its_light(tmp_path, cli, samples):
    spec, run, order = tmp_path / "slit.toml", tmp_path / "run", tmp_path / "order"
    spec.write_text(SLIT.replace("samples = 64", f"samples = {samples}"))
    for command in (
        ("optimize", spec, "--out", run),
        ("masks", run, "--out", order),
        ("verify", order),
        ("psf", run, "--masks", order, "--fabricated", "--seed", 0),
        ("tolerance", run, "--masks", order, "--draws", 2, "--workers", 1),
    ):
        done = cli(*command)
        assert done.code == 0, done.err
    manifest = read_manifest(order)
    assert manifest.relief == RectangularAperture((0.074e-3, 0.1184e-3))
    assert manifest.shape == ([64, 64] if samples == "64" else [40, 64])
    # The chrome of the process reaches 5 um over every edge.
    assert manifest.chrome.opening_diameter_mm == [0.1084, 0.064]
    rows = json.loads((run / "metrics.json").read_text())["psf"]
    assert all(sum(row["budget"].values()) == pytest.approx(1.0, abs=1e-6) for row in rows)
    written = f'samples = {samples}\npitch = "1.85 um"\naperture = ["118.4 um", "74 um"]'
    assert written in (run / "spec.toml").read_text()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"0.074 mm"]', '"0.074 mm", "1 um"]', "doe.aperture: must be a diameter, or [width, height]"),
        ('"0.074 mm"]', '"0.2 mm"]', "doe.aperture: must equal samples x pitch"),
        ('"0.074 mm"]', '"9 um"]', "twice the overlap must leave an opening in an aperture of 118.4 um x 9 um"),
        ('"0.074 mm"]', "3]", "must be a number with a unit"),
        ("samples = 64", "samples = [40, 64]", "samples x pitch = [40, 64] x 1.85 um = 74 um x 118.4 um"),
        ("samples = 64", "samples = [64, 40, 3]", "doe.samples: must be a whole number, or two of them"),
        ("samples = 64", "samples = [64, 1]", "doe.samples: must be at least 2"),
        ('start = "ring"', 'start = "ring"\nparametrization = "radial"', "rings fill a round aperture"),
    ],
)
def test_what_does_not_fit_a_rectangle_is_told_by_its_key(tmp_path, cli, old, new, words):
    spec = tmp_path / "slit.toml"
    spec.write_text(SLIT.replace(old, new))
    done = cli("optimize", spec, "--out", tmp_path / "run")
    assert done.code == 2
    assert words in done.err


@pytest.mark.slow
def test_a_bare_height_map_takes_width_and_height(tmp_path, cli):
    import numpy as np

    np.save(tmp_path / "steps.npy", np.full((20, 30), 1e-7, np.float32))
    done = cli("masks", tmp_path / "steps.npy", "--levels", 4, "--step", "100 nm", "--pitch", "2 um",
               "--aperture", "60 um, 30 um", "--out", tmp_path / "order")  # fmt: skip
    assert done.code == 0, done.err
    assert read_manifest(tmp_path / "order").aperture_mm == [0.06, 0.03]


@pytest.mark.slow
def test_obstructions_ask_for_a_round_aperture(tmp_path, cli):
    spec, run = tmp_path / "slit.toml", tmp_path / "run"
    spec.write_text(SLIT)
    assert cli("optimize", spec, "--out", run, "--set", "optimize.steps=0").code == 0
    done = cli("simulate", run, "--count", 1, "--obstruction", "dirt", "--occlusion", "radiometric")
    assert done.code == 2
    assert "doe.aperture: obstructions are captured through a round aperture" in done.err
