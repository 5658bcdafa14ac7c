"""Dies that draw the DOE differently on purpose: line-width splits, and the control of the etch order."""

import re
import shutil
from dataclasses import replace

import klayout.db as kdb
import numpy as np
import pytest

from fab.errors import InputError
from fab.gds.reader import read_gds
from fab.gds.writer import write_gds
from fab.grid import Grid
from fab.layout.geometry import Layer, Shapes
from fab.layout.split import splits_of
from fab.layout.wafer import Wafer
from fab.levels import Levels
from fab.manifest.records import read_manifest
from fab.order.order import plan_order
from fab.order.terms import OrderTerms
from fab.order.verify import verify
from fab.order.write import write_order
from fab.process import Normal, Process
from tests.fab.maps import PLAIN, wide_map

LEVELS, GRID = Levels(16, 75e-9), Grid((36, 30), 1.85e-6)


@pytest.fixture(scope="module")
def split(tmp_path_factory):
    """Blocks of 3 x 3 pixels, two line-width splits and the control, with a known bias made up for."""
    level_map = np.kron(np.random.default_rng(8).integers(0, 16, (12, 10)), np.ones((3, 3), int)).astype(np.uint8)
    process = Process(LEVELS, spreads={"common_cd_bias_m": Normal(0.1e-6, 0.0)})
    wafer = Wafer(compensate=True, line_splits_m=(-0.25e-6, 0.25e-6), order_control=True)
    folder = tmp_path_factory.mktemp("split") / "order"
    written = write_order(folder, wide_map(level_map, LEVELS, GRID, "s"), process=process, wafer=wafer, formats=PLAIN)
    assert written.report.passed
    return folder


def etched(folder, file, cell, layer):
    """The area that a cell of a file draws on a layer, read by KLayout."""
    layout = kdb.Layout()
    layout.read(str(folder / file))
    return kdb.Region(layout.cell(cell).shapes(layout.layer(layer, 0))).merged()


def test_one_of_the_splits_prints_the_design_where_the_line_width_strays_by_as_much(split):
    manifest = read_manifest(split)
    assert [one.words for one in manifest.splits][:2] == [
        "edges of etched areas drawn 250 nm further in on every etch mask",
        "edges of etched areas drawn 250 nm further out on every etch mask",
    ]
    for mask in manifest.masks:
        # What the plate as ordered prints with the bias that it was drawn for ...
        wanted = etched(split, mask.file, manifest.doe_cell, mask.layer).sized(100, 2)
        for one, more in zip(manifest.splits[:2], (-250, 250), strict=True):
            # ... the split prints with that bias less its own move.
            drawn = etched(split, mask.file, one.cell, mask.layer)
            assert one.layers[mask.bit].edge_move_nm == more - 100
            assert (drawn.sized(100 - more, 2) ^ wanted).is_empty()


def test_the_control_is_the_design_if_the_depths_were_etched_in_the_opposite_order(split):
    manifest = read_manifest(split)
    control = manifest.splits[2]
    depths = [mask.depth_nm for mask in manifest.masks]
    planes = [
        [etched(split, manifest.combined_gds, cell, mask.layer) for mask in manifest.masks]
        for cell in (manifest.doe_cell, control.cell)
    ]
    # Mask k with the depth of mask 3 - k: every area of the control goes as deep as the design's.
    for mask, depth in enumerate(reversed(depths)):
        bit = depths.index(depth)
        assert bit == 3 - mask
        assert (planes[1][mask] ^ planes[0][bit]).is_empty()


def test_every_split_is_placed_five_times_and_bears_its_name(split):
    manifest = read_manifest(split)
    layout = kdb.Layout()
    layout.read(str(split / manifest.combined_gds))
    wafer = layout.cell(f"{layout.top_cell().name}_WAFER")
    counts = {}
    for instance in wafer.each_inst():
        counts[instance.cell.name] = counts.get(instance.cell.name, 0) + max(instance.na * instance.nb, 1)
        x, y = instance.trans.disp.x / 1e6, instance.trans.disp.y / 1e6
        for one in manifest.splits:
            if instance.cell.name == f"{one.cell}_DIE":
                assert [x, y] in [manifest.wafer.dies_mm[die - 1] for die in one.dies]
                plain = layout.cell(f"{layout.top_cell().name}_DIE").bbox(layout.layer(1, 3))
                # The name stands above the DOE, where the plate as ordered has nothing.
                assert instance.cell.bbox(layout.layer(1, 3)).top > 0 > plain.top
    assert sum(n for name, n in counts.items() if name.endswith("_DIE")) == len(manifest.wafer.dies_mm)
    assert all(counts[f"{one.cell}_DIE"] == len(one.dies) == 5 for one in manifest.splits)


@pytest.mark.slow
def test_a_split_that_is_not_what_it_should_be_is_told_by_both_readers(split, tmp_path):
    folder = tmp_path / "order"
    shutil.copytree(split, folder)
    manifest = read_manifest(folder)
    file, cell = manifest.masks[2].file, manifest.splits[2].cell
    layout = read_gds(folder / file)
    cells = {one.name: one for one in layout.cells}
    shapes = cells[cell].shapes
    cells[cell] = replace(cells[cell], shapes={**shapes, Layer(3): Shapes(shapes[Layer(3)].rectangles[1:])})
    write_gds(folder / file, replace(layout, cells=tuple(cells.values())))
    told = [line for line in verify(folder).differences if f"cell {cell}: layer 3/0" in line]
    assert any("own reader" in line and "polygons more or less" in line for line in told)
    assert any("gdstk" in line and "from the level map" in line for line in told)


def test_splits_leave_a_die_as_ordered():
    with pytest.raises(InputError, match="one die or more as ordered"):
        Wafer(dies=(1, 2), line_splits_m=(1e-7,), order_control=True)
    with pytest.raises(InputError, match="out or in"):
        Wafer(line_splits_m=(0.0,))
    with pytest.raises(InputError, match="at most 32, but got 33"):
        Wafer(line_splits_m=(1e-7,) * 33)
    with pytest.raises(InputError, match="at most 100000 altogether"):
        Wafer(dies=(1000, 101))
    assert [one.code for one in splits_of(Wafer(), LEVELS, (0,) * 4, 1e-9)] == ["DOE"]


def test_the_control_of_the_order_gives_every_mask_the_plane_of_the_opposite_depth():
    """Whatever bits the depths belong to; a single depth has no order."""
    levels = Levels(8, 75e-9, (300e-9, 75e-9, 600e-9))
    (_, control) = splits_of(Wafer(order_control=True), levels, (0, 0, 0), 1e-9)
    given = {levels.etch_depth_m(mask): levels.etch_depth_m(plane) for mask, plane in enumerate(control.bits)}
    assert given == {75e-9: 600e-9, 300e-9: 300e-9, 600e-9: 75e-9}
    with pytest.raises(InputError, match="order_control: needs two masks or more"):
        splits_of(Wafer(order_control=True), Levels(2, 600e-9), (0,), 1e-9)


def test_moved_edges_must_leave_what_the_process_prints(tmp_path, caplog):
    """Lines and spaces of 1 um, as fine as it prints; what makes up for a bias is none of it."""
    stripes = np.tile(np.repeat([0, 1], 1), (32, 16)).astype(np.uint8)
    plate = wide_map(stripes, Levels(2, 600e-9), Grid((32, 32), 1e-6), "s")
    fine = Process(Levels(2, 600e-9), minimum_line_m=1e-6, minimum_space_m=1e-6)
    wider = replace(fine, spreads={"common_cd_bias_m": Normal(0.2e-6, 0.0)})
    for process, wafer, said in (
        (fine, Wafer(), None),
        (fine, Wafer(edge_moves_m=(0.4e-6,)), "narrowest space prints 200 nm wide, below the 1 um"),
        (fine, Wafer(line_splits_m=(-0.45e-6,)), r"450 nm further in .*narrowest line prints 100 nm wide"),
        (wider, Wafer(compensate=True), None),
    ):
        caplog.clear()
        plan_order(plate, process=process, wafer=wafer, on_violation="fail" if said is None else "warn")
        assert bool(said) == any(re.search(said or "edges are moved", message) for message in caplog.messages)
        if said:
            with pytest.raises(InputError, match=said):
                plan_order(plate, process=process, wafer=wafer, on_violation="fail")


@pytest.mark.parametrize("bias_m", [123.4e-9, -123.6e-9, 100e-9])
def test_a_bias_that_is_no_whole_number_of_units_can_be_made_up_for(bias_m: float):
    """Edges move by whole units: up to half of one is left on either side of a line."""
    stripes = np.tile([0, 1], (32, 16)).astype(np.uint8)
    plate = wide_map(stripes, Levels(2, 600e-9), Grid((32, 32), 1e-6), "s")
    spreads = {"common_cd_bias_m": Normal(bias_m, 0.0)}
    process = Process(Levels(2, 600e-9), minimum_line_m=1e-6, minimum_space_m=1e-6, spreads=spreads)
    assert plan_order(plate, process=process, wafer=Wafer(compensate=True), on_violation="fail").narrowed() == ()


def test_moved_edges_of_a_repaired_map_are_checked(caplog):
    """Lines that the process cannot print are widened to what it can, and then made narrower by a split."""
    level = np.tile(np.repeat([0, 1], 4), (32, 4)).astype(np.uint8)
    level[:, 5] = 0  # leaves a line of one pixel
    plate = wide_map(level, Levels(2, 600e-9), Grid((32, 32), 1e-6), "s")
    process = Process(Levels(2, 600e-9), minimum_line_m=2e-6, minimum_space_m=2e-6)
    order = plan_order(plate, process=process, wafer=Wafer(line_splits_m=(-0.6e-6,)), on_violation="fix")
    assert order.rules.clean
    assert any("edges are moved so far" in message for message in caplog.messages) == bool(order.narrowed())
    assert order.narrowed()


def test_lines_off_the_grid_of_the_mask_writer_are_told(caplog):
    plate = wide_map(np.zeros((8, 8), np.uint8), Levels(2, 600e-9), Grid((8, 8), 1.03e-6), "s")
    plan_order(plate)
    assert "mask writer's grid" not in caplog.text
    order = plan_order(plate, terms=OrderTerms(address_grid_m=100e-9))
    assert "lie off the mask writer's grid of 100 nm, which will move them by up to 40 nm" in caplog.text
    assert order.rules.off_grid.address_m == 100e-9


def test_staircases_of_other_counts_are_other_jobs():
    """Six and seven levels of the same map and depths: planes are counted from the top level down."""
    level = np.random.default_rng(0).integers(0, 6, (8, 8)).astype(np.uint8)
    maps = [wide_map(level, Levels(count, 75e-9), Grid((8, 8), 1e-6), "s") for count in (6, 7, 8)]
    assert len({plan_order(one).geometry for one in maps}) == 3


def test_a_split_that_closes_a_gap_is_refused(tmp_path):
    level_map = np.random.default_rng(1).integers(0, 16, GRID.shape).astype(np.uint8)
    wafer = Wafer(line_splits_m=(1e-6,))
    with pytest.raises(InputError, match="narrowest space"):
        write_order(tmp_path / "o", wide_map(level_map, LEVELS, GRID, "s"), wafer=wafer)
    assert not (tmp_path / "o").exists()
