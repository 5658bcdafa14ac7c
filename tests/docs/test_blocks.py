"""What README and documentation show is understood: commands, options, scripts, specs, names of files."""

import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest

from doedesign.cli import app
from doedesign.spec import load_spec
from doedesign.templates import EXAMPLES, template_names, template_text
from tests.docs.pages import LANGUAGES, PAGES, ROOT, Block, blocks

COMMANDS = sorted(name for name in app if not name.startswith("-"))
TASKS = ("objective", "spots", "area", "focus")
# Programs of others that a page may name; what is run is this project's own.
OTHERS = {"pip", "jupytext", "mkdir", "cp"}
DOCS = ROOT / "docs"


def shell_lines() -> list[tuple[str, str]]:
    """Every command of every page, once, and where it stands first."""
    found: dict[str, str] = {}
    for block in blocks("sh"):
        for line in block.lines:
            found.setdefault(line, block.where)
    # Indented lines of masks/README.md and the like are commands, too.
    for page in PAGES:
        for line in re.findall(
            r"(?m)^ {4,}(doedesign \w.*?)(?:  +#.*)?$", page.read_text("utf-8").replace("\\\n", " ")
        ):
            found.setdefault(line, page.name)
    return [(line, where) for line, where in found.items()]


def test_every_block_names_its_language():
    assert not [block.where for block in blocks() if block.language not in LANGUAGES]
    assert not [block.where for block in blocks() if block.note and not block.note.startswith("with: ")]


@pytest.mark.parametrize(("line", "where"), shell_lines(), ids=lambda text: text)
def test_a_command_is_understood(line: str, where: str):
    words = shlex.split(line.replace("~", "/home"))
    match words:
        case [".", script]:
            assert script == ".venv/bin/activate"
        case ["make", target, *variables]:
            assert re.search(rf"(?m)^{target}:", (ROOT / "Makefile").read_text()), where
            assert all("=" in variable for variable in variables)
        case ["doedesign", "--version"]:
            pass
        case ["doedesign", *arguments]:
            app.parse_args(arguments, exit_on_error=False, print_error=False)
        case ["python" | ".venv/bin/python", "-m", module, *_]:
            assert (
                module == "pip"
                or (ROOT / module.replace(".", "/")).exists()
                or (ROOT / f"{module.replace('.', '/')}.py").exists()
            ), where
        case ["python", script, *arguments]:
            text = (ROOT / script).read_text()
            assert not [word for word in arguments if word.startswith("--") and f'"{word}"' not in text], where
        case [".ci/run"]:
            assert (ROOT / ".ci" / "run").is_file()
        case [program, *_]:
            assert program in OTHERS, where


def test_extras_that_pages_name_exist():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = {extra for page in PAGES for extra in re.findall(r"doedesign\[(\w+)\]", page.read_text("utf-8"))}
    assert named
    assert named <= project["optional-dependencies"].keys()


def test_files_that_pages_name_exist():
    text = "\n".join(page.read_text("utf-8") for page in PAGES)
    paths = set(re.findall(r"\b((?:examples|tests|masks)/[\w./-]+\.(?:py|toml|md|csv|json|png|tex))\b", text))
    assert len(paths) > 20
    made = {"examples/results/never"}
    assert not sorted(path for path in paths - made if not (ROOT / path).is_file())


@pytest.mark.parametrize("block", blocks("toml"), ids=lambda block: block.where)
def test_a_fragment_of_a_spec_is_one(block: Block, tmp_path: Path):
    """Its tables take the place of those of the spec that the comment above it names."""
    base = block.note.removeprefix("with: ")
    text = template_text(base) if base in template_names() else (ROOT / "examples" / f"{base}.toml").read_text()
    tables = tomllib.loads(block.text)
    if any(task in tables for task in TASKS):
        parts = re.split(r"(?m)^(?=\[)", text)
        text = "".join(part for part in parts if not re.match(rf"\[+({'|'.join(TASKS)})\]", part))
    (tmp_path / "spec.toml").write_text(text)
    values: dict[str, Any] = {}
    for name, table in tables.items():
        if name in TASKS or isinstance(table, list):
            values[name] = table
        else:
            values |= {f"{name}__{key}": value for key, value in table.items()}
    assert load_spec(tmp_path / "spec.toml", **values).name


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_a_heading_and_an_example(name: str):
    text = "\n".join(page.read_text("utf-8") for page in (DOCS / "commands").glob("*.md"))
    section = re.search(rf"(?ms)^## {name}\n(.*?)(?=^## |\Z)", text)
    assert section, f"no heading of {name} in docs/commands"
    assert re.search(rf"(?m)^doedesign {name}\b", section[1]), f"no example of {name}"


@pytest.mark.parametrize("name", template_names())
def test_every_template_has_its_place_in_the_list(name: str):
    assert f"| `{name}` | " in (DOCS / "tasks/index.md").read_text("utf-8")


@pytest.mark.parametrize("name", sorted({*template_names()} - {*EXAMPLES}))
def test_every_template_has_a_heading_and_an_example(name: str):
    text = "\n".join(page.read_text("utf-8") for page in (DOCS / "tasks").glob("*.md"))
    assert f"{{#{name}}}" in text
    assert f"doedesign new {name}\n" in text


def test_readme_begins_with_the_first_order():
    """The commands of its first screen are those of the script that is timed."""
    commands = [line.split("#")[0].split() for line in (ROOT / "examples/first_order.sh").read_text().splitlines()]
    shown = [line.split("#")[0].split() for line in (ROOT / "README.md").read_text().splitlines()]
    assert [line for line in commands if line[:1] == ["doedesign"]] == [
        line for line in shown if line[:1] == ["doedesign"]
    ]


def test_readme_is_read_in_two_minutes():
    # 250 words a minute, tables and commands included.
    assert len((ROOT / "README.md").read_text("utf-8").split()) < 500
