"""Run folders: whose they are, what is in them, and what is refused."""

import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from doedesign.overview.listing import list_results
from doedesign.runs.folder import (
    CHECKPOINT,
    Run,
    alone_in,
    begin_run,
    claim_run,
    finish_run,
    input_digests,
    load_checkpoint,
    open_run,
    save_checkpoint,
    write_history,
)
from doedesign.spec import Spec, input_files, load_spec
from doedesign.templates import template_text
from fab.archive import read_archive, write_archive
from fab.errors import InputError
from fab.files import atomic_folder, sha256_file, write_atomic

QUICK = Path(__file__).parents[2] / "examples" / "quick.toml"


@pytest.fixture(scope="module")
def spec() -> Spec:
    return load_spec(QUICK)


@pytest.fixture
def run(spec: Spec, tmp_path: Path) -> Run:
    """A run that has begun."""
    with claim_run(tmp_path / "run", spec, {}) as claimed:
        begin_run(claimed)
    return claimed


@pytest.fixture
def done(run: Run) -> Run:
    """A finished run with one result."""
    run.path("level_map.npz").write_bytes(b"levels")
    finish_run(run, ["level_map.npz", "spec.toml"])
    return run


def test_a_run_is_begun_resumed_and_finished(spec: Spec, tmp_path: Path):
    folder = tmp_path / "a" / "b"
    with claim_run(folder, spec, {"image": "ab"}, ["optimize.seed=1"]) as run:
        assert not run.done
        assert list(folder.iterdir()) == []
        begin_run(run)
    assert {path.name for path in folder.iterdir()} == {"manifest.json", "spec.toml"}
    assert load_spec(folder / "spec.toml") == spec
    assert "--set optimize.seed=1" in (folder / "spec.toml").read_text()
    with claim_run(folder, spec, {"image": "ab"}, ["optimize.seed=1"]) as run:
        assert not run.done
        save_checkpoint(run, [np.zeros(3)], 1, [])
        write_history(run, [{"step": 0}, {"step": 1}])
        finish_run(run, ["history.jsonl"])
    assert not (folder / CHECKPOINT).exists()
    assert (folder / "history.jsonl").read_text() == '{"step": 0}\n{"step": 1}\n'
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["results_sha256"] == {"history.jsonl": sha256_file(folder / "history.jsonl")}
    assert manifest["overrides"] == ["optimize.seed=1"]
    save_checkpoint(run, [np.zeros(3)], 2, [])  # as if stopped before the last line
    with claim_run(folder, spec, {"image": "ab"}, ["optimize.seed=1"]) as run:
        assert run.done
    assert not (folder / CHECKPOINT).exists()
    assert open_run(folder) == run


def test_a_refused_run_leaves_no_empty_folder(spec: Spec, tmp_path: Path):
    def refused(folder: Path, *, begins: bool = False) -> None:
        with claim_run(folder, spec, {}) as claimed:
            if begins:
                begin_run(claimed)
            raise InputError("spots", "must be", "none", "Add some.")

    (tmp_path / "own").mkdir()
    for name, begins in (("new", False), ("own", False), ("begun", True)):
        with pytest.raises(InputError):
            refused(tmp_path / name, begins=begins)
    assert not (tmp_path / "new").exists()
    assert (tmp_path / "own").is_dir()
    assert (tmp_path / "begun" / "manifest.json").is_file()


def test_another_spec_or_other_inputs_are_refused(run: Run, spec: Spec):
    other = load_spec(QUICK, ["optimize.seed=2"])
    save_checkpoint(run, ARRAYS, 2, HISTORY)
    for wanted, inputs in ((other, {}), (spec, {"image": "ab"})):
        with (
            pytest.raises(InputError, match="another spec or other input files"),
            claim_run(run.folder, wanted, inputs),
        ):
            pytest.fail("claimed")


def test_another_spec_overwrites_on_request_alone(done: Run, spec: Spec, tmp_path: Path):
    """The message says what differs, and what was made of the old run goes with it; the same spec loses nothing."""
    (done.folder / "psf").mkdir()
    (done.folder / "psf" / "manifest.json").write_text("{}")
    (tmp_path / "kept.txt").write_text("mine")
    (done.folder / "link").symlink_to(tmp_path)
    changed = load_spec(QUICK, ["optimize.seed=2", "objective[0].weight=3.0"])
    found = pytest.raises(InputError, match=r"spec\.toml has another objective, optimize\.seed\. .*give `overwrite`")
    with found, claim_run(done.folder, changed, {}):
        pytest.fail("claimed")
    with claim_run(done.folder, spec, {}, overwrite=True) as run:
        assert (run.folder / "psf" / "manifest.json").is_file()
    with claim_run(done.folder, changed, {}, overwrite=True) as run:
        assert not run.done
        assert [path.name for path in run.folder.iterdir()] == [".doedesign-aside"]
    assert (tmp_path / "kept.txt").read_text() == "mine"


def test_a_run_that_got_nowhere_gives_way(run: Run):
    """Such as one with a start that diverges at once: mend the spec and go on."""
    other = load_spec(QUICK, ["optimize.seed=2"])
    with claim_run(run.folder, other, {"image": "ab"}) as claimed:
        assert not claimed.done
        begin_run(claimed)
    assert load_spec(run.path("spec.toml")) == other


@pytest.mark.parametrize("writes", range(4))
def test_a_run_that_is_killed_while_it_begins_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writes: int):
    """Whatever number of its files it had written; and it gives way on request."""
    for name in ("goal.png", "phase.png"):
        (tmp_path / name).write_bytes(name.encode())
    (tmp_path / "top_hat.toml").write_text(template_text("top_hat"), "utf-8")
    area = ["shape='picture'", "picture='goal.png'", "phase='phase.png'", "width='500 um'"]
    spec = load_spec(tmp_path / "top_hat.toml", [f"area={{ {', '.join(area)} }}"])
    inputs, folder = input_digests(input_files(spec)), tmp_path / "run"

    class Killed(BaseException):
        pass

    done: list[Path] = []

    def until_killed(path: Path, data: bytes) -> None:
        if len(done) == writes:
            raise Killed
        done.append(path)
        write_atomic(path, data)

    monkeypatch.setattr("doedesign.runs.folder.write_atomic", until_killed)
    with pytest.raises(Killed), claim_run(folder, spec, inputs) as run:
        begin_run(run)
    monkeypatch.undo()
    with claim_run(folder, spec.model_copy(update={"name": "another"}), inputs, overwrite=True) as run:
        pass
    with claim_run(folder, spec, inputs) as run:
        begin_run(run)
    kept = {"area_picture.png": b"goal.png", "area_phase.png": b"phase.png"}
    assert {path.name for path in folder.iterdir()} == {"manifest.json", "spec.toml", *kept}
    assert {name: run.path(name).read_bytes() for name in kept} == kept


def test_a_run_that_chose_its_depths_still_has_its_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """They lie in its folder, wherever a command is called, and not where it is called."""
    (tmp_path / "beam.png").write_bytes(b"a beam")
    (tmp_path / "quick.toml").write_text(QUICK.read_text("utf-8"), "utf-8")
    beam = "illumination={ kind = 'picture', picture = 'beam.png', pixel = '2 um' }"
    plain = ["scene={ far = ['inf'] }", "objective=[{ name = 'far_spot' }]", "process.etch_depths=optimize"]
    spec = load_spec(tmp_path / "quick.toml", [beam, *plain])
    with claim_run(tmp_path / "run", spec, {}) as run:
        begin_run(run)
        finish_run(run, [], [spec.process.depth_m(mask) for mask in range(spec.process.masks)])
    (tmp_path / "beam.png").unlink()
    monkeypatch.chdir(tmp_path)
    found = open_run(Path("run")).spec
    assert not found.process.chooses_depths
    assert input_files(found) == {"illumination.picture": Path("run/illumination_picture.png")}


def test_equal_specs_are_the_same_however_written(run: Run):
    with claim_run(run.folder, load_spec(QUICK, ["optics.focal_length=0.1 cm"]), {}) as claimed:
        assert claimed.spec == run.spec


@pytest.mark.parametrize("name", ["notes.txt", "spec.toml", ".hidden"])
def test_foreign_folders_and_files_are_refused(spec: Spec, tmp_path: Path, name: str):
    (tmp_path / name).write_text("mine")
    for folder in (tmp_path, tmp_path / name, tmp_path / name / "below"):
        with pytest.raises(InputError) as caught, claim_run(folder, spec, {}):
            pytest.fail("claimed")
        assert str(folder) in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"


def test_one_process_at_a_time(run: Run, spec: Spec):
    with alone_in(run.folder):
        with pytest.raises(InputError, match="only one process"), claim_run(run.folder, spec, {}):
            pytest.fail("claimed")
        with pytest.raises(InputError, match="unfinished"):  # and not that it is in use: reading needs no claim
            open_run(run.folder)
    with claim_run(run.folder, spec, {}):
        pass


def test_locks_may_be_missing(run: Run, monkeypatch: pytest.MonkeyPatch):
    def unsupported(*_: object) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("fcntl.flock", unsupported)
    with alone_in(run.folder), alone_in(run.folder):
        write_atomic(run.path("psf.json"), b"{}")
    assert run.path("psf.json").read_bytes() == b"{}"


def test_a_run_comes_back_where_nothing_takes_its_place(done: Run, spec: Spec):
    """A mistake that is found after it was asked to be overwritten, or a kill, loses nothing."""
    changed = spec.model_copy(update={"name": "another"})
    (done.folder / "notes.txt").write_text("mine")
    before = {path.name for path in done.folder.iterdir()}
    with pytest.raises(InputError, match="mistake"), claim_run(done.folder, changed, {}, overwrite=True):
        raise InputError("objective", "mistake", "one", "Correct it.")
    assert {path.name for path in done.folder.iterdir()} == before
    with claim_run(done.folder, changed, {}, overwrite=True) as run:
        begin_run(run)
        assert {path.name for path in done.folder.iterdir()} == {"manifest.json", "spec.toml"}


@pytest.mark.parametrize("written", range(3))
def test_a_run_comes_back_where_the_disk_is_full_when_the_other_begins(
    done: Run, spec: Spec, written: int, monkeypatch: pytest.MonkeyPatch
):
    """After so many of the other's first files; what removes the run that waits is the last thing that begins it."""
    changed, left = spec.model_copy(update={"name": "another"}), written
    before = {path.name: path.read_bytes() for path in done.folder.iterdir()}

    def full(path: Path, content: bytes) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise InputError(str(path), "there must be room on the disk", "No space left on device", "Make room.")
        write_atomic(path, content)

    def overwritten() -> None:
        with claim_run(done.folder, changed, {}, overwrite=True) as run:
            begin_run(run)
            assert written == 2

    with monkeypatch.context() as patch:
        patch.setattr("doedesign.runs.folder.write_atomic", full)
        if written < 2:
            with pytest.raises(InputError, match="No space"):
                overwritten()
        else:
            overwritten()
    with claim_run(done.folder, changed if written == 2 else spec, {}) as run:
        assert run.done == (written < 2)
    if written < 2:
        assert {path.name: path.read_bytes() for path in done.folder.iterdir()} == before


def test_a_run_that_waits_is_told_as_such(done: Run, spec: Spec, monkeypatch: pytest.MonkeyPatch):
    """Where a kill left it."""
    changed = spec.model_copy(update={"name": "another"})

    def overwritten() -> None:
        with claim_run(done.folder, changed, {}, overwrite=True):
            monkeypatch.setattr("doedesign.runs.aside._restore", lambda _: None)
            raise Killed

    with pytest.raises(Killed):
        overwritten()
    (entry,) = list_results([done.folder.parent])
    assert (entry.path, entry.state) == (done.folder, "stopped")
    assert "brings it back" in entry.about
    with pytest.raises(InputError, match=r"A run waits in \.doedesign-aside"):
        open_run(done.folder)


@pytest.mark.parametrize("moves", range(4))
def test_a_run_comes_back_wherever_a_kill_fell(done: Run, spec: Spec, moves: int, monkeypatch: pytest.MonkeyPatch):
    """After so many files were moved aside; and then after so many were moved back."""
    changed, rename, left = spec.model_copy(update={"name": "another"}), Path.rename, moves
    before = {path.name: path.read_bytes() for path in done.folder.iterdir()}

    def killed(path: Path, target: Path) -> Path:
        nonlocal left
        left -= 1
        if left < 0:
            raise Killed
        return rename(path, target)

    def overwritten() -> None:
        with claim_run(done.folder, changed, {}, overwrite=True):
            raise Killed

    for _ in range(2):
        with monkeypatch.context() as patch:
            patch.setattr(Path, "rename", killed)
            with pytest.raises(Killed):
                overwritten()
        left = moves + 1
    with claim_run(done.folder, spec, {}) as run:
        assert run.done
    assert {path.name: path.read_bytes() for path in done.folder.iterdir()} == before


def test_a_run_behind_a_link_and_the_current_folder_can_be_overwritten(
    done: Run, spec: Spec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "elsewhere").mkdir()
    link = tmp_path / "elsewhere" / "run"
    link.symlink_to(done.folder.resolve())
    monkeypatch.chdir(done.folder)
    for folder, name in ((link, "another"), (Path(), "a third")):
        with claim_run(folder, spec.model_copy(update={"name": name}), {}, overwrite=True) as run:
            begin_run(run)
            assert {path.name for path in folder.iterdir()} == {"manifest.json", "spec.toml"}


class Killed(BaseException):
    """In place of a signal that no process survives."""


def test_only_temporary_files_are_cleared_away(run: Run):
    kept = [".gitignore", ".notes.txt.abcdefgh", "checkpoint.npz.abcdefgh", ".height.exr.bak", ".psf.exr"]
    kept += [".checkpoint.npz.original", ".psf.new.abcdefgh"]  # of people
    swept = [
        f".{name}.doedesign-file.abcd_123" for name in ("checkpoint.npz", "manifest.json", "height_continuous.exr")
    ]
    for name in kept + swept:
        run.path(name).write_text("")
    run.path(".psf.doedesign-new.abcdefgh").mkdir()
    with alone_in(run.folder):
        assert {path.name for path in run.folder.iterdir()} == {*kept, "manifest.json", "spec.toml"}


def test_what_a_living_process_writes_in_a_run_is_left_alone(run: Run):
    """Such as a picture or PSFs by a command that needs no claim; a result that a killed one moved aside comes back."""
    aside = run.path(".certificate.doedesign-old.abcd_123")
    (aside / "certificate").mkdir(parents=True)
    (aside / "certificate" / "manifest.json").write_text("{}")
    with atomic_folder(run.path("psf")) as fresh:
        (fresh / "x").write_text("1")
        with alone_in(run.folder):
            pass
        assert (fresh / "x").exists()
    assert {path.name for path in run.folder.iterdir()} == {"manifest.json", "spec.toml", "psf", "certificate"}
    assert [path.name for path in run.path("certificate").iterdir()] == ["manifest.json"]


def test_nothing_stays_open(run: Run, spec: Spec):
    before = len(os.listdir("/dev/fd"))
    for _ in range(5):
        with claim_run(run.folder, spec, {}):
            pass
    assert len(os.listdir("/dev/fd")) == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda run: run.path("manifest.json").unlink(), "has a manifest.json"),
        (lambda run: run.path("manifest.json").write_text("{"), "must be JSON"),
        (lambda run: run.path("manifest.json").write_text('{"format": "other"}'), "must say format"),
        (lambda run: run.path("spec.toml").unlink(), "must exist"),
        (lambda run: run.path("spec.toml").write_text("name = 3"), "spec.toml"),
        (lambda run: run.path("spec.toml").write_text(QUICK.read_text().replace("seed = 1", "seed = 2")), "changed"),
        (lambda run: run.path("level_map.npz").write_bytes(b"other"), "the file this run wrote"),
        (lambda run: run.path("level_map.npz").unlink(), "must exist"),
    ],
)
def test_a_changed_run_is_refused(done: Run, change: Callable[[Run], object], message: str):
    assert open_run(done.folder).done
    change(done)
    with pytest.raises(InputError, match=message) as caught:
        open_run(done.folder)
    assert str(done.folder) in str(caught.value)


def test_a_run_that_is_none(tmp_path: Path):
    for folder in (tmp_path / "nothing", tmp_path):
        with pytest.raises(InputError, match="run folder"):
            open_run(folder)


@pytest.mark.parametrize("key", ["format", "state", "spec_sha256", "inputs_sha256", "results_sha256"])
@pytest.mark.parametrize("value", [None, 3, []])
def test_a_manifest_with_a_hole(done: Run, key: str, value: object):
    path = done.path("manifest.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(InputError, match=r"manifest\.json"):
        open_run(done.folder)


def test_input_digests_name_a_missing_file(tmp_path: Path):
    (tmp_path / "a").write_text("a")
    assert input_digests({"start": tmp_path / "a"}) == {"start": sha256_file(tmp_path / "a")}
    with pytest.raises(InputError, match="must exist"):
        input_digests({"start": tmp_path / "b"})


ARRAYS = [np.arange(12, dtype=np.float32).reshape(3, 4), np.array(7, np.int32), np.linspace(0, 1, 5, dtype=np.float32)]
HISTORY = [{"step": 0, "loss": 0.1}, {"step": 1, "loss": 1e-300}]


def test_checkpoint_round_trip(run: Run):
    assert load_checkpoint(run, ARRAYS) is None
    save_checkpoint(run, ARRAYS, 2, HISTORY)
    stored = load_checkpoint(run, ARRAYS)
    assert stored is not None
    arrays, step, history = stored
    assert step == 2
    assert history == HISTORY
    for found, saved in zip(arrays, ARRAYS, strict=True):
        assert found.dtype == saved.dtype
        assert np.array_equal(found, saved)


def test_equal_checkpoints_have_equal_bytes(run: Run):
    save_checkpoint(run, ARRAYS, 2, HISTORY)
    first = run.path(CHECKPOINT).read_bytes()
    save_checkpoint(run, ARRAYS, 2, HISTORY)
    assert run.path(CHECKPOINT).read_bytes() == first


def test_a_checkpoint_of_something_else(run: Run):
    save_checkpoint(run, ARRAYS, 2, HISTORY)
    first, second, third = ARRAYS
    others = (
        [first, second, third[:4]],
        [first.T, second, third],
        [*ARRAYS, second],
        [first.astype(float), second, third],
    )
    for like in others:
        with pytest.raises(InputError, match=CHECKPOINT):
            load_checkpoint(run, like)
    other = Run(run.folder, load_spec(QUICK, ["optimize.seed=2"]), done=False)
    with pytest.raises(InputError, match="another spec"):
        load_checkpoint(other, ARRAYS)


@pytest.mark.parametrize(
    "header",
    [{"step": "2"}, {"step": True}, {"step": None}, {"history": 3}, {"history": [1]}, {"history": [{"step": 0}]},
     {"history": [{"step": 0, "loss": "x"}]}, {"history": [{"step": 0, "loss": 1.0, "terms": "x"}]}],
)  # fmt: skip
def test_a_checkpoint_that_was_sealed_again_with_other_content_is_refused(run: Run, header: dict[str, Any]):
    save_checkpoint(run, ARRAYS, 2, HISTORY)
    path = run.path(CHECKPOINT)
    before, arrays = read_archive(path, "checkpoint", "")
    write_archive(path, {**before, **header}, arrays)
    with pytest.raises(InputError, match="must hold a number of steps and a record of each"):
        load_checkpoint(run, ARRAYS)


def test_damage_is_found_or_harmless(run: Run):
    """Cut or flipped anywhere, a checkpoint is refused with a cure, or gives exactly what was saved."""
    save_checkpoint(run, ARRAYS, 2, HISTORY)
    whole = run.path(CHECKPOINT).read_bytes()
    damaged = [whole[:n] for n in range(0, len(whole), 61)]
    for where in range(0, len(whole), 5):
        data = bytearray(whole)
        data[where] ^= 1 << (where % 8)
        damaged.append(bytes(data))
    refused = 0
    for data in damaged:
        run.path(CHECKPOINT).write_bytes(data)
        try:
            stored = load_checkpoint(run, ARRAYS)
        except InputError as error:
            refused += error.cure.startswith(f"Remove {CHECKPOINT}")
            continue
        assert stored is not None
        assert stored[1:] == (2, HISTORY)
        assert all(np.array_equal(a, b) for a, b in zip(stored[0], ARRAYS, strict=True))
    # Names, times and padding of the archive are about a third of it; everything else is guarded.
    assert refused > len(damaged) / 2


class Bomb:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_checkpoint_is_never_unpickled(run: Run, tmp_path: Path):
    bomb = Bomb(tmp_path / "exploded")
    run.path(CHECKPOINT).write_bytes(pickle.dumps(bomb))
    with pytest.raises(InputError, match="whole checkpoint"):
        load_checkpoint(run, ARRAYS)
    np.savez(run.path(CHECKPOINT), allow_pickle=True, array0=np.array([bomb], dtype=object))
    with pytest.raises(InputError, match="whole checkpoint"):
        load_checkpoint(run, ARRAYS)
    assert not (tmp_path / "exploded").exists()
