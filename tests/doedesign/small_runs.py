"""Small runs for tests of what is done with a finished one, and the command line called in this process."""

import contextlib
import io
from pathlib import Path

import pytest

import doedesign.optimization
from doedesign.cli import main
from tests.pictures import leave_out_pictures


def call(*arguments: object) -> tuple[int, str, str]:
    """Call a command: its exit code, stdout and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(argument) for argument in arguments])
    return code, out.getvalue(), err.getvalue()


def finished_run(folder: Path, spec: str) -> Path:
    """Optimise a spec into FOLDER/run without its pictures, which are looked at elsewhere."""
    (folder / "small.toml").write_text(spec)
    with pytest.MonkeyPatch.context() as patch:
        leave_out_pictures(patch, doedesign.optimization)
        code, _, said = call("optimize", folder / "small.toml", "--out", folder / "run")
    assert code == 0, said
    return folder / "run"
