"""One capture by two cameras: scenes that bring their surroundings along."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from doedesign.build import camera_from_spec
from doedesign.capture.scenes import SceneItem
from doedesign.capture.simulate import CameraPair, captured, flat_psfs, within
from doedesign.spec import load_spec
from sim.imaging.occlusion import Model
from sim.sensor import Sensor
from tests.doedesign.test_simulate_command import SPEC


@pytest.mark.parametrize("model", ["paper", "radiometric", "reciprocal"])
def test_light_comes_in_over_the_edges(rng: np.random.Generator, tmp_path: Path, model: Model):
    """The middle of a large scene is the same whether its surroundings are real or invented farther out."""
    (tmp_path / "small.toml").write_text(SPEC)
    camera = replace(camera_from_spec(load_spec(tmp_path / "small.toml")), window=9)
    psfs, quiet = flat_psfs(camera), Sensor(bits=None, noise="none")
    bench = CameraPair(camera, psfs, psfs, model, "scene", quiet, 17, "own")
    assert bench.margin_px == 8 + 16 * {"paper": 0, "radiometric": 1, "reciprocal": 2}[model]
    background, radiance = rng.random((2, 3, 104, 96), np.float32)
    item = SceneItem(background, rng.random((104, 96), np.float32), radiance, 7e-3, 0.6, "noise")
    mirrored, key, half = bench._replace(border="reflect"), jax.random.key(1), bench.margin_px // 2
    own, whole = captured(item, bench, key), captured(item, mirrored, key)
    inner = within(item, bench.margin_px)
    cut = captured(inner, mirrored, key)
    np.testing.assert_array_equal(own.mask, inner.mask)
    np.testing.assert_array_equal(own.clean, cut.clean)
    np.testing.assert_allclose(own.doe, whole.doe[:, half:-half, half:-half], atol=3e-6)  # rounding of transforms
    assert own.alpha.shape[1:] == own.depth_m.shape == own.mask.shape
    off = np.abs(own.doe - cut.doe)
    assert off[:, half:-half, half:-half].max() < 3e-6
    assert off.max() > 0.01
