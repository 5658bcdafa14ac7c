"""Change one operator or number of the code at a time, and see whether the tests that are meant for it notice.

    python -m tests.mutants                             # of what changed since the last commit
    python -m tests.mutants --since v0.1                # since a tag
    python -m tests.mutants --sample 500 --all          # 500 of everything, chosen by the seed
    python -m tests.mutants doedesign/design/patterns.py

Cosmic Ray makes the changes, in a copy of the project. The tests meant for a file are those that bear its name
(`test_sensor.py`, `test_sensor_noise.py` for `sensor.py`) and those that import it, of the fast tier; a mutant that
survives them meets those of the files that use it. One that survives all, but harms nothing, is listed with the reason
in `mutants.toml`.
"""

import argparse
import ast
import functools
import itertools
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

ROOT = Path(__file__).parents[1]
HARMLESS = Path(__file__).with_suffix(".toml")
# Where a wrong number is a wrong result.
EVERYTHING = (
    "sim/**/*.py",
    "fab/**/*.py",
    "doedesign/design/*.py",
    "doedesign/calibration/*.py",
    "doedesign/tolerancing/*.py",
)
_NONE_SELECTED = 5  # pytest's exit code where all tests of a file are slow ones
_COPIED = ("doedesign", "fab", "sim", "tests", "bench", "examples", "masks", "pyproject.toml", "README.md")
_COPIED += ("CONTRIBUTING.md", "Makefile", "constraints.txt")


class Change(NamedTuple):
    """A way to change a place: an operator of Cosmic Ray and which of its places in the file it is."""

    file: str
    line: int
    operator: Any
    occurrence: int


class Mutant(NamedTuple):
    """A changed file; the lines that differ are without the space around them."""

    file: str
    line: int
    was: str
    now: str
    code: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}\n    - {self.was}\n    + {self.now}"


def places(file: str) -> list[list[Change]]:
    """Every place of a file that can be changed, with its changes. Annotations are left alone."""
    code = (ROOT / file).read_text("utf-8")
    nodes, notes = list(ast_nodes(get_ast(code))), _annotations(code)
    found: dict[tuple[int, int], list[Change]] = defaultdict(list)
    for name in operator_names():
        kind: Any = get_operator(name)
        if kind.arguments():
            continue
        for occurrence, (start, _) in enumerate(at for node in nodes for at in kind().mutation_positions(node)):
            if not any(first <= start < last for first, last in notes):
                found[start].append(Change(file, start[0], kind(), occurrence))
    return [changes for _, changes in sorted(found.items())]


def mutant_of(change: Change) -> Mutant:
    """Make a change."""
    code = (ROOT / change.file).read_text("utf-8")
    new = mutate_code(code, change.operator, change.occurrence) or code
    pairs = zip(code.splitlines(), new.splitlines(), strict=False)
    was, now = next(((a, b) for a, b in pairs if a != b), ("", ""))
    return Mutant(change.file, change.line, was.strip(), now.strip(), new)


def _annotations(code: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Begin and end (line, column) of every annotation."""
    found = []
    for node in ast.walk(ast.parse(code)):
        for note in (getattr(node, "annotation", None), getattr(node, "returns", None)):
            if isinstance(note, ast.expr):
                end = (note.end_lineno or 0, note.end_col_offset or 0)
                found.append(((note.lineno, note.col_offset), end))
    return found


def tests_for(file: str) -> list[list[str]]:
    """Test files meant for a file: with its name or importing it; then those of the nearest files that use it."""
    own, users, seen = _own_tests(file), [file], {file}
    others: dict[str, None] = {}
    while users and not others:
        users = [user for user in _users(users) if user not in seen]
        seen |= set(users)
        others = dict.fromkeys(test for user in users for test in _own_tests(user) if test not in own)
    return [tests for tests in (own, list(others)) if tests]


def _own_tests(file: str) -> list[str]:
    """Test files with the name of a file that mention its package, then others that import it."""
    name, imported, package = Path(file).stem, _imports(file), ".".join(Path(file).parent.parts)
    by_name, importing = [], []
    for test, text in _texts("tests/**/test_*.py").items():
        stem = Path(test).stem
        if (stem == f"test_{name}" or stem.startswith(f"test_{name}_")) and package in text:
            by_name.append(test)
        elif imported.search(text):
            importing.append(test)
    return by_name + importing


def _users(files: Sequence[str]) -> list[str]:
    """Files of the product that import one of these."""
    imports = [_imports(file) for file in files]
    product = {path: text for top in ("fab", "sim", "doedesign") for path, text in _texts(f"{top}/**/*.py").items()}
    return [path for path, text in product.items() if any(imported.search(text) for imported in imports)]


def _imports(file: str) -> re.Pattern[str]:
    module = ".".join(Path(file).with_suffix("").parts).removesuffix(".__init__")
    package, _, name = module.rpartition(".")
    direct, of_package = rf"(from|import) {module}\b", rf"from {package} import (\([^)]*|[^\n]*)\b{name}\b"
    return re.compile(rf"^\s*({direct}|{of_package})".replace(".", r"\."), re.MULTILINE)


@functools.cache
def _texts(pattern: str) -> dict[str, str]:
    """Files of the project and what they hold."""
    return {str(path.relative_to(ROOT)): path.read_text("utf-8") for path in sorted(ROOT.glob(pattern))}


def survives(mutant: Mutant, tree: Path, tests: Sequence[str], limit_s: float) -> bool:
    """Whether tests pass although a file is changed; `tree` is a copy of the project."""
    path = tree / mutant.file
    code = path.read_text("utf-8")
    try:
        path.write_text(mutant.code, "utf-8")
        return _passes(tree, tests, limit_s)
    finally:
        path.write_text(code, "utf-8")


class _Judge:
    """Runs the tests of several mutants at once, each in a copy of the project of its own."""

    def __init__(self, folder: Path, jobs: int) -> None:
        self._folder, self._jobs = folder, jobs
        self._local, self._trees = threading.local(), itertools.count()

    def verdicts(self, mutants: Sequence[Mutant]) -> Iterator[tuple[Mutant, bool | None]]:
        """Every mutant, in their order, with whether it survives; None where no test is meant for it.

        The tests run once on the files as they are: those that fail there judge nothing, and the others tell how long
        they take.
        """
        meant = {file: tests_for(file) for file in {mutant.file for mutant in mutants}}
        every = sorted({test for groups in meant.values() for tests in groups for test in tests})
        with ThreadPoolExecutor(self._jobs) as pool:
            times = dict(zip(every, pool.map(self._seconds, every), strict=True))
            if failing := [test for test, seconds in times.items() if seconds is None]:
                raise SystemExit(f"tests fail on the files as they are: {', '.join(failing)}")

            def lives(mutant: Mutant) -> bool | None:
                groups = meant[mutant.file]
                limits = [30.0 + 3 * sum(times[test] or 0.0 for test in tests) for tests in groups]
                tree = self._tree()
                found = (survives(mutant, tree, *of_it) for of_it in zip(groups, limits, strict=True))
                return all(found) if groups else None

            yield from zip(mutants, pool.map(lives, mutants), strict=True)

    def _seconds(self, test: str) -> float | None:
        """How long the tests of a file take; None if one fails."""
        began = time.monotonic()
        return time.monotonic() - began if _passes(self._tree(), [test], 1800.0) else None

    def _tree(self) -> Path:
        if not hasattr(self._local, "tree"):
            self._local.tree = self._folder / f"tree{next(self._trees)}"
            self._local.tree.mkdir()
            for name in _COPIED:
                source = ROOT / name
                (shutil.copytree if source.is_dir() else shutil.copy2)(source, self._local.tree / name)
        return self._local.tree


def _passes(tree: Path, tests: Sequence[str], limit_s: float) -> bool:
    how = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-m", "not slow"]
    command = [sys.executable, "-B", "-m", "pytest", *how, *tests]
    environment = os.environ | {"PYTHONPATH": str(tree)}
    try:
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, check=False, timeout=limit_s)
    except subprocess.TimeoutExpired:
        return False
    if done.returncode not in (0, 1, 2, _NONE_SELECTED):
        print(done.stdout.decode(errors="replace")[-2000:])
    return done.returncode in (0, _NONE_SELECTED)


def chosen(files: Sequence[str], count: int | None, seed: int) -> list[Mutant]:
    """Mutants of files: one for each place, or for `count` random places, with a random change."""
    rng = np.random.default_rng(seed)
    every = [changes for file in files for changes in places(file)]
    if count is not None and count < len(every):
        every = [every[k] for k in sorted(rng.choice(len(every), count, replace=False))]
    return [mutant_of(changes[rng.integers(len(changes))]) for changes in every]


def _changed_files(since: str) -> list[str]:
    command = ["git", "diff", "--name-only", "--diff-filter=AM", since, "--", *(p.split("*")[0] for p in EVERYTHING)]
    named = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    return [name for name in named if name.endswith(".py")]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run mutants and print those that survive; 1 if one of them is not known to be harmless."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("file", nargs="*", help="files to change")
    parser.add_argument("--all", action="store_true", help="change everything in which a number is a result")
    parser.add_argument("--since", default="HEAD~1", help="change what differs from this commit; the last by default")
    parser.add_argument("--sample", type=int, help="how many places to change; all by default")
    parser.add_argument("--seed", type=int, default=0, help="which places, and how")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="mutants at once")
    asked = parser.parse_args(arguments)
    every = sorted(str(path.relative_to(ROOT)) for pattern in EVERYTHING for path in ROOT.glob(pattern))
    files = asked.file or (every if asked.all else _changed_files(asked.since))
    known = {(one["file"], one["was"], one["now"]): one["why"] for one in tomllib.loads(HARMLESS.read_text())["mutant"]}
    survived, harmless, untested = [], 0, []
    picked = chosen(files, asked.sample, asked.seed)
    print(f"{len(picked)} mutants of {len({m.file for m in picked})} files, seed {asked.seed}", flush=True)
    with tempfile.TemporaryDirectory(prefix="doedesign-mutants-") as folder:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", f"{folder}/compiled")
        judge = _Judge(Path(folder), asked.jobs)
        for number, (mutant, lives) in enumerate(judge.verdicts(picked), 1):
            if lives is None:
                untested.append(mutant)
                print(f"{number}: no test is meant for {mutant}", flush=True)
            elif not lives:
                print(f"{number}: killed {mutant}", flush=True)
            elif why := known.get((mutant.file, mutant.was, mutant.now)):
                harmless += 1
                print(f"{number}: harmless, {why} {mutant}", flush=True)
            else:
                survived.append(mutant)
                print(f"{number}: SURVIVED {mutant}", flush=True)
    lost = len(survived) + len(untested)
    print(f"\n{len(picked) - lost - harmless} killed, {harmless} harmless, {len(survived)} survived", end="")
    print(f", {len(untested)} without a test" if untested else "")
    for mutant in survived + untested:
        print(mutant)
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
