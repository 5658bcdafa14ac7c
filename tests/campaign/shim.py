"""Calls that change the disk, counted, and one thing that happens at a chosen one of them.

Python's own calls below one folder are counted: opening a file to write, every write, fsync, rename, making folders and
links, truncating and removing. What a C library writes by itself is out of reach here; a limit of the size of files
(`Fault.file_bytes`) fails those writes, too.
"""

import builtins
import contextlib
import errno
import io
import os
import resource
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

WRITES = ("fsync", "mkdir", "rename", "replace", "link", "symlink", "truncate", "ftruncate", "write")
REMOVALS = ("unlink", "remove", "rmdir")


class Fault(NamedTuple):
    """What happens to a command, at the call number `call` (from 1) or `after_s` seconds from its start.

    Attributes:
        call: the call at which it happens.
        after_s: the moment at which it happens.
        error: number of the error that the call meets, such as ENOSPC.
        stays: whether all later calls that write meet it, too.
        number: signal that the process gets.
        file_bytes: the largest file that can be written.
    """

    call: int | None = None
    after_s: float | None = None
    error: int | None = None
    stays: bool = False
    number: int | None = None
    file_bytes: int | None = None


class _Counted(io.FileIO):
    """A file whose writes are counted."""

    shim: "Shim"

    def write(self, data: Any) -> int:
        self.shim.met("write", self.fileno())
        return super().write(data)


def _name_of(handle: int) -> str:
    return os.readlink(f"/proc/self/fd/{handle}")


class Shim:
    """Counter of the calls below a folder.

    Attributes:
        calls: calls so far, their names.
    """

    def __init__(self, folder: Path, fault: Fault) -> None:
        self._folder, self._fault = os.path.realpath(folder), fault
        self.calls: list[str] = []
        self._lock = threading.Lock()

    def met(self, name: str, path: Any) -> None:
        """Count a call, and let happen what is due."""
        fault = self._fault
        if isinstance(path, int):
            path = _name_of(path)
            if not path.startswith("/"):  # a pipe, which no disk holds
                return
        where = os.path.realpath(os.fsdecode(path))
        if not where.startswith(self._folder):
            return
        removal = name in REMOVALS
        with self._lock:
            if fault.error is None or not removal:  # a full disk can still be cleared
                self.calls.append(name)
            count = len(self.calls)
        due = fault.call is not None and (count == fault.call or (fault.stays and count > fault.call))
        if due and fault.number is not None:
            os.kill(os.getpid(), fault.number)
        if due and fault.error is not None and not removal:
            raise OSError(fault.error, os.strerror(fault.error), str(path))

    def open(self, file: Any, mode: str = "r", buffering: int = -1, *rest: Any, **more: Any) -> Any:
        """`io.open` with counted writes."""
        if not set(mode) & set("wax+"):
            return _OPEN(file, mode, buffering, *rest, **more)
        names = ("encoding", "errors", "newline", "closefd", "opener")
        given = dict(zip(names, rest, strict=False)) | more
        if not isinstance(file, int):
            self.met("open", file)
        kind = mode.replace("b", "").replace("t", "")
        raw = _Counted(file, kind, given.pop("closefd", True), given.pop("opener", None))
        raw.shim = self
        if buffering == 0:
            return raw
        whole = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        if "b" in mode:
            return whole
        return io.TextIOWrapper(whole, **given, line_buffering=buffering == 1)


_OPEN = io.open


@contextlib.contextmanager
def shimmed(folder: Path, fault: Fault) -> Iterator[Shim]:
    """Count the calls of this process below a folder meanwhile, and let a fault happen."""
    shim, kept = Shim(folder, fault), {}

    def counted(name: str) -> Any:
        real = kept[name]

        def call(first: Any, *rest: Any, **more: Any) -> Any:
            # Of two paths the second is written.
            shim.met(name, rest[0] if name in ("rename", "replace", "link", "symlink") else first)
            return real(first, *rest, **more)

        return call

    def opens(path: Any, flags: int, *rest: Any, **more: Any) -> int:
        if flags & (os.O_CREAT | os.O_TRUNC):
            shim.met("open", path)
        return kept["open"](path, flags, *rest, **more)

    kept = {name: getattr(os, name) for name in (*WRITES, *REMOVALS, "open")}
    import _io

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    timer = None
    if fault.after_s is not None and fault.number is not None:
        timer = threading.Timer(fault.after_s, os.kill, (os.getpid(), fault.number))
        timer.daemon = True
    before = signal.getsignal(signal.SIGXFSZ)
    try:
        for name in (*WRITES, *REMOVALS):
            setattr(os, name, counted(name))
        os.open = opens
        builtins.open = io.open = _io.open = shim.open  # type: ignore[assignment]
        if fault.file_bytes is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (fault.file_bytes, limits[1]))
        if timer is not None:
            timer.start()
        yield shim
    finally:
        if timer is not None:
            timer.cancel()
            timer.join()
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
        for name, real in kept.items():
            setattr(os, name, real)
        builtins.open = io.open = _io.open = _OPEN


FULL = (errno.ENOSPC, errno.EDQUOT)
