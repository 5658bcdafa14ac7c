"""Modulation transfer before sampling, against the closed form and against a finely sampled PSF."""

import numpy as np
import pytest

from bench.reference import YELLOW_M, make_camera, wrapped_map
from sim.propagation.pixel import disc_autocorrelation
from sim.psf_bank import psf
from sim.transfer import mtf


@pytest.mark.parametrize("pixel_m", [3.7e-6, 0.4e-6])
def test_flat_plate_has_the_transfer_of_a_circular_aperture(pixel_m: float):
    camera = make_camera(600, 1.2e-3, 2.16e-3, pixel_m, 16)
    found = mtf(np.zeros(camera.grid.shape), camera, [np.inf])
    nu = found.frequencies_per_m
    cutoff = camera.aperture_m / (YELLOW_M * camera.focal_length_m)
    wanted = disc_autocorrelation(nu / cutoff) * np.abs(np.sinc(nu * pixel_m))
    # An edge cell of open share c passes c² here and c in truth: on average 1/6 of a cell for each of the about 4/pi x
    # 600 x pi / 2 cells that the circle cuts, over an area of 600² pi/4 cells, so 1.1e-3 at frequency zero.
    np.testing.assert_allclose(found.transfer[0, 0], wanted, atol=1.5e-3)
    assert nu[-1] == pytest.approx(0.5 / pixel_m)


def test_rough_plate_agrees_with_its_finely_sampled_psf():
    # Cells of 5 um: the band is 0.47 mm wide, the window 1.5 mm, so little light is missing from the PSF.
    camera = make_camera(64, 0.32e-3, 4e-3, 1.5e-6, 1000)
    height = wrapped_map(64)
    found = mtf(height, camera, [0.08], count=40)
    image = psf(height, camera, [0.08]).energy[0, 0].astype(np.float64)
    x = camera.axis_m()
    spectrum = np.abs(np.exp(-2j * np.pi * np.outer(found.frequencies_per_m, x)) @ image.sum(axis=0)) / image.sum()
    # 2 % of the light lies beyond the window; it is the transform's error at low frequencies.
    np.testing.assert_allclose(found.transfer[0, 0], spectrum, atol=0.02)


def test_light_does_not_depend_on_the_window():
    narrow, wide = (make_camera(200, 0.4e-3, 2e-3, 2e-6, window) for window in (8, 64))
    height = wrapped_map(200)
    first, second = (mtf(height, camera, [0.05, np.inf]) for camera in (narrow, wide))
    assert np.array_equal(first.transfer, second.transfer)


def test_under_an_angle_it_is_that_of_the_psf_there():
    """Of a rough plate, at 20 degrees: its phase is another than on the axis."""
    camera, field = make_camera(64, 0.32e-3, 4e-3, 1.5e-6, 1000), (0.0, np.radians(20))
    height = wrapped_map(64)
    found = mtf(height, camera, [0.08], count=40, field_rad=field)
    image = psf(height, camera, [0.08], field_rad=field).energy[0, 0].astype(np.float64)
    spectrum = np.abs(np.exp(-2j * np.pi * np.outer(found.frequencies_per_m, camera.axis_m())) @ image.sum(axis=0))
    np.testing.assert_allclose(found.transfer[0, 0], spectrum / image.sum(), atol=0.02)
    on_axis = mtf(height, camera, [0.08], count=40)
    assert np.abs(found.transfer - on_axis.transfer).max() > 2e-3
