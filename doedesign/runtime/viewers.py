"""Programs that show files: KLayout for layouts, the system's viewer for pictures and pages."""

import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from fab.errors import InputError

_LAYOUT = ("klayout", "klayout_app")
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "firefox")


def has_display() -> bool:
    """Whether a window can be opened: always on macOS and Windows, elsewhere with an X or Wayland display."""
    return sys.platform in ("darwin", "win32") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))


def layout_viewer() -> str | None:
    """Path of KLayout, or None."""
    return next((found for name in _LAYOUT if (found := shutil.which(name)) is not None), None)


def system_viewer() -> str | None:
    """Path of the program that opens a file as a double click does, or None; "startfile" on Windows."""
    if sys.platform == "win32":
        return "startfile"
    return shutil.which("open" if sys.platform == "darwin" else "xdg-open")


def browser() -> str | None:
    """Path of a browser, or None."""
    return next((found for name in _BROWSERS if (found := shutil.which(name)) is not None), None)


def open_layout(program: str, layout: Sequence[Path]) -> None:
    """Open a layout in KLayout, without waiting for it.

    Args:
        program: path of KLayout.
        layout: the file and, if there is one, the file of its colours.

    Raises:
        InputError: the program cannot be started.
    """
    file, *colours = map(_absolute, layout)
    _start([program, file, *(word for one in colours for word in ("-l", one))])


def open_file(program: str, file: Path) -> None:
    """Open a file in the system's viewer, without waiting for it.

    Args:
        program: what `system_viewer` found.
        file: the file.

    Raises:
        InputError: the program cannot be started.
    """
    if program == "startfile":
        vars(os)["startfile"](_absolute(file))  # which other systems lack
        return
    _start([program, _absolute(file)])


def _absolute(path: Path) -> str:
    """A path that no program takes for an option."""
    return str(path.absolute())


def _start(command: Sequence[str]) -> None:
    nothing = subprocess.DEVNULL
    try:
        # In a session of its own it outlives this command and its terminal.
        process = subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=nothing, start_new_session=True)
    except OSError as error:
        cure = "Open the file yourself; its path is printed where no viewer is found."
        raise InputError(command[0], "must be a program that can be started", f'"{error.strerror}"', cure) from error
    # Its end is taken note of as long as this process lives.
    threading.Thread(target=process.wait, daemon=True).start()
