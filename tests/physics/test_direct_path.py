"""The direct path against Fresnel diffraction in closed form, and the far field against the direct path."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import fresnel

from bench.reference import YELLOW_M, make_camera, relative_error
from sim.aperture import circle_coverage
from sim.camera import Camera
from sim.propagation.fresnel import Kernel, plan_direct
from sim.propagation.pupil import DoeRows, doe_field
from sim.psf_bank import psf
from sim.source import MapColumns, source_path_m, wrapped_waves

NO_LENS_M = 1e5  # focal length whose curvature over half a millimetre is 1e-6 of a wave


def without_lens(cells: int, aperture_m: float, distance_m: float, pixel_m: float, window: int) -> Camera:
    return make_camera(cells, aperture_m, NO_LENS_M, pixel_m, window, defocus_m=distance_m - NO_LENS_M)


def shadow(camera: Camera, coverage: np.ndarray, kernel: Kernel) -> np.ndarray:
    """Energy per pixel behind an opening, per unit power on the whole aperture."""
    source = wrapped_waves(source_path_m(camera, np.inf), YELLOW_M)
    rows = DoeRows(jnp.asarray(coverage, jnp.float32), None, None, jnp.asarray(source))
    plan = plan_direct(camera, YELLOW_M, kernel)
    return np.asarray(jax.jit(lambda r: plan.energy(doe_field, r, MapColumns(jnp.float32(0.0))))(rows))


def slit_intensity(x_m: np.ndarray, width_m: float, distance_m: float) -> np.ndarray:
    """Intensity behind a slit in a unit plane wave, from Cornu's spiral (Born and Wolf, §8.7)."""
    scale = np.sqrt(2 / (YELLOW_M * distance_m))
    s1, c1 = fresnel((x_m + width_m / 2) * scale)
    s0, c0 = fresnel((x_m - width_m / 2) * scale)
    return ((c1 - c0) ** 2 + (s1 - s0) ** 2) / 2


@pytest.mark.slow
@pytest.mark.parametrize("kernel", [pytest.param("fresnel", marks=pytest.mark.slow), "angular_spectrum"])
@pytest.mark.parametrize("distance_m", [pytest.param(6e-3, marks=pytest.mark.slow), 20e-3])
def test_square_opening(kernel: Kernel, distance_m: float):
    """A square of 200 um; its edges lie on cell edges."""
    camera = without_lens(800, 0.4e-3, distance_m, 2e-6, 120)
    axis = camera.grid.axis_m("x")
    open_1d = np.abs(axis) < 0.1e-3
    got = shadow(camera, open_1d[:, None] & open_1d[None, :], kernel)
    points = ((np.arange(10) + 0.5) / 10 - 0.5) * camera.pixel_m
    profile = slit_intensity(camera.axis_m()[:, None] + points, 0.2e-3, distance_m).mean(axis=1)
    wanted = np.outer(profile, profile) * camera.pixel_m**2 / (np.pi / 4 * camera.aperture_m**2)
    # The padded grid of three apertures stops the angles that leave it: an edge's ripples finer than its
    # 1 / (2 * 0.4 mm) are missing, some 1 % of the amplitude at the edge.
    assert relative_error(got, wanted) < 0.015
    assert got.sum(dtype=np.float64) == pytest.approx(wanted.sum(), rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("zones", [2.0, *(pytest.param(zones, marks=pytest.mark.slow) for zones in (1.0, 3.0))])
def test_circular_opening_on_the_axis(zones: float):
    """4 sin²(pi N / 2) times the open wave for Fresnel number N: bright for odd, dark for even numbers of zones."""
    radius = 0.15e-3
    distance = radius**2 / (YELLOW_M * zones)
    camera = without_lens(800, 2 * radius, distance, 1.5e-6, 21)
    got = shadow(camera, circle_coverage(camera.grid, camera.aperture_m), "fresnel")[10, 10]
    open_wave = camera.pixel_m**2 / (np.pi * radius**2)
    # What the rim scatters beyond the kernel's band is missing: about 1 % of the amplitude.
    assert got / open_wave == pytest.approx(4 * np.sin(np.pi * zones / 2) ** 2, abs=0.08)


def smooth_plate(cells: int) -> np.ndarray:
    noise = gaussian_filter(np.random.default_rng(2).normal(size=(cells, cells)), 8)
    return np.mod(noise / noise.std() * 0.5, 1.2) * 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("depth_m", [pytest.param(np.inf, marks=pytest.mark.slow), 0.05])
@pytest.mark.parametrize("defocus_m", [1e-4, pytest.param(0.0, marks=pytest.mark.slow)])
def test_far_field_agrees_with_the_direct_path(depth_m: float, defocus_m: float):
    camera = make_camera(800, 0.4e-3, 8e-3, 3.7e-6, 64, defocus_m=defocus_m)
    height = smooth_plate(800)
    far = psf(height, camera, [depth_m]).energy[0, 0].astype(np.float64)
    paraxial = psf(height, camera, [depth_m], propagation="fresnel").energy[0, 0]
    # Same paraxial physics, other route; half-micrometre cells hardly differ from points.
    assert relative_error(paraxial, far) < 1e-3
    exact = psf(height, camera, [depth_m], propagation="angular_spectrum").energy[0, 0]
    # At f/20 the paraxial phase is off by D^4 / (128 f^3) = 0.4 nm in the pupil, and by more for diffracted light.
    assert relative_error(exact, far) < 1e-2
