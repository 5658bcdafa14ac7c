"""Directions of light without a lens: a grating's orders and a square opening, against sums of their own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.optic import HeightOptic, RingOptic
from sim.propagation.hankel import ring_count
from sim.psf_bank import psf

WAVELENGTH, CELLS, PITCH = 532e-9, 96, 2e-6
PIXEL = float(np.sin(np.radians(0.1)))
_PARTS = 16


def camera_of(window: int, pixel: float = PIXEL) -> Camera:
    colour = Colour("green", (WAVELENGTH,), (1.0,))
    grid = Grid((CELLS, CELLS), PITCH)
    return Camera(grid, CELLS * PITCH, "fused_silica", (colour,), np.inf, pixel, window, distance_m=np.inf)


def summed(field: np.ndarray, camera: Camera, moved: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Energy of every pixel by a plain sum over square cells, in double precision, 16 directions to it and axis."""
    inside = (np.arange(_PARTS) + 0.5) / _PARTS - 0.5
    middle = (np.arange(camera.window) - (camera.window - 1) / 2)[:, None] + inside
    place = (np.arange(CELLS) - (CELLS - 1) / 2) * PITCH
    kernels = []
    for sine in moved:  # light that arrives at an angle leaves at it
        waves = (middle.ravel() * camera.pixel_m / camera.sensor_distance_m - sine) / WAVELENGTH
        kernels.append(np.exp(-2j * np.pi * waves[:, None] * place) * np.sinc(waves * PITCH)[:, None])
    scale = PITCH**2 / WAVELENGTH * camera.pixel_m / camera.sensor_distance_m / _PARTS
    light = np.abs(kernels[0] @ field @ kernels[1].T) ** 2 * scale**2
    light /= np.pi * camera.aperture_m**2 / 4
    return light.reshape(camera.window, _PARTS, camera.window, _PARTS).sum((1, 3)) * camera.transmission(WAVELENGTH)


@pytest.mark.parametrize("order", [1, 2, -3])
def test_a_grating_sends_an_order_to_its_angle(order: int):
    """A sawtooth of `order` waves per period of 24 cells: asin(order wavelength / period), to half a pixel."""
    camera, period = camera_of(81), 24
    wave = WAVELENGTH * camera.waves_per_metre(WAVELENGTH)  # waves per wavelength of height
    saw = np.mod(order * (np.arange(CELLS) + 0.5) / period, 1.0) * WAVELENGTH / wave
    optic = HeightOptic.of(camera, np.broadcast_to(saw, (CELLS, CELLS)).astype(np.float32))
    image = np.asarray(psf(optic).energy[0, 0])
    row, column = np.unravel_index(np.argmax(image), image.shape)
    assert row == 40
    angle, expected = (np.arcsin(s) for s in ((column - 40) * PIXEL, order * WAVELENGTH / (period * PITCH)))
    assert abs(angle - expected) <= PIXEL / 2 / np.cos(expected)
    field = np.asarray(optic.coverage, np.float64) * np.exp(2j * np.pi * camera.waves_per_metre(WAVELENGTH) * saw)
    assert np.linalg.norm(image - summed(field, camera)) < 3e-3 * np.linalg.norm(image)


def test_a_square_opening_has_a_sinc_squared_in_the_sine():
    """sinc²(side sin(angle) / wavelength) along both axes, integrated over pixels."""
    camera, side = camera_of(41, PIXEL / 2), 40
    coverage = np.zeros((CELLS, CELLS), np.float32)
    middle = slice((CELLS - side) // 2, (CELLS + side) // 2)
    coverage[middle, middle] = 1.0
    optic = HeightOptic(camera, jnp.asarray(coverage), jnp.zeros((CELLS, CELLS), jnp.float32))
    image = np.asarray(psf(optic).energy[0, 0])
    fine = (np.arange(41 * 20) - (41 * 20 - 1) / 2) * camera.pixel_m / 20
    wide = side * PITCH / WAVELENGTH
    axis = (np.sinc(fine * wide) ** 2).reshape(41, 20).mean(1) * camera.pixel_m * wide
    share = (side * PITCH) ** 2 / (np.pi * camera.aperture_m**2 / 4) * camera.transmission(WAVELENGTH)
    assert np.linalg.norm(image - np.outer(axis, axis) * share) < 3e-3 * np.linalg.norm(image)
    # The first dark place of 80 um at 532 nm is 0.381 degrees away.
    dark = np.degrees(np.arcsin((np.argmin(image[20, 20:32])) * camera.pixel_m))
    assert dark == pytest.approx(np.degrees(np.arcsin(WAVELENGTH / 80e-6)), abs=0.026)


def test_a_plan_that_was_made_in_a_trace_serves_later_ones():
    camera, flat = camera_of(32, 2 / 32), jnp.zeros((CELLS, CELLS), jnp.float32)
    traced = jax.jit(lambda height: psf(height, camera).energy)(flat)
    np.testing.assert_allclose(traced, psf(flat, camera).energy, rtol=1e-4, atol=1e-6)  # single precision


@pytest.mark.slow
def test_there_is_no_light_beyond_a_sine_of_one():
    """A window whose corners lie at 1.41, looked at straight and from an axis 20 degrees aslant."""
    camera, tilt = camera_of(40, 0.05), float(np.radians(20))
    height, open_ = np.zeros((2, CELLS, CELLS), np.float32)
    height[40:56, 40:56] = np.random.default_rng(0).uniform(0, 1.1e-6, (16, 16))
    open_[40:56, 40:56] = 1.0
    optic = HeightOptic(camera, jnp.asarray(open_), jnp.asarray(height))
    parts = (np.arange(40 * 50) + 0.5) / 1000 - 1
    straight = np.asarray(psf(optic).energy[0, 0])
    shares = (np.hypot(parts[:, None], parts) < 1).reshape(40, 50, 40, 50).mean((1, 3))
    assert np.all(straight[shares == 0] == 0)
    assert np.count_nonzero(shares == 0) > 100
    phase = 2j * np.pi * camera.waves_per_metre(WAVELENGTH) * height.astype(float)
    expected = summed(open_ * np.exp(phase), camera) * shares
    assert straight == pytest.approx(expected, rel=0.02, abs=3e-3 * expected.max())
    edge = (shares > 0.2) & (shares < 0.8)
    assert straight[edge].sum() == pytest.approx(expected[edge].sum(), rel=0.05)
    rings = psf(RingOptic(camera, jnp.zeros(ring_count(camera)))).energy[0, 0]
    assert np.array_equal(np.asarray(rings) == 0, shares == 0)
    aslant = np.asarray(psf(optic, field_rad=(0.0, tilt)).energy[0, 0])
    beyond = np.hypot(parts[:, None], parts + np.sin(tilt)).reshape(40, 50, 40, 50).min((1, 3)) > 1
    assert np.all(aslant[beyond] == 0)
    assert np.count_nonzero(beyond) > 300
    assert np.all(aslant[~beyond & (shares > 0.1)] > 0)


def test_a_source_at_a_depth_is_spread_over_the_sine_of_the_aperture():
    """The opening as seen from a point 5 mm before it, with nothing to gather its light."""
    camera = camera_of(61)
    image = np.asarray(psf(HeightOptic.of(camera), depths=5e-3).energy[0, 0])
    sines = (np.arange(61) - 30) * PIXEL
    inside = np.hypot(sines[:, None], sines) < camera.defocus_radius_m(5e-3) + 2 * PIXEL
    assert camera.defocus_radius_m(5e-3) == pytest.approx(96e-6 / 5e-3)
    assert image[inside].sum() > 0.93 * image.sum()
    assert image[30, 30] < 0.03
