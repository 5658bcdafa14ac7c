"""A look at what there is: runs, show, compare, doctor."""

import json
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from doedesign.cli.closing import words_to_draw
from doedesign.cli.console import print_paths, print_text, say
from doedesign.cli.options import AsJson, Flag, refuse_options
from fab.errors import InputError, printable

if TYPE_CHECKING:
    from doedesign.overview.comparing import Comparison
    from doedesign.overview.listing import Entry

Folders = Annotated[tuple[Path, ...], Parameter(negative="", show_default=False)]
What = Literal["picture", "pictures", "masks", "pages", "all"]


def runs(folders: Folders = (), /, *, json_: AsJson = False) -> None:
    """List runs and orders, and what is in them: kind, state, main numbers, date, size and cost.

    Every file is compared with the digest that was written beside it; a damaged folder is listed with the reason.
    Without a terminal the columns are separated by tabs.

    Args:
        folders: Folders of results, or folders with such in them; runs and masks by default.
    """
    from doedesign.overview.listing import entries_as_json, list_results

    entries = list_results(folders)
    if json_:
        print_text(entries_as_json(entries))
        return
    if not entries:
        say("no results in runs or masks" if not folders else "no results there")
        say("next: doedesign new")
        return
    head = ("folder", "kind", "state", "main numbers", "changed", "size", "took")
    _print_table(head, [_cells(one) for one in entries])


def _cells(entry: "Entry") -> list[str]:
    from doedesign.runs.costs import elapsed_text

    name = f"{'  ' * entry.depth}{entry.path}"
    state = f"{entry.state}: {entry.about}" if entry.about else entry.state
    numbers = ", ".join(one.text() for one in entry.numbers[:3])
    took = "" if entry.cost is None else elapsed_text(entry.cost.seconds)
    return [name, entry.kind, state, numbers, entry.changed[:16].replace("T", " "), _size_text(entry.size_bytes), took]


def _size_text(size: int) -> str:
    return f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"


def _print_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table: drawn on a terminal, otherwise a line per row with tabs between its columns."""
    import sys

    rows = [[printable(cell) for cell in row] for row in rows]
    if not sys.stdout.isatty():
        print_text("\n".join("\t".join(row) for row in [head, *rows]))
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False)
    for one in head:
        table.add_column(Text(one), overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))  # as text: brackets in it are no markup
    Console().print(table)


def show(
    folder: Path,
    /,
    what: What = "picture",
    *,
    masks: Path | None = None,
    print_: Annotated[Flag, Parameter(name="--print")] = False,
    json_: AsJson = False,
) -> None:
    """Open pictures, pages or masks of a folder of results in the programs that this machine has for them.

    Masks are opened in KLayout, all else as a double click does. The paths are printed, too; where there is no display
    or no such program, they are all there is.

    Args:
        folder: Run folder, order, or folder of results inside a run.
        what: The most telling picture, all pictures, the masks, the pages for the lab, or all of these.
        masks: The run's mask order, for masks, pages or all of it; masks/NAME by default.
        print_: Print the paths and open nothing.
    """
    from doedesign.overview.kinds import record_of
    from doedesign.overview.pictures import shown_of
    from doedesign.runs.orders import is_made_from, order_of_run, own_level_map

    record = record_of(folder)
    found = shown_of(folder, record)
    if record.kind == "run" and what in ("masks", "pages", "all"):
        if masks is not None and not masks.is_dir():
            raise InputError("--masks", "must be the folder of a mask order", f"no folder: {masks}", "Check the path.")
        own = own_level_map(folder)
        order = masks or order_of_run(record.name, folder, own)
        another = masks is None and own is not None and order.is_dir() and not is_made_from(order, own)
        if order.is_dir() and not another:
            of_order = shown_of(order, record_of(order))
            found = found._replace(pages=(*found.pages, *of_order.pages), layout=of_order.layout)
        elif what == "masks":
            got = "that of another design" if another else "no folder"
            cure = f"Draw it: doedesign {shlex.join(words_to_draw(record.name, folder))}"
            raise InputError(str(order), "must be the run's mask order", got, cure)
    else:
        cure = "Leave it out, or show masks, pages or all of a run."
        refuse_options(show, {"masks": masks}, "goes with masks, pages or all of a run only", cure)
    pictures = found.pictures[:1] if what == "picture" else found.pictures
    files = [*pictures] * (what in ("picture", "pictures", "all")) + [*found.pages] * (what in ("pages", "all"))
    layout = found.layout if what in ("masks", "all") else ()
    if not files and not layout:
        raise InputError(str(folder), f"must hold what is to be shown ({what})", "none", "Ask for something else.")
    if not print_:
        _open(files, layout)
    print_paths([*files, *layout], json_)


def _open(files: Sequence[Path], layout: Sequence[Path]) -> None:
    """Open files, or say why not."""
    from doedesign.runtime.viewers import has_display, layout_viewer, open_file, open_layout, system_viewer

    if not has_display():
        say("no display: here are the paths")
        return
    viewer, drawn = system_viewer(), layout_viewer()
    if files and viewer is None:
        say("no program that opens files (xdg-open): here are the paths")
    if layout and drawn is None:
        say("KLayout is not installed (https://www.klayout.de): here are the paths")
    for file in files if viewer is not None else ():
        open_file(viewer or "", file)
    if layout and drawn is not None:
        open_layout(drawn, layout)


def compare(folders: Folders, /, *, json_: AsJson = False) -> None:
    """Put two or more results of one kind side by side: where their specs differ, main numbers, and which is better.

    A star marks the better one where it is known which side is; differences are from the first folder.

    Args:
        folders: Run folders, or other folders of results of one kind.
    """
    from doedesign.overview.comparing import compare_results

    found = compare_results(folders)
    if json_:
        print_text(json.dumps(found.record(), sort_keys=True))
        return
    _print_table(["", *map(str, found.folders)], _compared(found))


def _compared(found: "Comparison") -> Iterable[list[str]]:
    from doedesign.overview.comparing import difference_text
    from doedesign.overview.numbers import number_text

    for number in found.numbers:
        cells: list[str] = []
        for position, value in enumerate(number.values):
            text = "-" if value is None else number_text(value, number.unit)
            change = difference_text(number, position)
            star = " *" if number.best == position else ""
            cells.append(f"{text}{f' ({change})' if change else ''}{star}")
        yield [number.label, *cells]
    if any(found.costs):
        yield ["took", *("unknown" if one is None else one.text() for one in found.costs)]
    for key in found.keys:
        yield [key.key, *("-" if value is None else value for value in key.values)]
    if not found.keys:
        yield ["spec", *("the same" for _ in found.folders)]


def doctor(*, json_: AsJson = False) -> None:
    """Tell what this installation and this machine have: versions, devices, memory, extras, programs to look with."""
    from doedesign.runtime.doctor import examine

    found: Any = examine()
    if json_:
        print_text(json.dumps(found.record(), sort_keys=True))
        return
    lines = found.lines()
    wide = max(len(name) for name, _ in lines)
    print_text("\n".join(f"{name:{wide}}  {words}" for name, words in lines))
