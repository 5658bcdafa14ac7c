"""Pixels at the places of a map: against closed forms for plane waves, and what must be conserved."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim.propagation.mapped import MappedPixels, PlaceMap, plan_mapped_pixels

SAMPLES, PITCH = 256, 5.3  # samples per axis, and from pixel to pixel
AXIS = np.arange(SAMPLES) - SAMPLES // 2


def affine(matrix: np.ndarray, middle: tuple[float, float] = (0.3, -1.7)) -> PlaceMap:
    (yy, yx), (xy, xx) = matrix * PITCH
    return lambda row, column: (middle[0] + yy * row + yx * column, middle[1] + xy * row + xx * column)


def turn(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, s], [-s, c]])


def bulged(row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scale = PITCH * (1 - 1e-4 * (row * row + column * column))
    return scale * row, scale * column


def plan(places: PlaceMap, window: int, fill: float = 1.0, room: float = 0.0, cutoff: float = 0.45) -> MappedPixels:
    return plan_mapped_pixels(places, window, fill, cutoff, np.ones(SAMPLES), room)[0]


AFFINE = {
    "straight": (np.eye(2), 1e-3),
    "stretched": (np.diag([1.03, 0.98]), 1e-3),
    # Edges that are not parallel to rows of samples cost 0.3 % of rough light per degree.
    "turned": (turn(1.0), 4e-3),
    "sheared": (np.array([[1.0, 0.0], [0.02, 1.0]]), 1e-3),  # columns follow the map exactly
}


@pytest.mark.parametrize("fill", [1.0, 0.7])
@pytest.mark.parametrize("name", AFFINE)
def test_plane_waves_are_integrated_over_parallelograms(name: str, fill: float, rng: np.random.Generator):
    """The integral of a cosine over a parallelogram is its value in the middle times a sinc along either side."""
    (matrix, limit), window = AFFINE[name], 30
    places = affine(matrix)
    waves = rng.uniform(-0.45, 0.45, (40, 2))
    strengths = 1 - np.hypot(*waves.T) / 0.45  # about as developed speckle has them
    waves, strengths = waves[strengths > 0], strengths[strengths > 0]
    phases, image = rng.uniform(size=len(waves)), np.full((SAMPLES, SAMPLES), 6.0)
    centres = np.arange(window) - (window - 1) / 2
    y, x = places(centres[:, None], centres)
    wanted = np.full((window, window), 6.0)
    for (fy, fx), phase, strength in zip(waves, phases, strengths, strict=True):
        image += strength * np.cos(2 * np.pi * (fy * AXIS[:, None] + fx * AXIS + phase))
        along_row, along_column = fill * PITCH * (np.array([fy, fx]) @ matrix)
        value = strength * np.cos(2 * np.pi * (fy * y + fx * x + phase))
        wanted += value * np.sinc(along_row) * np.sinc(along_column)
    wanted *= (fill * PITCH) ** 2 * np.linalg.det(matrix)
    found = np.asarray(plan(places, window, fill).energy(jnp.asarray(image, jnp.float32)), np.float64)
    assert np.linalg.norm(found - wanted) < limit * np.linalg.norm(wanted)


@pytest.mark.parametrize("degrees", [0.5, 2.0])
def test_the_predicted_error_is_that_of_turned_pixels(degrees: float, rng: np.random.Generator):
    """Speckle behind a disc, over parallelograms: a spectrum of plane waves, each integrated in closed form."""
    matrix, window, cutoff = turn(degrees), 24, 0.45
    places = affine(matrix)
    waves = rng.uniform(-cutoff, cutoff, (400, 2))
    waves = waves[np.hypot(*waves.T) < cutoff]
    ratio = np.hypot(*waves.T) / cutoff
    strengths = np.sqrt(2 / np.pi * (np.arccos(ratio) - ratio * np.sqrt(1 - ratio**2)))
    phases, image = rng.uniform(size=len(waves)), np.zeros((SAMPLES, SAMPLES))
    centres = np.arange(window) - (window - 1) / 2
    y, x = places(centres[:, None], centres)
    wanted = np.zeros((window, window))
    for (fy, fx), phase, strength in zip(waves, phases, strengths, strict=True):
        image += strength * np.cos(2 * np.pi * (fy * AXIS[:, None] + fx * AXIS + phase))
        along_row, along_column = PITCH * (np.array([fy, fx]) @ matrix)
        value = strength * np.cos(2 * np.pi * (fy * y + fx * x + phase))
        wanted += PITCH**2 * value * np.sinc(along_row) * np.sinc(along_column)
    pixels, predicted = plan_mapped_pixels(places, window, 1.0, cutoff, np.ones(SAMPLES))
    found = np.asarray(pixels.energy(jnp.asarray(image, jnp.float32)), np.float64)
    # 576 pixels of a width of several samples: some hundred independent ones, of a spectrum of as many waves.
    assert np.linalg.norm(found - wanted) / np.linalg.norm(wanted) == pytest.approx(predicted, rel=0.25)


def test_all_light_is_counted_once():
    """A blob of light within the window, whatever the map does to the pixels around it."""
    blob = np.exp(-((AXIS[:, None] - 31.0) ** 2 + (AXIS + 22.0) ** 2) / 60)
    for places in (affine(turn(2.0)), bulged):
        energy = np.asarray(plan(places, 40).energy(jnp.asarray(blob, jnp.float32)), np.float64)
        # Weights of float32 places: 1e-5 of a pixel each.
        assert energy.sum() == pytest.approx(blob.sum(), rel=2e-5)


def test_a_centroid_lands_where_the_map_says():
    """A blob at the place of one point of the window has its centroid there, with a turn and a bulge."""
    c, s = np.cos(0.02), np.sin(0.02)

    def places(row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return bulged(c * row + s * column, c * column - s * row)

    y, x = places(np.array(9.0), np.array(-13.0))
    blob = np.exp(-((AXIS[:, None] - y) ** 2 + (AXIS - x) ** 2) / 40)
    energy = np.asarray(plan(places, 40).energy(jnp.asarray(blob, jnp.float32)), np.float64)
    centres = np.arange(40) - 19.5
    found = energy.sum(1) @ centres / energy.sum(), energy.sum(0) @ centres / energy.sum()
    # The blob's width and the map's second derivative: 40 / 2 samples² x 3e-4 per pixel moves it by 3e-3 pixels.
    np.testing.assert_allclose(found, (9.0, -13.0), atol=5e-3)


@pytest.mark.parametrize("fill", [1.0, 0.8])
def test_the_way_back_is_the_transpose(fill: float, rng: np.random.Generator):
    pixels = plan(affine(turn(1.5)), 37, fill)
    image = jnp.asarray(rng.uniform(size=(SAMPLES, SAMPLES)), jnp.float32)
    energy, back = jax.vjp(pixels.energy, image)
    weights = jnp.asarray(rng.normal(size=energy.shape), jnp.float32)
    forth = np.vdot(np.asarray(energy, np.float64), np.asarray(weights))
    # Single precision, a sum of 1e3 terms of both signs.
    assert np.vdot(np.asarray(back(weights)[0], np.float64), np.asarray(image)) == pytest.approx(forth, rel=1e-4)


@pytest.mark.slow
def test_gradient_in_the_map(rng: np.random.Generator):
    """Of a turn, a stretch and a cubic bend, against differences."""
    image = np.zeros((SAMPLES, SAMPLES))
    for fy, fx, phase in rng.uniform(-0.2, 0.2, (12, 3)):
        image += 1 + np.cos(2 * np.pi * (fy * AXIS[:, None] + fx * AXIS + 5 * phase))
    image, weights = jnp.asarray(image, jnp.float32), rng.normal(size=(30, 30))
    planned = plan(affine(np.eye(2)), 30, room=0.05)

    def moved(values: jax.Array) -> PlaceMap:
        turned, wider, bend = values
        return lambda row, column: (
            PITCH * (row + turned * column),
            PITCH * ((1 + wider) * column - turned * row + bend * (column / 15) ** 3),
        )

    energy = jax.jit(lambda values: planned.at(moved(values)).energy(image))

    def total(values: jax.Array) -> jax.Array:
        return jnp.sum(weights * energy(values))

    def total64(values: np.ndarray) -> float:
        return float(np.sum(weights * np.asarray(energy(jnp.asarray(values, jnp.float32)), np.float64)))

    at = np.array([0.013, -0.021, 0.31])
    found = np.asarray(jax.jit(jax.grad(total))(jnp.asarray(at, jnp.float32)))
    for index, step in enumerate((5e-4, 5e-4, 2e-2)):
        high, low = (total64(at + side * step * np.eye(3)[index]) for side in (1, -1))
        # Places are rounded to 1e-5 samples, over moves of some hundredths.
        assert found[index] == pytest.approx((high - low) / (2 * step), rel=1e-2)


def test_pixels_beyond_the_room_are_nan():
    image = jnp.ones((SAMPLES, SAMPLES))
    planned = plan(affine(np.eye(2)), 30, room=0.03)
    assert np.isfinite(planned.at(affine(turn(1.5))).energy(image)).all()
    assert np.isnan(planned.at(affine(turn(15.0))).energy(image)).any()
    assert np.isnan(planned.at(affine(np.eye(2), (0.0, 80.0))).energy(image)).any()
    # The window is 159 samples wide; its half and 80 samples are more than the 128 there are.
