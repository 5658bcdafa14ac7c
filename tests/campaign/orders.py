"""Orders for `verify`: drawings that unfold without bounds, in the place of a plate or of the review file."""

import hashlib
from collections.abc import Iterator

import numpy as np

from tests.campaign.bombs import gds_bombs, oasis_bombs
from tests.campaign.field import Family, Field, said_badly
from tests.campaign.ground import COMMANDS, Ground
from tests.campaign.mutations import MOST_BYTES, REFUSED_S


def _bombs(ground: Ground, seed: int, count: int) -> Iterator[str]:
    names = [*gds_bombs(), *oasis_bombs()]
    order = np.random.default_rng(seed).permutation(len(names))
    yield from (names[k] for k in order[:count])


def _exploded(field: Field, case: str) -> list[str]:
    data = {**gds_bombs(), **oasis_bombs()}[case]
    work = field.ground.lay("verify", field.place)
    order, ending = work / "order", case[case.rindex(".") :]
    path = sorted(order.glob(f"*{ending}"))[-1]
    old, new = (hashlib.sha256(content).hexdigest() for content in (path.read_bytes(), data))
    path.write_bytes(data)
    manifest = order / "manifest.json"
    manifest.write_text(manifest.read_text().replace(old, new))
    end = field.worker.run(COMMANDS["verify"].arguments, field.place)
    problems = said_badly(end)
    if end.code not in (1, 2):
        problems.append(f"it is not refused: {end}")
    if end.peak_bytes > MOST_BYTES or end.cpu_s > REFUSED_S:
        problems.append(f"it takes {end.cpu_s:.1f} processor seconds and {end.peak_bytes / 1e9:.1f} GB: {end}")
    return problems


BOMBS = Family("drawings that unfold without bounds, for verify", 20, _bombs, _exploded)
