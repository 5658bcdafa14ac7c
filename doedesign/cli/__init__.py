"""The command line, a file for each family of commands.

Exit codes: 0 done, 1 a check failed, 2 bad input, 130 interrupted. Heavy packages are imported where they are used, so
that --help and the commonest mistakes are answered at once.
"""

import sys
from collections.abc import Callable, Sequence
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Any

from cyclopts import App, Group

from doedesign import __version__
from doedesign.cli.console import exit_code
from doedesign.cli.design import masks, new, optimize, precompensate, refine, verify
from doedesign.cli.light import certify, psf, simulate
from doedesign.cli.look import compare, doctor, runs, show
from doedesign.cli.network import evaluate, finetune, reconstruct, train
from doedesign.cli.order import example_of, place_of, stage_of, with_groups
from doedesign.cli.process import calibrate, tolerance
from doedesign.cli.report import report
from doedesign.cli.spec import spec

__all__ = ["app", "exit_code", "main"]

_GENERAL = Group("General", sort_key=100)

app = App(
    name="doedesign",
    help="Design diffractive optical elements and the masks that make them.",
    help_epilogue="Commands are in the order of the work; `doedesign COMMAND --help` shows options and an example.",
    version=__version__,
    group_commands=_GENERAL,
    # Leave both to `exit_code`.
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)
_COMMANDS = (
    new,
    spec,
    optimize,
    refine,
    masks,
    verify,
    psf,
    certify,
    simulate,
    tolerance,
    calibrate,
    precompensate,
    train,
    finetune,
    reconstruct,
    evaluate,
    report,
    runs,
    show,
    compare,
    doctor,
)
_USAGE = {
    "calibrate": "Usage: doedesign calibrate [OPTIONS] RUN [MEASUREMENT]",
    "reconstruct": "Usage: doedesign reconstruct [OPTIONS] [RUN] CAPTURE...",
    "runs": "Usage: doedesign runs [OPTIONS] [FOLDER...]",
    "show": "Usage: doedesign show [OPTIONS] FOLDER [WHAT]",
    "compare": "Usage: doedesign compare [OPTIONS] FOLDER FOLDER...",
}


def _run_first(command: Callable[..., None]) -> Callable[..., None]:
    """The command; if it works on a run, it asks whether there is one before it loads heavy packages."""
    if "run" not in signature(command).parameters:
        return command

    @wraps(command)
    def checked(run: Path, *given: Any, **options: Any) -> None:
        from doedesign.runs.folder import require_folder

        require_folder(run)
        command(run, *given, **options)

    return checked


for _command in _COMMANDS:
    _name = _command.__name__
    app.command(
        _run_first(with_groups(_command)),
        usage=_USAGE.get(_name),
        group=stage_of(_name),
        sort_key=place_of(_name),
        help_epilogue=example_of(_name),
    )
app.register_install_completion_command(
    help="Let the shell (bash, zsh, fish) complete commands and options.", group=_GENERAL
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the `doedesign` command."""
    given = (p for command in _COMMANDS for p in signature(command).parameters.values())
    options = frozenset(p.name.rstrip("_") for p in given if p.kind is p.KEYWORD_ONLY)
    words = sys.argv[1:] if arguments is None else arguments
    return exit_code(lambda: app(words, exit_on_error=False, print_error=False), options, words)
