"""Squares with two mirrors against closed forms, rows in one dimension, and another library's modes."""

import numpy as np
import pytest

import sim.rigorous.mirrored_squares as relief
from fab.errors import InputError
from sim.material import refractive_index
from sim.rigorous import compare_piece, crossed_orders, mirrored_orders, orders_of, row_slabs, with_mirrors
from sim.rigorous.crossed import travelling_terms
from sim.rigorous.rows import Polarisation

CELL, STEP, GREEN = 1.85e-6, 75e-9, 552e-9
INDEX = refractive_index("fused_silica", GREEN)
FACE = 4 * INDEX / (1 + INDEX) ** 2
SMALL_CELL = 0.6e-6


def test_a_bare_face_reflects_as_fresnel_says():
    orders = mirrored_orders(np.zeros((2, 2)), SMALL_CELL, GREEN, INDEX, 20)
    assert orders.within(0, 0).ravel() == pytest.approx([FACE] * 2, rel=1e-12)
    assert orders.transmitted.sum(1) == pytest.approx([FACE] * 2, rel=1e-12)
    assert orders.reflected.sum(1) == pytest.approx([1 - FACE] * 2, rel=1e-11)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_stripes_are_a_row(axis: str):
    """To the last digits: terms of a circle hold the same orders of even number across the walls as the row does."""
    heights, terms = STEP * np.array([0.0, 6, 9, 6]), 100
    square = np.tile(heights, (4, 1))
    orders = mirrored_orders(square if axis == "x" else square.T, 0.5e-6, GREEN, INDEX, terms)
    assert orders.energy == pytest.approx([1, 1], abs=1e-12)
    ways: tuple[Polarisation, Polarisation] = ("TM", "TE") if axis == "x" else ("TE", "TM")
    found = orders.within(3, 3)
    line = found[:, 3, :] if axis == "x" else found[:, :, 3]
    reach = int(np.abs(orders.number).max())
    for own, way in zip(line, ways, strict=True):
        row = orders_of(row_slabs(heights, 0.5e-6, INDEX), GREEN, INDEX, way, reach)
        assert own == pytest.approx(row.transmitted[row.at(-3) : row.at(4)], abs=1e-9)


def test_turned_relief_and_turned_light_go_together():
    """The same relief with x and y exchanged sends light of the other polarisation to exchanged orders."""
    height = 100e-9 * np.array([[0, 3], [1, 5]])
    one, other = (mirrored_orders(h, SMALL_CELL, GREEN, INDEX, 60) for h in (height, height.T))
    np.testing.assert_allclose(one.within(2, 2), other.within(2, 2)[::-1].transpose(0, 2, 1), atol=1e-12)


def test_a_square_moved_by_half_its_period_sends_the_same_light():
    """Both cells have a mirror through their middle, so either may be the first."""
    height = 100e-9 * np.array([[0, 3], [1, 5]])
    one, other = (mirrored_orders(h, SMALL_CELL, GREEN, INDEX, 60) for h in (height, np.roll(height, 1, (0, 1))))
    np.testing.assert_allclose(one.within(2, 2), other.within(2, 2), atol=1e-12)


def test_thin_slabs_and_thick_ones_are_the_same(monkeypatch: pytest.MonkeyPatch):
    height = 100e-9 * np.array([[0, 3], [1, 9]])
    thick = mirrored_orders(height, SMALL_CELL, GREEN, INDEX, 60)
    monkeypatch.setattr(relief, "_MOST_GROWTH", 1.0)
    thin = mirrored_orders(height, SMALL_CELL, GREEN, INDEX, 60)
    np.testing.assert_allclose(thin.transmitted, thick.transmitted, atol=1e-11)
    np.testing.assert_allclose(thin.reflected, thick.reflected, atol=1e-11)
    # The directions of walls make matrices that are not Hermitian: energy is kept up to terms that are missing.
    assert thick.energy == pytest.approx([1, 1], abs=2e-3)


def test_a_period_of_whole_waves_has_orders_at_grazing():
    """One that differs by a millionth has the same light."""
    height = 100e-9 * np.array([[0, 3], [1, 5]])
    one, other = (mirrored_orders(height, GREEN * stretch, GREEN, INDEX, 60) for stretch in (1.0, 1 + 1e-6))
    assert one.within(1, 1) == pytest.approx(other.within(1, 1), abs=1e-3)
    assert np.isfinite(one.transmitted).all()


def test_a_piece_is_continued_by_mirrors():
    piece = np.arange(9.0).reshape(3, 3)
    wanted = np.array([[0.0, 1, 2, 1], [3, 4, 5, 4], [6, 7, 8, 7], [3, 4, 5, 4]])
    np.testing.assert_array_equal(with_mirrors(piece), wanted)
    np.testing.assert_array_equal(with_mirrors(piece[:2, :2]), piece[:2, :2])
    assert relief.is_mirrored(with_mirrors(piece))
    assert relief.is_mirrored(piece[:2, :2])
    for other in (piece, wanted[:2], np.roll(wanted, 1, 0)):
        assert not relief.is_mirrored(other)


def test_squares_without_mirrors_are_refused():
    with pytest.raises(InputError, match=r"own mirror image.*but got 3 x 3 cells that are not"):
        mirrored_orders(np.arange(9.0).reshape(3, 3), SMALL_CELL, GREEN, INDEX, 9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("piece", "cell"), [([[0, 3], [1, 5]], SMALL_CELL), ([[5, 0, 3], [1, 2, 3], [2, 4, 0]], 0.35e-6)]
)
def test_squares_are_those_of_another_library(piece: list[list[int]], cell: float):
    """fmmax finds modes, has exponentials and a raster of 128 samples per cell, which leave less than 1e-4."""
    pytest.importorskip("fmmax")
    height = with_mirrors(100e-9 * np.array(piece))
    found, wanted = (solve(height, cell, GREEN, INDEX, 120) for solve in (mirrored_orders, crossed_orders))
    assert len(found.number) == len(wanted.number)
    np.testing.assert_allclose(found.within(3, 3), wanted.within(3, 3), atol=2e-4)
    np.testing.assert_allclose(found.energy, wanted.energy, atol=2e-4)


def test_random_cells_are_settled_and_edges_are_within_half_a_per_cent():
    """2 x 2 cells of four levels at 552 nm. Li's rule for rectangles has a 0th order of 26.290 and 26.298 %.

    That is with 497 and 697 terms.
    """
    height = 4 * STEP * np.array([[3, 2], [2, 1]])
    coarse, fine = (
        compare_piece(height, CELL, GREEN, INDEX, travelling_terms((2, 2), CELL, GREEN, INDEX, waves))
        for waves in (1.1, 1.25)
    )
    assert fine.error(coarse.rigorous).max() < 2e-3
    assert fine.energy == pytest.approx([1, 1], abs=5e-4)
    face = 4 * INDEX / (1 + INDEX) ** 2
    assert 100 * face * fine.zeroth(fine.rigorous) == pytest.approx([26.298] * 2, abs=0.04)
    assert 100 * face * fine.zeroth(fine.scalar) == pytest.approx(24.155, abs=0.002)
    # The light is symmetric about the diagonal, so both polarisations are alike.
    assert fine.error(fine.scalar) == pytest.approx([0.0764] * 2, abs=1e-3)
    # 0.28 %, and 1.8 % without the light of corners.
    assert fine.error(fine.edges).max() < 0.005
    assert fine.zeroth(fine.edges) == pytest.approx(fine.zeroth(fine.rigorous), abs=1e-3)


@pytest.mark.parametrize("levels", [[[10, 15], [0, 15]], [[15, 5], [0, 5]], [[15, 0], [0, 0]]])
def test_corners_of_the_highest_walls_are_within_two_per_cent(levels: list[list[int]]):
    """Walls alone leave 2.0 to 3.9 % of them."""
    coarse, found = (compare_piece(STEP * np.array(levels), CELL, GREEN, INDEX, terms) for terms in (600, 800))
    assert found.error(coarse.rigorous).max() < 2e-3
    assert found.error(found.scalar).min() > 0.25
    assert found.error(found.edges).max() < 0.015
    assert found.zeroth(found.edges) == pytest.approx(found.zeroth(found.rigorous), abs=4e-3)
