"""Work in a child process with limits, for libraries that a damaged file makes crash or grow without bounds."""

import contextlib
import ctypes
import faulthandler
import importlib
import math
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, TimeoutError
from typing import Any

from loky import ProcessPoolExecutor
from loky.process_executor import BrokenProcessPool, TerminatedWorkerError

# A sound file takes far less of either: gdstk about 350 bytes for a polygon, and seconds for a million of them.
# Seconds are those of the processor, so that a busy machine does not fail a sound file; to the clock they may be more.
_SECONDS, _SECONDS_PER_SHAPE = 4.0, 5e-6
_PATIENCE = 15.0
_BYTES, _BYTES_PER_SHAPE = 1 << 30, 400
_START_S = 120.0  # for a child to begin, and to import what it needs


class ChildFailed(Exception):
    """The work could not be done; the text says why."""


class TooMuch(ChildFailed):
    """The work takes more time or memory than it may."""


class Child:
    """A process that does one piece of work after another; one that fails ends it, and the next starts another."""

    def __init__(self) -> None:
        self._executor: ProcessPoolExecutor | None = None
        self._ready: Future[Any]

    def begin(self, work: Callable[..., Any], *arguments: Any) -> "Future[Any]":
        """Begin a piece of work; `result` waits for it."""
        modules = [each.__module__ for each in (work, *arguments) if callable(each)]
        try:
            self._ready = self._running().submit(_import, modules)
        except (BrokenProcessPool, TerminatedWorkerError):  # something ended it while it had nothing to do
            self.end()
            self._ready = self._running().submit(_import, modules)
        return self._running().submit(work, *arguments)

    def _running(self) -> ProcessPoolExecutor:
        if self._executor is None:
            # Without a timeout: a process that ends by itself may do so just when work is given to it.
            self._executor = ProcessPoolExecutor(max_workers=1)
        return self._executor

    def result(self, begun: "Future[Any]", shapes: int) -> Any:
        """Wait for a piece of work.

        Args:
            begun: the work.
            shapes: number of shapes that it may have to read, by which its time is limited.

        Raises:
            TooMuch: the work had not enough memory, or took too long and is ended.
            ChildFailed: the work failed, or its process died.
        """
        try:
            self._ready.exception(_START_S)  # what is imported for the first time does not count
            return begun.result(_PATIENCE * _seconds(shapes))
        except TimeoutError as error:
            self.end()
            raise TooMuch("it takes too long") from error
        except MemoryError as error:
            raise TooMuch("it takes too much memory") from error
        except (BrokenProcessPool, TerminatedWorkerError) as error:
            self.end()
            if "SIGXCPU" in str(error):
                raise TooMuch("it takes too long") from error
            raise ChildFailed("the library that reads it crashes") from error
        except Exception as error:  # whatever a library makes of a broken file
            raise ChildFailed(str(error) or type(error).__name__) from error

    def end(self) -> None:
        """End the process, whatever it does."""
        if self._executor is not None:
            self._executor.shutdown(kill_workers=True)
            self._executor = None


_CHILD = Child()


@contextlib.contextmanager
def child_process() -> Iterator[Child]:
    """Provide the child process. It is kept for the next block, unless this one is left by an error."""
    try:
        yield _CHILD
    except BaseException:
        _CHILD.end()
        raise


def _import(modules: list[str]) -> None:
    for module in modules:
        importlib.import_module(module)


def _seconds(shapes: int) -> float:
    return _SECONDS + _SECONDS_PER_SHAPE * shapes


def limited(shapes: int, work: Callable[..., Any], *arguments: Any) -> Any:
    """Do work with no more time and memory than reading so many shapes takes, beyond what is in use already.

    For the child: neither it nor a library says anything on its own; who waits for the result is told.
    """
    faulthandler.disable()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    os.close(nowhere)
    try:
        import resource
    except ImportError:  # Windows
        return work(*arguments)
    most = {
        resource.RLIMIT_DATA: _in_use() + _BYTES + _BYTES_PER_SHAPE * shapes,
        resource.RLIMIT_CPU: math.ceil(time.process_time() + _seconds(shapes)),
        resource.RLIMIT_CORE: 0,
    }
    before = {kind: resource.getrlimit(kind) for kind in most}
    for kind, limit in most.items():
        with contextlib.suppress(ValueError, OSError):  # a lower limit is there already
            resource.setrlimit(kind, (limit, before[kind][1]))
    try:
        return work(*arguments)
    finally:
        for kind, limits in before.items():
            resource.setrlimit(kind, limits)
        _give_back()


def _give_back() -> None:
    """Give memory that libraries have freed back to the system, where it can be asked for it.

    The executor would take what is kept for a leak, and start the process again.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def _in_use() -> int:
    """Private memory of this process, bytes; 0 where the system does not tell."""
    try:
        with open("/proc/self/status") as stream:
            lines = dict(line.split(":", 1) for line in stream)
        return 1024 * int(lines["VmData"].split()[0])
    except (OSError, KeyError):
        return 0
