"""Plates evaluated on all cores of this machine, by worker processes that are each single-threaded.

A plate's numbers must not depend on how many workers there are or which one is free, so every worker computes with one
thread, alone or not. A worker that dies (no memory left, say) takes nothing with it: the pool starts again, and the
plates that were under way are tried once more one by one, so that a plate that kills its worker is found and named.
"""

import atexit
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import threading
import uuid
import warnings
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from importlib import import_module
from multiprocessing.connection import Connection
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

from fab.errors import InputError
from fab.process import Process, Variation

if TYPE_CHECKING:
    from doedesign.design.design import Design
    from sim.psf_bank import PsfBank

Rows = list[dict[str, Any]]
Evaluate = Callable[["Design", Process, Variation], Any]
"""What is asked of a plate; a study asks for `Rows`."""

_STRIKES = 3
_GIB = 2**30
# Measured: an idle worker with its libraries, and what a prediction holds per DOE cell at its peak.
_BASE_GIB, _BYTES_PER_CELL = 0.7, 350


class Work(NamedTuple):
    """What every worker holds: how plates are evaluated, and of what."""

    evaluate: Evaluate
    design: "Design"
    process: Process


def predicted_rows(design: "Design", process: Process, variation: Variation) -> Rows:
    """What light does with one plate, one row per colour and depth (`doedesign.prediction`)."""
    from doedesign.prediction import predict

    return predict(design, process, variation).rows


def predicted_bank(design: "Design", process: Process, variation: Variation) -> "PsfBank":
    """The PSFs of one plate."""
    from doedesign.prediction import predict

    return predict(design, process, variation).bank


class OutOfModel(NamedTuple):
    """What is found of a plate whose errors are larger than the evaluation can describe.

    Attributes:
        reason: which of them, in a sentence.
    """

    reason: str


def evaluated(work: Work, variation: Variation) -> Any:
    """What is found of one plate; `OutOfModel` where the evaluation raises `InputError`."""
    try:
        return work.evaluate(work.design, work.process, variation)
    except InputError as error:
        return OutOfModel(f"{error.where}: {error.rule}, but got {error.got}")


class WorkerTask(NamedTuple):
    """Work on its way to a worker: values, and the names of what is to be imported once threads are limited.

    Attributes:
        token: tells one piece of work from another.
        evaluate: "module:function".
        design: "module:class".
        fields: what the design is made of.
        process: the process.
    """

    token: str
    evaluate: str
    design: str
    fields: dict[str, Any]
    process: Process


def path_of(thing: Callable[..., Any]) -> str:
    """Where a function or class is found, "module:name"."""
    return f"{thing.__module__}:{thing.__qualname__}"


def packed(work: Work) -> WorkerTask:
    """Work as it is sent to a worker.

    Raises:
        InputError: a function that a worker cannot import.
    """
    if "<" in path_of(work.evaluate):
        rule = "must be a function at the top of a module, for workers import it"
        raise InputError("evaluate", rule, path_of(work.evaluate), "Move it there.")
    # A read-only mapping cannot be sent.
    process = replace(work.process, spreads=dict(work.process.spreads))
    design = work.design
    return WorkerTask(uuid.uuid4().hex, path_of(work.evaluate), path_of(type(design)), dict(vars(design)), process)


_OPENED: dict[str, Work] = {}


def opened(parcel: WorkerTask) -> Work:
    """The work in a parcel; kept, so that a worker opens it once."""
    if parcel.token not in _OPENED:
        work = Work(_found(parcel.evaluate), _found(parcel.design)(**parcel.fields), parcel.process)
        _OPENED.clear()
        _OPENED[parcel.token] = work
    return _OPENED[parcel.token]


def _found(path: str) -> Any:
    module, _, name = path.partition(":")
    return attrgetter(name)(import_module(module))


def single_thread_settings() -> dict[str, str]:
    """Environment of a process that computes with one thread on the CPU, the same numbers on every machine like it."""
    flags = "--xla_cpu_multi_thread_eigen=false"
    libraries = ("OMP", "OPENBLAS", "MKL", "NUMBA")
    return {
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip(),
        "JAX_PLATFORMS": "cpu",
        "NPROC": "1",  # threads of XLA's own pool, beside those of Eigen
        **{f"{library}_NUM_THREADS": "1" for library in libraries},
    }


def default_workers(cells: int) -> int:
    """As many workers as there are cores and memory for.

    Args:
        cells: DOE cells of the design.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, int(_free_gib() / (_BASE_GIB + cells * _BYTES_PER_CELL / _GIB))))


def _free_gib() -> float:
    try:
        with open("/proc/meminfo") as stream:
            lines = dict(line.split(":", 1) for line in stream)
        return int(lines["MemAvailable"].split()[0]) * 1024 / _GIB
    except (OSError, KeyError):  # not Linux: trust the number of cores
        return float("inf")


def evaluate_here(work: Work, plates: Mapping[str, Variation], workers: int) -> Iterator[tuple[str, Any]]:
    """Evaluate plates by worker processes on this machine.

    Args:
        work: how, and of what design and process.
        plates: variations by key.
        workers: number of processes.

    Yields:
        key and what was found of every plate, as they are finished.

    Raises:
        InputError: a plate that ended its worker three times, or a function that a worker cannot import.
    """
    strikes: Counter[str] = Counter()
    fresh, suspects = deque(plates), deque[str]()
    while fresh or suspects:
        alone = not fresh
        queue, count = (suspects, 1) if alone else (fresh, workers)
        lost = yield from _until_broken(work, plates, queue, min(count, len(queue)), alone)
        strikes.update(lost)
        for key in lost:
            if strikes[key] >= _STRIKES:
                got = f"{_STRIKES} workers that ended while they computed it, as when memory runs out"
                cure = "Free memory, or take fewer workers (--workers). Finished draws are kept."
                raise InputError(f"draw {key}", "a worker must live through a draw", got, cure)
        suspects.extend(lost)


def _until_broken(
    work: Work, plates: Mapping[str, Variation], queue: deque[str], workers: int, alone: bool
) -> Generator[tuple[str, Any], None, list[str]]:
    """Evaluate a queue until it is empty or a worker dies; returns the plates that were under way then."""
    flying: dict[Future[Any], str] = {}
    # One more than can be computed keeps every worker busy; alone, the one under way must be the one to blame.
    ahead = 1 if alone else workers + 1
    with _pool(work, workers) as pool:
        try:
            while queue or flying:
                while queue and len(flying) < ahead:
                    flying[_submitted(pool, work, plates[queue[0]])] = queue[0]
                    queue.popleft()
                done = wait(flying, return_when=FIRST_COMPLETED).done
                for future in [one for one in flying if one in done]:  # in the order in which they were handed over
                    yield flying[future], named(flying[future], future.result)
                    del flying[future]
        except BrokenProcessPool:
            # What was finished just before counts.
            for future, key in flying.items():
                if future.done() and not future.cancelled() and future.exception() is None:
                    yield key, future.result()
            return [k for f, k in flying.items() if not f.done() or f.cancelled() or f.exception() is not None]
    return []


def named(key: str, result: Callable[[], Any]) -> Any:
    """What was found of a plate; an error says which plate it was."""
    try:
        return result()
    except InputError:
        raise
    except Exception as error:
        error.add_note(f"in draw {key}")
        raise


@contextmanager
def _pool(work: Work, workers: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that end when the body ends, at once if it raises, and also if this process is killed."""
    context = multiprocessing.get_context("spawn")
    # Nothing is ever sent: the other end tells that it was closed, which the system does for a process that is killed.
    theirs, ours = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_begin, initargs=(packed(work), theirs))
    try:
        yield pool
        pool.shutdown()
    finally:
        ours.close()
        pool.shutdown(cancel_futures=True)
        theirs.close()


def _submitted(pool: ProcessPoolExecutor, work: Work, variation: Variation) -> "Future[Any]":
    # Workers start while their first plates are handed over.
    with _sheltered_start(work):
        return pool.submit(_evaluate, variation)


@cache
def _compiled() -> str:
    """A folder in which workers find what others have compiled, as long as this process lives."""
    folder = tempfile.mkdtemp(prefix="doedesign-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@contextmanager
def _sheltered_start(work: Work) -> Iterator[None]:
    """Start processes in the body with one thread each, deaf to Ctrl-C, and without the user's script.

    A worker would otherwise run the script that asked for it once more, to find functions that are defined there.
    Ctrl-C is for this process, which ends its workers.
    """
    settings = single_thread_settings()
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        # A worker compiles for eight seconds at its first plate; its successors need not.
        settings |= {"JAX_COMPILATION_CACHE_DIR": _compiled(), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    before = {name: os.environ.get(name) for name in settings}
    main = vars(sys.modules["__main__"])
    told = {name: main[name] for name in ("__file__", "__spec__") if name in main}
    hidden = work.evaluate.__module__ != "__main__"
    deaf_before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        os.environ.update(settings)
        if hidden:
            main.pop("__file__", None)
            main["__spec__"] = None
        yield
    finally:
        main.update(told)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, deaf_before)


# What follows runs in a worker.

_HELD: list[WorkerTask] = []


def _begin(parcel: WorkerTask, parent: Connection) -> None:
    # What another worker is just writing cannot be read; it is then compiled here, too.
    warnings.filterwarnings("ignore", "Error reading persistent compilation cache")
    _HELD.append(parcel)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Connection) -> None:
    with suppress(EOFError, OSError):
        parent.recv_bytes()  # returns when the other end is closed
    os._exit(1)


def _evaluate(variation: Variation) -> Any:
    return evaluated(opened(_HELD[0]), variation)
