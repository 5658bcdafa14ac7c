"""`write_report`: the page of a run, written once or as often as the run changes."""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from doedesign.report.page.compare import compared
from doedesign.report.page.files import work_state
from doedesign.report.page.gather import gather
from doedesign.report.page.render import render
from fab.errors import InputError
from fab.files import os_errors_explained, path_of, write_atomic

if TYPE_CHECKING:
    from doedesign.design.design import Design
    from doedesign.runs.folder import Run

_EVERY_S = 2.0
# By which a page is known as one, in its first bytes.
_MARK, _HEAD = b'<meta name="generator" content="doedesign', 2000


def write_report(
    run: "Design | Run | str | Path",
    *,
    compare: "Sequence[Design | Run | str | Path]" = (),
    order: str | Path | None = None,
    out: str | Path | None = None,
) -> Path:
    """Write the page of a run: one HTML file that opens from the disk.

    Args:
        run: the run folder, finished or at work; an open run or a design stands for its folder.
        compare: other runs to put beside it.
        order: its mask order; `masks/NAME` beside the folder of runs, or where the program runs, by default. Not with
            other runs, whose page shows none.
        out: the file; report.html in the run's folder by default, comparison.html for several runs.

    Returns:
        the file.

    Raises:
        InputError: a design without a folder; something that is damaged, was changed, or does not belong to the run;
            `out` is another file than an earlier page; an order beside other runs.
    """
    if compare and order is not None:
        cure = "Leave it out: a comparison shows no order."
        raise InputError("order", "does not go with other runs to compare with", str(order), cure)
    folder, others = _folder_of(run), [_folder_of(one) for one in compare]
    path = path_of(out, "out") if out is not None else folder / ("comparison.html" if others else "report.html")
    if path.is_file() and not _is_page(path):
        raise InputError(str(path), "a report must not replace another file", "no report", "Choose another place.")
    given = None if order is None else Path(order)
    content = compared([folder, *others]) if others else gather(folder, given)
    write_atomic(path, render(content))
    return path


def _folder_of(run: "Design | Run | str | Path") -> Path:
    if not isinstance(run, str | Path) and not hasattr(run, "folder"):
        rule, cure = "must be a design, a run or its folder", 'For example "runs/NAME".'
        raise InputError("run", rule, f"a {type(run).__name__}", cure)
    folder = run if isinstance(run, str | Path) else run.folder
    if folder is None:
        cure = "Optimise it into a folder, or give that of its run."
        raise InputError("run", "a page is written of a run folder", "a design in memory", cure)
    return Path(folder)


def _is_page(path: Path) -> bool:
    with os_errors_explained(path), path.open("rb") as stream:
        return _MARK in stream.read(_HEAD)


def watch_report(
    run: str | Path, *, order: str | Path | None = None, out: str | Path | None = None, every_s: float = _EVERY_S
) -> Iterator[Path]:
    """Write the page of a run whenever its files changed, until nothing works in it any more; yield it every time.

    Args:
        run: the run folder.
        order: its mask order, as `write_report`.
        out: the file, as `write_report`.
        every_s: seconds between two looks.

    Raises:
        InputError: as `write_report`.
    """
    folder, seen = Path(run), None
    while True:
        working, state = work_state(folder)
        if state != seen:
            seen = state
            yield write_report(folder, order=order, out=out)
        if not working:
            return
        time.sleep(every_s)
