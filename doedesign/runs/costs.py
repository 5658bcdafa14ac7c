"""The cost of commands: time, memory and host, kept in the folder of the run that they worked on.

    cost.jsonl      one line per command that ended, in the order in which they ended

It is no result: its numbers differ from call to call, so no manifest lists it, no digest covers it and no command reads
it. A run that was stopped and resumed has a line for each part. A part that was killed leaves none, and one that found
its work done, neither.
"""

import json
import os
import platform
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from doedesign import __version__
from doedesign.runs.folder import COST_NAME, FORMAT
from doedesign.runtime.effort import efforts
from doedesign.runtime.memory import peak_bytes
from doedesign.runtime.progress import duration_text
from fab.errors import InputError
from fab.files import MANIFEST_NAME, read_json
from sim.threads import cores

_MIB, _GIB = 1 << 20, 1 << 30
_MOST = 1e18  # seconds or bytes that a command may have taken; no machine has more


class Cost(NamedTuple):
    """Cost of one command, or of several together.

    Attributes:
        commands: their names.
        seconds: time from start to end.
        cpu_s: processor time, of worker processes and of other programs that were called, too.
        peak_bytes: the most memory that the process held.
        worker_peak_bytes: the most that a single worker process held; 0 without workers.
        host: name of the machine; of several, each once.
        cores: processors that it might use.
        ended: time of the end, UTC, ISO 8601.
        done: whether it came to its end, and was not stopped.
    """

    commands: tuple[str, ...]
    seconds: float
    cpu_s: float
    peak_bytes: int
    worker_peak_bytes: int
    host: str
    cores: int
    ended: str
    done: bool = True

    def text(self) -> str:
        """The cost in words."""
        memory = _size_text(self.peak_bytes)
        if self.worker_peak_bytes > 0:
            memory += f" and {_size_text(self.worker_peak_bytes)} per worker"
        parts = "" if len(self.commands) == 1 else f" in {len(self.commands)} commands"
        busy = f"{elapsed_text(self.cpu_s)} of processor time"
        return f"{elapsed_text(self.seconds)}{parts} ({busy}), {memory} of memory, on {self.host}"


def elapsed_text(seconds: float) -> str:
    """A duration that is over, in words; of less than ten seconds to a tenth.

    Args:
        seconds: the duration.
    """
    return f"{seconds:.1f} s" if seconds < 10 else duration_text(seconds)


def _size_text(size: float) -> str:
    return f"{size / _GIB:.1f} GiB" if size >= _GIB else f"{size / _MIB:.0f} MiB"


class Measuring:
    """A command that is under way; made by `measured`, and filled in when its block ends.

    Attributes:
        run: the run that it works on; the block may say so where it learns it.
        cost: its cost; None until it has ended.
    """

    def __init__(self, run: Path | None) -> None:
        self.run = run
        self.cost: Cost | None = None


@contextmanager
def measured(run: Path | None, command: str, *, writes: Path | None = None) -> Iterator[Measuring]:
    """Measure what happens in this block, and add it to the costs of a run when it ends or is stopped.

    Nothing is added where there is no run, where the block changed nothing because all was there already, where it
    failed, and where the folder cannot be written to: a cost is never a reason to fail.

    Args:
        run: folder of the run, which the block may make; a folder of something else keeps no costs.
        command: name of the command.
        writes: folder that the block writes, where that is not in the run.

    Yields:
        an object that has the cost when the block has ended.
    """
    places = [path for path in (run, writes) if path is not None]
    before, start, cpu, known = [_changed_ns(path) for path in places], time.monotonic(), _cpu_s(), len(efforts())
    measuring, ended = Measuring(run), "failed"
    try:
        yield measuring
        ended = "done"
    except KeyboardInterrupt:
        ended = "stopped"
        raise
    finally:
        of_others = efforts()[known:]
        measuring.cost = Cost(
            (command,),
            round(time.monotonic() - start, 3),
            round(_cpu_s() - cpu + sum(one.cpu_s for one in of_others), 3),
            peak_bytes(),
            max((one.peak_bytes for one in of_others), default=0),
            platform.node(),
            cores(),
            datetime.now(UTC).isoformat(timespec="seconds"),
            ended == "done",
        )
        # Whatever the block made that was not known before is new.
        changed = measuring.run != run or [_changed_ns(path) for path in places] != before
        if measuring.run is not None and ended != "failed" and changed:
            _add(measuring.run, measuring.cost)


def _cpu_s() -> float:
    """Processor time of this process."""
    now = os.times()
    return now.user + now.system


def _changed_ns(run: Path) -> tuple[int, ...]:
    """Times at which a run and the folders of results in it changed last."""
    if not run.is_dir():
        return ()
    found = [run, *sorted(path for path in run.iterdir() if path.is_dir()), *run.glob("*/*/" + MANIFEST_NAME)]
    found += [run / MANIFEST_NAME, *run.glob("*/*.jsonl")]
    times = []
    for path in found:
        with suppress(OSError):
            times.append(path.stat().st_mtime_ns)
    return tuple(times)


def _add(run: Path, cost: Cost) -> None:
    """Append a line, whole or not at all; two commands at once may do so."""
    with suppress(InputError, OSError):
        if read_json(run / MANIFEST_NAME).get("format") != FORMAT:
            return
        line = json.dumps({**cost._asdict(), "version": __version__}, sort_keys=True) + "\n"
        handle = os.open(run / COST_NAME, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            os.write(handle, line.encode())
        finally:
            os.close(handle)


def costs_of(run: Path) -> tuple[Cost, ...]:
    """The costs that a run keeps, in the order of the ends of its commands; lines that are none are left out.

    Args:
        run: folder of the run.
    """
    try:
        lines = (run / COST_NAME).read_bytes().splitlines()
    except OSError:
        return ()
    return tuple(cost for line in lines if (cost := _cost(line)) is not None)


def _cost(line: bytes) -> Cost | None:
    try:
        found: dict[str, Any] = json.loads(line)
        cost = Cost(
            tuple(str(name) for name in found["commands"]),
            float(found["seconds"]),
            float(found["cpu_s"]),
            int(found["peak_bytes"]),
            int(found["worker_peak_bytes"]),
            str(found["host"]),
            int(found["cores"]),
            str(found["ended"]),
            bool(found["done"]),
        )
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return None
    numbers = (cost.seconds, cost.cpu_s, cost.peak_bytes, cost.worker_peak_bytes, cost.cores)
    return cost if all(0 <= number <= _MOST for number in numbers) else None


def together(costs: Iterable[Cost]) -> Cost | None:
    """Several costs as one: times add up, of memory and processors the largest counts; None without any.

    Args:
        costs: the costs.
    """
    each = tuple(costs)
    if not each:
        return None
    return Cost(
        tuple(name for one in each for name in one.commands),
        sum(one.seconds for one in each),
        sum(one.cpu_s for one in each),
        max(one.peak_bytes for one in each),
        max(one.worker_peak_bytes for one in each),
        ", ".join(dict.fromkeys(one.host for one in each)),
        max(one.cores for one in each),
        each[-1].ended,
        each[-1].done,
    )
