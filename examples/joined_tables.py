"""Join rows of a later run of `doedesign evaluate` to a table, or draw tables anew from their CSV files.

    python examples/joined_tables.py TABLE.csv [TABLE.csv ...]
    python examples/joined_tables.py TABLE.csv --later LATER.csv --rows robust robust_fabricated

TABLE is `table.csv` of a run under the name of its folder (table2-dirt-paper.csv). With --later, the rows that --rows
names are taken from another run's `table.csv`, whatever TABLE has of these names is replaced, and column `run` counts
on for them: their differences are to the proposed row of their own run, not to that of the table. Where rows of
TABLE were compared with a proposed row of the same scores, trainings and pairs are the same, and so is `run`. Written
beside TABLE: the table itself, LaTeX and the picture, in which rows of other runs than the first have a dagger.
"""

import argparse
import csv
import io
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from doedesign.cli import exit_code
from doedesign.evaluation.published import published_scores
from doedesign.evaluation.rows import MethodRow, rows_of
from doedesign.evaluation.statistics import BootstrapInterval
from doedesign.evaluation.tables import EvaluationTable, Intervals, PairFacts, TableRow
from fab.errors import InputError
from fab.figure import save
from fab.files import read_bytes, write_atomic

PROPOSED = "proposed"
COLUMNS = (
    *("row", "region", "score", "mean", "low", "high", "pairs", "pictures", "seeds", "gain", "gain_low", "gain_high"),
    *("parameters", "original_parameters", "why_not"),
)
DIGITS = 2e-4  # six digits of each of three numbers are kept
Lines = list[dict[str, str]]


def read_table(path: str | Path) -> EvaluationTable:
    """Read a table from its CSV file, whose name says of what it is; it knows the number of its pairs, and no pair.

    Args:
        path: file.

    Raises:
        InputError: a file of another kind, or a row that no such table has.
    """
    kind, _, rest = Path(path).stem.partition("-")
    obstruction, _, occlusion = rest.rpartition("-")
    if kind not in ("table1", "table2") or not obstruction:
        rule, cure = "must be named like table2-dirt-paper.csv", "Rename it after the folder that it came from."
        raise InputError(str(path), rule, Path(path).name, cure)
    number = int(kind[-1])
    found: dict[str, Lines] = {}
    lines = csv.DictReader(io.StringIO(read_bytes(path).decode()))
    if lacking := [name for name in COLUMNS if name not in (lines.fieldnames or ())]:
        cure = "Give table.csv of an evaluation."
        raise InputError(str(path), f"must have the columns {', '.join(COLUMNS)}", f"no {lacking[0]}", cure)
    for line in lines:
        found.setdefault(line["row"], []).append(line)
    known = rows_of(number, obstruction, robust=True)
    if unknown := [name for name in found if name not in {row.name for row in known}]:
        raise InputError(str(path), "must have rows of the paper's tables alone", unknown[0], "Leave it out.")
    rows = tuple(_row(row, found[row.name], number, obstruction) for row in known if row.name in found)
    count = max((int(line["pairs"] or 0) for lines in found.values() for line in lines), default=0)
    pairs = (PairFacts(0, "", 0.0, 0.0, 0.0),) * count
    return EvaluationTable(number, obstruction, rows, pairs, {"occlusion": occlusion})


def joined(table: EvaluationTable, later: EvaluationTable, names: Sequence[str]) -> EvaluationTable:
    """Join rows of a later run to a table, in the place of its own of the same names.

    Args:
        table: the table.
        later: of the later run.
        names: of the rows.

    Raises:
        InputError: a later run of another table, or a name that it has no scores of.
    """
    if table.title != later.title:
        cure = "Give another run; its file is named after its table."
        raise InputError("later", f"must be a run of {table.title}", later.title, cure)
    scored = {one.row.name: one for one in later.rows if one.scores}
    for name in names:
        if name not in scored:
            raise InputError("rows", f"must be among {', '.join(scored)}", name, "Choose among these.")
    own = {one.row.name: one for one in table.rows}
    kept = [one for one in table.rows if one.row.name not in names]
    same = [one.run for one in kept if PROPOSED in scored and _as_proposed(one, scored[PROPOSED])]
    run = same[0] if same else 1 + max((one.run for one in kept), default=0)
    own |= {name: replace(scored[name], run=run) for name in names}
    order = [row.name for row in rows_of(table.number, table.obstruction, robust=True)]
    return replace(table, rows=tuple(own[name] for name in order if name in own))


def _as_proposed(row: TableRow, proposed: TableRow) -> bool:
    """Whether a row was compared with this proposed row, of the same trainings and pairs, or is that row."""
    if not row.gain and row.row.name != PROPOSED:
        return False

    def mean(intervals: Intervals, region: str, score: str) -> float:
        found = intervals.get(region, {}).get(score)
        return found.mean if found else 0.0

    places = [(region, score) for region, of in row.scores.items() for score in of]
    means = [(mean(proposed.scores, *at), mean(row.scores, *at) - mean(row.gain, *at)) for at in places]
    return bool(means) and all(abs(one - other) < DIGITS for one, other in means)


def _row(row: MethodRow, lines: Lines, number: int, obstruction: str) -> TableRow:
    first, scores, gain = lines[0], {}, {}
    for line in lines:
        if not line["region"]:
            continue
        scores.setdefault(line["region"], {})[line["score"]] = _interval(line, "mean", "low", "high")
        if line["gain"]:
            found = _interval(line, "gain", "gain_low", "gain_high")
            gain.setdefault(line["region"], {})[line["score"]] = found
    published = published_scores(number, obstruction)
    return TableRow(
        row,
        scores,
        gain,
        published.get(row.paper) if row.paper else None,
        first["why_not"],
        int(first["parameters"] or 0),
        int(first["original_parameters"]) if first["original_parameters"] else None,
        int(first.get("run") or 1),
    )


def _interval(line: Mapping[str, str], mean: str, low: str, high: str) -> BootstrapInterval:
    pairs, pictures, seeds = (int(line[name]) for name in ("pairs", "pictures", "seeds"))
    first, last = (float(line[name]) if line[name] else None for name in (low, high))
    return BootstrapInterval(float(line[mean]), first, last, pairs, pictures, seeds)


def main(arguments: Sequence[str]) -> int:
    """Join or draw anew."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tables", type=Path, nargs="+")
    parser.add_argument("--later", type=Path)
    parser.add_argument("--rows", nargs="+", default=[])
    asked = parser.parse_args(arguments)
    if asked.later and (len(asked.tables) > 1 or not asked.rows):
        parser.error("--later takes one table, and --rows with the names of the rows")

    def work() -> None:
        for path in asked.tables:
            table = read_table(path)
            if asked.later:
                table = joined(table, read_table(asked.later), asked.rows)
            write_atomic(path, table.csv().encode())
            write_atomic(path.with_suffix(".tex"), table.latex().encode())
            save(table.plot(), path.with_suffix(".png"))

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
