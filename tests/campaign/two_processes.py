"""Two processes on one folder at once: the second waits for nobody, and nothing is mixed up."""

import time
from collections.abc import Iterator

import numpy as np

from tests.campaign.field import Family, Field, said_badly
from tests.campaign.ground import COMMANDS, WRITING, Ground, differences, in_turn
from tests.campaign.process import content


def _cases(ground: Ground, seed: int, count: int) -> Iterator[str]:
    rng = np.random.default_rng(seed)
    for name in in_turn(WRITING, seed, count):
        yield f"{name}:after={rng.uniform(0, ground.whole(name)[1].wall_s):.3f}"


def _problems(field: Field, case: str) -> list[str]:
    name, moment = case.split(":")
    command, whole = COMMANDS[name], field.ground.after(name)
    work = field.ground.lay(name, field.place)
    # Both are warm before they meet.
    for one in (field.worker, field.beside):
        one.run(("--version",), field.place)
    field.worker.begin(command.arguments, field.place)
    time.sleep(float(moment.partition("=")[2]))
    field.beside.begin(command.arguments, field.place)
    ends = field.worker.end(), field.beside.end()
    problems = [wrong for end in ends for wrong in said_badly(end)]
    if 0 not in [end.code for end in ends]:
        problems.append(f"neither has finished: {ends[0]}; {ends[1]}")
    elif wrong := differences(content(work), whole):
        problems.append(f"{wrong[:5]} differ from a quiet run: {ends[0]}; {ends[1]}")
    again = field.worker.run(command.arguments, field.place)
    if again.code != 0 or (wrong := differences(content(work), whole)):
        problems.append(f"the same command again: {again} {differences(content(work), whole)[:5]}")
    return problems


TWO_PROCESSES = Family("the same command twice at once in one folder", 20, _cases, _problems)
