"""Lessons of the low-resolution branch: what cells say of an obstruction, and that a branch learns it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doedesign.capture.camera import CaptureModel
from doedesign.recon.blocks import shrunk
from doedesign.recon.global_light import GlobalLight, described
from doedesign.spec import Spec
from doedesign.training.joint import Trainer
from doedesign.training.lesson import Cells, cells_of, lesson_loss, taught
from sim.imaging.occlusion import Model
from sim.imaging.scene import Obstruction, Scene
from tests.recon.small_training import PLAIN, batch, heights, trainer

SIDE = 32
POINT = jnp.zeros((3, 9, 9)).at[:, 4, 4].set(1.0)
KEEPS_ALL = (*PLAIN, "network.global_light=true", "train.light_scenes=8")


def bench(model: Model) -> CaptureModel:
    """A camera of three colours."""
    made = trainer(*PLAIN, 'train.camera="conventional"', model=model).bench
    return made


@pytest.mark.slow
@pytest.mark.parametrize("model", ["paper", "radiometric"])
def test_cells_say_what_an_even_obstruction_does(model: Model) -> None:
    """Half of the light kept off everywhere, before a plate that images a point as a point."""
    background = jnp.full((1, SIDE, SIDE), 0.6)
    near = Obstruction(jnp.full((SIDE, SIDE), 0.5), jnp.full((1, SIDE, SIDE), 0.2), 0.008)
    scene = Scene(background, 0.6, (near,))
    found = cells_of(bench(model), scene, POINT[:1], POINT[:1], jax.random.key(0), 8)
    assert found.mean.shape == (1, 4, 4, 1)
    np.testing.assert_allclose(found.clear, 0.6, rtol=1e-5)
    np.testing.assert_allclose(found.log_gain, np.log(2), rtol=1e-5)
    # By eq. 10 the obstruction shows its light and, between, the scene: 0.3 + 0.5 (0.1 + 0.3) in all; following
    # the light, 0.3 + 0.1. A mean of 64 pixels with the noise of some thousand electrons each.
    expected = 0.5 if model == "paper" else 0.4
    np.testing.assert_allclose(found.mean, expected, atol=0.01)


def toy(rng: np.random.Generator, count: int = 64) -> Cells:
    """Grey scenes with an edge of brightness behind smooth dark veils."""
    y, x = np.mgrid[:8, :8] / 8
    clear = 0.3 + 0.2 * rng.uniform(0, 1, (count, 1, 1, 1)) * np.ones((1, 8, 8, 1))
    middle = rng.uniform(0, 1, (2, count, 1, 1))
    alpha = 0.8 * np.exp(-((y - middle[0]) ** 2 + (x - middle[1]) ** 2) / 0.1)[..., None]
    mean, contrast = (1 - alpha) * clear + 0.05 * alpha, 0.05 * (1 - alpha)
    description = np.concatenate([mean ** (1 / 2.2), (0.9 * mean) ** (1 / 2.2), np.log(contrast) / 1.2 + 3], axis=-1)
    parts = (description, mean, clear, contrast, -np.log(1 - alpha))
    return Cells(*(jnp.asarray(part, jnp.float32) for part in parts))


@pytest.mark.slow
def test_a_branch_learns_by_itself() -> None:
    light = GlobalLight.make(np.random.default_rng(0), 1)
    cells, others = toy(np.random.default_rng(1)), toy(np.random.default_rng(2))
    learnt = taught(light, cells, 3)
    # From nothing undone to a third of it, on scenes that it has not seen.
    assert float(lesson_loss(learnt, others)) < float(lesson_loss(light, others)) / 3
    again = taught(light, cells, 3)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(learnt), jax.tree.leaves(again), strict=True))


@pytest.mark.slow
def test_a_training_teaches_its_branch_and_nothing_else() -> None:
    made: Trainer = trainer(*KEEPS_ALL, 'train.freeze="optics"', "train.average=0.9")
    spec: Spec = made.spec
    assert spec.train.light_scenes == 8
    state = made.initial(heights())
    after = made.taught(state, [batch(2, step) for step in range(4)])
    for name in ("down", "bottom", "up", "head"):
        before, now = (jax.tree.leaves(getattr(each.network, name)) for each in (state, after))
        assert all(np.array_equal(a, b) for a, b in zip(before, now, strict=True))
    begun, learnt, mean = (network.light for network in (state.network, after.network, after.best))
    assert begun is not None
    assert learnt is not None
    assert mean is not None
    assert not np.array_equal(begun.last, learnt.last)
    np.testing.assert_array_equal(mean.last, learnt.last)
    # And goes on from there.
    assert made.step(after, batch())[0].step == 1


def test_contrast_and_description_are_of_the_capture() -> None:
    """The spread that the loss weighs with is that of the noisy capture at the brightness of the scene behind."""
    light = jnp.tile(jnp.array([[0.1, 0.3], [0.3, 0.1]]), (16, 16))[None]
    near = Obstruction(jnp.zeros((SIDE, SIDE)), jnp.zeros((1, SIDE, SIDE)), 0.008)
    found = cells_of(bench("paper"), Scene(light, 0.6, (near,)), POINT[:1], POINT[:1], jax.random.key(0), 16)
    np.testing.assert_allclose(found.log_gain, 0, atol=1e-6)
    # A spread of 0.1 at a mean of 0.2, times the slope of display values there; noise adds some percent.
    np.testing.assert_allclose(found.contrast, 0.1 / 2.2 * 0.2 ** (1 / 2.2 - 1), rtol=0.1)
    assert described(light.transpose(1, 2, 0)[None], 16).shape == found.description.shape
    np.testing.assert_allclose(shrunk(light.transpose(1, 2, 0)[None], 16), found.clear, rtol=1e-5)
