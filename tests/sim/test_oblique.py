"""How oblique light is, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from bench.reference import YELLOW_M, make_camera
from fab.aperture import RectangularAperture
from sim.illumination import EvenBeam
from sim.propagation.oblique import oblique_waves

CAMERA = make_camera(100, 0.2e-3, 1e-3, 4e-6, 40)
CELL = 2e-6 / YELLOW_M  # waves per cell for a sine of 1


def test_obliquity_behind_a_lens_that_images_sines():
    waves = oblique_waves(CAMERA, YELLOW_M, (5e-3, np.inf, 20e-3))
    # From the middle to a pixel beyond the window's edge; from the rim to the nearest and the farthest source.
    assert waves.seen == pytest.approx(21 * 4e-6 / 1e-3 * CELL, rel=1e-12)
    assert (waves.low, waves.high) == pytest.approx((0.0, 0.1e-3 / 5e-3 * CELL), rel=1e-12)
    halves = waves.over(2)
    assert halves == pytest.approx(np.array(waves) / 2, rel=1e-12)


def test_a_tangent_lens_sees_the_sine_of_its_angle():
    seen = oblique_waves(replace(CAMERA, mapping="tangent", pixel_m=4e-5), YELLOW_M, (np.inf,)).seen
    assert seen == pytest.approx(np.sin(np.arctan(21 * 4e-5 / 1e-3)) * CELL, rel=1e-12)


def test_a_sensor_out_of_focus_and_a_long_aperture():
    """1/z + 1/d - 1/f at half of the longer side: near sources spread the light, far ones gather it."""
    camera = replace(CAMERA, defocus_m=0.1e-3, aperture=RectangularAperture((0.1e-3, 0.18e-3)))
    common = 1 / 1.1e-3 - 1 / 1e-3
    waves = oblique_waves(camera, YELLOW_M, (np.inf, 8e-3))
    assert (waves.low, waves.high) == pytest.approx(
        (0.09e-3 * common * CELL, 0.09e-3 * (common + 125) * CELL), rel=1e-12
    )
    assert waves.low < 0 < waves.high


def test_light_aslant_beside_the_window_is_more_oblique():
    camera = replace(CAMERA, beam=EvenBeam(tilt_rad=(-0.02, 0.01)))
    more = oblique_waves(camera, YELLOW_M, (np.inf,)).seen - oblique_waves(CAMERA, YELLOW_M, (np.inf,)).seen
    tangents = np.tan([-0.02, 0.01])
    assert more == pytest.approx(abs(tangents[0]) / np.sqrt(1 + np.sum(tangents**2)) * CELL, rel=1e-9)
