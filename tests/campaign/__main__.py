"""Disturb every command in every way, and print what did not stand it.

    python -m tests.campaign                                # minutes, all families
    python -m tests.campaign kills full_disk --count 1000   # hours
    python -m tests.campaign --replay kills:masks:call=17   # one case again; its folder is kept

A seed that nobody chose beforehand is taken unless one is given, and printed. Exit code 1 if a case failed.
"""

import argparse
import itertools
import os
import secrets
import shutil
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from tests.campaign.field import Field, clear
from tests.campaign.full_disk import EVERY_WRITE, FULL_DISK
from tests.campaign.ground import Ground
from tests.campaign.kills import KILLS, SIGNALLED
from tests.campaign.mutations import MUTATIONS
from tests.campaign.orders import BOMBS, PLANTED
from tests.campaign.process import Worker
from tests.campaign.two_processes import TWO_PROCESSES

FAMILIES = {
    "kills": KILLS,
    "signals": SIGNALLED,
    "full_disk": FULL_DISK,
    "every_write": EVERY_WRITE,
    "two_processes": TWO_PROCESSES,
    "mutations": MUTATIONS,
    "bombs": BOMBS,
    "planted": PLANTED,
}


class Result(NamedTuple):
    """A case, what is wrong after it, and how long it took."""

    family: str
    case: str
    problems: list[str]
    seconds: float


class Campaign:
    """Cases that run on several fields at once, on one ground."""

    def __init__(self, folder: Path, jobs: int) -> None:
        self._folder, self._jobs = folder, jobs
        self._local, self._fields, self._numbers = threading.local(), [], itertools.count()
        self._worker = Worker(folder / "said")
        self.ground = Ground(folder, self._worker)

    def _field(self) -> Field:
        if not hasattr(self._local, "field"):
            self._local.field = Field(self.ground, self._folder / f"field{next(self._numbers)}")
            self._fields.append(self._local.field)
        return self._local.field

    def case(self, family: str, case: str, keep: bool = False) -> Result:
        """Run one case; its folder is kept if asked for, or if it fails."""
        field, began = self._field(), time.monotonic()
        problems = FAMILIES[family].problems(field, case)
        seconds = time.monotonic() - began
        if problems or keep:
            kept = self._folder / "kept" / f"{family}:{case}".replace("/", "_")
            clear(kept)
            kept.parent.mkdir(exist_ok=True)
            shutil.copytree(field.place, kept, symlinks=True, ignore=lambda *_: [], dirs_exist_ok=True)
        return Result(family, case, problems, seconds)

    def run(self, family: str, seed: int, count: int) -> list[Result]:
        """Run cases of one family; those that fail are printed as they do."""
        cases = list(FAMILIES[family].cases(self.ground, seed, count))
        found = []
        with ThreadPoolExecutor(self._jobs) as pool:
            for result in pool.map(self.case, itertools.repeat(family), cases):
                found.append(result)
                print(f"\r{family}: {len(found)}/{len(cases)} ", end="", file=sys.stderr, flush=True)
                for problem in result.problems:
                    print(f"\n{family}:{result.case}\n    {problem}", flush=True)
        return found

    def stop(self) -> None:
        """End all processes."""
        for one in (self._worker, *self._fields):
            one.stop()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the campaign; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaign", description=(__doc__ or "").partition("\n")[0])
    about = "; ".join(f"{name}: {family.about}" for name, family in FAMILIES.items())
    parser.add_argument("family", nargs="*", help=f"{about}; all by default")
    parser.add_argument("--count", type=int, help="cases of each family; some minutes' worth by default")
    parser.add_argument("--seed", type=int, help="where the cases come from; a new one by default")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="cases at once")
    parser.add_argument("--replay", metavar="CASE", action="append", help="run this case alone")
    parser.add_argument("--folder", type=Path, help="where to work; a temporary folder by default")
    asked = parser.parse_args(arguments)
    if unknown := [name for name in asked.family if name not in FAMILIES]:
        parser.error(f"there is no family {unknown[0]}; there are {', '.join(FAMILIES)}")
    seed = secrets.randbelow(2**32) if asked.seed is None else asked.seed
    folder = asked.folder or Path(tempfile.mkdtemp(prefix="doedesign-campaign-"))
    folder.mkdir(parents=True, exist_ok=True)
    # Programs are compiled once for all processes.
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "compiled"))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
    print(f"seed {seed}; laying the ground in {folder}", flush=True)
    campaign = Campaign(folder, asked.jobs)
    try:
        if asked.replay:
            results = [campaign.case(*case.split(":", 1), keep=True) for case in asked.replay]
        else:
            results = []
            for name in asked.family or FAMILIES:
                count = FAMILIES[name].usual if asked.count is None else asked.count
                results += campaign.run(name, seed, count)
    finally:
        campaign.stop()
    print(f"\n\n{table(results)}")
    failed = [result for result in results if result.problems]
    for result in failed:
        print(f"\n{result.family}:{result.case}")
        for problem in result.problems:
            print(f"    {problem}")
        print(f"    replay: python -m tests.campaign --replay '{result.family}:{result.case}'")
    if failed or asked.replay or asked.folder:
        print(f"\nfolders of the cases: {folder / 'kept'}")
    else:
        shutil.rmtree(folder, ignore_errors=True)
    return 1 if failed else 0


def table(results: Sequence[Result]) -> str:
    """Cases, failures and times by family."""
    lines = [f"{'':16}{'cases':>8}{'failed':>8}{'median s':>10}{'longest s':>11}"]
    for name in dict.fromkeys(result.family for result in results):
        of_it = [result for result in results if result.family == name]
        times = [result.seconds for result in of_it]
        failed = sum(bool(result.problems) for result in of_it)
        lines.append(f"{name:16}{len(of_it):8}{failed:8}{statistics.median(times):10.2f}{max(times):11.1f}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
