"""The shape of the code, checked by machine: who may import what, and what must stay cheap to start."""

import ast
import graphlib
import importlib
import inspect
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
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


def module_of(path: str) -> str:
    return path.removesuffix(".py").replace("/", ".").removesuffix(".__init__")


def folder_of(path: str) -> str:
    """The folder of a file; a file directly inside a package is a room of its own."""
    parent = path.rpartition("/")[0]
    return path if "/" not in parent else parent


def run_time(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes that run: pictures name the types of what they draw for the type checker alone."""
    yield tree
    for node in ast.iter_child_nodes(tree):
        if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            yield from run_time(node)


def test_no_circle_between_folders():
    files = {module_of(path): path for path in TREES}
    graph: dict[str, set[str]] = {}
    for path, tree in TREES.items():
        if path.endswith("/__init__.py") and path.count("/") == 1:
            continue  # the face of a package hands on names of all its rooms
        targets = set()
        for node in run_time(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                inner = {f"{node.module}.{alias.name}" for alias in node.names}
                targets |= (inner & files.keys()) or ({node.module} & files.keys())
        graph.setdefault(folder_of(path), set()).update(
            folder_of(files[target]) for target in targets if folder_of(files[target]) != folder_of(path)
        )
    order = graphlib.TopologicalSorter(graph)
    try:
        order.prepare()
    except graphlib.CycleError as error:
        pytest.fail(f"folders import each other: {' -> '.join(error.args[1])}")


def test_no_folder_is_a_heap():
    """About fifteen files, so that a folder can be taken in at a glance."""
    loose = Counter(path.rpartition("/")[0] for path in TREES if not path.endswith("__init__.py"))
    assert {folder: count for folder, count in loose.items() if count > 15} == {}


def test_a_class_is_named_once():
    names = Counter(
        node.name for tree in TREES.values() for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )  # fmt: skip
    assert {name for name, count in names.items() if count > 1} == set()


# Those that change while they work: a tally counts, pictures are decoded when they are needed.
GROWING = {"fab/layout/limits.py: Tally", "doedesign/capture/images.py: Pictures"}


def test_a_dataclass_cannot_be_changed():
    """Results are shared among caches, workers and notebooks; whoever wants another value makes another object."""
    frozen, others = set(), set()
    for path, tree in TREES.items():
        for node in (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)):
            for decorator in node.decorator_list:
                call = decorator if isinstance(decorator, ast.Call) else ast.Call(decorator, [], [])
                if ast.unparse(call.func).rpartition(".")[2] == "dataclass":
                    given = {word.arg: ast.unparse(word.value) for word in call.keywords}
                    (frozen if given.get("frozen") == "True" else others).add(f"{path}: {node.name}")
    assert len(frozen) > 50
    assert others == GROWING


# Who may read or write a format: one room each. gdstk only reads, to prove what was written without it.
IMPORTERS = {
    "OpenEXR": {"sim/store.py"},
    "gdstk": {"fab/gds/gdstk_reader.py"},
    # The picture of marks unites shapes and opens no file; files for direct write are not those of masks.
    "klayout": {"fab/gds/writer.py", "fab/plots/marks.py", "fab/solids/direct_write.py"},
    "imageio": {"fab/pictures.py"},
    "jinja2": {"fab/runsheet/page.py"},
    "tomllib": {"doedesign/spec/__init__.py"},
}


@pytest.mark.parametrize("library", IMPORTERS)
def test_one_room_for_a_file_format(library: str):
    users = {name for name, tree in TREES.items() if any(m.split(".")[0] == library for m in imported_modules(tree))}
    assert users == IMPORTERS[library]


def test_one_room_for_the_kernel_of_solids():
    """Its modules are loaded by name, each when it is used first."""
    assert [name for name in TREES if "OCP" in (ROOT / name).read_text("utf-8")] == ["fab/solids/step.py"]


# TOML tables and command-line options are named where the user's words are read, and nowhere below.
# The reference says them as they are written.
BORDER = ("doedesign/spec/", "doedesign/cli/", "doedesign/commands/", "doedesign/reference/")
USERS_WORDS = re.compile(
    r"(?<![\w-])--[a-z][a-z-]+|\[\[?(process|scene|sensor|wafer|doe|optics|optimize|obstruction|network|train|limit|"
    r"objective)\]\]?"
)


@pytest.mark.parametrize("path", [path for path in TREES if not path.startswith(BORDER)])
def test_no_toml_table_or_option_is_named_below_the_border(path: str):
    said = [
        (node.lineno, found[0])
        for node in ast.walk(TREES[path])
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and (found := USERS_WORDS.search(node.value))
    ]
    assert said == []


def test_no_docstring_is_a_riddle():
    """The first line is a noun phrase or an imperative."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    riddles = [
        f"{path}: {text.splitlines()[0]}"
        for path, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, documented) and (text := ast.get_docstring(node)) and text.startswith("What ")
    ]
    assert riddles == []


@pytest.mark.parametrize("package", ["fab", "sim", "doedesign"])
def test_what_is_public_is_there_typed_and_documented(package: str):
    """Every name of the package's list can be had, and says what it is; every argument of a function is described."""
    module = importlib.import_module(package)
    listed = re.findall(r"import (\w+) as \1$", (ROOT / package / "__init__.pyi").read_text(), re.MULTILINE)
    assert listed
    assert set(listed) <= set(dir(module))
    assert (ROOT / package / "py.typed").exists()
    for name in listed:
        value = getattr(module, name)
        if not callable(value):
            continue
        text = inspect.getdoc(value) or ""
        assert text, name
        if inspect.isfunction(value):
            missing = [p for p in inspect.signature(value).parameters if not re.search(rf"\b{p}\b", text)]
            assert missing == [], f"{package}.{name} does not say what {missing} is"


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
