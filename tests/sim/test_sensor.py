"""The sensor: counts against photons, saturation, bits, colours behind a mosaic, and the way back to light."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim.sensor import Sensor, demosaiced, developed, expose, mosaic

KEY = jax.random.key(0)
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")


def flat(light: float, colours: int = 3, side: int = 256) -> jax.Array:
    return jnp.full((colours, side, side), light, jnp.float32)


@pytest.mark.parametrize("light", [0.0, 1e-3, 0.1, 1.0])
def test_mean_and_variance_against_photons(light: float):
    """Raw = black + electrons / step; variance = (photons QE + dark + read^2) / step^2 + 1/12 of the rounding."""
    sensor = Sensor(full_well_e=8000, exposure=0.75, quantum_efficiency=(0.5,), read_noise_e=4, dark_e=10)
    sensor = dataclasses.replace(sensor, black_level=64, bits=12)
    raw = np.asarray(expose(flat(light), sensor, KEY), np.float64)
    step = 8000 / (4095 - 64)
    photons = 12000 * light  # 0.75 x 8000 electrons / 0.5
    electrons = photons * 0.5 + 10
    variance = (electrons + 16) / step**2 + 1 / 12
    # Five standard errors over 3 x 256^2 pixels.
    assert abs(raw.mean() - (64 + electrons / step)) < 5 * np.sqrt(variance / raw.size)
    assert raw.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / raw.size))


def test_colours_differ_by_their_quantum_efficiency():
    sensor = Sensor(full_well_e=1e5, exposure=0.5, quantum_efficiency=(0.3, 0.6, 0.4), read_noise_e=0, bits=None)
    assert sensor.white_photons == pytest.approx(1e5 * 0.5 / 0.6)
    assert sensor.white_e(3).ravel() == pytest.approx([25000, 50000, 100000 / 3])
    raw = np.asarray(expose(flat(1.0), sensor, KEY))
    share = (raw.mean(axis=(1, 2)) - sensor.zero_raw) / np.asarray(sensor.white_raw(3)).ravel()
    assert share == pytest.approx([1, 1, 1], abs=5 / np.sqrt(25000) / 256)  # five standard errors of the dimmest
    light = np.asarray(developed(raw, sensor))
    assert light.std(axis=(1, 2)) == pytest.approx(1 / np.sqrt(sensor.white_e(3).ravel()), rel=0.02)


def test_the_brightest_light_fills_the_full_well_of_the_dimmest_colour():
    sensor = Sensor(full_well_e=1000, exposure=0.5, quantum_efficiency=(0.3, 0.6), dark_e=10, black_level=64)
    # White is 250 and 500 electrons, and 10 of 1000 are there in the dark.
    assert sensor.most_light(2) == pytest.approx(990 / 250, rel=1e-6)
    lights = np.array([0.99, 1.01]) * sensor.most_light(2)
    none = dataclasses.replace(sensor, noise="none")
    first, second = (np.asarray(expose(flat(light, 2, 1), none, KEY))[0, 0, 0] for light in lights.tolist())
    assert first < sensor.top == second
    # White is full scale where electrons are not counted.
    assert Sensor(noise="tseng", exposure=0.5).most_light(3) == pytest.approx(1)


def test_saturation_and_bits():
    sensor = Sensor(full_well_e=1000, exposure=1.0, read_noise_e=0, bits=8)
    raw = np.asarray(expose(flat(3.0), sensor, KEY))
    assert np.all(raw == 255)
    ramp = jnp.linspace(0, 1, 4096).reshape(1, 64, 64)
    for bits in (1, 4, 10):
        raw = np.asarray(expose(ramp, dataclasses.replace(sensor, bits=bits, noise="none"), KEY))
        assert np.array_equal(np.unique(raw), np.arange(2**bits))
    smooth = np.asarray(expose(ramp, dataclasses.replace(sensor, bits=None, noise="none"), KEY))
    assert smooth == pytest.approx(np.asarray(ramp), abs=1e-6)


def test_the_black_level_keeps_what_the_read_noise_takes_below():
    light = flat(0.0)
    kept = np.asarray(developed(expose(light, Sensor(read_noise_e=8, black_level=64), KEY), Sensor(black_level=64)))
    none = Sensor(read_noise_e=8, black_level=0)
    cut = np.asarray(developed(expose(light, none, KEY), none))
    deviation = 8 / 8000
    assert abs(kept.mean()) < 5 * deviation / np.sqrt(kept.size)
    assert cut.mean() == pytest.approx(deviation / np.sqrt(2 * np.pi), rel=0.02)  # half a Gaussian


def test_the_usual_black_level_leaves_darkness_and_its_noise_alone():
    """Without one, noise of 2.5 electrons lifts darkness by a third of a raw number and hides 60 % of its variance."""
    dark = {level: np.asarray(expose(flat(0.0), Sensor(black_level=level), KEY), np.float64) for level in (None, 0.0)}
    noise = np.hypot(2.5 / (10000 / (4095 - 64)), np.sqrt(1 / 12))  # raw numbers, rounding included
    assert dark[None].mean() == pytest.approx(64, abs=5 * noise / np.sqrt(dark[None].size))
    assert dark[None].std() == pytest.approx(noise, rel=0.02)
    assert dark[0.0].mean() == pytest.approx(0.31, abs=0.1)
    assert dark[0.0].var() < 0.5 * dark[None].var()


@pytest.mark.parametrize(
    ("bits", "noise", "black"),
    [
        (8, "physical", 4),
        (10, "physical", 16),
        (12, "physical", 64),
        (14, "physical", 256),
        (5, "physical", 0),
        (None, "physical", 1 / 64),
        (12, "none", 0),
        (12, "tseng", 0),
    ],
)
def test_the_usual_black_level_is_a_64th_where_electrons_have_noise(bits: int | None, noise: Any, black: float):
    sensor = Sensor(bits=bits, noise=noise)
    assert sensor.zero_raw == black
    assert dataclasses.replace(sensor, black_level=3 * black / 2).zero_raw == 3 * black / 2


@pytest.mark.parametrize(
    ("noise", "variance"),
    [("tseng", lambda x: 4e-5 * x + 1e-10), ("release", lambda x: 0.008**2 / 3), ("none", lambda x: 0.0)],
)
def test_named_noise(noise, variance):
    sensor = Sensor(noise=noise, bits=None, exposure=1.0)
    got = np.asarray(developed(expose(flat(0.4), sensor, KEY), sensor), np.float64)
    assert got.mean() == pytest.approx(0.4, abs=1e-4)  # five standard errors of the widest, 0.0046 / 443
    assert got.var() == pytest.approx(variance(0.4), rel=0.02, abs=1e-12)
    bright = np.asarray(expose(flat(2.0), sensor, KEY))
    assert bright.max() <= 1.0


def test_same_seed_same_bytes():
    first, again = (np.asarray(expose(flat(0.3), Sensor(), jax.random.key(7))) for _ in range(2))
    assert first.tobytes() == again.tobytes()
    assert first.tobytes() != np.asarray(expose(flat(0.3), Sensor(), jax.random.key(8))).tobytes()


def test_gradients_pass_where_the_sensor_still_answers():
    sensor = Sensor(full_well_e=1000, exposure=1.0, read_noise_e=1.0, bits=12)
    light = jnp.asarray([0.2, 0.7, 5.0]).reshape(1, 1, 3)
    slope = jax.grad(lambda x: jnp.sum(expose(x, sensor, KEY)))(light).ravel()
    # Steps per unit of light, 4095, and the change of the noise, 1 / (2 sqrt(electrons)) deviations, up to five.
    assert slope[:2] == pytest.approx([4095, 4095], rel=5 / (2 * np.sqrt(200)))
    assert slope[2] == 0


def test_gradient_of_a_capture_against_finite_differences():
    """With a fixed key and no rounding; over 256^2 pixels the steps of single electrons average out."""
    sensor = Sensor(read_noise_e=2.0, bits=None)
    picture = jnp.asarray(np.random.default_rng(1).uniform(0.2, 0.9, (3, 256, 256)), jnp.float32)

    @jax.jit
    def total(gain):
        return jnp.mean(developed(expose(gain * picture, sensor, KEY), sensor) ** 2)

    slope = float(jax.grad(total)(1.0))
    assert float(total(1.02) - total(0.98)) / 0.04 == pytest.approx(
        slope, rel=1e-3
    )  # single electrons: 1 / 443 / 8000 / 0.04


@pytest.mark.parametrize("pattern", PATTERNS)
def test_the_pattern_names_the_upper_left_photosites(pattern):
    red, green, blue = 0.25, 0.5, 1.0
    colours = jnp.asarray([red, green, blue])[:, None, None] * jnp.ones((3, 6, 5))
    seen = np.asarray(mosaic(colours, pattern))[0]
    named = dict(zip("RGB", (red, green, blue), strict=True))
    top = seen[::-1]  # row 0 is the lowest
    assert [top[0, 0], top[0, 1], top[1, 0], top[1, 1]] == [named[letter] for letter in pattern]
    assert np.array_equal(top[:2, :4], top[2:4, :4])


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("interpolation", ["bilinear", "malvar2004", "menon2007"])
def test_uniform_colours_come_back_through_the_mosaic(pattern, interpolation):
    pytest.importorskip("colour_demosaicing", reason="the extra [bayer] is not installed")
    sensor = Sensor(
        quantum_efficiency=(0.3, 0.6, 0.5), black_level=64, dark_e=3, bits=14, pattern=pattern, noise="none"
    )
    light = jnp.asarray([0.2, 0.5, 0.8])[:, None, None] * jnp.ones((3, 16, 12))
    raw = expose(light, sensor, KEY)
    assert raw.shape == (1, 16, 12)
    got = np.asarray(developed(demosaiced(raw, sensor, interpolation), sensor))
    # Half a step of 14 bits in the dimmest colour; at the frame's edge the filters of Malvar mirror to other colours.
    inside = (slice(None), slice(4, -4), slice(4, -4))
    assert got[inside] == pytest.approx(np.asarray(light)[inside], abs=4e-4)


def test_what_the_mosaic_saw_is_kept():
    pytest.importorskip("colour_demosaicing", reason="the extra [bayer] is not installed")
    sensor = Sensor(pattern="RGGB", quantum_efficiency=(0.4, 0.6, 0.5))
    picture = jnp.asarray(np.random.default_rng(2).uniform(0, 0.5, (3, 8, 10)), jnp.float32)
    raw = np.asarray(expose(picture, sensor, KEY))
    full = demosaiced(raw, sensor)
    again = np.asarray(mosaic(jnp.asarray(full), "RGGB"))
    assert again == pytest.approx(raw, rel=1e-5)


def test_what_cannot_be_a_sensor():
    mistakes: tuple[dict[str, Any], ...] = (
        {"full_well_e": 0.0},
        {"exposure": -1.0},
        {"read_noise_e": float("nan")},
        {"quantum_efficiency": (1.2,)},
        {"bits": 40},
        {"black_level": 4095.0},
        {"noise": "loud"},
        {"pattern": "RGBG"},
    )
    for wrong in mistakes:
        (name,) = wrong
        # In tests the annotations are checked first, which refuses the two unknown names.
        with pytest.raises((ValueError, TypeError), match=name):
            Sensor(**wrong)
    with pytest.raises(ValueError, match="`dark_e` must lie below the full well, 10000, but got 10000"):
        Sensor(dark_e=10000.0)
    with pytest.raises(ValueError, match="quantum_efficiency"):
        Sensor(quantum_efficiency=(0.3, 0.4)).white_e(3)
    with pytest.raises(ValueError, match="red, green and blue"):
        mosaic(flat(1.0, colours=1), "RGGB")
    with pytest.raises(ValueError, match="mosaic"):
        demosaiced(np.zeros((1, 4, 4)), Sensor())
