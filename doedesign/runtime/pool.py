"""Items of work evaluated on all cores of this machine, by worker processes of loky that compute with one thread each.

The numbers of an item must not depend on how many workers there are or which one is free, so every worker computes with
one thread, alone or not. loky starts the workers, hands them their items and keeps them a while for the next question.
A worker that dies (no memory left, say) takes nothing with it: the items that were under way are tried once more one by
one by new workers, so that an item that kills its worker is found and named.
"""

import atexit
import os
import shutil
import sys
import tempfile
import threading
import time
import warnings
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from functools import cache, partial
from typing import Any, ClassVar, NamedTuple, Protocol

from doedesign.runtime.effort import Effort, note_effort
from doedesign.runtime.memory import peak_bytes
from fab.errors import InputError
from sim.threads import cores

_STRIKES = 3
_GIB = 2**30
_BASE_GIB = 0.7  # measured: an idle worker with its libraries
_IDLE_S = 30  # after which a worker without work ends


class Work(Protocol):
    """An evaluation that can be sent to workers: what it computes follows from itself and the item.

    `noun` is an item's name in messages, such as "draw".
    """

    noun: ClassVar[str]

    @property
    def token(self) -> str:
        """Text that its copies share, and no other evaluation."""
        ...

    def __call__(self, item: Any, /) -> Any:
        """Evaluate one item."""


def single_thread_settings() -> dict[str, str]:
    """Environment of a process that computes with one thread on the CPU, the same numbers on every machine like it."""
    flag = "xla_cpu_multi_thread_eigen"
    libraries = ("OMP", "OPENBLAS", "MKL", "NUMBA")
    return {
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --{flag}=false".strip(),
        "JAX_PLATFORMS": "cpu",
        "NPROC": "1",  # threads of XLA's own pool, beside those of Eigen
        **{f"{library}_NUM_THREADS": "1" for library in libraries},
    }


def default_workers(peak_bytes: int) -> int:
    """As many workers as there are cores and memory for, given the bytes that one item takes at its peak."""
    return max(1, int(min(cores(), free_gib() / (_BASE_GIB + peak_bytes / _GIB))))


def free_gib() -> float:
    """Memory that is free, GiB; infinite where the system does not say."""
    try:
        with open("/proc/meminfo") as stream:
            lines = dict(line.split(":", 1) for line in stream)
        return int(lines["MemAvailable"].split()[0]) * 1024 / _GIB
    except (OSError, KeyError):  # not Linux: trust the number of cores
        return float("inf")


def evaluate_here(work: Work, items: Mapping[str, Any], workers: int) -> Iterator[tuple[str, Any]]:
    """Evaluate items, by key, in worker processes; with 0 workers in this process, with all its threads.

    Yields:
        key and result of every item, as they are finished.

    Raises:
        InputError: an item that ended its worker three times.
    """
    if workers == 0:
        for key, item in items.items():
            yield key, named(f"{work.noun} {key}", partial(work, item))
        return
    strikes: Counter[str] = Counter()
    fresh, suspects = deque(items), deque[str]()
    while fresh or suspects:
        # One more than can be computed keeps every worker busy; alone, the one under way must be the one to blame.
        queue, count, ahead = (fresh, min(workers, len(fresh)), workers + 1) if fresh else (suspects, 1, 1)
        lost = yield from _until_broken(work, items, queue, count, ahead)
        strikes.update(lost)
        for key in lost:
            if strikes[key] >= _STRIKES:
                got = f"{_STRIKES} workers that ended while they computed it, as when memory runs out"
                cure = f"Free memory, or take fewer workers. Finished {work.noun}s are kept."
                raise InputError(f"{work.noun} {key}", f"a worker must live through a {work.noun}", got, cure)
        suspects.extend(lost)


def _until_broken(
    work: Work, items: Mapping[str, Any], queue: deque[str], workers: int, ahead: int
) -> Generator[tuple[str, Any], None, list[str]]:
    """Evaluate a queue until it is empty or a worker dies; returns the items that were under way then."""
    from loky import get_reusable_executor
    from loky.process_executor import TerminatedWorkerError

    # Idle workers are taken again if they were started with the same arguments.
    started = {"env": _worker_settings(), "initializer": _begin, "initargs": (os.getpid(), tuple(sys.path))}
    executor = get_reusable_executor(workers, timeout=_IDLE_S, **started)
    flying: dict[Future[Any], str] = {}
    sent = 0
    try:
        while queue or flying:
            while queue and len(flying) < ahead:
                # Copies of an evaluation may be as large as its networks, so only the first items bring one.
                told = work if sent < workers else None
                flying[executor.submit(_evaluate, work.token, told, items[queue[0]])] = queue[0]
                queue.popleft()
                sent += 1
            done = wait(flying, return_when=FIRST_COMPLETED).done
            for future in [one for one in flying if one in done]:  # in the order in which they were handed over
                key = flying[future]
                found = named(f"{work.noun} {key}", future.result)
                if isinstance(found, _Untold):
                    flying[executor.submit(_evaluate, work.token, work, items[key])] = key
                else:
                    note_effort(found.effort)
                    yield key, found.result
                del flying[future]
    except TerminatedWorkerError:
        # What was finished just before counts.
        lost = [future for future in flying if not future.done() or future.cancelled() or future.exception()]
        told = {future: future.result() for future in flying if future not in lost}
        for future, found in told.items():
            if not isinstance(found, _Untold):
                note_effort(found.effort)
                yield flying[future], found.result
        return [key for future, key in flying.items() if future in lost or isinstance(told[future], _Untold)]
    except BaseException:
        executor.shutdown(kill_workers=True)  # nobody waits for what is under way
        raise
    return []


def named(name: str, result: Callable[[], Any]) -> Any:
    """The result of an item; an error says which item it was."""
    try:
        return result()
    except InputError:
        raise
    except Exception as error:
        error.add_note(f"in {name}")
        raise


@cache
def _worker_settings() -> dict[str, str]:
    """Environment of workers, with a folder for what they have compiled, as long as this process lives."""
    # loky would end workers that grow, as they do from item to item by what they compile.
    settings = {**single_thread_settings(), "LOKY_MAX_MEMORY_LEAK_SIZE": "1e18"}
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        # A worker compiles for eight seconds at its first item; its successors need not.
        folder = tempfile.mkdtemp(prefix="doedesign-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        settings |= {"JAX_COMPILATION_CACHE_DIR": folder, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    return settings


# What follows runs in a worker.

_HELD: dict[str, Work] = {}
_said_s = 0.0  # processor time of this worker that was told


class _Untold:
    """Answer of a worker that has no copy of the evaluation yet."""


class _Told(NamedTuple):
    """Answer of a worker: the result of an item, and what the worker took since its last answer."""

    result: Any
    effort: Effort


def _begin(parent: int, path: tuple[str, ...]) -> None:
    sys.path[:] = path
    # What another worker is just writing cannot be read; it is then compiled here, too.
    warnings.filterwarnings("ignore", "Error reading persistent compilation cache")
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End this process when the one that started it is gone: loky's workers would wait for ever."""
    while os.getppid() == parent:
        time.sleep(1)
    os._exit(1)


def _evaluate(token: str, work: Work | None, item: Any) -> _Told | _Untold:
    global _said_s
    # The first copy stands for all that follow it: what it has compiled and computed belongs to it.
    if token not in _HELD:
        if work is None:
            return _Untold()
        _HELD.clear()
        _HELD[token] = work
    result = _HELD[token](item)
    before, _said_s = _said_s, time.process_time()
    return _Told(result, Effort(_said_s - before, peak_bytes()))
