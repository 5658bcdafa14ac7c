"""Nothing is lost and nothing is made: all pixels together hold what the substrate lets through."""

import numpy as np
import pytest

from bench.reference import YELLOW_M, make_camera, wrapped_map
from sim.metrics import energy_budget
from sim.optic import HeightOptic
from sim.psf_bank import psf


@pytest.mark.parametrize("plate", ["flat", "wrapped", "noise"])
def test_a_very_wide_sensor_catches_everything(plate: str, rng: np.random.Generator):
    """The sensor reaches over 13 x 13 replicas of the cells' band, each damped by the cell's sinc²."""
    cells, aperture, focal = 64, 0.128e-3, 0.2e-3
    band = YELLOW_M * focal / (aperture / cells)
    camera = make_camera(cells, aperture, focal, band * 13 / 390, 390)
    height = {"flat": np.zeros, "wrapped": lambda s: wrapped_map(s[0]), "noise": lambda s: rng.uniform(0, 1.2e-6, s)}
    image = psf(height[plate]((cells, cells)), camera, [np.inf]).energy[0, 0]
    # White noise leaves 2 / (pi² 6.5) = 3.1 % beyond per axis; edge cells count by area, not by its square root.
    missing = {"flat": 0.006, "wrapped": 0.02, "noise": 0.062}[plate]
    edge = 1 - float(np.sum(np.square(coverage_of(cells), dtype=np.float64))) / (np.pi / 4 * cells**2)
    share = image.sum(dtype=np.float64) / camera.transmission(YELLOW_M)
    assert share < 1
    assert share == pytest.approx(1 - edge - missing / 2, abs=missing / 2 + 0.004)


def coverage_of(cells: int) -> np.ndarray:
    from fab.grid import Grid
    from sim.aperture import circle_coverage

    return circle_coverage(Grid((cells, cells), 1.0), float(cells))


@pytest.mark.slow
def test_no_period_of_the_spectrum_counts_twice():
    """Windows of one, two and three bands of a wrapped plate hold what Parseval leaves them."""
    cells, aperture, focal = 96, 0.192e-3, 0.3e-3
    band = YELLOW_M * focal / (aperture / cells)
    sums = []
    for periods in (1, 2, 4):
        camera = make_camera(cells, aperture, focal, band / 48, 48 * periods)
        image = psf(wrapped_map(cells), camera, [np.inf]).energy[0, 0]
        sums.append(float(image.sum(dtype=np.float64)))
        if periods == 1:
            budget = energy_budget(HeightOptic.of(camera, wrapped_map(cells)), image, np.inf, camera.colours[0])
            # The window is the band itself, so nothing of it is left over but the last row's rounding of pixels.
            assert budget.uncollected == pytest.approx(0, abs=2e-3)
    assert all(np.diff(sums) > 0)
    assert sums[-1] < camera.transmission(YELLOW_M)


def test_energy_does_not_depend_on_where_it_lands(rng: np.random.Generator):
    """A smooth lens-like plate spreads the same energy that a flat one focuses."""
    camera = make_camera(512, 1e-3, 4e-3, 3e-6, 128)
    y, x = (camera.grid.axis_m(a) for a in ("y", "x"))
    bowl = (y[:, None] ** 2 + x[None, :] ** 2) * 24.0  # a weak lens, 6 um high at the rim
    flat, spread = (psf(h, camera, [np.inf]).energy[0, 0] for h in (np.zeros((512, 512)), bowl))
    assert spread.max() < 0.05 * flat.max()
    # 99.7 % of both lie in the window; what differs are their tails.
    assert spread.sum() == pytest.approx(flat.sum(), rel=4e-3)
