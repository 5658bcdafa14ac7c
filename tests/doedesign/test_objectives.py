"""Objectives against PSFs whose value is known."""

import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pytest

from doedesign.design.objectives import (
    BUILT_IN,
    PsfSet,
    far_spot,
    handcrafted,
    import_objectives,
    near_spread,
    source_digests,
    terms_from_spec,
    window_loss,
)
from doedesign.design.patterns import target_image
from doedesign.optimization import optimize
from doedesign.spec import Spec, load_spec
from doedesign.spec.values import NEAR_OBJECTIVES, OBJECTIVES
from fab.errors import InputError
from fab.files import sha256_file
from fab.grid import Grid
from fab.pictures import write_pixels
from sim.camera import Camera, Colour
from sim.metrics import participation
from sim.psf_bank import psf

EXAMPLES = Path(__file__).parents[2] / "examples"
CAMERA = Camera(Grid((64, 64), 10e-6), 0.64e-3, "fused_silica", (Colour("green", (550e-9,), (1.0,)),), 5e-3, 4e-6, 64)


def view(near: np.ndarray, far: np.ndarray, lens: float = 1.0) -> PsfSet:
    return PsfSet(jnp.asarray(near)[None, None], jnp.asarray(far)[None, None], jnp.full((1, 1), lens), CAMERA)


def even() -> np.ndarray:
    return np.full((64, 64), 1 / 64**2, np.float32)


def point() -> np.ndarray:
    image = np.zeros((64, 64), np.float32)
    image[31:33, 31:33] = 0.25
    return image


def test_far_spot_is_the_light_that_misses() -> None:
    assert float(far_spot(view(even(), point()))) == pytest.approx(0.0, abs=1e-6)
    assert float(far_spot(view(even(), 0.3 * point()))) == pytest.approx(0.7, abs=1e-6)


def test_near_spread_is_one_for_the_plain_lens() -> None:
    bank = psf(np.zeros((64, 64)), CAMERA, [0.05])
    lens = float(participation(jnp.asarray(bank.energy[0, 0])))
    assert float(near_spread(view(bank.energy[0, 0], point(), lens))) == pytest.approx(1.0, rel=1e-6)
    assert float(near_spread(view(even(), point(), lens))) == pytest.approx(1 / 64**2 / lens, rel=1e-5)


def test_coherent_light_obeys_its_bound() -> None:
    # A fraction s of the field passes undiffracted; the near PSF keeps s times the lens's disc, hence s² of its square.
    bank = psf(np.zeros((64, 64)), CAMERA, [0.05]).energy[0, 0]
    lens = float(participation(jnp.asarray(bank)))
    s = 0.4
    assert float(near_spread(view(s * bank, point(), lens))) == pytest.approx(s**2, rel=1e-5)


def test_window_loss_counts_what_is_not_there() -> None:
    assert float(window_loss(view(0.5 * even(), point()))) == pytest.approx(0.25, abs=1e-6)


def test_handcrafted_is_zero_at_its_targets() -> None:
    from doedesign.design.objectives import spot_weights

    spots = spot_weights(CAMERA)[0]
    assert float(handcrafted(view(even(), spots / spots.sum()))) == pytest.approx(0.0, abs=1e-5)
    assert float(handcrafted(view(point(), even()))) > 1.0


def test_target_pattern_is_zero_when_all_light_is_on_target() -> None:
    spec = load_spec(EXAMPLES / "beam_splitter.toml")
    from doedesign.build import camera_from_spec

    camera = camera_from_spec(spec)
    (term,) = terms_from_spec(spec, camera, {})
    target = target_image(camera, dict(spec.objectives[0].options), None, "objective")
    assert target.sum() == pytest.approx(1.0, abs=1e-5)
    images = PsfSet(jnp.zeros((1, 0, *target.shape)), jnp.asarray(target)[None, None], jnp.zeros((1, 0)), camera)
    assert float(term.value(images)) == pytest.approx(0.0, abs=1e-9)


def test_a_picture_is_a_target_with_its_top_at_the_highest_y(tmp_path: Path) -> None:
    display = np.zeros((128, 128), np.uint8)
    display[96:, :64] = 188  # top left; half of the linear light of 255 in sRGB
    write_pixels(tmp_path / "grey.png", display)
    write_pixels(tmp_path / "colour.tif", np.repeat(display[..., None].astype(np.uint16) * 257, 3, axis=2))
    for name in ("grey.png", "colour.tif"):
        target = target_image(CAMERA, {}, tmp_path / name, "objective")
        assert target.sum() == pytest.approx(1.0, abs=1e-5)
        # Anti-aliasing blurs by about a pixel of the target; energies are shares of the total, 16 x 32 pixels.
        np.testing.assert_allclose(target[52:, :28], 1 / (16 * 32), rtol=0.01)
        assert target[:44].max() < 1e-6
    write_pixels(tmp_path / "black.png", np.zeros((8, 8), np.uint8))
    with pytest.raises(InputError, match="some light"):
        target_image(CAMERA, {}, tmp_path / "black.png", "objective")


def test_the_objectives_are_those_of_the_spec() -> None:
    """And each says by itself whether it looks at near depths, as the spec's table does."""
    assert BUILT_IN.keys() == set(OBJECTIVES)
    given = {"target_pattern": {"target": even()}}
    for name in OBJECTIVES:
        without = PsfSet(jnp.zeros((1, 0, 64, 64)), jnp.asarray(point())[None, None], jnp.zeros((1, 0)), CAMERA)
        value = float(BUILT_IN[name](without, **given.get(name, {})))
        assert np.isnan(value) == (name in NEAR_OBJECTIVES), name


def test_users_objective(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("users_objectives")
    module.dark_centre = lambda view, *, power=1.0: jnp.mean(view.near) ** power  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "users_objectives", module)
    overrides = ["objective.0.name=users_objectives:dark_centre", "objective.0.options.power=2.0"]
    spec = load_spec(EXAMPLES / "quick.toml", overrides)
    with pytest.raises(InputError, match="a spec runs no code by itself"):
        terms_from_spec(spec, CAMERA, {})
    term = terms_from_spec(spec, CAMERA, {}, import_objectives(spec))[0]
    assert float(term.value(view(even(), point()))) == pytest.approx(1 / 64**4, rel=1e-5)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["objective.0.name=no_such_module:f"], "importable module:function"),
        (["objective.0.name=math:no_such_function"], "importable module:function"),
        (["objective.0.name=math:pi"], "must be a function"),
        (["objective.0.options.radius=3"], "must be options of far_spot"),
        (["objective.0.name=target_pattern", "objective.0.options.pattern=hexagon"], "must be one of spots"),
        (["objective.0.name=target_pattern", "objective.0.options.pattern=square"], "must be a length"),
        (["objective.0.name=target_pattern", "objective.0.options={pattern='disc', bogus=1}"], "are: diameter"),
    ],
)
def test_wrong_objectives_are_named(overrides: list[str], words: str) -> None:
    spec = load_spec(EXAMPLES / "quick.toml", overrides)
    with pytest.raises(InputError, match=words):
        terms_from_spec(spec, CAMERA, {}, import_objectives(spec))


def test_a_spec_alone_runs_no_code() -> None:
    """Neither is the function called nor its module imported."""
    spec = load_spec(EXAMPLES / "quick.toml", ["objective.0.name=this:d", "objective.0.options={mode=0}"])
    with pytest.raises(InputError, match=r"objective\[0\] this:d: a spec runs no code by itself"):
        optimize(spec)
    assert "this" not in sys.modules


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Spec]:
    """A module with an objective, and a spec that names it."""
    file = tmp_path / "own_objective.py"
    file.write_text("def dark(psfs):\n    return psfs.far.max()\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "own_objective", raising=False)
    return file, load_spec(EXAMPLES / "quick.toml", ["objective.0.name=own_objective:dark", "optimize.steps=0"])


def test_the_file_of_an_objective_is_known_by_its_digest(own: tuple[Path, Spec]) -> None:
    file, spec = own
    assert source_digests(spec, import_objectives(spec)) == {"objective[0].name": sha256_file(file)}
    with pytest.raises(InputError, match="must be in a file"):
        source_digests(spec, {"own_objective:dark": cast("Any", len)})


@pytest.mark.slow
def test_a_run_records_the_file_of_an_objective(own: tuple[Path, Spec], tmp_path: Path) -> None:
    file, spec = own
    functions = import_objectives(spec)
    optimize(spec, tmp_path / "run", objectives=functions)
    recorded = json.loads((tmp_path / "run" / "manifest.json").read_text())["inputs_sha256"]
    assert recorded == {"objective[0].name": sha256_file(file)}
    file.write_text("def dark(psfs):\n    return psfs.far.min()\n")
    with pytest.raises(InputError, match="other input files"):
        optimize(spec, tmp_path / "run", objectives=functions)
