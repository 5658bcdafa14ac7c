"""The last lines of a command: the numbers that matter, the picture to open, the cost, the next command to try."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from doedesign.cli.console import say
from fab.errors import InputError

if TYPE_CHECKING:
    from doedesign.overview.kinds import Record
    from doedesign.runs.costs import Cost, Measuring

_MOST = 3  # numbers


def closing_lines(
    folder: Path, run: Path | None = None, cost: "Cost | None" = None, *, order: Path | None = None
) -> list[str]:
    """The last lines of a command, from the folder that it wrote.

    Args:
        folder: folder of results; of one that holds none only the cost is said.
        run: the run that they belong to; the folder itself by default.
        cost: cost of the command, if it was measured.
        order: folder of the run's mask order; masks/NAME by default.
    """
    from doedesign.overview.kinds import record_of
    from doedesign.overview.numbers import main_numbers
    from doedesign.overview.pictures import shown_of
    from doedesign.runs.costs import costs_of, elapsed_text

    run, lines = run or folder, []
    try:
        record = record_of(folder)
    except InputError:
        record = None
    if record is not None:
        if numbers := main_numbers(folder, record)[:_MOST]:
            lines.append(f"result: {', '.join(one.text() for one in numbers)}")
        if pictures := shown_of(folder, record).pictures:
            lines.append(f"look at: {pictures[0]}")
    if cost is not None:
        kept = costs_of(run)
        parts = (
            f"; everything done with {run}: {elapsed_text(sum(one.seconds for one in kept))}"
            if kept and kept != (cost,)
            else ""
        )
        lines.append(f"took: {cost.text()}{parts}")
    if record is not None and (words := _next(folder, run, record, order)):
        lines.append(f"next: doedesign {shlex.join(words)}")
    return lines


def say_closing(folder: Path, run: Path | None = None, taken: "Measuring | None" = None) -> None:
    """Say the last lines of a command on stderr.

    Args:
        folder: folder of results that it wrote.
        run: the run that they belong to; the folder itself by default.
        taken: its cost.
    """
    for line in closing_lines(folder, run, None if taken is None else taken.cost):
        say(line)


def words_to_draw(name: str, run: Path) -> list[str]:
    """Words of the command that draws the masks of a run, without the program's name, where nothing is replaced.

    Args:
        name: name of its design.
        run: the run folder.
    """
    from doedesign.runs.orders import MASKS, free_place

    place = free_place(name, run)
    return ["masks", str(run), *(["--out", str(place)] if place != MASKS / name else [])]


def _next(folder: Path, run: Path, record: "Record", order: Path | None) -> list[str]:
    """Words of the command to try next, without the program's name; none where there is nothing to propose."""
    kind = record.kind
    if kind in ("run", "certificate"):
        return _masks_or_study(run, record, order)
    if kind == "fabricated":
        return _study(run)
    if kind in ("PSFs", "explanations"):
        return ["psf", str(run), "--fabricated", "--seed", "0"] if _has_errors(run) else ["report", str(run)]
    if kind in ("training", "fine-tuning", "released model"):
        captures = sorted((run / "simulated").glob("*/capture.*"))
        return ["reconstruct", str(folder), str(captures[0])] if captures else ["simulate", str(run)]
    if kind == "order":
        return ["show", str(folder), "masks"] if run == folder else ["report", str(run)]
    if kind == "calibration":
        return ["precompensate", str(run), "--process", str(folder / "process-estimate.toml")]
    if kind == "tolerance":
        return ["show", str(folder), "all"]
    of_run = {
        "simulation": ["train", str(run)],
        "as-built": ["show", str(folder), "all"],
        "evaluation": ["show", str(folder), "all"],
    }
    return of_run.get(kind, [])


def _masks_or_study(run: Path, record: "Record", order: Path | None) -> list[str]:
    """Draw the masks of a run, again for the sheet to tell its certificate; once it has some, study their errors."""
    from doedesign.runs.orders import is_order_of, order_of_run, own_level_map

    own = own_level_map(run)
    if own is not None and is_order_of(order or order_of_run(record.name, run, own), own):
        return _study(run) if record.kind == "run" else ["masks", str(run)]
    return words_to_draw(record.name, run)


def _study(run: Path) -> list[str]:
    return ["tolerance" if _has_errors(run) else "report", str(run)]


def _has_errors(run: Path) -> bool:
    """Whether plates of a run's process differ from each other, without which there is nothing to study or draw."""
    from doedesign.build import process_from_spec
    from doedesign.spec import load_spec
    from fab.draws import sources_of

    try:
        return bool(sources_of(process_from_spec(load_spec(run / "spec.toml").process)))
    except InputError:
        return False
