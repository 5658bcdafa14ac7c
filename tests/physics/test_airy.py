"""A clear aperture in focus: the Airy disc and its encircled energy."""

import numpy as np
import pytest
from scipy.special import j0, j1

from bench.reference import YELLOW_M, make_camera, relative_error
from sim.camera import Camera
from sim.metrics import encircled_energy
from sim.psf_bank import psf


def flat_psf(camera: Camera) -> np.ndarray:
    bank = psf(np.zeros(camera.grid.shape), camera, [np.inf])
    return bank.energy[0, 0] / camera.transmission(YELLOW_M)


def airy_energy(camera: Camera, points: int = 24) -> np.ndarray:
    """Energy per pixel of the Airy pattern, by points x points midpoints."""
    side = camera.pixel_m * camera.fill
    offsets = ((np.arange(points) + 0.5) / points - 0.5) * side
    axis = (camera.axis_m()[:, None] + offsets).ravel()
    v = np.pi * camera.aperture_m / (YELLOW_M * camera.focal_length_m) * np.hypot(axis[:, None], axis)
    v = np.maximum(v, 1e-9)
    peak = np.pi / 4 * (camera.aperture_m / (YELLOW_M * camera.focal_length_m)) ** 2
    n = camera.window
    return (peak * (2 * j1(v) / v) ** 2).reshape(n, points, n, points).mean(axis=(1, 3)) * side**2


@pytest.mark.parametrize(
    ("pixel_m", "window", "fill"),
    [(1.85e-6, 64, 1.0), (1.85e-6, 65, 0.8), (3.7e-6, 32, 1.0), (0.5e-6, 101, 1.0)],
)
def test_profile(pixel_m: float, window: int, fill: float):
    camera = make_camera(600, 1.2e-3, 2.16e-3, pixel_m, window, fill=fill)  # f/1.8: lambda f / D = 1.06 um
    # The rule's own 2e-3, and what a disc of square cells lacks of a true one at six hundred cells across.
    assert relative_error(flat_psf(camera), airy_energy(camera)) < 3e-3


def test_encircled_energy():
    camera = make_camera(600, 1.2e-3, 4e-3, 0.25e-6, 161)
    radii = np.array([1.0, 2.0, 3.0, 5.0, 8.0]) * YELLOW_M * camera.focal_length_m / camera.aperture_m
    v = np.pi * radii * camera.aperture_m / (YELLOW_M * camera.focal_length_m)
    # Eight pixels per lambda f / D; a rim that cuts a steep part of the profile is blurred by half of one.
    wanted = 1 - j0(v) ** 2 - j1(v) ** 2
    np.testing.assert_allclose(encircled_energy(flat_psf(camera), camera.pixel_m, radii), wanted, atol=3e-3)


def test_narrow_windows_see_the_same_pixels():
    wide = make_camera(300, 0.6e-3, 1.08e-3, 1.85e-6, 60)
    narrow = make_camera(300, 0.6e-3, 1.08e-3, 1.85e-6, 20)
    assert relative_error(flat_psf(narrow), flat_psf(wide)[20:40, 20:40].astype(np.float64)) < 1e-5


@pytest.mark.parametrize("fill", [1.0, 0.5])
def test_the_bright_middle_by_hand(fill: float):
    """Energy of the middle pixel, if it is much smaller than the disc, is the peak density times its area."""
    camera = make_camera(200, 0.2e-3, 8e-3, 0.5e-6, 21, fill=fill)  # lambda f / D = 23.6 um
    peak = np.pi / 4 * (0.2e-3 / (YELLOW_M * 8e-3)) ** 2 * (0.5e-6 * fill) ** 2
    assert flat_psf(camera)[10, 10] == pytest.approx(peak, rel=3e-3)
