"""What a lab checks again with KLayout alone: layer colours that KLayout reads, and a deck that finds what is wrong."""

import json
import shutil
import subprocess

import klayout.db as kdb
import klayout.lay as lay
import numpy as np
import pytest

from fab.aperture import RectangularAperture
from fab.gds.reader import read_gds
from fab.grid import Grid
from fab.layout.doe import mask_layout
from fab.layout.geometry import Layer
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.manifest.records import read_manifest
from fab.order.order import plan_order
from fab.order.recheck import drc_deck
from fab.process import Normal, Process
from tests.orders import named


def test_klayout_reads_the_layers_with_their_names(written_order):
    view = lay.LayoutView()
    view.load_layer_props(str(named(written_order, "LAYERS.lyp")))
    found = {(node.source_layer, node.source_datatype): node.name for node in view.each_layer()}
    layers = read_gds(named(written_order, "ALL.gds")).layers
    assert set(found) == {(layer.number, layer.datatype) for layer in layers}
    assert found[(1, 0)] == "ETCH_B0_75nm"
    assert found[(5, 0)] == "CHROME"
    assert all(found.values())


def test_the_deck_names_every_file_and_the_rules_of_the_process(written_order, level_map):
    manifest = read_manifest(written_order)
    deck = named(written_order, "CHECK.drc").read_text()
    assert all(f'"{plate.file}"' in deck for plate in manifest.plates)
    assert f'REVIEW = "{manifest.combined_oasis}"' in deck
    process = Process(level_map.levels, minimum_line_m=1.2e-6, minimum_space_m=1.5e-6)
    head = drc_deck(plan_order(level_map, process=process), "x.oas").decode()
    assert "LINE_UM = 1.2\nSPACE_UM = 1.5\n" in head


def deck_findings(order):
    """How many narrow lines, narrow spaces and edges that are not moved the numbers of the deck find in an order."""
    head = drc_deck(order, "x.oas").decode().split("\n\n")[0]
    said = {name: json.loads(value) for name, value in (line.split(" = ", 1) for line in head.splitlines())}
    line, space = (round(said[name] * 1e-6 / order.dbu_m) for name in ("LINE_UM", "SPACE_UM"))
    found = [0, 0, 0]
    for (cell, moves), split in zip(said["DOES"], order.splits, strict=True):
        assert cell == f"{order.stem}_{split.code}"
        drawn_as = mask_layout(order.level_map, "X", order.chrome, split.moves, split.bits)
        for number, move_um in enumerate(moves, 1):
            drawn, move = kdb.Region(), round(move_um * 1e-6 / order.dbu_m)
            for box in drawn_as.top.shapes[Layer(number)].rectangles.tolist():
                drawn.insert(kdb.Box(*box))
            doe = drawn.sized(-move)
            found[0] += doe.width_check(line, False, kdb.Region.Projection).count()
            found[1] += doe.space_check(space, False, kdb.Region.Projection).count()
            found[2] += (drawn ^ doe.sized(move)).count()
    return found


@pytest.mark.parametrize("bias_m", [0.1e-6, -0.1e-6])
def test_the_deck_measures_moved_masks_as_the_rules_do(bias_m):
    """Bars of 1 um, the narrowest that prints, and blocks one pixel beside each other's columns, drawn moved."""
    levels, grid, level = Levels(4, 75e-9), Grid((30, 60), 0.5e-6), np.full((30, 60), 3, np.uint8)
    level[:, 4::4] = level[:, 5::4] = 0
    level[:9], level[1:4, 2:6], level[4:7, 7:11], level[1:4, 14:18], level[4:7, 17:21] = 3, 0, 0, 0, 0
    narrow = {"common_cd_bias_m": Normal(bias_m, 0.0)}
    process = Process(levels, spreads=narrow, minimum_line_m=1e-6, minimum_space_m=1e-6)
    wafer = Wafer(compensate=True, line_splits_m=(-0.05e-6, 0.05e-6), order_control=True)
    plate = LevelMap(level, levels, grid, RectangularAperture(grid.extent_m))
    order = plan_order(plate, process=process, wafer=wafer)
    assert order.rules.clean
    assert order.edge_moves() == (round(-bias_m * 1e9),) * 2
    assert deck_findings(order) == [0, 0, 0]
    deck = drc_deck(order, "x.oas").decode()
    assert "doe = drawn.sized(-move)" in deck
    assert "told(drawn ^ doe.sized(move)" in deck
    level[20, 6::4] = 0  # spaces of one pixel
    coarse = plan_order(plate.with_level(level), process=process, wafer=wafer)
    assert not coarse.rules.printable
    assert deck_findings(coarse)[1] > 0


def run_deck(folder, tmp_path):
    """Run the deck by KLayout itself; the lines that it prints."""
    command = ["klayout", "-b", "-r", str(named(folder, "CHECK.drc")), "-rd", f"out={tmp_path / 'found.lyrdb'}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.skipif(shutil.which("klayout") is None, reason="the program KLayout is not installed, only its library")
def test_the_deck_passes_an_order_and_finds_planted_defects(order_folder, tmp_path):
    assert run_deck(order_folder, tmp_path)[-1].endswith("all checks passed")
    plate = named(order_folder, "M2_150NM.gds")
    layout = kdb.Layout()
    layout.read(str(plate))
    name = layout.top_cell().name.removesuffix("_M2_150NM")
    layout.cell(f"{name}_SITE").shapes(layout.find_layer(2, 0)).insert(kdb.Box(0, 0, 1000, 1000))
    for instance in layout.cell(f"{name}_DIE").each_inst():
        instance.trans = instance.trans * kdb.Trans(1000, 0)
    layout.write(str(plate))
    (found,) = [line for line in run_deck(order_folder, tmp_path) if line.startswith("FOUND")]
    assert f"shapes of cell {name}_SITE" in found
    assert f"places in cell {name}_DIE" in found
    assert plate.name in found


@pytest.mark.skipif(shutil.which("klayout") is None, reason="the program KLayout is not installed, only its library")
def test_the_deck_finds_lines_and_spaces_that_are_too_narrow_and_no_corners(order_folder, tmp_path):
    """Pixels of 1.85 um touch at corners all over: that is no space of zero."""
    deck, found = named(order_folder, "CHECK.drc"), []
    words = deck.read_text()
    for least in ("1.8", "1.9"):
        deck.write_text(
            words.replace("LINE_UM = 0.0", f"LINE_UM = {least}").replace("SPACE_UM = 0.0", f"SPACE_UM = {least}")
        )
        found.append([line for line in run_deck(order_folder, tmp_path) if "FOUND" in line])
    assert found[0] == []
    assert len(found[1]) == 9  # lines and spaces of four masks, and the sum
