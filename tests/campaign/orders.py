"""Orders for `verify`: with a planted defect, or with a drawing that unfolds without bounds in the place of a file."""

import gzip
import hashlib
import shutil
from collections.abc import Iterator

import numpy as np

from tests.campaign.bombs import gds_bombs, oasis_bombs
from tests.campaign.field import Family, Field, said_badly
from tests.campaign.ground import COMMANDS, Ground
from tests.campaign.mutations import MOST_BYTES, REFUSED_S
from tests.campaign.planted import defects


def _bombs(ground: Ground, seed: int, count: int) -> Iterator[str]:
    names = [*gds_bombs(), *oasis_bombs()]
    order = np.random.default_rng(seed).permutation(len(names))
    yield from (names[k] for k in order[:count])


def _exploded(field: Field, case: str) -> list[str]:
    data = {**gds_bombs(), **oasis_bombs()}[case]
    work = field.ground.lay("verify", field.place)
    order, ending = work / "order", case[case.rindex(".") :]
    path = sorted([*order.glob(f"*{ending}"), *order.glob(f"*{ending}.gz")])[-1]
    if path.suffix == ".gz":
        data = gzip.compress(data)
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


def _defects(ground: Ground, seed: int, count: int) -> Iterator[str]:
    names = [defect.name for defect in defects()]
    order = np.random.default_rng(seed).permutation(len(names))
    yield from (names[k] for k in order[:count])


def _planted(field: Field, case: str) -> list[str]:
    defect = next(one for one in defects() if one.name == case)
    work = field.place / "work"
    shutil.rmtree(field.place, ignore_errors=True)
    shutil.copytree(field.ground.base(), work / "order", symlinks=True)
    defect.plant(work / "order")
    end = field.worker.run(COMMANDS["verify"].arguments, field.place)
    problems = said_badly(end)
    if (end.code != 0) != defect.meaningful:
        problems.append(
            f"{'a defect passes' if defect.meaningful else 'a change that means nothing is refused'}: {end}"
        )
    return problems


PLANTED = Family("defects planted in orders, for verify", 60, _defects, _planted)
