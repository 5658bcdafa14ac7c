"""What PSFs are judged by: a plain float64 evaluation with sixteen samples per pixel and axis, and the maps to try.

Nothing here shares code with `sim.propagation.farfield` or `sim.propagation.pixel`: the field is summed at the sample
positions themselves and the pixel integral is the midpoint rule, whose own error at sixteen samples is up to 1e-3 (at
thirty-two, a fourth).
"""

from typing import Any

import numpy as np
from jaxtyping import Complex, Float
from scipy.ndimage import gaussian_filter
from scipy.signal import ZoomFFT

from fab.grid import Grid
from sim.camera import Camera, Colour

_BLOCK = 256
YELLOW_M = 589e-9


def make_camera(
    cells: int,
    aperture_m: float,
    focal_length_m: float,
    pixel_m: float,
    window: int,
    *,
    wavelength_m: float = YELLOW_M,
    fill: float = 1.0,
    defocus_m: float = 0.0,
) -> Camera:
    """Camera of one colour with a fused-silica plate, its grid as wide as the clear aperture (lengths in metres)."""
    colour = Colour("only", (wavelength_m,), (1.0,))
    grid = Grid((cells, cells), aperture_m / cells)
    return Camera(grid, aperture_m, "fused_silica", (colour,), focal_length_m, pixel_m, window, fill, defocus_m)


def wrapped_map(cells: int, seed: int = 0, smooth_cells: float = 2.0) -> Float[np.ndarray, "y x"]:
    """Smooth noise, wrapped to one wave and cut into 16 levels of 75 nm, in metres: like an optimised plate."""
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=(cells, cells)), smooth_cells, mode="wrap")
    waves = np.mod(noise / noise.std() * 0.5, 1.0)
    return np.floor(waves * 16) * 75e-9


def oversampled_psf(
    camera: Camera, wavelength_m: float, field: Complex[np.ndarray, "y x"], oversampling: int = 16
) -> Float[np.ndarray, "v u"]:
    """Pixel energies of a far field, per unit power on the clear aperture, in float64.

    Args:
        camera: square grid, sensor in focus.
        wavelength_m: vacuum wavelength.
        field: `[y, x]` complex field behind the DOE, constant within each cell.
        oversampling: samples per pixel and axis.
    """
    scale = wavelength_m * camera.sensor_distance_m
    pitch, cells = camera.grid.pitch_m, camera.grid.shape[0]
    count = camera.window * oversampling
    step = camera.pixel_m * camera.fill / oversampling
    offsets = (np.arange(oversampling) - (oversampling - 1) / 2) * step
    positions = (camera.axis_m()[:, None] + offsets).ravel()
    if camera.fill == 1.0:
        edge = positions[-1] * pitch / scale
        transform: Any = ZoomFFT(cells, [-edge, edge], count, fs=1, endpoint=True)
    else:
        matrix = np.exp(-2j * np.pi / scale * np.outer(camera.grid.axis_m("x"), positions))
        transform = matrix.__rmatmul__  # rows @ matrix

    envelope = np.sinc(positions * pitch / scale)
    half = np.concatenate([transform(field[i : i + _BLOCK]) for i in range(0, cells, _BLOCK)]) * envelope
    energy = np.empty((camera.window, camera.window))
    for u in range(camera.window):
        columns = np.ascontiguousarray(half[:, u * oversampling : (u + 1) * oversampling].T)
        intensity = np.abs(transform(columns) * envelope) ** 2
        energy[:, u] = intensity.reshape(oversampling, camera.window, oversampling).sum(axis=(0, 2))
    area = np.pi * camera.aperture_m**2 / 4
    return energy * (pitch**2 / scale * step) ** 2 / area


def relative_error(got: Float[np.ndarray, "*s"], wanted: Float[np.ndarray, "*s"]) -> float:
    """Relative L2 difference, in float64."""
    difference = np.asarray(got, np.float64) - wanted
    return float(np.linalg.norm(difference) / np.linalg.norm(wanted))
