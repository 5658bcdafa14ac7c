"""The report of the quick example as a user makes it: its size, and the page in a browser."""

import contextlib
import json
from pathlib import Path

import pytest

from doedesign.report.page.blocks import TableBlock
from doedesign.report.page.gather import gather
from tests.doedesign.small_runs import call
from tests.report.browser import CHROMIUM, chromium, violations, visit

QUICK = Path(__file__).parents[2] / "examples" / "quick.toml"
MOST_BYTES = 6_000_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the finished quick run, its order, its PSFs, plates as fabricated and captures."""
    folder = tmp_path_factory.mktemp("quick")
    run = "runs/quick"
    commands = (
        ["optimize", QUICK],
        ["masks", run],
        ["verify", "masks/quick"],
        ["masks", run, "--as-built", "filled.json"],
        ["psf", run],
        ["psf", run, "--fabricated", "--seed", "0"],
        ["tolerance", run, "--draws", "8"],
        ["certify", run, "--cells", "12", "--pieces", "0"],
        ["simulate", run],
        ["report", run],
    )
    with contextlib.chdir(folder):
        for command in commands:
            if "--as-built" in command:
                fill_in(Path())
            code, _, told = call(*command)
            assert code == 0, told
    return folder


def fill_in(folder: Path) -> None:
    """The run sheet with what a lab measured of two masks."""
    (sheet,) = folder.glob("masks/quick/*_RUNSHEET.json")
    record = json.loads(sheet.read_text())
    record["measured"]["mask 1"]["depth_nm"], record["measured"]["mask 4"]["overlay_x_um"] = 76.5, 0.6
    (folder / "filled.json").write_text(json.dumps(record))


@pytest.mark.study
def test_the_quick_report_is_small_and_complete(folder: Path):
    path = folder / "runs" / "quick" / "report.html"
    assert path.stat().st_size <= MOST_BYTES
    content = gather(folder / "runs" / "quick")
    parts = [part.name for part in content.sections]
    assert parts == ["reached", "map", "light", "budget", "tolerance", "order", "captures", "history", "provenance"]
    tables = {block.title: block for part in content.sections for block in part.blocks if isinstance(block, TableBlock)}
    rows = tables["Wafer as measured: errors that were measured"].rows
    assert rows == (("depth scale, mask 1", "2 %", "measured"), ("overlay x, mask 4", "600 nm", "measured"))
    assert len(tables["Wafer as measured: light beside that of the sheet"].rows) > 5
    kinds = {block.kind for part in content.sections for block in part.blocks}
    assert kinds == {"bars", "table", "map", "psf", "picture", "chart", "text", "commands", "model", "divider"}
    text = path.read_text()
    assert "doedesign tolerance runs/quick --draws 8 --seed 0" in text
    assert "doedesign verify masks/quick" in text


@pytest.mark.study
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_the_quick_report_opens_and_everybody_can_read_it(folder: Path):
    with chromium() as browser:
        for scheme, width in (("light", 1280), ("dark", 390)):
            seen = visit(browser, folder / "runs" / "quick" / "report.html", scheme=scheme, width=width)
            seen.see_all()
            seen.page.evaluate("document.querySelectorAll('details').forEach(one => { one.open = true; })")
            assert violations(seen.page) == []
            assert seen.page.evaluate("document.documentElement.scrollWidth") <= width
            seen.require_quiet()
