"""Small runs for tests of what is done with a finished one, and the command line called in this process."""

import contextlib
import io
from pathlib import Path

import pytest

import doedesign.optimization
from doedesign.cli import main
from tests.pictures import leave_out_pictures

# Of a plate with errors, and a limit for it.
SPEC = """
name = "small"

[optics]
focal_length = "1 mm"
wavelengths = ["550 nm"]
design_wavelength = "550 nm"

[doe]
samples = 48
pitch = "1.85 um"
aperture = "88.8 um"
material = "fused_silica"

[process]
levels = 4
level_step = "300 nm"

[process.errors]
overlay_x = "0.4 um"
common_depth_scale = 0.03

[scene]
near = ["6 mm"]
far = ["inf"]

[sensor]
pitch = "1.85 um"
resolution = [640, 480]
window = 32

[optimize]
start = "ring"
steps = 0

[[objective]]
name = "far_spot"

[[limit]]
quantity = "strehl"
min = 0.9
"""

# The same, whose near light should spread.
SPREAD = SPEC.replace('name = "far_spot"\n', 'name = "far_spot"\n\n[[objective]]\nname = "near_spread"\nweight = 2.0\n')


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
