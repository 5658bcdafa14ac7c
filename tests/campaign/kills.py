"""kill -9, SIGINT, SIGTERM and SIGHUP, then the same command again.

They come at a random moment, or in the middle of a random call that changes the disk.
"""

import signal
from collections.abc import Iterator

import numpy as np

from tests.campaign.field import Family, Field, disturbed
from tests.campaign.ground import WRITING, Ground, in_turn
from tests.campaign.process import SIGNALS
from tests.campaign.shim import Fault


def moments(ground: Ground, seed: int, count: int) -> Iterator[tuple[str, str]]:
    """Commands in turn, each with a call ("call=17") or a time in seconds ("after=0.25")."""
    rng = np.random.default_rng(seed)
    for name in in_turn(WRITING, seed, count):
        end = ground.whole(name)[1]
        if rng.random() < 0.5:
            yield name, f"call={rng.integers(1, len(end.calls) + 1)}"
        else:
            yield name, f"after={rng.uniform(0, 1.1 * end.wall_s):.3f}"


def _kills(ground: Ground, seed: int, count: int) -> Iterator[str]:
    for name, moment in moments(ground, seed, count):
        yield f"{name}:{moment}"


def _killed(field: Field, case: str) -> list[str]:
    name, moment = case.split(":")
    kind, _, value = moment.partition("=")
    killed = (-signal.SIGKILL,)
    if kind == "call":
        return disturbed(field, name, Fault(call=int(value), number=signal.SIGKILL), killed)
    return disturbed(field, name, Fault(), killed, kill_after_s=float(value))


KILLS = Family("kill -9, then the same command again", 40, _kills, _killed)


def _signals(ground: Ground, seed: int, count: int) -> Iterator[str]:
    rng = np.random.default_rng(seed)
    for name, moment in moments(ground, seed, count):
        yield f"{name}:{SIGNALS[rng.integers(len(SIGNALS))].name}:{moment}"


def _signalled(field: Field, case: str) -> list[str]:
    name, number, moment = case.split(":")
    kind, _, value = moment.partition("=")
    fault = Fault(call=int(value)) if kind == "call" else Fault(after_s=float(value))
    return disturbed(field, name, fault._replace(number=signal.Signals[number]), (130,), words="interrupted")


SIGNALLED = Family("Ctrl-C, kill and a closed terminal, then the same command again", 40, _signals, _signalled)
