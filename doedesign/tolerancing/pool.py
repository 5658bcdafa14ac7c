"""Draws evaluated on all cores of this machine, by worker processes of loky that compute with one thread each.

A draw's numbers must not depend on how many workers there are or which one is free, so every worker computes with one
thread, alone or not. loky starts the workers, hands them their draws and keeps them a while for the next question. A
worker that dies (no memory left, say) takes nothing with it: the draws that were under way are tried once more one by
one by new workers, so that a draw that kills its worker is found and named.
"""

import atexit
import os
import shutil
import sys
import tempfile
import threading
import time
import uuid
import warnings
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from functools import cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

from fab.errors import InputError
from fab.process import Process, Variation

if TYPE_CHECKING:
    from doedesign.design.design import Design
    from sim.psf_bank import PsfBank

Rows = list[dict[str, Any]]
Evaluate = Callable[["Design", Process, Variation], Any]
"""Evaluation of a draw; a study needs `Rows`."""

_STRIKES = 3
_GIB = 2**30
# Measured: an idle worker with its libraries, and what a prediction holds per DOE cell at its peak.
_BASE_GIB, _BYTES_PER_CELL = 0.7, 350
_IDLE_S = 30  # after which a worker without work ends


class OutOfModel(NamedTuple):
    """Result of a draw whose errors are larger than the evaluation can describe."""

    reason: str


@dataclass(frozen=True, eq=False)
class DrawModel:
    """Model of a study: how a draw is evaluated, of which design and process; its copies in workers share a token."""

    evaluate: Evaluate
    design: "Design"
    process: Process
    token: str = field(default_factory=lambda: uuid.uuid4().hex)

    def __call__(self, variation: Variation) -> Any:
        """Evaluate one draw; `OutOfModel` where the evaluation raises `InputError`."""
        try:
            return self.evaluate(self.design, self.process, variation)
        except InputError as error:
            return OutOfModel(f"{error.where}: {error.rule}, but got {error.got}")


def predicted_rows(design: "Design", process: Process, variation: Variation) -> Rows:
    """Metrics of one draw, a row per colour and depth (`doedesign.prediction`)."""
    from doedesign.prediction import predict

    return predict(design, process, variation).rows


def predicted_bank(design: "Design", process: Process, variation: Variation) -> "PsfBank":
    """PSFs of one draw."""
    from doedesign.prediction import predict

    return predict(design, process, variation).bank


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


def default_workers(cells: int) -> int:
    """As many workers as there are cores and memory for, given the DOE cells of a design."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, int(_free_gib() / (_BASE_GIB + cells * _BYTES_PER_CELL / _GIB))))


def _free_gib() -> float:
    try:
        with open("/proc/meminfo") as stream:
            lines = dict(line.split(":", 1) for line in stream)
        return int(lines["MemAvailable"].split()[0]) * 1024 / _GIB
    except (OSError, KeyError):  # not Linux: trust the number of cores
        return float("inf")


def evaluate_here(model: DrawModel, draws: Mapping[str, Variation], workers: int) -> Iterator[tuple[str, Any]]:
    """Evaluate draws, by key, in worker processes; with 0 workers in this process, with all its threads.

    Yields:
        key and result of every draw, as they are finished.

    Raises:
        InputError: a draw that ended its worker three times.
    """
    if workers == 0:
        for key, variation in draws.items():
            yield key, named(key, partial(model, variation))
        return
    strikes: Counter[str] = Counter()
    fresh, suspects = deque(draws), deque[str]()
    while fresh or suspects:
        # One more than can be computed keeps every worker busy; alone, the one under way must be the one to blame.
        queue, count, ahead = (fresh, min(workers, len(fresh)), workers + 1) if fresh else (suspects, 1, 1)
        lost = yield from _until_broken(model, draws, queue, count, ahead)
        strikes.update(lost)
        for key in lost:
            if strikes[key] >= _STRIKES:
                got = f"{_STRIKES} workers that ended while they computed it, as when memory runs out"
                cure = "Free memory, or take fewer workers. Finished draws are kept."
                raise InputError(f"draw {key}", "a worker must live through a draw", got, cure)
        suspects.extend(lost)


def _until_broken(
    model: DrawModel, draws: Mapping[str, Variation], queue: deque[str], workers: int, ahead: int
) -> Generator[tuple[str, Any], None, list[str]]:
    """Evaluate a queue until it is empty or a worker dies; returns the draws that were under way then."""
    from loky import get_reusable_executor
    from loky.process_executor import TerminatedWorkerError

    # Idle workers are taken again if they were started with the same arguments.
    started = {"env": _worker_settings(), "initializer": _begin, "initargs": (os.getpid(), tuple(sys.path))}
    executor = get_reusable_executor(workers, timeout=_IDLE_S, **started)
    flying: dict[Future[Any], str] = {}
    try:
        while queue or flying:
            while queue and len(flying) < ahead:
                flying[executor.submit(_evaluate, model, draws[queue[0]])] = queue[0]
                queue.popleft()
            done = wait(flying, return_when=FIRST_COMPLETED).done
            for future in [one for one in flying if one in done]:  # in the order in which they were handed over
                yield flying[future], named(flying[future], future.result)
                del flying[future]
    except TerminatedWorkerError:
        # What was finished just before counts.
        lost = [future for future in flying if not future.done() or future.cancelled() or future.exception()]
        yield from ((key, future.result()) for future, key in flying.items() if future not in lost)
        return [flying[future] for future in lost]
    except BaseException:
        executor.shutdown(kill_workers=True)  # nobody waits for what is under way
        raise
    return []


def named(key: str, result: Callable[[], Any]) -> Any:
    """The result of a draw; an error says which draw it was."""
    try:
        return result()
    except InputError:
        raise
    except Exception as error:
        error.add_note(f"in draw {key}")
        raise


@cache
def _worker_settings() -> dict[str, str]:
    """Environment of workers, with a folder for what they have compiled, as long as this process lives."""
    # loky would end workers that grow, as they do from draw to draw by what they compile.
    settings = {**single_thread_settings(), "LOKY_MAX_MEMORY_LEAK_SIZE": "1e18"}
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        # A worker compiles for eight seconds at its first draw; its successors need not.
        folder = tempfile.mkdtemp(prefix="doedesign-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        settings |= {"JAX_COMPILATION_CACHE_DIR": folder, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    return settings


# What follows runs in a worker.

_MODELS: dict[str, DrawModel] = {}


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


def _evaluate(model: DrawModel, variation: Variation) -> Any:
    # The first copy stands for all that follow it, for predictions know a level map by its identity.
    if model.token not in _MODELS:
        _MODELS.clear()
        _MODELS[model.token] = model
    return _MODELS[model.token](variation)
