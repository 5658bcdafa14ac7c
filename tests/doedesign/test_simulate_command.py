"""`doedesign simulate`: a small run's captures, resumed, repeated, refused, and what they say about light."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import doedesign.capture.folder
from doedesign.capture.folder import PlateErrors, simulate_files
from doedesign.capture.image_files import read_image
from doedesign.runs.level_maps import open_design
from fab.errors import InputError
from fab.files import read_json
from fab.process import Process, Variation
from tests.doedesign.small_runs import call, finished_run
from tests.pictures import leave_out_pictures

SPEC = """
name = "small"
[optics]
focal_length = "1 mm"
wavelengths = ["656 nm", "589 nm", "486 nm"]
design_wavelength = "550 nm"
[doe]
samples = 64
pitch = "1.85 um"
aperture = "0.1184 mm"
material = "fused_silica"
[process]
levels = 4
level_step = "300 nm"
stock = "contact_aligner"
[scene]
near = ["6 mm", "9 mm"]
far = ["0.6 m"]
[sensor]
pitch = "1.85 um"
resolution = [640, 480]
window = 32
[optimize]
start = "ring"
steps = 0
[[objective]]
name = "far_spot"
"""
USUAL = {"--size": 32, "--count": 2, "--occlusion": "radiometric", "--obstruction": "dirt"}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished_run(tmp_path_factory.mktemp("small"), SPEC)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("images")
    rng = np.random.default_rng(0)
    for k in range(3):
        coarse = rng.integers(30, 256, (5, 6, 3), np.uint8)
        Image.fromarray(coarse).resize((48, 40)).save(folder / f"{k}.png")
    (folder / "broken.png").write_bytes(b"no picture")
    return folder


@pytest.fixture(autouse=True)
def plain_sheet(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sheet is looked at in a test of its own; drawing it takes longer than all else."""
    leave_out_pictures(monkeypatch, doedesign.capture.folder)


def arguments(run: Path, out: Path, images: Path, *more: object) -> list[object]:
    usual = [part for key, value in USUAL.items() if key not in more for part in (key, value)]
    return ["simulate", run, "--images", images, "--out", out, *usual, *more]


def simulate(run: Path, out: Path, images: Path, *more: object) -> dict:
    code, said, err = call(*arguments(run, out, images, *more), "--json")
    assert code == 0, err
    return json.loads(said) | {"said": err}


def refused(*given: object) -> str:
    code, out, err = call(*given)
    assert (code, out) == (2, "")
    assert "Traceback" not in err
    return err


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def item_images(folder: Path) -> dict[str, np.ndarray]:
    described = read_json(folder / "manifest.json")
    return {name: read_image(folder, stored) for name, stored in described["images"].items()}


@pytest.mark.slow
def test_what_is_written(run: Path, images: Path, tmp_path: Path):
    result = simulate(run, tmp_path / "out", images)
    assert len(result["items"]) == 2
    assert all(Path(path).exists() for path in result["paths"])
    manifest = read_json(tmp_path / "out" / "manifest.json")
    assert (manifest["state"], manifest["occlusion"], manifest["obstruction"]) == ("done", "radiometric", "dirt")
    assert manifest["sensor"]["full_well_e"] == 10000
    for name in result["items"]:
        item = read_json(tmp_path / "out" / name / "manifest.json")
        assert 6e-3 <= item["depth_m"] <= 9e-3  # between the near depths of the spec
        assert item["background_depth_m"] == 0.6
        found = item_images(tmp_path / "out" / name)
        assert {n: image.shape for n, image in found.items()} == {
            **dict.fromkeys(("clean", "conventional", "capture"), (3, 32, 32)),
            **dict.fromkeys(("mask", "alpha", "depth"), (1, 32, 32)),
        }
        assert set(np.unique(found["depth"])) <= {np.float32(item["depth_m"]), np.float32(0.6)}
        assert 0 <= found["alpha"].min() <= found["alpha"].max() <= 1


def test_broken_pictures_are_told_and_not_fatal(run: Path, images: Path, tmp_path: Path):
    result = simulate(run, tmp_path / "out", images, "--count", 4)
    assert list(result["skipped"]) == [str(images / "broken.png")]
    assert "1 of 4 pictures skipped: broken.png" in result["said"]
    assert len(result["items"]) == 4
    assert not any("broken" in name for name in result["items"])


@pytest.mark.slow
def test_same_seed_same_bytes_and_a_stopped_one_goes_on(run: Path, images: Path, tmp_path: Path):
    simulate(run, tmp_path / "a", images)
    simulate(run, tmp_path / "b", images)
    whole = content(tmp_path / "a")
    assert whole == content(tmp_path / "b")
    simulate(run, tmp_path / "c", images, "--seed", 1)
    assert {k: v for k, v in whole.items() if k.endswith("capture.exr")} != {
        k: v for k, v in content(tmp_path / "c").items() if k.endswith("capture.exr")
    }
    # One item lost, another damaged, and the temporary folder of a third.
    first, second = sorted(path for path in (tmp_path / "b").iterdir() if path.is_dir())
    shutil.rmtree(first)
    (second / "mask.exr").write_bytes(b"cut off")
    (tmp_path / "b" / ".0002_x.doedesign-new.abcdefgh").mkdir()
    simulate(run, tmp_path / "b", images)
    assert content(tmp_path / "b") == whole
    # A damaged description, which the contact sheet would have believed.
    described = json.loads((first / "manifest.json").read_text())
    for damage in (
        {"depth_m": []},
        {"covered": 0.5},
        {"images": {"clean": {"file": 2}}},
        {"sha256": 1},
        {"number": "a"},
    ):
        (first / "manifest.json").write_text(json.dumps(described | damage))
        simulate(run, tmp_path / "b", images)
        assert content(tmp_path / "b") == whole
    # More items of the same simulation keep those that are there.
    before = (tmp_path / "b" / first.name / "capture.exr").stat().st_mtime_ns
    result = simulate(run, tmp_path / "b", images, "--count", 3)
    assert "2 items are there already" in result["said"]
    assert (tmp_path / "b" / first.name / "capture.exr").stat().st_mtime_ns == before


def test_without_noise_and_obstruction_light_is_what_the_plate_passes(run: Path, tmp_path: Path):
    """A white world behind nothing: the flat plate passes what Fresnel leaves, less what leaves the window."""
    (tmp_path / "white").mkdir()
    Image.new("RGB", (40, 40), (255, 255, 255)).save(tmp_path / "white" / "white.png")
    clear = 'obstruction={kind="dirt", options={opacity=0.0}}'
    more = ("--set", clear, "--set", "sensor.noise=none", "--count", 1)
    result = simulate(run, tmp_path / "out", tmp_path / "white", *more)
    found = item_images(tmp_path / "out" / result["items"][0])
    assert np.all(found["clean"] == 1)
    assert not found["mask"].any()
    assert not found["alpha"].any()
    # Two faces of index 1.456 to 1.463 pass 93.1 to 92.9 %; beyond v = pi r / (lambda N) an Airy disc keeps 2 / (pi v),
    # which is 3 to 4 % for the window's half side of 30 um at F/9.
    assert np.all((found["conventional"] > 0.931 * 0.955) & (found["conventional"] < 0.931 * 0.975))
    assert np.all(found["capture"] <= found["conventional"].max() + 1e-3)
    assert found["conventional"].std(axis=(1, 2)).max() < 2e-4  # one step of 12 bits is 3e-4


def test_png_holds_the_same(run: Path, images: Path, tmp_path: Path):
    exr, png = (simulate(run, tmp_path / name, images, *more) for name, more in (("a", ()), ("b", ("--png",))))
    assert exr["items"] == png["items"]
    for name in exr["items"]:
        exact, counted = (item_images(tmp_path / folder / name) for folder in "ab")
        for title in ("clean", "conventional", "capture", "mask", "alpha"):
            # Half a count of the brightest light, 1.25; noise below black is cut.
            assert counted[title] == pytest.approx(np.maximum(exact[title], 0), abs=1.25 / 65535)
        assert counted["depth"] == pytest.approx(exact["depth"], rel=1 / 6e-3 / 65535 * 0.6)


@pytest.mark.parametrize("model", ["paper", "paper_release"])
def test_the_papers_models_are_named_where_they_are_used(run: Path, images: Path, tmp_path: Path, model: str):
    result = simulate(run, tmp_path / "out", images, "--occlusion", model)
    assert read_json(tmp_path / "out" / "manifest.json")["occlusion"] == model
    assert item_images(tmp_path / "out" / result["items"][0])["alpha"].shape == (3, 32, 32)
    assert model in result["said"]


@pytest.mark.slow
def test_a_plate_as_fabricated(run: Path, images: Path, tmp_path: Path):
    drawn = simulate(run, tmp_path / "a", images, "--count", 1)
    simulate(run, tmp_path / "b", images, "--count", 1, "--fabricated", "--plate-seed", 3)
    told = read_json(tmp_path / "b" / "manifest.json")
    assert "draw normal/0 of seed 3" in told["plate"]
    assert "overlay_x" in told["variation"]
    found = [item_images(tmp_path / folder / drawn["items"][0]) for folder in "ab"]
    assert np.array_equal(found[0]["conventional"], found[1]["conventional"])
    assert not np.array_equal(found[0]["capture"], found[1]["capture"])


@pytest.mark.slow
def test_captures_of_one_process_are_none_of_another(run: Path, images: Path, tmp_path: Path):
    """The same errors of a plate that lies elsewhere on its wafer."""
    design, seen = open_design(run, False), set()
    errors = Variation(radial_nonuniformity=0.05)
    for die_m in ((0.0, 0.0), (0.03, 0.03)):
        plate = PlateErrors(Process(design.levels, die_m=die_m), errors, "errors of a file")
        out = tmp_path / f"{die_m[0]}"
        simulate_files(design, out, images, obstruction="dirt", occlusion="radiometric", count=1, size=32, plate=plate)
        seen.add(read_json(out / "manifest.json")["settings_sha256"])
    assert len(seen) == 2
    with pytest.raises(InputError, match="must belong to"):
        simulate_files(
            design, tmp_path / "0.0", images, obstruction="dirt", occlusion="radiometric", count=1, size=32, plate=plate
        )


def test_a_mosaic(run: Path, images: Path, tmp_path: Path):
    pytest.importorskip("colour_demosaicing", reason="the extra [bayer] is not installed")
    result = simulate(run, tmp_path / "out", images, "--set", "sensor.bayer=RGGB", "--set", "sensor.noise=none")
    found = item_images(tmp_path / "out" / result["items"][0])
    assert found["conventional"].shape == (3, 32, 32)


@pytest.mark.slow
def test_one_colour(images: Path, tmp_path: Path):
    text = SPEC.replace('["656 nm", "589 nm", "486 nm"]', '["550 nm"]').replace('"small"', '"single"')
    result = simulate(finished_run(tmp_path, text), tmp_path / "out", images, "--count", 1)
    found = item_images(tmp_path / "out" / result["items"][0])
    assert found["clean"].shape == found["capture"].shape == (1, 32, 32)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--occlusion", "eq10"], ["--occlusion", "radiometric"]),
        (["--obstruction", "mud"], ["--obstruction", '"mud"', "kind of obstruction"]),
        (["--count", 0], ["--count", "at least 1"]),
        (["--size", 5000], ["--size", "480"]),
        (["--set", "process.levels=8"], ["--set", "another process"]),
        (["--set", "sensor.binning=2"], ["--set", "sensor.binning"]),
        (["--set", "sensor.binnings=2"], ["sensor.binnings", "binning"]),
        (["--plate-seed", 3], ["--fabricated"]),
        (["--fabricated", "--variation", "none.toml"], ["none.toml"]),
    ],
)
def test_what_is_refused(run: Path, images: Path, tmp_path: Path, more: list[object], words: list[str]):
    message = refused(*arguments(run, tmp_path / "out", images, *more))
    for word in words:
        assert word in message


def test_what_must_be_named_and_whole(run: Path, images: Path, tmp_path: Path):
    message = refused("simulate", run, "--obstruction", "dirt", "--images", images)
    assert "spec.toml: scene.occlusion" in message
    assert "--occlusion" in message
    assert "obstruction.kind" in refused("simulate", run, "--occlusion", "paper", "--images", images)
    empty = tmp_path / "empty"
    assert "no folder" in refused(*arguments(run, tmp_path / "out", empty))
    empty.mkdir()
    assert "must hold pictures" in refused(*arguments(run, tmp_path / "out", empty))
    (empty / "a.jpg").write_bytes(b"broken")
    assert "only broken ones: a.jpg" in refused(*arguments(run, tmp_path / "out", empty))
    simulate(run, tmp_path / "out", images)  # nothing was made in it yet


def test_what_others_keep_beside_the_items_stays(run: Path, images: Path, tmp_path: Path):
    """Reconstructions beside the captures that they are of, and a simulation in its own folder."""
    out = tmp_path / "out"
    simulate(run, out, images)
    item = next(out.glob("0*/manifest.json"))
    (out / "restored").mkdir()
    (out / "restored" / "manifest.json").write_text('{"format": "doedesign reconstructions 1"}')
    (out / "2024_other").mkdir()
    (out / "2024_other" / "manifest.json").write_text((out / "manifest.json").read_text())
    before = item.stat().st_mtime_ns, item.stat().st_ino
    simulate(run, out, images)
    assert (out / "restored" / "manifest.json").is_file()
    assert (out / "2024_other" / "manifest.json").is_file()
    assert (item.stat().st_mtime_ns, item.stat().st_ino) == before


def test_folders_of_others_are_left_alone(run: Path, images: Path, tmp_path: Path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years of work")
    assert "other content" in refused(*arguments(run, tmp_path / "out", images))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.tex"]
    simulate(run, tmp_path / "mine", images)
    before = content(tmp_path / "mine")
    assert "must belong to this simulation" in refused(*arguments(run, tmp_path / "mine", images, "--seed", 5))
    assert content(tmp_path / "mine") == before


@pytest.mark.parametrize("seed", [-1, 1 << 40])
def test_a_seed_that_is_none_is_refused_before_anything_is_written(run: Path, images: Path, tmp_path: Path, seed: int):
    told = refused(*arguments(run, tmp_path / "out", images, "--seed", seed))
    assert "--seed: must be from 0 to 4294967295" in told
    assert not (tmp_path / "out").exists()
