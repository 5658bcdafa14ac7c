"""Commands in warm processes: everything is imported, so a case costs the command's own time.

A process is forked from a server that has imported all packages and run nothing. It runs one command after another,
with its own clock, memory and temporary folder for each, until one kills it.
"""

import contextlib
import io
import json
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NamedTuple

from doedesign.runs.folder import COST_NAME
from tests.campaign.shim import Fault, shimmed

ROOT = Path(__file__).parents[2]
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_STREAMS = ("out", "err")
# A process that has grown beyond the first gives way to a new one; the second saves the machine.
_GROWN_BYTES, _DATA_BYTES = 2 << 30, 6 << 30


class End(NamedTuple):
    """How a command ended.

    Attributes:
        code: exit code; minus the signal that ended the process; None if it took too long and was killed.
        out: what it printed.
        err: what it said.
        cpu_s: processor time of this process and of the children that it waited for.
        wall_s: time from start to end.
        peak_bytes: by how much the memory of the process grew at most.
        calls: calls that changed the disk, by name.
        read: files below its folder that it opened.
    """

    code: int | None
    out: str = ""
    err: str = ""
    cpu_s: float = 0.0
    wall_s: float = 0.0
    peak_bytes: int = 0
    calls: tuple[str, ...] = ()
    read: tuple[str, ...] = ()

    def __str__(self) -> str:
        last = self.err.strip().splitlines()[-3:]
        return f"exit {self.code} after {self.wall_s:.1f} s: {' / '.join(last)}"


class _Job(NamedTuple):
    arguments: tuple[str, ...]
    place: Path
    fault: Fault


class Worker:
    """A warm process; what a command says is in files in `said`, even if the process dies."""

    def __init__(self, said: Path) -> None:
        self._said, self._process, self._pipe, self._fault = said, None, None, Fault()
        said.mkdir(parents=True, exist_ok=True)

    def _start(self) -> Connection:
        if self._process is None or not self._process.is_alive():
            self.stop()
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload([f"{__package__}.imports"])
            self._pipe, theirs = context.Pipe()
            self._process = context.Process(target=_serve, args=(theirs, self._said), daemon=False)
            self._process.start()
            theirs.close()
        assert self._pipe is not None
        return self._pipe

    def begin(self, arguments: Sequence[object], place: Path, fault: Fault = Fault()) -> None:  # noqa: B008
        """Begin a command in the folder `place`/work, with `place`/tmp for temporary files."""
        (place / "tmp").mkdir(exist_ok=True)
        for name in _STREAMS:  # a process may be killed before it opens them
            (self._said / name).write_bytes(b"")
        self._start().send(_Job(tuple(map(str, arguments)), place, fault))
        self._fault, self._begun = fault, time.monotonic()

    def end(self, limit_s: float = 120.0, kill_after_s: float | None = None) -> End:
        """Wait for the command; kill it after a limit, or when it is meant to be killed."""
        process, pipe = self._process, self._pipe
        assert process is not None
        assert pipe is not None
        patience = limit_s if kill_after_s is None else kill_after_s
        ready = wait([pipe, process.sentinel], max(0.0, self._begun + patience - time.monotonic()))
        found = None
        if pipe in ready:
            with contextlib.suppress(EOFError, ConnectionResetError):
                found = pipe.recv()
        if found is not None:
            # A signal may have left modules imported by half, which a command in a process of its own never meets.
            if self._fault.number or found.peak_bytes > _GROWN_BYTES or _resident() > _GROWN_BYTES:
                self.stop()
            return found
        late = not ready and kill_after_s is None
        if not ready:
            process.kill()
        process.join(10)
        code, wall = process.exitcode, time.monotonic() - self._begun
        self.stop()
        out, err = ((self._said / name).read_text("utf-8", "replace") for name in _STREAMS)
        return End(None if late else code, out, err, wall_s=wall)

    def run(self, arguments: Sequence[object], place: Path, fault: Fault = Fault(), **limits: Any) -> End:  # noqa: B008
        """Run a command and wait for it."""
        self.begin(arguments, place, fault)
        return self.end(**limits)

    def stop(self) -> None:
        """End the process, whatever it does, and what it started."""
        if self._process is not None and self._process.pid is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.kill()
            self._process.join(10)
            self._process.close()
        if self._pipe is not None:
            self._pipe.close()
        self._process = self._pipe = None


@contextlib.contextmanager
def worker(said: Path) -> Iterator[Worker]:
    """A process for a while."""
    one = Worker(said)
    try:
        yield one
    finally:
        one.stop()


# What follows runs in the process.

_OPENED: set[str] = set()
_WATCHED = [""]


def _serve(pipe: Connection, said: Path) -> None:
    os.setpgid(0, 0)  # so that it is ended with all that it started
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_DATA, (_DATA_BYTES, resource.RLIM_INFINITY))
    sys.addaudithook(_watch)
    parent = multiprocessing.parent_process()
    while True:
        while not pipe.poll(2.0):
            if parent is None or not parent.is_alive():
                return
        try:
            job = pipe.recv()
        except EOFError:
            return
        for number in SIGNALS:  # one that comes too late is for nobody
            signal.signal(number, lambda *_: None)
        pipe.send(_done(job, said))


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
        path = os.path.abspath(os.fsdecode(arguments[0]))
        if path.startswith(_WATCHED[0]):
            _OPENED.add(path)


def _done(job: _Job, said: Path) -> End:
    from doedesign.cli import main

    folder = (job.place / "work").resolve()
    os.chdir(folder)
    tempfile.tempdir = os.environ["TMPDIR"] = str(job.place / "tmp")
    _OPENED.clear()
    _WATCHED[0] = f"{folder}{os.sep}"
    handles = [os.open(said / name, os.O_RDWR | os.O_CREAT | os.O_TRUNC) for name in _STREAMS]
    kept = [os.dup(1), os.dup(2)]
    for stream, handle in zip((1, 2), handles, strict=True):
        os.dup2(handle, stream)
    Path("/proc/self/clear_refs").write_text("5")  # the highest memory counts from here
    began, used, before = time.monotonic(), _processor_s(), _resident()
    try:
        sys.stdout = io.TextIOWrapper(os.fdopen(1, "wb", closefd=False), "utf-8")
        sys.stderr = io.TextIOWrapper(
            os.fdopen(2, "wb", 0, closefd=False), "utf-8", "backslashreplace", write_through=True
        )
        with shimmed(job.place, job.fault) as shim:
            try:
                code = main(job.arguments)
            except SystemExit as error:
                code = error.code if isinstance(error.code, int) else 1
            except BaseException:
                traceback.print_exc()
                code = 1
        sys.stdout.flush()
    finally:
        for stream, handle in zip((1, 2), kept, strict=True):
            os.dup2(handle, stream)
            os.close(handle)
    out, err = (os.pread(handle, 1 << 24, 0).decode("utf-8", "replace") for handle in handles)
    for handle in handles:
        os.close(handle)
    found = tuple(sorted(os.path.relpath(path, folder) for path in _OPENED))
    _WATCHED[0] = "\0"
    cpu, wall = _processor_s() - used, time.monotonic() - began
    return End(code, out, err, cpu, wall, max(0, _status("VmHWM") - before), tuple(shim.calls), found)


def _processor_s() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _status(key: str) -> int:
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return 1024 * int(lines[key].split()[0])


def _resident() -> int:
    return _status("VmRSS")


def content(folder: Path) -> dict[str, bytes]:
    """Every file and folder below a folder by its relative name, the times that steps and commands took left out."""
    found: dict[str, bytes] = {}
    for path in sorted(folder.rglob("*")):
        if path.name == COST_NAME:
            continue
        name = str(path.relative_to(folder))
        if path.is_symlink():
            found[name] = b"link " + os.fsencode(os.readlink(path))
        elif path.is_dir():
            found[f"{name}/"] = b""
        elif path.is_file():
            found[name] = path.read_bytes()
    return {name: _untimed(name, data, found) for name, data in found.items()}


def _untimed(name: str, data: bytes, files: dict[str, bytes]) -> bytes:
    """A file without what a clock wrote into it."""
    folder, _, last = name.rpartition("/")
    history = f"{folder}/history.jsonl".lstrip("/")
    if b'"seconds"' not in files.get(history, b"") or last not in ("history.jsonl", "manifest.json"):
        return data
    try:
        if last == "history.jsonl":
            records = [json.loads(line) for line in data.splitlines()]
            return json.dumps([{k: v for k, v in r.items() if k != "seconds"} for r in records]).encode()
        manifest = json.loads(data)
        manifest.get("results_sha256", {}).pop("history.jsonl", None)
        return json.dumps(manifest).encode()
    except (ValueError, AttributeError):
        return data
