"""SIGINT and SIGTERM during long work: the end between two steps."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class StopRequest:
    """Request to end the work; made by `stoppable`.

    Attributes:
        asked: whether a signal arrived.
    """

    def __init__(self) -> None:
        self.asked, self._waits = False, False

    def ask(self, *_: Any) -> None:
        """Handle a signal: at once, or after the step within `gently`; a second signal does not wait.

        Raises:
            KeyboardInterrupt: at once.
        """
        if self.asked or not self._waits:
            raise KeyboardInterrupt
        self.asked = True

    @contextmanager
    def gently(self) -> Iterator[None]:
        """Let steps end: within this block a signal only sets `asked`, which the caller checks between steps."""
        self._waits = True
        try:
            yield
        finally:
            self._waits = False


@contextmanager
def stoppable() -> Iterator[StopRequest]:
    """Handle SIGINT and SIGTERM by a `StopRequest`; both raise KeyboardInterrupt outside of its `gently`."""
    stop = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield stop  # only the main thread receives signals
        return
    before = {number: signal.signal(number, stop.ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
