"""The transform itself: against a dense float64 evaluation of the same operators, value and gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bench.reference import YELLOW_M, make_camera, relative_error, wrapped_map
from fab.grid import Grid
from sim.aperture import circle_coverage
from sim.camera import Camera, Colour
from sim.propagation.farfield import TOLERANCE, FarField, displaced, plan_far_field
from sim.propagation.pixel import Banded
from sim.propagation.pupil import DoeRows, doe_field
from sim.source import MapColumns, source_path_m, wrapped_waves

# The airy disc is as wide against the pixel as in the paper's camera (f/1.8, 1.85 um).
PLANS = {
    "default": (make_camera(256, 0.8e-3, 1.44e-3, 1.85e-6, 64), {}),
    "bare FFT": (make_camera(200, 0.8e-3, 1.44e-3, 1.85e-6, 48), {"sampling": 1.0}),
    "prime number of cells": (make_camera(251, 0.8e-3, 1.44e-3, 1.85e-6, 33), {}),
    "window wider than the band": (make_camera(48, 0.15e-3, 1.44e-3, 7.4e-6, 100), {}),
    "aperture inside the grid": (
        Camera(Grid((300, 300), 3e-6), 0.7e-3, "fused_silica", make_camera(8, 1, 1, 1, 8).colours, 1.3e-3, 1.85e-6, 41),
        {"sampling": 1.5},
    ),
    "lit from 8 mm": (make_camera(128, 0.3e-3, 1.44e-3, 1.85e-6, 40), {"depth_m": 8e-3}),
    "small pixels, half filled": (make_camera(128, 0.4e-3, 1.44e-3, 1.85e-6, 40, fill=0.5), {"cell": False}),
}
RARE = tuple(name for name in PLANS if name != "default")


def make_rows(camera: Camera, depth_m: float = 0.02) -> DoeRows:
    source = wrapped_waves(source_path_m(camera, depth_m), YELLOW_M)
    coverage = circle_coverage(camera.grid, camera.aperture_m)
    height = wrapped_map(camera.grid.shape[0]).astype(np.float32)
    return DoeRows(jnp.asarray(coverage), jnp.asarray(height), None, jnp.asarray(source))


def dense(banded: Banded, inputs: int) -> np.ndarray:
    return np.asarray(banded(jnp.eye(inputs, dtype=jnp.float32)), np.float64)


def inputs64(rows: DoeRows, rate: np.ndarray | np.floating | float) -> list[np.ndarray]:
    return [np.asarray(a, np.float64) for a in (rows.height_m, rows.source, rows.coverage, rate)]


def field64(height: np.ndarray, source: np.ndarray, coverage: np.ndarray, rate: np.ndarray) -> np.ndarray:
    return coverage * np.exp(2j * np.pi * (height * rate + source))


def energy64(plan: FarField, field: np.ndarray) -> np.ndarray:
    """The plan's operators applied to a pupil, written as dense products in float64."""
    samples = np.arange(plan.kept) - plan.kept // 2
    axes = [np.exp(-2j * np.pi * np.outer(samples, np.arange(n) - n // 2) / plan.length) for n in plan.cells]
    if plan.tilt is not None:
        field = np.asarray(plan.tilt[0])[:, None] * field * np.asarray(plan.tilt[1])
    if plan.refine is not None:
        unit = jnp.eye(plan.kept, dtype=jnp.float32)
        real, imaginary = np.asarray(plan.refine.of_complex(jnp.stack([unit, 0 * unit])), np.float64)
        axes = [(real + 1j * imaginary).T @ matrix for matrix in axes]
    assert plan.gather is not None
    gather = dense(plan.gather, len(axes[0]))
    return gather.T @ np.abs(axes[0] @ field @ axes[1].T) ** 2 @ gather


def planned(name: str, moved: bool) -> tuple[Camera, FarField]:
    camera, options = PLANS[name]
    plan = plan_far_field(camera, YELLOW_M, **options)
    return camera, displaced(plan, jnp.array([0.4e-6, -0.7e-6])) if moved else plan


@pytest.mark.slow
@pytest.mark.parametrize("moved", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in RARE else n for n in PLANS])
def test_value_and_gradient(name: str, moved: bool, rng: np.random.Generator):
    camera, plan = planned(name, moved)
    rows, rate = make_rows(camera), np.float32(camera.waves_per_metre(YELLOW_M))
    weights = rng.uniform(size=(camera.window, camera.window))

    def objective(rows: DoeRows, rate: jax.Array) -> tuple[jax.Array, jax.Array]:
        energy = plan.energy(doe_field, rows, MapColumns(rate))
        return jnp.sum(jnp.asarray(weights, jnp.float32) * energy), energy

    run = jax.jit(jax.value_and_grad(objective, argnums=(0, 1), has_aux=True))
    (_, energy), (by_rows, by_rate) = run(rows, rate)
    inputs = inputs64(rows, rate)
    # Float32 transforms of a few hundred samples and a pupil good to 4e-6 (`sim.propagation.pupil.cis`).
    assert relative_error(np.asarray(energy), energy64(plan, field64(*inputs))) < 3e-5

    def loss64(leaf: int, change: np.ndarray | float) -> float:
        changed = [value + change if i == leaf else value for i, value in enumerate(inputs)]
        return float(np.sum(weights * energy64(plan, field64(*changed))))

    sizes = (1e-10, 1e-4, 1e-3, 1.0)  # of a change in height, source, coverage and rate
    for leaf, (gradient, size) in enumerate(zip(inputs64(by_rows, by_rate), sizes, strict=True)):
        # A random direction alone is mostly cancellation; a share of the gradient gives it something to measure.
        noise = rng.normal(size=gradient.shape)
        change = size * (noise + gradient / np.sqrt(np.mean(gradient**2)))
        wanted = (loss64(leaf, change) - loss64(leaf, -change)) / 2
        # Central differences are good to 1e-6 here; the rest is float32 in the adjoint transforms.
        assert float(np.sum(gradient * change)) == pytest.approx(wanted, rel=1e-4), leaf


def test_displaced_moves_the_image():
    """By whole pixels, so that the moved image is the same numbers one pixel further; +y is the next row."""
    camera, plan = planned("default", moved=False)
    rows, rate = make_rows(camera), jnp.float32(camera.waves_per_metre(YELLOW_M))
    still = np.asarray(plan.energy(doe_field, rows, MapColumns(rate)))
    offset = jnp.array([2 * camera.pixel_m, -3 * camera.pixel_m])
    moved = np.asarray(displaced(plan, offset).energy(doe_field, rows, MapColumns(rate)))
    # What differs is the rule's error at other sample positions, and the cell's sinc², which stays where it was.
    assert relative_error(moved[2:, :-3], still[:-2, 3:]) < 2e-2


@pytest.mark.parametrize("sampling", [None, 1.5])
def test_point_cells_lack_only_the_envelope(sampling: float | None):
    camera = make_camera(256, 0.8e-3, 1.44e-3, 1.85e-6, 65)
    rows, rate = make_rows(camera), jnp.float32(camera.waves_per_metre(YELLOW_M))
    square, points = (
        np.asarray(
            plan_far_field(camera, YELLOW_M, cell=cell, sampling=sampling).energy(doe_field, rows, MapColumns(rate))
        )
        for cell in (True, False)
    )
    envelope = np.sinc(camera.axis_m() * camera.grid.pitch_m / (YELLOW_M * camera.focal_length_m)) ** 2
    # Across one pixel the envelope changes by at most 4 %, and linearly, so its value at the centre is near its mean.
    assert relative_error(points * envelope[:, None] * envelope, square) < 2e-3


@pytest.mark.parametrize("name", ["default", "lit from 8 mm"])
def test_tiles_in_a_loop_give_the_same_bits(name: str):
    camera, plan = planned(name, moved=False)
    rows, rate = make_rows(camera), jnp.float32(camera.waves_per_metre(YELLOW_M))
    one, other = (np.asarray(way.energy(doe_field, rows, MapColumns(rate))) for way in (plan, plan.looped))
    np.testing.assert_array_equal(one, other)


def test_a_large_matrix_is_multiplied_alike_in_a_loop(rng: np.random.Generator):
    """Beyond what is one batch of tiles: 900 inputs, 1000 outputs, complex weights on 24 diagonals."""
    matrix = np.zeros((900, 1000), np.complex128)
    first = np.arange(1000) * 876 // 1000
    matrix[first[:, None] + np.arange(24), np.arange(1000)[:, None]] = rng.normal(size=(1000, 24)) + 1j
    banded = Banded.from_dense(matrix, batched=True)
    x = rng.normal(size=(2, 7, 900)).astype(np.float32)
    one, other = (np.asarray(each.of_complex(jnp.asarray(x))) for each in (banded, banded.looped))
    np.testing.assert_array_equal(one, other)
    assert banded.looped is not banded
    wanted = (x[0] + 1j * x[1].astype(np.float64)) @ matrix
    np.testing.assert_allclose(one[0] + 1j * one[1], wanted, atol=1e-4)  # 24 products of single precision


def test_the_default_sampling_predicts_its_tolerance():
    for name in ("default", "prime number of cells"):
        assert planned(name, moved=False)[1].expected_error <= TOLERANCE


def test_impossible_plans_are_refused():
    yellow = Colour("yellow", (YELLOW_M,), (1.0,))
    camera = Camera(Grid((8, 8), 1e-6), 8e-6, "fused_silica", (yellow,), 1e-3, 2e-6, 8)
    with pytest.raises(ValueError, match="must be at least 1"):
        plan_far_field(camera, YELLOW_M, sampling=0.5)
