"""Rows and squares that are cut out of a design and solved."""

import numpy as np
import pytest

from fab.aperture import RectangularAperture, RoundAperture
from fab.figure import png_bytes
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.material import refractive_index
from sim.plots.orders import plot_certificate
from sim.rigorous import certify_pieces, certify_rows, compare_piece, compare_row, cut_pieces, cut_rows
from sim.rigorous.certificate import CertifiedPiece, CertifiedRow
from sim.rigorous.crossed import travelling_terms

PITCH_M = 1.85e-6
GRID = Grid((100, 100), PITCH_M)
APERTURE = RoundAperture(100 * PITCH_M)
GREEN = Colour("green", (552e-9,), (1.0,))
CAMERA = Camera(GRID, APERTURE, "fused_silica", (GREEN,), 8e-3, 3.7e-6, 64)
# Every height says where it is.
PLACES = np.arange(1e4).reshape(100, 100)


def test_rows_lie_on_both_axes_and_on_the_diagonal():
    rows = cut_rows(PLACES, GRID, APERTURE, 8, shares=(0.0, 0.5))
    assert [row.axis for row in rows] == ["x", "x", "y", "x"]
    firsts = [divmod(int(row.height_m[0]), 100) for row in rows]
    # The middle lies between cells 49 and 50, half way to the rim is 25 cells further, 17.7 along either axis.
    assert firsts == [(49, 45), (49, 70), (70, 49), (67, 63)]
    assert all(np.ptp(row.height_m) == (700 if row.axis == "y" else 7) for row in rows)
    for row, (y, x) in zip(rows, [(49, 48.5), (49, 73.5), (73.5, 49), (67, 66.5)], strict=True):
        assert row.centre_m == pytest.approx(((y - 49.5) * PITCH_M, (x - 49.5) * PITCH_M))


def test_rows_end_at_the_aperture_and_have_relief():
    at_rim = cut_rows(PLACES, GRID, APERTURE, 24, shares=(0.95,))
    # Toward the rim 24 cells end at the last one; on the diagonal where the circle does.
    assert [len(row.height_m) for row in at_rim] == [24, 24, 16]
    assert at_rim[0].height_m[-1] == 4999
    stripes = np.tile(np.arange(100.0)[:, None], (1, 100))
    assert [row.axis for row in cut_rows(stripes, GRID, APERTURE, 8)] == ["y"] * 4
    assert cut_rows(0 * PLACES, GRID, APERTURE, 8) == []


def test_rows_are_as_long_as_the_plate_along_them():
    for height in (PLACES[:20], PLACES[:, :20]):
        slit = RectangularAperture((height.shape[0] * PITCH_M, height.shape[1] * PITCH_M))
        rows = cut_rows(height, Grid(height.shape, PITCH_M), slit, 24, shares=(0.0, 0.5))
        short, long = ("y", "x") if len(height) == 20 else ("x", "y")
        assert {(row.axis, len(row.height_m)) for row in rows} == {(short, 20), (long, 24)}


@pytest.fixture(scope="module")
def certified() -> tuple[CertifiedRow, ...]:
    levels = np.random.default_rng(0).integers(0, 16, (100, 100))
    rows = cut_rows(75e-9 * levels, GRID, APERTURE, 8, shares=(0.0, 0.5))[:2]
    return certify_rows(rows, CAMERA, (552e-9, 656e-9))


def test_rows_of_a_rectangle_lie_at_shares_of_its_own_sides():
    slit = RectangularAperture((40 * PITCH_M, 80 * PITCH_M))
    rows = cut_rows(PLACES, GRID, slit, 8, shares=(0.0, 0.5))
    assert [row.axis for row in rows] == ["x", "x", "y", "x"]
    np.testing.assert_allclose([row.centre_m[1] for row in rows[:2]], [0, 20 * PITCH_M], atol=PITCH_M)
    np.testing.assert_allclose(rows[2].centre_m, (10 * PITCH_M, 0), atol=PITCH_M)
    # Beyond the rim nothing is cut out: of the cells 75 to 98 about that at 38 from the middle, 75 to 89 are inside.
    at_rim = cut_rows(PLACES, GRID, slit, 24, shares=(0.95,))[0]
    assert at_rim.height_m.tolist() == [4900.0 + column for column in range(75, 90)]
    assert at_rim.centre_m == pytest.approx((-0.5 * PITCH_M, (82 - 49.5) * PITCH_M))
    assert all(np.abs(piece.centre_m[0]) < 20 * PITCH_M for piece in cut_pieces(PLACES, GRID, slit, 2, 4, cells=8))


def test_rows_are_settled_and_edges_are_near_maxwell(certified: tuple[CertifiedRow, ...]):
    assert [one.wavelength_m for one in certified] == [552e-9] * 2 + [656e-9] * 2
    for one in certified:
        orders = one.orders
        assert one.unsettled.max() < 5e-3
        assert orders.energy == pytest.approx([1, 1], abs=1e-12)
        # Random levels in cells of three wavelengths.
        assert orders.error(orders.edges).max() < 0.015 < 0.03 < orders.error(orders.scalar).max()


def test_the_finer_solution_is_the_one_that_is_told(certified: tuple[CertifiedRow, ...]):
    one = certified[0]
    finer = compare_row(one.row.height_m, PITCH_M, 552e-9, 1.4599, waves=2.0)  # of fused silica
    np.testing.assert_allclose(one.orders.rigorous, finer.rigorous, atol=1e-4)
    coarse = compare_row(one.row.height_m, PITCH_M, 552e-9, 1.4599, waves=1.5)
    assert one.unsettled == pytest.approx(finer.error(coarse.rigorous), rel=0.02)


@pytest.mark.parametrize("count", [1, 4])
def test_a_picture_has_a_panel_for_errors_and_one_for_each_of_two_wavelengths(
    certified: tuple[CertifiedRow, ...], count: int
):
    figure = plot_certificate(certified[:count], "name")
    errors, *orders = figure.axes  # type: ignore[union-attr]
    assert len(orders) == (1 if count == 1 else 2)
    thin, edges = (line.get_ydata() for line in errors.get_lines()[:2])
    for points, kind in ((thin, "scalar"), (edges, "edges")):
        wanted = [100 * one.orders.error(getattr(one.orders, kind)).mean() for one in certified[:count]]
        np.testing.assert_allclose(points, wanted)
    own = [one for one in certified[:count] if one.wavelength_m == 552e-9]
    worst = max(own, key=lambda one: one.orders.error(one.orders.scalar).max())
    bars = [bar.get_height() for bar in orders[0].patches]
    np.testing.assert_allclose(bars, 100 * worst.orders.rigorous.mean(0))
    assert png_bytes(figure)[:4] == b"\x89PNG"


def test_a_picture_of_nothing_is_refused():
    with pytest.raises(ValueError, match="`rows` must not be empty"):
        plot_certificate([])


def test_squares_lie_where_rows_do_and_have_the_highest_walls():
    """Along the row of a place, within its reach; the outermost place first."""
    height = np.zeros((100, 100))
    height[45, 60], height[60, 45] = 5e-7, 6e-7  # near the axes, 11 cells from the middle
    found = cut_pieces(height, GRID, APERTURE, 2, 4, cells=8, shares=(0.0, 0.25))
    assert found == []
    height[49, 60], height[60, 50] = 5e-7, 6e-7
    squares = cut_pieces(height, GRID, APERTURE, 2, 3, cells=8, shares=(0.0, 0.25))
    # Of the three out of four places the diagonal one is flat, and so is the middle.
    assert [np.max(square.height_m) for square in squares] == [6e-7]
    squares = cut_pieces(height, GRID, APERTURE, 2, 4, cells=8, shares=(0.0, 0.25))
    assert [np.max(square.height_m) for square in squares] == [6e-7, 5e-7]
    # Of squares as high as each other, the first: the cell is the last of its square.
    np.testing.assert_array_equal(squares[1].height_m, [[0, 5e-7], [0, 0]])
    assert squares[1].centre_m == pytest.approx((0.0 * PITCH_M, 10.0 * PITCH_M))


def test_squares_stay_within_the_aperture_and_the_grid():
    height = np.random.default_rng(1).integers(0, 16, (100, 100)) * 75e-9
    for side in (2, 3, 4):
        squares = cut_pieces(height, GRID, APERTURE, side, 13, cells=24)
        assert len(squares) == 13
        for square in squares:
            assert square.height_m.shape == (side, side)
            y, x = (np.array(square.centre_m) / PITCH_M + 50 - side / 2).round().astype(int)
            np.testing.assert_array_equal(square.height_m, height[y : y + side, x : x + side])
            corner = np.abs(square.centre_m) + (side - 1) / 2 * PITCH_M
            assert np.hypot(*corner) <= APERTURE.diameter_m / 2
    assert cut_pieces(height[:3, :3], Grid((3, 3), PITCH_M), RoundAperture(3 * PITCH_M), 4, 2, cells=24) == []
    assert cut_pieces(height, GRID, APERTURE, 2, 0, cells=24) == []


@pytest.fixture(scope="module")
def certified_pieces() -> tuple[CertifiedPiece, ...]:
    """Cells of a wavelength: coarse physics, and few terms."""
    height = np.random.default_rng(0).integers(0, 3, (100, 100)) * 150e-9
    grid = Grid((100, 100), 0.5e-6)
    squares = cut_pieces(height, grid, RoundAperture(50e-6), 2, 2, cells=4)
    return certify_pieces(squares, Camera(grid, 50e-6, "fused_silica", (GREEN,), 8e-3, 3.7e-6, 64), (552e-9,))


@pytest.mark.slow  # squares take many seconds
def test_the_finer_solution_of_a_square_is_the_one_that_is_told(certified_pieces: tuple[CertifiedPiece, ...]):
    assert len(certified_pieces) == 2
    one, index = certified_pieces[0], refractive_index("fused_silica", 552e-9)
    given = (0.5e-6, 552e-9, index)
    terms = travelling_terms((2, 2), *given, 2.2)
    coarse, finer = (compare_piece(one.piece.height_m, *given, count) for count in (round(0.75 * terms), terms))
    np.testing.assert_allclose(one.orders.rigorous, finer.rigorous, atol=1e-9)
    assert one.unsettled == pytest.approx(finer.error(coarse.rigorous), rel=1e-6)
    # A hundred terms: a per cent.
    assert 0 < one.unsettled.max() < 0.02
    # The directions of walls make matrices that are not Hermitian, so energy is kept up to terms that are missing.
    assert one.orders.energy == pytest.approx([1, 1], abs=0.01)


@pytest.mark.slow  # squares take many seconds
def test_a_picture_has_squares_beside_rows(
    certified: tuple[CertifiedRow, ...], certified_pieces: tuple[CertifiedPiece, ...]
):
    figure = plot_certificate(certified[:2], "name", pieces=certified_pieces)
    _, errors, orders, squares = figure.axes  # type: ignore[union-attr]
    points = errors.get_lines()[1].get_ydata()
    wanted = [100 * one.orders.error(one.orders.edges).mean() for one in certified_pieces]
    np.testing.assert_allclose(points, wanted)
    worst = max(certified_pieces, key=lambda one: one.orders.error(one.orders.scalar).max())
    bars = [bar.get_height() for bar in squares.patches]
    np.testing.assert_allclose(bars, 100 * worst.orders.rigorous.mean(0).ravel())
    np.testing.assert_allclose(squares.get_lines()[0].get_ydata(), 100 * worst.orders.scalar.ravel())
    assert len(orders.patches) == 9
    assert errors.get_title(loc="left") == "squares of 2 x 2 cells"
    assert png_bytes(figure)[:4] == b"\x89PNG"
