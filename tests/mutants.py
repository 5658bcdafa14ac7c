"""Change one operator or number of the code at a time, and see whether the tests that are meant for it notice.

    python -m tests.mutants                             # of what changed since the last commit
    python -m tests.mutants --since v0.1                # since a tag
    python -m tests.mutants --sample 500 --all          # 500 of everything, chosen by the seed
    python -m tests.mutants doedesign/design/patterns.py

Cosmic Ray makes the changes, in a copy of the project. The tests of the fast tier, with `--all`, or else those that are
meant for the files, run once under Coverage, which notes the lines that each of them runs. A mutant first meets the
tests that run its line, the quickest first; if it survives them, all tests of those files, because others of a file may
look at what one of them, or a fixture, has made. A line that is run on import meets the tests with its file's name,
those that import the file, and those of its users. With `--slow`, what survives meets the long tests, too, that have
its file's name or import it. Mutants that survive, but harm nothing, are listed with the reason in `mutants.toml`.
"""

import argparse
import ast
import functools
import itertools
import os
import queue
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names
from coverage import CoverageData

ROOT = Path(__file__).parents[1]
HARMLESS = Path(__file__).with_suffix(".toml")
# Where a wrong number is a wrong result.
EVERYTHING = (
    "sim/**/*.py",
    "fab/**/*.py",
    "doedesign/design/*.py",
    "doedesign/spots/*.py",
    "doedesign/areas/*.py",
    "doedesign/focus/*.py",
    "doedesign/calibration/*.py",
    "doedesign/tolerancing/*.py",
)
_NOT_FOUND, _NONE_SELECTED = (
    4,
    5,
)  # pytest's exit codes where a file breaks on import, and where all tests are slow ones
_QUICK_S, _FILES_S = 60.0, 120.0  # of tests by themselves, and of all tests of files, that a mutant meets
COPIED = ("doedesign", "fab", "sim", "tests", "bench", "examples", "masks", "pyproject.toml", "README.md")
COPIED += ("docs", "mkdocs.yml", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "Makefile")
COPIED += ("constraints.txt", ".ci", ".gitignore")


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


def tests_for(file: str) -> list[str]:
    """Test files meant for a file: with its name or importing it; then those of the nearest files that use it."""
    own, users, seen = _own_tests(file), [file], {file}
    others: dict[str, None] = {}
    while users and not others:
        users = [user for user in _users(users) if user not in seen]
        seen |= set(users)
        others = dict.fromkeys(test for user in users for test in _own_tests(user) if test not in own)
    return [*own, *others]


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


class Coverage(NamedTuple):
    """What the tests do: how long each takes, in seconds, and which of them run each line of a file; "" on import."""

    seconds: dict[str, float]
    running: dict[str, dict[int, list[str]]]

    def tests(self, file: str, line: int) -> list[str]:
        """Tests that run a line, or where that is none of its own, the statement that it is in; the quickest first."""
        lines = self.running.get(file, {})
        near = {line} if line in lines else _statement(file, line)
        found = {test for one in near for test in lines.get(one, ()) if test}
        return sorted(found, key=lambda test: (self.seconds.get(test, 0.0), test))

    def of_file(self, test_file: str) -> float:
        """How long all tests of a file take."""
        return sum(seconds for test, seconds in self.seconds.items() if test.startswith(f"{test_file}::"))


def _statement(file: str, line: int) -> set[int]:
    """Lines of the smallest statement that a line is in."""
    spans = [
        (node.end_lineno - node.lineno, node.lineno, node.end_lineno)
        for node in ast.walk(ast.parse(_texts(file)[file]))
        if isinstance(node, ast.stmt) and node.end_lineno and node.lineno <= line <= node.end_lineno
    ]
    _, first, last = min(spans, default=(0, line, line))
    return set(range(first, last + 1))


def _pytest(tree: Path, arguments: Sequence[str], limit_s: float) -> subprocess.CompletedProcess[bytes]:
    quick = ("-m", "not slow and not study")
    command = [sys.executable, "-B", "-m", "pytest", "-q", "-p", "no:cacheprovider", *quick, *arguments]
    environment = os.environ | {"PYTHONPATH": str(tree), "COVERAGE_FILE": str(tree / "coverage")}
    return subprocess.run(command, cwd=tree, env=environment, capture_output=True, check=False, timeout=limit_s)


def covered(tree: Path, tests: Sequence[str], jobs: int) -> Coverage:
    """Run tests, all by default, on the files as they are."""
    packages = [f"--cov={top}" for top in ("fab", "sim", "doedesign")]
    how = ["-vv", "--durations=0", "-n", str(jobs), "--dist", "loadfile", "--cov-context=test", "--cov-report="]
    done = _pytest(tree, [*how, *packages, *tests], 7200.0)
    said = done.stdout.decode(errors="replace")
    if done.returncode != 0:
        raise SystemExit(f"tests fail on the files as they are:\n{said[-3000:]}")
    seconds: dict[str, float] = defaultdict(float)
    for took, test in re.findall(r"^\s*([\d.]+)s (?:setup|call|teardown)\s+(tests/.*)$", said, re.MULTILINE):
        seconds[test] += float(took)
    data = CoverageData(str(tree / "coverage"))
    data.read()
    running: dict[str, dict[int, list[str]]] = {}
    for name in data.measured_files():
        lines = data.contexts_by_lineno(name)
        found = {line: sorted({one.rpartition("|")[0] for one in contexts}) for line, contexts in lines.items()}
        running[str(Path(name).resolve().relative_to(tree.resolve()))] = found
    return Coverage(dict(seconds), running)


def survives(mutant: Mutant, tree: Path, known: Coverage, slow: bool = False) -> bool | None:
    """Whether all tests pass although a file is changed; None where no test runs its line. `tree` is a copy."""
    quickest = known.tests(mutant.file, mutant.line)
    files = list(dict.fromkeys(test.partition("::")[0] for test in quickest)) or tests_for(mutant.file)
    meant = tests_for(mutant.file)
    files.sort(key=lambda file: (file not in meant, known.of_file(file)))
    if not files:
        return None
    groups = [_first(quickest, known.seconds.get, _QUICK_S), _first(files, known.of_file, _FILES_S)]
    path = tree / mutant.file
    code = path.read_text("utf-8")
    try:
        path.write_text(mutant.code, "utf-8")
        fast = all(_pass(tree, tests, known) for tests in groups if tests)
        return fast and not (slow and _kill(tree, _own_tests(mutant.file)))
    finally:
        path.write_text(code, "utf-8")


def _first(tests: Sequence[str], seconds: Callable[[str], float | None], most_s: float) -> list[str]:
    """As many as take so long together, and at least one."""
    ends = itertools.accumulate(seconds(test) or 0.0 for test in tests)
    return [test for k, (test, end) in enumerate(zip(tests, ends, strict=True)) if end <= most_s or k == 0]


def _pass(tree: Path, tests: Sequence[str], known: Coverage) -> bool:
    expected = sum(known.seconds.get(test) or known.of_file(test) for test in tests)
    try:
        done = _pytest(tree, ["-x", "-p", "no:xdist", *tests], 60.0 + 5 * expected)
    except subprocess.TimeoutExpired:
        return False
    if done.returncode not in (0, 1, 2, _NOT_FOUND, _NONE_SELECTED):
        print(done.stdout.decode(errors="replace")[-2000:])
    return done.returncode in (0, _NONE_SELECTED)


def _kill(tree: Path, tests: Sequence[str]) -> bool:
    """Whether a long test of these files fails."""
    try:
        done = _pytest(tree, ["-x", "-p", "no:xdist", "-m", "slow", *tests], 1800.0) if tests else None
    except subprocess.TimeoutExpired:
        return True
    return done is not None and done.returncode not in (0, _NONE_SELECTED)


def _copy(tree: Path) -> Path:
    """Copy the project."""
    tree.mkdir()
    for name in COPIED:
        source = ROOT / name
        (shutil.copytree if source.is_dir() else shutil.copy2)(source, tree / name)
    return tree


def verdicts(
    mutants: Sequence[Mutant], trees: Sequence[Path], known: Coverage, slow: bool = False
) -> Iterator[tuple[Mutant, bool | None]]:
    """Every mutant, in their order, with whether it survives; as many at once as there are copies of the project."""
    idle: queue.SimpleQueue[Path] = queue.SimpleQueue()
    for tree in trees:
        idle.put(tree)

    def lives(mutant: Mutant) -> bool | None:
        tree = idle.get()
        try:
            return survives(mutant, tree, known, slow)
        finally:
            idle.put(tree)

    with ThreadPoolExecutor(len(trees)) as pool:
        yield from zip(mutants, pool.map(lives, mutants), strict=True)


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
    parser.add_argument("--slow", action="store_true", help="run long tests, too, on what survives")
    asked = parser.parse_args(arguments)
    every = sorted(str(path.relative_to(ROOT)) for pattern in EVERYTHING for path in ROOT.glob(pattern))
    files = asked.file or (every if asked.all else _changed_files(asked.since))
    harmless_ones = {
        (one["file"], one["was"], one["now"]): one["why"] for one in tomllib.loads(HARMLESS.read_text())["mutant"]
    }
    survived, harmless, untested = [], 0, []
    picked = chosen(files, asked.sample, asked.seed)
    print(f"{len(picked)} mutants of {len({m.file for m in picked})} files, seed {asked.seed}", flush=True)
    with tempfile.TemporaryDirectory(prefix="doedesign-mutants-") as folder:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", f"{folder}/compiled")
        trees = [_copy(Path(folder) / f"tree{k}") for k in range(asked.jobs)]
        few = [] if asked.all else sorted({test for mutant in picked for test in tests_for(mutant.file)})
        known = covered(trees[0], few, asked.jobs)
        for number, (mutant, lives) in enumerate(verdicts(picked, trees, known, asked.slow), 1):
            if lives is None:
                untested.append(mutant)
                print(f"{number}: no test is meant for {mutant}", flush=True)
            elif not lives:
                print(f"{number}: killed {mutant}", flush=True)
            elif why := harmless_ones.get((mutant.file, mutant.was, mutant.now)):
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
