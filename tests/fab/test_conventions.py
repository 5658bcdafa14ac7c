"""What a lab and every other module rely on: one place that pins the conventions of the masks."""

from typing import Any

import gdstk
import klayout.db as kdb
import numpy as np
import pytest

from fab.gds.writer import write_gds
from fab.grid import Grid
from fab.layout.doe import mask_layout
from fab.layout.geometry import Chrome
from fab.levels import Levels, height_of, planes, quantise
from fab.order.write import write_order
from tests.fab.maps import FEW, wide_map
from tests.orders import named

LEVELS = Levels(16, 75e-9)
GRID = Grid((4, 4), 2e-6)


def drawn(tmp_path, level_map):
    """Return the polygons of each layer in micrometres, as another library reads them."""
    write_gds(tmp_path / "a.gds", mask_layout(wide_map(level_map, LEVELS, GRID), "DOE", Chrome(overlap_m=1e-6)))
    found = {}
    cells: list[Any] = gdstk.read_gds(str(tmp_path / "a.gds")).cells
    for polygon in cells[0].polygons:
        found.setdefault((polygon.layer, polygon.datatype), []).append(polygon)
    return found


def one_pixel(row, column, level):
    level_map = np.full((4, 4), 15, dtype=np.uint8)
    level_map[row, column] = level
    return level_map


@pytest.mark.parametrize("bit", range(4))
def test_bit_k_is_layer_k_plus_one_datatype_zero(tmp_path, bit):
    # Level 15 - 2**bit lacks exactly 2**bit steps.
    found = drawn(tmp_path, one_pixel(1, 1, 15 - 2**bit))
    assert set(found) == {(bit + 1, 0), (5, 0)}


def test_a_polygon_means_etched_here(tmp_path):
    # The blank is the top level: no polygon. The deepest floor lies under all masks.
    assert set(drawn(tmp_path, np.full((4, 4), 15, dtype=np.uint8))) == {(5, 0)}
    assert set(drawn(tmp_path, one_pixel(1, 1, 0))) == {(1, 0), (2, 0), (3, 0), (4, 0), (5, 0)}
    assert LEVELS.heights_m()[0] == 0


def test_row_zero_is_the_lowest_y_and_column_zero_the_lowest_x(tmp_path):
    (polygon,) = drawn(tmp_path, one_pixel(3, 1, 14))[1, 0]
    # Row 3 of four pixels of 2 um: y from 2 to 4; column 1: x from -2 to 0.
    np.testing.assert_allclose(polygon.bounding_box(), ((-2, 2), (0, 4)), atol=1e-12)


def test_a_height_that_grows_with_y_is_etched_deeper_below(tmp_path):
    height_m = np.repeat(np.array([[0.0], [300e-9], [600e-9], [1125e-9]]), 4, axis=1)
    deepest = drawn(tmp_path, quantise(height_m, LEVELS))[4, 0]
    assert max(y for polygon in deepest for _, y in polygon.points) == 0


def test_the_origin_is_the_centre_of_the_clear_aperture(tmp_path):
    chrome = drawn(tmp_path, np.full((4, 4), 15, dtype=np.uint8))[5, 0]
    points = np.concatenate([polygon.points for polygon in chrome])
    np.testing.assert_allclose(points.min(axis=0), -points.max(axis=0), atol=1e-9)
    # Chrome here means chrome: the opening is 3 um in radius, 1 um inside the aperture of 4 um.
    assert np.hypot(*points.T).min() == pytest.approx(3.0, abs=1e-3)
    assert not any(gdstk.inside([(0, 0), (2.9, 0), (0, -2.9)], chrome))
    assert all(gdstk.inside([(3.1, 0), (0, -3.9), (200, 300)], chrome))


def test_the_depths_of_all_open_masks_make_the_height():
    level_map = np.arange(16, dtype=np.uint8).reshape(4, 4)
    depth_m = sum(LEVELS.etch_depth_m(bit) * plane for bit, plane in enumerate(planes(level_map, LEVELS)))
    np.testing.assert_allclose(1125e-9 - depth_m, height_of(level_map, LEVELS), atol=1e-21)


@pytest.mark.slow
def test_oasis_draws_the_same_way_up(tmp_path):
    write_order(
        tmp_path / "o", wide_map(one_pixel(3, 1, 14), LEVELS, GRID, "up"), chrome=Chrome(overlap_m=1e-6), wafer=FEW
    )
    layout = kdb.Layout()
    layout.read(str(named(tmp_path / "o", "ALL.oas")))
    box = layout.cell(f"{layout.top_cell().name}_DOE").bbox(layout.find_layer(1, 0))
    assert (box.left, box.bottom, box.right, box.top) == (-2000, 2000, 0, 4000)
