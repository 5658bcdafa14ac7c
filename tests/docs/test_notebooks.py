"""The notebooks run from top to bottom, as a user runs them, and what they end cells with shows itself."""

import shutil
from pathlib import Path

import jupytext
import nbclient
import nbformat
import pytest

from tests.docs.pages import ROOT

EXAMPLES = ROOT / "examples"
# Pictures and tables that a reader must see, at least.
SHOWN = {"tutorial": 8, "cookbook": 12}

# The documentation's commands do what the tutorial does; doedesign/test_templates.py has what the cookbook has.
pytestmark = pytest.mark.study


@pytest.mark.parametrize("name", SHOWN)
# ipykernel leaves sockets to the interpreter's end, which pytest would take for this test's.
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_notebook_runs_and_shows_its_results(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    shutil.copytree(EXAMPLES, tmp_path / "examples")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook = jupytext.read(EXAMPLES / f"{name}.py")
    client = nbclient.NotebookClient(
        notebook, timeout=900, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    rich = [output for output in outputs if {"text/html", "image/png"} & output.get("data", {}).keys()]
    assert len(rich) >= SHOWN[name]
    assert not [output for output in outputs if output.output_type == "error"]
    nbformat.validate(notebook)
    if name == "tutorial":
        assert (tmp_path / "masks" / "tutorial_v2" / "manifest.json").is_file()
