"""Specs and main numbers of several folders of results side by side."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from doedesign.overview.kinds import record_of
from doedesign.overview.listing import require_whole
from doedesign.overview.numbers import LEAST_PERCENT, MainNumber, main_numbers, number_text
from doedesign.runs.costs import Cost, costs_of, together
from doedesign.spec import load_spec, spec_to_toml
from fab.errors import InputError

_SAME = 1e-9  # relative; numbers that differ by less are the same


class ComparedNumber(NamedTuple):
    """A main number of several results.

    Attributes:
        key: its name for programs.
        label: its name for people, with what to know of it where that is the same of all.
        unit: of the values.
        values: one per folder; None where it has none.
        differences: from that of the first folder; None where one of both is missing.
        best: position of the best; None where that is not known, or two are equally good.
    """

    key: str
    label: str
    unit: str
    values: tuple[float | None, ...]
    differences: tuple[float | None, ...]
    best: int | None


class ComparedKey(NamedTuple):
    """A key of a spec in which folders differ.

    Attributes:
        key: "table.key".
        values: one per folder, in the spec's own text; None where it has none.
    """

    key: str
    values: tuple[str | None, ...]


class Comparison(NamedTuple):
    """Several results side by side.

    Attributes:
        folders: the folders.
        kinds: what each holds.
        numbers: their main numbers.
        keys: keys of their specs that differ.
        costs: what each cost, as far as it is known.
    """

    folders: tuple[Path, ...]
    kinds: tuple[str, ...]
    numbers: tuple[ComparedNumber, ...]
    keys: tuple[ComparedKey, ...]
    costs: tuple[Cost | None, ...]

    def record(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "folders": [str(path) for path in self.folders],
            "kinds": list(self.kinds),
            "numbers": [one._asdict() for one in self.numbers],
            "spec": [one._asdict() for one in self.keys],
            "costs": [None if one is None else one._asdict() for one in self.costs],
        }


def compare_results(folders: Sequence[Path]) -> Comparison:
    """Put results side by side: main numbers with differences, keys of specs that differ, costs.

    Args:
        folders: two folders or more, of one kind.

    Raises:
        InputError: fewer than two; one that holds no results, unfinished or damaged ones, or results of another kind.
    """
    if len(folders) < 2:
        raise InputError("folders", "must be two or more", len(folders), "Give a second folder.")
    records = [record_of(folder) for folder in folders]
    for folder, record in zip(folders, records, strict=True):
        if record.kind != records[0].kind:
            rule = f"must hold the same as {folders[0]}, which is: {records[0].kind}"
            raise InputError(str(folder), rule, record.kind, "Compare results of one kind.")
        if not record.finished:
            raise InputError(str(folder), "must be finished", "unfinished results", "Resume it by the same command.")
        require_whole(folder, record)
    found = [main_numbers(folder, record) for folder, record in zip(folders, records, strict=True)]
    return Comparison(
        tuple(folders),
        tuple(record.kind for record in records),
        tuple(_side_by_side(found)),
        tuple(_differing(folders)),
        tuple(together(costs_of(folder)) for folder in folders),
    )


def _side_by_side(found: Sequence[Sequence[MainNumber]]) -> Iterator[ComparedNumber]:
    named = [{one.key: one for one in numbers} for numbers in found]
    for key, first in {key: one for numbers in named[::-1] for key, one in numbers.items()}.items():
        values = tuple(numbers[key].value if key in numbers else None for numbers in named)
        base = values[0]
        differences = tuple(None if base is None or value is None else value - base for value in values)
        ones = [numbers[key] for numbers in named if key in numbers]
        notes = {one.note for one in ones}
        label = f"{first.label} ({first.note})" if first.note and len(notes) == 1 else first.label
        yield ComparedNumber(key, label, first.unit, values, differences, _best(values, first.better))


def _best(values: Sequence[float | None], better: str | None) -> int | None:
    """Position of the best of all values; None where one is missing, or the two best are the same."""
    if better is None or any(value is None for value in values):
        return None
    numbers = [value for value in values if value is not None]
    order = sorted(range(len(numbers)), key=lambda k: numbers[k], reverse=better == "high")
    first, second = numbers[order[0]], numbers[order[1]]
    return None if abs(first - second) <= _SAME * max(abs(first), abs(second)) else order[0]


def _differing(folders: Sequence[Path]) -> Iterator[ComparedKey]:
    """Keys in which the specs of folders differ; none where a folder has no spec.

    A table that only some of them have is one difference.
    """
    if not all((folder / "spec.toml").is_file() for folder in folders):
        return
    texts = [_keys_of(spec_to_toml(load_spec(folder / "spec.toml"))) for folder in folders]
    tables = [{key.rpartition(".")[0] for key in each} for each in texts]
    partial = {table for each in tables for table in each if not all(table in other for other in tables)}
    for table in sorted(partial):
        shown = table if table.endswith("]") else f"[{table}]"
        yield ComparedKey(shown, tuple("there" if table in each else None for each in tables))
    for key in dict.fromkeys(key for each in texts for key in each):
        values = tuple(each.get(key) for each in texts)
        if key.rpartition(".")[0] not in partial and any(value != values[0] for value in values):
            yield ComparedKey(key, values)


def _keys_of(text: str) -> dict[str, str]:
    """Keys of a spec that this program wrote, "table.key", and their values as they stand there."""
    table, found, counts = "", {}, Counter[str]()
    for line in text.splitlines():
        if line.startswith("["):
            table = line.strip("[]")
            if line.startswith("[["):
                counts[table] += 1
                table = f"{table}[{counts[table] - 1}]"  # as `--set` and messages count
        elif " = " in line and not line.startswith("#"):
            key, _, value = line.partition(" = ")
            found[f"{table}.{key}".removeprefix(".")] = value
    return found


def difference_text(number: ComparedNumber, position: int) -> str:
    """The difference of one folder from the first in words, with its sign; nothing where it is not known, or too small.

    That of percentages is in points.

    Args:
        number: the compared number.
        position: of the folder.
    """
    difference = number.differences[position]
    if position == 0 or difference is None or (number.unit == "%" and 0 < abs(difference) < LEAST_PERCENT):
        return ""
    sign, text = "+" if difference >= 0 else "-", number_text(abs(difference), number.unit)
    # Of shares, "+5 %" could be one of 25 to 30 % or of 25 to 26.25 %.
    return f"{sign}{text.replace(' %', ' points')}"
