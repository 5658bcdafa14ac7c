"""Apertures of any mask through every command."""

import json

import numpy as np
import pytest

from doedesign.spec import load_spec, spec_digest, spec_from_json, spec_to_json, spec_warnings
from fab.aperture import MaskAperture
from fab.manifest.records import read_manifest
from fab.pictures import write_pixels
from tests.pipeline.conftest import TINY

PITCH_M = 1.85e-6
STENCIL = TINY.replace('aperture = "0.1184 mm"', 'aperture = "mask.png"').replace(
    'level_step = "75 nm"', 'level_step = "75 nm"\nstock = "contact_aligner"'
)


def plane() -> np.ndarray:
    """An L and a block of its own."""
    found = np.zeros((64, 64), bool)
    found[4:60, 4:20] = found[4:20, 20:44] = found[34:60, 36:62] = True
    return found


@pytest.fixture
def spec(tmp_path):
    path = tmp_path / "stencil.toml"
    path.write_text(STENCIL)
    write_pixels(tmp_path / "mask.png", plane().astype(np.uint8) * 255)
    return path


def test_the_spec_keeps_the_open_cells_and_needs_the_picture_no_more(tmp_path, spec):
    from doedesign.spec import spec_to_toml

    read = load_spec(spec)
    assert read.doe.relief == MaskAperture.of(plane(), PITCH_M)
    (tmp_path / "mask.png").unlink()
    (tmp_path / "kept.toml").write_text(spec_to_toml(read))
    again = load_spec(tmp_path / "kept.toml")
    assert again == read
    assert spec_digest(again) == spec_digest(read)
    assert spec_from_json(json.loads(json.dumps(spec_to_json(read))), "here") == read


def test_parts_that_the_chrome_closes_are_told(tmp_path, spec):
    assert not [warning for warning in spec_warnings(load_spec(spec)) if "doe.aperture" in warning]
    narrow = plane()
    narrow[50:60, 24:29] = narrow[24:30, 62:64] = True  # both less than 10 um wide
    write_pixels(tmp_path / "mask.png", narrow.astype(np.uint8) * 255)
    (warning,) = (warning for warning in spec_warnings(load_spec(spec)) if "doe.aperture" in warning)
    assert "reaches 5 um over every edge, closes 2 of the 4 parts of the mask" in warning


@pytest.mark.slow
def test_a_mask_goes_from_the_spec_to_a_proved_order_and_to_its_light(tmp_path, cli, spec):
    run, order = tmp_path / "run", tmp_path / "order"
    for command in (
        ("optimize", spec, "--out", run),
        ("masks", run, "--out", order),
        ("verify", order),
        ("psf", run, "--masks", order, "--fabricated", "--seed", 0),
        ("tolerance", run, "--masks", order, "--draws", 2, "--workers", 1),
        ("certify", run, "--cells", 12, "--pieces", 0),
    ):
        done = cli(*command)
        assert done.code == 0, done.err
    manifest = read_manifest(order)
    assert manifest.relief == MaskAperture.of(plane(), PITCH_M)
    # The chrome of the process reaches 5 um over every edge: the L and the block close by ten along both axes.
    sides_um = [1.85 * n for n in (56, 16, 40, 26)]
    high, wide, long, block = sides_um
    open_um2 = (high - 10) * (wide - 10) + (long - wide) * (wide - 10) + (block - 10) ** 2
    outer_um = manifest.chrome.outer_diameter_mm / 2 * 1e3
    assert manifest.chrome.area_um2 == pytest.approx(np.pi * outer_um**2 - open_um2, abs=2 * np.pi * outer_um * 5e-3)
    rows = json.loads((run / "metrics.json").read_text())["psf"]
    assert all(sum(row["budget"].values()) == pytest.approx(1.0, abs=1e-6) for row in rows)


@pytest.mark.study
def test_light_with_edges_and_the_direct_path_take_a_mask(tmp_path, cli, spec):
    for name, changes in {
        "edges": ['optics.light="edges"'],
        "fresnel": ['optics.propagation="fresnel"', "optics.focal_length=20 mm", 'scene.near=["60 mm"]'],
    }.items():
        run = tmp_path / name
        sets = [part for change in (*changes, "optimize.steps=0") for part in ("--set", change)]
        assert cli("optimize", spec, "--out", run, *sets).code == 0
        done = cli("psf", run)
        assert done.code == 0, done.err


@pytest.mark.parametrize(
    ("write", "old", "new", "words"),
    [
        (0, "", "", "mask.png: must be open, brighter than half of white, somewhere"),
        (255, "samples = 64", "samples = [64, 40]", "mask.png: must have the proportions of the DOE's 64 x 40 cells"),
        (255, "samples = 64", 'samples = "64"', "doe.samples: must be a whole number"),
        (255, '"mask.png"', '"none.png"', 'doe.aperture: the file must exist, but got "none.png"'),
        (255, '"mask.png"', '"mask.jpg"', "doe.aperture: must be a number with a unit"),
        (255, '"mask.png"', "{ rows = [[64, 0, 65]] }", "doe.aperture: rows of a mask must be those of 64 x 64 cells"),
        (255, '"mask.png"', "{ rows = [[64, 0.5, 3]] }", "must be rows of whole numbers"),
        (255, '"mask.png"', "{ rows = 3 }", "must be rows of whole numbers"),
        (255, '"mask.png"', "{ runs = [[64, 0, 3]] }", "doe.aperture"),
        (255, '"mask.png"', "{ rows = [[63], [1, 0, 5]] }", "leave an opening in an aperture of mask of 9.25 um"),
        (255, 'start = "ring"', 'start = "ring"\nparametrization = "radial"', "rings fill a round aperture"),
    ],
    ids=["black", "shape", "samples", "missing", "kind", "beyond", "part", "number", "key", "narrow", "radial"],
)  # fmt: skip
def test_what_is_no_mask_of_the_doe_is_told_by_its_key(tmp_path, cli, spec, write, old, new, words):
    write_pixels(tmp_path / "mask.png", np.full((64, 64), write, np.uint8))
    spec.write_text(STENCIL.replace(old, new) if old else STENCIL)
    done = cli("optimize", spec, "--out", tmp_path / "run")
    assert done.code == 2
    assert words in done.err
    assert "Traceback" not in done.err
    assert max(map(len, done.err.splitlines())) < 400


@pytest.mark.slow
def test_a_bare_height_map_takes_the_picture_of_its_aperture(tmp_path, cli):
    np.save(tmp_path / "steps.npy", np.full((64, 64), 1e-7, np.float32))
    write_pixels(tmp_path / "mask.png", plane().astype(np.uint8) * 255)
    done = cli("masks", tmp_path / "steps.npy", "--levels", 4, "--step", "100 nm", "--pitch", "2 um",
               "--aperture", tmp_path / "mask.png", "--out", tmp_path / "order")  # fmt: skip
    assert done.code == 0, done.err
    assert read_manifest(tmp_path / "order").relief == MaskAperture.of(plane(), 2e-6)


@pytest.mark.slow
def test_obstructions_ask_for_a_round_aperture(tmp_path, cli, spec):
    run = tmp_path / "run"
    assert cli("optimize", spec, "--out", run, "--set", "optimize.steps=0").code == 0
    done = cli("simulate", run, "--count", 1, "--obstruction", "dirt", "--occlusion", "radiometric")
    assert done.code == 2
    assert "doe.aperture: obstructions are captured through a round aperture" in done.err
