"""Weights that interpolate the field: against the waves of single cells, written out."""

import numpy as np
import pytest

from sim.propagation.field_weights import field_weights

# Transforms of 250 samples of 200 cells; pixels from one side of the axis to the other.
CELLS, LENGTH, SAMPLES = 200, 250, 64
PLACES = 14 + np.linspace(0, 36, 97)


@pytest.mark.parametrize("is_round", [True, False])
@pytest.mark.parametrize("slope", [None, 4e-4])
def test_every_cell_is_seen_as_far_as_is_predicted(is_round: bool, slope: float | None):
    """A cell at x is exp(-2 pi i k x / length) at sample k, and at a fractional k that times its sinc."""
    weights, predicted = field_weights(PLACES, SAMPLES, LENGTH, CELLS, slope, is_round)
    assert np.iscomplexobj(weights) == (slope is not None)
    cells = np.arange(-CELLS / 2, CELLS / 2 + 0.1, 0.5)  # the middles of an even or an odd number of cells
    seen = (PLACES[:, None] - SAMPLES // 2) / LENGTH
    wanted = np.exp(-2j * np.pi * seen * cells)
    # Lit from nearby, a cell sends light most strongly where it would go without diffraction.
    wanted = wanted if slope is None else wanted * np.sinc(seen - slope * cells)
    found = weights.T @ np.exp(-2j * np.pi * (np.arange(SAMPLES)[:, None] - SAMPLES // 2) * cells / LENGTH)
    power = np.sqrt(1 - (cells / (CELLS / 2 + 0.5)) ** 2) if is_round else np.ones_like(cells)
    error = np.sqrt((np.abs(found - wanted) ** 2 @ power).mean() / (np.abs(wanted) ** 2 @ power).mean())
    assert error < 3e-4
    # The rim has most of the error, and is divided in another way here.
    assert predicted == pytest.approx(error, rel=0.1)
    assert np.abs(found - wanted).max() < 6e-3


def test_mirrored_places_have_mirrored_weights():
    one, other = (field_weights(at, SAMPLES, LENGTH, CELLS, 4e-4)[0] for at in (PLACES, SAMPLES - PLACES))
    halfway = np.mod(PLACES, 1) == 0  # between as many samples on either side; there either will do
    # Normal equations with a floor of 1e-9, in double precision.
    np.testing.assert_allclose(other[:0:-1, ~halfway], one[1:, ~halfway], atol=1e-6)
