"""A design of 64 x 64 cells that goes through every command in a second or two, and the finished results of one.

Tests that change something work on a copy.
"""

import contextlib
import fcntl
import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

import doedesign.optimization
import doedesign.runs.psfs
from doedesign.cli import main
from doedesign.runs.folder import COST_NAME
from tests.orders import GDS_TOO
from tests.pictures import leave_out_pictures

TINY = """
name = "tiny"

[optics]
focal_length = "1 mm"
wavelengths = ["550 nm"]
design_wavelength = "550 nm"

[doe]
samples = 64
pitch = "1.85 um"
aperture = "0.1184 mm"
material = "fused_silica"

[process]
levels = 16
level_step = "75 nm"

[wafer]
dies = [3, 3]

[scene]
near = ["6 mm"]
far = ["0.6 m"]

[sensor]
pitch = "1.85 um"
resolution = [640, 480]
window = 48

[optimize]
start = "ring"
steps = 6
checkpoint_every = 2

[[objective]]
name = "far_spot"

[[objective]]
name = "near_spread"
weight = 2.0
"""


class Done(NamedTuple):
    """What a command left behind: its exit code, stdout, and stderr."""

    code: int
    out: str
    err: str


class Finished(NamedTuple):
    """A finished run (with its PSFs) and its mask order, and what the commands said."""

    run: Path
    order: Path
    said: dict[str, Done]


Cli = Callable[..., Done]


def run_here(*arguments: object) -> Done:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(argument) for argument in arguments])
    return Done(code, out.getvalue(), err.getvalue())


@pytest.fixture(scope="session")
def cli() -> Cli:
    """Run one command in this process."""
    return run_here


# A shell in the background, or nohup, lets its children ignore signals.
_COMMAND = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
from doedesign.cli import main
sys.exit(main())
"""


@pytest.fixture
def start_process() -> Callable[..., subprocess.Popen[str]]:
    """Start one command in a process of its own."""

    def start(*arguments: object) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", _COMMAND, *map(str, arguments)]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    return start


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The spec file."""
    path = tmp_path_factory.mktemp("spec") / "tiny.toml"
    path.write_text(TINY)
    return path


def finish(tiny: Path, folder: Path) -> None:
    """Make a run, its order and its PSFs in a new folder, and write down what the commands said."""
    folder.mkdir()
    run, order = folder / "run", folder / "order"
    said = {
        "optimize": run_here("optimize", tiny, "--out", run),
        "masks": run_here("masks", run, "--levels", 16, "--out", order, *GDS_TOO),
        "verify": run_here("verify", order),
        "psf": run_here("psf", run, "--masks", order, "--json"),
    }
    assert {name: done.code for name, done in said.items()} == dict.fromkeys(said, 0), said
    (folder / "said.json").write_text(json.dumps(said))


@pytest.fixture(scope="session")
def finished(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """The results of optimize, masks, verify and psf, made once for all processes of a session. Not to be changed."""
    folder = tmp_path_factory.mktemp("finished")
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = tmp_path_factory.getbasetemp().parent / "finished"
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "said.json").exists():
            shutil.rmtree(folder, ignore_errors=True)
            finish(tiny, folder)
    said = {name: Done(*done) for name, done in json.loads((folder / "said.json").read_text()).items()}
    return Finished(folder / "run", folder / "order", said)


@pytest.fixture
def copied(finished: Finished, tmp_path: Path) -> Finished:
    """A copy of the finished results, to be changed."""
    shutil.copytree(finished.run, tmp_path / "run")
    shutil.copytree(finished.order, tmp_path / "order")
    return Finished(tmp_path / "run", tmp_path / "order", finished.said)


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes most of the time of a run this small; write a few bytes instead."""
    leave_out_pictures(monkeypatch, doedesign.optimization, doedesign.runs.psfs)


@pytest.fixture(scope="session")
def content() -> Callable[[Path], dict[str, bytes]]:
    """Every file below a folder by its relative name, hidden ones too; but the costs of a run, which a clock writes."""

    def read(folder: Path) -> dict[str, bytes]:
        files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != COST_NAME]
        return {str(p.relative_to(folder)): p.read_bytes() for p in files}

    return read
