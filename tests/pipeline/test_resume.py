"""A run that is stopped at any moment, in any way, ends with the bytes of one that was not."""

import json
import os
import signal
import time
from pathlib import Path

import pytest

import doedesign.optimization
import doedesign.runs.folder
from doedesign.runs.folder import alone_in

# Long enough to be killed in the middle, with a checkpoint every few milliseconds.
LONG = ("--set", "optimize.steps=400", "--set", "optimize.checkpoint_every=10")


@pytest.fixture(scope="module")
def uninterrupted(tiny, cli, content, tmp_path_factory):
    folder = tmp_path_factory.mktemp("uninterrupted") / "run"
    assert cli("optimize", tiny, "--out", folder, *LONG).code == 0
    return content(folder)


def wait_for(path: Path, process) -> None:
    end = time.monotonic() + 60
    while not path.exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.002)


@pytest.mark.parametrize(
    ("kind", "code"),
    [(signal.SIGKILL, -signal.SIGKILL), (signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGHUP, 130)],
)
@pytest.mark.slow
def test_killed_after_a_checkpoint(tiny, cli, content, uninterrupted, start_process, tmp_path, kind, code):
    folder = tmp_path / "run"
    process = start_process("optimize", tiny, "--out", folder, *LONG)
    wait_for(folder / "checkpoint.npz", process)
    process.send_signal(kind)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (code, "")
    assert "Traceback" not in err
    assert json.loads((folder / "manifest.json").read_text())["state"] == "running"
    done = cli("optimize", tiny, "--out", folder, *LONG)
    assert done.code == 0
    assert "resuming after step" in done.err
    assert content(folder) == uninterrupted


@pytest.mark.slow
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_order_that_is_ended_leaves_nothing_behind(copied, start_process, tmp_path, kind):
    out = tmp_path / "orders" / "order"
    out.parent.mkdir()
    process = start_process("masks", copied.run, "--out", out)
    end = time.monotonic() + 60
    while not any(out.parent.rglob("*_M1_*")):  # the folder alone may be no older than the signal
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.002)
    process.send_signal(kind)
    out_text, err = process.communicate(timeout=60)
    assert (process.returncode, out_text) == (130, "")
    assert "doedesign: interrupted" in err
    assert "Traceback" not in err
    assert not any(out.parent.iterdir())


@pytest.mark.slow
def test_a_second_process_is_kept_out(tiny, cli, start_process, tmp_path):
    folder = tmp_path / "run"
    process = start_process("optimize", tiny, "--out", folder, *LONG)
    wait_for(folder / "manifest.json", process)
    done = cli("optimize", tiny, "--out", folder, *LONG)
    process.kill()
    process.communicate(timeout=60)
    assert done.code == 2
    assert "only one process may work in a run folder" in done.err
    # The system let go of the folder when the first process died.
    assert cli("optimize", tiny, "--out", folder, *LONG).code == 0


@pytest.fixture(scope="module")
def finished_files(finished, content):
    return {name: data for name, data in content(finished.run).items() if not name.startswith("psf/")}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "name"),
    [
        (doedesign.runs.folder, "spec_to_resolved_toml"),  # between the manifest and the spec
        (doedesign.optimization, "steps"),  # before the first step
        (doedesign.optimization, "save_checkpoint"),  # before the first checkpoint
        (doedesign.optimization, "write_history"),  # between the height maps and the rest
        (doedesign.optimization, "plot_encircled"),  # among the pictures
        (doedesign.optimization, "finish_run"),  # when all is written and nothing is said to be done
    ],
)
def test_stopped_in_between(tiny, cli, content, finished_files, tmp_path, monkeypatch, module, name):
    def stop(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module, name, stop)
        done = cli("optimize", tiny, "--out", tmp_path / "run")
    assert done.code == 130
    assert "Traceback" not in done.err
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["state"] == "running"
    assert cli("optimize", tiny, "--out", tmp_path / "run").code == 0
    assert content(tmp_path / "run") == finished_files


@pytest.mark.slow
@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("every", [2, 5, 7])
def test_stopped_at_every_few_writes(tiny, cli, content, tmp_path, monkeypatch, every):
    """Three attempts in a row are stopped while they force a file or a folder to the disk."""
    sync, calls = os.fsync, 0

    def stop(handle):
        nonlocal calls
        calls += 1
        if calls % every == 0:
            raise KeyboardInterrupt
        sync(handle)

    changes = ("--set", "optimize.steps=3", "--set", "optimize.checkpoint_every=1")
    assert cli("optimize", tiny, "--out", tmp_path / "whole", *changes).code == 0
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", stop)
        codes = [cli("optimize", tiny, "--out", tmp_path / "run", *changes).code for _ in range(3)]
    assert codes[0] == 130
    assert cli("optimize", tiny, "--out", tmp_path / "run", *changes).code == 0
    assert content(tmp_path / "run") == content(tmp_path / "whole")


@pytest.mark.usefixtures("without_pictures")
def test_what_a_killed_process_was_writing_is_cleared_away(copied, tiny, cli, content):
    before = content(copied.run)
    (copied.run / ".checkpoint.npz.doedesign-file.k2_x81ab").write_bytes(b"half")
    (copied.run / ".manifest.json.doedesign-file.00000000").write_bytes(b"")
    (copied.run / ".psf.doedesign-new.abcdefgh").mkdir()
    (copied.run / ".psf.doedesign-new.abcdefgh" / "continuous.exr").write_bytes(b"half")
    assert cli("optimize", tiny, "--out", copied.run).code == 0
    assert content(copied.run) == before


@pytest.mark.slow
def test_killed_before_the_manifest_was_whole(tiny, cli, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".manifest.json.doedesign-file.k2_x81ab").write_bytes(b"half")
    assert cli("optimize", tiny, "--out", tmp_path / "run", "--set", "optimize.steps=0").code == 0


@pytest.mark.slow
@pytest.mark.usefixtures("without_pictures")
def test_the_last_call_tells_how_the_spec_came_about(tiny, cli, content, tmp_path, monkeypatch):
    """The same spec said in two ways: an edited file, or the override that was used at first."""
    spec, run = tmp_path / "edited.toml", tmp_path / "run"
    spec.write_text(tiny.read_text().replace("steps = 6", "steps = 4"))
    with monkeypatch.context() as patch:
        patch.setattr(doedesign.optimization, "finish_run", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            cli("optimize", tiny, "--out", run, "--set", "optimize.steps=4")
    assert cli("optimize", spec, "--out", run).code == 0
    assert cli("optimize", spec, "--out", tmp_path / "whole").code == 0
    assert content(run) == content(tmp_path / "whole")


@pytest.mark.usefixtures("without_pictures")
def test_psf_interrupted_keeps_the_earlier_results(copied, cli, content, monkeypatch):
    before = content(copied.run)

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("doedesign.runs.psfs.plot_mtf", stop)
    assert cli("psf", copied.run, "--masks", copied.order).code == 130
    assert content(copied.run) == before


def test_psf_waits_for_nobody(copied, cli):
    with alone_in(copied.run):
        done = cli("psf", copied.run, "--masks", copied.order)
    assert done.code == 2
    assert "only one process" in done.err
