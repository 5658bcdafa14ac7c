"""The script that designs the public splitter: its score, its rule of widths, and the cell that it made."""

import sys
from pathlib import Path

import numpy as np
import pytest

from sim.rigorous import MirroredLayer

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import design_splitter  # pyright: ignore[reportMissingImports]
import invrs_splitter  # pyright: ignore[reportMissingImports]

RESULT = Path(__file__).parents[2] / "examples" / "results" / "invrs_splitter.png"


def test_the_soft_score_nears_the_score_and_has_its_derivative():
    orders = np.random.default_rng(0).uniform(0.01, 0.02, (7, 7))
    # The mean of a power of 49 numbers is off by that root of 49 at the most: 1 %, for the largest and for the least.
    assert design_splitter.soft_score(orders, 400)[0] == pytest.approx(invrs_splitter.Score(orders).value, rel=0.02)
    direction = np.random.default_rng(1).normal(size=(7, 7)) * 1e-8
    ends = [design_splitter.soft_score(orders + sign * direction, 12)[0] for sign in (1, -1)]
    assert (design_splitter.soft_score(orders, 12)[1] * direction).sum() == pytest.approx((ends[0] - ends[1]) / 2)


def test_equal_orders_score_their_sum():
    assert design_splitter.soft_score(np.full((7, 7), 0.015), 12)[0] == pytest.approx(49 * 0.015)


def bar(width: int) -> np.ndarray:
    cell = np.zeros((180, 180), bool)
    # Across the rim of the cell, where it goes on.
    cell[np.arange(-3, width - 3) % 180] = True
    return cell


def test_a_stroke_covers_what_is_as_wide_as_the_brush():
    assert not design_splitter.painted(bar(9)).any()
    assert np.array_equal(design_splitter.painted(bar(10)), bar(10))


def test_what_is_drawn_follows_the_rule_and_the_mirror():
    noise = np.random.default_rng(0).normal(size=(180, 180))
    noise = noise + np.roll(noise[:, ::-1], 1, 1)
    place = np.hypot(*np.meshgrid(np.fft.fftfreq(180, 1 / 180), np.fft.fftfreq(180, 1 / 180)))
    outline = np.fft.ifft2(np.fft.fft2(noise) * np.fft.fft2(np.exp(-(place**2) / 128))).real
    outline /= outline.std()
    assert not np.array_equal(outline > 0, design_splitter.painted(outline > 0))
    cell = design_splitter.drawn(outline)
    assert cell is not None
    assert np.array_equal(cell, design_splitter.painted(cell))
    assert np.array_equal(~cell, design_splitter.painted(~cell))
    assert np.array_equal(cell, np.roll(cell[:, ::-1], 1, 1))
    # Little is changed.
    assert np.mean(cell != (outline > 0)) < 0.05


def test_the_cell_that_it_made_follows_the_rule():
    cell = invrs_splitter.read_design(RESULT).T
    assert set(np.unique(cell)) == {0, 1}
    for part in (cell > 0.5, cell < 0.5):
        assert np.array_equal(part, design_splitter.painted(part))


@pytest.mark.study
def test_the_cell_that_it_made_has_the_score_that_is_stated():
    """Both solvers, which share nothing but the case."""
    pytest.importorskip("fmmax")
    cell, height_m = invrs_splitter.read_design(RESULT), 0.6828558e-6
    score = invrs_splitter.rigorous_scores(cell, height_m)[1]
    assert score.value == pytest.approx(0.6877, abs=1e-3)
    layer = MirroredLayer(180, invrs_splitter.PERIOD_M, invrs_splitter.WAVELENGTH_M, (invrs_splitter.GLASS, 1.0), 800)
    permittivity = 1 + (invrs_splitter.GLASS**2 - 1) * cell.T
    found = layer.solve(permittivity, height_m, layer.products_of_directions(permittivity), 3)
    # The imaginary part of the products of directions, 2.9e-5, and single precision.
    assert found.orders == pytest.approx(score.orders, abs=5e-5)
