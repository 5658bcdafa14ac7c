from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.special import j0, j1

from bench.reference import YELLOW_M, make_camera, relative_error
from fab.grid import Grid
from sim.propagation.hankel import _points, plan_hankel, radial_profile, revolve, ring_count, ring_source_waves

CAMERA = make_camera(300, 0.6e-3, 1.08e-3, 1.85e-6, 49)


def noise_profile(rings: int, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.mod(gaussian_filter1d(rng.normal(size=rings), 4) * 4e-6, 1.2e-6)


def image_on_the_axis(profile_m: np.ndarray, radius_m: np.ndarray) -> np.ndarray:
    """Intensity at radii of the sensor: the Hankel integral of 30 midpoints per ring, in float64."""
    pitch, scale = CAMERA.grid.pitch_m, YELLOW_M * CAMERA.focal_length_m
    fine = (np.arange(len(profile_m) * 30) + 0.5) * pitch / 30
    wave = np.exp(2j * np.pi * np.repeat(profile_m, 30) * CAMERA.waves_per_metre(YELLOW_M))
    kernel = j0(2 * np.pi / scale * np.outer(radius_m, fine))
    field = 2 * np.pi / scale * kernel @ (wave * fine) * (pitch / 30)
    return np.abs(field) ** 2 / (np.pi * CAMERA.aperture_m**2 / 4)


@pytest.mark.slow
def test_pixels_against_the_integral():
    """Thirty pixels, each by 12 x 12 points of the directly summed Hankel integral."""
    profile = noise_profile(ring_count(CAMERA))
    plan = plan_hankel(CAMERA, YELLOW_M)
    source = jnp.asarray(ring_source_waves(CAMERA, np.inf, YELLOW_M))
    got = np.asarray(
        plan.energy(jnp.asarray(profile, jnp.float32), source, jnp.float32(CAMERA.waves_per_metre(YELLOW_M)))
    )
    points = (np.arange(12) - 5.5) / 12 * CAMERA.pixel_m
    y, x = ((CAMERA.axis_m()[24 : 24 + n, None] + points).ravel() for n in (3, 10))
    values = image_on_the_axis(profile, np.hypot(y[:, None], x).ravel()).reshape(3, 12, 10, 12).mean(axis=(1, 3))
    # Linear interpolation between fine radii (1e-3) and 16 x 16 points per pixel (2e-3 on the brightest).
    assert relative_error(got[24:27, 24:34], values * CAMERA.pixel_m**2) < 3e-3


def test_a_few_rings_lit_from_nearby_are_the_integral():
    """A small plate of random rings 4 mm behind a point, 30 midpoints per ring and 12 x 12 points per pixel."""
    camera = make_camera(80, 0.16e-3, 0.29e-3, 1.85e-6, 9)
    rings, pitch, scale = 40, camera.grid.pitch_m, YELLOW_M * camera.focal_length_m
    profile, rate = noise_profile(rings), camera.waves_per_metre(YELLOW_M)
    source = jnp.asarray(ring_source_waves(camera, 4e-3, YELLOW_M))
    got = np.asarray(plan_hankel(camera, YELLOW_M).energy(jnp.asarray(profile, jnp.float32), source, jnp.float32(rate)))
    fine = (np.arange(rings * 30) + 0.5) * pitch / 30
    waves = np.repeat(profile, 30) * rate + (np.hypot(fine, 4e-3) - 4e-3) / YELLOW_M
    points = (np.arange(12) - 5.5) / 12 * camera.pixel_m
    y, x = ((camera.axis_m()[4:, None] + points).ravel() for _ in range(2))
    places, index = np.unique(np.hypot(y[:, None], x).ravel().round(12), return_inverse=True)
    field = j0(2 * np.pi / scale * np.outer(places, fine)) @ (np.exp(2j * np.pi * waves) * fine) * (pitch / 30)
    density = np.abs(2 * np.pi / scale * field) ** 2 / (np.pi * camera.aperture_m**2 / 4)
    wanted = density[index].reshape(5, 12, 5, 12).mean(axis=(1, 3)) * camera.pixel_m**2
    # As above, and three sub-rings, over each of which the wave of the source turns by 0.06 waves at most.
    assert relative_error(got[4:, 4:], wanted) < 4e-3


def test_an_open_aperture_is_the_airy_disc():
    plan = plan_hankel(CAMERA, YELLOW_M)
    profile = jnp.zeros(ring_count(CAMERA))
    source = jnp.asarray(ring_source_waves(CAMERA, np.inf, YELLOW_M))
    got = np.asarray(plan.energy(profile, source, jnp.float32(1.0)))
    points = (np.arange(40) - 19.5) / 40 * CAMERA.pixel_m
    fine = (CAMERA.axis_m()[:, None] + points).ravel()
    v = np.pi * CAMERA.aperture_m / (YELLOW_M * CAMERA.focal_length_m) * np.hypot(fine[:, None], fine)
    density = np.pi / 4 * (CAMERA.aperture_m / (YELLOW_M * CAMERA.focal_length_m)) ** 2 * (2 * j1(v) / v) ** 2
    wanted = density.reshape(49, 40, 49, 40).mean(axis=(1, 3)) * CAMERA.pixel_m**2
    assert relative_error(got, wanted) < 3e-3  # as above


@pytest.mark.parametrize("airy_radii", [10, 18.6, 40])
def test_a_pixel_much_wider_than_the_airy_disc_has_all_of_its_light(airy_radii: float):
    """One pixel about the axis: the light of the Airy pattern in a square `airy_radii` times lambda f / D wide."""
    camera = make_camera(256, 0.512e-3, 1e-3, airy_radii * YELLOW_M * 1e-3 / 0.512e-3, 1)
    source = jnp.asarray(ring_source_waves(camera, np.inf, YELLOW_M))
    got = plan_hankel(camera, YELLOW_M).energy(jnp.zeros(ring_count(camera)), source, jnp.float32(1.0))
    points = (np.arange(1000) + 0.5) / 1000 * airy_radii / 2  # a quarter of the square, 25 or more per lambda f / D
    v = np.pi * np.hypot(points[:, None], points)
    wanted = np.mean(np.pi / 4 * (2 * j1(v) / v) ** 2) * airy_radii**2
    assert float(got[0, 0]) == pytest.approx(wanted, rel=2e-3)  # linear interpolation between fine radii


def test_distortion_that_draws_the_image_together_has_more_points_in_a_pixel():
    sine, airy_m = 0.45, YELLOW_M * 1e-3 / 20e-6
    pixel_m = np.sqrt(2) * (sine - 0.3 * sine**3) * 1e-3  # its corners have light of that sine
    wide = make_camera(20, 20e-6, 1e-3, float(pixel_m), 1)
    assert _points(wide, airy_m) == 2 * np.ceil(pixel_m / airy_m)
    drawn = pixel_m / airy_m / (1 - 0.9 * sine**2)  # by the slope of the distortion there
    assert _points(replace(wide, distortion=(-0.3, 0.0)), airy_m) == pytest.approx(2 * drawn, abs=2)


@pytest.mark.parametrize("depth_m", [np.inf, 0.02])
def test_gradient_against_finite_differences(depth_m: float, rng: np.random.Generator):
    plan = plan_hankel(CAMERA, YELLOW_M)
    weights = jnp.asarray(rng.uniform(size=(49, 49)), jnp.float32)
    source = jnp.asarray(ring_source_waves(CAMERA, depth_m, YELLOW_M))
    rate = jnp.float32(CAMERA.waves_per_metre(YELLOW_M))

    @jax.jit
    def loss(profile: jax.Array) -> jax.Array:
        return jnp.sum(weights * plan.energy(profile, source, rate))

    profile = jnp.asarray(noise_profile(ring_count(CAMERA)), jnp.float32)
    gradient = np.asarray(jax.jit(jax.grad(loss))(profile), np.float64)
    way = gradient / np.abs(gradient).max()
    step = np.float32(8e-9)
    slope = (float(loss(profile + step * way)) - float(loss(profile - step * way))) / (2 * float(step))
    # Float32 losses of order 1 over a change of order 0.1, and the curvature over 8 nm.
    assert slope == pytest.approx(float(gradient @ way), rel=5e-3)


def test_a_point_on_the_axis_delays_outer_rings():
    waves = ring_source_waves(CAMERA, 0.05, YELLOW_M)
    edges = np.arange(ring_count(CAMERA) * 3 + 1) * CAMERA.grid.pitch_m / 3
    radius = (edges[1:] + edges[:-1]) / 2
    path = np.sqrt(radius**2 + 0.05**2) - 0.05
    difference = waves - path / YELLOW_M
    # Whole waves apart, to the rounding of the naive difference.
    np.testing.assert_allclose(difference, np.round(difference), atol=1e-5)


@pytest.mark.parametrize("cells", [40, 41])
def test_a_raster_of_rings_gives_its_profile_back(cells: int):
    grid = Grid((cells, cells), 2e-6)
    profile = noise_profile((cells + 1) // 2)
    found = radial_profile(revolve(profile, grid), grid)
    assert found is not None
    # An odd grid's last ring reaches half a cell beyond the circle, but its centres lie within.
    np.testing.assert_array_equal(found, profile)


def test_what_is_no_raster_of_rings_has_no_profile():
    grid = Grid((40, 40), 2e-6)
    height = revolve(noise_profile(20), grid)
    height[20, 25] += 1e-9
    assert radial_profile(height, grid) is None
    assert radial_profile(np.zeros((40, 42)), Grid((40, 42), 2e-6)) is None
    # Outside the aperture anything may stand.
    height = revolve(noise_profile(20), grid)
    height[0, 0] = 1.0
    assert radial_profile(height, grid) is not None


def test_the_image_is_symmetric_and_even_windows_are_centred_on_a_corner():
    camera = make_camera(100, 0.2e-3, 0.36e-3, 1.85e-6, 20)
    plan = plan_hankel(camera, YELLOW_M)
    source = jnp.asarray(ring_source_waves(camera, 0.01, YELLOW_M))
    got = np.asarray(plan.energy(jnp.asarray(noise_profile(50), jnp.float32), source, jnp.float32(7.8e5)))
    for turned in (got.T, got[::-1], got[:, ::-1]):
        np.testing.assert_array_equal(got, turned)
