"""Derivatives of the light behind a plate by every continuous error, against finite differences, both ways round."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from bench.reference import YELLOW_M
from fab.grid import Grid
from fab.levels import Levels
from fab.process import DEVIATIONS, Process, Variation, error_names, variation_of
from sim.camera import Camera, Colour
from sim.optic import HeightOptic
from sim.surface import as_fabricated

pytestmark = pytest.mark.slow

UM = 1e-6
PITCH_M = 1.85 * UM
CELLS = 48
LEVELS = Levels(8, 150e-9)
MASKS = LEVELS.bits
# Far from the wafer's middle, where a turned mask lies off.
PROCESS = Process(LEVELS, die_m=(10e-3, -20e-3))
CAMERA = Camera(
    Grid((CELLS, CELLS), PITCH_M),
    0.95 * CELLS * PITCH_M,
    "fused_silica",
    (Colour("yellow", (YELLOW_M,), (1.0,)),),
    1e-3,
    3.7 * UM,
    64,
)
# A generic plate: all errors at once, and no two masks' edges at the same place, where the derivative is one-sided.
PLATE = {
    "common_depth_scale": 0.01,
    "depth_scale": (0.02, -0.03, 0.01),
    "radial_nonuniformity": 0.1,
    "linear_nonuniformity_y": 0.02,
    "linear_nonuniformity_x": -0.03,
    "overlay_y_m": (0.2 * UM, -0.35 * UM, 0.55 * UM),
    "overlay_x_m": (-0.15 * UM, 0.45 * UM, 0.75 * UM),
    "rotation_rad": (1e-6, -2e-6, 3e-6),
    "magnification": (2e-6, 1e-6, -3e-6),
    "common_cd_bias_m": 0.05 * UM,
    "cd_bias_m": (0.02 * UM, -0.12 * UM, 0.06 * UM),
    "corner_radius_m": 0.3 * UM,
    "sidewall_rad": 0.05,
    "etch_lag": 0.05,
    "roughness_m": 10e-9,
    "correlation_m": 2 * UM,
    "chrome_y_m": 0.7 * UM,
    "chrome_x_m": -0.4 * UM,
    "chrome_diameter_m": 0.9 * UM,
}
# Half the distance between the two plates of a difference. The functional is rounded to 1e-7 or so of itself, so a step
# must change it by some 1e-4; and the edges that it moves, 10 nm, must not pass each other (they are 20 nm apart or
# more here), nor the rim of the chrome a corner of the squares that cells there are cut into. Turns and growths act
# over 20 mm, so 4e-7 of them are 8 nm. What is smooth takes longer steps.
STEPS = {
    "common_depth_scale": 2e-3,
    "depth_scale": 4e-3,
    "radial_nonuniformity": 2e-2,
    "linear_nonuniformity_y": 2e-2,
    "linear_nonuniformity_x": 2e-2,
    "overlay_y_m": 10e-9,
    "overlay_x_m": 10e-9,
    "rotation_rad": 4e-7,
    "magnification": 4e-7,
    "common_cd_bias_m": 10e-9,
    "cd_bias_m": 10e-9,
    "corner_radius_m": 10e-9,
    "sidewall_rad": 2e-3,
    "etch_lag": 1e-2,
    "roughness_m": 0.5e-9,
    "correlation_m": 50e-9,
    "chrome_y_m": 10e-9,
    "chrome_x_m": 10e-9,
    "chrome_diameter_m": 10e-9,
}
NAMES = error_names(MASKS)
VALUES = {
    name: float(value)
    for key, given in PLATE.items()
    for name, value in zip(error_names(MASKS, key), given if isinstance(given, tuple) else (given,), strict=True)
}


def plate(**changed: float) -> Variation:
    return variation_of(MASKS, VALUES | changed, seed=3)


def direction(name: str) -> Variation:
    return variation_of(MASKS, {other: float(other == name) for other in NAMES}, seed=3)


def level_map() -> np.ndarray:
    noise = gaussian_filter(np.random.default_rng(0).normal(size=(CELLS, CELLS)), 1.5, mode="wrap")
    return np.mod(np.rint(noise / noise.std() * 4), LEVELS.count).astype(np.uint8)


class Compiled(NamedTuple):
    """The functional with its derivatives: backward once for all errors, forward for one at a time."""

    slopes: Variation
    value: float
    along: Callable[[Variation, Variation], Any]


@pytest.fixture(scope="module")
def compiled() -> Compiled:
    """Intensities of the far field, weighted at random, as a function of the errors; float32 as in the product."""
    u = np.linspace(-0.35, 0.35, 48)
    x = np.arange(CELLS) - (CELLS - 1) / 2
    waves = jnp.asarray(np.exp(-2j * np.pi * u[:, None] * x) * np.sinc(u)[:, None] / CELLS, jnp.complex64)
    # Of both signs, or the sum would hardly depend on where the light goes.
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(48, 48)), jnp.float32)
    level = level_map()

    def functional(variation: Variation) -> jax.Array:
        surface = as_fabricated(level, CAMERA, PROCESS, variation)
        field = waves @ surface.transmission[0] @ waves.T
        return jnp.sum(weights * (field.real**2 + field.imag**2))

    value, slopes = jax.jit(jax.value_and_grad(functional))(plate())
    along = jax.jit(lambda at, toward: jax.jvp(functional, (at,), (toward,)))
    return Compiled(slopes, float(value), along)


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_are_those_of_finite_differences(name: str, compiled: Compiled):
    step = STEPS[name.partition("[")[0]]
    slope = compiled.slopes.value(name)
    # Compiled apart, in another order of sums.
    value, forward = map(float, compiled.along(plate(), direction(name)))
    assert value == pytest.approx(compiled.value, rel=1e-4)
    high, low = (
        float(compiled.along(plate(**{name: VALUES[name] + s * step}), direction(name))[0]) for s in (1, -1)
    )  # fmt: skip
    difference = (high - low) / (2 * step)
    assert slope != 0
    # Curvature over a step and rounding leave 1e-3 or so each. Rounding: a few float32 digits of the value.
    rounding = 2e-7 * abs(compiled.value) / step
    assert slope == pytest.approx(difference, rel=5e-3, abs=rounding)
    assert forward == pytest.approx(slope, rel=1e-4, abs=rounding / 100)


def test_every_error_is_tried():
    assert set(PLATE) == set(STEPS) == set(DEVIATIONS)
    assert set(VALUES) == set(NAMES)


def test_a_psf_has_the_derivative_of_its_plate():
    """What remains of the chain: from the plate's transmission and chrome to the energy on the pixels."""
    (line,) = CAMERA.lines
    lens = HeightOptic.of(CAMERA)
    plan, source = lens.plan(line, 5e-3), lens.source(line, 5e-3)
    rng = np.random.default_rng(2)
    weights = jnp.asarray(rng.normal(size=(64, 64)), jnp.float32)
    values, shift = rng.normal(size=(2, 2, CELLS, CELLS))
    at, toward = (jnp.asarray(a[0] + 1j * a[1], jnp.complex64) for a in (values, shift))
    open_, closing = (jnp.asarray(rng.random((CELLS, CELLS)), jnp.float32) for _ in range(2))

    @jax.jit
    @jax.value_and_grad
    def energy(step: jax.Array) -> jax.Array:
        optic = HeightOptic(CAMERA, open_ - step[1] * closing, None, {line.wavelength_m: at + step[0] * toward})
        return jnp.sum(weights * optic.energy(line, plan, source))

    slopes = np.asarray(energy(jnp.zeros(2))[1])
    for i in range(2):
        # Energies are of second order in either, so a difference of any length is exact but for rounding.
        high, low = (float(energy(jnp.asarray(s * np.eye(2)[i], jnp.float32))[0]) for s in (0.2, -0.2))
        assert slopes[i] == pytest.approx((high - low) / 0.4, rel=1e-3)
