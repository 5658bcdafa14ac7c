"""Signals that end work: SIGINT (Ctrl-C), SIGTERM (kill) and SIGHUP (the terminal is closed), all alike."""

import _thread
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from fab.errors import InputError


class StopRequest:
    """Request to end the work; made by `stoppable`.

    Attributes:
        asked: whether a signal arrived.
        cut: whether it interrupted whatever was going on.
    """

    def __init__(self) -> None:
        self.asked, self.cut, self._waits = False, False, False

    def ask(self, *_: Any) -> None:
        """Handle a signal: at once, or after the step within `gently`; a second signal does not wait.

        Raises:
            KeyboardInterrupt: at once.
        """
        if self.asked or not self._waits:
            self.cut = True
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
    """Handle the signals by a `StopRequest`; all of them raise KeyboardInterrupt outside of its `gently`."""
    stop = StopRequest()
    with _handled(stop.ask):
        yield stop


@contextmanager
def interruptible() -> Iterator[None]:
    """Let all the signals raise KeyboardInterrupt, as SIGINT does by default, so that work cleans up behind itself.

    Raises:
        KeyboardInterrupt: a signal came, also where a library that was just being imported took it for a fault.
    """
    stop = StopRequest()
    with _handled(stop.ask):
        try:
            yield
        except Exception as error:
            if stop.cut and not isinstance(error, InputError):
                raise KeyboardInterrupt from error
            raise


def _interrupt_main() -> None:
    """Send SIGINT to the main thread, which ends a wait there, too."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        _thread.interrupt_main()  # Windows


@contextmanager
def _handled(handler: Callable[..., None]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread receives signals
        return
    numbers = [signal.SIGINT, signal.SIGTERM]
    # Who starts a command with nohup means it to outlive the terminal. Windows has no such signal.
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, handler) for number in numbers}
    show, again = sys.unraisablehook, list[threading.Timer]()

    def not_lost(unraisable: "sys.UnraisableHookArgs") -> None:
        # Python swallows what is raised while an object is removed: interrupt once more, a moment later.
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            again.append(threading.Timer(0.01, _interrupt_main))
            again[-1].start()
        else:
            show(unraisable)

    sys.unraisablehook = not_lost
    try:
        yield
    finally:
        try:
            for timer in again:  # none may come when this handler is gone
                timer.cancel()
                timer.join()
        finally:
            sys.unraisablehook = show
            for number, earlier in before.items():
                signal.signal(number, earlier)
