"""Signs, axes and centres, stated once in `sim/__init__.py` and pinned here."""

import dataclasses
from typing import Literal

import numpy as np
import pytest

from bench.reference import YELLOW_M, make_camera
from sim.camera import Camera
from sim.optic import HeightOptic
from sim.psf_bank import psf
from sim.source import path_at_m


def peak(image: np.ndarray) -> tuple[int, int]:
    y, x = np.unravel_index(np.argmax(image), image.shape)
    return int(y), int(x)


def wedge(camera: Camera, slope_y: float, slope_x: float) -> np.ndarray:
    """Heights that grow toward +y and +x."""
    y, x = (camera.grid.axis_m(a) for a in ("y", "x"))
    height = slope_y * y[:, None] + slope_x * x[None, :]
    return height - height.min()


@pytest.mark.parametrize("propagation", ["far_field", "fresnel", "angular_spectrum"])
def test_glass_that_thickens_toward_plus_y_sends_light_to_plus_y(
    propagation: Literal["far_field", "fresnel", "angular_spectrum"],
):
    camera = make_camera(400, 0.2e-3, 4e-3, 3e-6, 41)
    delay = camera.waves_per_metre(YELLOW_M) * YELLOW_M  # n - 1
    # f (n - 1) slope is the displacement: 8 pixels in y, -5 in x.
    shift = np.array([8, -5]) * camera.pixel_m
    slopes = shift / (camera.focal_length_m * delay)
    image = psf(wedge(camera, *slopes), camera, [np.inf], propagation=propagation).energy[0, 0]
    assert peak(image) == (20 + 8, 20 - 5)


def test_thicker_glass_means_more_phase():
    camera = make_camera(64, 0.2e-3, 4e-3, 3e-6, 8)
    quarter = np.full((64, 64), 0.25 / camera.waves_per_metre(YELLOW_M))
    field = np.asarray(HeightOptic.of(camera, quarter).field(camera.lines[0]))
    assert field[32, 32] == pytest.approx(1j, abs=1e-5)  # the accuracy of `cis` and a float32 height


@pytest.mark.parametrize("propagation", ["far_field", "angular_spectrum"])
@pytest.mark.parametrize("cells", [400, 401])
@pytest.mark.parametrize("window", [32, 33])
def test_windows_are_centred_on_the_chief_ray(
    propagation: Literal["far_field", "angular_spectrum"], cells: int, window: int
):
    camera = make_camera(cells, 0.2e-3, 4e-3, 3e-6, window)
    image = psf(np.zeros((cells, cells)), camera, [np.inf], propagation=propagation).energy[0, 0]
    brightest = image.max()
    if window % 2:
        assert peak(image) == (16, 16)
        assert np.sum(image > 0.9 * brightest) == 1
    else:
        # The four middle pixels share it; float32 and the rule's error (2e-3) tell them apart.
        np.testing.assert_allclose(image[15:17, 15:17], brightest, rtol=5e-3)
    np.testing.assert_allclose(image, image[::-1, ::-1], atol=5e-3 * brightest)


def test_a_source_below_the_axis_lights_a_tilted_wave_toward_plus_y():
    """Positive field angles: the light travels toward +y, so the path grows with y by the sine of the angle."""
    camera = make_camera(64, 1e-3, 8e-3, 3e-6, 8)
    angle, depth = 0.2, 0.05
    y = np.array([-1e-4, 1e-4])
    source_y = -depth * np.tan(angle)
    path = np.hypot(y - source_y, depth)
    assert (path[1] - path[0]) / 2e-4 == pytest.approx(np.sin(angle), rel=1e-4)  # third order in y / z
    without_tilt = path - np.hypot(source_y, depth) - np.sin(angle) * y
    np.testing.assert_allclose(path_at_m(camera, y, np.zeros(()), depth, (angle, 0.0)), without_tilt, atol=1e-15)


def test_a_near_source_off_axis_is_lopsided_along_its_own_axis():
    """The coma of an oblique spherical wave lies in the plane of the field angle and turns over with its sign."""
    camera = make_camera(256, 1e-3, 1.8e-3, 3.7e-6, 64)
    flat = np.zeros((256, 256))
    up, down, right = (
        psf(flat, camera, [8e-3], field_rad=f).energy[0, 0] for f in ((0.4, 0.0), (-0.4, 0.0), (0.0, 0.4))
    )
    scale = up.max()
    assert np.abs(up - up[::-1]).max() > 0.05 * scale
    np.testing.assert_allclose(up, down[::-1], atol=1e-2 * scale)  # samples fall differently on a turned window
    np.testing.assert_allclose(up, right.T, atol=1e-2 * scale)


def test_a_plate_may_be_turned_with_its_image(rng: np.random.Generator):
    """Rows are y and columns are x on both sides: transposing the plate transposes the image, mirroring mirrors."""
    camera = make_camera(128, 0.3e-3, 0.54e-3, 1.85e-6, 33)
    height = rng.uniform(0, 1.2e-6, (128, 128))
    image = psf(height, camera, [0.03]).energy[0, 0]
    scale = image.max()
    np.testing.assert_allclose(psf(height.T, camera, [0.03]).energy[0, 0], image.T, atol=1e-3 * scale)
    np.testing.assert_allclose(psf(height[::-1], camera, [0.03]).energy[0, 0], image[::-1], atol=5e-3 * scale)


def test_fill_takes_the_middle_of_the_pixel():
    camera = make_camera(128, 0.3e-3, 0.54e-3, 1.85e-6, 33)
    flat = np.zeros((128, 128))
    whole, part = (psf(flat, dataclasses.replace(camera, fill=f), [2e-3]).energy[0, 0] for f in (1.0, 0.8))
    # The blur disc is wider than the window and its fringes wider than a pixel, so energy goes with the area.
    assert part.sum() / whole.sum() == pytest.approx(0.64, abs=0.01)
