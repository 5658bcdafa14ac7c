"""What a lab checks again with KLayout alone: layer colours that KLayout reads, and a deck that finds what is wrong."""

import shutil
import subprocess

import klayout.db as kdb
import klayout.lay as lay
import pytest

from fab.gds.reader import read_gds
from fab.manifest.records import read_manifest
from fab.order.order import plan_order
from fab.order.recheck import drc_deck
from fab.process import Process
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
