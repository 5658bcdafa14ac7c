"""`doedesign masks` and `doedesign verify`: a height map becomes a mask order, and an order is proved."""

from collections.abc import Callable
from pathlib import Path

from doedesign.drawing import LevelMap
from doedesign.runs import open_run
from fab.files import sha256_file
from fab.layout import Chrome
from fab.order import write_order
from fab.verify import Report, verify_order

Say = Callable[[str], None]


def write_masks(source: Path, drawing: LevelMap, out: Path | None, say: Say = lambda _: None) -> tuple[Path, Report]:
    """Write and prove the mask order of a level map.

    Args:
        source: the run folder or height map it came from, for the manifest.
        drawing: what to draw.
        out: order folder; `masks/NAME` by default.
        say: told what is going on.

    Returns:
        the folder and the report of its proof.

    Raises:
        InputError: the map cannot be drawn, or the folder cannot be written.
        CheckFailed: what was read back differs from what was asked for; nothing is left behind.
    """
    folder = out or Path("masks") / drawing.name
    chrome = Chrome()
    kind, name = "height map", drawing.file.name
    if source.is_dir():
        run = open_run(source)
        chrome = Chrome(overlap_m=run.spec.process.chrome_overlap_m)
        kind, name = "run", run.spec.name
    origin = {"kind": kind, "name": name, "height_sha256": sha256_file(drawing.file)}
    report = write_order(
        folder,
        drawing.level,
        drawing.levels,
        drawing.grid,
        drawing.aperture_m,
        drawing.name,
        origin,
        chrome=chrome,
        say=say,
    )
    return folder, report


def verify(folder: Path) -> Report:
    """Prove a mask order from its files alone; see `fab.verify.verify_order`."""
    return verify_order(folder)
