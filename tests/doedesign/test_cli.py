"""The command line itself: help, options, where things are printed, exit codes. The work has tests of its own."""

import builtins
import io
import json
import logging
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from doedesign import __main__ as loading
from doedesign import __version__
from doedesign.cli import app, exit_code, main
from fab.errors import CheckFailed, InputError
from fab.solids.patch import Patch
from tests.doedesign.small_runs import call

ROOT = Path(__file__).parents[2]
COMMANDS = tuple(name for name in app if not name.startswith("-"))
HEAVY = ("jax", "numba", "numpy", "matplotlib", "klayout", "gdstk", "pint", "OpenEXR")


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help(command: str, capsys: pytest.CaptureFixture[str]):
    assert main([*command.split(), "--help"]) == 0
    shown = capsys.readouterr().out
    assert f"doedesign {command}".strip() in shown
    assert "--empty" not in shown  # an option that says what leaving out its opposite says
    if not command:
        assert all(name in shown for name in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_what_must_be_given_has_no_default(command: str, capsys: pytest.CaptureFixture[str]):
    main([command, "--help"])
    panels = capsys.readouterr().out.replace("│", " ")
    entries = re.split(r"\n +(?=\* |--|[A-Z]+ )", panels)
    required = [entry for entry in entries if "[required]" in " ".join(entry.split())]
    assert required or command in ("new", "spec", "runs", "doctor")  # which list what there is
    assert not [entry for entry in required if "by default" in entry or "may be left out" in entry]


@pytest.mark.parametrize(
    ("command", "option"),
    [("calibrate", "--pairs"), ("refine", "--terms"), ("evaluate", "--pairs"), ("finetune", "--validation")],
)
def test_options_are_grouped_by_what_they_mean_here(command: str, option: str, capsys: pytest.CaptureFixture[str]):
    main([command, "--help"])
    panels = re.split(r"╭─ ([^─]+) ─", capsys.readouterr().out)
    found = [title for title, text in zip(panels[1::2], panels[2::2], strict=True) if f"│ {option} " in text]
    assert found == ["What is computed"]


def test_nested_commands_say_things_once(capsys: pytest.CaptureFixture[str]):
    def work() -> None:
        logging.getLogger("doedesign").info("once")

    assert exit_code(lambda: exit_code(work)) == 0
    assert capsys.readouterr().err == "once\n"


def test_help_loads_nothing_heavy():
    """A fresh interpreter: everything but the command line's own library is imported where it is used."""
    calls = "; ".join(f"assert main({[*c.split(), '--help']}) == 0" for c in ("", *COMMANDS))
    check = f"import sys; from doedesign.cli import main; {calls}; print(*({set(HEAVY)} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.splitlines()[-1] == ""


def test_common_mistakes_load_nothing_heavy(tmp_path: Path):
    """A wrong path or key is told before the packages that the work would need are loaded."""
    (tmp_path / "spec.toml").write_bytes((ROOT / "examples/quick.toml").read_bytes())
    names = {each: {argument.name for argument in app[each].assemble_argument_collection()} for each in COMMANDS}
    more = {"finetune": ["--pairs", "none"]}
    mistakes = [[each, "none", *more.get(each, [])] for each in COMMANDS if "--run" in names[each]]
    assert len(mistakes) > 10
    mistakes += [["verify", "none"], ["masks", "none"], ["masks", "spec.toml"]]
    mistakes += [["optimize", "none.toml"], ["optimize", "spec.toml", "--set", "optimize.stepz=3"]]
    calls = "; ".join(f"assert main({each}) == 2" for each in mistakes)
    check = f"import sys; from doedesign.cli import main; {calls}; print(*({{'jax', 'numba'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stdout.split() == []
    assert done.stderr.count(", but got ") == len(mistakes)


def test_version(capsys: pytest.CaptureFixture[str]):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == __version__


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["optimise", "spec.toml"], "optimize"),
        (["optimize"], "spec"),
        (["optimize", "spec.toml", "--output", "x"], "--out"),
        (["masks", "plate.npy", "--levels", "many"], "--levels"),
        (["masks", "plate.npy", "--levels", "1e2"], "--levels"),
        (["verify", "order", "another"], "another"),
        (["psf", "run", "--field-deg", "1"], "--field-deg"),
        (["optimize", "spec.toml", "--set"], "--set"),
        (["finetune", "run"], "--pairs"),
        (["reconstruct"], "CAPTURES"),
    ],
)
def test_usage_mistakes(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]):
    assert main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert words in printed.err
    command = f"doedesign {arguments[0]}" if arguments[0] in COMMANDS else "doedesign"
    assert printed.err.splitlines()[1:] == [f"Try: {command} --help"]


def test_a_path_with_the_name_of_an_option_is_told_as_a_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "masks").mkdir()
    for command in ("psf", "report"):
        code, _, said = call(command, "masks")
        assert code == 2
        assert said.startswith("doedesign: masks: ")


@pytest.mark.slow
@pytest.mark.parametrize("closed", [">&-", "2>&-"])
def test_closed_streams_are_nothing_to_stumble_over(tmp_path: Path, closed: str):
    command = f"'{sys.executable}' -m doedesign runs '{tmp_path}' {closed}"
    done = subprocess.run(["sh", "-c", command], cwd=tmp_path, capture_output=True, check=False, env=os.environ)
    assert done.returncode == 0
    assert b"Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (("psf", "run", "--draw", "normal/3"), "--draw: must be given with --seed"),
        (("simulate", "run", "--draw", "normal/3"), "--draw: must be given with --plate-seed"),
        (("evaluate", "run", "--figure", "4", "--table", "1"), "--table: is of tables"),
        (("evaluate", "run", "--figure", "4", "--train"), "--train: is of tables"),
        (("evaluate", "run", "--figure", "4", "--seed", "2"), "--seed: does not go with --figure 4"),
        (("evaluate", "run", "--figure", "bench", "--draws", "2"), "--draws: does not go with --figure bench"),
        (("evaluate", "run", "--figure", "4", "--set", "train.steps=1"), "--set: is of tables"),
        (("evaluate", "run", "--figure", "8", "--lpips-weights", "a.npz"), "--lpips-weights: is of tables"),
        (("report", "run", "--compare", "other", "--order", "masks"), "--order: does not go with other runs"),
        (("calibrate", "run", "m.toml", "--throughput", "0.9"), "--throughput: goes with --ring-to-disc"),
        (("calibrate", "run", "m.toml", "--no-pairs"), "--no-pairs: goes with --ring-to-disc"),
        (("calibrate", "run", "--ring-to-disc", "1", "--polish", "3"), "--polish: goes with a measurement"),
        (("calibrate", "run", "--ring-to-disc", "1", "--throughput-sigma", "0.1"), "must be given with --throughput"),
        (("tolerance", "run", "--draw", "normal/3", "--draws", "5"), "--draws: must be left out with --draw"),
        (("tolerance", "run", "--draw", "normal/3", "--out", "there"), "--out: must be left out with --draw"),
    ],
)
def test_options_that_would_do_nothing_are_refused(
    command: tuple[str, ...], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    Path("run").mkdir()
    code, _, said = call(*command)
    assert code == 2
    assert words in said


def test_an_interrupt_before_the_commands_are_there(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    load = builtins.__import__

    def interrupted(name: str, *arguments: Any, **more: Any) -> Any:
        if name == "doedesign.cli":
            raise KeyboardInterrupt
        return load(name, *arguments, **more)

    monkeypatch.setattr(builtins, "__import__", interrupted)
    assert loading.main() == 130
    assert capsys.readouterr().err == "doedesign: interrupted before anything was done\n"


def failing(error: BaseException):
    def work() -> None:
        raise error

    return work


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (InputError("spec.toml: name", "must be plain", "?", "Change it."), 2, "spec.toml: name: must be plain"),
        (CheckFailed(["M1.gds: differs", "M2.gds: differs"]), 1, "M1.gds: differs\nM2.gds: differs"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (OSError(28, "No space left on device", "out.gds"), 2, "out.gds: the disk must have room"),
        (BrokenPipeError(32, "Broken pipe"), 130, ""),
    ],
)
def test_exit_codes(error: BaseException, code: int, message: str, capsys: pytest.CaptureFixture[str]):
    assert exit_code(failing(error)) == code
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.out == ""


def test_a_defect_is_not_hidden():
    with pytest.raises(ZeroDivisionError):
        exit_code(lambda: 1 / 0)


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("plate") / "plate.npy"
    np.save(path, np.zeros((8, 8)))
    return path


def draw(plate: Path, out: Path, *more: str) -> list[str]:
    return ["masks", str(plate), "--levels", "2", "--step", "0.5 um", "--pitch", "9 um", "--out", str(out), *more]


@pytest.mark.slow
def test_json_is_one_line(plate: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(draw(plate, tmp_path / "a", "--json")) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert json.loads(line)["paths"][0] == str(tmp_path / "a")


@pytest.mark.parametrize(("option", "step"), [("--patch", True), ("--mesh-patch", False)])
def test_a_place_may_begin_with_a_minus(plate: Path, option: str, step: bool, monkeypatch: pytest.MonkeyPatch):
    given: dict[str, object] = {}

    def asked(*_: object, **more: object) -> None:
        given.update(more)
        failing_problem()

    monkeypatch.setattr("doedesign.lab.order.write_masks", asked)
    assert main(["masks", str(plate), option, "-1mm,-20 um,50 um"]) == 2
    assert given["patch"] == Patch(-1e-3, -20e-6, 50e-6, step=step)


def test_warnings_go_to_stderr(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("doedesign.optimization.problem_of", failing_problem)
    assert (
        main(
            [
                "optimize",
                str(ROOT / "examples/quick.toml"),
                "--out",
                str(tmp_path / "run"),
                "--set",
                "process.level_step=70 nm",
            ]
        )
        == 2
    )
    printed = capsys.readouterr()
    assert "warning: process.level_step: 16 x 70 nm" in printed.err
    assert printed.out == ""


def test_a_start_is_short_for_an_override(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    said: dict[str, object] = {}
    monkeypatch.setattr("doedesign.optimization.optimize", lambda *_, **more: said.update(more))
    asked = ["optimize", str(ROOT / "examples/quick.toml"), "--out", str(tmp_path / "run"), "--set", "optimize.seed=2"]
    assert main([*asked, "--start", "nlopt"]) == 0
    assert said["overrides"] == ("optimize.seed=2", "optimize.start=nlopt")
    assert main([*asked, "--start", "no-such"]) == 2


def failing_problem(*_: object) -> None:
    raise InputError("here", "stops", "it", "Go on.")


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_names_the_terminal_cannot_show(plate: Path, tmp_path: Path, encoding: str, monkeypatch: pytest.MonkeyPatch):
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, encoding))
    assert main(draw(plate, tmp_path / "Größe")) == 0
    first = shown.getvalue().splitlines()[0].decode()
    assert first == str(tmp_path / ("Größe" if encoding == "utf-8" else "Gr\\xf6\\xdfe"))


@pytest.mark.slow
@pytest.mark.parametrize(("target", "code"), [("pipe", 0), ("/dev/full", 2)])
def test_stdout_that_takes_nothing(plate: Path, tmp_path: Path, target: str, code: int):
    """`doedesign masks ... | head` is no error, a full disk is; neither ends in a traceback."""
    if target == "pipe":
        reader, stdout = os.pipe()
        os.close(reader)
    elif not Path(target).exists():
        pytest.skip(f"no {target} on this system")
    else:
        stdout = os.open(target, os.O_WRONLY)
    command = [sys.executable, "-m", "doedesign", *draw(plate, tmp_path / "order")]
    done = subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, text=True, check=False, cwd=ROOT)
    os.close(stdout)
    assert done.returncode == code
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert main(["verify", str(tmp_path / "order")]) == 0
