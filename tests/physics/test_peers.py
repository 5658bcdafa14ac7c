# pyright: reportMissingImports=false, reportArgumentType=false
# The peers come with the `bench` extra alone, and their stubs take no floats.
"""The same small tasks given to prysm, POPPY and HCIPy (extra `bench`); each compared where it says the same thing."""

import warnings
from types import ModuleType

import numpy as np
import pytest

from bench.psf import Task, adjoint_error, prysm, prysm_wavefronts
from bench.reference import YELLOW_M, make_camera, relative_error, wrapped_map
from sim.aperture import circle_coverage
from sim.camera import Camera
from sim.psf_bank import psf

CAMERA = make_camera(256, 0.512e-3, 2e-3, 1.85e-6, 32)
HEIGHT = wrapped_map(256, smooth_cells=4.0)
COVERAGE = circle_coverage(CAMERA.grid, CAMERA.aperture_m)
POINTS = 15  # per pixel and axis, for peers that only know points


def peer(name: str) -> ModuleType:
    """Import a peer, whose own warnings are not ours to answer for."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pytest.importorskip(name, reason=f"{name} is in the extra `bench`", exc_type=ImportError)


def ours() -> np.ndarray:
    return psf(HEIGHT, CAMERA, [np.inf]).energy[0, 0] / CAMERA.transmission(YELLOW_M)


def binned(intensity: np.ndarray) -> np.ndarray:
    """Point samples, `POINTS` per pixel and axis, as pixel energies of points instead of cells, in our units."""
    scale = YELLOW_M * CAMERA.focal_length_m
    n, step = CAMERA.window, CAMERA.pixel_m / POINTS
    fine = (np.arange(n * POINTS) - (n * POINTS - 1) / 2) * step
    envelope = np.sinc(fine * CAMERA.grid.pitch_m / scale) ** 2
    pixels = (intensity * np.outer(envelope, envelope)).reshape(n, POINTS, n, POINTS).sum(axis=(1, 3))
    return pixels * (CAMERA.grid.pitch_m**2 / scale * step) ** 2 / (np.pi / 4 * CAMERA.aperture_m**2)


def pupil64() -> np.ndarray:
    return COVERAGE * np.exp(2j * np.pi * HEIGHT * CAMERA.waves_per_metre(YELLOW_M))


def fine_camera() -> Camera:
    return make_camera(256, 0.512e-3, 2e-3, 1.85e-6 / POINTS, 32 * POINTS)


@pytest.mark.filterwarnings("ignore")
def test_prysm():
    peer("prysm")
    task = Task(fine_camera(), HEIGHT.astype(np.float32), COVERAGE, np.ones(1, np.float32))
    # An odd number of points per pixel puts them half a point off prysm's own lattice, as for any even window.
    sensor = prysm_wavefronts(task, 0.5)[1]
    cells = CAMERA.grid.shape[0]
    airy = YELLOW_M * CAMERA.focal_length_m / (cells * CAMERA.grid.pitch_m) / (CAMERA.pixel_m / POINTS)
    intensity = np.asarray(sensor.intensity.data, np.float64) * (cells * airy) ** 2  # without its 1 / (Q N)
    # Our rule's 2e-3, the midpoint rule's 1e-3 at fifteen points, and single precision on both sides.
    assert relative_error(ours(), binned(intensity)) < 3e-3


@pytest.mark.filterwarnings("ignore")
def test_the_adjoint_that_the_benchmark_times():
    peer("prysm")
    assert adjoint_error(prysm) < 1e-3  # central differences of a float32 sum


@pytest.mark.filterwarnings("ignore")
def test_poppy():
    peer("poppy.matrixDFT")
    from poppy.matrixDFT import MatrixFourierTransform

    # Its unit on the sensor is lambda f / D of the whole grid; "ADJUSTABLE" and "SYMMETRIC" lie between samples.
    airy = YELLOW_M * CAMERA.focal_length_m / (CAMERA.grid.shape[0] * CAMERA.grid.pitch_m)
    count = CAMERA.window * POINTS
    transform = MatrixFourierTransform(centering="SYMMETRIC")
    field = transform.perform(pupil64(), count * CAMERA.pixel_m / POINTS / airy, count)
    # Its transform has the other sign, which turns the image over, and is normalised to the energy
    # of its samples: undo nlam / (N npix).
    scale = CAMERA.grid.shape[0] * count / (count * CAMERA.pixel_m / POINTS / airy)
    assert relative_error(ours(), binned(np.abs(field[::-1, ::-1] * scale) ** 2)) < 3e-3  # as above


@pytest.mark.filterwarnings("ignore")
def test_hcipy():
    peer("hcipy")
    from hcipy import CartesianGrid, Field, FraunhoferPropagator, RegularCoords, Wavefront

    def grid(count: int, step: float) -> CartesianGrid:
        return CartesianGrid(RegularCoords([step, step], [count, count], np.full(2, -(count - 1) / 2 * step)))

    pupil_grid = grid(CAMERA.grid.shape[0], CAMERA.grid.pitch_m)
    sensor_grid = grid(CAMERA.window * POINTS, CAMERA.pixel_m / POINTS)
    propagate = FraunhoferPropagator(pupil_grid, sensor_grid, focal_length=CAMERA.focal_length_m)
    arrived = propagate(Wavefront(Field(pupil64().ravel(), pupil_grid), YELLOW_M))
    field = np.asarray(arrived.electric_field).reshape(CAMERA.window * POINTS, -1)
    # Its fields carry pitch² / (lambda f), which `binned` brings in itself.
    density = np.abs(field * YELLOW_M * CAMERA.focal_length_m / CAMERA.grid.pitch_m**2) ** 2
    assert relative_error(ours(), binned(density)) < 3e-3  # as above
