"""Orders of maps that trip up drawing programs: written, proved, and opened by two other libraries."""

from typing import Any

import gdstk
import klayout.db as kdb
import numpy as np
import pytest

from fab.grid import Grid
from fab.layout.geometry import Chrome, pixel_edges
from fab.levels import Levels
from fab.manifest.records import read_manifest
from fab.order.write import write_order
from fab.units import NM, UM
from fab.verification.files import read_drawn_levels
from tests.fab.maps import FEW, PLAIN, wide_map

BLANK = 15


def dot(shape):
    """One pixel etched by every mask."""
    out = np.full(shape, BLANK)
    out[shape[0] // 2, shape[1] // 2] = 0
    return out


def hole(shape):
    """One pixel left standing in the deepest floor."""
    return BLANK - dot(shape)


def board(shape):
    """Pixels that touch at corners only, in every plane."""
    return np.where(np.indices(shape).sum(axis=0) % 2, BLANK, 0)


def stripes(shape):
    """Lines one pixel wide."""
    return np.where(np.indices(shape)[0] % 2, BLANK, 0)


def one_plane(shape):
    """One plane full, one empty, two that kiss."""
    return BLANK - np.where(np.indices(shape).sum(axis=0) % 2, 0b0011, 0b1001)


def noise(shape, count=16):
    return np.random.default_rng(shape[0]).integers(0, count, shape)


MAPS = {
    "one pixel in all": (np.zeros((1, 1), int), 16),
    "one row": (noise((1, 7)), 16),
    "one column": (noise((9, 1)), 16),
    "a dot": (dot((7, 6)), 16),
    "a hole": (hole((6, 7)), 16),
    "kissing corners": (board((8, 9)), 16),
    "stripes": (stripes((9, 8)), 16),
    "full, empty and kissing planes": (one_plane((5, 5)), 16),
    "all blank": (np.full((4, 6), BLANK), 16),
    "all etched": (np.zeros((6, 4), int), 16),
    **{f"{count} levels": (noise((11, 6), count), count) for count in (2, 4, 8, 16, 32, 64)},
}


@pytest.mark.slow
@pytest.mark.parametrize(("level_map", "count"), MAPS.values(), ids=MAPS.keys())
def test_awkward_maps_make_orders_that_other_libraries_read_pixel_by_pixel(tmp_path, monkeypatch, level_map, count):
    # The picture for people takes most of the time of an order this small.
    monkeypatch.setattr("fab.order.order.Order.plot", lambda *_: None)
    monkeypatch.setattr("fab.order.papers.png_bytes", lambda _: b"picture")
    levels, grid = Levels(count, 1200 * NM / count), Grid(level_map.shape, 2 * UM)
    # A circle wide enough for every pixel is wider than the raster; the aperture may not be, so corners are blank.
    folder = tmp_path / "o"
    given = wide_map(level_map, levels, grid, "odd")
    assert write_order(folder, given, chrome=Chrome(0.5 * UM), wafer=FEW, formats=PLAIN).report.passed
    manifest = read_manifest(folder)
    edges = pixel_edges(grid)
    combined = folder / manifest.combined_gds
    assert np.array_equal(read_drawn_levels([combined], levels, edges, manifest.doe_cell), given.level)
    for mask, plane in zip(manifest.masks, given.planes(), strict=True):
        assert np.array_equal(by_klayout(folder / mask.file, manifest.doe_cell, mask.layer, grid), plane)
        assert np.array_equal(by_klayout(folder / manifest.combined_oasis, manifest.doe_cell, mask.layer, grid), plane)
        assert np.array_equal(by_gdstk(folder / mask.file, manifest.doe_cell, mask.layer, grid), plane)


def by_klayout(path, cell, layer, grid):
    """Etched share of every pixel, by KLayout's rasteriser; of copies of a cell, too."""
    layout = kdb.Layout()
    layout.read(str(path))
    found = layout.find_layer(layer, 0)
    region = kdb.Region() if found is None else kdb.Region(layout.cell(cell).begin_shapes_rec(found))
    (ny, nx), pitch = grid.shape, round(grid.pitch_m / NM)
    origin = kdb.Point(-nx * pitch // 2, -ny * pitch // 2)
    areas = region.rasterize(origin, kdb.Vector(pitch, pitch), kdb.Vector(pitch, pitch), nx, ny)
    return np.array(areas) / pitch**2


def by_gdstk(path, cell, layer, grid):
    """Whether the middle of every pixel is etched, by gdstk's test of points; of copies of a cell, too."""
    library = gdstk.read_gds(str(path), unit=1e-6)
    found: Any = next(one for one in library.cells if one.name == cell)
    polygons = [polygon for polygon in found.get_polygons() if (polygon.layer, polygon.datatype) == (layer, 0)]
    x, y = np.meshgrid(grid.axis_m("x") / UM, grid.axis_m("y") / UM)
    points = list(zip(x.ravel().tolist(), y.ravel().tolist(), strict=True))
    return np.array(gdstk.inside(points, polygons)).reshape(grid.shape)
