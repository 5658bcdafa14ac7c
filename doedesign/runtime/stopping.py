"""Ending long work between two steps: what SIGINT and SIGTERM ask for, and what several hosts agree on."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class StopRequest:
    """Whether someone asked for an end; made by `stoppable`.

    Attributes:
        asked: whether.
    """

    def __init__(self) -> None:
        self.asked, self._waits = False, False

    def ask(self, *_: Any) -> None:
        """Handle a signal: at once, or after the step where there is one; a second signal does not wait.

        Raises:
            KeyboardInterrupt: at once.
        """
        if self.asked or not self._waits:
            raise KeyboardInterrupt
        self.asked = True

    @contextmanager
    def gently(self) -> Iterator[None]:
        """Let steps end: within this block a signal only sets `asked`, which is to be looked at between steps."""
        self._waits = True
        try:
            yield
        finally:
            self._waits = False

    def agreed(self) -> bool:
        """Whether any host was asked: one that stopped alone would leave the others waiting for ever."""
        import jax

        if jax.process_count() == 1:
            return self.asked
        import numpy as np
        from jax.experimental.multihost_utils import process_allgather

        return bool(np.any(process_allgather(np.array(self.asked))))


@contextmanager
def stoppable() -> Iterator[StopRequest]:
    """Take SIGINT and SIGTERM as questions; both raise KeyboardInterrupt where nothing is said of steps."""
    stop = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield stop  # only the main thread is told of signals
        return
    before = {number: signal.signal(number, stop.ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
