"""A new process error is one field of `Variation` and its physics: everything else reads the field."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]

# All that is written to add an error: where, after what, and what.
FIELD = (
    "fab/deviations.py",
    "    repeats: tuple[int, ...] = ()\n",
    """    bath_drift: float = _error(
        "bath", "1", "etches grow too deep by this share while the bath ages", one_sided=True, largest=0.2,
        prior_sigma=0.03, stock=Typical(0.01, 0.005, estimate("a bath that is renewed every week")))
""",
)
PHYSICS = ("sim/surface/relief.py", "(1.0 + variation.common_depth_scale)", " * (1.0 + variation.bath_drift)")

SCRIPT = """
import pytest
from pathlib import Path
from doedesign.build import process_from_spec
from doedesign.calibration.unknowns import unknowns_of
from doedesign.spec import load_process, load_variation, variation_to_toml
from fab.draws import chosen_errors, normal_keys, one_at_a_time_keys, sources_of, variation_at
from fab.errors import InputError
from fab.process import Normal, Variation
from fab.sampling import normal_draw
from fab.stock import STOCK
from sim.surface.relief import relief_of

text = '[process]\\nlevels = 4\\nlevel_step = "75 nm"\\n[process.errors]\\n'
Path("process.toml").write_text(text + "bath_drift = { mean = 0.1, sigma = 0.02 }\\n")
process = process_from_spec(load_process(Path("process.toml")))
assert process.spreads == {"bath_drift": Normal(0.1, 0.02)}
Path("wrong.toml").write_text(text + "bath_drift = 0.3\\n")
with pytest.raises(InputError, match="bath_drift"):
    load_process(Path("wrong.toml"))
assert STOCK["stepper"].errors["bath_drift"].sigma == 0.005

assert sources_of(process) == ("bath",)
assert chosen_errors(process, "bath") == ("bath_drift",)
assert one_at_a_time_keys(process) == ["one_at_a_time/bath_drift/-1", "one_at_a_time/bath_drift/+1"]
draw = variation_at(process, 0, 1e-3, "normal/3")
assert draw.value("bath_drift") == normal_draw(process, 0, 3, 1e-3).bath_drift != 0.1
Path("draw.toml").write_text(variation_to_toml(draw))
assert load_variation(Path("draw.toml")) == draw

unknowns = unknowns_of(process, ["bath"])
assert (unknowns.names, unknowns.mean.tolist(), unknowns.low.tolist()) == (("bath_drift",), [0.1], [0.0])
assert unknowns_of(STOCK["stepper"].process(process.levels), ["bath_drift"]).sigma == pytest.approx(0.005)

nominal = relief_of(process, Variation()).depth_m
assert relief_of(process, Variation(bath_drift=0.1)).depth_m == pytest.approx(1.1 * nominal)
"""


def test_a_new_error_is_one_field_and_its_physics(tmp_path: Path):
    for package in ("fab", "sim", "doedesign"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name, after, text in (FIELD, PHYSICS):
        file = tmp_path / name
        assert file.read_text().count(after) == 1
        file.write_text(file.read_text().replace(after, text + after if after.endswith("\n") else after + text))
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
