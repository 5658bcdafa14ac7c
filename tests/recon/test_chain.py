"""The optics of a training step: the PSFs of a plate that learns are those of the banks, and they have its gradient."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doedesign.design.levels.quantisation import CONTINUOUS, ROUNDED
from doedesign.training.joint import Trainer
from doedesign.training.optics import TrainingDoe, shots
from sim.optic import HeightOptic, RingOptic
from sim.propagation.hankel import revolve, ring_count
from sim.psf_bank import BankOptic, PsfBank, psf
from tests.recon.small_training import batch, heights, trainer

AXIS, ASIDE = (0.0, 0.0), (0.2, -0.1)
NEAR_M, FAR_M = 6e-3, 0.6
PLACES = [(NEAR_M, AXIS), (FAR_M, AXIS), (NEAR_M, ASIDE), (FAR_M, ASIDE)]


@eqx.filter_jit
def psf_of(plate: Any, free: Any, rounding: Any, source: Any) -> jax.Array:
    return plate.psf(free, rounding, source)


def live(*changes: str) -> tuple[Trainer, TrainingDoe]:
    """A plate whose heights are not rounded."""
    made = trainer("optimize.quantisation=none", *changes)
    assert isinstance(made.doe.optic, HeightOptic)
    return made, made.doe


def radians_of(plate: TrainingDoe, height_m: np.ndarray) -> jax.Array:
    return jnp.asarray(plate.learning.radians_of(height_m))


def difference(found: jax.Array, wanted: np.ndarray) -> float:
    return float(np.linalg.norm(np.asarray(found) - wanted) / np.linalg.norm(wanted))


# --- a plate that learns ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("depth_m", "field_rad"), PLACES)
def test_a_live_plate_has_the_psf_of_the_bank(depth_m: float, field_rad: tuple[float, float]) -> None:
    made, plate = live("optimize.sampling=exact")
    found = psf_of(plate, radians_of(plate, heights()), CONTINUOUS, plate.sources(depth_m, field_rad))
    wanted = psf(heights(), made.bench.camera, (depth_m,), field_rad=field_rad).energy[:, 0]
    # The bank's cells send light about the direction in which it leaves them, those of a step about the axis (see
    # `sim.propagation.farfield`): so near 1 % of the PSF. Far away single precision is left, for waves up to a hundred.
    assert difference(found, wanted) < (0.012 if depth_m == NEAR_M else 2e-4)


@pytest.mark.parametrize(("depth_m", "field_rad"), PLACES)
def test_sparse_sampling_keeps_the_energy(depth_m: float, field_rad: tuple[float, float]) -> None:
    """One sample per lambda d / D: single pixels are off, which is what it costs, sums over the window are not."""
    made, plate = live("optimize.sampling=sparse")
    found = psf_of(plate, radians_of(plate, heights()), CONTINUOUS, plate.sources(depth_m, field_rad))
    wanted = psf(heights(), made.bench.camera, (depth_m,), field_rad=field_rad).energy[:, 0]
    # The window's edge may pass between two samples: a row or column of 33 more or less, of a thirtieth of the energy.
    np.testing.assert_allclose(np.asarray(found).sum(), wanted.sum(), rtol=0.03)
    assert difference(found, wanted) < 0.5


def test_a_live_plate_is_quantised_as_it_will_be_drawn() -> None:
    made, plate = live("optimize.sampling=exact")
    free = radians_of(plate, heights())
    drawn = plate.learning.level(plate.learning.continuous_m(free)) * plate.learning.levels.step_m
    wanted = psf(np.asarray(drawn), made.bench.camera, (FAR_M,)).energy[:, 0]
    found = psf_of(plate, free, ROUNDED, plate.sources(FAR_M))
    assert difference(found, wanted) < 2e-4  # as above
    smooth = psf_of(plate, free, CONTINUOUS, plate.sources(FAR_M))
    assert difference(smooth, wanted) > 0.1


def test_errors_of_nothing_change_nothing() -> None:
    _, plate = live()
    free, rounding, source = radians_of(plate, heights()), ROUNDED, plate.sources(NEAR_M)
    ones = {line.wavelength_m: jnp.ones((96, 96), jnp.complex64) for line in plate.optic.lines}
    none = eqx.tree_at(lambda p: p.optic.deviation, plate, ones, is_leaf=lambda x: x is None)
    # A product with one is exact; the compiler may round the two programs' sums apart.
    assert difference(psf_of(none, free, rounding, source), np.asarray(psf_of(plate, free, rounding, source))) < 1e-5


# --- rings -----------------------------------------------------------------------------------------------------------


def test_rings_have_the_psf_of_their_bank() -> None:
    made = trainer("optimize.parametrization=radial", "optimize.quantisation=none")
    plate, camera = made.doe, made.bench.camera
    assert isinstance(plate.optic, RingOptic)
    profile = heights()[0].repeat(2)[: ring_count(camera)]
    source = plate.sources(FAR_M)
    found = psf_of(plate, radians_of(plate, profile), CONTINUOUS, source)
    wanted = psf(RingOptic(camera, jnp.asarray(profile)), depths=(FAR_M,)).energy[:, 0]
    assert difference(found, wanted) < 1e-4  # the same transform, compiled in another program
    # Drawn as squares, the same rings make nearly the same picture: this is the plate that was meant.
    drawn = psf(revolve(profile, camera.grid), camera, (FAR_M,)).energy[:, 0]
    assert np.corrcoef(np.asarray(found).ravel(), drawn.ravel())[0, 1] > 0.9
    with pytest.raises(ValueError, match="must be \\(0, 0\\) for rings"):
        plate.sources(FAR_M, ASIDE)


# --- a plate at rest -------------------------------------------------------------------------------------------------


def test_a_stored_plate_gives_its_bank_back_and_mixes_between() -> None:
    rng = np.random.default_rng(0)
    depths = (0.1, 0.6, np.inf, 0.2)
    bank = PsfBank(rng.random((1, 4, 3, 3), np.float32), ("green",), depths, 1e-6)
    plate = TrainingDoe.at_rest(bank.as_optic())
    for k, depth in enumerate(depths):
        found = psf_of(plate, None, ROUNDED, plate.sources(depth))
        # The place between two depths is found in single precision.
        np.testing.assert_allclose(found, bank.energy[:, k], atol=2e-6)
    # Half way in 1/z between 0.1 m and 0.2 m.
    found = psf_of(plate, None, ROUNDED, plate.sources(1 / 7.5))
    np.testing.assert_allclose(found, (bank.energy[:, 0] + bank.energy[:, 3]) / 2, atol=2e-6)
    beyond = psf_of(plate, None, ROUNDED, plate.sources(0.01))
    np.testing.assert_array_equal(beyond, bank.energy[:, 0])


def test_a_plate_at_rest_has_the_psf_of_the_bank() -> None:
    """Between the depths of its bank the blur disc grows by less than a pixel here."""
    made = trainer("train.freeze=optics")
    assert isinstance(made.doe.optic, BankOptic)
    for depth in (NEAR_M, 7.3e-3, 9e-3, FAR_M):
        found = psf_of(made.doe, None, ROUNDED, made.doe.sources(depth))
        wanted = psf(heights(), made.bench.camera, (depth,)).energy[:, 0]
        # Defocus turns by a fifth of a wave from one depth to the next: a parabola of a hundredth at most between.
        assert difference(found, wanted) < 0.02


# --- the capture -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_capture_has_the_gradient_of_its_plate() -> None:
    """By central differences along one direction, with the heights unrounded."""
    made, plate = live("optimize.sampling=exact")
    # Whole raw numbers would hide small changes; their gradient is that of numbers that are not rounded.
    bench = replace(made.bench, sensor=replace(made.bench.sensor, noise="none", bits=None))
    seen, keys = made._seen(batch(), 0, False)
    look = jnp.asarray(np.random.default_rng(1).standard_normal((1, 1, 32, 32)), jnp.float32)
    free = radians_of(plate, heights())

    @jax.jit
    def value(radians: jax.Array) -> jax.Array:
        return jnp.sum(look * shots(seen, plate, radians, CONTINUOUS, bench, keys).capture)

    slope = jax.jit(jax.grad(value))(free)
    # Cells that a step would wrap have a jump in between.
    room = (free > 0.1) & (free < plate.learning.levels.period_m / plate.learning.metres_per_radian - 0.1)
    along = jnp.where(room, jnp.sign(slope), 0.0)
    step = 1e-2
    found = (value(free + step * along) - value(free - step * along)) / (2 * step)
    # Rounding of a sum of a thousand pixels over the step; the third order of 0.01 rad is far below.
    np.testing.assert_allclose(found, jnp.sum(slope * along), rtol=5e-3)
