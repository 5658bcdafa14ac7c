"""Tables of curves: their numbers are those of MTF and encircled energy, their units as the columns say."""

import csv

import numpy as np
import pytest

from bench.reference import YELLOW_M, make_camera, wrapped_map
from doedesign.runs.curve_tables import encircled_csv, mtf_csv
from sim.plots.curves import encircled_curves
from sim.psf_bank import psf
from sim.transfer import mtf

DEPTHS = (0.08, np.inf)


def columns(text: str, depth: str) -> dict[str, np.ndarray]:
    rows = [row for row in csv.DictReader(text.splitlines()) if row["depth_m"] == depth]
    return {key: np.array([float(row[key]) for row in rows]) for key in rows[0] if key not in ("depth_m", "colour")}


def test_modulation_transfer_along_x():
    camera = make_camera(200, 0.4e-3, 2e-3, 2e-6, 16)
    flat, rough = (mtf(height, camera, DEPTHS) for height in (np.zeros(camera.grid.shape), wrapped_map(200)))
    text = mtf_csv(rough, flat)
    assert text.splitlines()[0] == "depth_m,colour,frequency_per_mm,design,without"
    for k, depth in enumerate(("0.08", "inf")):
        found = columns(text, depth)
        # Half a cycle per pixel of 2 um; six digits are written.
        assert found["frequency_per_mm"][-1] == pytest.approx(250)
        np.testing.assert_allclose(found["design"], rough.transfer[0, k], rtol=1e-5)
        np.testing.assert_allclose(found["without"], flat.transfer[0, k], rtol=1e-5)


def test_light_within_a_radius():
    camera = make_camera(200, 0.4e-3, 2e-3, 0.5e-6, 64)
    flat, rough = (psf(height, camera, DEPTHS) for height in (np.zeros(camera.grid.shape), wrapped_map(200)))
    found = columns(encircled_csv(rough, encircled_curves([rough, flat]), camera), "inf")
    assert found["radius_um"][0] == pytest.approx(0.5)
    # The Airy disc holds 83.8 % of what both faces pass; cells on the rim and pixels blur it by less than 1 %.
    airy, passed = 1.22 * YELLOW_M * 2e-3 / 0.4e-3 * 1e6, camera.transmission(YELLOW_M)
    assert np.interp(airy, found["radius_um"], found["without"]) == pytest.approx(0.838 * passed, abs=0.01)
    assert found["design"][-1] == pytest.approx(float(rough.energy[0, 1].sum()), rel=1e-5)
