"""`doedesign train`: what it leaves behind, stopped and resumed in every way, refused, and what it never looks at."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
from PIL import Image

import doedesign.training.job
import doedesign.training.train
import fab.archive
from doedesign.build import camera_from_spec
from doedesign.capture.images import sample_files
from doedesign.cli import exit_code, main
from doedesign.design.design import Design
from doedesign.recon.weights import read_network
from doedesign.report.history import plot_training
from doedesign.report.sheet import ValidationRow, plot_validation
from doedesign.runs.folder import TRAINING_TABLES
from doedesign.runs.level_maps import drawing_from, open_design
from doedesign.spec import load_spec
from doedesign.training.history import open_board, open_history, read_history
from doedesign.training.joint import Trainer, layout_of
from doedesign.training.train import train
from doedesign.training.validation import split_pictures
from fab.errors import InputError
from fab.figure import save
from fab.files import canonical_json, read_json
from fab.level_map import read_level_map
from fab.pictures import read_display
from sim.psf_bank import psf
from sim.store import read_bank
from tests import compilations
from tests.doedesign.small_runs import finished_run
from tests.pictures import leave_out_pictures, leave_out_pictures_of_orders

ROOT = Path(__file__).parents[2]
# One colour, a network without transforms of its own and a loss of two terms compile in the least time.
SPEC = """
name = "small"
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
levels = 4
level_step = "300 nm"
[scene]
near = ["6 mm", "9 mm"]
far = ["0.6 m"]
occlusion = "paper"
[sensor]
pitch = "1.85 um"
resolution = [640, 480]
window = 32
[obstruction]
kind = "dirt"
[optimize]
start = "ring"
steps = 0
[[objective]]
name = "far_spot"
[network]
width = 2
depth = 1
wiener = false
near_estimate = false
refine = false
[train]
size = 32
steps = 6
perceptual = 0.0
validation = 2
validate_every = 3
checkpoint_every = 2
"""
STEPS = 6


@pytest.fixture(scope="module", autouse=True)
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Programs that one test compiled serve the others, and other processes."""
    with compilations.kept_in(tmp_path_factory.mktemp("compiled")) as folder:
        yield folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished_run(tmp_path_factory.mktemp("small"), SPEC)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six crops of photographs, and a second copy of each under another name."""
    folder = tmp_path_factory.mktemp("images")
    for k, path in enumerate(sample_files()):
        crop = read_display(path, 96)[::-1][20:68, 10:66]
        for copy in "ab":
            Image.fromarray(crop).save(folder / f"{k}{copy}.png")
    return folder


@pytest.fixture(autouse=True)
def plain_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are looked at in a test of their own; drawing them takes longer than all else."""
    leave_out_pictures(monkeypatch, doedesign.training.job)


def changed_design(run: Path, *changes: str) -> Design:
    return open_design(run, False, overrides=changes, free=TRAINING_TABLES)


def trained(run: Path, out: Path, images: Path, *changes: str, **more: Any) -> tuple[int, str]:
    """Train: the exit code, and what was said."""
    said: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("doedesign.cli.console.say", said.append)
        code = exit_code(lambda: train(changed_design(run, *changes), images, out, overrides=changes, **more))
    return code, "\n".join(said)


@pytest.mark.slow
def test_a_plate_of_level_numbers_alone_is_learnt_further(run: Path, images: Path, tmp_path: Path) -> None:
    """From the heights of its levels, which small steps do not leave and great ones do."""
    given = replace(changed_design(run), continuous_m=None)
    design_wave_m = given.levels.count * given.levels.step_m
    for rate, stays in ((1e-6, True), (3.0, False)):
        train(given, images, out := tmp_path / str(rate), steps=2, optics_learning_rate=rate, validate_every=2)
        learnt = open_design(out, False)
        assert learnt.continuous_m is not None
        turns = (learnt.continuous_m - given.height_m) / design_wave_m
        moved = np.abs(np.angle(np.exp(2j * np.pi * turns)))
        assert (moved.max() < 1e-3) == (learnt.level_map.digest == given.level_map.digest) == stays


def content(folder: Path) -> dict[str, Any]:
    """Every file, but for the seconds that steps took."""
    found: dict[str, Any] = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    records = [json.loads(line) for line in found.pop("history.jsonl", b"").splitlines()]
    manifest = json.loads(found.pop("manifest.json"))
    manifest.get("results_sha256", {}).pop("history.jsonl", None)
    return found | {"history": [{k: v for k, v in r.items() if k != "seconds"} for r in records], "manifest": manifest}


@pytest.fixture(scope="module")
def whole(run: Path, images: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training that was never stopped."""
    out = tmp_path_factory.mktemp("whole") / "out"
    with pytest.MonkeyPatch.context() as patch:
        leave_out_pictures(patch, doedesign.training.job)
        code, said = trained(run, out, images)
    assert code == 0, said
    return out


# --- what is there when all is done ---------------------------------------------------------------------------------


def test_what_is_written(run: Path, images: Path, whole: Path):
    results = {
        "network.npz",
        "psf.exr",
        "level_map.npz",
        "height.exr",
        "height_continuous.exr",
        "metrics.json",
        "curves.png",
    }
    names = {"manifest.json", "spec.toml", "pictures.json", "history.jsonl", "validation"} | results
    assert {path.name for path in whole.iterdir()} == names
    assert {path.name for path in (whole / "validation").iterdir()} == {"step_000003.png", "step_000006.png"}
    manifest = read_json(whole / "manifest.json")
    assert (manifest["state"], manifest["occlusion"], manifest["camera"]) == ("done", "paper", "doe")
    assert results | {"spec.toml", "pictures.json", "history.jsonl"} == set(manifest["results_sha256"])
    assert load_spec(whole / "spec.toml") == load_spec(run / "spec.toml")
    network, about = read_network(whole / "network.npz")
    assert network.layout == layout_of(load_spec(run / "spec.toml"), 1)
    assert (about["occlusion"], about["steps"], about["near_m"]) == ("paper", STEPS, [6e-3, 9e-3])
    assert about["far_m"] == pytest.approx(0.6, rel=1e-12)
    bank = read_bank(whole / "psf.exr")
    assert bank.depths_m == (6e-3, 9e-3, 0.6, np.inf)
    assert bank.energy.shape == (1, 4, 33, 33)  # odd, so that a capture lies on its scene


def test_the_history_has_every_step_once(whole: Path):
    records = read_history(whole / "history.jsonl", STEPS)
    assert [record["step"] for record in records] == list(range(STEPS))
    for record in records:
        parts = record["parts"]
        # The terms are added in single precision.
        assert record["loss"] == pytest.approx(parts["l1"] + parts["masked"], rel=1e-6)
        assert record["seconds"] > 0
    rates = [record["learning_rates"] for record in records]
    assert rates[0] == {"network": 1e-4, "optics": 0.02}
    assert rates[-1]["network"] < rates[0]["network"]
    assert [record["step"] for record in records if "validation" in record] == [2, 5]
    metrics = read_json(whole / "metrics.json")
    assert records[-1]["validation"] == {kind: metrics[kind] for kind in ("capture", "reconstruction")}
    assert len(metrics["scenes"]) == 2


def test_the_trained_plate_can_be_ordered(run: Path, whole: Path):
    """As a height map of its own, with other heights than the run's."""
    drawn, before = (drawing_from(folder, 4).level_map for folder in (whole, run))
    assert drawn.aperture_m == before.aperture_m == 0.1184e-3
    # Steps of 0.02 rad move a few of the cells whose height was near the middle of two levels.
    assert 0 < np.mean(drawn.level != before.level) < 0.2


def test_what_is_finished_stays(run: Path, images: Path, whole: Path, tmp_path: Path):
    before = content(whole)
    code, said = trained(run, whole, images)
    assert code == 0
    assert "already holds this finished training" in said
    assert content(whole) == before
    # A manifest that does not list what is finished is no proof of it.
    copy = tmp_path / "copy"
    shutil.copytree(whole, copy)
    manifest = read_json(copy / "manifest.json")
    (copy / "manifest.json").write_bytes(canonical_json({**manifest, "results_sha256": None}))
    code, said = trained(run, copy, images)
    assert code == 2
    assert "must list the results of a finished training" in said


@pytest.mark.slow
def test_pictures_are_drawn(tmp_path: Path, rng: np.random.Generator):
    rows = [ValidationRow(f"{k}.png: 20 dB", *rng.random((3, 3, 300, 200), np.float32)) for k in range(6)]
    save(plot_validation(rows, "small, step 3", "words " * 30), tmp_path / "a.png")
    scores = {
        kind: {region: {"psnr": 20.0} for region in ("full", "occluded")} for kind in ("capture", "reconstruction")
    }
    scores["capture"]["occluded"]["psnr"] = None  # pyright: ignore[reportArgumentType]
    records: list[dict[str, Any]] = [
        {"step": k, "loss": 1 / (k + 1), "parts": {"l1": 0.5 / (k + 1), "masked": 0.1}} for k in range(200)
    ]
    save(plot_training([*records, records[-1] | {"step": 200, "validation": scores}], "small"), tmp_path / "b.png")
    save(plot_training(records, "small"), tmp_path / "c.png")
    sizes = [np.asarray(Image.open(tmp_path / name)).shape for name in ("a.png", "b.png", "c.png")]
    # Four rows at most, each half as high again as wide.
    assert sizes[0][0] > 4 * 1.5 * sizes[0][1] / 3 * 0.9
    assert sizes[1] == sizes[2]
    assert (tmp_path / "b.png").read_bytes() != (tmp_path / "c.png").read_bytes()
    with pytest.raises(ValueError, match="at least one step"):
        plot_training([], "small")


@pytest.mark.study
def test_the_trained_plate_can_be_drawn(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """A training is a run with another plate: its masks are those of the map that it learnt."""
    leave_out_pictures_of_orders(monkeypatch)
    assert main(["masks", str(whole), "--out", str(tmp_path / "order"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["checks"] > 0
    source = read_json(tmp_path / "order" / "manifest.json")["source"]
    assert source["level_map_sha256"] == read_level_map(whole / "level_map.npz").digest


@pytest.mark.study
def test_a_training_without_a_plate_has_no_masks(
    run: Path, images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert trained(run, tmp_path / "out", images, 'train.camera="conventional"', "train.steps=1")[0] == 0
    assert main(["masks", str(tmp_path / "out"), "--out", str(tmp_path / "order")]) == 2
    assert "must hold a plate, level_map.npz" in capsys.readouterr().err


@pytest.mark.study
def test_without_a_folder_the_model_is_what_is_left(run: Path, images: Path, whole: Path):
    """The same training in memory, but for a shorter one that an option asks for."""
    design = open_design(run, levels=4)
    model = train(design, images)
    assert model.folder is None
    learnt, _ = read_network(whole / "network.npz")
    for one, other in zip(jax.tree.leaves(model.network), jax.tree.leaves(learnt), strict=True):
        np.testing.assert_array_equal(one, other)
    assert train(design, images, steps=1).about["steps"] == 1
    with pytest.raises(InputError, match="stepps"):
        train(design, images, stepps=1)
    with pytest.raises(InputError, match="design: must have a spec"):
        train(design.bare(), images)


# --- stopped and resumed ---------------------------------------------------------------------------------------------


def stop_at(monkeypatch: pytest.MonkeyPatch, where: int, stop: Callable[[], None]) -> None:
    """Do something after step number `where` was taken."""
    step = Trainer.step

    def stepping(self: Trainer, state: Any, batch: Any) -> Any:
        number, done = state.step, step(self, state, batch)
        if number == where:
            stop()
        return done

    monkeypatch.setattr(Trainer, "step", stepping)


def interrupt() -> None:
    raise KeyboardInterrupt


def ask() -> None:
    signal.raise_signal(signal.SIGTERM)


@pytest.mark.parametrize(
    ("where", "stop", "done"),
    [(0, interrupt, 0), (3, interrupt, 2), (4, interrupt, 4), (2, ask, 3), (5, ask, 6)],
)
def test_stopped_between_steps(
    run: Path,
    images: Path,
    whole: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    where: int,
    stop: Any,
    done: int,
):
    """An exception loses the steps since the last checkpoint, a signal none; the result is the same to the last bit."""
    with monkeypatch.context() as patch:
        stop_at(patch, where, stop)
        code, said = trained(run, tmp_path / "out", images)
    assert code == 130
    assert "Traceback" not in said
    assert (f"stopped after step {done} of 6" in said) == (stop is ask)
    assert read_json(tmp_path / "out" / "manifest.json")["state"] == "running"
    assert (tmp_path / "out" / "checkpoint.npz").exists() == (done > 0)
    code, said = trained(run, tmp_path / "out", images)
    assert code == 0
    assert (f"resuming after step {done}" in said) == (done > 0)
    assert content(tmp_path / "out") == content(whole)


@pytest.mark.parametrize(
    ("module", "name"),
    [
        (doedesign.training.job, "settled"),  # after the manifest and the spec
        (doedesign.training.job, "write_checkpoint"),  # between a line of history and the checkpoint
        (doedesign.training.job, "plot_validation"),
        (doedesign.training.train, "write_design"),  # when all steps are done
        (doedesign.training.train, "write_network"),  # among the results
        (doedesign.training.job, "plot_training"),
    ],
)
def test_stopped_in_between(
    run: Path, images: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: Any, name: str
):
    with monkeypatch.context() as patch:
        patch.setattr(module, name, lambda *_, **__: interrupt())
        assert trained(run, tmp_path / "out", images)[0] == 130
    assert trained(run, tmp_path / "out", images)[0] == 0
    assert content(tmp_path / "out") == content(whole)


@pytest.mark.slow
def test_stopped_at_every_few_writes(
    run: Path, images: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Twenty attempts in a row are stopped while they force a file or a folder to the disk, each at another one."""
    sync, rng, left = os.fsync, np.random.default_rng(0), [0]

    def stop(handle: int) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        sync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", stop)
        codes = []
        for _ in range(20):
            left[0] = int(rng.integers(0, 24))
            codes.append(trained(run, tmp_path / "out", images)[0])
    assert 130 in codes[:3]
    assert set(codes) <= {0, 130}
    assert trained(run, tmp_path / "out", images)[0] == 0
    assert content(tmp_path / "out") == content(whole)


SCRIPT = """
import sys, time
from pathlib import Path
import doedesign.training.job as job
from doedesign.cli import exit_code
from doedesign.runs.level_maps import open_design
from doedesign.training.joint import Trainer
from doedesign.training.train import train
from fab.files import write_atomic

step = Trainer.step
def slowly(self, state, batch):
    time.sleep(0.3)  # long enough to be told between two lines of history
    return step(self, state, batch)
Trainer.step = slowly
for name in ("plot_training", "plot_validation"):
    setattr(job, name, lambda *_: None)
job.save = lambda _, path: write_atomic(path, b"picture")
run, out, images = map(Path, sys.argv[1:])
sys.exit(exit_code(lambda: train(open_design(run, False), images, out)))
"""


@pytest.mark.study
@pytest.mark.parametrize(("kind", "code"), [(signal.SIGTERM, 130), (signal.SIGKILL, -9)])
def test_a_process_that_is_told_to_end(
    run: Path, images: Path, whole: Path, tmp_path: Path, compiled_once: Path, kind: signal.Signals, code: int
):
    settings = {"JAX_COMPILATION_CACHE_DIR": str(compiled_once), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    arguments = [sys.executable, "-c", textwrap.dedent(SCRIPT), run, tmp_path / "out", images]
    process = subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True, cwd=ROOT, env=os.environ | settings)
    history, end = tmp_path / "out" / "history.jsonl", time.monotonic() + 120
    while not (history.exists() and history.read_bytes().count(b"\n") >= 3):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.01)
    process.send_signal(kind)
    _, said = process.communicate(timeout=60)
    assert process.returncode == code, said
    assert "Traceback" not in said
    assert read_json(tmp_path / "out" / "manifest.json")["state"] == "running"
    code, said = trained(run, tmp_path / "out", images)
    assert code == 0
    assert "resuming after step" in said
    assert content(tmp_path / "out") == content(whole)


def test_a_disk_that_fills_up(run: Path, images: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The training stands at its last checkpoint, and goes on when there is room again."""
    write, room = fab.archive.write_atomic, iter(range(2))

    def filling(path: Path, data: bytes) -> None:
        if next(room, None) is None:
            with monkeypatch.context() as patch:
                patch.setattr(os, "fsync", full)
                write(path, data)
        write(path, data)

    def full(_handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(fab.archive, "write_atomic", filling)
        code, said = trained(run, tmp_path / "out", images)
    assert code == 2
    assert "checkpoint.npz: the disk must have room" in said
    assert "No space left" in said
    code, said = trained(run, tmp_path / "out", images)
    assert code == 0
    assert "resuming after step 4" in said
    assert content(tmp_path / "out") == content(whole)


@pytest.mark.slow
def test_numbers_that_are_not_finite(run: Path, images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The checkpoint before them is kept, and its place is told."""
    step = Trainer.step

    def breaking(self: Trainer, state: Any, batch: Any) -> Any:
        state, record = step(self, state, batch)
        return state._replace(free=state.free * np.nan) if state.step == 4 else state, record

    monkeypatch.setattr(Trainer, "step", breaking)
    code, said = trained(run, tmp_path / "out", images)
    assert code == 2
    assert "step 4" in said
    assert "must stay finite" in said
    assert "train.learning_rate" in said
    monkeypatch.undo()
    _, said = trained(run, tmp_path / "out", images)
    assert "resuming after step 2" in said


def test_lines_of_steps_that_no_checkpoint_knows_are_dropped(tmp_path: Path):
    path = tmp_path / "history.jsonl"
    with open_history(path, 0) as history:
        for step in range(5):
            history.add({"step": step})
    with path.open("ab") as stream:
        stream.write(b'{"step": 5, "lo')
    with open_history(path, 3) as history:
        history.add({"step": 3})
    assert read_history(path, 10) == [{"step": k} for k in range(4)]
    path.write_bytes(b"[]\n")
    with pytest.raises(InputError, match=r"line 1.*record of a step"):
        read_history(path, 10)


# --- what is trained on ----------------------------------------------------------------------------------------------


def test_held_out_pictures_are_never_trained_on(
    run: Path, images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Nor their copies under other names."""
    seen: set[str] = set()
    step = Trainer.step

    def noting(self: Trainer, state: Any, batch: Any) -> Any:
        seen.update(item.name for item in batch.items)
        return step(self, state, batch)

    monkeypatch.setattr(Trainer, "step", noting)
    assert trained(run, tmp_path / "out", images, licence="CC0")[0] == 0
    names = read_json(tmp_path / "out" / "pictures.json")
    assert names["licence"] == read_json(tmp_path / "out" / "manifest.json")["licence"] == "CC0"
    held_out = {name[0] for name in names["held_out"]}
    assert len(names["held_out"]) == 2
    assert len(names["training"]) == 12 - 2 * len(held_out)
    assert seen <= set(names["training"])
    assert not held_out & {name[0] for name in seen}
    assert {scene["name"][0] for scene in read_json(tmp_path / "out" / "metrics.json")["scenes"]} <= held_out


def test_a_folder_of_their_own(images: Path, tmp_path: Path):
    split = split_pictures(images, None, 3, 0)
    assert split == split_pictures(images, None, 3, 0)
    assert split.held_out != split_pictures(images, None, 3, 1).held_out
    own = tmp_path / "own"
    own.mkdir()
    for name in ("0a.png", "1a.png"):
        (own / f"copy of {name}").write_bytes((images / name).read_bytes())
    split = split_pictures(images, own, 1, 0)
    assert len(split.held_out) == 1
    assert {path.name[0] for path in split.training} == set("2345")
    with pytest.raises(InputError, match="only those held out"):
        split_pictures(own, own, 2, 0)
    (own / "copy of 1a.png").unlink()
    with pytest.raises(InputError, match="one picture to train on and one to hold out"):
        split_pictures(own, None, 2, 0)


def test_scikit_images_pictures_are_enough():
    """Eight are held out by default, of which there are six."""
    split = split_pictures(None, None, 8, 0)
    assert len(split.training) == len(split.held_out) == 3


@pytest.mark.study
@pytest.mark.parametrize(
    ("change", "height", "continuous", "network"),
    [
        ("train.camera=conventional", None, False, True),
        ("train.freeze=optics", True, False, True),
        ("train.freeze=network", False, True, False),
    ],
)
def test_what_stays_at_rest(
    run: Path, images: Path, tmp_path: Path, change: str, height: bool | None, continuous: bool, network: bool
):
    """`height` tells whether the plate drawn is the run's, or that there is none."""
    out = tmp_path / "out"
    code, said = trained(run, out, images, change, "train.steps=2", "train.learning_rate=1e-3")
    assert code == 0, said
    assert (out / "height_continuous.exr").exists() == continuous
    if height is None:
        assert not (out / "height.exr").exists()
    else:
        drawn, before = (drawing_from(folder, 4).level_map.level for folder in (out, run))
        assert np.array_equal(drawn, before) == height
    moved, _ = read_network(out / "network.npz")
    fresh = jax.tree.leaves(Trainer.initial(_still(run), np.zeros((2, 2), np.float32)).network)
    assert any(not np.array_equal(a, b) for a, b in zip(jax.tree.leaves(moved), fresh, strict=True)) == network
    camera = camera_from_spec(load_spec(run / "spec.toml"))
    flat = psf(np.zeros((64, 64), np.float32), replace(camera, window=33), (np.inf,)).energy
    assert np.array_equal(read_bank(out / "psf.exr").energy[:, -1:], flat) == (height is None)


def _still(run: Path) -> Any:
    """As much of a trainer as makes a fresh network."""
    spec = load_spec(run / "spec.toml")
    bench = SimpleNamespace(camera=SimpleNamespace(colours=(1,)))
    return SimpleNamespace(
        spec=spec,
        bench=bench,
        mesh=None,
        doe=SimpleNamespace(parametrization=None),
    )


# --- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (["process.levels=8"], ["--set", "another process", "[network], [train]"]),
        (["sensor.binning=2"], ["--set", "sensor.binning"]),
        (["train.size=484"], ["train.size", "480 binned pixels"]),
    ],
)
def test_what_is_refused(run: Path, images: Path, tmp_path: Path, changes: list[str], words: list[str]):
    code, said = trained(run, tmp_path / "out", images, *changes)
    assert code == 2
    for word in words:
        assert word in said
    assert not (tmp_path / "out").exists()


def test_what_must_be_named_and_whole(run: Path, images: Path, tmp_path: Path):
    bare = SPEC.replace('occlusion = "paper"', "").replace('[obstruction]\nkind = "dirt"', "")
    other = finished_run(tmp_path, bare)
    code, said = trained(other, tmp_path / "out", images)
    assert (code, "scene.occlusion" in said) == (2, True)
    code, said = trained(other, tmp_path / "out", images, "scene.occlusion=paper")
    assert (code, "obstruction.kind" in said) == (2, True)
    code, said = trained(run, tmp_path / "out", images, lpips_weights=[tmp_path / "none.npz"])
    assert (code, "none.npz" in said) == (2, True)
    code, said = trained(run, tmp_path / "out", images, devices=64)
    assert (code, "devices: must lie" in said) == (2, True)


def test_folders_of_others_are_left_alone(run: Path, images: Path, whole: Path, tmp_path: Path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    (tmp_path / "mine" / "validation" / ".thumbs").mkdir(parents=True)
    (tmp_path / "mine" / "validation" / ".gitkeep").touch()
    code, said = trained(run, tmp_path / "mine", images)
    assert (code, "other content" in said) == (2, True)
    assert sorted(path.name for path in (tmp_path / "mine").rglob("*")) == [
        ".gitkeep",
        ".thumbs",
        "thesis.tex",
        "validation",
    ]
    before = content(whole)
    for changes in (["train.seed=1"], ["scene.occlusion=radiometric"]):
        code, said = trained(run, whole, images, *changes)
        assert (code, "must belong to this training" in said) == (2, True)
    code, said = trained(run, whole, images.parent)
    assert (code, "must belong to this training" in said) == (2, True)
    assert content(whole) == before


def test_files_that_were_changed(run: Path, images: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    network = (whole / "network.npz").read_bytes()
    (whole / "network.npz").write_bytes(network[:-1])
    code, said = trained(run, whole, images)
    (whole / "network.npz").write_bytes(network)
    assert (code, "network.npz: must be the file this training wrote" in said) == (2, True)
    with monkeypatch.context() as patch:
        stop_at(patch, 3, interrupt)
        trained(run, tmp_path / "out", images)
    checkpoint = tmp_path / "out" / "checkpoint.npz"
    data = bytearray(checkpoint.read_bytes())
    data[len(data) // 2] ^= 1
    checkpoint.write_bytes(data)
    code, said = trained(run, tmp_path / "out", images)
    assert (code, "whole checkpoint" in said, "Remove checkpoint.npz" in said) == (2, True, True)
    checkpoint.unlink()
    assert trained(run, tmp_path / "out", images)[0] == 0
    assert content(tmp_path / "out") == content(whole)


# --- TensorBoard -----------------------------------------------------------------------------------------------------


def test_tensorboard_is_asked_for_where_it_is_missing(run: Path, images: Path, tmp_path: Path):
    if find_spec("tensorboardX"):
        pytest.skip("tensorboardX is installed")
    code, said = trained(run, tmp_path / "out", images, tensorboard=True)
    assert (code, "pip install tensorboardX" in said) == (2, True)
    assert not (tmp_path / "out").exists()


def test_what_tensorboard_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    told: list[Any] = []

    class Writer:
        def __init__(self, folder: str, purge_step: int) -> None:
            told.append((Path(folder).name, purge_step))

        def add_scalar(self, *scalar: Any) -> None:
            told.append(scalar)

        def close(self) -> None:
            told.append("closed")

    fake = SimpleNamespace(SummaryWriter=Writer, __spec__=SimpleNamespace())
    monkeypatch.setitem(sys.modules, "tensorboardX", fake)
    with open_board(tmp_path / "tensorboard", 4) as add:
        add({"step": 4, "loss": 0.5, "parts": {"l1": 0.25}, "validation": {"capture": {"full": {"psnr": None}}}})
    assert told == [("tensorboard", 4), ("loss", 0.5, 4), ("parts/l1", 0.25, 4), "closed"]
