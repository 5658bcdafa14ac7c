"""Orders of six levels: three masks, whose sets 2 + 3 and 1 + 2 + 3 make no level."""

import shutil
from dataclasses import replace
from typing import Any

import gdstk
import numpy as np
import pytest

from fab.errors import CheckFailed, InputError
from fab.gds.reader import read_gds
from fab.gds.writer import write_gds
from fab.grid import Grid
from fab.layout.geometry import Layer, Layout, Shapes, pixel_edges
from fab.levels import Levels, height_of
from fab.manifest.records import read_manifest
from fab.order.verify import verify
from fab.order.write import write_order
from fab.pictures import read_pixels
from fab.process import Normal, Process
from fab.solids.height_files import write_greymap
from fab.verification.files import read_drawn_levels
from tests.fab.maps import FEW, PLAIN, level_map_from, wide_map

SIX = Levels(6, 200e-9)
GRID = Grid((21, 16), 1.85e-6)
LEVEL = np.random.default_rng(7).integers(0, 6, GRID.shape).astype(np.uint8)


@pytest.fixture(scope="module")
def order(tmp_path_factory):
    """An order with everything in it. Not to be changed."""
    folder = tmp_path_factory.mktemp("orders") / "six"
    source = {"height_map": "a test"}
    written = write_order(
        folder, wide_map(LEVEL, SIX, GRID, "six"), source=source, wafer=FEW, formats=PLAIN, direct_write=True
    )
    assert written.report.passed
    return folder


def drawn_by(folder):
    manifest = read_manifest(folder)
    files, edges = manifest.drawn_files(folder), pixel_edges(manifest.grid())
    return read_drawn_levels(files, manifest.staircase(), edges, manifest.doe_cell, manifest.edge_moves())


def relief(folder):
    manifest = read_manifest(folder)
    return manifest.relief.inside(manifest.grid())


def test_an_order_of_six_levels_is_whole(order):
    report = verify(order)
    assert report.passed
    assert "all masks together, a level for every pixel" in {check.question for check in report.checks}
    manifest = read_manifest(order)
    assert manifest.staircase() == SIX
    assert [mask.depth_nm for mask in manifest.masks] == [200, 400, 800]
    assert "the other sets of masks make no level" in manifest.conventions["levels"]
    inside = relief(order)
    assert np.array_equal(drawn_by(order)[inside], LEVEL[inside])
    heights = np.load(next(order.glob("*_HEIGHT.npy")))
    assert np.array_equal(heights[inside], (LEVEL[inside] * 200e-9).astype(np.float32))
    assert heights[~inside].tolist() == [np.float32(1000e-9)] * np.count_nonzero(~inside)


def test_gdstk_sees_the_level_of_every_pixel(order):
    """A point in the middle of every pixel, and the depths of the masks whose polygons hold it."""
    manifest = read_manifest(order)
    y, x = ((np.arange(n) - (n - 1) / 2) * 1.85 for n in GRID.shape)
    points = [(float(u), float(v)) for v in y for u in x]
    depth_nm = np.zeros(len(points))
    for mask in manifest.masks:
        cells: list[Any] = gdstk.read_gds(str(order / mask.file)).cells
        cell = next(c for c in cells if c.name == manifest.doe_cell)
        polygons = [p for p in cell.polygons if (p.layer, p.datatype) == (mask.layer, mask.datatype)]
        depth_nm += np.array(gdstk.inside(points, polygons)) * mask.depth_nm
    wanted = np.where(relief(order), 1000 - 200 * LEVEL.astype(float), 0)
    assert np.array_equal(depth_nm.reshape(GRID.shape), wanted)


def forged(order, tmp_path, code):
    """A copy of an order in which masks etch a pixel of level 5, etched by none, by another set of them."""
    folder = shutil.copytree(order, tmp_path / "order")
    row, column = (int(v[0]) for v in np.nonzero((LEVEL == 5) & relief(order)))
    manifest, edges = read_manifest(order), pixel_edges(GRID)
    box = np.array([[edges.x[column], edges.y[row], edges.x[column + 1], edges.y[row + 1]]], np.int32)
    for mask in manifest.masks:
        if code >> mask.bit & 1:
            layout = read_gds(folder / mask.file)
            layer = Layer(mask.layer)
            cells = [
                replace(
                    cell, shapes={**cell.shapes, layer: Shapes(np.concatenate([cell.shapes[layer].rectangles, box]))}
                )
                if cell.name == manifest.doe_cell
                else cell
                for cell in layout.cells
            ]
            write_gds(folder / mask.file, Layout(layout.dbu_m, tuple(cells)))
    return folder, f"got 1 with a set of masks of none, the first at row {row}, column {column}"


@pytest.mark.parametrize("code", [6, 7])
def test_masks_that_make_no_level_together_are_refused(order, tmp_path, code):
    folder, where = forged(order, tmp_path, code)
    told = [one for one in verify(folder).differences if "a level for every pixel" in one]
    assert len(told) == 1
    assert told[0].endswith(f"they must give every pixel one of the 6 levels, but {where}")
    with pytest.raises(InputError, match=rf"M1_200NM\.gds.*must give every pixel one of the 6 levels, but {where}"):
        drawn_by(folder)


def test_masks_that_make_another_level_are_no_worse_than_that(order, tmp_path):
    folder, _ = forged(order, tmp_path, 5)
    told = verify(folder).differences
    assert any("pixel differs from the level map" in one for one in told)
    assert not any("a level for every pixel" in one for one in told)


def test_a_stored_level_beyond_the_last_is_no_level_map(order, tmp_path):
    folder, _ = forged(order, tmp_path, 6)
    path = folder / read_manifest(folder).level_map_file
    level = np.load(path)
    level[0, 0] = 6
    np.save(path, level)
    with pytest.raises(CheckFailed, match="the level map is unreadable"):
        verify(folder)


def test_a_process_of_six_levels_has_errors_of_three_masks():
    spreads = {"depth_scale[2]": Normal(0.0, 0.01), "overlay_x_m[0]": Normal(0.0, 1e-7)}
    process = Process(SIX, spreads=spreads)
    assert (process.masks, process.order, process.depths_m()) == (3, (0, 1, 2), SIX.depths_m)
    with pytest.raises(InputError, match=r"depth_scale\[3\]"):
        Process(SIX, spreads={"depth_scale[3]": Normal(0.0, 0.01)})


@pytest.mark.parametrize("count", [3, 5, 6, 12])
def test_grey_is_linear_in_height(tmp_path, count):
    levels = Levels(count, 100e-9)
    level = np.arange(36, dtype=np.uint8).reshape(6, 6) % count
    scale_m = write_greymap(tmp_path / "grey.png", level_map_from(level, levels))
    grey = read_pixels(tmp_path / "grey.png")
    # Half a count of 65535.
    np.testing.assert_allclose(grey * scale_m, height_of(level, levels), atol=0.51 * scale_m)
