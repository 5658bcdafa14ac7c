"""Every code block of README and documentation runs; the site builds strictly and fetches nothing from elsewhere."""

import contextlib
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from skimage import data

from doedesign.cli import main
from doedesign.templates import template_names, template_text
from sim.store import write_picture
from tests.docs.pages import ROOT, blocks

pytestmark = pytest.mark.slow

# Pages whose commands run, a folder for each row: later pages go on with the runs of earlier ones.
SESSIONS = (
    ("docs/start.md", "README.md"),
    ("docs/tutorial.md", "docs/commands/fabrication.md", "docs/klayout.md", "docs/notebooks.md"),
    ("docs/commands/design.md", "docs/commands/light.md", "docs/commands/network.md", "docs/commands/looking.md"),
    ("docs/tasks/spots.md",),
    ("docs/tasks/areas.md",),
    ("docs/tasks/foci.md",),
    ("docs/tasks/see-through.md",),
    ("docs/tasks/hdr.md", "docs/tasks/wide-aperture.md"),
    ("docs/tasks/tables.md",),
)
# Those with plates of many million cells and networks behind them, with every network of a table, with one design after
# the other, of templates that have tests of their own, or with dozens of commands, each of which has tests of its own.
LENGTHY = (
    "docs/tasks/hdr.md",
    "docs/tasks/tables.md",
    "docs/tasks/foci.md",
    "docs/tutorial.md",
    "docs/commands/design.md",
)
# Compiling a large network takes longer than a few steps of a small one.
CHANGES = ("train.steps=2", "train.validation=1", "network.depth=1", "network.width=3")
SMALL = [word for change in CHANGES for word in ("--set", change)]
# What a full design, a training, a study or a fit takes minutes for is cut short; else commands are as they stand.
DRAWS = "4"
SHORT = {
    "calibrate": ["--errors", "common_depth_scale", "--evaluations", "0"],
    "optimize": ["--set", "optimize.steps=2"],
    "train": SMALL,
    "evaluate": [*SMALL, "--pairs", "2"],
    "examples/snapshot_hdr.py": ["--scenes", "1", "--others", "1", "--case", "without lamps"],
    "examples/snapshot_hdr_network.py": ["--scenes", "1", "--examples", "2", "--steps", "2"],
}
LONG = ("examples/snapshot_hdr", "examples/wide_aperture")
PROGRAMS = {"make", "pip", ".", ".ci/run"}  # make and what installs run in tests of their own


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder like the root of the repository, with what a reader has: pictures, a height map, the right python."""
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    made = tmp_path / "documentation"
    made.mkdir()
    shutil.copytree(ROOT / "examples", made / "examples")
    for name in ("released", "released-raindrop", "released-fence"):
        shutil.copytree(ROOT / "masks" / name, made / "masks" / name)
    for number, name in enumerate(("chelsea", "astronaut", "coffee", "rocket")):
        picture = getattr(data, name)()
        for pictures, shown in (("pictures", picture), ("others", picture[::-1]))[: 1 + number // 2]:
            (made / pictures).mkdir(exist_ok=True)
            Image.fromarray(shown).save(made / pictures / f"{name}_{pictures}.png")
    y, x = np.indices((1101, 1101)) - 550
    for name, side in (("far", 31), ("near", 63)):  # as photographs of a point of light hold them
        write_picture(made / f"measured-{name}.exr", dict.fromkeys("RGB", gaussian(side)))
    np.save(made / "height.npy", np.float32(600e-9) * ((x**2 + y**2) % 8100 / 8100).astype(np.float32))
    return made


def test_every_page_with_commands_runs():
    """No page is forgotten."""
    left_out = {block.page for block in blocks("sh")} - {page for pages in SESSIONS for page in pages}
    # CONTRIBUTING.md has targets of make, and digests of whole sessions.
    assert left_out <= {"CONTRIBUTING.md"}


@pytest.mark.parametrize(
    "pages",
    [pytest.param(pages, marks=pytest.mark.study if pages[0] in LENGTHY else (), id=pages[0]) for pages in SESSIONS],
)
def test_commands_run(pages: tuple[str, ...], folder: Path):
    found = [(page, block) for page in pages for block in blocks("sh") if block.page == page]
    lines = dict.fromkeys(line for _, block in found for line in block.lines)  # what two pages have runs once
    for line in lines:
        words = shlex.split(line)
        if words[0] == "doedesign" and words[1:] != ["--version"]:
            with contextlib.chdir(folder):
                assert main(shortened(words[1:])) == 0, line
        elif words[:3] == ["python", "-m", "pip"]:
            pass  # in a test of the release
        elif words[0] == "jupytext":
            subprocess.run([sys.executable, "-m", *words], cwd=folder, env=environment(), check=True)
        elif words[0] == "python":
            command = [sys.executable, *words[1:], *SHORT.get(words[1], [])]
            subprocess.run(command, cwd=folder, env=environment(), check=True)
        elif words[0] in ("mkdir", "cp"):
            subprocess.run(words, cwd=folder, check=True)
        else:
            assert words[0] in PROGRAMS or words[1:] == ["--version"], line


PYTHON_PAGES = sorted({block.page for block in blocks("python")} - {"CONTRIBUTING.md"})


@pytest.mark.parametrize(
    "page",
    # The session of that page has a test of its own, `tests/test_session.py`.
    [pytest.param(page, marks=pytest.mark.study if page == "docs/notebooks.md" else ()) for page in PYTHON_PAGES],
)
def test_python_of_a_page_runs(page: str, tmp_path: Path):
    """The blocks of a page one after another, in a process of their own (CONTRIBUTING.md: test_additions.py)."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    Image.fromarray(data.chelsea()).save(tmp_path / "cat.jpg")
    program = "\n".join(block.text for block in blocks("python") if block.page == page)
    # Workers of a study import the main program, so it has to know that it is one.
    indented = "".join(f"    {line}\n" for line in program.splitlines())
    (tmp_path / "session.py").write_text(f'if __name__ == "__main__":\n{indented}')
    done = subprocess.run(
        [sys.executable, "session.py"],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    if page == "docs/notebooks.md":
        assert (tmp_path / "masks" / "quick" / "manifest.json").is_file()


def test_the_site_builds_strictly_and_fetches_nothing(tmp_path: Path):
    """No warning, and no address of another server in anything that a page loads."""
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        env={**environment(), "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 25
    for page in pages:
        text = page.read_text("utf-8")
        loaded = re.findall(r"<(?:script|img|iframe|link)\b[^>]*?\b(?:src|href)=[\"']?((?:https?:)?//[^\"'> ]+)", text)
        assert not loaded, page
    for sheet in (tmp_path / "site").rglob("*.css"):
        assert not re.findall(r"(?:url\(|@import )[\"']?(?:https?:)?//", sheet.read_text("utf-8")), sheet


def shortened(command: list[str]) -> list[str]:
    """A command that trains, fits photographs or takes many steps or draws, cut short; any other as it is."""
    name = command[0]
    if "--draws" in command:
        where = command.index("--draws") + 1
        return [*command[:where], DRAWS, *command[where + 1 :]]
    optimises = name == "optimize" and takes_steps(command[1].removesuffix(".toml"))
    fits = name == "calibrate" and command[-1].endswith(".toml")
    return command + (SHORT[name] if optimises or fits or name == "train" or "--train" in command else [])


def takes_steps(name: str) -> bool:
    """Whether a spec takes many steps; some classic plates are given by a formula."""
    return name in LONG or (name in template_names() and bool(re.search(r"(?m)^steps = [1-9]", template_text(name))))


def gaussian(side: int) -> np.ndarray:
    """Counts of a round spot, a sixth of the window wide."""
    squared = (np.indices((side, side)) - side // 2) ** 2
    return (4000 * np.exp(-18 * squared.sum(axis=0) / side**2)).astype(np.float32)


def environment() -> dict[str, str]:
    """The environment of a process that finds the packages of this tree."""
    return {**os.environ, "PYTHONPATH": str(ROOT)}
