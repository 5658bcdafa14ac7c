"""The history of a training: one line of JSON per step, appended as it goes; and the same for TensorBoard.

    {"learning_rates": {"network": 1e-4, "optics": 0.02}, "loss": 0.31, "parts": {"l1": 0.2, ...}, "seconds": 0.9,
     "step": 0}

Steps count from 0. At some of them "validation" holds scores of scenes that were not trained on, after that step. A
training that goes on from a checkpoint first drops the lines of later steps, and the half of a line that a killed one
left behind, so every step is there once.
"""

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fab.errors import InputError
from fab.files import explain_os_error, write_atomic

HISTORY_NAME = "history.jsonl"


class History:
    """The file, open for appending; made by `open_history`."""

    def __init__(self, path: Path, handle: int) -> None:
        self._path, self._handle = path, handle

    def add(self, record: Mapping[str, Any]) -> None:
        """Append one record.

        Raises:
            InputError: the disk is full, or refuses otherwise.
        """
        data = (json.dumps(record, sort_keys=True, allow_nan=False) + "\n").encode()
        try:
            while data:
                data = data[os.write(self._handle, data) :]
        except OSError as error:
            raise explain_os_error(error, self._path) from error

    def sync(self) -> None:
        """Return when all records are on the disk: a checkpoint must not know of steps that the history lacks.

        Raises:
            InputError: the disk is full, or refuses otherwise.
        """
        try:
            os.fsync(self._handle)
        except OSError as error:
            raise explain_os_error(error, self._path) from error


def read_history(path: Path, steps: int) -> list[dict[str, Any]]:
    """Records of the steps before step number `steps`; none if there is no file.

    Raises:
        InputError: a line is no record, or the system refuses the path.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise explain_os_error(error, path) from error
    whole = data[: data.rfind(b"\n") + 1]
    records = []
    for number, line in enumerate(whole.splitlines(), 1):
        try:
            record = json.loads(line)
            if record["step"] < steps:
                records.append(record)
        # What a damaged line lacks shows in different ways.
        except (ValueError, KeyError, TypeError) as error:
            cure = "Remove that line; training goes on without it."
            raise InputError(f"{path}, line {number}", "must be the record of a step", f'"{error}"', cure) from error
    return records


@contextlib.contextmanager
def open_history(path: Path, steps: int) -> Iterator[History]:
    """Open the history of a training of which a number of steps are done.

    Args:
        path: the file; made if missing.
        steps: steps that the checkpoint knows; later records are dropped.

    Raises:
        InputError: a line is no record, or the system refuses the path.
    """
    kept = read_history(path, steps)
    write_atomic(path, "".join(json.dumps(record, sort_keys=True) + "\n" for record in kept).encode())
    try:
        handle = os.open(path, os.O_WRONLY | os.O_APPEND)
    except OSError as error:
        raise explain_os_error(error, path) from error
    try:
        yield History(path, handle)
    finally:
        os.close(handle)


class Board:
    """Records for TensorBoard; made by `open_board`."""

    def __init__(self, writer: Any) -> None:
        self._writer = writer

    def add(self, record: Mapping[str, Any]) -> None:
        """Hand one record over, every number under a name of its own: "parts/l1", "validation/capture/full"."""
        for name, value in _numbers(record):
            if name != "step":
                self._writer.add_scalar(name, value, record["step"])


def require_tensorboard() -> None:
    """Refuse where the package that writes for TensorBoard is not there.

    Raises:
        InputError: it is not.
    """
    if find_spec("tensorboardX") is None:
        cure = f"Run: pip install tensorboardX. Or leave the option out; {HISTORY_NAME} holds the same numbers."
        raise InputError("tensorboard", "needs the package tensorboardX", "none", cure)


@contextlib.contextmanager
def open_board(folder: Path, steps: int) -> Iterator[Board]:
    """Open TensorBoard's folder; what it has of later steps than those done is hidden."""
    require_tensorboard()
    writer = import_module("tensorboardX").SummaryWriter(str(folder), purge_step=steps)
    try:
        yield Board(writer)
    finally:
        writer.close()


def _numbers(record: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, float]]:
    for key, value in record.items():
        name = f"{path}/{key}".removeprefix("/")
        if isinstance(value, Mapping):
            yield from _numbers(value, name)
        elif value is not None:
            yield name, float(value)
