"""A full disk or quota at every call that changes it, once and for good, then the same command with room again."""

import errno
import itertools
from collections.abc import Iterator

import numpy as np

from tests.campaign.field import Family, Field, disturbed
from tests.campaign.ground import Ground
from tests.campaign.kills import WRITING
from tests.campaign.shim import FULL, Fault

_REMOVALS = ("unlink", "remove", "rmdir")
_LEAST_BYTES = 4096


def _cases(ground: Ground, seed: int, count: int) -> Iterator[str]:
    """Every call of every command in random order; every tenth case limits the size of files instead."""
    rng = np.random.default_rng(seed)
    every, sizes = [], {}
    for name in WRITING:
        folder, end = ground.whole(name)
        calls = sum(call not in _REMOVALS for call in end.calls)
        every += [(name, call) for call in range(1, calls + 1)]
        files = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
        sizes[name] = [size for size in files if size > _LEAST_BYTES]
    order = itertools.cycle(rng.permutation(len(every)))
    for k in range(count):
        if k % 10 == 9:
            name = WRITING[rng.integers(len(WRITING))]
            yield f"{name}:size={int(rng.choice(sizes[name])) - int(rng.integers(1, _LEAST_BYTES))}"
        else:
            name, call = every[next(order)]
            yield f"{name}:call={call}:{errno.errorcode[FULL[rng.integers(2)]]}:{('once', 'stays')[rng.integers(2)]}"


def _problems(field: Field, case: str) -> list[str]:
    name, when, *how = case.split(":")
    value = int(when.partition("=")[2])
    if not how:
        fault, words = Fault(file_bytes=value), ""
    else:
        fault = Fault(call=value, error=getattr(errno, how[0]), stays=how[1] == "stays")
        words = "No space left|quota"
    return disturbed(field, name, fault, (2,), words=words)


FULL_DISK = Family("a full disk or quota at a write, then the same command again", 60, _cases, _problems)
