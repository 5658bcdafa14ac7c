import json
import os
import signal
import subprocess
import sys
import textwrap
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from fab.errors import CheckFailed, InputError
from fab.files import (
    atomic_folder,
    canonical_json,
    read_bytes,
    read_json,
    read_npy,
    sha256_bytes,
    sha256_file,
    write_atomic,
)

ROOT = Path(__file__).parents[2]


def test_input_error_names_place_rule_value_and_cure():
    error = InputError("spec.toml: levels", "must be at least 2", 1, "Choose 8 or 16.")
    assert str(error) == "spec.toml: levels: must be at least 2, but got 1. Choose 8 or 16."
    assert isinstance(error, ValueError)


def test_check_failed_lists_its_differences():
    error = CheckFailed(["a.gds: one", "b.gds: two"])
    assert error.differences == ("a.gds: one", "b.gds: two")
    assert str(error) == "a.gds: one\nb.gds: two"


def test_write_atomic_replaces_the_file_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "deep" / "file.bin"
    write_atomic(path, b"old")
    write_atomic(path, b"new")
    assert path.read_bytes() == b"new"
    assert [p.name for p in path.parent.iterdir()] == ["file.bin"]


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
def test_files_and_folders_have_the_permissions_of_others(tmp_path, mask):
    before = os.umask(mask)
    try:
        write_atomic(tmp_path / "file.bin", b"new")
        with atomic_folder(tmp_path / "folder"):
            pass
    finally:
        os.umask(before)
    assert (tmp_path / "file.bin").stat().st_mode & 0o777 == 0o666 & ~mask
    assert (tmp_path / "folder").stat().st_mode & 0o777 == 0o777 & ~mask


def test_write_atomic_keeps_the_old_content_when_the_new_cannot_be_written(tmp_path, monkeypatch):
    path = tmp_path / "file.bin"
    write_atomic(path, b"old")

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="must have room"):
        write_atomic(path, b"new")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["file.bin"]


def test_a_path_under_a_file_is_refused_by_name(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=r"file/out"):
        write_atomic(tmp_path / "file" / "out.bin", b"")
    with pytest.raises(InputError, match=r"file/out"), atomic_folder(tmp_path / "file" / "out"):
        pass


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no /proc")
def test_where_nothing_can_be_made_is_refused_at_once():
    with pytest.raises(InputError, match="/proc/doedesign"):
        write_atomic("/proc/doedesign.toml", b"x")
    with pytest.raises(InputError, match="/proc/doedesign"), atomic_folder("/proc/doedesign"):
        pass


def test_a_folder_that_may_not_be_written_is_refused(tmp_path):
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="must be writable"), atomic_folder(tmp_path / "out"):
        pass


def test_a_folder_appears_whole(tmp_path):
    path = tmp_path / "a" / "out"
    with atomic_folder(path) as fresh:
        (fresh / "x.txt").write_text("1")
        (fresh / "sub").mkdir()
        (fresh / "sub" / "y.txt").write_text("2")
        assert not path.exists()
    assert (path / "sub" / "y.txt").read_text() == "2"
    assert [p.name for p in path.parent.iterdir()] == ["out"]


def break_off(path):
    """Start filling a folder and fail in the middle."""
    with atomic_folder(path) as fresh:
        (fresh / "new.txt").write_text("new")
        raise RuntimeError


def test_an_exception_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError):
        break_off(tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_an_earlier_result_is_replaced_only_at_the_end(tmp_path):
    path = tmp_path / "out"
    with atomic_folder(path) as fresh:
        (fresh / "manifest.json").write_text("{}")
        (fresh / "old.txt").write_text("old")
    with pytest.raises(RuntimeError):
        break_off(path)
    assert (path / "old.txt").exists()
    with atomic_folder(path) as fresh:
        (fresh / "new.txt").write_text("new")
    assert [p.name for p in path.iterdir()] == ["new.txt"]
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_foreign_content_is_refused_and_kept(tmp_path):
    path = tmp_path / "out"
    path.mkdir()
    (path / "thesis.tex").write_text("precious")
    with pytest.raises(InputError, match=r"thesis\.tex"), atomic_folder(path):
        pass
    assert (path / "thesis.tex").read_text() == "precious"
    with pytest.raises(InputError, match="must be a folder"), atomic_folder(path / "thesis.tex"):
        pass


def test_a_link_to_itself_is_refused(tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    expected = pytest.raises(InputError, match=r"loop: the output must be a folder, but got a link to itself")
    with expected, atomic_folder(tmp_path / "loop"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["loop"]


def test_an_empty_folder_may_be_filled(tmp_path):
    (tmp_path / "out").mkdir()
    with atomic_folder(tmp_path / "out") as fresh:
        (fresh / "x").write_text("1")
    assert (tmp_path / "out" / "x").exists()


def test_what_a_killed_process_was_writing_is_cleared_by_the_next(tmp_path):
    (tmp_path / ".out.doedesign-new.abcd_123").mkdir()
    (tmp_path / ".out.doedesign-new.abcd_123" / "half.gds").write_text("half")
    (tmp_path / ".file.bin.doedesign-file.k2_x81ab").write_bytes(b"half")
    others = {".outer.doedesign-new.abcd_123", ".out.doedesign-new.mine", ".file.bin.backup1.old"}
    others |= {".file.bin.original", ".out.original", ".out.previous", ".out.new.abcd_123"}  # of people
    for name in others:
        (tmp_path / name).write_text("mine")
    with atomic_folder(tmp_path / "out") as fresh:
        (fresh / "x").write_text("1")
    write_atomic(tmp_path / "file.bin", b"whole")
    assert {path.name for path in tmp_path.iterdir()} == {"out", "file.bin", *others}


def test_what_a_living_process_writes_is_left_alone(tmp_path):
    with atomic_folder(tmp_path / "out") as first:
        (first / "x").write_text("1")
        with atomic_folder(tmp_path / "out") as second:
            (second / "manifest.json").write_text("{}")
        assert (first / "x").exists()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["x"]


def test_an_earlier_result_comes_back_whenever_its_replacement_is_stopped(tmp_path, monkeypatch):
    """By a signal between the two renames, or by a kill there, after which the next call finds it moved aside."""
    path, rename = tmp_path / "out", Path.rename
    with atomic_folder(path) as fresh:
        (fresh / "manifest.json").write_text("{}")

    def stopped(source, target):
        if source.name.startswith(".out.doedesign-new."):
            raise KeyboardInterrupt
        return rename(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", stopped)
        with pytest.raises(KeyboardInterrupt), atomic_folder(path) as fresh:
            (fresh / "x").write_text("1")
    assert (path / "manifest.json").exists()
    (tmp_path / ".out.doedesign-old.abcd_123").mkdir()
    path.rename(tmp_path / ".out.doedesign-old.abcd_123" / "out")
    with pytest.raises(RuntimeError):
        break_off(path)
    assert [found.name for found in path.iterdir()] == ["manifest.json"]
    assert [found.name for found in tmp_path.iterdir()] == ["out"]


def test_a_kill_in_the_middle_leaves_nothing_at_the_final_path(tmp_path):
    code = f"""
        import os, signal
        from fab.files import atomic_folder
        with atomic_folder({str(tmp_path / "out")!r}) as fresh:
            (fresh / "x.txt").write_text("1")
            os.kill(os.getpid(), signal.SIGKILL)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], cwd=ROOT, check=False)
    assert done.returncode == -signal.SIGKILL
    assert not (tmp_path / "out").exists()


def test_digests_agree(tmp_path):
    (tmp_path / "x").write_bytes(b"abc")
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert sha256_file(tmp_path / "x") == sha256_bytes(b"abc") == known
    with pytest.raises(InputError, match="must exist"):
        sha256_file(tmp_path / "missing")


def test_canonical_json_depends_on_the_value_alone():
    data = canonical_json({"b": 1, "a": [1.5, None, "µ"]})
    assert data == canonical_json({"a": [1.5, None, "µ"], "b": 1})
    assert data.endswith(b"\n")
    assert json.loads(data) == {"a": [1.5, None, "µ"], "b": 1}
    with pytest.raises(ValueError, match="JSON"):
        canonical_json({"x": float("nan")})


@pytest.mark.parametrize("content", [b"{", b"[1]", b"\xff\xfe", b""])
def test_read_json_refuses_what_is_no_object(tmp_path, content):
    path = tmp_path / "manifest.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"manifest\.json"):
        read_json(path)
    with pytest.raises(InputError, match="must exist"):
        read_json(tmp_path / "missing.json")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": 1, "a": 2}', "the key 'a' stands twice"),
        ('{"a": {"b": NaN}}', "a.b: must be a finite number"),
        ('{"a": -Infinity}', "a: must be a finite number"),
        (f'{{"a": [1, -1{400 * "0"}]}}', "a.1: must be a finite number, but got a whole number of 401 digits"),
        ('{"a": ' + "[" * 100_000, "brackets without end"),
        ('{"a": ' + "1" * 5000 + "}", "4300 digits"),
    ],
)
def test_read_json_takes_nothing_ambiguous(tmp_path, text, words):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_json(path)


@pytest.mark.parametrize("read", [read_bytes, read_json, read_npy, sha256_file])
def test_what_is_no_file_is_refused_at_once(tmp_path, read):
    """A pipe that nobody writes to would be waited for."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="pipe: must be a file, but got a pipe, socket or device"):
        read(tmp_path / "pipe")
    with pytest.raises(InputError, match="the path must be a file"):
        read(tmp_path)


def test_no_pipe_or_device_is_replaced_by_a_file(tmp_path):
    """Whoever may do so replaced /dev/null, for every program of the machine, by a report."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "null").symlink_to("/dev/null")
    (tmp_path / "stdout").symlink_to("/proc/self/fd/1")
    before = {path.name: os.lstat(path).st_ino for path in tmp_path.iterdir()}
    for name in before:
        with pytest.raises(InputError, match=f"{name}: must be a file, or nothing yet, but got a pipe, socket or dev"):
            write_atomic(tmp_path / name, b"report")
    assert {path.name: os.lstat(path).st_ino for path in tmp_path.iterdir()} == before
    (tmp_path / "elsewhere").write_bytes(b"kept")
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    write_atomic(tmp_path / "link", b"report")  # a link that somebody planted leads nowhere else
    assert (tmp_path / "elsewhere").read_bytes() == b"kept"


def test_a_file_beyond_the_limit_is_refused(tmp_path):
    (tmp_path / "large").write_bytes(b"12345")
    assert read_bytes(tmp_path / "large", 5) == b"12345"
    with pytest.raises(InputError, match="must have at most 4 bytes, but got 5"):
        read_bytes(tmp_path / "large", 4)


def test_read_npy_round_trip(tmp_path):
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    np.save(tmp_path / "a.npy", values)
    assert np.array_equal(read_npy(tmp_path / "a.npy"), values)
    with pytest.raises(InputError, match="plain numbers"):
        read_npy(tmp_path / "a.npy", most=5)


def test_read_npy_loads_no_pickle(tmp_path):
    np.save(tmp_path / "a.npy", np.array([print, None], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match=r"a\.npy"):
        read_npy(tmp_path / "a.npy")


def test_read_npy_refuses_archives_and_ruins(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.zeros(3))
    np.save(tmp_path / "b.npy", np.zeros((4, 4)))
    whole = (tmp_path / "b.npy").read_bytes()
    (tmp_path / "cut.npy").write_bytes(whole[:-1])
    (tmp_path / "empty.npy").write_bytes(b"")
    (tmp_path / "huge.npy").write_bytes(
        whole.replace(b"(4, 4)", b"(9999999999, 9999999999)").replace(b" " * 20, b"", 1)
    )
    for name in ("a.npz", "cut.npy", "empty.npy", "huge.npy", "missing.npy"):
        with pytest.raises(InputError, match=name):
            read_npy(tmp_path / name)


def test_read_npy_survives_any_flipped_header_byte(tmp_path):
    np.save(tmp_path / "b.npy", np.zeros((4, 4)))
    whole = (tmp_path / "b.npy").read_bytes()
    for position in range(128):
        damaged = bytearray(whole)
        damaged[position] ^= 0x08
        (tmp_path / "d.npy").write_bytes(damaged)
        # Read or refused: any other exception would fail here.
        with suppress(InputError):
            read_npy(tmp_path / "d.npy")


def test_bytes_of_a_name_that_are_no_text_are_written_as_text(tmp_path: Path):
    data = canonical_json({"file": "caf\udce9.npy", "other": "µ\\"})
    assert json.loads(data) == {"file": "caf\\udce9.npy", "other": "µ\\"}
    assert canonical_json(json.loads(data)) == data


def test_a_folder_whose_name_is_no_text_is_refused(tmp_path: Path):
    # Libraries for layouts and solids cannot open files in it.
    with pytest.raises(InputError, match="must be UTF-8 text"), atomic_folder(tmp_path / "caf\udce9"):
        pass
    assert not list(tmp_path.iterdir())
