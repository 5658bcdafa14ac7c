"""Several hosts in one training: how they find each other, what they agree on, and arrays that lie on all of them.

Every host makes the same call, each with its own number: the address HOST:PORT of host 0, the number of hosts, and its
own from 0; or, where the cluster tells (SLURM, Open MPI, Kubernetes, TPU pods), "auto" for the address alone. All of
them see the same folders, and host 0 alone writes. A host that fails takes the others with it after some minutes: they
miss it.

Host 0 listens on that address alone. Whoever reaches it can take part in the training, and stop it: nothing is
encrypted and nobody is asked for a password, so it has to lie in a network whose users are trusted.

With one host, all of this does nothing and costs nothing.
"""

import socket
import time
from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from fab.errors import InputError

_AUTO = "auto"

_Tree = TypeVar("_Tree")


def join_hosts(coordinator: str | None, hosts: int | None = None, host: int | None = None, wait_s: int = 300) -> None:
    """Find the other hosts, before anything asks for devices; a host alone has None for a coordinator.

    Raises:
        InputError: an option is missing or out of range, the cluster says nothing, or the others do not come.
    """
    if coordinator in (None, _AUTO):
        rule, cure = "must be left out with the coordinator auto", "The cluster says it."
        if coordinator is None:
            rule, cure = "must be given with a coordinator", "Add its address, HOST:PORT."
        for name, value in (("hosts", hosts), ("host", host)):
            if value is not None:
                raise InputError(name, rule, value, cure)
    if coordinator is None:
        return
    if coordinator != _AUTO:
        _require_numbers(coordinator, hosts, host)
        if host:
            _require_listening(coordinator, wait_s)
    address = None if coordinator == _AUTO else coordinator
    # Host 0 would listen on all of its addresses.
    bound = address if host == 0 else None
    how = {"initialization_timeout": wait_s, "coordinator_bind_address": bound}
    try:
        jax.distributed.initialize(address, hosts, host, **how)
    # A port in use, a cluster unknown to jax: each comes as an error of its own.
    except (RuntimeError, ValueError) as error:
        raise _not_found(coordinator, wait_s, f'"{str(error).splitlines()[0]}"') from error


def _not_found(coordinator: str, wait_s: float, got: str) -> InputError:
    cure = "Start every host with the same coordinator and number of hosts, and look whether the port is open."
    return InputError(f"coordinator {coordinator}", f"all hosts must find each other within {wait_s} s", got, cure)


def _require_listening(coordinator: str, wait_s: float) -> None:
    """Wait for host 0: jax would end the process without a word of sense if nobody comes."""
    name, _, port = coordinator.rpartition(":")
    end = time.monotonic() + wait_s
    while True:
        try:
            with socket.create_connection((name, int(port)), timeout=max(wait_s, 5)):
                return
        except OSError as error:
            if time.monotonic() > end:
                raise _not_found(coordinator, wait_s, f'"{error}"') from error
        time.sleep(0.2)


def _require_numbers(coordinator: str, hosts: int | None, host: int | None) -> None:
    """Refuse an address without a port, and numbers that are missing or do not fit each other."""
    name, _, port = coordinator.rpartition(":")
    if not name or not port.isdigit() or not 0 < int(port) < 65536:
        cure = "Give the address of host 0 and a free port of it, such as 10.0.0.1:1234."
        raise InputError("coordinator", 'must be HOST:PORT or "auto"', f'"{coordinator}"', cure)
    if hosts is None or hosts < 1:
        got = "nothing" if hosts is None else hosts
        raise InputError("hosts", "must be the number of hosts, 1 or more", got, "Give it.")
    if host is None or not 0 <= host < hosts:
        got = "nothing" if host is None else host
        raise InputError("host", f"must lie from 0 to {hosts - 1}", got, "Give every host its own number.")


def gathered(value: int) -> list[int]:
    """The value of every host, in their order. Each waits here for all."""
    if jax.process_count() == 1:
        return [value]
    from jax.experimental.multihost_utils import process_allgather

    return np.asarray(process_allgather(np.array(int(value)))).tolist()


def parts_of(tree: _Tree, mesh: Mesh) -> _Tree:
    """Arrays whose first axis is shared out over all devices, of which each host hands in its own part."""
    return _placed(tree, NamedSharding(mesh, PartitionSpec(*mesh.axis_names)))


def on_all(tree: _Tree, mesh: Mesh) -> _Tree:
    """The same arrays on every device of every host."""
    return _placed(tree, NamedSharding(mesh, PartitionSpec()))


def _placed(tree: Any, sharding: NamedSharding) -> Any:
    def place(leaf: Any) -> Any:
        whole = isinstance(leaf, jax.Array | np.ndarray | np.generic)
        return jax.make_array_from_process_local_data(sharding, leaf) if whole else leaf

    return jax.tree.map(place, tree)


def own_copy(tree: _Tree) -> _Tree:
    """Arrays that are the same everywhere, as this host's own: what it computes of them, it computes alone."""
    return jax.tree.map(lambda leaf: np.asarray(leaf) if isinstance(leaf, jax.Array) else leaf, tree)
