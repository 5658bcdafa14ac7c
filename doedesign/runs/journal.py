"""Finished items of a long piece of work, in memory and, where a folder is given, on disk.

    study.json     what is asked; only results of the same study are kept together
    FILE           one line of JSON per finished item, in the order in which they were finished, with its digest

A line is on the disk before the next item is taken, so work that is killed at any moment loses nothing that was
finished; the half of a line that a killed process left behind is cut off.
"""

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

from doedesign.runs.folder import alone_in
from fab.errors import InputError
from fab.files import canonical_json, os_errors_explained, read_bytes, read_json, sha256_bytes, write_atomic

STUDY_NAME = "study.json"
_DIGEST = "sha256"


@contextlib.contextmanager
def study_folder(folder: Path, study: Mapping[str, Any]) -> Iterator[None]:
    """Keep a folder for this process, and for the results of one study.

    Args:
        folder: the folder, made where there is none.
        study: all that the results depend on, for JSON; kept in the folder.

    Raises:
        InputError: the folder holds results of another study or something else, or another process works in it.
    """
    with alone_in(folder):
        _claim(folder, study)
        yield


def _claim(folder: Path, asked: Mapping[str, Any]) -> None:
    path = folder / STUDY_NAME
    # Only what compares equal after a way through the file is the same study.
    study = json.loads(canonical_json(asked))
    if not path.exists():
        foreign = [p.name for p in sorted(folder.iterdir())]
        if foreign:
            rule, cure = "a study needs a new or empty folder, or its own", "Choose another folder."
            raise InputError(str(folder), rule, f"other content, such as {foreign[0]!r}", cure)
        write_atomic(path, canonical_json(study))
        return
    found = read_json(path)
    different = [key for key in sorted(found.keys() | study.keys()) if found.get(key) != study.get(key)]
    held = [p for p in folder.iterdir() if p.name != STUDY_NAME and not (p.is_file() and p.stat().st_size == 0)]
    if different and not held:
        # It was refused before its first result: there is nothing to lose, whatever it was.
        write_atomic(path, canonical_json(study))
    elif different:
        rule, cure = "the folder must belong to this study", "Choose another folder, or remove that study."
        raise InputError(str(folder), rule, f"one with another {', '.join(different)}", cure)


class Lines(Protocol):
    """How results become lines, and what they are called."""

    @property
    def file(self) -> str:
        """Name of the file."""
        ...

    @property
    def noun(self) -> str:
        """Name of an item in messages, such as "draw"."""
        ...

    def encode(self, key: str, found: Any) -> Mapping[str, Any]:
        """A line for JSON, without infinite numbers."""
        ...

    def decode(self, line: Mapping[str, Any]) -> tuple[str, Any]:
        """The key and the result of a line; a ValueError, KeyError or TypeError for something else."""
        ...


class Journal:
    """Results of finished items by key, kept in a folder or, where that is None, in memory alone.

    Only `add` changes `finished`. `study` says what is asked, as JSON.
    """

    def __init__(self, folder: Path | None, study: Mapping[str, Any], lines: Lines) -> None:
        self.folder, self.study, self.lines = folder, study, lines
        self.finished: dict[str, Any] = {}
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
        with study_folder(self.folder, self.study):
            path = self.folder / self.lines.file
            self.finished |= _read(path, self.lines)
            with os_errors_explained(path):
                self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o666)
            try:
                yield
            finally:
                os.close(self._file)
                self._file = None

    def add(self, key: str, found: Any) -> None:
        """Keep one result; returns when it is on the disk.

        Raises:
            InputError: the disk is full, or refuses otherwise.
        """
        own = self.lines.encode(key, found)
        line = json.dumps({**own, _DIGEST: _digest(own)}, sort_keys=True, allow_nan=False) + "\n"
        if self.folder is not None and self._file is not None:
            with os_errors_explained(self.folder / self.lines.file):
                data = line.encode()
                while data:
                    data = data[os.write(self._file, data) :]
                os.fsync(self._file)
        # As it would be read again.
        self.finished |= dict([self.lines.decode(_whole(line))])


def _digest(line: Mapping[str, Any]) -> str:
    return sha256_bytes(json.dumps(line, sort_keys=True, allow_nan=False).encode())[:16]


def _whole(text: str | bytes) -> dict[str, Any]:
    """A line as it was written; a ValueError, KeyError or TypeError for one that was changed since."""
    line = json.loads(text)
    if not isinstance(line, dict):
        raise TypeError("no table")
    told = line.pop(_DIGEST, None)  # earlier versions wrote none
    if told is not None and told != _digest(line):
        raise ValueError("a line that was changed since it was written")
    return line


def _read(path: Path, lines: Lines) -> dict[str, Any]:
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
    finished: dict[str, Any] = {}
    for number, line in enumerate(data[:whole].splitlines(), 1):
        try:
            key, found = lines.decode(_whole(line))
        # What a damaged line lacks shows in different ways.
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            cure = f"Remove {path} to compute all {lines.noun}s again."
            raise InputError(
                f"{path}, line {number}", f"must be one finished {lines.noun}", f'"{error}"', cure
            ) from error
        finished[key] = found
    return finished
