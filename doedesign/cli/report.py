"""The page of a run: report."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from doedesign.cli.console import print_paths, say
from doedesign.cli.options import AsJson, Flag
from fab.errors import InputError


def report(
    run: Path,
    *,
    compare: Annotated[tuple[Path, ...], Parameter(negative="", show_default=False)] = (),
    watch: Flag = False,
    order: Path | None = None,
    out: Path | None = None,
    json_: AsJson = False,
) -> None:
    """Write one HTML file with all that is known of a run: it opens from the disk, without a network.

    Maps to zoom to single pixels, PSFs by depth and colour, yield, the order as a model to turn, and where every number
    comes from. Parts appear once their data exist: psf, certify, masks, tolerance, calibrate, simulate, train and
    evaluate add to it.

    Args:
        run: Run folder, finished or at work.
        compare: Other runs to put beside it, with their differences.
        watch: Write it again whenever the run has changed, until it is done or stopped; end with Ctrl-C.
        order: The run's mask order; masks/NAME by default.
        out: The file; RUN/report.html by default, RUN/comparison.html beside others.
    """
    from doedesign.report.page.write import watch_report, write_report

    if not watch:
        written = write_report(run, compare=compare, order=order, out=out)
        print_paths([written], json_)
        say(f"look at: {written}")
        return
    if compare:
        raise InputError("--watch", "follows one run", "others to compare with", "Leave out --compare.")
    written = None
    try:
        for written in watch_report(run, order=order, out=out):
            say(f"written {written}; reload it in the browser")
        say("nothing works in this run any more")
    except KeyboardInterrupt:
        say("stopped watching")
    if written is not None:
        print_paths([written], json_)
