"""Training steps: what moves and what does not, what a step depends on, and what is refused.

Networks are as small as they go, for the time goes into compiling steps.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doedesign.capture.from_spec import obstruction_from_spec
from doedesign.capture.scenes import Batch
from doedesign.spec.training import TrainSpec
from doedesign.training.checkpoint import read_checkpoint, write_checkpoint
from doedesign.training.joint import JointState, Trainer, devices_mesh, rates_at, resting_depths_m
from doedesign.training.train import JointTraining, _with_options, trained_near_m
from doedesign.training.validation import SCENE_SEED
from fab.errors import InputError
from sim.light import srgb_from_linear
from sim.obstruction import Dirt
from tests.doedesign.calibration_fakes import plate_drawn
from tests.recon.small_training import PLAIN, batch, heights, small_spec, trainer

COLOURS = ("optics.wavelengths=['640 nm', '550 nm', '460 nm']", "network.width=3")
LEARNING = ("train.learning_rate=0.01", "train.optics_learning_rate=0.1", 'train.schedule="constant"')


@pytest.fixture(scope="module")
def joint() -> Trainer:
    return trainer(*PLAIN, *LEARNING)


@pytest.mark.parametrize(
    ("changes", "options", "size"), [((), {}, 480), ((), {"steps": 3}, 480), (("train.size=64",), {}, 64)]
)
def test_the_usual_size_is_what_a_small_sensor_has(changes: tuple[str, ...], options: dict[str, Any], size: int):
    """Also of a spec without a word on training."""
    spec = small_spec("train={}", "sensor.resolution=[640, 480]", *changes)
    _, resolved = _with_options(replace(plate_drawn(cells=16), spec=spec), options)
    assert (resolved.train.size, resolved.train.steps) == (size, options.get("steps", spec.train.steps))


def numbers(tree: Any) -> list[np.ndarray]:
    """Copies of all arrays: a step reuses the memory of the state that it is given."""
    return [np.array(leaf) for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]


def alike(a: list[np.ndarray], b: list[np.ndarray]) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def walk(
    made: Trainer, steps: int, state: JointState | None = None, at: int | None = None
) -> tuple[JointState, list[float]]:
    """Steps on one batch, and their losses; `at` lets each of them count as that step."""
    state, losses = state or made.initial(heights()), []
    for _ in range(steps):
        state, line = made.step(state if at is None else state._replace(step=at), batch())
        losses.append(line["loss"])
    return state, losses


# --- the loss falls --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_optics_and_network_learn_together(joint: Trainer) -> None:
    before = joint.initial(heights())
    network, free = numbers(before.network), numbers(before.free)
    state, losses = walk(joint, 30, before)
    assert losses[-1] < 0.7 * losses[0]
    assert state.step == 30
    assert not alike(numbers(state.network), network)
    assert not alike(numbers(state.free), free)


@pytest.mark.study
def test_in_turns_one_moves_and_the_other_stays_to_the_bit() -> None:
    """The network alone lowers the loss, and so does the optics alone."""
    made = trainer(*PLAIN, *LEARNING, 'train.mode="alternating"', "train.period=3")
    state = made.initial(heights())
    for at, moves_optics in ((0, False), (2, True)):
        network, free = numbers(state.network), numbers(state.free)
        moments = numbers(state.optics_moments if at == 0 else state.network_moments)
        state, losses = walk(made, 20, state, at)
        assert losses[-1] < 0.98 * losses[0]
        assert alike(numbers(state.network), network) == moves_optics
        assert alike(numbers(state.free), free) != moves_optics
        # Adam's memory of what stays does not fade either.
        assert alike(numbers(state.optics_moments if at == 0 else state.network_moments), moments)


@pytest.mark.slow
def test_a_plate_at_rest_is_not_in_the_state() -> None:
    made = trainer(*PLAIN, *LEARNING, 'train.freeze="optics"')
    plate = numbers(made.doe)
    state, losses = walk(made, 20)
    assert losses[-1] < 0.98 * losses[0]
    assert state.free is None
    assert alike(numbers(made.doe), plate)


@pytest.mark.slow
def test_optics_alone_learn_from_their_capture() -> None:
    """Whatever the network that is not used would make of it."""
    made = trainer(*PLAIN, *LEARNING, 'train.freeze="network"')
    state = made.initial(heights())
    capture, shown = made.reconstruct(state, batch())
    np.testing.assert_allclose(shown, srgb_from_linear(capture.capture), atol=1e-6)  # rounding of single precision
    other = made.initial(heights())
    other = other._replace(network=jax.tree.map(lambda leaf: leaf + 1.0, other.network))
    (state, found), (_, same) = (walk(made, 20, each) for each in (state, other))
    assert found == same
    assert found[-1] < found[0]
    assert alike(numbers(state.network), numbers(made.initial(heights()).network))


@pytest.mark.parametrize(("freeze", "moves"), [("optics", False), ("none", True)])
def test_a_plate_that_stays_is_the_one_that_is_drawn(freeze: Any, moves: bool) -> None:
    """Rules and errors in the loop make levels that are not the nearest to the heights before rounding."""
    design = replace(plate_drawn(cells=16), continuous_m=np.full((16, 16), 0.3e-6, np.float32))
    begun: list[np.ndarray] = []

    def initial(height_m: np.ndarray) -> None:
        begun.append(height_m)
        raise LookupError

    trainer: Any = SimpleNamespace(doe=SimpleNamespace(parametrization=None), initial=initial)
    job: Any = SimpleNamespace(design=design, trainer=trainer, options=TrainSpec(freeze=freeze, fabricated=True))
    with pytest.raises(LookupError):
        JointTraining.initial(job)
    np.testing.assert_array_equal(begun[0], design.continuous_m if moves else design.nominal_height_m)


def test_held_out_scenes_have_obstructions_of_their_own() -> None:
    """Also where a training has the usual seed."""
    assert SCENE_SEED > 2**32  # no seed of a training is as large, nor that of the lesson about veil and gain
    for seed in range(3):
        streams = [np.random.default_rng(np.random.SeedSequence(s, spawn_key=(0, 1))) for s in (seed, SCENE_SEED)]
        assert streams[0].random() != streams[1].random()


@pytest.mark.parametrize(
    ("options", "depths"),
    [("{}", (6e-3, 9e-3)), ('{depth=["7 mm", "20 mm"]}', (9e-3,)), ('{depth="30 mm"}', (0.03, 0.03))],
)
def test_depths_that_a_network_is_told_of_are_those_of_its_scenes(options: str, depths: tuple[float, ...]) -> None:
    spec = small_spec(f"obstruction.options={options}", 'scene.near=["6 mm", "9 mm"]')
    assert trained_near_m(spec, obstruction_from_spec(spec, "small.toml")) == pytest.approx(depths)


def test_a_conventional_camera_has_a_flat_plate() -> None:
    one, other = (
        trainer(*PLAIN, 'train.camera="conventional"', height_m=height) for height in (heights(), 0 * heights())
    )
    assert alike(numbers(one.doe), numbers(other.doe))
    assert not alike(numbers(one.doe), numbers(trainer(*PLAIN, 'train.freeze="optics"').doe))


@pytest.mark.slow
def test_the_mean_of_weights_is_that_of_its_steps(tmp_path: Path) -> None:
    """By hand, in a checkpoint, and in what is looked at; the steps are those of a training without it."""
    still = (*PLAIN, *LEARNING, 'train.freeze="optics"')
    made, plain = trainer(*still, "train.average=0.6"), trainer(*still)
    state, bare = made.initial(heights()), plain.initial(heights())
    expected = numbers(state.network)
    assert bare.average is None
    assert bare.best is bare.network
    for step in range(6):
        state, _ = made.step(state, batch())
        bare, _ = plain.step(bare, batch())
        kept = min(0.6, (1 + step) / (10 + step))
        expected = [kept * a + (1 - kept) * b for a, b in zip(expected, numbers(state.network), strict=True)]
    assert alike(numbers(state.network), numbers(bare.network))
    assert state.average is not None
    for found, wanted in zip(numbers(state.best), expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-7)  # six means in single precision
    write_checkpoint(tmp_path / "checkpoint.npz", state, state.step, "owner")
    stored = read_checkpoint(tmp_path / "checkpoint.npz", made.initial(heights()), "owner")
    assert stored is not None
    assert alike(numbers(stored[0].average), numbers(state.average))
    _, shown = made.reconstruct(state, batch())
    _, by_hand = plain.reconstruct(bare._replace(network=state.average), batch())
    np.testing.assert_array_equal(shown, by_hand)


# --- what a step depends on ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_randomness_follows_from_seed_and_batch(joint: Trainer) -> None:
    def first(given: Batch, made: Trainer = joint) -> float:
        return made.step(made.initial(heights()), given)[1]["loss"]

    loss = first(batch())
    assert first(batch()) == loss
    # The same scene under another number has other noise.
    assert first(batch()._replace(step=5)) != loss
    # The seed is no part of what is compiled.
    seen = [made._seen(batch(), made.spec.train.seed, True) for made in (joint, trainer(*PLAIN, "train.seed=3"))]
    (here, keys), (there, other_keys) = seen
    assert not np.array_equal(jax.random.key_data(keys), jax.random.key_data(other_keys))
    assert not np.array_equal(here.far[0].sines, there.far[0].sines)


@pytest.mark.slow
def test_field_angles_stay_on_the_sensor(joint: Trainer) -> None:
    sines = [joint._seen(batch(step=k), 0, True)[0].far[0].sines[0] for k in range(200)]
    # 640 x 480 pixels of 1.85 um at 1 mm: angles (y, x) whose tangents are below half of that.
    most = np.array([240, 320]) * 1.85e-3
    tangents = np.abs(sines) / np.sqrt(1 - np.sum(np.square(sines), axis=1, keepdims=True))
    assert np.all(tangents < 1.05 * most)  # a sine is taken for its plane's, so a little more in the corner
    assert np.all(tangents.max(axis=0) > 0.9 * most)
    straight = joint._seen(batch(), 0, False)[0].far[0].sines
    np.testing.assert_array_equal(straight, 0)


def test_step_sizes() -> None:
    base = {"steps": 100, "learning_rate": 1.0, "optics_learning_rate": 2.0}
    cosine = [rates_at(TrainSpec(**base), step) for step in (0, 50, 100, 150)]
    assert cosine[0] == (1.0, 2.0)
    assert cosine[1] == pytest.approx((0.55, 1.1))  # half way from 1 to a tenth
    assert cosine[2] == cosine[3] == pytest.approx((0.1, 0.2))
    constant = {**base, "schedule": "constant"}
    assert rates_at(TrainSpec(**constant), 70) == (1.0, 2.0)
    turns = [rates_at(TrainSpec(**constant, mode="alternating", period=3), step) for step in range(6)]
    assert turns == [(1, 0), (1, 0), (0, 2)] * 2
    # With one of them at rest there are no turns to take.
    assert rates_at(TrainSpec(**constant, mode="alternating", freeze="optics"), 3) == (1, 0)
    assert rates_at(TrainSpec(**constant, mode="alternating", freeze="network"), 0) == (0, 2)


class Distance(eqx.Module):
    """A perceptual distance of nothing but a number."""

    value: jax.Array

    def __call__(self, picture: jax.Array, reference: jax.Array) -> jax.Array:
        return self.value + 0 * jnp.mean(picture - reference, axis=(1, 2, 3))


@pytest.mark.study
def test_errors_of_a_process_and_the_perceptual_term() -> None:
    changes = ("train.fabricated=true", "process.errors.overlay_y={sigma='0.5 um'}", "train.perceptual=0.5")
    made = trainer(*PLAIN, *changes, perceptual=Distance(jnp.float32(3)))
    state = made.initial(heights())
    with_errors = [made._with_errors(state, step) for step in (0, 0, 1)]
    optics: list[Any] = [each.doe.optic for each in with_errors]
    errors = [np.stack(list(one.deviation.values())) for one in optics]
    # Every step has errors of its own, which follow from its number.
    np.testing.assert_array_equal(errors[0], errors[1])
    assert np.mean(errors[0] != errors[2]) > 0.01
    _, line = made.step(state, batch())
    parts = line["parts"]
    assert parts["perceptual"] == 3
    assert line["loss"] == pytest.approx(parts["l1"] + parts["masked"] + 0.5 * 3, rel=1e-6)


@pytest.mark.study
@pytest.mark.parametrize("changes", [('train.precision="mixed"',), ("train.checkpointing=true",)])
def test_other_ways_to_the_same_loss(changes: tuple[str, ...]) -> None:
    """The whole network, Wiener blocks and all: half precision within 1 %, computing twice to the rounding."""
    same = [walk(trainer(*LEARNING, *more), 2)[1] for more in ((), changes)]
    # bfloat16 keeps 8 bits, and every pixel is a sum of dozens of products.
    np.testing.assert_allclose(same[1], same[0], rtol=1e-2 if "mixed" in changes[0] else 1e-4)


# --- what is refused -------------------------------------------------------------------------------------------------


def test_a_loss_that_is_not_finite_is_told(joint: Trainer) -> None:
    broken = batch()
    np.asarray(broken.items[0].scene.background)[1, 3, 3] = np.nan
    with pytest.raises(InputError, match=r"train, step 0.*must stay finite.*nan.*learning_rate"):
        joint.step(joint.initial(heights()), broken)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ((*COLOURS, 'sensor.bayer="RGGB"'), "sensor.bayer.*demosaicing has no gradient"),
        (("optimize.parametrization=radial", "train.field=random"), "train.field.*design of rings.*freeform"),
        (("optimize.parametrization=radial", "train.fabricated=true"), "train.fabricated.*design of rings"),
    ],
)
def test_what_cannot_be_trained(changes: tuple[str, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        trainer(*PLAIN, *changes)


def test_devices() -> None:
    assert devices_mesh(1) is None
    with pytest.raises(InputError, match="devices"):
        devices_mesh(len(jax.devices()) + 1)


def test_depths_of_a_plate_at_rest() -> None:
    found = resting_depths_m(small_spec("scene.far=['0.5 m', 'inf']"), Dirt(depth_m=(6e-3, 9e-3)))
    near = [depth for depth in found if depth <= 9e-3 * (1 + 1e-12)]
    np.testing.assert_allclose((min(near), max(near)), (6e-3, 9e-3))
    np.testing.assert_allclose(np.diff(np.sort(1 / np.array(near))), np.ptp(1 / np.array(near)) / (len(near) - 1))
    assert sorted(set(found) - set(near)) == [0.5, 1.0, np.inf]
