"""Output and exit codes of commands: stdout is data (paths, or JSON on request), stderr is messages."""

import contextlib
import io
import json
import logging
import os
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from cyclopts import CycloptsError

from doedesign.cli.options import in_options, words_in_options
from doedesign.runtime.stopping import interruptible
from fab.errors import CheckFailed, InputError, printable


def say(text: str) -> None:
    """Print a message to stderr."""
    print(printable(text, "\n"), file=sys.stderr, flush=True)


class _Stderr(logging.Handler):
    """Show records of the library: plain lines, warnings as such."""

    def emit(self, record: logging.LogRecord) -> None:
        text = words_in_options(record.getMessage())
        say(f"warning: {text}" if record.levelno >= logging.WARNING else text)


@contextlib.contextmanager
def shown_log() -> Iterator[None]:
    """Show the log of the library on stderr meanwhile, once where such blocks are nested."""
    log, handler = logging.getLogger("doedesign"), _Stderr()
    if any(isinstance(other, _Stderr) for other in log.handlers):
        yield
        return
    before, propagate = log.level, log.propagate
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    log.propagate = False
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(before)
        log.propagate = propagate


def print_text(text: str) -> None:
    """Print a result."""
    try:
        print(printable(text, "\n\t"), flush=True)
    except OSError as error:
        # What could not be printed would be tried again, and fail again, when Python ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):  # a reader that has seen enough is no error
            raise


def print_paths(paths: Sequence[Path], as_json: bool, **more: Any) -> None:
    """Print paths, or JSON with what else there is to say."""
    names = [str(path) for path in paths]
    print_text(json.dumps({"paths": names, **more}, sort_keys=True) if as_json else "\n".join(map(printable, names)))


def print_results(folder: Path, as_json: bool, **more: Any) -> None:
    """Print the paths of a folder and of what is in it."""
    print_paths([folder, *sorted(folder.iterdir())], as_json, **more)


def exit_code(work: Callable[[], Any], options: Collection[str] = (), given: Collection[str] = ()) -> int:
    """Run a command and return its exit code; a mistake of the user becomes one message instead of a traceback.

    `options` are the names of arguments that are options, `given` the words of the command line.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # whoever started it closed it
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
        elif isinstance(stream, io.TextIOWrapper):  # what its encoding lacks is escaped
            stream.reconfigure(errors="backslashreplace")
    try:
        with interruptible(), shown_log():
            work()
    except InputError as error:
        say(f"doedesign: {in_options(error, options, given)}")
        return 2
    except CheckFailed as error:
        say(f"doedesign: check failed\n{error}")
        return 1
    except CycloptsError as error:
        say(f"doedesign: {error}\nTry: {' '.join(('doedesign', *(error.command_chain or ()), '--help'))}")
        return 2
    except KeyboardInterrupt:
        say("doedesign: interrupted; what was finished is kept, the same command goes on from there")
        return 130
    except BrokenPipeError:  # nobody listens to stderr any more
        return 130
    except OSError as error:
        from fab.files import explain_os_error

        if error.filename is None and error.errno is None:
            raise
        say(f"doedesign: {explain_os_error(error, str(error.filename or 'output'))}")
        return 2
    return 0
