"""Computations side by side on the cores of a processor.

A transform in blocks that stay in the cache leaves half of a second core idle, and more of a third; two of them side by
side do not.
"""

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import TypeVar

_MOST = 8  # each holds a field of its own
_here = threading.local()  # `busy`: whether this thread is one of several that work side by side

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def side_by_side() -> int:
    """How many computations run side by side: on a processor as many as it has cores, at most 8.

    Where the environment variable NPROC tells XLA how many threads to take, it is told here too. On another device two,
    of which one is prepared by the host while the other is computed. One where this is asked by such a computation.
    """
    if getattr(_here, "busy", False):
        return 1
    import jax  # how many cores there are is asked by commands that need none of it

    if jax.default_backend() != "cpu":
        return 2
    told = os.environ.get("NPROC", "")
    count = int(told) if told.isdecimal() and int(told) > 0 else cores()
    return min(count, _MOST)


def at_once(work: Callable[[_Item], _Result], items: Sequence[_Item]) -> Iterator[_Result]:
    """`work` of every item, in their order, several at once; none may be part of a trace.

    After an error no further item is begun. Settings that jax keeps for a thread (`jax.enable_x64`, `jax.debug_nans`,
    `jax.default_device` as context managers) do not reach the work.
    """
    count, failed = min(side_by_side(), len(items)), threading.Event()
    if count < 2:
        yield from map(work, items)
        return

    def unless_failed(item: _Item) -> _Result:
        if failed.is_set():  # the error of an earlier item is raised before anybody asks for this one
            raise CancelledError
        _here.busy = True  # the threads of the pool do nothing else
        try:
            return work(item)
        except BaseException:
            failed.set()
            raise

    pool = ThreadPoolExecutor(count)
    try:
        yield from pool.map(unless_failed, items)
    finally:
        pool.shutdown(cancel_futures=True)
