"""Bad input: one clear message, exit 2, no traceback, nothing half-written, nothing lost."""

import errno
import json
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

import doedesign.lab.order
import fab.archive
from doedesign.cli import main
from fab.files import os_errors_explained
from fab.level_map import read_level_map, write_level_map
from sim.store import write_height
from tests.orders import named

pytestmark = pytest.mark.usefixtures("without_pictures")

BARE = ("--levels", 16, "--step", "75 nm", "--pitch", "2 um")


def refuse(done, *words, code=2):
    """Check that a command refused with one message that holds some words."""
    assert done.code == code, done
    assert done.out == ""
    message = done.err[done.err.index("doedesign: ") :]
    assert "Traceback" not in done.err
    for word in words:
        assert str(word) in message
    return message


def cut(path: Path, share: float = 0.6) -> None:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def flip(path: Path, where: int) -> None:
    data = bytearray(path.read_bytes())
    data[where] ^= 0x10
    path.write_bytes(data)


class Bomb:
    """Touches a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


# --- specs --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["optics"]),
        ("[optics", ["valid TOML", "end of document"]),
        ("\x00", ["valid TOML"]),
        (b"\xff\xfe", ["UTF-8"]),
        ("[" * 9000, ["valid TOML"]),
        ("samples = 64\n", ["samples", "[doe]"]),
    ],
    ids=["empty", "cut off", "null", "utf-16", "nested", "misplaced"],
)
def test_spec_that_is_none(cli, tmp_path, text, words):
    spec = tmp_path / "spec.toml"
    spec.write_bytes(text if isinstance(text, bytes) else text.encode())
    refuse(cli("optimize", spec, "--out", tmp_path / "run"), spec, *words)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("process.levels=65", ["process.levels", "from 2 to 64", "65"]),
        ("optimize.stepz=3", ["optimize.stepz", "steps"]),
        ("doe.pitch=2 kg", ["doe.pitch"]),
        ("doe.samples=63", ["doe.aperture", "samples x pitch"]),
        ("name=../up", ["name"]),
        ("nonsense", ["KEY=VALUE"]),
        ('scene.far=["1 mm"]', ["scene.near"]),
        ('objective=[{name="no_such:thing"}]', ["no_such", "runs no code by itself", "--allow-code"]),
        ('objective=[{name="far_spot", options={reach=2}}]', ["far_spot"]),
        ('objective=[{name="target_pattern", options={image="none.png"}}]', ["none.png", "exist"]),
        ("optimize.start_options.pitch=3", ["start_options", "pitch"]),
    ],
)
def test_override_that_cannot_be(tiny, cli, tmp_path, override, words):
    refuse(cli("optimize", tiny, "--out", tmp_path / "run", "--set", override), *words)


def test_code_that_is_allowed_must_be_there(tiny, cli, tmp_path):
    override = 'objective=[{name="no_such:thing"}]'
    done = cli("optimize", tiny, "--out", tmp_path / "run", "--allow-code", "--set", override)
    refuse(done, "no_such", "importable module:function")


def test_loss_without_end(tiny, cli, tmp_path):
    weights = ("--set", "objective.0.weight=3e38", "--set", "objective.1.weight=3e38")
    refuse(cli("optimize", tiny, "--out", tmp_path / "run", *weights), "loss must stay finite")


def test_missing_files(cli, tmp_path):
    for command in ("optimize", "masks", "verify", "psf"):
        refuse(cli(command, tmp_path / "nothing"), tmp_path / "nothing")


# --- folders ------------------------------------------------------------------------------------------------------


def test_folder_of_another_spec(copied, tiny, cli, content):
    before = content(copied.run)
    done = cli("optimize", tiny, "--out", copied.run, "--set", "optimize.seed=7")
    refuse(done, copied.run, "another spec", "--out")
    assert content(copied.run) == before


def test_folder_with_other_content(finished, tiny, cli, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    refuse(cli("optimize", tiny, "--out", tmp_path), tmp_path, "other content")
    refuse(cli("masks", finished.run, "--out", tmp_path), tmp_path, "thesis.tex")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_each_command_leaves_the_others_folders_alone(copied, tiny, cli, content):
    before = content(copied.run), content(copied.order)
    refuse(cli("optimize", tiny, "--out", copied.order), copied.order, "format")
    refuse(cli("masks", copied.run, "--out", copied.run), copied.run, "format")
    for command in ("masks", "psf", "report", "certify", "simulate", "tolerance", "precompensate", "refine", "train"):
        images = ("--images", copied.run) if command == "train" else ()
        refuse(cli(command, copied.order, *images), copied.order, "but got a mask order", "runs/tiny")
    refuse(cli("verify", copied.run), copied.run, "but got a run", f"doedesign masks {copied.run}")
    assert (content(copied.run), content(copied.order)) == before


def test_folder_that_is_a_file_or_below_one(finished, tiny, cli, tmp_path):
    file = tmp_path / "file"
    file.write_text("mine")
    for out in (file, file / "below"):
        refuse(cli("optimize", tiny, "--out", out), out)
        refuse(cli("masks", finished.run, "--out", out), out)
    assert file.read_text() == "mine"


def test_a_users_note_among_results_is_not_lost(copied, cli, content):
    (copied.run / "psf" / "note.txt").write_text("look at the left")
    (copied.order / "note.txt").write_text("sent on Monday")
    before = content(copied.run), content(copied.order)
    refuse(cli("psf", copied.run, "--masks", copied.order), copied.run / "psf", "note.txt")
    refuse(cli("masks", copied.run, "--out", copied.order), copied.order, "note.txt")
    assert (content(copied.run), content(copied.order)) == before


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_disk_that_takes_no_more(copied, tiny, cli, content, tmp_path, monkeypatch, number):
    before = content(copied.run), content(copied.order)

    def full(_handle):
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        words = os.strerror(number)
        refuse(cli("optimize", tiny, "--out", tmp_path / "new"), tmp_path / "new", words)
        refuse(cli("masks", copied.run, "--out", tmp_path / "new order"), tmp_path / "new order", words)
        refuse(cli("masks", copied.run, "--out", copied.order), copied.order, words)
        refuse(cli("psf", copied.run, "--masks", copied.order), copied.run, words)
    assert (content(copied.run), content(copied.order)) == before
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} <= {
        path.name for folder in (copied.run, copied.order) for path in folder.rglob("*")
    }
    assert not list((tmp_path / "new").glob("*"))
    assert not (tmp_path / "new order").exists()


def test_a_run_sheet_is_not_written_without_its_light_because_a_disk_is_full(copied, cli, tmp_path, monkeypatch):
    def full(*_):
        with os_errors_explained(tmp_path):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(doedesign.lab.order, "predict_sheet", full)
    refuse(cli("masks", copied.run, "--out", tmp_path / "new order"), tmp_path, "No space left")
    assert not (tmp_path / "new order").exists()


def test_disk_that_fills_up_in_the_middle(finished, tiny, cli, content, tmp_path, monkeypatch):
    """The run stands at its last checkpoint, and goes on when there is room again."""
    run, write = tmp_path / "run", fab.archive.write_atomic
    room = iter(range(1))  # one checkpoint

    def filling(path, data):
        if next(room, None) is None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        write(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(fab.archive, "write_atomic", filling)
        refuse(cli("optimize", tiny, "--out", run), run / "checkpoint.npz", "No space left")
    assert {path.name for path in run.iterdir()} == {"manifest.json", "spec.toml", "checkpoint.npz"}
    done = cli("optimize", tiny, "--out", run)
    assert "resuming after step 2" in done.err
    heights = [(folder / "height.exr").read_bytes() for folder in (run, finished.run)]
    assert heights[0] == heights[1]


# --- run folders that changed -------------------------------------------------------------------------------------


def test_spec_changed_inside_a_run(copied, tiny, cli):
    spec = copied.run / "spec.toml"
    spec.write_text(spec.read_text().replace("seed = 0", "seed = 1"))
    for command in (("masks", copied.run), ("psf", copied.run), ("optimize", tiny, "--out", copied.run)):
        refuse(cli(*command), spec, "changed")


@pytest.mark.parametrize("name", ["level_map.npz", "height.exr", "height_continuous.exr"])
def test_height_changed_inside_a_run(copied, tiny, cli, name):
    if name.endswith(".exr"):
        write_height(copied.run / name, np.zeros((64, 64)), 1.85e-6, 118.4e-6)
    else:
        level_map = read_level_map(copied.run / name)
        write_level_map(copied.run / name, level_map.with_level(np.roll(level_map.level, 1)))
    for command in (("masks", copied.run), ("psf", copied.run), ("optimize", tiny, "--out", copied.run)):
        refuse(cli(*command), copied.run / name, "changed")
    (copied.run / name).unlink()
    refuse(cli("masks", copied.run), copied.run / name, "exist")


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": "doedesign run 1"}', '{"format": "doedesign run 2"}'])
def test_manifest_changed_inside_a_run(copied, tiny, cli, text):
    manifest = copied.run / "manifest.json"
    manifest.write_text(text)
    for command in (("masks", copied.run), ("psf", copied.run), ("optimize", tiny, "--out", copied.run)):
        refuse(cli(*command), manifest)


@pytest.mark.parametrize("key", ["state", "spec_sha256", "inputs_sha256", "results_sha256"])
def test_manifest_of_a_run_with_a_hole(copied, tiny, cli, key):
    path = copied.run / "manifest.json"
    manifest = json.loads(path.read_text())
    path.write_text(json.dumps(manifest | {key: 3}))
    refuse(cli("masks", copied.run), path, key)
    refuse(cli("optimize", tiny, "--out", copied.run), path, key)


def test_unfinished_run(tiny, cli, tmp_path, monkeypatch):
    monkeypatch.setattr("doedesign.optimization.write_history", lambda *_: main(["nonsense"]) and 1 / 0)
    with pytest.raises(ZeroDivisionError):
        cli("optimize", tiny, "--out", tmp_path / "run")
    refuse(cli("masks", tmp_path / "run"), tmp_path / "run", "unfinished", "Resume")
    refuse(cli("psf", tmp_path / "run"), tmp_path / "run", "unfinished", "Resume")


@pytest.mark.parametrize("damage", ["cut", "empty", "text", "flipped", "pickle"])
def test_checkpoint_that_is_none(copied, tiny, cli, tmp_path, damage):
    """A damaged checkpoint is refused, not guessed at; without it the run begins again and ends the same."""
    run = copied.run
    heights = (run / "height.exr").read_bytes()
    shutil.rmtree(run / "psf")
    manifest = json.loads((run / "manifest.json").read_text())
    del manifest["results_sha256"]
    (run / "manifest.json").write_text(json.dumps(manifest | {"state": "running"}))
    checkpoint = run / "checkpoint.npz"
    np.savez(checkpoint, array0=np.zeros((64, 64), np.float32), step=np.int64(2))
    if damage == "cut":
        cut(checkpoint)
    elif damage == "flipped":
        flip(checkpoint, 4000)
    elif damage == "pickle":
        checkpoint.write_bytes(pickle.dumps(Bomb(tmp_path / "exploded")))
    else:
        checkpoint.write_bytes(b"" if damage == "empty" else b"not a checkpoint")
    kept = checkpoint.read_bytes()
    refuse(cli("optimize", tiny, "--out", run), checkpoint, "whole checkpoint", "Remove checkpoint.npz")
    assert checkpoint.read_bytes() == kept
    assert not (tmp_path / "exploded").exists()
    checkpoint.unlink()
    assert cli("optimize", tiny, "--out", run).code == 0
    assert (run / "height.exr").read_bytes() == heights


# --- height maps a user brings ------------------------------------------------------------------------------------


def bad_maps():
    ramp = np.linspace(0, 1e-6, 300).reshape(15, 20)
    hole, dent = ramp.copy(), ramp.copy()
    hole[3, 4], dent[3, 4] = np.nan, -1e-9
    yield "nan", hole, ["finite", "row 3", "column 4"]
    yield "infinite", np.where(hole > -1, ramp, np.inf), ["finite", "row 3"]
    yield "negative", dent, ["negative", "row 3", "column 4", "-1 nm"]
    yield "too high", ramp * 1.3, ["above the top level", "16 levels of 75 nm"]
    yield "flat list", ramp[0], ["two axes"]
    yield "stack", ramp[None], ["two axes"]
    yield "nothing", ramp[:0], ["1 to"]
    yield "complex", ramp * 1j, ["real numbers"]
    yield "words", ramp.astype(str), ["real numbers"]
    yield "counts", np.ones((4, 4), int), ["scale"]


@pytest.mark.parametrize(("name", "values", "words"), list(bad_maps()), ids=[name for name, *_ in bad_maps()])
def test_height_map_that_cannot_be_made(cli, tmp_path, name, values, words):
    path = tmp_path / f"{name}.npy"
    np.save(path, values)
    refuse(cli("masks", path, *BARE, "--out", tmp_path / "order"), path, *words)
    assert not (tmp_path / "order").exists()


@pytest.mark.parametrize("suffix", [".npy", ".exr", ".tif", ".png"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9])
def test_height_map_cut_off(cli, tmp_path, suffix, share):
    from PIL import Image
    from tifffile import imwrite

    path = tmp_path / f"map{suffix}"
    counts = np.random.default_rng(5).integers(0, 1000, (40, 30), dtype=np.uint16)
    if suffix == ".npy":
        np.save(path, counts)
    elif suffix == ".exr":
        write_height(path, counts * 1e-9, 2e-6, 60e-6)
    elif suffix == ".tif":
        imwrite(path, counts)
    else:
        Image.fromarray(counts).save(path)
    cut(path, share)
    scale = () if suffix == ".exr" else ("--scale", "1 nm")
    refuse(cli("masks", path, *BARE, *scale, "--out", tmp_path / "order"), path)
    assert not (tmp_path / "order").exists()


def test_a_pickle_is_never_loaded(cli, tmp_path):
    bomb = np.array([[Bomb(tmp_path / "exploded")]], dtype=object)
    np.save(tmp_path / "bomb.npy", bomb, allow_pickle=True)
    (tmp_path / "raw.npy").write_bytes(pickle.dumps(bomb))
    np.savez(tmp_path / "bomb.npz", bomb, allow_pickle=True)
    (tmp_path / "bomb.npz").rename(tmp_path / "archive.npy")
    for name in ("bomb.npy", "raw.npy", "archive.npy"):
        refuse(cli("masks", tmp_path / name, *BARE), tmp_path / name)
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--step", "75 nm", "--pitch", "2 um"), ["--levels"]),
        (("--levels", 16, "--pitch", "2 um"), ["--step"]),
        (("--levels", 16, "--step", "75 nm"), ["--pitch"]),
        (("--levels", 65, "--step", "75 nm", "--pitch", "2 um"), ["from 2 to 64", "65"]),
        (("--levels", 10**30, "--step", "75 nm", "--pitch", "2 um"), ["from 2 to 64"]),
        (("--levels", 16, "--step", "75", "--pitch", "2 um"), ["--step", "unit"]),
        (("--levels", 16, "--step", "75 s", "--pitch", "2 um"), ["--step", "unit"]),
        (("--levels", 16, "--step", "0 nm", "--pitch", "2 um"), ["step", "positive"]),
        (("--levels", 16, "--step", "75 nm", "--pitch", "0 um"), ["pitch", "positive"]),
        (
            ("--levels", 16, "--step", "75 nm", "--pitch", "nan um"),
            ["--pitch", "must be a length with a unit", "nan um"],
        ),
        (("--levels", 16, "--step", "75 nm", "--pitch", "1e-9 um"), ["pixels"]),
        (("--levels", 16, "--step", "75 nm", "--pitch", "1e9 um"), ["pixels"]),
        (("--levels", 16, "--step", "75 nm", "--pitch", "2 um", "--aperture", "1 km"), ["aperture"]),
        (("--levels", 16, "--step", "75 nm", "--pitch", "2 um", "--aperture", "0 m"), ["aperture"]),
        (("--levels", 16, "--step", "75 nm", "--pitch", "2 um", "--scale", "0 m"), ["scale"]),
        (("--levels", 16, "--step", "75 nm", "--pitch", "2 um", "--colour", "red"), ["--colour"]),
    ],
)
def test_geometry_that_cannot_be(cli, tmp_path, options, words):
    np.save(tmp_path / "map.npy", np.zeros((15, 20)))
    refuse(cli("masks", tmp_path / "map.npy", *options, "--out", tmp_path / "order"), *words)
    assert not (tmp_path / "order").exists()


def test_file_of_another_kind(cli, tmp_path, tiny):
    from PIL import Image

    for geometry in (BARE, ()):
        refuse(cli("masks", tiny, *geometry), tiny, ".npy", "but got a spec", f"doedesign optimize {tiny}")
    (tmp_path / "text.exr").write_text("not an EXR")
    refuse(cli("masks", tmp_path / "text.exr", *BARE), tmp_path / "text.exr", "OpenEXR")
    Image.new("RGB", (20, 15)).save(tmp_path / "colours.png")
    refuse(cli("masks", tmp_path / "colours.png", *BARE, "--scale", "1 nm"), "colours.png", "colours")


def test_a_run_brings_its_own_geometry(finished, cli):
    for option, value in {"--step": "75 nm", "--pitch": "1 um", "--scale": "1 nm", "--aperture": "1 mm"}.items():
        refuse(cli("masks", finished.run, option, value), option, "its own geometry")
    refuse(cli("masks", finished.run, "--levels", 0), "from 2 to 64")


# --- mask orders that changed -------------------------------------------------------------------------------------


def mask_files(order: Path) -> list[str]:
    return sorted(path.name for path in order.iterdir() if path.suffix in (".gds", ".oas"))


@pytest.mark.slow
def test_one_flipped_byte_fails_verify_and_is_named(copied, cli):
    rng = np.random.default_rng(11)
    names = [*mask_files(copied.order), *(named(copied.order, end).name for end in ("LEVELS.npy", "PREVIEW.png"))]
    assert len(names) == 9
    for name in names:
        path = copied.order / name
        where = int(rng.integers(path.stat().st_size))
        flip(path, where)
        told = cli("verify", copied.order, "--json")
        assert told.code == 1, (name, where)
        assert "Traceback" not in told.err
        assert f"{name}: bytes as in the manifest" in told.err
        failed = [check for check in json.loads(told.out)["checks"] if check["problems"]]
        assert {check["file"] for check in failed} == {name}
        flip(path, where)
    assert cli("verify", copied.order).code == 0


@pytest.mark.slow
def test_files_missing_or_too_many_fail_verify(copied, cli):
    kept = b""
    for name in mask_files(copied.order):
        kept = (copied.order / name).read_bytes()
        (copied.order / name).unlink()
        done = cli("verify", copied.order)
        assert done.code == 1
        assert f"{name}: bytes as in the manifest: the file is missing" in done.err
        (copied.order / name).write_bytes(kept)
    (copied.order / "EXTRA.gds").write_bytes(kept)
    done = cli("verify", copied.order)
    assert done.code == 1
    assert "EXTRA.gds" in done.err


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_drawing_cut_off(copied, cli, content, share):
    drawing = named(copied.order, "M1_75NM.gds")
    cut(drawing, share)
    before = content(copied.run)
    refuse(cli("psf", copied.run, "--masks", copied.order), drawing)
    done = cli("verify", copied.order)
    assert done.code == 1
    assert drawing.name in done.err
    assert content(copied.run) == before


@pytest.mark.parametrize("text", ["", "{}", "[1, 2]", None])
def test_manifest_of_an_order_changed(copied, cli, text):
    manifest = copied.order / "manifest.json"
    manifest.write_text(manifest.read_text().replace("1.85", "1.86") if text is None else text)
    refuse(cli("verify", copied.order), manifest)
    refuse(cli("psf", copied.run, "--masks", copied.order), manifest)
    # What cannot be told from a user's own folder is not replaced.
    refuse(cli("masks", copied.run, "--out", copied.order), manifest)


@pytest.mark.slow
def test_masks_of_another_run(copied, tiny, cli, content, tmp_path):
    """Another design on the same raster is another run; of another raster or staircase, both are said."""
    other, order = tmp_path / "other", tmp_path / "other order"
    assert cli("optimize", tiny, "--out", other, "--set", "optimize.seed=9", "--set", "optimize.steps=0").code == 0
    assert cli("masks", other, "--out", order).code == 0
    before = content(copied.run)
    refuse(
        cli("psf", copied.run, "--masks", order), order, "those of this run", "those of another", "doedesign masks RUN"
    )
    drawn = content(order)
    refuse(cli("masks", copied.run, "--levels", 8, "--out", order), order, 'the design "tiny"', "--overwrite")
    assert content(order) == drawn
    assert cli("masks", copied.run, "--levels", 8, "--out", order, "--overwrite").code == 0
    refuse(cli("psf", copied.run, "--masks", order), order, "16 levels of 75 nm", "8 levels of 150 nm")
    np.save(tmp_path / "map.npy", np.zeros((15, 20)))
    refuse(cli("masks", tmp_path / "map.npy", *BARE, "--out", order), order, 'the design "tiny"', "--overwrite")
    assert cli("masks", tmp_path / "map.npy", *BARE, "--out", order, "--overwrite").code == 0
    refuse(cli("psf", copied.run, "--masks", order), order, "64 x 64 pixels of 1.85 um", "15 x 20 pixels of 2 um")
    assert content(copied.run) == before


# --- light --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--depths", "5"), ["--depths", "unit"]),
        (("--depths", "0 m"), ["--depths", "positive"]),
        (("--depths", "1 nm"), ["--depths", "10 um"]),
        (("--depths", "100 um"), ["--depths", "cells cannot follow"]),
        (("--depths", "1e300 m"), ["--depths", "between"]),
        (("--field-deg", "nan", "0"), ["--field-deg", "60 degrees"]),
        (("--field-deg", "0", "-61"), ["--field-deg", "60 degrees"]),
        (("--field-deg", "1"), ["--field-deg"]),
        (("--fields", "1"), ["--fields"]),
    ],
)
def test_light_that_cannot_be(copied, cli, content, options, words):
    before = content(copied.run)
    refuse(cli("psf", copied.run, "--masks", copied.order, *options), *words)
    assert content(copied.run) == before
