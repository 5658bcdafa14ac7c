"""The worked examples of CONTRIBUTING.md: their code is put into a copy of the packages, and each addition is used."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)

# Where the blocks of each example go: a file, and the text that they stand before or after; a new file has none.
PLACES = {
    "A process error": [
        ("fab/deviations.py", "{}    repeats: tuple[int, ...] = ()\n"),
        ("sim/surface/relief.py", "(1.0 + variation.common_depth_scale){}"),
    ],
    "An objective": [
        ("doedesign/spec/values/__init__.py", "OBJECTIVES = (\n{}"),
        ("doedesign/design/objectives.py", "{}\n\ndef far_spot("),
    ],
    "An obstruction": [
        ("sim/obstruction/sticker.py", "{}"),
        ("sim/obstruction/__init__.py", "{}from sim.obstruction.view"),
        ("doedesign/spec/scene.py", '"release_dirt", "folder")\n{}'),
    ],
    "A file of an order": [
        ("fab/solids/profile_file.py", "{}"),
        ("fab/solids/write.py", "KINDS: tuple[ModelKind, ...] = (\n{}"),
    ],
    "A column of the metrics": [("sim/metrics/table.py", "MappingProxyType(\n    {{\n{}")],
}
# Names that the tables list beside what the blocks say.
LISTED = [
    ("sim/obstruction/__init__.py", "ReleaseDirt, MaskFolder)", "ReleaseDirt, MaskFolder, Sticker)"),
    ("fab/solids/write.py", "mesh_files, step_files\n", "mesh_files, profile_file, step_files\n"),
]

HEAD = "import numpy as np, pytest\nfrom pathlib import Path\nQUICK = {quick!r}\n"
USES = {
    "A process error": """
from doedesign.build import process_from_spec
from doedesign.calibration.unknowns import unknowns_of
from doedesign.spec import load_process, load_variation, variation_to_toml
from fab.draws import chosen_errors, normal_keys, one_at_a_time_keys, sources_of, variation_at
from fab.errors import InputError
from fab.process import Normal, Variation
from fab.draws import normal_draw
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
""",
    "An objective": """
import doedesign as dd
spec = dd.load_spec(QUICK, objective=[{"name": "far_peak", "options": {"power": 2.0}}], steps=2)
design = dd.optimize(spec)
assert design.history[-1]["names"] == ["far_peak"]
assert 0 < design.history[-1]["loss"] < 1
""",
    "An obstruction": """
import sim
view = sim.CameraView((64, 48), pixel_m=37e-6, focal_m=8e-3)
drawn = sim.OBSTRUCTIONS["sticker"]().draw(np.random.default_rng(0), view, np.zeros((3, 64, 48), np.float32))
assert drawn.mask.shape == (64, 48) and 0 < drawn.mask.mean() < 1 and 0.05 <= drawn.depth_m <= 0.12
import doedesign as dd
from doedesign.capture.from_spec import obstruction_from_spec
spec = dd.load_spec(QUICK, obstruction={"kind": "sticker", "options": {"diameter": ["6 mm", "7 mm"]}})
assert obstruction_from_spec(spec, QUICK).diameter_m == (6e-3, 7e-3)
""",
    "A file of an order": """
import fab
level = np.random.default_rng(0).integers(0, 4, (24, 24)).astype(np.uint8)
level_map = fab.LevelMap(level, fab.Levels(4, 75e-9), fab.Grid((24, 24), 4e-6), 90e-6, "SMALL")
order = fab.write_order("order", level_map)
assert fab.verify(order).passed
profile = next(Path("order").glob("*_PROFILE.CSV"))
profile.write_bytes(profile.read_bytes().replace(b"e-06", b"e-05", 1))
assert not fab.verify(order).passed
""",
    "A column of the metrics": """
import sim, doedesign as dd
camera = dd.camera_from_spec(dd.load_spec(QUICK))
bank = sim.psf(np.zeros(camera.grid.shape), camera, ["inf"])
np.testing.assert_array_equal(bank.metric("peak")[:, 0], bank.energy[:, 0].max(axis=(-2, -1)))
""",
}


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the packages with all five additions."""
    copy = tmp_path_factory.mktemp("packages")
    for package in ("fab", "sim", "doedesign"):
        shutil.copytree(ROOT / package, copy / package, ignore=shutil.ignore_patterns("__pycache__"))
    chapters = re.split(r"^### ", (ROOT / "CONTRIBUTING.md").read_text(), flags=re.MULTILINE)
    blocks = {chapter.partition("\n")[0]: BLOCK.findall(chapter) for chapter in chapters}
    for name, places in PLACES.items():
        assert len(blocks[name]) == len(places) <= 3
        for (file, place), block in zip(places, blocks[name], strict=True):
            edit(copy / file, place.format(""), place.format(block.rstrip("\n") if place.endswith("){}") else block))
    for file, old, new in LISTED:
        edit(copy / file, old, new)
    return copy


def edit(file: Path, old: str, new: str) -> None:
    """Replace a text that a file holds once; an empty one makes the file."""
    before = file.read_text() if old else ""
    assert not old or before.count(old) == 1, f"{file} holds {old!r} {before.count(old)} times"
    file.write_text(before.replace(old, new) if old else new)


@pytest.mark.parametrize("name", USES)
def test_what_contributing_shows_works(extended: Path, name: str, tmp_path: Path):
    script = HEAD.format(quick=str(ROOT / "examples" / "quick.toml")) + USES[name]
    environment = {**os.environ, "PYTHONPATH": str(extended)}
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
