"""Progress of long work.

On a terminal a bar with rate, losses and time left; otherwise plain lines, one in about ten seconds, so that a
log stays short. All of it goes to stderr; stdout is for results.
"""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_INTERVAL_S = 10.0


class Meter:
    """Progress of one piece of work, as plain lines; made by `meter`."""

    def __init__(self, title: str, total: int, start: int) -> None:
        self._title, self._total, self._start = title, total, start
        self._begun: float | None = None
        self._printed = time.monotonic()

    def advance(self, done: int, note: str = "") -> None:
        """Report that `done` of the total are finished; `note` is a few words on how it goes."""
        now = time.monotonic()
        if self._begun is None:
            # The clock starts after the first piece, which also pays for compilation.
            self._begun, self._start = now, done
        if now - self._printed < _INTERVAL_S and done < self._total:
            return
        self._printed = now
        parts = [f"{self._title}: {done}/{self._total}"]
        if done > self._start and now > self._begun:
            rate = (done - self._start) / (now - self._begun)
            parts += [f"{rate:.2f}/s", f"{duration_text((self._total - done) / rate)} left"]
        print(", ".join([*parts, note] if note else parts), file=sys.stderr, flush=True)


class _BarMeter(Meter):
    def __init__(self, bar: Any, task: Any) -> None:
        self._bar, self._task = bar, task

    def advance(self, done: int, note: str = "") -> None:
        self._bar.update(self._task, completed=done, note=note)


def duration_text(seconds: float) -> str:
    """Duration as people write it: 40 s, 12 min, 2 h 5 min.

    Args:
        seconds: the duration.
    """
    if seconds < 100:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


@contextmanager
def meter(title: str, total: int, start: int = 0) -> Iterator[Meter]:
    """Show the progress of work of `total` pieces, `start` of them done before, on stderr."""
    if not sys.stderr.isatty():
        yield Meter(title, total, start)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    notes = TextColumn("{task.fields[note]}")
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), notes, TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        yield _BarMeter(bar, bar.add_task(title, total=total, completed=start, note=""))
