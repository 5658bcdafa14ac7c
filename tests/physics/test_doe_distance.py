"""A DOE some way before its lens: against the wave propagated to the lens, through it, and on to the sensor.

Everything is separable: a square aperture, heights that are sums of one along y and one along x. So the reference is
two Fresnel integrals in one dimension, summed in float64 over points far finer than a cell; it knows nothing of Fourier
transforms, ray matrices or Collins' integral.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from fab.errors import InputError
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.propagation.farfield import plan_far_field
from sim.propagation.fresnel import plan_direct
from sim.propagation.pupil import DoeRows, doe_field
from sim.source import MapColumns, source_path_m, wrapped_waves

WAVELENGTH_M, CELLS, PITCH_M, PIXEL_M, WINDOW, FOCAL_M, DEPTH_M = 550e-9, 48, 2e-6, 3.7e-6, 32, 2e-3, 20e-3
ONE = (Colour("one", (WAVELENGTH_M,), (1.0,)),)
CAMERA = Camera(Grid((CELLS, CELLS), PITCH_M), CELLS * PITCH_M, "fused_silica", ONE, FOCAL_M, PIXEL_M, WINDOW)
HEIGHTS_M = 75e-9 * np.random.default_rng(3).integers(0, 8, (2, CELLS))


def chirp(to_m: np.ndarray, from_m: np.ndarray, distance_m: float) -> np.ndarray:
    """Fresnel's kernel in one dimension, but for a constant phase."""
    square = (to_m[:, None] - from_m) ** 2
    return np.exp(1j * np.pi / WAVELENGTH_M * square / distance_m) / np.sqrt(WAVELENGTH_M * distance_m)


def along(height_m: np.ndarray, camera: Camera, depth_m: float) -> np.ndarray:
    """Energy in every pixel along one axis, per unit intensity and length of the aperture."""
    fine, at_lens = 16, (np.arange(6400) - 3199.5) * 0.2e-6
    cells_m = (np.arange(CELLS * fine) - (CELLS * fine - 1) / 2) * PITCH_M / fine
    wave = np.exp(2j * np.pi * np.repeat(height_m, fine) * camera.waves_per_metre(WAVELENGTH_M))
    wave = wave * np.exp(1j * np.pi / WAVELENGTH_M * cells_m**2 / depth_m)
    lens = chirp(at_lens, cells_m, camera.doe_distance_m) @ wave * (PITCH_M / fine)
    lens = lens * np.exp(-1j * np.pi / WAVELENGTH_M * at_lens**2 / camera.focal_length_m)
    # Light at 0.64 mm comes from angles that miss the window by far; a soft end keeps it from ringing.
    lens = lens * np.cos(np.pi / 2 * np.clip(np.abs(at_lens) / 0.3e-3 - 1, 0, 1)) ** 2
    points = ((np.arange(24) + 0.5) / 24 - 0.5) * PIXEL_M
    sensor = (camera.axis_m()[:, None] + points).ravel()
    field = chirp(sensor, at_lens, camera.focal_length_m + camera.defocus_m) @ lens * 0.2e-6
    return (np.abs(field) ** 2).reshape(WINDOW, 24).mean(1) * PIXEL_M


def computed(camera: Camera, depth_m: float) -> np.ndarray:
    height = jnp.asarray(HEIGHTS_M[0][:, None] + HEIGHTS_M[1], jnp.float32)
    source = jnp.asarray(wrapped_waves(source_path_m(camera, depth_m), WAVELENGTH_M))
    columns = MapColumns(jnp.float32(camera.waves_per_metre(WAVELENGTH_M)))
    plan = plan_far_field(camera, WAVELENGTH_M, depth_m=depth_m)
    energy = plan.energy(doe_field, DoeRows(jnp.ones_like(height), height, None, source), columns)
    return np.asarray(energy, np.float64) * np.pi * camera.aperture_m**2 / 4  # per unit intensity


def missed(found: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))


@pytest.mark.slow
@pytest.mark.parametrize("depth_m", [DEPTH_M, np.inf])
@pytest.mark.parametrize("defocus_m", [0.15e-3, -0.1e-3, 0.0])
def test_a_doe_before_the_lens(defocus_m: float, depth_m: float):
    camera = replace(CAMERA, defocus_m=defocus_m, doe_distance_m=1.5e-3)
    wanted = np.multiply.outer(*(along(height, camera, depth_m) for height in HEIGHTS_M))
    # Pixels are integrated to 2e-3 for round apertures; a square one is wider along its diagonals.
    assert missed(computed(camera, depth_m), wanted) < 6e-3
    at_the_lens = computed(replace(camera, doe_distance_m=0.0), depth_m)
    if defocus_m:
        assert missed(at_the_lens, wanted) > 0.03
    else:  # in the focal plane its place does not matter, for any source
        np.testing.assert_allclose(at_the_lens, computed(camera, depth_m), rtol=1e-6)


def test_the_blur_disc_follows():
    """A ray from the axis through the aperture's rim, traced by hand."""
    camera = replace(CAMERA, defocus_m=0.15e-3, doe_distance_m=1.5e-3)
    height, slope = camera.aperture_m / 2, camera.aperture_m / 2 / DEPTH_M
    height += slope * camera.doe_distance_m
    slope -= height / camera.focal_length_m
    height += slope * (camera.focal_length_m + camera.defocus_m)
    assert camera.defocus_radius_m(DEPTH_M) == pytest.approx(abs(height), rel=1e-12)


def test_the_direct_path_refuses_it():
    with pytest.raises(InputError, match="lies on the lens"):
        plan_direct(replace(CAMERA, doe_distance_m=1e-3), WAVELENGTH_M)
