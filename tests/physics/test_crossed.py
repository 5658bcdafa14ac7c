"""Squares of cells in two dimensions against closed forms, rows in one dimension, and another formulation."""

import sys

import numpy as np
import pytest

from fab.errors import InputError
from sim.material import refractive_index
from sim.rigorous import (
    CrossedOrders,
    PieceComparison,
    compare_piece,
    compare_row,
    crossed_orders,
    orders_of,
    row_slabs,
    thin_amplitudes,
    thin_piece_amplitudes,
)
from sim.rigorous.crossed import travelling_terms
from sim.rigorous.rows import Polarisation

pytest.importorskip("fmmax")

CELL, STEP, GREEN = 1.85e-6, 75e-9, 552e-9
INDEX = refractive_index("fused_silica", GREEN)


@pytest.mark.slow
def test_a_bare_face_reflects_as_fresnel_says():
    orders = crossed_orders(np.zeros((2, 2)), 0.6e-6, GREEN, INDEX, 9)
    face = 4 * INDEX / (1 + INDEX) ** 2
    assert orders.within(0, 0).ravel() == pytest.approx([face] * 2, rel=1e-12)
    assert orders.energy == pytest.approx([1, 1], abs=1e-12)
    assert orders.transmitted.sum(1) == pytest.approx([face] * 2, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_relief_that_varies_along_one_axis_is_a_row(axis: str):
    """Walls across x are met by light along x as TM and by light along y as TE; turned by a right angle, vice versa."""
    cell, heights = 0.6e-6, np.array([0.0, 300e-9])
    square = np.tile(heights, (2, 1))
    orders = crossed_orders(square if axis == "x" else square.T, cell, GREEN, INDEX, 80)
    assert orders.energy == pytest.approx([1, 1], abs=1e-12)
    # Cells as far along the walls as across them: orders of even numbers along the walls, of which all but 0 are dark.
    ways: tuple[Polarisation, Polarisation] = ("TM", "TE") if axis == "x" else ("TE", "TM")
    found = orders.within(2, 2)
    line = found[:, 2, :] if axis == "x" else found[:, :, 2]
    assert found.sum() == pytest.approx(line.sum(), abs=1e-12)
    for own, way in zip(line, ways, strict=True):
        row = orders_of(row_slabs(heights, cell, INDEX), GREEN, INDEX, way, 40)
        wanted = row.transmitted[row.at(-2) : row.at(3)]
        # 80 terms have nine along either axis; 160 halve the distance.
        assert own == pytest.approx(wanted, abs=5e-4)


@pytest.mark.slow
def test_turned_relief_and_turned_light_go_together():
    """The same relief with x and y exchanged sends light of the other polarisation to exchanged orders."""
    height = 100e-9 * np.array([[0, 3], [1, 5]])
    one, other = (crossed_orders(h, 0.6e-6, GREEN, INDEX, 40) for h in (height, height.T))
    np.testing.assert_allclose(one.within(2, 2), other.within(2, 2)[::-1].transpose(0, 2, 1), atol=1e-6)


@pytest.mark.slow
def test_orders_are_where_the_light_goes():
    """A prism of four steps along y sends light up: thin elements agree on the brightest order to a tenth."""
    height = np.tile(STEP * np.array([0, 4, 8, 12])[:, None], (1, 1))
    found = compare_piece(height, CELL, GREEN, INDEX, 60)
    # Glass grows along y, so light goes to +y, order 1 of -2 to 2.
    for orders in (found.scalar, *found.edges, *found.rigorous):
        assert np.unravel_index(orders.argmax(), orders.shape) == (3, 0)
        assert orders.max() == pytest.approx(found.rigorous.max(), rel=0.1)


def test_orders_that_were_left_out_are_dark():
    orders = CrossedOrders(np.array([[0, 0], [0, 1], [-2, 0]]), np.array([[0.5, 0.25, 0.1]] * 2), np.zeros((2, 3)))
    np.testing.assert_array_equal(orders.within(1, 1)[0], [[0, 0, 0], [0, 0.5, 0.25], [0, 0, 0]])
    np.testing.assert_array_equal(orders.within(2, 0)[1], [[0.1], [0], [0.5], [0], [0]])
    assert orders.energy == pytest.approx([0.85] * 2)


def test_terms_grow_with_the_area_of_the_square():
    """A period of 3.7 um holds n P / wavelength = 9.8 orders to either side: a disc of 301."""
    assert travelling_terms((2, 2), CELL, GREEN, INDEX) == 301
    assert travelling_terms((4, 4), CELL, GREEN, INDEX) == pytest.approx(4 * 301, abs=4)
    assert travelling_terms((2, 2), CELL, GREEN, INDEX, 2.0) == pytest.approx(4 * 301, abs=4)
    assert travelling_terms((1, 1), 0.1e-6, GREEN, INDEX) == 9


@pytest.mark.parametrize("polarisation", [None, "x", "y"])
def test_a_thin_square_is_the_transform_of_its_raster(polarisation: str | None):
    """Cells against an own transform of 60 samples per cell and axis; lines of light against rows."""
    height = STEP * np.random.default_rng(2).integers(0, 16, (3, 4))
    amplitude = thin_piece_amplitudes(height, CELL, GREEN, INDEX, polarisation)
    assert amplitude.shape == (3, 5)
    if polarisation is None:
        fine = np.kron(height, np.ones((60, 60)))
        waves = np.fft.fft2(np.exp(2j * np.pi / GREEN * (INDEX - 1) * fine), norm="forward")
        wanted = waves[np.ix_([-1, 0, 1], [-2, -1, 0, 1, 2])]
        # Samples miss the sinc of a cell by (pi u / 60)^2 / 6 at the wave number u, at most a half.
        np.testing.assert_allclose(np.abs(amplitude), np.abs(wanted), atol=2e-4)
        return
    along: tuple[Polarisation, Polarisation] = ("TM", "TE") if polarisation == "x" else ("TE", "TM")
    parts: tuple[tuple[np.ndarray, Polarisation], ...] = ((height[:1], along[0]), (height[:, :1], along[1]))
    for one, way in parts:
        own = thin_piece_amplitudes(one, CELL, GREEN, INDEX, polarisation).ravel()
        row = thin_amplitudes(one.ravel(), CELL, GREEN, INDEX, way)[1]
        np.testing.assert_allclose(np.abs(own), np.abs(row), atol=1e-12)


def test_walls_along_both_axes_add_up():
    """A square that is alike along y has no walls across y; one that varies along both has those of both."""
    height = STEP * np.array([[0, 5], [9, 2]])
    light = [thin_piece_amplitudes(height, CELL, GREEN, INDEX, way) for way in (None, "x", "y")]
    turned = thin_piece_amplitudes(height.T, CELL, GREEN, INDEX, "y").T
    np.testing.assert_allclose(light[1], turned, atol=1e-13)
    stripes = np.tile(height[:1], (2, 1))
    one = thin_piece_amplitudes(stripes, CELL, GREEN, INDEX, "x")[1]
    np.testing.assert_allclose(one, thin_piece_amplitudes(height[:1], CELL, GREEN, INDEX, "x")[0], atol=1e-13)
    assert np.abs(light[1] - light[0]).max() > 0.01


def test_errors_are_those_of_all_orders_together():
    rigorous = np.zeros((2, 3, 3))
    rigorous[:, 1, 1], rigorous[1, 0, 2] = (0.6, 0.4), 0.3
    found = PieceComparison(np.zeros((3, 3)), rigorous + 0.01, rigorous, np.ones(2))
    assert found.error(found.scalar) == pytest.approx([1, 1])
    assert found.error(found.edges) == pytest.approx([0.03 / 0.6, 0.03 / 0.5])
    assert found.zeroth(found.rigorous) == pytest.approx([0.6, 0.4])


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "fmmax", None)
    with pytest.raises(InputError, match=r"pieces: solutions in two dimensions need fmmax.*doedesign\[rigorous\]"):
        crossed_orders(np.zeros((2, 2)), CELL, GREEN, INDEX, 9)


@pytest.mark.slow
def test_a_row_of_wide_cells_is_the_same_in_two_dimensions():
    """Cells of the size of a design's: TE and TM to a thousandth, in a period as short along the walls as may be."""
    heights = 4 * STEP * np.array([0, 1, 2, 3])
    row = compare_row(heights, CELL, GREEN, INDEX, waves=2.0)
    found = crossed_orders(np.repeat(heights[None], 1, 0), CELL, GREEN, INDEX, 420)
    face = 4 * INDEX / (1 + INDEX) ** 2
    line = found.within(0, 2)[:, 0] / face
    np.testing.assert_allclose(line, row.rigorous[::-1], atol=1e-3)
