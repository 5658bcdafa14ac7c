"""The released model works where it lies, its record is true, and the scripts around networks do what they say."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from doedesign.capture.images import sample_files
from doedesign.cli import main
from doedesign.optimization import optimize
from doedesign.recon.model import RELEASED, Model
from doedesign.recon.photos import read_capture
from doedesign.runs.level_maps import drawn_in_masks, open_design
from doedesign.runs.psfs import psfs
from fab.errors import InputError
from fab.files import canonical_json, read_json, sha256_file
from sim.light import srgb_from_linear
from sim.psf_bank import psf
from tests.recon.small_training import SPEC

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import release_model  # pyright: ignore[reportMissingImports]
import see_through  # pyright: ignore[reportMissingImports]
import train_demo  # pyright: ignore[reportMissingImports]
import train_released  # pyright: ignore[reportMissingImports]

ROOT = Path(__file__).parents[2]


def psnr(image: np.ndarray, scene: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((image - scene) ** 2)))


@pytest.mark.parametrize("name", ["", "-raindrop", "-fence", "-all"])
def test_a_released_model_is_what_its_manifest_says(name: str):
    folder = ROOT / f"{RELEASED}{name}"
    said = read_json(folder / "manifest.json")
    digests = said["results_sha256"]
    assert {path.name for path in folder.iterdir() if path.is_file()} == {"manifest.json", *digests}
    assert all(sha256_file(folder / name) == digest for name, digest in digests.items())
    assert (folder / "network.npz").stat().st_size < 10e6
    model = Model.open(folder)
    assert model.about["pictures"]["licence"] == said["trained"]["licence"]
    assert len(model.about["pictures"]["training"]) > 20
    digest = open_design(folder, False).level_map.digest
    if name == "-fence":  # the plate of a design that is released, too
        assert digest == open_design(ROOT / "masks" / "dslr-2800", False).level_map.digest
    else:
        assert read_json(folder / "masks.json")["level_map_sha256"] == digest


def test_a_released_model_is_trained_on_free_pictures_alone(tmp_path: Path):
    """Each with its licence; nothing that is trained on is judged by, nor shown with the model."""
    data, out = tmp_path / "data", tmp_path / "out"
    names = ("training_free/clic2025_a.jpg", "training_free/gb82_b.jpg", "training_free/SOURCES.md")
    names += ("backgrounds_kodak/kodim02.png", "backgrounds_bsds500/val/c.jpg", "driving_720p/bdd_d.jpg", "other/e.jpg")
    for name in names:
        path = data / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    found = train_released.free_pictures(data, out)
    entries = train_released.listed(found)
    licences = {entry["name"]: entry["licence"] for entry in entries}
    assert licences == found.licences
    free = {"clic2025_a.jpg": "Unsplash License (CLIC 2025)", "gb82_b.jpg": "CC0 1.0 (GB82)"}
    assert licences == free | {"kodim02.png": "unrestricted (Kodak PCD0992)"} | train_released.SAMPLES
    assert found.test is not None
    assert {path.name for path in found.test.iterdir()} == {"c.jpg", "bdd_d.jpg"}
    assert all(entry["sha256"] == sha256_file(found.images / entry["name"]) for entry in entries)
    assert sample_files()[0].name not in licences
    # Without others, scikit-image's own, some of which are held out.
    alone = train_released.free_pictures(tmp_path, tmp_path / "alone")
    assert alone.test is None
    assert set(alone.licences) == set(train_released.SAMPLES)


@pytest.mark.study
def test_the_released_plate_is_taken_like_that_of_a_run(tmp_path: Path):
    """Its PSFs are those that were released; masks and captures are made of it, as of any run."""
    folder = ROOT / RELEASED
    design, model = open_design(folder, False), Model.open(folder)
    far_m = max(design.far_m)
    found = psf(design.nominal_height_m, design.camera, [far_m]).energy[:, 0]
    # float32 transforms differ in the last digits from machine to machine.
    assert found == pytest.approx(model.bank.at(far_m), abs=1e-5 * float(found.max()))
    assert main(["masks", str(folder), "--out", str(tmp_path / "order")]) == 0
    assert drawn_in_masks(tmp_path / "order", design.level_map) == pytest.approx(design.level_map.level)
    shot = tmp_path / "shot"
    assert main(["simulate", str(folder), "--count", "1", "--size", "256", "--out", str(shot)]) == 0
    assert (shot / "contact.png").is_file()
    # There are no heights before rounding to show.
    with pytest.raises(KeyError):
        psfs(folder, tmp_path / "order", [far_m])["continuous"]


@pytest.mark.study
def test_reconstruct_works_out_of_the_box(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Without a model named: the capture that lies beside the released one comes out nearer to its scene."""
    monkeypatch.chdir(tmp_path)
    capture = ROOT / RELEASED / "capture.png"
    assert main(["reconstruct", str(capture), "--out", str(tmp_path / "out")]) == 0
    assert "occlusion model" in capsys.readouterr().err
    images = [np.clip(srgb_from_linear(read_capture(p).light), 0, 1) for p in (capture, tmp_path / "out/capture.png")]
    chain = see_through.photographed(Model.released(), sample_files()[0], release_model.SEED, side=release_model.SIDE)
    # Both were rounded to 16 bits, and transforms differ in the last digits from machine to machine.
    assert psnr(images[0], chain.plate) > 60
    assert psnr(images[1], chain.scene) > psnr(images[0], chain.scene) + 4


@pytest.mark.study
def test_the_chain_in_one_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", ["see_through.py", "--out", str(tmp_path / "chain.png")])
    assert see_through.main() == 0
    assert (tmp_path / "chain.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.study
def test_the_demo_of_training_compares_what_it_trained(tmp_path: Path):
    """At the smallest size, where numbers mean nothing: that the table is that of the trainings' own scores."""
    spec = tmp_path / "small.toml"
    # Enough of it that no scene is without an occluded region.
    spec.write_text(SPEC.replace('kind = "dirt"', 'kind = "dirt"\noptions = { coverage = [0.6, 0.8] }'))
    changes = ("train.steps=2", "train.validation=2", "network.width=1", "network.refine=false")
    plan = train_demo.Plan(tmp_path / "out", models=("paper",), seeds=(0, 1), spec=spec, overrides=changes)
    # Its pictures are scikit-image's where the checkout has no others beside it.
    train_demo.DATA = tmp_path
    table = train_demo.run(plan)["paper"]
    assert json.loads((plan.out / "table.json").read_text())["paper"] == table
    folders = [plan.out / f"paper_doe_{seed}" for seed in plan.seeds]
    scores = [read_json(folder / "metrics.json")["reconstruction"]["full"]["psnr"] for folder in folders]
    assert table["full"]["rows"]["doe: network"]["psnr"] == pytest.approx(np.mean(scores))
    assert {len(table[part]["psnr_differences"]) for part in train_demo.PARTS} == {2}
    # What is beyond an edge changes what is seen of the same scene.
    own, mirrored = (table[border]["psnr_differences"] for border in ("own", "reflect"))
    assert own != mirrored
    assert "## Occlusion model `paper`, 2 scenes, 2 seeds" in (plan.out / "table.md").read_text()
    with pytest.raises(InputError, match="must be a finished training behind a plate"):
        release_model.release(plan.out / "paper_conventional_0", None, tmp_path / "released")
    release_model.release(folders[0], None, tmp_path / "released")
    assert Model.open(tmp_path / "released").colours == ("550nm",)


@pytest.mark.study
def test_a_model_is_trained_behind_a_plate_that_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Behind a released plate, which has no heights before rounding and stays as it is; what is stopped goes on."""
    spec = tmp_path / "small.toml"
    spec.write_text(SPEC)
    optimize(spec, tmp_path / "masks" / "plate")
    manifest = tmp_path / "masks" / "plate" / "manifest.json"
    said = read_json(manifest)
    del said["results_sha256"]["height_continuous.exr"]  # as in a plate that is given away
    manifest.write_bytes(canonical_json(said))
    manifest.with_name("height_continuous.exr").unlink()
    small = (
        "train.steps=2",
        "train.light_scenes=2",
        "train.size=32",
        "train.validation=2",
        "network.width=1",
        "network.refine=false",
    )
    pictures = train_released.free_pictures(tmp_path, tmp_path / "out")
    monkeypatch.setitem(train_released.KINDS, "small", train_released.Kind("plate", '{ kind = "dirt" }'))
    how = {"overrides": small, "masks": tmp_path / "masks"}
    folder = train_released.trained("small", pictures, tmp_path / "out", "radiometric", **how)
    assert train_released.trained("small", pictures, tmp_path / "out", "radiometric", **how) == folder
    release_model.release(folder, None, tmp_path / "released", pictures=train_released.listed(pictures))
    said, model = read_json(tmp_path / "released" / "manifest.json"), Model.open(tmp_path / "released")
    assert {entry["name"] for entry in said["pictures"]} == set(train_released.SAMPLES)
    assert said["trained"]["occlusion"] == model.about["occlusion"] == "radiometric"
    assert model.network.light is not None
    before, after = (open_design(at, False) for at in (tmp_path / "masks" / "plate", tmp_path / "released"))
    assert before.level_map.digest == after.level_map.digest
