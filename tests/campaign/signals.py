"""SIGINT, SIGTERM and SIGHUP at a random moment, then the same command again."""

import signal
from collections.abc import Iterator

import numpy as np

from tests.campaign.field import Family, Field, disturbed
from tests.campaign.ground import Ground
from tests.campaign.kills import moments
from tests.campaign.process import SIGNALS
from tests.campaign.shim import Fault


def _cases(ground: Ground, seed: int, count: int) -> Iterator[str]:
    rng = np.random.default_rng(seed)
    for name, moment in moments(ground, seed, count):
        yield f"{name}:{SIGNALS[rng.integers(len(SIGNALS))].name}:{moment}"


def _problems(field: Field, case: str) -> list[str]:
    name, number, moment = case.split(":")
    kind, _, value = moment.partition("=")
    fault = Fault(call=int(value)) if kind == "call" else Fault(after_s=float(value))
    return disturbed(field, name, fault._replace(number=signal.Signals[number]), (130,), words="interrupted")


SIGNALLED = Family("Ctrl-C, kill and a closed terminal, then the same command again", 40, _cases, _problems)
