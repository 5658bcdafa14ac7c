"""Training goes without the libraries that draw masks, make solids and search: on a cluster they need not be there."""

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BLOCKED = ("cadquery", "OCP", "gdstk", "klayout", "manifold3d", "nlopt", "trimesh")
SCRIPT = f"""
import importlib.abc, sys

class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {BLOCKED}:
            raise ImportError(f"{{name}} is not there")

sys.meta_path.insert(0, Absent())
import doedesign.cli, doedesign.training.train
from tests.recon.small_training import trainer
trainer("train.fabricated=true", "process.errors.overlay_y={{sigma='0.5 um'}}")
trainer('train.freeze="optics"')
"""


def failure_of(script: str) -> str:
    """What a script of its own process says when it fails; nothing if it does not."""
    command = [sys.executable, "-c", textwrap.dedent(script)]
    done = subprocess.run(command, check=False, cwd=ROOT, capture_output=True, text=True, timeout=120)
    return f"exit {done.returncode}: {done.stderr}" if done.returncode else ""


@pytest.mark.slow
def test_without_what_only_drawing_needs() -> None:
    assert failure_of(SCRIPT) == ""


def test_what_is_blocked_is_there_otherwise() -> None:
    """Otherwise the other test would not block anything."""
    assert failure_of(f"from importlib.util import find_spec\nassert all(map(find_spec, {BLOCKED}))") == ""
