"""Folders of results below others: kind, state, main numbers, date, size and cost of each."""

import json
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from doedesign.overview.kinds import TABLE_NAME, Record, has_record, record_of
from doedesign.overview.numbers import MainNumber, main_numbers
from doedesign.runs.aside import waits
from doedesign.runs.costs import Cost, costs_of, together
from doedesign.runs.folder import CHECKPOINT
from doedesign.runs.journal import STUDY_NAME
from doedesign.spec import load_spec
from fab.archive import read_archive
from fab.errors import InputError
from fab.files import MANIFEST_NAME, explain_os_error, os_errors_explained, read_json, sha256_file

ROOTS = (Path("runs"), Path("masks"))
_STEPPED = ("training", "fine-tuning", "training of a rival")
_CURE = "Remove it, or make it again."
_DEEPEST = 3  # folders within folders: a run, its evaluation, a table of it


class Entry(NamedTuple):
    """One folder of results.

    Attributes:
        path: the folder.
        kind: what it holds.
        name: name of its design.
        state: "done", "stopped", "damaged", or "not ours" where nothing says what it is.
        about: of a state other than "done", how far it went or what is wrong.
        numbers: its main numbers.
        changed: time of its record, UTC, ISO 8601.
        size_bytes: size of its files, those of other results in it left out.
        cost: of a run, cost of everything done with it, as far as it is known.
        depth: 0, or 1 and more for a folder of results inside another.
    """

    path: Path
    kind: str
    name: str
    state: str
    about: str
    numbers: tuple[MainNumber, ...]
    changed: str
    size_bytes: int
    cost: Cost | None = None
    depth: int = 0

    def record(self) -> dict[str, Any]:
        """Plain values for JSON."""
        numbers = {one.key: {"value": one.value, "unit": one.unit, "label": one.label} for one in self.numbers}
        found = self._asdict() | {"path": str(self.path), "numbers": numbers}
        return found | {"cost": None if self.cost is None else self.cost._asdict()}


def list_results(folders: Sequence[Path] = ()) -> tuple[Entry, ...]:
    """Entries of folders of results and of what is inside them; a damaged folder becomes an entry that says so.

    Args:
        folders: folders of results, or folders with such in them; `ROOTS`, as far as they are there, by default.

    Raises:
        InputError: a folder that was given is not there.
    """
    for folder in folders:
        if not folder.is_dir():
            got = "a file" if folder.exists() else "nothing"
            raise InputError(str(folder), "must be a folder", got, "Check the path.")
    found: list[Entry] = []
    for folder in folders or [root for root in ROOTS if root.is_dir()]:
        if has_record(folder):
            found += _entries(folder, 0)
            continue
        for path in _folders_in(folder):
            found += _entries(path, 0) if has_record(path) else _without_record(path)
    return tuple(found)


def _folders_in(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    except OSError:
        return []


def _without_record(folder: Path) -> Iterator[Entry]:
    """Results in a folder that is none itself; an entry of the folder where there are none."""
    if waits(folder):
        about = "waits to be replaced; the next optimize with its spec brings it back"
        yield Entry(folder, "run", folder.name, "stopped", about, (), _changed(folder), _size(folder))
        return
    inside = [path for path in _folders_in(folder) if has_record(path) or waits(path)]
    for path in inside:
        yield from _entries(path, 0) if has_record(path) else _without_record(path)
    try:
        state, about = "not ours" if any(folder.iterdir()) else "", f"no {MANIFEST_NAME}"
    except OSError as error:
        state, about = "damaged", _relative(str(explain_os_error(error, folder)), folder)
    if state and not inside:
        yield Entry(folder, "", folder.name, state, about, (), _changed(folder), _size(folder))


def _entries(folder: Path, depth: int) -> Iterator[Entry]:
    """A folder of results, and those inside it."""
    yield entry_of(folder, depth)
    if depth >= _DEEPEST:
        return
    for path in _folders_in(folder):
        if has_record(path):
            # The items of a simulation are its results.
            if _kind_of(path) != _kind_of(folder):
                yield from _entries(path, depth + 1)
        elif depth == 0 and path.name == "evaluation":
            for inner in _folders_in(path):
                if has_record(inner):
                    yield from _entries(inner, depth + 1)


def _kind_of(folder: Path) -> str:
    try:
        return record_of(folder).kind
    except InputError:
        return ""


def entry_of(folder: Path, depth: int = 0) -> Entry:
    """Entry of one folder of results.

    Args:
        folder: the folder.
        depth: of how many other folders of results it is inside.
    """
    try:
        record = record_of(folder)
    except InputError as error:
        about = _relative(str(error), folder)
        return Entry(folder, "", folder.name, "damaged", about, (), _changed(folder), _size(folder), depth=depth)
    state, about = _state(folder, record)
    numbers = main_numbers(folder, record) if state == "done" else ()
    cost = together(costs_of(folder))
    return Entry(folder, record.kind, record.name, state, about, numbers, _changed(folder), _size(folder), cost, depth)


def _state(folder: Path, record: Record) -> tuple[str, str]:
    try:
        if not record.finished:
            return _unfinished(folder, record)
        require_whole(folder, record)
    except InputError as error:
        return "damaged", _relative(str(error), folder)
    return "done", ""


def _relative(text: str, folder: Path) -> str:
    """A message without the path that stands beside it anyway."""
    return text.replace(f"{folder}/", "").replace(str(folder), folder.name)


def require_whole(folder: Path, record: Record) -> None:
    """Refuse results of which a file is missing or was changed since it was written.

    Args:
        folder: the folder.
        record: its record.

    Raises:
        InputError: there is such a file.
    """
    key = "results_sha256" if "results_sha256" in record.found else "files"
    listed = record.found.get(key, {})
    if record.kind == "order" and isinstance(listed, list):
        files = [(one.get("file"), one["sha256"]) for one in listed if isinstance(one, dict) and "sha256" in one]
    elif isinstance(listed, dict):
        files = [*listed.items()]
    else:
        rule = "must list files with their digests"
        raise InputError(f"{folder / MANIFEST_NAME}: {key}", rule, type(listed).__name__, _CURE)
    for name, digest in files:
        path = folder / str(name)
        with os_errors_explained(path):
            there = path.is_file()
        if not there:
            raise InputError(str(path), "must be there", "no such file", _CURE)
        if sha256_file(path) != digest:
            raise InputError(str(path), "must be the file that was written", "a changed file", _CURE)
    if record.kind == "evaluation":  # of which nothing lists the digests
        read_json(folder / TABLE_NAME)


def _unfinished(folder: Path, record: Record) -> tuple[str, str]:
    """How far an unfinished piece of work went."""
    if record.kind == "run":
        steps = load_spec(folder / "spec.toml").all_steps if (folder / "spec.toml").is_file() else None
        step = 0
        if (folder / CHECKPOINT).is_file():
            header, _ = read_archive(folder / CHECKPOINT, "checkpoint", _CURE)
            step = header.get("step", 0)
        return "stopped", f"at step {step}" + (f" of {steps}" if steps is not None else "")
    if record.kind in _STEPPED:
        done = _lines(folder / "history.jsonl")
        options = record.found.get("options")
        asked = options.get("steps") if isinstance(options, dict) else None
        if asked is None and (folder / "spec.toml").is_file():
            asked = load_spec(folder / "spec.toml").train.steps
        return "stopped", f"at step {done}" + (f" of {asked}" if asked is not None else "")
    if (folder / STUDY_NAME).is_file():
        lines = sum(_lines(path) for path in folder.glob("*.jsonl"))
        return "stopped", f"after {lines} finished parts"
    return "stopped", "before its end"


def _lines(path: Path) -> int:
    """Number of whole lines of a file; 0 without one."""
    try:
        return path.read_bytes().count(b"\n")
    except OSError:
        return 0


def _changed(folder: Path) -> str:
    """Time of the record of a folder, or of the folder where it has none."""
    for path in (folder / MANIFEST_NAME, folder / STUDY_NAME, folder):
        try:
            return datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat(timespec="seconds")
        except OSError:
            continue
    return ""


def _size(folder: Path) -> int:
    """Size of the files of a folder, those of other results in it left out."""
    total = 0
    try:
        for path in folder.iterdir():
            if path.is_symlink():
                continue
            if path.is_file():
                total += path.stat().st_size
            elif path.is_dir() and (not has_record(path) or _kind_of(path) == _kind_of(folder)):
                total += _size(path)
    except OSError:
        return total
    return total


def entries_as_json(entries: Sequence[Entry]) -> str:
    """All entries as one line of JSON.

    Args:
        entries: the entries.
    """
    return json.dumps({"results": [one.record() for one in entries]}, sort_keys=True)
