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
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fab.errors import InputError
from fab.files import os_errors_explained, write_atomic

HISTORY_NAME = "history.jsonl"


class History:
    """The file, open for appending; made by `open_history`."""

    def __init__(self, path: Path, handle: int) -> None:
        self._path, self._handle = path, handle

    def add(self, record: Mapping[str, Any]) -> None:
        """Append one record."""
        data = (json.dumps(record, sort_keys=True, allow_nan=False) + "\n").encode()
        with os_errors_explained(self._path):
            while data:
                data = data[os.write(self._handle, data) :]

    def sync(self) -> None:
        """Return when all records are on the disk: a checkpoint must not know of steps that the history lacks."""
        with os_errors_explained(self._path):
            os.fsync(self._handle)


def read_history(path: Path, steps: int) -> list[dict[str, Any]]:
    """Records of the steps before step number `steps`; none if there is no file.

    Raises:
        InputError: a line is no record, or the system refuses the path.
    """
    with os_errors_explained(path):
        data = path.read_bytes() if path.exists() else b""
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
    """Open the history, made if missing, of a training with a checkpoint of so many steps; drop later records.

    Raises:
        InputError: a line is no record, or the system refuses the path, then or later.
    """
    kept = read_history(path, steps)
    write_atomic(path, "".join(json.dumps(record, sort_keys=True) + "\n" for record in kept).encode())
    with os_errors_explained(path):
        handle = os.open(path, os.O_WRONLY | os.O_APPEND)
    try:
        yield History(path, handle)
    finally:
        os.close(handle)


def require_tensorboard() -> None:
    """Raise InputError where the package that writes for TensorBoard is not there."""
    if find_spec("tensorboardX") is None:
        cure = f"Run: pip install tensorboardX. Or leave the option out; {HISTORY_NAME} holds the same numbers."
        raise InputError("tensorboard", "needs the package tensorboardX", "none", cure)


@contextlib.contextmanager
def open_board(folder: Path, steps: int) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """Open TensorBoard's folder, and hide its later steps than those done; yield a call that adds a record.

    Every number has a name of its own: "parts/l1", "validation/capture/full".
    """
    require_tensorboard()
    writer = import_module("tensorboardX").SummaryWriter(str(folder), purge_step=steps)

    def add(record: Mapping[str, Any]) -> None:
        for name, value in _numbers(record):
            if name != "step":
                writer.add_scalar(name, value, record["step"])

    try:
        yield add
    finally:
        writer.close()


def _numbers(record: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, float]]:
    for key, value in record.items():
        name = f"{path}/{key}".removeprefix("/")
        if isinstance(value, Mapping):
            yield from _numbers(value, name)
        elif value is not None:
            yield name, float(value)
