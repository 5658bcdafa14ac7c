"""Progress of long work.

On a terminal a bar with rate, losses and time left; otherwise plain lines, one in about ten seconds, so that a
log stays short. All of it goes to stderr; stdout is for results.
"""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


class Meter(Protocol):
    """Receives progress of one piece of work."""

    def advance(self, done: int, note: str = "") -> None:
        """`done` of the total are finished; `note` is a few words on how it goes."""
        ...


class _PlainMeter:
    _INTERVAL_S = 10.0

    def __init__(self, title: str, total: int, start: int) -> None:
        self._title, self._total, self._start = title, total, start
        self._begun: float | None = None
        self._told = time.monotonic()

    def advance(self, done: int, note: str = "") -> None:
        now = time.monotonic()
        if self._begun is None:
            # The clock starts after the first piece, which also pays for compilation.
            self._begun, self._start = now, done
        if now - self._told < self._INTERVAL_S and done < self._total:
            return
        self._told = now
        parts = [f"{self._title}: {done}/{self._total}"]
        if done > self._start and now > self._begun:
            rate = (done - self._start) / (now - self._begun)
            parts += [f"{rate:.2f}/s", f"{_told((self._total - done) / rate)} left"]
        if note:
            parts.append(note)
        print(", ".join(parts), file=sys.stderr, flush=True)


def _told(seconds: float) -> str:
    """A time as people say it: 40 s, 12 min, 2 h 5 min."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


class _BarMeter:
    def __init__(self, bar: object, task: object) -> None:
        self._bar, self._task = bar, task

    def advance(self, done: int, note: str = "") -> None:
        self._bar.update(self._task, completed=done, note=note)  # pyright: ignore[reportAttributeAccessIssue]


@contextmanager
def meter(title: str, total: int, start: int = 0) -> Iterator[Meter]:
    """A meter for stderr.

    Args:
        title: what is being done.
        total: number of pieces.
        start: pieces that were done before (a resumed run).
    """
    if not sys.stderr.isatty():
        yield _PlainMeter(title, total, start)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        yield _BarMeter(bar, bar.add_task(title, total=total, completed=start, note=""))
