"""`doedesign finetune`: what it learns, what it leaves behind, stopped and resumed, and what it refuses."""

import json
import shutil
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from scipy.signal import convolve2d

import doedesign.training.job
from doedesign.cli import exit_code, main
from doedesign.recon.model import Model
from doedesign.recon.network import Network, NetworkShape
from doedesign.recon.photos import read_capture, write_reconstruction
from doedesign.recon.weights import read_network, write_network
from doedesign.training.finetune import FineTuning, finetune, mirrored_as
from doedesign.training.history import read_history
from doedesign.training.pairs import PairData, Pairs, find_pairs, read_pair, split_pairs
from fab.errors import InputError
from fab.files import read_json, sha256_file
from sim.light import linear_from_srgb, srgb_from_linear
from sim.psf_bank import PsfBank
from sim.store import read_bank, write_bank, write_picture
from tests import compilations
from tests.pictures import leave_out_pictures

PIXEL = 3.7e-6
ABOUT = {"run": "small", "colours": ["550nm"], "wavelengths_m": [550e-9], "pixel_m": PIXEL, "near_m": [0.05, 0.12]}
# One colour, a network without transforms of its own and a loss of two terms compile in the least time.
LAYOUT = NetworkShape(colours=1, width=2, depth=1, wiener=False, near_estimate=False, refine=False)
SPEC = """
name = "small"
[optics]
focal_length = "8 mm"
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
near = ["5 cm", "12 cm"]
far = ["5 m"]
[sensor]
pitch = "1.85 um"
resolution = [640, 480]
window = 33
[[objective]]
name = "far_spot"
[train]
size = 32
learning_rate = 1e-2
perceptual = 0.0
checkpoint_every = 2
validate_every = 3
"""
STEPS = 6


@pytest.fixture(scope="module", autouse=True)
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Programs that one test compiled serve the others."""
    with compilations.kept_in(tmp_path_factory.mktemp("compiled")) as folder:
        yield folder


def bank(colours=("550nm",), depths=(0.05, 0.12, 5.0, np.inf), pixel=PIXEL, window=7) -> PsfBank:
    energy = np.random.default_rng(0).uniform(0, 1, (len(colours), len(depths), window, window))
    energy *= 0.8 / energy.sum(axis=(2, 3), keepdims=True)
    return PsfBank(energy.astype(np.float32), colours, depths, pixel)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model with the spec that it was trained with."""
    folder = tmp_path_factory.mktemp("model")
    write_network(folder / "network.npz", Network.make(LAYOUT, 0), ABOUT)
    write_bank(folder / "psf.exr", bank())
    (folder / "spec.toml").write_text(SPEC)
    return folder


def scene(k: int, shape: tuple[int, int] = (36, 44)) -> np.ndarray:
    """Display values of soft blobs in three colours, 0.2 to 0.8."""
    rng = np.random.default_rng(k)
    y, x = (np.linspace(0, 1, n) for n in shape)
    phases, rates = rng.uniform(0, 6, (3, 2)), rng.uniform(3, 12, (3, 2))
    waves = [
        np.outer(np.cos(ry * y + py), np.cos(rx * x + px)) for (py, px), (ry, rx) in zip(phases, rates, strict=True)
    ]
    return (0.5 + 0.3 * np.stack(waves)).astype(np.float32)


def dimmed(display: np.ndarray) -> np.ndarray:
    """What the camera makes of a scene, in display values: half of its light, and a veil."""
    return srgb_from_linear(0.5 * linear_from_srgb(display) + 0.1).astype(np.float32)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six pairs of unlike sizes and kinds, one with a mask."""
    folder = tmp_path_factory.mktemp("pairs")
    for k in range(6):
        display = scene(k, (36 + k, 44))
        write_reconstruction(folder / f"{k}_reference.png", display, 16)
        write_reconstruction(
            folder / f"{k}_capture{('.png', '.exr', '.tif')[k % 3]}", dimmed(display), (16, None, 8)[k % 3]
        )
    write_reconstruction(folder / "2_mask.png", np.eye(38, 44, dtype=np.float32)[None], 8)
    (folder / "notes.txt").write_text("taken on a dull day")
    return folder


def tuned(model: Path, pairs: Path, out: Path, *, drawn: bool = False, **options: Any) -> tuple[int, str]:
    """Fine-tune: the exit code, and what was said. Drawing takes longer than all else, so it is left out."""
    said: list[str] = []
    how = {"steps": STEPS, "validation": 2, **options}
    files, lengths = how.pop("psf", ()), {name: how.pop(name) for name in ("pixel_m", "near_m", "far_m") if name in how}

    def work() -> None:
        opened = Model.open(model)
        finetune(opened, pairs, out, psfs=opened.psfs(files, **lengths), **how)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("doedesign.cli.console.say", said.append)
        if not drawn:
            leave_out_pictures(patch, doedesign.training.job)
        code = exit_code(work)
    return code, "\n".join(said)


def content(folder: Path) -> dict[str, Any]:
    """Every file, but for the seconds that steps took."""
    found: dict[str, Any] = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    records = [json.loads(line) for line in found.pop("history.jsonl", b"").splitlines()]
    manifest = json.loads(found.pop("manifest.json"))
    manifest.get("results_sha256", {}).pop("history.jsonl", None)
    return found | {"history": [{k: v for k, v in r.items() if k != "seconds"} for r in records], "manifest": manifest}


@pytest.fixture(scope="module")
def whole(model: Path, pairs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fine-tuning that was never stopped."""
    out = tmp_path_factory.mktemp("whole") / "out"
    code, said = tuned(model, pairs, out)
    assert code == 0, said
    return out


# --- what is there when all is done ---------------------------------------------------------------------------------


def test_what_is_written(model: Path, pairs: Path, whole: Path):
    results = {"network.npz", "psf.exr", "metrics.json", "pairs.json", "curves.png", "history.jsonl"}
    assert {path.name for path in whole.iterdir()} == results | {"manifest.json", "validation"}
    assert {path.name for path in (whole / "validation").iterdir()} == {f"step_00000{k}.png" for k in (0, 3, 6)}
    manifest = read_json(whole / "manifest.json")
    assert (manifest["state"], manifest["crop_px"]) == ("done", [32, 32])
    assert set(manifest["results_sha256"]) == results
    assert manifest["model_sha256"]["network.npz"] == sha256_file(model / "network.npz")
    names = read_json(whole / "pairs.json")
    assert sorted(names["training"] + names["held_out"]) == list("012345")
    assert (len(names["held_out"]), names["with_mask"]) == (2, ["2"])
    records = read_history(whole / "history.jsonl", STEPS)
    assert [record["step"] for record in records] == list(range(STEPS))
    rates = [record["learning_rates"]["network"] for record in records]
    # A tenth of the training's, and along the cosine towards a tenth of that.
    assert rates[0] == pytest.approx(1e-3)
    assert 1e-4 < rates[-1] < 2e-4
    metrics = read_json(whole / "metrics.json")
    assert records[-1]["validation"] == {kind: metrics[kind] for kind in ("capture", "reconstruction")}


def test_the_result_is_a_model(whole: Path, pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """One that `reconstruct` opens, and that is told of the PSFs that it was tuned with."""
    network, about = read_network(whole / "network.npz")
    assert network.layout == LAYOUT
    assert about["before"] == ABOUT
    np.testing.assert_array_equal(read_bank(whole / "psf.exr").energy, bank().energy)
    paths = [str(path) for path in (whole, pairs / "0_capture.png", pairs / "1_capture.exr")]
    assert (
        main(["reconstruct", *paths, "--out", str(tmp_path / "out"), "--tile", "64", "--overlap", "16", "--json"]) == 0
    )
    written = json.loads(capsys.readouterr().out)["paths"]
    assert [Path(path).name for path in written] == ["0_capture.png", "1_capture.exr"]
    assert read_capture(written[0]).light.shape == (1, 36, 44)
    before = Model.open(whole).psfs()
    assert before.near_m == pytest.approx(2 / (1 / 0.05 + 1 / 0.12))


@pytest.mark.slow
def test_it_learns_what_the_camera_does(model: Path, pairs: Path, tmp_path: Path):
    """Half of the light and a veil: undone on pairs that were never trained on."""
    code, said = tuned(model, pairs, tmp_path / "out", steps=150, learning_rate=1e-2)
    assert code == 0, said
    metrics = read_json(tmp_path / "out" / "metrics.json")
    before, after = (metrics[key]["full"]["psnr"] for key in ("capture", "reconstruction"))
    # 6 dB is half the error. The tiny network sees 32 pixels at a time and gets no further quickly.
    assert after > before + 6
    assert abs(metrics["before"]["full"]["psnr"] - before) < 1  # a fresh network hands captures through
    losses = [record["loss"] for record in read_history(tmp_path / "out" / "history.jsonl", 150)]
    assert np.mean(losses[-8:]) < 0.5 * np.mean(losses[:8])


def test_no_steps_leave_the_network_as_it_was(model: Path, pairs: Path, tmp_path: Path):
    """Without a spec, training's own defaults hold: a perceptual term, and MS-SSIM in its stead."""
    bare = tmp_path / "bare"
    shutil.copytree(model, bare)
    (bare / "spec.toml").unlink()
    code, said = tuned(bare, pairs, bare / "finetuned", steps=0, size=32, drawn=True)
    assert code == 0, said
    assert "MS-SSIM stands in" in said
    one, other = (jax.tree.leaves(read_network(f / "network.npz")[0]) for f in (bare, bare / "finetuned"))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)
    metrics = read_json(bare / "finetuned" / "metrics.json")
    assert metrics["before"] == metrics["reconstruction"]
    assert (bare / "finetuned" / "validation" / "step_000000.png").read_bytes().startswith(b"\x89PNG")


# --- stopped and resumed ---------------------------------------------------------------------------------------------


def interrupt() -> None:
    raise KeyboardInterrupt


def ask() -> None:
    signal.raise_signal(signal.SIGTERM)


@pytest.mark.slow
@pytest.mark.parametrize(("where", "stop", "done"), [(0, interrupt, 0), (4, interrupt, 4), (2, ask, 3), (5, ask, 6)])
def test_stopped_between_steps(
    model: Path,
    pairs: Path,
    whole: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    where: int,
    stop: Callable[[], None],
    done: int,
):
    """An exception loses the steps since the last checkpoint, a signal none; the result is the same to the last bit."""
    step = FineTuning.step

    def stepping(self: FineTuning, state: Any, batch: Any) -> Any:
        number, found = state.step, step(self, state, batch)
        if number == where:
            stop()
        return found

    with monkeypatch.context() as patch:
        patch.setattr(FineTuning, "step", stepping)
        code, said = tuned(model, pairs, tmp_path / "out")
    assert code == 130
    assert (f"stopped after step {done} of 6" in said) == (stop is ask)
    assert read_json(tmp_path / "out" / "manifest.json")["state"] == "running"
    assert (tmp_path / "out" / "checkpoint.npz").exists() == (done > 0)
    code, said = tuned(model, pairs, tmp_path / "out")
    assert code == 0
    assert (f"resuming after step {done}" in said) == (done > 0)
    assert content(tmp_path / "out") == content(whole)


def test_what_is_finished_stays(model: Path, pairs: Path, whole: Path):
    before = content(whole)
    code, said = tuned(model, pairs, whole)
    assert (code, "already holds this finished fine-tuning" in said) == (0, True)
    assert content(whole) == before


# --- pairs -----------------------------------------------------------------------------------------------------------


def test_a_mirrored_capture_is_seen_through_a_mirrored_plate(tmp_path: Path, model: Path):
    """What a lopsided PSF makes of a reference is the capture, whichever way round the crop is."""
    psf = np.zeros((1, 5, 5), np.float32)
    psf[0, 2, 2], psf[0, 1, 4], psf[0, 3, 3] = 0.5, 0.3, 0.2
    light = np.random.default_rng(3).uniform(0.1, 0.9, (40, 40)).astype(np.float32)
    for name, image in (("reference", light), ("capture", convolve2d(light, psf[0], mode="same"))):
        write_picture(tmp_path / f"a_{name}.exr", {"Y": image})
    data = PairData(Pairs(find_pairs(tmp_path), Model.open(model)), (24, 32), seed=0, batch=16)
    crops = [data.item(k) for k in range(16)]
    mirrored = [crop.mirrored for crop in crops]
    assert 0 < sum(mirrored) < 16
    kernels = np.asarray(mirrored_as(jax.numpy.asarray(psf), jax.numpy.asarray(mirrored)))
    inner = (slice(2, -2), slice(2, -2))  # the rim lacks what lies beyond the crop
    for crop, kernel in zip(crops, kernels[:, 0], strict=True):
        seen = convolve2d(linear_from_srgb(crop.pair.reference[0]), kernel, mode="same")
        # Single precision, through the curve and back.
        np.testing.assert_allclose(seen[inner], crop.pair.capture[0][inner], atol=1e-5)


def test_the_stream_goes_on_from_any_step(pairs: Path, model: Path):
    """Every pair once in an epoch; and pictures that do not fit into memory are read again."""
    files, opened = find_pairs(pairs), Model.open(model)
    data = PairData(Pairs(files, opened), (32, 32), seed=1, batch=2)
    tight = PairData(Pairs(files, opened, most_bytes=40_000), (32, 32), seed=1, batch=2)
    with data.batches(0, 6) as stream, tight.batches(3, 5) as later:
        whole, part = list(stream), list(later)
    assert [batch.step for batch in whole] == list(range(6))
    for epoch in (whole[:3], whole[3:]):
        assert sorted(item.name for batch in epoch for item in batch.items) == list("012345")
    for one, other in zip(whole[3:5], part, strict=True):
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            np.testing.assert_array_equal(a, b)
    assert {item.name for batch in whole for item in batch.items if item.pair.mask.any()} <= {"2"}
    straight = replace(data, mirrored=False)
    assert not any(straight.item(k).mirrored for k in range(12))


def test_what_is_held_out_is_never_trained_on(
    pairs: Path, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Nor the same view behind other dirt."""
    folder = tmp_path / "pairs"
    shutil.copytree(pairs, folder)
    for k in range(6):
        shutil.copy(folder / f"{k}_reference.png", folder / f"{k}b_reference.png")
        write_reconstruction(folder / f"{k}b_capture.png", 0.9 * dimmed(scene(k, (36 + k, 44))), 16)
    split = split_pairs(find_pairs(folder), 2, 0, "here")
    held_out = {pair.name[0] for pair in split.held_out}
    assert len(split.held_out) == 2
    assert {pair.name[0] for pair in split.left_out} <= held_out
    assert {pair.name[0] for pair in split.training} == set("012345") - held_out
    seen: set[str] = set()
    step = FineTuning.step

    def noting(self: FineTuning, state: Any, batch: Any) -> Any:
        seen.update(item.name for item in batch.items)
        return step(self, state, batch)

    monkeypatch.setattr(FineTuning, "step", noting)
    code, said = tuned(model, folder, tmp_path / "out")
    assert code == 0, said
    assert seen <= {pair.name for pair in split.training}
    assert "left out" in said


def test_folders_of_captures_and_references(pairs: Path, model: Path, tmp_path: Path):
    for path in pairs.glob("*_*"):
        name, part = path.stem.split("_")
        (tmp_path / part).mkdir(exist_ok=True)
        shutil.copy(path, tmp_path / part / f"{name}{path.suffix}")
    opened = Model.open(model)
    for one, other in zip(find_pairs(pairs), find_pairs(tmp_path), strict=True):
        assert one.name == other.name
        for a, b in zip(read_pair(one, opened), read_pair(other, opened), strict=True):
            np.testing.assert_array_equal(a, b)


# --- measured PSFs ---------------------------------------------------------------------------------------------------


def test_measured_psfs_become_those_of_the_result(pairs: Path, model: Path, tmp_path: Path):
    """Two files of unlike windows: without further words, the result is told of the same."""
    counts = np.random.default_rng(5).uniform(0, 4000, (11, 11)).astype(np.float32)
    write_picture(tmp_path / "far.exr", {"Y": counts[2:-2, 2:-2]})
    write_picture(tmp_path / "near.exr", {"Y": counts})
    # Their one channel has another name than the model's, and its energy is that of the model's own PSF.
    files: list[Path] = [tmp_path / "far.exr", tmp_path / "near.exr"]
    how: Any = {"pixel_m": PIXEL, "near_m": 0.1, "far_m": 5.0}
    code, said = tuned(model, pairs, tmp_path / "out", steps=0, psf=files, **how)
    assert code == 0, said
    used, kept = Model.open(model).psfs(files, **how), Model.open(tmp_path / "out").psfs()
    assert (kept.near_m, kept.far_m) == (pytest.approx(0.1), 5.0)
    for one, other in ((kept.far, used.far), (kept.near, used.near)):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)  # the depth of 0.1 m is rounded on its way
    assert not used.far[:, :2].any()
    assert kept.far.sum(dtype=np.float64) == pytest.approx(used.far.sum(dtype=np.float64))


# --- what is refused -------------------------------------------------------------------------------------------------


def change(pairs: Path, folder: Path, kind: str) -> None:
    """A copy of the pairs with one mistake."""
    shutil.copytree(pairs, folder)
    if kind == "incomplete":
        (folder / "3_reference.png").unlink()
    elif kind == "mask alone":
        shutil.copy(folder / "2_mask.png", folder / "9_mask.png")
    elif kind == "twice":
        shutil.copy(folder / "0_capture.png", folder / "0_capture.tif")
    elif kind == "sizes":
        write_reconstruction(folder / "4_reference.png", scene(4, (36, 44)), 16)
    elif kind == "mask size":
        write_reconstruction(folder / "4_mask.png", np.ones((1, 20, 20), np.float32), 8)
    elif kind == "nan":
        write_picture(folder / "1_capture.exr", {"Y": np.full((37, 44), np.nan)})
    elif kind == "mask nan":
        (folder / "4_mask.png").unlink(missing_ok=True)
        write_picture(folder / "4_mask.exr", {"M": np.full((40, 44), np.nan)})
    elif kind == "small":
        for part in ("reference", "capture"):
            write_reconstruction(folder / f"0_{part}.png", scene(0, (12, 44)), 16)
    elif kind == "none":
        shutil.rmtree(folder)
        folder.mkdir()
    else:
        shutil.rmtree(folder)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("incomplete", ['"3" must have a reference', "3_capture.png alone"]),
        ("mask alone", ['"9" must have a capture', "9_mask.png alone"]),
        ("twice", ["must have one capture", "0_capture.png and 0_capture.tif"]),
        ("sizes", ["4_reference.png: must have the 44 x 40 pixels of 4_capture.exr, but got 44 x 36"]),
        ("mask size", ["4_mask.png: must have the 44 x 40 pixels"]),
        ("nan", ["1_capture.exr", "every pixel must be finite"]),
        ("mask nan", ["4_mask.exr: every pixel must be finite"]),
        ("small", ["at least 16 x 16 pixels", "44 x 12"]),
        ("none", ["must hold pairs", "NAME_capture.png"]),
        ("gone", ["gone: the file must exist"]),
    ],
)
def test_pairs_that_cannot_be_used(model: Path, pairs: Path, tmp_path: Path, kind: str, words: list[str]):
    change(pairs, tmp_path / kind, kind)
    code, said = tuned(model, tmp_path / kind, tmp_path / "out")
    assert code == 2
    for word in words:
        assert word in said
    assert not (tmp_path / "out").exists()


def test_other_mistakes(model: Path, pairs: Path, tmp_path: Path):
    write_bank(tmp_path / "pitch.exr", bank(pixel=1.85e-6))
    write_bank(tmp_path / "colours.exr", bank(("450nm", "550nm", "650nm")))
    write_bank(tmp_path / "even.exr", bank(window=8))
    (tmp_path / "weights.npz").write_bytes(b"")
    cases: list[tuple[dict[str, Any], str]] = [
        ({"psf": [tmp_path / "pitch.exr"]}, "3.7 um pixels"),
        ({"psf": [tmp_path / "colours.exr"]}, "colours of the network"),
        ({"psf": [tmp_path / "even.exr"]}, "odd window, such as 9"),
        ({"near_m": 0.01}, "--near-depth: must lie within"),
        ({"validation": 6}, "validation: must be from 1 to 5"),
        ({"validation": 0}, "validation"),
        ({"steps": -1}, "steps"),
        ({"learning_rate": float("nan")}, "learning_rate"),
        ({"seed": -1}, "seed"),
        ({"size": 8}, "crops of 8"),
        ({"lpips_weights": [tmp_path / "weights.npz"]}, "weights.npz"),
    ]
    for options, words in cases:
        code, said = tuned(model, pairs, tmp_path / "out", **options)
        assert (code, words in said) == (2, True), said
        assert not (tmp_path / "out").exists()
    code, said = tuned(tmp_path, pairs, tmp_path / "out")
    assert (code, "must hold a trained network" in said) == (2, True)


def test_views_that_are_all_one(model: Path, pairs: Path, tmp_path: Path):
    for k in "ab":
        for part in ("capture", "reference"):
            shutil.copy(pairs / f"0_{part}.png", tmp_path / f"{k}_{part}.png")
    with pytest.raises(InputError, match="none of whose pictures is held out"):
        finetune(Model.open(model), tmp_path, tmp_path / "out")


def test_folders_and_checkpoints_of_others(model: Path, pairs: Path, whole: Path, tmp_path: Path):
    before = content(whole)
    code, said = tuned(model, pairs, whole, seed=1)
    assert (code, "must belong to this fine-tuning" in said) == (2, True)
    assert content(whole) == before
    code, said = tuned(model, pairs, model)
    assert (code, "other content" in said) == (2, True)
    out = tmp_path / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FineTuning, "write_results", lambda *_: interrupt())
        assert tuned(model, pairs, out)[0] == 130
        assert tuned(model, pairs, tmp_path / "other", seed=1)[0] == 130
    shutil.copy(tmp_path / "other" / "checkpoint.npz", out)
    code, said = tuned(model, pairs, out)
    assert (code, "must belong to this training" in said) == (2, True)
    (out / "checkpoint.npz").write_bytes(b"half")
    code, said = tuned(model, pairs, out)
    assert (code, "must be a whole checkpoint" in said) == (2, True)


def test_a_loss_that_is_not_finite(model: Path, pairs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    step = FineTuning.step

    def breaking(self: FineTuning, state: Any, batch: Any) -> Any:
        nothing = [item.pair._replace(reference=item.pair.reference * np.nan) for item in batch.items]
        spoilt = [item._replace(pair=pair) for item, pair in zip(batch.items, nothing, strict=True)]
        return step(self, state, batch._replace(items=tuple(spoilt)))

    monkeypatch.setattr(FineTuning, "step", breaking)
    code, said = tuned(model, pairs, tmp_path / "out")
    assert (code, "step 0: the loss must stay finite" in said, "learning rate" in said) == (2, True, True)


# --- the command line ------------------------------------------------------------------------------------------------


def test_the_command_line(model: Path, pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    shutil.copytree(model, tmp_path / "run" / "trained")
    options = ["--steps", "0", "--validation", "1", "--psf", str(model / "psf.exr"), "--near-depth", "10 cm"]
    arguments = [
        "finetune",
        str(tmp_path / "run"),
        "--pairs",
        str(pairs),
        *options,
        "--far-depth",
        "inf",
        "--no-mirror",
    ]
    assert main([*arguments, "--json"]) == 0
    out = tmp_path / "run" / "finetuned"
    assert json.loads(capsys.readouterr().out)["metrics"] == str(out / "metrics.json")
    manifest = read_json(out / "manifest.json")
    assert (manifest["near_m"], manifest["far_m"], manifest["mirrored"]) == (0.1, None, False)
    assert main([*arguments[:-1], "--near-depth", "ten"]) == 2
    assert "--near-depth" in capsys.readouterr().err
