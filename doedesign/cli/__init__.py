"""The command line, a file for each family of commands.

Exit codes: 0 done, 1 a check failed, 2 bad input, 130 interrupted. Heavy packages are imported where they are used, so
that --help answers at once.
"""

from collections.abc import Sequence
from inspect import signature

from cyclopts import App

from doedesign import __version__
from doedesign.cli.console import exit_code
from doedesign.cli.design import masks, new, optimize, precompensate, refine, verify
from doedesign.cli.light import certify, psf, simulate
from doedesign.cli.network import finetune, reconstruct, train
from doedesign.cli.process import calibrate, tolerance

__all__ = ["app", "exit_code", "main"]

app = App(
    name="doedesign",
    help="Design diffractive optical elements and the masks that make them.",
    version=__version__,
    # Leave both to `exit_code`.
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)
_COMMANDS = (new, optimize, refine, precompensate, masks, verify, psf, certify, tolerance, simulate, train, finetune)
for _command in _COMMANDS:
    app.command(_command)
app.command(calibrate, usage="Usage: doedesign calibrate [OPTIONS] RUN [MEASUREMENT]")
app.command(reconstruct, usage="Usage: doedesign reconstruct [OPTIONS] [RUN] CAPTURE...")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the `doedesign` command."""
    given = (p for command in (*_COMMANDS, calibrate, reconstruct) for p in signature(command).parameters.values())
    options = frozenset(p.name.rstrip("_") for p in given if p.kind is p.KEYWORD_ONLY)
    return exit_code(lambda: app(arguments, exit_on_error=False, print_error=False), options)
