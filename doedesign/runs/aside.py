"""A run that another one is to take the place of, and that waits until that one has begun.

    RUN/.doedesign-aside/       all of it, in its own folder: on one disk, whatever links to it
    RUN/.doedesign-replaced/    what is left of one that was replaced

Its manifest is moved aside first and back last, so that a folder of which a part was moved has none, and a kill or a
full disk at any step loses nothing.
"""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from fab.files import MANIFEST_NAME, os_errors_explained

ASIDE = ".doedesign-aside"
_REPLACED = ".doedesign-replaced"


def waits(folder: Path) -> bool:
    """Whether a run waits in its folder to be brought back, which the next `optimize` there does.

    Args:
        folder: folder of the run.
    """
    return (folder / ASIDE / MANIFEST_NAME).is_file()


def set_aside(folder: Path) -> None:
    """Move a run aside.

    Args:
        folder: folder of the run, in which none waits.
    """
    with os_errors_explained(folder):
        (folder / ASIDE).mkdir()
        _move(sorted(folder.iterdir(), key=lambda path: path.name != MANIFEST_NAME), folder / ASIDE)


def replace_aside(folder: Path) -> None:
    """Remove the run that waits, if one does, for another one has begun; from the first step on it does not come back.

    Args:
        folder: folder of both.
    """
    if (folder / ASIDE).is_dir():
        with os_errors_explained(folder):
            (folder / ASIDE).rename(folder / _REPLACED)
            shutil.rmtree(folder / _REPLACED)


@contextmanager
def restored_unless_replaced(folder: Path) -> Iterator[None]:
    """Bring back a run that nothing took the place of: a mistake was found before the other began, or it was killed.

    Args:
        folder: folder of the run.
    """
    _restore(folder)
    try:
        yield
    finally:
        _restore(folder)


def _restore(folder: Path) -> None:
    """Move a run back that waits, over what another one began with."""
    aside = folder / ASIDE
    with os_errors_explained(folder):
        if (folder / _REPLACED).is_dir():
            shutil.rmtree(folder / _REPLACED)
        if not aside.is_dir():
            return
        if waits(folder):
            (folder / MANIFEST_NAME).unlink(missing_ok=True)
        _move(sorted(aside.iterdir(), key=lambda path: path.name == MANIFEST_NAME), folder)
        aside.rmdir()


def _move(paths: Sequence[Path], home: Path) -> None:
    for path in paths:
        if path != home:
            path.rename(home / path.name)
