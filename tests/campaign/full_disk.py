"""A full disk or quota at every call that changes it, once and for good, then the same command with room again."""

import errno
from collections.abc import Iterator

import numpy as np

from tests.campaign.field import Family, Field, disturbed
from tests.campaign.ground import WRITING, Ground, in_turn
from tests.campaign.shim import FULL, REMOVALS, Fault

_LEAST_BYTES = 4096


def _cases(ground: Ground, seed: int, count: int) -> Iterator[str]:
    """Commands in turn, each with all its calls in random order; every tenth case limits the size of files instead."""
    rng, left = np.random.default_rng(seed), {}
    for k, name in enumerate(in_turn(WRITING, seed, count)):
        folder, end = ground.whole(name)
        if k % 10 == 9:
            files = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
            size = rng.choice([size for size in files if size > _LEAST_BYTES])
            yield f"{name}:size={size - rng.integers(1, _LEAST_BYTES)}"
            continue
        if not left.get(name):
            left[name] = list(rng.permutation(sum(call not in REMOVALS for call in end.calls)))
        yield _case(name, left[name].pop() + 1, rng)


def _every_case(ground: Ground, seed: int, count: int) -> Iterator[str]:
    """Every call of every command once, in random order, up to a count; none at all without one."""
    rng = np.random.default_rng(seed)
    if not count:
        return
    calls = [
        (name, call)
        for name in WRITING
        for call in range(1, 1 + sum(call not in REMOVALS for call in ground.whole(name)[1].calls))
    ]
    for k in rng.permutation(len(calls))[:count]:
        name, call = calls[k]
        yield _case(name, call, rng)


def _case(name: str, call: int, rng: np.random.Generator) -> str:
    error, stays = FULL[rng.integers(2)], rng.integers(2)
    return f"{name}:call={call}:{errno.errorcode[error]}:{('once', 'stays')[stays]}"


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
EVERY_WRITE = Family(
    "a full disk at every write once, as many as --count says; 0 by default", 0, _every_case, _problems
)
