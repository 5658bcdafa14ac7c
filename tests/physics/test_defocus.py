"""Near sources: the geometric blur disc D f / z behind a clear aperture."""

import numpy as np
import pytest

from bench.reference import YELLOW_M, make_camera
from sim.metrics import encircled_energy
from sim.psf_bank import psf


def half_energy_radius(image: np.ndarray, pixel_m: float, total: float) -> float:
    radii = np.linspace(0.1, 0.5, 33) * image.shape[0] * pixel_m
    return float(np.interp(0.5 * total, encircled_energy(image, pixel_m, radii), radii))


@pytest.mark.parametrize(
    ("depth_m", "defocus_m"), [(0.1, 0.0), (0.2, 0.0), (np.inf, 4e-4), (np.inf, -4e-4), (0.15, 1e-4)]
)
def test_the_disc_is_as_wide_as_geometry_says(depth_m: float, defocus_m: float):
    """Uniformly lit, so half the light lies within 1/sqrt(2) of the radius."""
    camera = make_camera(768, 3e-3, 8e-3, 3e-6, 100, defocus_m=defocus_m)
    image = psf(np.zeros((768, 768)), camera, [depth_m]).energy[0, 0]
    passed = camera.transmission(YELLOW_M)
    radius = camera.defocus_radius_m(depth_m)
    assert half_energy_radius(image, camera.pixel_m, passed) == pytest.approx(radius / np.sqrt(2), rel=0.02)
    # The edge of the shadow is blurred over sqrt(lambda d²/ z) or so, which a Fresnel number above ten keeps thin.
    inner, outer = encircled_energy(image, camera.pixel_m, np.array([0.5, 1.15]) * radius)
    assert inner == pytest.approx(0.25 * passed, rel=0.06)
    assert outer > 0.97 * passed


def test_the_disc_in_the_focal_plane_is_d_f_over_z():
    camera = make_camera(64, 4e-3, 8e-3, 3e-6, 16)
    for depth_m in (0.05, 0.12, 5.0):
        assert 2 * camera.defocus_radius_m(depth_m) == pytest.approx(4e-3 * 8e-3 / depth_m)


def test_refocusing_makes_the_near_source_sharp():
    depth = 0.5
    sensor = 8e-3 * depth / (depth - 8e-3)
    camera = make_camera(512, 2e-3, 8e-3, 3e-6, 31, defocus_m=sensor - 8e-3)
    sharp = psf(np.zeros((512, 512)), camera, [depth]).energy[0, 0]
    star = psf(np.zeros((512, 512)), make_camera(512, 2e-3, sensor, 3e-6, 31), [np.inf]).energy[0, 0]
    # The sphere and the parabola differ by D^4 / (128 z^3) = 1 nm here.
    np.testing.assert_allclose(sharp, star, atol=2e-4 * star.max())
