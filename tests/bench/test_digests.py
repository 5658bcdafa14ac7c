"""Digests of a session are proof only where the session ran."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from bench.digests import main


def test_no_digests_of_a_session_that_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, 2, "", "doedesign: no")

    monkeypatch.setattr(subprocess, "run", fail)
    monkeypatch.setattr(sys, "argv", ["digests", str(tmp_path / "before.json")])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    assert not (tmp_path / "before.json").exists()


@pytest.mark.parametrize(("after", "code", "told"), [("1", 0, "every file is the same"), ("2", 1, "quick/psf.png")])
def test_two_states_are_compared(
    after: str,
    code: int,
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    for name, digest in (("before", "1"), ("after", after)):
        (tmp_path / f"{name}.json").write_text(json.dumps({"quick/psf.png": digest}))
    monkeypatch.setattr(
        sys, "argv", ["digests", "--compare", *(str(tmp_path / f"{n}.json") for n in ("before", "after"))]
    )
    assert main() == code
    assert told in capsys.readouterr().out


def test_what_is_asked_must_be_said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys, "argv", ["digests"])
    with pytest.raises(SystemExit):
        main()
    assert "give a file for the digests" in capsys.readouterr().err
