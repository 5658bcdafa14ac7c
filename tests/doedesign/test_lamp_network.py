"""The network for lamps: its veil against a plain convolution, what it is shown, a training that goes on."""

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import convolve

from doedesign.hdr.capture import LampCapture
from doedesign.hdr.learning import (
    LAMP_NETWORK_NAME,
    LampExamples,
    LampTraining,
    lamp_losses,
    read_lamp_network,
    trained_lamp_network,
    turned,
    write_lamp_network,
)
from doedesign.hdr.network import (
    LampNetwork,
    LampView,
    Veil,
    compressed_light,
    light_of_compressed,
    refined,
    viewed,
)
from doedesign.hdr.scores import compressed
from fab.archive import read_archive, write_archive
from fab.errors import InputError

SIDE = 32


def spots(strength: float = 0.02) -> np.ndarray:
    """PSFs `[c, y, x]` of a sharp spot and two copies, which lie farther out in every next colour."""
    found = np.zeros((3, 45, 45), np.float32)
    for c in range(3):
        found[c, 22, 22] = 1 - 2 * strength
        found[c, 22 + 2, 22 + 18 + c] = strength
        found[c, 22 - 17 - c, 22 + 5] = strength
    return found


def captured(rng: np.random.Generator, kernel: np.ndarray, shape: tuple[int, int] = (SIDE, SIDE)) -> tuple:
    """A capture of a lamp of 4 x 4 pixels before a calm background, the light of the scene, and a guess of it."""
    light = rng.uniform(0.2, 0.4, (3, *shape))
    y, x = (int(rng.integers(4, n - 8)) for n in shape)
    light[:, y : y + 4, x : x + 4] = rng.uniform(30, 150, (3, 1, 1))
    seen = np.stack([convolve(one, k, mode="same") for one, k in zip(light, kernel, strict=True)])
    capture = LampCapture(np.minimum(seen, 1.25).astype(np.float32), seen >= 1.25)
    return capture, light.astype(np.float32), np.where(capture.full, 80.0, capture.light).astype(np.float32)


def test_the_veil_is_a_convolution():
    rng, kernel = np.random.default_rng(1), spots()
    light = rng.uniform(0, 1, (20, 24, 3)).astype(np.float32)
    found = np.asarray(Veil.of(kernel, (20, 24)).spread(jnp.asarray(light)))
    for c in range(3):
        whole = convolve(light[..., c], kernel[c])[22 : 22 + 20, 22 : 22 + 24]
        # Single precision of sums over 45 x 45 pixels.
        assert found[..., c] == pytest.approx(whole / kernel[c, 22, 22], abs=1e-5)


def test_the_veil_has_its_adjoint():
    rng, veil = np.random.default_rng(2), Veil.of(spots(), (20, 24))
    a, b = (jnp.asarray(rng.uniform(0, 1, (20, 24, 3)).astype(np.float32)) for _ in range(2))
    assert float(jnp.vdot(veil.spread(a), b)) == pytest.approx(
        float(jnp.vdot(a, veil.spread(b, turned=True))), rel=1e-5
    )


@pytest.mark.parametrize("way", range(8))
def test_turned_light_is_spread_by_the_turned_psf(way: int):
    rng, kernel = np.random.default_rng(3), spots()
    light = rng.uniform(0, 1, (20, 20, 3)).astype(np.float32)
    straight = np.asarray(Veil.of(kernel, (20, 20)).spread(jnp.asarray(light)))
    other = Veil.of(turned(kernel, way, (1, 2)), (20, 20)).spread(jnp.asarray(turned(light, way, (0, 1)).copy()))
    assert np.asarray(other) == pytest.approx(turned(straight, way, (0, 1)), abs=1e-5)


def test_evidence_is_the_light_that_falls_on_pixels_that_are_seen():
    kernel = spots(0.02)
    full = np.zeros((3, SIDE, SIDE), bool)
    full[:, 20, 4] = True
    full[:, 22, 22] = True  # the first copy of the first colour falls on it
    capture = LampCapture(np.where(full, np.float32(1.25), np.float32(0.3)), full)
    view = viewed(capture, np.where(full, np.float32(80), np.float32(0.3)), kernel)
    assert view.evidence[20, 4] == pytest.approx([0.4, 0.8, 0.8, 0.4, 0.8, 0.8], abs=1e-4)
    assert view.full.shape == view.light.shape == (SIDE, SIDE, 3)
    with pytest.raises(ValueError, match="shapes"):
        viewed(capture, capture.light[:, :20], kernel)


def test_the_scale_is_that_of_the_scores():
    light = np.array([[[0.0, 1.0, 60.0, 200.0]]])
    assert np.asarray(compressed_light(jnp.asarray(light))) == pytest.approx(compressed(light, 200.0), abs=1e-6)
    assert np.asarray(light_of_compressed(compressed_light(jnp.asarray(light)))) == pytest.approx(light, rel=1e-4)


def test_a_new_network_hands_the_estimate_on():
    rng, kernel = np.random.default_rng(4), spots()
    capture, light, _ = captured(rng, kernel, (30, 37))
    found = refined(LampNetwork.make(1, width=8), capture, light, kernel)
    assert found.shape == light.shape
    # Its answers begin near nothing, not at it.
    assert compressed(found, 200.0) == pytest.approx(compressed(light, 200.0), abs=0.05)


def test_what_is_left_of_copies_says_what_is_missing():
    """Lamps found half as bright as they are lack once what was found; its arsinh is shown. Right ones lack nothing."""
    kernel = spots(0.004)
    capture, light, _ = captured(np.random.default_rng(9), kernel, (64, 64))
    half = np.where(capture.full, light / 2, light)
    veil = np.stack([convolve(light[c] * capture.full[c] / 2, kernel[c], mode="same") for c in range(3)])
    half = np.where(capture.full, half, half + veil).astype(np.float32)
    lamp = np.moveaxis(light, 0, -1) > 1.25
    dim, right = (viewed(capture, found, kernel).left for found in (half, light))
    # Noise of the background, 0.06, over two copies of 0.004 of lamps of 30 to 150: a tenth or two.
    assert dim[lamp].mean() == pytest.approx(np.arcsinh(1), abs=0.1)
    assert right[lamp].mean() == pytest.approx(0, abs=0.1)
    assert not viewed(capture, light, kernel).left[~np.moveaxis(capture.full, 0, -1)].any()


def test_sides_that_cannot_be_halved_are_refused():
    view = LampView(*(np.zeros((1, 30, 32, n), np.float32) for n in (3, 3, 3, 6, 3)))
    with pytest.raises(ValueError, match="multiples of 8"):
        LampNetwork.make(0, width=8)(view, Veil.of(spots(), (30, 32)))


HOW = LampTraining(steps=6, batch=2, examples=4, rate=5e-3, width=8, checkpoint_every=2)


def examples() -> LampExamples:
    """Four scenes."""
    rng, kernel, made = np.random.default_rng(6), spots(), []
    for _ in range(4):
        capture, light, guess = captured(rng, kernel)
        made.append((viewed(capture, guess, kernel), np.moveaxis(light, 0, -1)))
    view = LampView(*(np.stack(one) for one in zip(*(each for each, _ in made), strict=True)))
    truth = np.stack([light for _, light in made])
    return LampExamples(view, truth, (truth > 1.25).astype(np.float32))


@pytest.mark.slow
def test_a_training_goes_on_where_it_was_stopped(tmp_path: Path):
    kernel, settings = spots(), {"camera": "plate"}
    told: list[float] = []

    def stopping(step: int, loss: float) -> None:
        if step == 5:
            raise KeyboardInterrupt

    whole = trained_lamp_network(tmp_path / "a", examples, kernel, HOW, settings, lambda _, loss: told.append(loss))
    with pytest.raises(KeyboardInterrupt):
        trained_lamp_network(tmp_path / "b", examples, kernel, HOW, settings, stopping)
    assert (tmp_path / "b" / "checkpoint.npz").is_file()
    trained_lamp_network(tmp_path / "b", lambda: pytest.fail("made again"), kernel, HOW, settings)
    first, second = (tmp_path / name / LAMP_NETWORK_NAME for name in "ab")
    assert first.read_bytes() == second.read_bytes()
    assert told[-1] < told[0]
    # It has learnt, and what is read back is what was written.
    batch, veil = examples(), Veil.of(kernel, (SIDE, SIDE))
    losses = [
        float(np.mean(lamp_losses(net, batch, veil)[0]))
        for net in (LampNetwork.make(0, width=8), whole, read_lamp_network(first)[0])
    ]
    assert losses[1] < losses[0]
    assert losses[1] == losses[2]
    # A kill after the network and before the end leaves a checkpoint, which the next call removes.
    (tmp_path / "a" / "checkpoint.npz").touch()
    trained_lamp_network(tmp_path / "a", lambda: pytest.fail("made again"), kernel, HOW, settings)
    assert not (tmp_path / "a" / "checkpoint.npz").exists()
    with pytest.raises(InputError, match="settings"):
        trained_lamp_network(tmp_path / "a", examples, kernel, replace(HOW, seed=1), settings)


@pytest.mark.parametrize("wrong", [{"steps": 0}, {"rate": -1.0}, {"batch": 5, "examples": 4}])
def test_a_training_of_no_use_is_refused(wrong: dict):
    with pytest.raises(InputError):
        replace(HOW, **wrong)


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"layout": None}, "the layout must be one that this version knows"),
        ({"layout": {"colours": 3}}, "the layout must be one that this version knows"),
        ({"layout": {"colours": 3, "width": "4"}}, "the layout must be one that this version knows"),
        ({"layout": {"colours": 3, "width": 0}}, "the layout must be one that this version knows"),
        ({"layout": {"colours": 3, "width": 500}}, "the layout must be one that this version knows"),
        ({"about": "a plate"}, "must say what it is about"),
        ({"format": "doedesign network 1"}, "must be of format"),
    ],
)
def test_a_file_that_is_no_network_for_lamps_is_refused(tmp_path: Path, said: dict, words: str):
    """None of them is made first: one of width 3000 took twelve gigabytes."""
    path = tmp_path / LAMP_NETWORK_NAME
    write_lamp_network(path, LampNetwork.make(0, width=4), {"owner": "nobody"})
    assert read_lamp_network(path)[0].width == 4
    header, arrays = read_archive(path, "network", "")
    write_archive(path, {**header, **said}, arrays)
    with pytest.raises(InputError, match=words):
        read_lamp_network(path)
