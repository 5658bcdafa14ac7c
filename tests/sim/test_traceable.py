"""What users call goes through jax: `grad` is the finite difference, `jit` and `vmap` give the values without them."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bench.reference import wrapped_map
from fab.grid import Grid
from fab.levels import Levels
from fab.process import Process, variation_of
from sim.camera import Camera, Colour
from sim.imaging.formation import Optics, capture
from sim.imaging.occlusion import Model
from sim.imaging.scene import Obstruction, Scene
from sim.metrics import METRICS, mean_transmission, strehl, zeroth_order
from sim.optic import HeightOptic, RingOptic
from sim.propagation.hankel import ring_count
from sim.psf_bank import psf
from sim.sensor import Sensor, developed, expose
from sim.surface import as_fabricated

CELLS, PITCH_M = 32, 2e-6
COLOURS = (Colour("green", (520e-9, 550e-9), (0.4, 0.6)), Colour("red", (620e-9,), (1.0,)))
CAMERA = Camera(Grid((CELLS, CELLS), PITCH_M), CELLS * PITCH_M, "fused_silica", COLOURS, 0.4e-3, 4e-6, 17)
ONE = replace(CAMERA, colours=COLOURS[1:])
NEAR_M = 4e-3  # a defocus disc of 3.2 um, 0.8 pixels, in radius
DEPTHS_M = (np.inf, NEAR_M)
HEIGHT_M = wrapped_map(CELLS)
LEVELS = Levels(2, 500e-9)
LEVEL = np.random.default_rng(4).integers(0, 2, (CELLS, CELLS)).astype(np.uint8)


def check(function: Callable[[Any], Any], at: Any, step: float, *, slope: float = 2e-3, value: float = 1e-5) -> None:
    """Check grad, jit and vmap of a function along a random direction.

    Args:
        function: pytree of arrays -> array.
        at: where; the direction is about as large as each leaf.
        step: half the distance of the central difference, as a share of that size.
        slope: tolerance of the derivative, relative: curvature over a step, and float32 rounding over it.
        value: tolerance of values, relative to the largest; float32 sums in another order where nothing is said.
    """
    rng = np.random.default_rng(7)
    at = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), at)
    way = jax.tree.map(
        lambda leaf: (
            jnp.asarray(rng.choice([-1, 1], leaf.shape) * rng.uniform(0.5, 1.5, leaf.shape), jnp.float32)
            * jnp.abs(leaf).max()
        ),
        at,
    )
    sides = [jax.tree.map(lambda leaf, w, t=t: leaf + t * w, at, way) for t in (0.0, step, -step)]
    eager = np.stack([np.asarray(function(side)) for side in sides]).astype(np.float64)
    close = partial(np.testing.assert_allclose, rtol=0, atol=value * np.abs(eager[0]).max())
    close(jax.jit(jax.vmap(function))(jax.tree.map(lambda *leaves: jnp.stack(leaves), *sides)), eager)
    # Of both signs, or the sum would hardly depend on where the light goes.
    weights = rng.normal(size=eager[0].shape)

    @jax.jit
    def value_and_gradient(x: Any) -> tuple[Any, Any]:
        found, pull = jax.vjp(function, x)
        return found, pull(jnp.asarray(weights, found.dtype))[0]

    compiled, gradient = value_and_gradient(at)
    close(compiled, eager[0])
    found = sum(float(jnp.vdot(g, w)) for g, w in zip(jax.tree.leaves(gradient), jax.tree.leaves(way), strict=True))
    assert found == pytest.approx(np.sum(weights * (eager[1] - eager[2])) / (2 * step), rel=slope)
    assert found != 0


@pytest.mark.slow
def test_psfs_of_a_height_map():
    # Phases bend over a radian, 0.09 um of glass: steps of a thousandth of the heights leave 1e-4.
    check(lambda height: psf(height, ONE, DEPTHS_M).energy, HEIGHT_M, 2e-3)


def test_psfs_of_rings():
    camera = replace(ONE, window=9)
    profile = np.linspace(0.1e-6, 1e-6, ring_count(camera))
    check(lambda profile_m: psf(RingOptic(camera, profile_m), depths=DEPTHS_M).energy, profile, 2e-3)


@pytest.mark.parametrize("propagation", ["fresnel", "angular_spectrum"])
def test_psfs_of_the_direct_path(propagation: Any):
    fine = replace(ONE, grid=Grid((64, 64), 1e-6), window=9)
    check(lambda height: psf(height, fine, NEAR_M, propagation=propagation).energy, wrapped_map(64), 2e-3)


@pytest.mark.study
def test_a_doe_as_fabricated():
    """Its PSF, 0th order and overlap with the design as functions of a number (metres) that moves several errors."""
    process, nominal = Process(LEVELS), as_fabricated(LEVEL, ONE, Process(LEVELS), variation_of(1, {}))

    def judged(error_m: Any) -> Any:
        errors = {
            "overlay_x_m[0]": 0.2e-6 + error_m,
            "cd_bias_m[0]": 0.1e-6 + error_m / 2,
            "depth_scale[0]": 1e5 * error_m,
        }
        doe = as_fabricated(LEVEL, ONE, process, variation_of(1, errors), depths_m=(NEAR_M,))
        overlaps = jnp.concatenate([jnp.abs(mean_transmission(doe)), zeroth_order(doe), strehl(doe, nominal)])
        return jnp.concatenate([psf(doe, depths=NEAR_M).energy.ravel(), 0.1 * overlaps])

    # With a traced error the aperture's edge is straight within a cell: 1 / (12 x 32) of an edge cell.
    check(judged, 0.05e-6, 0.2, value=1e-3)


@pytest.mark.slow
def test_all_metrics_of_a_height_map():
    """The whole table of a DOE with no target; lengths, and the light that the chrome takes, are constants here."""
    whole = [metric for metric in METRICS.values() if not metric.aimed]
    depths_m = (np.inf, 1.0, NEAR_M)
    lens, nominal = psf(HeightOptic.of(ONE), depths=depths_m), HeightOptic.of(ONE, HEIGHT_M)

    def metrics(height: Any) -> list[Any]:
        doe = HeightOptic.of(ONE, height)
        inputs = psf(doe, depths=depths_m).metric_inputs((NEAR_M,), doe, nominal, lens)
        return [metric.of(inputs, 0, 0 if metric.depths == "far" else 2) for metric in whole]

    start = HEIGHT_M + 1e-8 * np.random.default_rng(6).normal(size=HEIGHT_M.shape)
    sizes = [
        max(abs(float(value)), 1e-6) if metric.unit == "m" else max(abs(float(value)), 1e-2)
        for metric, value in zip(whole, metrics(jnp.asarray(start, jnp.float32)), strict=True)
    ]
    # A share of the light is a sum of thousands of float32 numbers, of which a step changes a hundredth.
    check(
        lambda height: jnp.stack([jnp.asarray(v) / s for v, s in zip(metrics(height), sizes, strict=True)]),
        start,
        0.01,
        slope=5e-3,
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["throughput", "far_spot", "ring_to_disc", "participation", "encircled_energy"])
def test_metrics_of_a_bank(name: str):
    bank = psf(HEIGHT_M, CAMERA, DEPTHS_M)
    arguments = ([5e-6, 20e-6],) if name == "encircled_energy" else ()
    # A ratio of two sums that a step changes by 1 % bends by 1e-4.
    check(lambda energy: getattr(replace(bank, energy=energy), name)(*arguments), bank.energy, 0.01)


SHAPE = (20, 24)
MODELS: tuple[Model, ...] = ("paper", "paper_release", "radiometric", "reciprocal")


def layers(rng: np.random.Generator) -> tuple[Any, ...]:
    """Background, mask and light of an obstruction, and inverse depth."""
    background, radiance = rng.uniform(0.2, 1, (2, 2, *SHAPE))
    return background, 0.2 + 0.5 * rng.uniform(0, 1, SHAPE), radiance, np.float64(10.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "model", [*(pytest.param(model, marks=pytest.mark.study) for model in MODELS[:-1]), MODELS[-1]]
)
def test_image_formation(rng: np.random.Generator, model: Model):
    """PSFs, images, mask and depth at once; from the bank through `Optics.of`, as a user goes."""
    bank = psf(HEIGHT_M, CAMERA, DEPTHS_M)

    def image(given: Any) -> Any:
        energy, background, mask, radiance, curvature = given
        optics = Optics.of(replace(bank, energy=energy), CAMERA, DEPTHS_M)
        optics = replace(optics, aperture_m=1e-3, focal_m=4e-3, shadow_px=17)
        return capture(Scene(background, np.inf, (Obstruction(mask, radiance, 1 / curvature),)), optics, model)

    # The clamp of the release's alpha bends a few pixels, and a shadow disc is traced by straight lines in a pixel
    # while it is known exactly outside jax: 1e-3 of the light.
    followed = model in ("radiometric", "reciprocal")
    check(
        image,
        (bank.energy, *layers(rng)),
        5e-3,
        slope=0.03 if model == "paper_release" else 5e-3,
        value=1e-3 if followed else 1e-5,
    )


@pytest.mark.parametrize("noise", ["none", "physical", "tseng", "release"])
def test_the_sensor(noise: Any):
    """From light to developed light, with one key: the draw follows its mean as the mean plus a fixed deviation."""
    sensor = Sensor(quantum_efficiency=(0.3, 0.6), bits=None, noise=noise)
    light = np.random.default_rng(5).uniform(0.2, 0.4, (2, 64, 64))
    key = jax.random.key(3)
    # Counts are whole electrons: 0.4 of one for each of the two sides, over a step of 50 of them.
    slope = 1e-2 if noise in ("physical", "tseng") else 2e-3
    check(lambda given: developed(expose(given, sensor, key), sensor), light, 0.05, slope=slope)


def test_rounding_to_bits_passes_gradients_on():
    """A sensor with bits has the gradient of one without: the finite difference of what it rounds."""
    fine, rough = (Sensor(quantum_efficiency=(0.6,), bits=bits, noise="none") for bits in (None, 12))
    light, key = jnp.asarray(np.random.default_rng(5).uniform(0.2, 0.9, (1, 16, 16)), jnp.float32), jax.random.key(3)
    gradients = [jax.grad(lambda x, s=s: jnp.sum(developed(expose(x, s, key), s)))(light) for s in (fine, rough)]
    np.testing.assert_allclose(gradients[1], gradients[0], rtol=1e-6)
