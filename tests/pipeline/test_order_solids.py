"""The solids of an order, from the command line."""

import json

import pytest

from doedesign.runs.folder import open_run
from doedesign.runs.level_maps import level_map_of_run
from fab.solids.rings import ring_levels


def models(order):
    listed = json.loads((order / "manifest.json").read_text())["models"]
    return {entry["file"].split("_", 4)[4]: entry for entry in listed}


@pytest.mark.slow
def test_a_radial_design_is_ordered_with_its_rings_as_circles(tiny, cli, tmp_path):
    options = ["--set", 'optimize.parametrization="radial"', "--set", "optimize.steps=1"]
    done = cli("optimize", tiny, "--out", tmp_path / "run", *options)
    assert done.code == 0, done.err
    done = cli("masks", tmp_path / "run", "--levels", 16, "--out", tmp_path / "order")
    assert done.code == 0, done.err
    assert "relief of 32 rings as exact circles" in models(tmp_path / "order")["PLATE.step"]["content"]
    # Rounded to other levels it is as radial.
    other = level_map_of_run(open_run(tmp_path / "run"), 4)
    rings = ring_levels(other)
    assert rings is not None
    assert len(rings) == 32


def test_a_freeform_design_is_ordered_with_a_flat_plate(finished):
    assert "drawn flat" in models(finished.order)["PLATE.step"]["content"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("option", "names"),
    [
        ("--patch", {"PATCH.step", "PATCH.3mf", "PATCH.glb", "PATCH_MM.stl"}),
        pytest.param("--mesh-patch", {"PATCH.3mf", "PATCH.glb", "PATCH_MM.stl"}, marks=pytest.mark.slow),
    ],
)
def test_a_patch_is_written_on_request(finished, cli, tmp_path, option, names):
    done = cli("masks", finished.run, "--out", tmp_path / "order", f"{option}=-20 um, 10um, 18.5 um")
    assert done.code == 0, done.err
    found = models(tmp_path / "order")
    assert {name for name in found if name.startswith("PATCH")} == names
    assert "10 x 10 pixels of 1.85 um about -20.35 um, 9.25 um" in found["PATCH.glb"]["content"]
    assert cli("verify", tmp_path / "order").code == 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--patch", "0 um, 0 um"], "must be three lengths"),
        (["--patch", "0 um, 0 um, wide"], "must be a length with a unit"),
        (["--patch", "0 um, 0 um, 1 mm"], "must lie on the map"),
        (["--patch", "0 um, 0 um, 9 um", "--mesh-patch", "0 um, 0 um, 9 um"], "does not go with --patch"),
    ],
)
def test_patches_that_cannot_be_are_refused_with_a_cure(finished, cli, tmp_path, options, words):
    done = cli("masks", finished.run, "--out", tmp_path / "order", *options)
    assert done.code == 2
    assert words in done.err
    assert not (tmp_path / "order").exists()
