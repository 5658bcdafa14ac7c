"""The shape of the code, checked by machine: who may import what, and what must stay cheap to start."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SOURCES = sorted(path for package in ("doedesign", "fab", "sim") for path in (ROOT / package).rglob("*.py"))
TREES = {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text("utf-8")) for path in SOURCES}


def imported_modules(tree: ast.AST) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


def loaded_after(statement: str, *modules: str) -> set[str]:
    """Run a statement in a fresh interpreter and tell which of the modules it loaded."""
    check = f"import sys\n{statement}\nprint(*(m for m in {modules!r} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.splitlines()[-1].split())


def test_import_contracts_hold():
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_one_module_touches_openexr():
    users = {name for name, tree in TREES.items() if any(m.split(".")[0] == "OpenEXR" for m in imported_modules(tree))}
    assert users == {"sim/store.py"}


def test_no_pickle_is_loaded_anywhere():
    forbidden = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
    for name, tree in TREES.items():
        assert not {module.split(".")[0] for module in imported_modules(tree)} & forbidden, name
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            allowed = {k.arg: k.value for k in call.keywords}.get("allow_pickle")
            assert allowed is None or (isinstance(allowed, ast.Constant) and allowed.value is False), name


def test_no_star_imports_and_no_empty_files():
    for name, tree in TREES.items():
        assert isinstance(tree, ast.Module)
        assert ast.get_docstring(tree), f"{name} does not say what it is"
        stars = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.names[0].name == "*"]
        assert not stars, name


def test_matplotlib_is_loaded_by_the_first_picture_and_pyplot_never():
    for name, tree in TREES.items():
        assert isinstance(tree, ast.Module)
        at_import = set().union(*(imported_modules(n) for n in tree.body if isinstance(n, ast.Import | ast.ImportFrom)))
        assert not any(module.split(".")[0] == "matplotlib" for module in at_import), name
        assert not any("pyplot" in module for module in imported_modules(tree)), name


@pytest.mark.parametrize(
    "statement",
    [
        "import doedesign, fab, sim",
        "from doedesign.spec import load_spec; load_spec('examples/quick.toml')",
        "import doedesign.cli",
    ],
)
def test_starting_is_cheap(statement: str):
    # Each of these packages takes longer to import than `doedesign --help` may take in all.
    assert loaded_after(statement, "jax", "numba", "matplotlib", "skimage", "klayout.db", "gdstk", "nlopt") == set()


def test_help_runs_without_the_heavy_packages():
    statement = (
        "from doedesign.cli import main\nsys.argv = ['doedesign', '--help']\n"
        "try:\n    main()\nexcept SystemExit as stop:\n    assert not stop.code"
    )
    assert loaded_after(statement, "jax", "numba", "matplotlib", "pint") == set()
