"""`[optics] light`: whether walls add their light, everywhere from the loss to the captures."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import doedesign as dd
from doedesign.build import camera_from_spec
from doedesign.design.problem import judge_height, problem_of
from doedesign.spec import load_spec, spec_digest, spec_to_toml
from fab.errors import InputError
from fab.process import Variation
from sim.metrics import energy_budget
from sim.psf_bank import psf
from sim.rigorous.edge_optic import EdgeOptic, with_edges
from tests.doedesign.small_runs import SPEC, call, finished_run

LIT = SPEC.replace("[doe]", 'light = "edges"\npolarisation = "x"\n\n[doe]', 1)
VISIBLE = 0.005  # relative difference (L2) of PSFs; walls of these rings make 0.008, rounding 1e-6


def off(found: object, expected: object) -> float:
    return float(np.linalg.norm(np.asarray(found) - np.asarray(expected)) / np.linalg.norm(np.asarray(expected)))


def loaded(folder: Path, text: str) -> dd.Spec:
    (folder / "spec.toml").write_text(text)
    return load_spec(folder / "spec.toml")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished_run(tmp_path_factory.mktemp("lit"), LIT)


def test_the_camera_knows_its_light(tmp_path: Path):
    thin, lit = loaded(tmp_path, SPEC), loaded(tmp_path, LIT)
    assert (camera_from_spec(thin).light, camera_from_spec(lit).light) == ("scalar", "edges")
    assert camera_from_spec(lit).polarisation == "x"
    assert 'light = "edges"' in spec_to_toml(lit)
    # The keys leave no trace where they are not given: digests of older specs stay.
    said = loaded(tmp_path, SPEC.replace("[doe]", 'light = "scalar"\npolarisation = "unpolarised"\n\n[doe]', 1))
    assert spec_digest(said) == spec_digest(thin)
    assert "light" not in spec_to_toml(thin)


@pytest.mark.parametrize(("key", "value"), [("light", '"bright"'), ("light", "1"), ("polarisation", '"z"')])
def test_light_that_is_none_is_refused(tmp_path: Path, key: str, value: str):
    with pytest.raises(InputError, match=rf"spec\.toml: optics\.{key}: "):
        loaded(tmp_path, SPEC.replace("[doe]", f"{key} = {value}\n\n[doe]", 1))


@pytest.mark.slow
def test_a_run_says_its_light_and_its_psfs_have_it(run: Path):
    assert json.loads((run / "metrics.json").read_text())["light"] == "edges"
    design = dd.open_design(run)
    assert isinstance(design.as_optic(), EdgeOptic)
    depths = design.depths_m
    found = psf(design, depths=depths).energy
    walls = with_edges(design.height_m, design.camera, depths_m=depths)
    np.testing.assert_array_equal(found, psf(walls, depths=depths).energy)
    assert off(found, psf(design.height_m, replace(design.camera, light="scalar"), depths).energy) > VISIBLE
    code, _, said = call("psf", run)
    assert code == 0, said
    bank = next((run / "psf").glob("quantised.exr"))
    assert bank.is_file()
    other = {way: psf(design.height_m, replace(design.camera, polarisation=way), depths).energy for way in ("x", "y")}
    assert off(other["x"], found) == 0
    assert off(other["y"], found) > VISIBLE / 10


@pytest.mark.slow
def test_the_loss_is_of_the_light_that_was_asked_for(tmp_path: Path):
    losses = []
    for text in (SPEC, LIT):
        problem, scene = problem_of(loaded(tmp_path, text), {})
        height = np.random.default_rng(0).integers(0, 4, problem.optic.shape) * 300e-9
        losses.append(judge_height(problem, scene, height))
    assert abs(losses[1] / losses[0] - 1) > 1e-3


@pytest.mark.slow
def test_plates_as_fabricated_have_the_light_of_their_walls(run: Path):
    design = dd.open_design(run)
    thin = replace(design, camera=replace(design.camera, light="scalar"))
    errors = Variation(overlay_x_m=(0.0, 0.4e-6))
    both = [psf(one.fabricated(variation=errors), depths=design.depths_m).energy for one in (design, thin)]
    assert off(*both) > VISIBLE
    drawn = design.fabricated(variation=Variation())
    np.testing.assert_array_equal(psf(drawn, depths=design.depths_m).energy, psf(design, depths=design.depths_m).energy)


@pytest.mark.slow
def test_captures_follow_the_design(run: Path):
    design = dd.open_design(run)
    thin = replace(design, camera=replace(design.camera, light="scalar"))
    picture = np.random.default_rng(0).random((64, 64, 3)).astype(np.float32)
    found = [dd.simulate(picture, one, obstruction="dirt", occlusion="radiometric", size=64) for one in (design, thin)]
    assert off(*(np.asarray(one.doe) for one in found)) > 1e-4


# So near, and so wide a window, that light of walls is computed on halves of cells.
OBLIQUE = LIT.replace("window = 32", "window = 160").replace('near = ["6 mm"]', 'near = ["1 mm"]')
OBLIQUE = OBLIQUE.replace("steps = 0", "steps = 2")


@pytest.mark.slow
def test_cells_that_are_split_for_walls_are_still_those_of_the_design(tmp_path: Path):
    run = finished_run(tmp_path, OBLIQUE)
    design = dd.open_design(run)
    optic = design.as_optic()
    assert optic.camera.grid.shape == (96, 96)
    assert design.height_m.shape == (48, 48)
    rows = json.loads((run / "metrics.json").read_text())["psf"]
    thin = replace(design, camera=replace(design.camera, light="scalar"))
    for row, depth in zip(rows, design.depths_m, strict=True):
        assert sum(row["budget"].values()) == pytest.approx(1, abs=1e-9)
        # What lies beyond the band of the cells that were drawn hardly depends on the walls.
        image = psf(thin, depths=[depth]).energy[0, 0]
        scalar = energy_budget(thin.as_optic(), image, depth, design.camera.colours[0])
        assert row["budget"]["higher_orders"] == pytest.approx(scalar.higher_orders, abs=0.02)
        assert row["budget"]["uncollected"] > -2e-3
