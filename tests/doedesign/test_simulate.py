"""One capture by two cameras: in memory, and of scenes that bring their surroundings along."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from PIL import Image

import doedesign.capture.folder
from doedesign.build import camera_from_spec
from doedesign.capture.camera import CaptureModel
from doedesign.capture.folder import simulate_files
from doedesign.capture.image_files import read_image
from doedesign.capture.scenes import NamedScene
from doedesign.capture.simulate import SimulatedCapture, flat_psfs, inner, photograph, simulate
from doedesign.design.design import Design
from doedesign.runs.level_maps import open_design
from doedesign.spec import load_spec
from fab.errors import InputError
from fab.files import read_json
from fab.pictures import read_display
from fab.process import Process
from sim.imaging.occlusion import Model
from sim.imaging.scene import Obstruction, Scene
from sim.obstruction import Dirt
from sim.psf_bank import psf
from sim.sensor import Sensor
from tests.doedesign.small_runs import finished_run
from tests.doedesign.test_simulate_command import SPEC
from tests.pictures import leave_out_pictures


@pytest.mark.slow
@pytest.mark.parametrize(
    "model", ["paper", *(pytest.param(m, marks=pytest.mark.slow) for m in ("radiometric", "reciprocal"))]
)
def test_light_comes_in_over_the_edges(rng: np.random.Generator, tmp_path: Path, model: Model):
    """The middle of a large scene is the same whether its surroundings are real or invented farther out."""
    (tmp_path / "small.toml").write_text(SPEC)
    camera = replace(camera_from_spec(load_spec(tmp_path / "small.toml")), window=9)
    psfs, quiet = flat_psfs(camera), Sensor(bits=None, noise="none")
    bare = CaptureModel(camera, model, "scene", quiet, 17, "own")
    assert bare.margin_px == 8 + 16 * {"paper": 0, "radiometric": 1, "reciprocal": 2}[model]
    background, radiance = rng.random((2, 3, 104, 96), np.float32)
    scene = Scene(background, 0.6, (Obstruction(rng.random((104, 96), np.float32), radiance, 7e-3),))
    mirrored, half = replace(bare, border="reflect"), bare.margin_px // 2

    def taken(by: CaptureModel, scene: Scene) -> SimulatedCapture:
        return photograph(NamedScene("noise", scene), by, psfs, psfs, jax.random.key(1))

    own, whole, middle = taken(bare, scene), taken(mirrored, scene), inner(scene, bare.margin_px)
    cut = taken(mirrored, middle)
    np.testing.assert_array_equal(own.mask, middle.obstructions[0].mask)
    np.testing.assert_array_equal(own.clean, cut.clean)
    np.testing.assert_allclose(own.doe, whole.doe[:, half:-half, half:-half], atol=3e-6)  # rounding of transforms
    assert own.alpha.shape[1:] == own.depth_m.shape == own.mask.shape
    off = np.abs(own.doe - cut.doe)
    assert off[:, half:-half, half:-half].max() < 3e-6
    assert off.max() > 0.01


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished_run(tmp_path_factory.mktemp("small"), SPEC)


@pytest.fixture(scope="module")
def design(run: Path) -> Design:
    return open_design(run)


@pytest.fixture(scope="module")
def picture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    coarse = np.random.default_rng(0).integers(30, 256, (5, 6, 3), np.uint8)
    path = tmp_path_factory.mktemp("pictures") / "a.png"
    Image.fromarray(coarse).resize((48, 40)).save(path)
    return path


ASKED: dict[str, Any] = {"obstruction": "dirt", "occlusion": "radiometric", "size": 32}


@pytest.mark.slow
def test_in_memory_and_in_files_the_same(run: Path, design: Design, picture: Path, monkeypatch: pytest.MonkeyPatch):
    """The function and the command take the same capture; so do a file and its values."""
    shot = simulate(picture, design, **ASKED, seed=3)
    leave_out_pictures(monkeypatch, doedesign.capture.folder)
    found = simulate_files(design, run / "simulated", picture.parent, **ASKED, seed=3)
    images = read_json(run / "simulated" / found.items[0] / "manifest.json")["images"]
    for name, image in (("capture", shot.doe), ("conventional", shot.conventional), ("depth", shot.depth_m[None])):
        np.testing.assert_array_equal(read_image(run / "simulated" / found.items[0], images[name]), image)
    for values in (read_display(picture), read_display(picture) / 255):
        np.testing.assert_array_equal(simulate(values, design, **ASKED, seed=3).doe, shot.doe)
    np.testing.assert_array_equal(simulate(picture, run, **ASKED, seed=3).doe, shot.doe)
    assert not np.array_equal(simulate(picture, design, **ASKED, seed=4).doe, shot.doe)


@pytest.mark.slow
def test_what_a_capture_knows_of_itself(design: Design, picture: Path):
    shot = simulate(picture, design, **ASKED)
    assert (shot.name, shot.occlusion) == ("a.png", "radiometric")
    assert 6e-3 <= shot.depth_near_m <= 9e-3  # between the near depths of the design
    assert shot.depth_far_m == 0.6
    # Its PSFs are those of the design at the depths of the scene, in an odd window.
    camera = replace(design.camera, window=33)
    wanted = psf(design.fabricated(Process(design.levels)), camera, (0.6,)).energy[:, 0]
    np.testing.assert_array_equal(shot.psf_far, wanted)
    other = simulate(picture, design, **ASKED, fabricated=design.fabricated(seed=3))
    assert not np.array_equal(other.doe, shot.doe)
    np.testing.assert_array_equal(other.conventional, shot.conventional)


def test_a_capture_draws_itself(design: Design, picture: Path):
    shot = simulate(picture, design, **ASKED)
    drawn: Any = shot.plot()
    assert len(drawn.axes) == 4
    html = shot._repr_html_()
    assert "radiometric" in html
    assert "data:image/png;base64," in html


def test_without_a_spec_everything_is_named(design: Design, picture: Path):
    bare = design.bare()
    shot = simulate(picture, bare, **ASKED)
    np.testing.assert_array_equal(shot.doe, simulate(picture, design, **ASKED).doe)
    # A kind with parameters of its own keeps them.
    near = simulate(picture, bare, **{**ASKED, "obstruction": Dirt(depth_m=(7e-3, 7e-3))})
    assert near.depth_near_m == 7e-3
    for lacking, words in (
        ("occlusion", "occlusion model must be named"),
        ("obstruction", "obstruction must be named"),
    ):
        with pytest.raises(InputError, match=words):
            simulate(picture, bare, **{**ASKED, lacking: None})


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.zeros((40, 40), np.uint8), r"must be an array \[y, x, 3\]"),
        (np.full((40, 40, 3), 2.0), "floats from 0 to 1"),
        (np.full((40, 40, 3), np.nan), "floats from 0 to 1"),
        (np.zeros((40, 40, 3), np.int32), "uint8, or floats"),
    ],
)
def test_what_is_no_picture(design: Design, values: Any, words: str):
    with pytest.raises(InputError, match=words):
        simulate(values, design, **ASKED)


@pytest.mark.usefixtures("annotations_unchecked")
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"picture": [[[0, 0, 0]]]}, r"picture: must be a file, or an array \[y, x, 3\], but got a list"),
        ({"seed": -1}, "seed: must be from 0 to 4294967295"),
        ({"seed": 1.5}, "seed: must be from 0 to 4294967295"),
        ({"size": "64"}, "size: must lie from 16"),
        ({"size": 64.5}, "size: must lie from 16"),
    ],
)
def test_what_is_no_number_of_a_capture(design: Design, picture: Path, changes: dict[str, Any], words: str):
    asked: dict[str, Any] = {"picture": picture, "design": design, **ASKED, **changes}
    with pytest.raises(InputError, match=words):
        simulate(**asked)
