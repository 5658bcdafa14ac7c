"""Items of work evaluated by the workers of a Dask cluster, wherever they run.

    dask scheduler                                   # prints ADDRESS
    dask worker ADDRESS                              # of one thread, on as many machines as there are, with doedesign
    tolerance(design, scheduler=ADDRESS)

Dask hands out the items and hands those of a lost worker to another; this module only asks and listens.
"""

import gc
import logging
import os
import queue
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from doedesign import __version__
from doedesign.runtime.pool import Work, named, single_thread_settings
from fab.errors import InputError

if TYPE_CHECKING:
    from distributed import Client, Future

log = logging.getLogger("doedesign")

_PATIENCE_S = 30.0


def evaluate_there(work: Work, items: Mapping[str, Any], address: str) -> Iterator[tuple[str, Any]]:
    """Evaluate items, by key, by the workers of the Dask scheduler at an address such as "tcp://10.0.0.1:8786".

    Yields:
        key and result of every item, as they are finished.

    Raises:
        InputError: no Dask here, no scheduler or no workers there, workers without this version of doedesign, or an
            item that ended its worker again and again.
    """
    finished: queue.SimpleQueue[Future] = queue.SimpleQueue()
    with _client(address) as client:
        # A task, and no scattered value: whoever holds it may be lost.
        held = client.submit(_held, work, key=f"doedesign-{work.token}", pure=False)
        waiting: dict[Future, str] = {}
        for key, item in items.items():
            name = f"doedesign-{work.noun}-{work.token}-{key}"
            future = client.submit(_evaluate, held, item, __version__, key=name, pure=False)
            waiting[future] = key
            future.add_done_callback(finished.put)
        while waiting:
            future = _next(finished, client, work.noun, address)
            key = waiting.pop(future)
            yield key, _result(future, work.noun, key, address)


@contextmanager
def _client(address: str) -> "Iterator[Client]":
    try:
        import dask.config
        from distributed import Client
    except ImportError as error:
        cure = 'Install it with: pip install "doedesign[cluster]"'
        raise InputError("scheduler", "a cluster is reached through Dask", "no Dask here", cure) from error
    client, refusal = None, ""
    try:
        client = Client(address, timeout=_PATIENCE_S, set_as_default=False)  # pyright: ignore[reportArgumentType]
    except (OSError, ValueError, ImportError) as error:
        refusal = str(error)
    if client is None:
        # The half-made client closes itself when it is collected, which must not be while the next one is being made:
        # both take the same lock of Dask's.
        gc.collect()
        cure = "Start one with `dask scheduler` and give the address it prints."
        raise InputError(address, "a Dask scheduler must answer there", f'"{refusal}"', cure)
    # A design is larger than what Dask expects in a task.
    with client, dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GB"}):
        try:
            client.wait_for_workers(1, timeout=_PATIENCE_S)
        except TimeoutError as error:
            cure = f"Start some, each with one thread: dask worker {address}"
            raise InputError(address, "the cluster must have workers", "none", cure) from error
        yield client


def _next(finished: "queue.SimpleQueue[Future]", client: "Client", noun: str, address: str) -> "Future":
    """The next future that is done, however long it takes."""
    warned = False
    while True:
        try:
            return finished.get(timeout=_PATIENCE_S)
        except queue.Empty:
            try:
                working = client.nthreads()
            except OSError as error:
                raise _lost(noun, address) from error
            if not working and not warned:
                log.warning(f"no worker is left at {address}; waiting for new ones")
                warned = True


def _result(future: "Future", noun: str, key: str, address: str) -> Any:
    from distributed import KilledWorker
    from distributed.client import FutureCancelledError

    try:
        return named(f"{noun} {key}", future.result)
    except KilledWorker as error:
        got = f"several that ended while they computed it, the last one {error.last_worker.address}"
        cure = f"Give workers more memory, or evaluate it alone. Finished {noun}s are kept."
        raise InputError(f"{noun} {key}", f"a worker must live through a {noun}", got, cure) from error
    except FutureCancelledError as error:
        raise _lost(noun, address) from error
    except ModuleNotFoundError as error:
        cure = f"Install doedesign {__version__} where the workers run."
        raise InputError(address, "the workers must have what the study needs", f'"{error}"', cure) from error


def _lost(noun: str, address: str) -> InputError:
    cure = f"Start it again and repeat the command. Finished {noun}s are kept."
    return InputError(address, "the scheduler must stay reachable", "a lost connection", cure)


# What follows runs in a worker.


def _held(work: Work) -> Work:
    return work


def _evaluate(work: Work, item: Any, version: str) -> Any:
    if version != __version__:
        cure = "Install the same version everywhere."
        raise InputError("worker", f"must have doedesign {version}", __version__, cure)
    if "jax" not in sys.modules:
        os.environ.update(single_thread_settings())
    return work(item)
