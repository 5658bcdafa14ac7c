"""Every picture has a title, and says why its history is not smooth."""

import ast
from pathlib import Path

import pytest

from doedesign.report.history import history_note, plot_history
from doedesign.spec import load_spec

ROOT = Path(__file__).parents[2]
SOURCES = [path for package in ("doedesign", "fab", "sim") for path in sorted((ROOT / package).rglob("*.py"))]


def without_title(function: ast.FunctionDef) -> list[int]:
    """Lines of calls that open a picture without a title, in a function that writes none over its legend either."""
    calls = [node for node in ast.walk(function) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)]
    if any(call.func.id == "legend_above" for call in calls if isinstance(call.func, ast.Name)):
        return []
    opened = [call for call in calls if isinstance(call.func, ast.Name) and call.func.id in ("panels", "single")]
    return [
        call.lineno for call in opened if len(call.args) < 3 and "title" not in {word.arg for word in call.keywords}
    ]


@pytest.mark.slow
def test_every_picture_has_a_title():
    drawing, bare = 0, []
    for path in SOURCES:
        tree = ast.parse(path.read_text("utf-8"))
        taken = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module == "fab.figure"]
        used = {alias.name for node in taken for alias in node.names}
        if not used & {"panels", "single"}:
            continue
        drawing += 1
        functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
        bare += [f"{path.relative_to(ROOT)}:{line}" for one in functions for line in without_title(one)]
    assert drawing > 15
    assert bare == []


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["optimize.colours=in_turn"], "one of 3 colours in turn"),
        (["optimize.colours=together"], "one near and one far depth"),
        (["optimize.colours=together", 'scene.near=["6 mm"]', 'scene.far=["inf"]'], ""),
    ],
)
def test_a_history_says_why_it_zigzags(overrides: list[str], words: str):
    note = history_note(load_spec(ROOT / "examples" / "quick.toml", overrides))
    assert words in note
    assert bool(words) == bool(note)
    records = [{"step": k, "loss": 1.0 + k % 3, "terms": [1.0], "names": ["far_spot"]} for k in range(9)]
    figure = plot_history(records, title="quick", note=note).get_figure(root=True)
    assert figure is not None
    assert figure.get_suptitle() == "quick: loss over the steps"
    assert figure.get_supxlabel().replace("\n", " ") == note


def test_a_history_of_spots_says_why_it_jumps():
    assert "Weights of the spots" in history_note(load_spec(ROOT / "examples" / "cell.toml"))
