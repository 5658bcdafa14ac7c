"""Leaked and diffracted light: how they are told apart, and that nothing is lost between them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from bench.reference import relative_error
from fab.grid import Grid
from fab.levels import Levels, height_of
from fab.process import Process, Variation
from sim.camera import Camera, Colour
from sim.metrics import mean_transmission, strehl, zeroth_order
from sim.optic import HeightOptic
from sim.psf_bank import psf
from sim.surface import FabricatedDoe, as_fabricated
from sim.surface.leakage import SplitPsf, split_psf

PITCH_M = 2e-6
CELLS = 48
FOCAL_M = 0.4e-3
LEVELS = Levels(16, 75e-9)
GREEN = Colour("green", (520e-9, 550e-9), (0.4, 0.6))
BAND_M = 520e-9 * FOCAL_M / PITCH_M  # of the cells of this DOE, on the sensor
# Two bands in 60 pixels each, so that little of the light misses the sensor.
CAMERA = Camera(Grid((CELLS, CELLS), PITCH_M), CELLS * PITCH_M, "fused_silica", (GREEN,), FOCAL_M, BAND_M / 30, 60)
DEPTH_M = 4e-3


@pytest.fixture(scope="module")
def level() -> np.ndarray:
    return np.random.default_rng(8).integers(3, 13, (CELLS, CELLS)).astype(np.uint8)


@pytest.fixture(scope="module")
def nominal(level: np.ndarray) -> FabricatedDoe:
    return as_fabricated(level, CAMERA, Process(LEVELS), Variation())


@pytest.fixture(scope="module")
def plate(level: np.ndarray) -> FabricatedDoe:
    return as_fabricated(
        level, CAMERA, Process(LEVELS), Variation(depth_scale=(0.02, -0.04, 0.03, 0.05)), depths_m=(DEPTH_M,)
    )


@pytest.fixture(scope="module")
def split(plate: FabricatedDoe) -> SplitPsf:
    return split_psf(plate, DEPTH_M, GREEN)


def test_the_mean_is_weighted_by_the_open_share_of_every_cell(plate: FabricatedDoe):
    weights = np.asarray(plate.coverage, float)
    values = np.asarray(plate.means, complex)
    mean = (values * weights).sum(axis=(1, 2)) / weights.sum()
    np.testing.assert_allclose(mean_transmission(plate), mean, rtol=1e-12)
    np.testing.assert_allclose(zeroth_order(plate), np.abs(mean) ** 2, rtol=1e-12)


def test_the_zeroth_order_of_a_plate_as_drawn_is_that_of_its_height_map(level: np.ndarray, nominal: FabricatedDoe):
    height = height_of(level, LEVELS)
    np.testing.assert_array_equal(zeroth_order(nominal), zeroth_order(HeightOptic.of(CAMERA, height)))


def test_a_flat_plate_leaks_everything(nominal: FabricatedDoe):
    even = jnp.full_like(nominal.transmission, jnp.exp(0.7j))
    flat = dataclasses.replace(nominal, transmission=nominal.coverage * even, means=even, height_m=None)
    np.testing.assert_allclose(zeroth_order(flat), 1.0, atol=1e-6)  # float32
    parts = split_psf(flat, DEPTH_M, GREEN)
    assert parts.diffracted.sum() < 1e-9
    assert relative_error(parts.leaked, parts.total.astype(np.float64)) < 1e-6


def test_strehl_is_the_overlap_with_the_plate_as_drawn(nominal: FabricatedDoe, plate: FabricatedDoe):
    np.testing.assert_allclose(strehl(nominal, nominal), 1.0, atol=1e-5)  # `cis` is good to 4e-6
    weights = np.asarray(plate.coverage, float)
    wrong = np.asarray(plate.means, complex) * np.conj(np.asarray(nominal.means, complex))
    overlap = np.abs((wrong * weights).sum(axis=(1, 2)) / weights.sum()) ** 2
    np.testing.assert_allclose(strehl(plate, nominal), overlap, rtol=1e-6)
    assert (overlap < 0.999).all()


def test_strehl_of_a_plate_in_half_cells(nominal: FabricatedDoe, plate: FabricatedDoe):
    """Every cell of the plate as drawn stands for the two by two halves of it."""

    def halved(values: jnp.ndarray) -> jnp.ndarray:
        return jnp.repeat(jnp.repeat(values, 2, axis=-2), 2, axis=-1)

    halves = dataclasses.replace(
        plate,
        transmission=halved(plate.transmission),
        means=halved(plate.means),
        coverage=halved(plate.coverage),
        camera=dataclasses.replace(CAMERA, grid=Grid((2 * CELLS, 2 * CELLS), PITCH_M / 2)),
    )
    np.testing.assert_allclose(strehl(halves, nominal), strehl(plate, nominal), rtol=1e-6)


def test_the_parts_belong_to_the_psf_of_the_bank(plate: FabricatedDoe, split: SplitPsf):
    bank = psf(plate, depths=[DEPTH_M]).energy[0, 0]
    np.testing.assert_array_equal(split.total, bank)
    assert relative_error(split.leaked + split.diffracted + split.interference, bank.astype(np.float64)) < 1e-6


def test_what_leaks_is_the_zeroth_order_of_the_bare_lens(plate: FabricatedDoe, split: SplitPsf):
    orders = zeroth_order(plate)
    bare = np.zeros_like(split.leaked, float)
    for i, line in enumerate(GREEN.wavelengths_m):
        own = dataclasses.replace(CAMERA, colours=(Colour("one", (line,), (1.0,)),))
        flat = psf(np.zeros((CELLS, CELLS)), own, [DEPTH_M]).energy[0, 0]
        bare += GREEN.weights[i] * orders[i] * flat
    assert relative_error(split.leaked, bare) < 1e-5  # float32 and `cis`


def test_interference_comes_to_nothing_over_a_wide_sensor(split: SplitPsf):
    """The two fields are orthogonal over the aperture, so their powers add up, though not in any one pixel."""
    total = split.total.sum(dtype=float)
    # What is left is the light beyond the sensor, and that edge cells count by their share, not by its square.
    assert abs(split.interference.sum(dtype=float)) < 3e-3 * total
    assert np.abs(split.interference).sum() > 0.02 * total


def test_interference_stays_within_what_two_fields_can_do(split: SplitPsf):
    assert split.excess() < 1e-6  # float32
    # A leaked part that is not the plate's own goes beyond it.
    foreign = split._replace(leaked=0.2 * split.leaked)
    assert foreign.excess() > 1e-3


def test_excess_by_hand():
    """Twice the root of 4 times 9 is 12, of 13 that interfere; where light is less than none, nothing may."""
    leaked, diffracted = np.array([[4.0, 0.5]]), np.array([[9.0, -0.01]])
    split = SplitPsf(leaked + diffracted + np.array([[-13.0, 0.02]]), leaked, diffracted)
    # Of the brightest pixel, which has 0.51.
    assert split.excess() == pytest.approx(1 / 0.51)
    assert split._replace(total=leaked + diffracted + np.array([[12.0, 0.5]])).excess() == pytest.approx(0.5 / 25)
