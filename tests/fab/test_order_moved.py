"""Orders whose masks are drawn against the line-width bias of the process."""

import shutil
from dataclasses import replace

import klayout.db as kdb
import numpy as np
import pytest

from fab.gds.reader import read_gds
from fab.gds.writer import write_gds
from fab.grid import Grid
from fab.layout.geometry import Layer, Shapes, pixel_edges
from fab.layout.wafer import Wafer
from fab.levels import Levels
from fab.manifest.records import read_manifest
from fab.order.order import Order, plan_order
from fab.order.request import order_from, request_of
from fab.order.verify import verify
from fab.order.write import write_order
from fab.process import Normal, Process
from fab.verification.files import read_drawn_levels
from tests.fab.maps import PLAIN, wide_map
from tests.orders import named


@pytest.fixture(scope="module")
def compensated(tmp_path_factory):
    """A map of blocks against a bias of 0.1 um on every mask, 0.3 um less on the third; and the same as drawn."""
    levels, grid = Levels(16, 75e-9), Grid((36, 30), 1.85e-6)
    level_map = np.kron(np.random.default_rng(8).integers(0, 16, (12, 10)), np.ones((3, 3), int)).astype(np.uint8)
    bias = {"common_cd_bias_m": Normal(0.1e-6, 0.0), "cd_bias_m[2]": Normal(-0.3e-6, 0.0)}
    process = Process(levels, spreads=bias)
    folders = [tmp_path_factory.mktemp("moved") / name for name in ("moved", "plain")]
    for folder, wafer in zip(folders, (Wafer(compensate=True), Wafer()), strict=True):
        write_order(folder, wide_map(level_map, levels, grid, "small"), process=process, wafer=wafer, formats=PLAIN)
    return folders


def test_edges_are_drawn_against_the_bias_and_the_map_comes_back(compensated):
    moved, plain = compensated
    manifest = read_manifest(moved)
    assert [mask.edge_move_nm for mask in manifest.masks] == [-100, -100, 200, -100]
    levels, edges = manifest.staircase(), pixel_edges(manifest.grid())
    drawn = read_drawn_levels([moved / manifest.combined_gds], levels, edges, manifest.doe_cell, manifest.edge_moves())
    assert np.array_equal(drawn, np.load(named(plain, "LEVELS.npy")))
    # The process moves every edge by its bias: printed like that, by KLayout, the drawing is the plane again.
    for mask in manifest.masks:
        regions = []
        for order in (manifest, read_manifest(plain)):
            layout = kdb.Layout()
            layout.read(str((moved if order is manifest else plain) / order.masks[mask.bit].file))
            shapes = layout.cell(order.doe_cell).shapes(layout.layer(mask.layer, 0))
            regions.append(kdb.Region(shapes).merged())
        assert not (regions[0] ^ regions[1]).is_empty()
        assert (regions[0].sized(round(-mask.edge_move_nm), 2) ^ regions[1]).is_empty()


def test_an_edge_that_was_moved_otherwise_is_told_by_both_readers(compensated, tmp_path):
    folder = tmp_path / "order"
    shutil.copytree(compensated[0], folder)
    file = named(folder, "M3_300NM.gds").name
    layout = read_gds(folder / file)
    doe, *around = layout.cells
    rects = doe.shapes[Layer(3)].rectangles.copy()
    rects[5, 2] += 1
    write_gds(folder / file, replace(layout, cells=(replace(doe, shapes={Layer(3): Shapes(rects)}), *around)))
    told = {c.question: " ".join(c.problems) for c in verify(folder).checks if c.file == file}
    for question in ("own reader, every pixel", "gdstk, every pixel"):
        assert "layer 3/0: every edge must be a pixel edge moved by 200 nm" in told[question]


def test_a_bias_wider_than_the_pixels_allow_is_refused(tmp_path):
    levels, grid = Levels(4, 75e-9), Grid((12, 12), 1e-6)
    level_map = np.random.default_rng(0).integers(0, 4, (12, 12)).astype(np.uint8)
    process = Process(levels, spreads={"common_cd_bias_m": Normal(0.6e-6, 0.0)})
    with pytest.raises(ValueError, match="edges must move by less than half the narrowest line and space"):
        write_order(tmp_path / "o", wide_map(level_map, levels, grid), process=process, wafer=Wafer(compensate=True))
    assert not (tmp_path / "o").exists()


def test_edges_may_be_given_by_mask_whatever_the_process_is_known_for():
    levels, grid = Levels(16, 75e-9), Grid((36, 30), 1.85e-6)
    level_map = np.kron(np.random.default_rng(8).integers(0, 16, (12, 10)), np.ones((3, 3), int)).astype(np.uint8)
    moves, process = (-100e-9, 60e-9, 200e-9, 0.0), Process(levels, spreads={"common_cd_bias_m": Normal(0.3e-6, 0.0)})

    def planned(wafer: Wafer) -> Order:
        return plan_order(wide_map(level_map, levels, grid, "small"), process=process, wafer=wafer)

    order, plain = planned(Wafer(edge_moves_m=moves)), planned(Wafer())
    assert [move * order.dbu_m for move in order.edge_moves()] == pytest.approx(moves)
    assert order.geometry != plain.geometry
    # Orders from before there was such a list are the same as ever.
    assert "edge_moves_m" not in request_of(plain)["wafer"]
    assert order_from(request_of(order), level_map, "here").edge_moves() == order.edge_moves()
    with pytest.raises(ValueError, match="must be one length per mask, 4, but got 3"):
        planned(Wafer(edge_moves_m=moves[:3])).edge_moves()


@pytest.mark.parametrize(
    ("wafer", "words"),
    [
        ({"edge_moves_m": (1e-7,) * 4, "compensate": True}, "or against the bias, but got both"),
        ({"edge_moves_m": (2e-4,)}, "must be at most 100 um"),
        ({"edge_moves_m": (float("nan"),)}, "must be several numbers of metres"),
    ],
)
def test_moves_that_cannot_be_are_refused(wafer, words):
    with pytest.raises(ValueError, match=words):
        Wafer(**wafer)
