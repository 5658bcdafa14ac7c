"""The run sheet of an order, and the way back: `doedesign masks RUN --as-built FILE`."""

import json

from sim.store import read_bank


def test_an_order_has_a_run_sheet_of_its_own_files(finished):
    (page,) = finished.order.glob("*_RUNSHEET.html")
    (sheet,) = finished.order.glob("*_RUNSHEET.json")
    text = page.read_text()
    manifest = json.loads((finished.order / "manifest.json").read_text())
    for plate in manifest["plates"]:
        assert plate["file"] in text
    for entry in manifest["files"]:
        if entry["file"].endswith(".gds") and entry["file"] != manifest["combined_gds"]:
            assert entry["sha256"][:8] in text
    assert json.loads(sheet.read_text())["measured"]


def test_a_sheet_that_nobody_filled_in_gives_the_plate_as_drawn(copied, cli):
    (sheet,) = copied.order.glob("*_RUNSHEET.json")
    done = cli("masks", copied.run, "--order", copied.order, "--as-built", sheet)
    assert done.code == 0, done.err
    built = read_bank(copied.run / "as-built" / "as-built.exr")
    drawn = read_bank(copied.run / "psf" / "from_masks.exr")
    # The spec's process is ideal, so what was not measured is without error.
    assert (built.energy == drawn.energy).all()


def test_a_sheet_of_another_order_and_options_that_do_not_go_together_are_refused(copied, cli, tmp_path):
    (sheet,) = copied.order.glob("*_RUNSHEET.json")
    other = json.loads(sheet.read_text())
    other["level_map_sha256"] = "0" * 64
    (tmp_path / "other.json").write_text(json.dumps(other))
    done = cli("masks", copied.run, "--order", copied.order, "--as-built", tmp_path / "other.json")
    assert done.code == 2
    assert "other.json" in done.err
    done = cli("masks", copied.run, "--order", copied.order, "--out", tmp_path / "x")
    assert done.code == 2
    assert "goes with --as-built only" in done.err
