"""Rows that are cut out of a design and solved."""

import numpy as np
import pytest

from fab.figure import png_bytes
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.plots.orders import plot_certificate
from sim.rigorous import certify_rows, compare_row, cut_rows
from sim.rigorous.certificate import CertifiedRow

PITCH_M = 1.85e-6
GRID = Grid((100, 100), PITCH_M)
APERTURE_M = 100 * PITCH_M
GREEN = Colour("green", (552e-9,), (1.0,))
CAMERA = Camera(GRID, APERTURE_M, "fused_silica", (GREEN,), 8e-3, 3.7e-6, 64)
# Every height says where it is.
PLACES = np.arange(1e4).reshape(100, 100)


def test_rows_lie_on_both_axes_and_on_the_diagonal():
    rows = cut_rows(PLACES, GRID, APERTURE_M, 8, shares=(0.0, 0.5))
    assert [row.axis for row in rows] == ["x", "x", "y", "x"]
    firsts = [divmod(int(row.height_m[0]), 100) for row in rows]
    # The middle lies between cells 49 and 50, half way to the rim is 25 cells further, 17.7 along either axis.
    assert firsts == [(49, 45), (49, 70), (70, 49), (67, 63)]
    assert all(np.ptp(row.height_m) == (700 if row.axis == "y" else 7) for row in rows)
    for row, (y, x) in zip(rows, [(49, 48.5), (49, 73.5), (73.5, 49), (67, 66.5)], strict=True):
        assert row.centre_m == pytest.approx(((y - 49.5) * PITCH_M, (x - 49.5) * PITCH_M))


def test_rows_end_at_the_aperture_and_have_relief():
    at_rim = cut_rows(PLACES, GRID, APERTURE_M, 24, shares=(0.95,))
    # Toward the rim 24 cells end at the last one; on the diagonal where the circle does.
    assert [len(row.height_m) for row in at_rim] == [24, 24, 16]
    assert at_rim[0].height_m[-1] == 4999
    stripes = np.tile(np.arange(100.0)[:, None], (1, 100))
    assert [row.axis for row in cut_rows(stripes, GRID, APERTURE_M, 8)] == ["y"] * 4
    assert cut_rows(0 * PLACES, GRID, APERTURE_M, 8) == []


@pytest.fixture(scope="module")
def certified() -> tuple[CertifiedRow, ...]:
    levels = np.random.default_rng(0).integers(0, 16, (100, 100))
    rows = cut_rows(75e-9 * levels, GRID, APERTURE_M, 8, shares=(0.0, 0.5))[:2]
    return certify_rows(rows, CAMERA, (552e-9, 656e-9))


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
