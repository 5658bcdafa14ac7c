"""`doedesign reconstruct`: what it takes, what it leaves behind, and what it refuses."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import doedesign
from doedesign.cli import main
from doedesign.recon.files import FORMAT, reconstruct_files
from doedesign.recon.model import Model
from doedesign.recon.network import NetworkShape
from doedesign.recon.photos import read_capture, write_reconstruction
from doedesign.recon.weights import camera_facts, read_network, write_network
from fab.errors import InputError
from fab.files import canonical_json, read_json, sha256_file
from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.light import srgb_from_linear
from sim.psf_bank import PsfBank
from sim.store import read_picture, write_bank, write_picture
from tests.recon.drawn_networks import drawn

# Blue comes first, so that files in red, green and blue have to be turned round.
COLOURS = ("486nm", "589nm", "656nm")
WAVES = (486e-9, 589e-9, 656e-9)
PIXEL = 3.7e-6
ABOUT = {"colours": list(COLOURS), "wavelengths_m": list(WAVES), "pixel_m": PIXEL, "near_m": [0.05, 0.08, 0.12]}
LAYOUT = NetworkShape(width=3, depth=1, wiener=False, near_estimate=False, refine=False)
# Through single precision, the curve and back, and half a count of 16 bits.
SIXTEEN = 0.5 / 65535 + 1e-6


def bank(colours=COLOURS, depths=(0.05, 0.12, 5.0, np.inf), pixel=PIXEL, window=7, seed=0) -> PsfBank:
    energy = np.random.default_rng(seed).uniform(0, 1, (len(colours), len(depths), window, window))
    energy *= np.linspace(0.7, 0.9, len(colours))[:, None, None, None] / energy.sum(axis=(2, 3), keepdims=True)
    return PsfBank(energy.astype(np.float32), colours, depths, pixel)


def model_in(
    folder: Path, layout: NetworkShape = LAYOUT, about=ABOUT, spread: float = 0.0, psfs: PsfBank | None = None
) -> Path:
    """A model; with a spread of 0 its network hands the capture through."""
    write_network(folder / "network.npz", drawn(layout, spread), about)
    write_bank(folder / "psf.exr", psfs or bank(about["colours"] and tuple(about["colours"])))
    return folder


def reconstruct(model: Path, captures: list[Path], out: Path, *, psf: Any = (), **how: Any) -> list[Path]:
    opened = Model.open(model)
    lengths = {name: how.pop(name) for name in ("pixel_m", "near_m", "far_m") if name in how}
    return reconstruct_files(opened, captures, out, psfs=opened.psfs(psf, **lengths), **how)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run with a training."""
    model_in(tmp_path / "run" / "trained")
    return tmp_path / "run"


@pytest.fixture
def light() -> np.ndarray:
    return np.random.default_rng(1).uniform(0, 1, (3, 30, 41)).astype(np.float32)


@pytest.fixture
def capture(tmp_path: Path, light: np.ndarray) -> Path:
    write_picture(tmp_path / "capture.exr", dict(zip("RGB", light, strict=True)))
    return tmp_path / "capture.exr"


def test_a_network_that_changes_nothing_gives_the_capture_back(tmp_path: Path, run: Path, light: np.ndarray):
    """Every kind of file: its colours, the way up, its curve, and more tiles than one."""
    display = srgb_from_linear(light)
    files = [tmp_path / f"{name}" for name in ("a.exr", "b.png", "c.png", "d.tif", "e.tif")]
    for path, bits in zip(files, (None, 16, 8, 16, None), strict=True):
        write_reconstruction(path, display, bits)
    out = tmp_path / "out"
    written = reconstruct(run, files, out, tile=32, overlap=8)
    assert written == [out / path.name for path in files]
    for before, after in zip(files, written, strict=True):
        one, other = read_capture(before), read_capture(after)
        assert (one.bits, one.linear) == (other.bits, other.linear)
        np.testing.assert_allclose(srgb_from_linear(other.light), srgb_from_linear(one.light), atol=SIXTEEN)


def test_a_capture_that_is_none_is_told_before_the_first_is_reconstructed(tmp_path: Path, run: Path, capture: Path):
    """It left a folder of no results, or was told after those before it."""
    (tmp_path / "notes.md").write_text("no picture")
    for wrong in ("notes.md", "missing.png"):
        with pytest.raises(InputError, match=wrong):
            reconstruct(run, [capture, tmp_path / wrong], tmp_path / "out")
        assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("annotations_unchecked")
def test_paths_may_be_text(tmp_path: Path, run: Path, capture: Path):
    """A folder that was text ended in an AttributeError, and one capture was taken for its letters."""
    model = Model.open(run)
    assert reconstruct_files(model, str(capture), str(tmp_path / "out")) == [tmp_path / "out" / "capture.exr"]
    given: Any = [3]
    with pytest.raises(InputError, match="captures: must be the path of a file or a folder, but got an int"):
        reconstruct_files(model, given, tmp_path / "out")
    asked: Any = {"tile": "32"}
    with pytest.raises(InputError, match=r"tile, overlap: tile must be a multiple of \d+, but got 32"):
        reconstruct_files(model, capture, tmp_path / "out", **asked)


def test_the_manifest_says_what_was_done(tmp_path: Path, run: Path, capture: Path):
    out = tmp_path / "out"
    reconstruct(run, [capture], out, near_m=0.07, kind=".png", beside=True)
    manifest = read_json(out / "manifest.json")
    assert manifest["format"] == FORMAT
    assert set(manifest["results"]) == {"capture.png", "capture_beside.png"}
    for name, said in manifest["results"].items():
        assert said["sha256"] == sha256_file(out / name)
        assert said["capture_sha256"] == sha256_file(capture)
        assert said["model_sha256"]["network.npz"] == sha256_file(run / "trained" / "network.npz")
        assert (said["near_m"], said["far_m"]) == (0.07, None)
    assert {path.name for path in out.iterdir()} == {*manifest["results"], "manifest.json"}


def test_side_by_side_shows_both(tmp_path: Path, run: Path, capture: Path, light: np.ndarray):
    reconstruct(run, [capture], tmp_path / "out", beside=True)
    seen = np.asarray(Image.open(tmp_path / "out" / "capture_beside.png"))[::-1].transpose(2, 0, 1) / 255
    assert seen.shape == (3, 30, 2 * 41 + 2)
    for half in (seen[..., :41], seen[..., 43:]):
        np.testing.assert_allclose(half, srgb_from_linear(light), atol=0.51 / 255)
    assert seen[..., 41:43].min() == 1


def test_same_inputs_same_bytes_and_a_later_call_adds(tmp_path: Path, run: Path, capture: Path):
    out, other = tmp_path / "out", tmp_path / "other.exr"
    shutil.copy(capture, other)
    reconstruct(run, [capture], out)
    first = {path.name: path.read_bytes() for path in out.iterdir()}
    reconstruct(run, [capture], out)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == first
    reconstruct(run, [other], out)
    assert set(read_json(out / "manifest.json")["results"]) == {"capture.exr", "other.exr"}
    assert (out / "capture.exr").read_bytes() == first["capture.exr"]


def test_captures_of_one_name_are_told_apart_by_their_folders(tmp_path: Path, run: Path, capture: Path):
    copies = []
    for name in ("0000_cat", "0001_dog"):
        (tmp_path / name).mkdir()
        copies.append(Path(shutil.copy(capture, tmp_path / name / "capture.exr")))
    written = reconstruct(run, copies, tmp_path / "out")
    assert [path.name for path in written] == ["0000_cat_capture.exr", "0001_dog_capture.exr"]
    with pytest.raises(InputError, match="twice"):
        reconstruct(run, [capture, capture], tmp_path / "out")


def test_psfs_reach_the_network(tmp_path: Path, capture: Path):
    """A network with Wiener blocks gives another picture with other PSFs, and the same with its own handed in."""
    model = model_in(tmp_path / "model", NetworkShape(width=3, depth=1, features=False, refine=False), spread=0.1)
    sharp = bank()
    sharp = PsfBank(np.zeros_like(sharp.energy), COLOURS, sharp.depths_m, PIXEL)
    sharp.energy[..., 3, 3] = 0.8
    write_bank(tmp_path / "sharp.exr", sharp)
    shutil.copy(model / "psf.exr", tmp_path / "same.exr")
    pictures = []
    for k, psf in enumerate(((), (tmp_path / "same.exr",), (tmp_path / "sharp.exr",))):
        (path,) = reconstruct(model, [capture], tmp_path / f"out{k}", psf=psf)
        pictures.append(read_picture(path)[0]["G"])
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert np.abs(pictures[2] - pictures[0]).max() > 1e-3


def test_depths_are_the_middle_of_the_near_ones_and_the_farthest(run: Path):
    model = Model.open(run)
    psfs = model.psfs()
    assert psfs.near_m == pytest.approx(2 / (1 / 0.05 + 1 / 0.12))
    assert psfs.far_m == np.inf
    np.testing.assert_array_equal(psfs.far, model.bank.energy[:, 3])
    # Half way in 1/z between the bank's two near depths is half of each.
    np.testing.assert_allclose(psfs.near, model.bank.energy[:, :2].mean(axis=1), rtol=1e-5)
    chosen = model.psfs(near_m=0.05, far_m=5.0)
    np.testing.assert_array_equal(chosen.near, model.bank.energy[:, 0])
    np.testing.assert_array_equal(chosen.far, model.bank.energy[:, 2])


def test_a_bank_in_another_order_is_put_in_order(tmp_path: Path, run: Path):
    model, own = Model.open(run), bank()
    turned = PsfBank(own.energy[[2, 0, 1]], (COLOURS[2], COLOURS[0], COLOURS[1]), own.depths_m, PIXEL * 1.0005)
    write_bank(tmp_path / "turned.exr", turned)
    found, usual = model.psfs([tmp_path / "turned.exr"]), model.psfs()
    np.testing.assert_array_equal(found.far, usual.far)
    np.testing.assert_array_equal(found.near, usual.near)


def measured(path: Path, window: int = 9, seed: int = 5) -> np.ndarray:
    """Counts of another program, red, green and blue."""
    counts = np.random.default_rng(seed).uniform(0, 4000, (3, window, window)).astype(np.float32)
    write_picture(path, dict(zip("RGB", counts, strict=True)))
    return counts


def test_measured_psfs_take_the_energy_of_the_models(tmp_path: Path, run: Path):
    far, near = measured(tmp_path / "far.exr"), measured(tmp_path / "near.exr", 11, 6)
    model = Model.open(run)
    found = model.psfs([tmp_path / "far.exr", tmp_path / "near.exr"], pixel_m=PIXEL)
    own = model.psfs()
    np.testing.assert_array_equal(found.bank.energy, np.stack([found.near, found.far], axis=1))
    # The smaller one stands in the middle of the larger one's window.
    for psf, usual, counts in ((found.far[:, 1:-1, 1:-1], own.far, far), (found.near, own.near, near)):
        np.testing.assert_allclose(psf.sum(axis=(1, 2)), usual.sum(axis=(1, 2)), rtol=1e-5)
        # Blue is the model's first channel.
        np.testing.assert_allclose(psf / psf[:, :1, :1], counts[::-1] / counts[::-1][:, :1, :1], rtol=1e-5)


def test_one_colour_takes_luminance_and_gives_grey(tmp_path: Path, capture: Path, light: np.ndarray):
    about = ABOUT | {"colours": ["550nm"], "wavelengths_m": [550e-9]}
    layout = NetworkShape(colours=1, width=2, depth=1, wiener=False, near_estimate=False, refine=False)
    model = model_in(tmp_path / "grey", layout, about)
    (path,) = reconstruct(model, [capture], tmp_path / "out")
    channels, _ = read_picture(path)
    assert set(channels) == {"Y"}
    # Luminance of linear sRGB, through the curve and back in single precision.
    np.testing.assert_allclose(channels["Y"], np.tensordot([0.2126, 0.7152, 0.0722], light, 1), rtol=1e-4, atol=1e-5)


def test_camera_facts_are_what_a_model_needs():
    # Two lines of one colour, weighted: (2 · 580 + 607) / 3 = 589 nm.
    colours = (
        Colour("486nm", (486e-9,), (1.0,)),
        Colour("589nm", (580e-9, 607e-9), (2 / 3, 1 / 3)),
        Colour("656nm", (656e-9,), (1.0,)),
    )
    camera = Camera(Grid((16, 16), 2e-6), 30e-6, "fused_silica", colours, 1e-3, PIXEL, 15)
    facts = camera_facts(camera, (0.05, 0.08, 0.12))
    assert facts.pop("wavelengths_m") == pytest.approx(WAVES)
    assert facts == {key: value for key, value in ABOUT.items() if key != "wavelengths_m"}


def refusals(tmp_path: Path, run: Path, capture: Path) -> dict[str, tuple[str, dict]]:
    write_bank(tmp_path / "pitch.exr", bank(pixel=1.85e-6))
    write_bank(tmp_path / "colours.exr", bank(("450nm", "550nm", "650nm")))
    write_bank(tmp_path / "one.exr", bank(("589nm",)))
    write_bank(tmp_path / "even.exr", bank(window=8))
    write_bank(tmp_path / "depths.exr", bank(depths=(0.3, np.inf)))
    measured(tmp_path / "far.exr")
    write_picture(tmp_path / "dark.exr", {c: np.zeros((5, 5)) for c in "RGB"})
    write_picture(tmp_path / "grey.exr", {"Y": np.ones((20, 20))})
    nan = np.ones((20, 20))
    nan[3, 4] = np.nan
    write_picture(tmp_path / "nan.exr", {c: nan for c in "RGB"})

    def psf(*names: str, **more) -> dict:
        return {"psf": [tmp_path / name for name in names], **more}

    return {
        "pitch": (r"must have the 3\.7 um pixels .* but got 1\.85 um\. Compute or bin", psf("pitch.exr")),
        "colours": (
            r"the colours of the network, 486nm, 589nm, 656nm, but got 450nm, 550nm, 650nm",
            psf("colours.exr"),
        ),
        "count": ("the colours of the network, 486nm, 589nm, 656nm, but got 589nm", psf("one.exr")),
        "even": (r"must have an odd window.*8 x 8 pixels.*odd window, such as 9", psf("even.exr")),
        "depths": ("near_m: must lie within the depths of the PSF bank, 0.3 to inf m", psf("depths.exr")),
        "foreign": ("pixel pitch of a PSF from another program must be given", psf("far.exr", "far.exr")),
        "single": ("are needed, but got one depth", psf("far.exr", pixel_m=PIXEL)),
        "measured pitch": ("pixels that the network was trained with", psf("far.exr", "far.exr", pixel_m=4e-6)),
        "pitch alone": ("pixel_m: goes with PSFs of another program", {"pixel_m": PIXEL}),
        "dark": ("a PSF must hold light", psf("dark.exr", "dark.exr", pixel_m=PIXEL)),
        "three": ("must be one bank, or one file of the scene", psf("far.exr", "far.exr", "far.exr")),
        "no psf": ("must exist", psf("none.exr")),
        "near beyond": ("near_m: must lie within", {"near_m": 0.01}),
        "negative": (
            "near_m: must be a positive distance",
            {"near_m": -0.1},
        ),
        "nan depth": (
            "far_m: must be metres or text with a unit",
            {"far_m": np.nan},
        ),
        "order": (
            "the obstruction must be nearer",
            {"near_m": 6.0, "far_m": 5.0},
        ),
        "tile": (
            "tile, overlap: overlap must be at most half",
            {"tile": 64, "overlap": 48},
        ),
        "kind": ("kind: must be one of", {"kind": ".jpg"}),
        "grey": ("a capture must have the 3 colours of the network, but got 1", {"captures": [tmp_path / "grey.exr"]}),
        "nan": ("NaN or infinity at row 3 from below, column 4", {"captures": [tmp_path / "nan.exr"]}),
        "nothing": ("at least one capture", {"captures": []}),
        "missing": ("must exist", {"captures": [tmp_path / "none.png"]}),
        "no model": ("must hold a trained network", {"model": tmp_path}),
        "beside": ("a folder of their own", {"out": capture.parent}),
        "run as out": ("a folder of their own", {"out": run}),
    }


def test_mistakes_are_told_and_leave_nothing(tmp_path: Path, run: Path, capture: Path):
    for name, (message, wrong) in refusals(tmp_path, run, capture).items():
        out = tmp_path / "results" / name.replace(" ", "_")
        given = {"model": run, "captures": [capture], "out": out} | wrong
        with pytest.raises(InputError, match=message):
            reconstruct(**given)
        assert not out.exists() or {path.name for path in out.iterdir()} <= {"manifest.json"}, name


def test_models_that_do_not_fit_together_are_refused(tmp_path: Path):
    cases = {
        "pitch": ({"psfs": bank(pixel=1.85e-6)}, "the network was trained with"),
        "colours": ({"psfs": bank(("450nm", "550nm", "650nm"))}, "the colours of the network"),
        "facts": ({"about": {"colours": ["a"]}, "psfs": bank()}, "must say colours, wavelengths_m, pixel_m and near_m"),
        "layout": ({"about": ABOUT | {"colours": ["a", "b"]}, "psfs": bank()}, "must fit its layout, but got 2 names"),
        "depths": ({"about": ABOUT | {"near_m": []}, "psfs": bank()}, "must fit its layout"),
    }
    for name, (wrong, message) in cases.items():
        with pytest.raises(InputError, match=message):
            Model.open(model_in(tmp_path / name, **wrong))
    (model_in(tmp_path / "bare") / "psf.exr").unlink()
    with pytest.raises(InputError, match=r"psf\.exr"):
        Model.open(tmp_path / "bare")


def test_a_capture_is_never_overwritten(tmp_path: Path, run: Path, capture: Path):
    out = tmp_path / "out"
    (first,) = reconstruct(run, [capture], out)
    with pytest.raises(InputError, match="a capture must not be overwritten"):
        reconstruct(run, [first], out)
    whole, manifest = first.read_bytes(), read_json(out / "manifest.json")
    for changed in ({"format": "another"}, {"results": []}):
        (out / "manifest.json").write_bytes(canonical_json(manifest | changed))
        with pytest.raises(InputError, match="a folder of their own"):
            reconstruct(run, [capture], out)
    assert first.read_bytes() == whole


def test_side_by_side_overwrites_no_other_picture(tmp_path: Path, run: Path, capture: Path):
    out, own = tmp_path / "out", b"a picture of somebody's own"
    reconstruct(run, [capture], out)
    mine = out / "capture_beside.png"
    mine.write_bytes(own)
    with pytest.raises(InputError, match="of another origin must not be overwritten"):
        reconstruct(run, [capture], out, beside=True)
    shutil.copy(capture, mine.with_suffix(".exr"))
    with pytest.raises(InputError, match="a capture must not be overwritten"):
        reconstruct(run, [mine.with_suffix(".exr")], out)
    twin = Path(shutil.copy(capture, tmp_path / "capture_beside.exr"))
    how = {"kind": ".png", "beside": True}
    with pytest.raises(InputError, match=r"results of different names, but got capture_beside\.png twice"):
        reconstruct(run, [capture, twin], tmp_path / "both", **how)
    assert mine.read_bytes() == own
    assert len(reconstruct(run, [capture], tmp_path / "both", **how)) == 2
    assert len(reconstruct(run, [capture], tmp_path / "both", **how)) == 2  # what is listed is made again


def test_a_stopped_call_can_be_repeated(tmp_path: Path, run: Path, capture: Path, monkeypatch: pytest.MonkeyPatch):
    """Whatever it has written it has listed before."""

    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("doedesign.recon.files.write_reconstruction", stopped)
        with pytest.raises(KeyboardInterrupt):
            reconstruct(run, [capture], tmp_path / "out", beside=True)
    assert (tmp_path / "out" / "capture.exr").is_file()
    assert "sha256" not in read_json(tmp_path / "out" / "manifest.json")["results"]["capture.exr"]
    assert len(reconstruct(run, [capture], tmp_path / "out", beside=True)) == 2


def test_a_result_that_became_a_link_to_itself_is_made_again(tmp_path: Path, run: Path, capture: Path):
    (first,) = reconstruct(run, [capture], tmp_path / "out")
    whole = first.read_bytes()
    first.unlink()
    first.symlink_to(first.name)
    assert reconstruct(run, [capture], tmp_path / "out") == [first]
    assert first.read_bytes() == whole


def test_a_broken_capture_leaves_the_others(tmp_path: Path, run: Path, capture: Path):
    (tmp_path / "broken.exr").write_bytes(capture.read_bytes()[:200])
    out = tmp_path / "out"
    with pytest.raises(InputError, match=r"broken\.exr"):
        reconstruct(run, [capture, tmp_path / "broken.exr"], out)
    assert set(read_json(out / "manifest.json")["results"]) == {"capture.exr"}
    reconstruct(run, [capture], out)  # and the folder can be used again


def test_half_precision_serves_as_well(tmp_path: Path, capture: Path):
    model = model_in(tmp_path / "model", spread=0.1)
    (before,) = reconstruct(model, [capture], tmp_path / "full")
    network, about = read_network(model / "network.npz")
    write_network(model / "network.npz", network, about, half=True)
    (after,) = reconstruct(model, [capture], tmp_path / "half")
    one, other = (srgb_from_linear(read_capture(path).light) for path in (before, after))
    # Weights off by 2^-12 of themselves at most; corrections are of order 1 and so are sums of a few of them.
    assert 0 < np.abs(one - other).max() < 5e-3


def test_captures_alone_go_through_the_released_model(
    tmp_path: Path, capture: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(doedesign, "__file__", str(tmp_path / "elsewhere" / "doedesign" / "__init__.py"))
    assert main(["reconstruct", str(capture)]) == 2
    assert "Give the folder of a model" in capsys.readouterr().err
    released = tmp_path / "elsewhere" / "masks" / "released"
    model_in(released)
    arguments = ["reconstruct", str(capture), "--near-depth", "7 cm", "--far-depth", "inf", "--kind", "png", "--beside"]
    assert main(arguments) == 0
    names = ["reconstructed/capture.png", "reconstructed/capture_beside.png"]
    assert capsys.readouterr().out.split() == names
    manifest = read_json(tmp_path / "reconstructed" / "manifest.json")
    said = manifest["results"]["capture.png"]
    assert (said["near_m"], said["far_m"]) == (0.07, None)
    assert said["model_sha256"]["network.npz"] == sha256_file(released / "network.npz")


def test_the_command_line(tmp_path: Path, run: Path, capture: Path, capsys: pytest.CaptureFixture[str]):
    """A model and captures, PSFs one by one, and what cannot be read as a length."""
    for name, window, seed in (("far", 9, 5), ("near", 11, 6)):
        measured(tmp_path / f"{name}.exr", window, seed)
    psf = [word for name in ("far", "near") for word in ("--psf", str(tmp_path / f"{name}.exr"))]
    arguments = ["reconstruct", *psf, "--pixel", "3.7 um", str(run), str(capture), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"paths": [str(tmp_path / "out" / "capture.exr")]}
    assert len(read_json(tmp_path / "out" / "manifest.json")["results"]["capture.exr"]["psf_sha256"]) == 2
    for words, where in ((["--far-depth", "far"], "--far-depth"), (["--pixel", "-1 um"], "--pixel"), ([], "CAPTURE")):
        paths = [str(run), str(capture)] if words else [str(run)]
        assert main(["reconstruct", *paths, *words, "--out", str(tmp_path / "other")]) == 2
        assert where in capsys.readouterr().err
        assert not (tmp_path / "other").exists()
