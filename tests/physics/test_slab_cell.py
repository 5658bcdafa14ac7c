"""Slabs of cells by Fourier modes against coupled waves in one dimension, other squares, films, and differences."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sim.rigorous import SlabCell, crossed_orders, orders_of, row_slabs
from sim.rigorous.rows import POLARISATIONS
from sim.rigorous.slab_cell import gradient_bytes, usual_terms

pytest.importorskip("fmmax")

WAVE, GLASS = 633e-9, 1.457
STEP = WAVE / (GLASS - 1) / 4


def filled_of(level: np.ndarray, count: int) -> np.ndarray:
    return np.stack([level > low for low in range(count - 1)][::-1]).astype(float)


def blazed(period_waves: float, terms: int) -> tuple[SlabCell, np.ndarray]:
    """Four levels in three cells each, to be lit along x."""
    level = np.repeat(np.arange(4), 3)[None]
    return SlabCell((1, 12), period_waves * WAVE / 12, np.full(3, STEP), WAVE, GLASS, terms), level


def order_of(cell: SlabCell, y: int, x: int) -> int:
    return int(np.flatnonzero((cell.number == (y, x)).all(1))[0])


# At 3 waves the third order leaves along the face, where modes cannot be told apart: a Rayleigh anomaly.
@pytest.mark.slow
@pytest.mark.parametrize("period", [3.0, 3.01])
def test_a_row_is_what_coupled_waves_say(period: float):
    """Another solver, another treatment of walls; light along x is TM at walls across x."""
    cell, level = blazed(period, 61)
    orders = cell.transmitted(filled_of(level, 4))
    for own, way in zip(orders, POLARISATIONS[::-1], strict=True):
        row = orders_of(row_slabs(level[0] * STEP, period * WAVE / 12, GLASS), WAVE, GLASS, way, 60)
        for number in range(-3, 4):
            assert own[order_of(cell, 0, number)] == pytest.approx(row.transmitted[row.at(number)], abs=5e-4)


@pytest.mark.slow
def test_a_row_along_y_is_one_along_x_turned():
    cell, level = blazed(3.01, 21)
    turned = SlabCell((12, 1), 3.01 * WAVE / 12, np.full(3, STEP), WAVE, GLASS, 21)
    one, other = cell.transmitted(filled_of(level, 4)), turned.transmitted(filled_of(level.T, 4))
    np.testing.assert_array_equal(cell.number, turned.number[:, ::-1])
    np.testing.assert_allclose(one, other[::-1], atol=1e-9)


@pytest.mark.slow
def test_bare_glass_lets_through_what_fresnel_says():
    """Glass and air of any thickness before a bare face change nothing but phases: both slabs empty."""
    cell = SlabCell((2, 2), 0.4 * WAVE, np.full(2, STEP), WAVE, GLASS, 9)
    orders = cell.transmitted(np.zeros((2, 2, 2)))
    face = 4 * GLASS / (1 + GLASS) ** 2
    assert orders[:, order_of(cell, 0, 0)] == pytest.approx([face] * 2, rel=1e-9)
    assert orders.sum(1) == pytest.approx([face] * 2, rel=1e-9)


@pytest.mark.slow
def test_a_slab_with_a_share_of_glass_is_a_film_of_the_mean_permittivity():
    """A quarter of a wave of the index sqrt(n), of which the share follows, takes the reflection away."""
    share = (GLASS - 1) / (GLASS**2 - 1)
    cell = SlabCell((2, 2), 0.4 * WAVE, np.array([WAVE / 4 / np.sqrt(GLASS)]), WAVE, GLASS, 9)
    assert cell.transmitted(np.full((1, 2, 2), share)).sum(1) == pytest.approx([1, 1], abs=1e-9)


@pytest.mark.slow
def test_squares_are_those_of_the_certificate():
    level = np.random.default_rng(1).integers(0, 3, (3, 4))
    cell = SlabCell((3, 4), 0.3 * WAVE, np.full(2, STEP), WAVE, GLASS, 40)
    wanted = crossed_orders(level * STEP, 0.3 * WAVE, WAVE, GLASS, 40)
    np.testing.assert_array_equal(cell.number, wanted.number)
    # Rasters of 86 and 64 samples per cell instead of 128.
    np.testing.assert_allclose(cell.transmitted(filled_of(level, 3)), wanted.transmitted, atol=2e-3)


def judge_of(cell: SlabCell) -> Callable[[Any], Any]:
    places = [order_of(cell, 0, 1), order_of(cell, 0, 0)]
    return lambda orders: orders[0, places[0]] + 0.5 * orders[1, places[1]] ** 2


@pytest.mark.slow
def test_the_gradient_is_that_of_differences():
    cell, level = blazed(3.01, 15)
    filled = (0.1 + 0.8 * filled_of(level, 4)) * np.random.default_rng(2).uniform(0.8, 1, (3, 1, 12))
    judge = judge_of(cell)
    value, orders, change = cell.gradient(filled, judge)
    assert value == pytest.approx(float(judge(orders)), rel=1e-12)
    np.testing.assert_allclose(orders, cell.transmitted(filled), atol=1e-12)
    for at in ((0, 0, 3), (1, 0, 7), (2, 0, 0)):
        ends = []
        for sign in (-1, 1):
            moved = filled.copy()
            moved[at] += sign * 1e-4
            ends.append(float(judge(cell.transmitted(moved))))
        assert change[at] == pytest.approx((ends[1] - ends[0]) / 2e-4, rel=1e-5)


@pytest.mark.slow
def test_the_gradient_of_squares_is_along_the_way_to_more():
    """Walls are held in their directions: a short step gains what the gradient promises, but for their turning."""
    cell = SlabCell((3, 3), 0.4 * WAVE, np.full(1, 2 * STEP), WAVE, GLASS, 20)
    filled = np.random.default_rng(3).uniform(0.2, 0.8, (1, 3, 3))
    judge = judge_of(cell)
    value, _, change = cell.gradient(filled, judge)
    moved = 1e-3 * change / np.linalg.norm(change)
    assert float(judge(cell.transmitted(filled + moved))) - value == pytest.approx(
        float((moved * change).sum()), rel=0.3
    )


def test_terms_and_memory():
    assert usual_terms((1, 12), 3 * WAVE / 12, WAVE, GLASS) == 2 * 9 + 1  # 2 x 1.457 x 3 = 8.7 to either side
    assert usual_terms((10, 10), 0.5 * WAVE, WAVE, GLASS) == round(np.pi * (1.1 * GLASS * 5) ** 2)
    assert gradient_bytes(100, 3) == 2 * gradient_bytes(100, 1) + gradient_bytes(100, 1)
    assert gradient_bytes(200, 1) == 4 * gradient_bytes(100, 1)
