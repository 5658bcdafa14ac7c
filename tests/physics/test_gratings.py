"""Gratings, whose orders have closed forms: sinc²(1/L) for L levels, cos²(phi/2) for the 0th order of a binary one."""

import numpy as np
import pytest

from bench.reference import YELLOW_M, make_camera
from sim.camera import Camera
from sim.metrics import zeroth_order
from sim.optic import HeightOptic
from sim.psf_bank import psf

CELLS = 512
PITCH = 1.85e-6
PER_ORDER = 15  # pixels between orders


def ruled_camera(period_cells: int, orders: int) -> Camera:
    """A sensor with `PER_ORDER` pixels from one order to the next, wide enough for orders -orders .. orders."""
    spacing = YELLOW_M * 8e-3 / (period_cells * PITCH)
    return make_camera(CELLS, CELLS * PITCH, 8e-3, spacing / PER_ORDER, (2 * orders + 1) * PER_ORDER)


def efficiency(camera: Camera, height: np.ndarray, order: int) -> float:
    """Energy around an order over that of a flat plate around the axis, in boxes of the same size."""
    middle = camera.window // 2
    rows = slice(middle - PER_ORDER // 2, middle + PER_ORDER // 2 + 1)

    def box(plate: np.ndarray, column: int) -> float:
        left = column - PER_ORDER // 2
        return float(psf(plate, camera, [np.inf]).energy[0, 0][rows, left : left + PER_ORDER].sum())

    return box(height, middle + order * PER_ORDER) / box(np.zeros_like(height), middle)


@pytest.mark.parametrize(
    ("levels", "percent"), [(2, 40.5), (3, 68.4), (4, 81.1), (5, 87.5), (6, 91.2), (8, 95.0), (16, 98.7)]
)
@pytest.mark.parametrize("cells_per_level", [1, 4])
def test_blazed_grating(levels: int, percent: float, cells_per_level: int):
    """The same plate drawn with one cell per level or four: the cell's own sinc² makes both right."""
    period = levels * cells_per_level
    if period < 4:
        period, cells_per_level = 8, 4  # orders of a two-cell grating lie on the edge of the band
    camera = ruled_camera(period, 1)
    step = 1 / levels / camera.waves_per_metre(YELLOW_M)
    level = np.arange(CELLS) // cells_per_level % levels
    height = np.broadcast_to(level * step, (CELLS, CELLS)).copy()
    # Neighbouring orders reach into the box with their Airy tails, a few parts in a thousand of a strong neighbour.
    assert efficiency(camera, height, 1) == pytest.approx(percent / 100, abs=4e-3)
    assert percent / 100 == pytest.approx(np.sinc(1 / levels) ** 2, abs=6e-4)


def binary_plate(camera: Camera, waves: float, period_cells: int = 16) -> np.ndarray:
    ridge = (np.arange(CELLS) // (period_cells // 2)) % 2
    return np.broadcast_to(ridge * waves / camera.waves_per_metre(YELLOW_M), (CELLS, CELLS)).copy()


@pytest.mark.parametrize("waves", [0.0, 0.1, 0.25, 0.4, 0.5, 0.75, 1.0])
def test_zeroth_order_of_a_binary_grating(waves: float):
    camera = ruled_camera(16, 1)
    height = binary_plate(camera, waves)
    wanted = np.cos(np.pi * waves) ** 2
    # Ridges and grooves mirror each other on the disc, so both have half its area; the rest is float32.
    assert zeroth_order(HeightOptic.of(camera, height))[0] == pytest.approx(wanted, abs=3e-5)
    assert efficiency(camera, height, 0) == pytest.approx(wanted, abs=5e-3)  # tails of the first orders, as above


def test_first_orders_of_a_binary_half_wave_are_equal():
    camera = ruled_camera(16, 1)
    height = binary_plate(camera, 0.5)
    left, right = efficiency(camera, height, -1), efficiency(camera, height, 1)
    assert left == pytest.approx(4 / np.pi**2, abs=4e-3)  # tails, as above
    assert left == pytest.approx(right, abs=1e-3)
