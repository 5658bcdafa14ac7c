"""PSFs behind lenses that distort, and on sensors that are turned: against sums over the cells at exact directions.

The reference shares no code with the package: for every point of a pixel it finds the direction of light by fixed-point
iteration, sums the waves of all cells in float64, and turns intensity per direction sine into light per area by the
map's Jacobian, from differences.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fab.grid import Grid
from sim.aperture import circle_coverage
from sim.camera import Camera, Colour
from sim.propagation.farfield import bent, plan_far_field
from sim.propagation.places import CUBIC
from sim.propagation.pupil import DoeRows, doe_field
from sim.source import MapColumns

WAVELENGTH_M, PITCH_M, CELLS, PIXEL_M, POINTS = 550e-9, 1.85e-6, 96, 3.7e-6, 24
ONE = (Colour("one", (WAVELENGTH_M,), (1.0,)),)
# As far from the axis as the corners of the automotive design's window: 0.12 of the focal length along either axis.
CAMERA = Camera(Grid((CELLS, CELLS), PITCH_M), CELLS * PITCH_M, "fused_silica", ONE, 1.6e-3, PIXEL_M, 104)
PIXELS = np.array([(0, 0), (0, 52), (103, 51), (51, 51), (52, 103), (101, 2), (103, 103), (20, 77), (88, 60), (9, 30)])
HEIGHT_M = 75e-9 * np.random.default_rng(5).integers(0, 16, (CELLS, CELLS))


def directions(camera: Camera, y_m: np.ndarray, x_m: np.ndarray) -> np.ndarray:
    """Direction sines `[2, ...]` of the light that lands at places on the sensor."""
    seen = np.stack([y_m, x_m]) / camera.sensor_distance_m
    ideal, (k1, k2) = seen, camera.distortion
    for _ in range(80):
        square = (ideal**2).sum(0)
        ideal = seen / (1 + k1 * square + k2 * square**2)
    return ideal / np.sqrt(1 + (ideal**2).sum(0)) if camera.mapping == "tangent" else ideal


def summed(camera: Camera, chief: np.ndarray, place_m, pixels: np.ndarray = PIXELS) -> np.ndarray:
    """Energy of some pixels; `place_m` gives a point's place on the sensor from its place on an ideal window."""
    coverage = circle_coverage(camera.grid, camera.aperture_m).astype(np.float64)
    delay = np.float32(HEIGHT_M).astype(np.float64) * camera.waves_per_metre(WAVELENGTH_M)
    field = coverage * np.exp(2j * np.pi * delay)
    cells_m = (np.arange(CELLS) - (CELLS - 1) / 2) * PITCH_M
    offsets = ((np.arange(POINTS) + 0.5) / POINTS - 0.5) * camera.fill * PIXEL_M
    area = np.pi * camera.aperture_m**2 / 4
    found = []
    for row, column in pixels - (camera.window - 1) / 2:
        y, x = np.meshgrid(row * PIXEL_M + offsets, column * PIXEL_M + offsets, indexing="ij")
        sines = directions(camera, *place_m(y, x)) - chief[:, None, None]
        step = 1e-9
        down, right = (
            (directions(camera, *place_m(y + a, x + b)) - directions(camera, *place_m(y - a, x - b))) / (2 * step)
            for a, b in ((step, 0.0), (0.0, step))
        )
        jacobian = np.abs(down[0] * right[1] - down[1] * right[0])
        fy, fx = (sines / WAVELENGTH_M).reshape(2, -1)
        waves = np.einsum(
            "py,py->p",
            np.exp(-2j * np.pi * np.outer(fy, cells_m)),
            np.exp(-2j * np.pi * np.outer(fx, cells_m)) @ field.T,
        )
        waves = waves * np.sinc(fy * PITCH_M) * np.sinc(fx * PITCH_M) * PITCH_M**2 / WAVELENGTH_M
        density = np.abs(waves) ** 2 * jacobian.ravel() / area
        found.append(density.sum() * (camera.fill * PIXEL_M / POINTS) ** 2)
    return np.array(found)


def rows_of(camera: Camera) -> tuple[DoeRows, MapColumns]:
    height = jnp.asarray(HEIGHT_M, jnp.float32)
    coverage = jnp.asarray(circle_coverage(camera.grid, camera.aperture_m))
    columns = MapColumns(jnp.float32(camera.waves_per_metre(WAVELENGTH_M)))
    return DoeRows(coverage, height, None, jnp.zeros_like(height)), columns


def test_a_turned_stretched_and_bent_sensor():
    """Value against the sum, and gradient in all coefficients against differences."""
    camera, (rows, columns) = replace(CAMERA, window=61), rows_of(CAMERA)
    half_m = camera.window * PIXEL_M / 2
    coefficients = np.zeros((2, len(CUBIC)))
    shares = {(0, 2): 0.017, (1, 1): -0.017, (0, 1): 0.02, (1, 2): -0.015, (1, 6): 0.004, (0, 8): 0.003}
    for place, share in shares.items():
        coefficients[place] = share * half_m
    assert (CUBIC[6], CUBIC[8]) == ((3, 0), (1, 2))

    def place_m(y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        b, a = y / half_m, x / half_m
        return (
            y + half_m * (0.017 * a + 0.02 * b + 0.003 * b * a**2),
            x + half_m * (-0.017 * b - 0.015 * a + 0.004 * b**3),
        )

    plan = plan_far_field(camera, WAVELENGTH_M, room=0.05)
    energy = jax.jit(lambda values: bent(plan, camera, values).energy(doe_field, rows, columns))
    image = np.asarray(energy(jnp.asarray(coefficients, jnp.float32)), np.float64)
    pixels = np.array([(0, 0), (30, 30), (60, 60), (0, 60), (12, 41), (55, 8), (30, 0), (60, 22)])
    wanted = summed(camera, np.zeros(2), place_m, pixels)
    # Slanted edges of pixels: 0.3 % per degree of turn, of a speckle-like image.
    assert np.linalg.norm(image[tuple(pixels.T)] - wanted) < 6e-3 * np.linalg.norm(wanted)

    weights = np.random.default_rng(1).normal(size=image.shape)
    gradient = jax.jit(jax.grad(lambda values: jnp.sum(weights * energy(values))))
    found = np.asarray(gradient(jnp.asarray(coefficients, jnp.float32)), np.float64)
    for axis, term in shares:
        moved = np.zeros_like(coefficients)
        moved[axis, term] = 5e-8
        high, low = (
            np.sum(weights * np.asarray(energy(jnp.asarray(coefficients + side * moved, jnp.float32)), np.float64))
            for side in (1, -1)
        )
        # Places are rounded to 1e-4 samples over moves of a tenth; terms of both signs cancel in the sum.
        assert found[axis, term] == pytest.approx((high - low) / 1e-7, rel=1e-2, abs=1e-3 * np.abs(found).max())


def test_a_plan_without_room_does_not_bend():
    plan = plan_far_field(CAMERA, WAVELENGTH_M)
    assert plan.pixels is None  # straight pixels take their own way, and the same bits as ever
    with pytest.raises(ValueError, match="room"):
        bent(plan, CAMERA, jnp.zeros((2, len(CUBIC))))
