"""Commands that look: show with the viewers of a fake machine, doctor; and the help of all commands."""

import io
import json
import re
import shlex
import time
from pathlib import Path

import pytest

from doedesign.cli import app, main
from doedesign.cli.order import COMMANDS, STAGES
from doedesign.runtime.doctor import EXTRAS, examine
from tests.doedesign.small_runs import call
from tests.doedesign.test_overview import written

MASKS = Path(__file__).parents[2] / "masks"
EXAMPLE = MASKS / "example"
NAMES = [name for name in app if not name.startswith("-")]


@pytest.fixture
def viewers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with a display, whose viewer and KLayout write down what they were asked to show."""
    programs, said = tmp_path / "programs", tmp_path / "said"
    programs.mkdir()
    for name in ("xdg-open", "klayout"):
        path = programs / name
        path.write_text(f'#!/bin/sh\nprintf "%s\\n" "{name}" "$@" >> "{said}.$$" && mv "{said}.$$" "{said}-$$"\n')
        path.chmod(0o755)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("PATH", f"{programs}:/usr/bin:/bin")
    monkeypatch.setenv("DISPLAY", ":0")
    return tmp_path


def opened(folder: Path, count: int) -> list[list[str]]:
    """What the viewers were asked, in any order; they run beside the command."""
    end = time.monotonic() + 60
    while len(found := sorted(folder.glob("said-*"))) < count:
        assert time.monotonic() < end
        time.sleep(0.01)
    return sorted(path.read_text().splitlines() for path in found)


def test_a_picture_is_opened_and_its_path_printed(viewers: Path):
    run = written(viewers / "run; touch hacked")  # no shell reads it
    code, out, _ = call("show", run)
    assert (code, out) == (0, f"{run / 'psf.png'}\n")
    assert opened(viewers, 1) == [["xdg-open", str(run / "psf.png")]]
    assert not Path("hacked").exists()


def test_masks_are_opened_in_klayout_with_their_colours(viewers: Path):
    code, out, _ = call("show", EXAMPLE, "masks")
    assert code == 0
    layout, colours = out.splitlines()
    assert opened(viewers, 1) == [["klayout", layout, "-l", colours]]


def test_the_masks_of_a_run_are_those_of_its_order(viewers: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(viewers)
    run = written(Path("runs") / "small")
    code, _, said = call("show", run, "masks")
    assert code == 2
    assert "doedesign masks runs/small" in said
    code, out, _ = call("show", run, "masks", "--masks", EXAMPLE, "--print")
    assert code == 0
    assert out.splitlines()[0].endswith("_ALL.oas")
    assert not list(viewers.glob("said*"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("{run}", "--masks", EXAMPLE), "--masks: goes with masks, pages or all of a run only"),
        (("{run}", "pictures", "--masks", "nonsense"), "--masks: goes with masks, pages or all of a run only"),
        ((EXAMPLE, "masks", "--masks", EXAMPLE), "--masks: goes with masks, pages or all of a run only"),
        (("{run}", "masks", "--masks", "nonsense"), "--masks: must be the folder of a mask order"),
        (("{run}", "all", "--masks", "nonsense"), "--masks: must be the folder of a mask order"),
    ],
)
def test_another_order_is_looked_at_or_refused(tmp_path: Path, arguments: tuple[object, ...], words: str):
    run = written(tmp_path / "run")
    code, out, said = call("show", *(str(one).format(run=run) for one in arguments), "--print")
    assert (code, out) == (2, "")
    assert said.startswith(f"doedesign: {words}, but got ")


@pytest.mark.parametrize("missing", ["DISPLAY", "PATH"])
def test_without_a_display_or_a_viewer_paths_are_printed(viewers: Path, monkeypatch: pytest.MonkeyPatch, missing: str):
    run = written(viewers / "run")
    if missing == "DISPLAY":
        monkeypatch.delenv("DISPLAY")
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    else:
        monkeypatch.setenv("PATH", str(viewers))
    code, out, said = call("show", run)
    assert (code, out) == (0, f"{run / 'psf.png'}\n")
    assert "here are the paths" in said
    assert not list(viewers.glob("said*"))


def test_print_opens_nothing(viewers: Path):
    code, out, said = call("show", EXAMPLE, "all", "--print", "--json")
    assert (code, said) == (0, "")
    assert len(json.loads(out)["paths"]) >= 6
    assert not list(viewers.glob("said*"))


def test_what_there_is_nothing_to_show_of(tmp_path: Path):
    run = written(tmp_path / "run")
    assert call("show", run, "pages")[0] == 2
    assert call("show", tmp_path)[0] == 2
    assert call("show", tmp_path / "none")[0] == 2


def test_the_doctor_tells_of_everything():
    found = examine()
    assert found.versions["jax"]
    assert found.devices
    assert {one.name for one in found.extras} == EXTRAS.keys()
    code, out, _ = call("doctor", "--json")
    assert code == 0
    assert json.loads(out)["cores"] == found.cores
    code, out, said = call("doctor")
    assert (code, said) == (0, "")
    for words in ("Python", "memory", "compiled programs", "extra rigorous", "KLayout", "devices"):
        assert re.search(rf"(?m)^{words}", out), words


def test_the_doctor_knows_all_extras_of_users():
    import tomllib

    table = tomllib.loads((MASKS.parent / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert table.keys() - EXTRAS.keys() == {"bench", "dev", "docs"}  # of those who work on the package
    assert EXTRAS.keys() <= table.keys()


def test_an_extra_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch):
    from importlib import metadata

    whole = metadata.version

    def version(name: str) -> str:
        if name == "fmmax":
            raise metadata.PackageNotFoundError(name)
        return whole(name)

    monkeypatch.setattr("doedesign.runtime.doctor.metadata.version", version)
    line = dict(examine().lines())["extra rigorous"]
    assert line.startswith("missing fmmax: pip install 'doedesign[rigorous]'")


@pytest.mark.parametrize("name", NAMES)
def test_the_example_of_every_command_is_understood(name: str, capsys: pytest.CaptureFixture[str]):
    words = shlex.split(COMMANDS[name].example)
    assert words[0] == name
    command, _, _ = app.parse_args(words, exit_on_error=False, print_error=False)
    assert command.__name__ == name
    app([name, "--help"])
    shown = " ".join(capsys.readouterr().out.split())
    assert f"Example: doedesign {COMMANDS[name].example}" in shown


def test_commands_are_in_the_order_of_the_work(capsys: pytest.CaptureFixture[str]):
    app(["--help"])
    shown = capsys.readouterr().out
    panels = [title for title in re.findall(r"╭─ ([\w ]+) ─", shown) if title != "General"]
    assert panels == [stage for stage in STAGES if stage in {COMMANDS[name].stage for name in NAMES}]
    listed = [word for word in re.findall(r"(?m)^│ (\w+) ", shown) if word in NAMES]
    assert listed == [name for name in COMMANDS if name in NAMES]
    assert set(listed) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_options_stand_in_groups(name: str, capsys: pytest.CaptureFixture[str]):
    app([name, "--help"])
    panels = re.findall(r"╭─ ([\w ]+) ─", capsys.readouterr().out)
    order = ["Input", "What is computed", "Where it is computed", "Output"]
    assert panels == [title for title in order if title in panels]
    assert "Output" in panels


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_commands(shell: str):
    script = app.generate_completion(shell=shell)  # pyright: ignore[reportArgumentType]
    assert all(name in script for name in NAMES)
    assert "on-violation" in script


def test_completion_is_installed_where_the_shell_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("SHELL", "/bin/bash")
    assert call("--install-completion", "--shell", "bash")[0] == 0
    written_files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert any("tolerance" in path.read_text() for path in written_files)


def test_a_terminal_gets_a_table_without_markup(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    run = written(tmp_path / "[red]run")
    monkeypatch.setenv("COLUMNS", "300")
    shown = io.StringIO()
    monkeypatch.setattr(shown, "isatty", lambda: True)
    monkeypatch.setattr("sys.stdout", shown)
    assert main(["runs", str(run)]) == 0
    assert "[red]run" in shown.getvalue()
    assert "main numbers" in shown.getvalue()
    assert "\t" not in shown.getvalue()


def test_a_terminal_without_the_letters_of_a_name_gets_escapes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    run = written(tmp_path / "Größe")
    monkeypatch.setenv("COLUMNS", "300")
    shown = io.BytesIO()
    terminal = io.TextIOWrapper(shown, "ascii")
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr("sys.stdout", terminal)
    assert main(["runs", str(run)]) == 0
    assert b"Gr\\xf6\\xdfe" in shown.getvalue()
