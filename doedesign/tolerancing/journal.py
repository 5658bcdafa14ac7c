"""The finished draws of a study, in memory and, where a folder is given, on disk.

    study.json     what was studied: design, process, seed; only draws of the same study are kept together
    draws.jsonl    one line per finished draw, in the order in which they were finished

A line is on the disk before the next draw is taken, so a run that is killed at any moment loses no finished draw; the
half of a line that a killed run left behind is cut off.
"""

import contextlib
import json
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from doedesign.runs.folder import alone_in
from doedesign.tolerancing.pool import OutOfModel, Rows
from fab.errors import InputError
from fab.files import canonical_json, os_errors_explained, read_bytes, read_json, write_atomic
from sim.metrics import METRICS, without_infinities

STUDY_NAME, DRAWS_NAME = "study.json", "draws.jsonl"


class Journal:
    """Results of finished draws by key, kept in a folder or, where that is None, in memory alone.

    Only `add` changes `finished`. `study` says what was studied, as JSON.
    """

    def __init__(self, folder: Path | None, study: Mapping[str, Any]) -> None:
        self.folder, self.study = folder, study
        self.finished: dict[str, Rows | OutOfModel] = {}
        self._file: int | None = None

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        """Keep the folder for this process, and read what is in it.

        Raises:
            InputError: the folder holds another study or something else, or another process works in it.
        """
        if self.folder is None or self._file is not None:
            yield  # nothing on the disk, or open already
            return
        with alone_in(self.folder):
            self._claim(self.folder)
            path = self.folder / DRAWS_NAME
            self.finished |= _read(path)
            with os_errors_explained(path):
                self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o666)
            try:
                yield
            finally:
                os.close(self._file)
                self._file = None

    def add(self, key: str, found: Rows | OutOfModel) -> None:
        """Keep one draw; returns when it is on the disk. An infinite number is kept as None, for JSON has none.

        Raises:
            InputError: the disk is full, or refuses otherwise.
        """
        beyond = isinstance(found, OutOfModel)
        record = {"key": key, **({"beyond": found.reason} if beyond else {"rows": without_infinities(found)})}
        line = json.dumps(record, sort_keys=True, allow_nan=False) + "\n"
        if self.folder is not None and self._file is not None:
            with os_errors_explained(self.folder / DRAWS_NAME):
                data = line.encode()
                while data:
                    data = data[os.write(self._file, data) :]
                os.fsync(self._file)
        # As it would be read again.
        self.finished |= dict([_draw(json.loads(line))])

    def _claim(self, folder: Path) -> None:
        path = folder / STUDY_NAME
        # Only what compares equal after a way through the file is the same study.
        study = json.loads(canonical_json(self.study))
        if not path.exists():
            foreign = [p.name for p in sorted(folder.iterdir())]
            if foreign:
                rule, cure = "a study needs a new or empty folder, or its own", "Choose another folder."
                raise InputError(str(folder), rule, f"other content, such as {foreign[0]!r}", cure)
            write_atomic(path, canonical_json(study))
            return
        found = read_json(path)
        different = [key for key in sorted(found.keys() | study.keys()) if found.get(key) != study.get(key)]
        if different:
            rule, cure = "the folder must belong to this study", "Choose another folder, or remove that study."
            raise InputError(str(folder), rule, f"one with another {', '.join(different)}", cure)


def _read(path: Path) -> dict[str, Rows | OutOfModel]:
    """Results by key; half a line at the end is cut off the file."""
    if path.is_symlink():
        raise InputError(str(path), "must be a file of its own", "a link to elsewhere", "Put the file in its place.")
    if not path.exists():
        return {}
    with os_errors_explained(path):
        data = read_bytes(path)
        whole = data.rfind(b"\n") + 1
        if whole < len(data):
            os.truncate(path, whole)
    finished: dict[str, Rows | OutOfModel] = {}
    for number, line in enumerate(data[:whole].splitlines(), 1):
        try:
            key, found = _draw(json.loads(line))
        # What a damaged line lacks shows in different ways.
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            cure = f"Remove {path} to compute all draws again."
            raise InputError(f"{path}, line {number}", "must be one finished draw", f'"{error}"', cure) from error
        finished[key] = found
    return finished


def _draw(record: dict[str, Any]) -> tuple[str, Rows | OutOfModel]:
    """The key of a draw and its result, or a ValueError, KeyError or TypeError for something else."""
    key = record["key"]
    if "beyond" in record:
        reason = record["beyond"]
        if not (isinstance(key, str) and isinstance(reason, str)):
            raise ValueError("a key and a reason must be text")
        return key, OutOfModel(reason)
    rows = [dict(row) for row in record["rows"]]
    for row in rows:
        numbers = [row["depth_m"], *(value for name, value in row.items() if name in METRICS)]
        if not isinstance(row["colour"], str) or not all(map(_is_number, numbers)):
            raise ValueError("a row must hold a colour, a depth and numbers")
    if not isinstance(key, str) or not rows:
        raise ValueError("a draw must have a key and rows")
    return key, rows


def _is_number(value: Any) -> bool:
    """Whether a value of JSON is a finite number, or None, which stands for an infinite one."""
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value))
