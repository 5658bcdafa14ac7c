"""Plates whose etches are not 2^k steps deep, where the answer is known exactly."""

import numpy as np
import pytest

from fab.grid import Grid
from fab.levels import Levels, height_of, planes
from fab.process import Process, Variation
from sim.camera import Camera, Colour
from sim.surface import as_fabricated

LEVELS = Levels(8, 150e-9, (520e-9, 160e-9, 330e-9))
LINE_M = 550e-9
# An aperture wider than the grid: all cells are open.
CAMERA = Camera(Grid((24, 24), 1.85e-6), 70e-6, "fused_silica", (Colour("green", (LINE_M,), (1.0,)),), 1e-3, 3.7e-6, 24)


@pytest.mark.parametrize(
    ("variation", "off_m"),
    [
        (Variation(), (0.0, 0.0, 0.0)),
        (Variation(repeats=(-1, 0, 0)), (520e-9, 0.0, 0.0)),
        (Variation(repeats=(0, 0, 1)), (0.0, 0.0, -330e-9)),
        (Variation(common_depth_scale=0.02), (-10.4e-9, -3.2e-9, -6.6e-9)),
        (Variation(depth_scale=(0.0, -0.05, 0.0)), (0.0, 8e-9, 0.0)),
    ],
    ids=["nominal", "missed", "doubled", "all deeper", "one shallower"],
)
def test_a_depth_that_is_off_moves_what_its_mask_opens(variation: Variation, off_m: tuple[float, ...]):
    level = np.random.default_rng(4).integers(0, 8, (24, 24)).astype(np.uint8)
    surface = as_fabricated(level, CAMERA, Process(LEVELS), variation)
    height = height_of(level, LEVELS) + np.tensordot(np.array(off_m), planes(level, LEVELS).astype(float), axes=1)
    meant = np.exp(2j * np.pi * CAMERA.waves_per_metre(LINE_M) * height)
    # Heights of a micrometre in single precision: 1e-7 of a wave.
    np.testing.assert_allclose(np.asarray(surface.at(LINE_M)), meant, atol=1e-5)
