"""Files and folders that appear whole or not at all, their digests, and canonical JSON.

A result is written under a temporary name beside its final place, forced to the disk and then renamed. Whatever happens
in between (an exception, a full disk, a kill), the final path holds the old content or the new one and never a half.
What a killed process was writing lies hidden beside it until the next one writes there.
What the operating system refuses is an `InputError` that names the path.
"""

import contextlib
import csv
import errno
import fcntl
import hashlib
import io
import json
import math
import os
import re
import shutil
import stat
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.units import named_kind

MANIFEST_NAME = "manifest.json"
# A field with this mark is left out of records where it is its default, so that records without it stay what they are.
IF_ANY: Mapping[str, bool] = {"if_any": True}

_NO_FILE = "a pipe, socket or device"
_NO_TEXT = re.compile("[\ud800-\udfff]")

# Temporary names of `write_atomic` and `atomic_folder`, which stay behind where a process is killed while it writes.
_UNFINISHED = re.compile(r"\.(?P<name>.+)\.doedesign-(file|new|old)\.[a-z0-9_]{8}", re.DOTALL)

_CURES = {
    errno.EACCES: ("the place must be writable", "Choose another output folder or change its permissions."),
    errno.EPERM: ("the place must be writable", "Choose another output folder or change its permissions."),
    errno.EROFS: ("the file system must be writable", "Choose an output folder on a writable disk."),
    errno.ENOSPC: ("the disk must have room for the result", "Free some space or choose another disk."),
    errno.EDQUOT: ("the disk quota must have room for the result", "Free some space or choose another disk."),
    errno.ENOTDIR: ("every part of the path above the last must be a folder", "Choose another output path."),
    errno.EISDIR: ("the path must be a file", "Give the file inside that folder."),
    errno.EEXIST: ("the folder's parent must not be a file", "Choose another output path."),
    errno.ENOENT: ("the file must exist", "Check the path."),
    errno.ENAMETOOLONG: ("the path must be shorter", "Choose a shorter name."),
}


def explain_os_error(error: OSError, path: str | Path) -> InputError:
    """Turn an operating-system error about a path into the `InputError` to raise from it."""
    rule, cure = _CURES.get(error.errno or 0, ("the path must be usable", "Check the path and the disk."))
    return InputError(str(path), rule, f'"{error.strerror or error}"', cure)


def path_of(value: object, name: str = "path") -> Path:
    """Return the path of a file or a folder, given as text or as a path, the value of `name`.

    Raises:
        InputError: anything else, such as what is to be written there, no text at all, or text that no path may have.
    """
    if not isinstance(value, str | os.PathLike) or not str(value) or "\0" in str(value):
        got = repr(value) if isinstance(value, str) else named_kind(type(value))
        raise InputError(name, "must be the path of a file or a folder", got, 'For example "out/plate.npz".')
    return Path(value)


def paths_of(value: object, name: str) -> tuple[Path, ...]:
    """Return the paths of files, of one or of a tuple or list of them, the value of `name`; see `path_of`."""
    return tuple(path_of(one, name) for one in (value if isinstance(value, tuple | list) else [value]))


@contextmanager
def os_errors_explained(path: str | Path) -> Iterator[None]:
    """Turn every operating-system error within this block into an `InputError` that names the path."""
    try:
        yield
    except OSError as error:
        raise explain_os_error(error, path) from error


def _sync(path: Path) -> None:
    """Force a file or the list of a folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_atomic(path: str | Path, data: bytes) -> None:
    """Write a whole file: temporary sibling, fsync, rename; its folder is made if missing.

    Raises:
        InputError: something else than a path, a device, pipe or socket at that path, or what the system refuses.
    """
    path = path_of(path)
    _require_no_device(path)
    with os_errors_explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        clear_killed(path.parent, path.name.__eq__)
        temporary, handle = _locked(lambda: _made_file(path))
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
                temporary.chmod(0o666 & ~_umask())
                temporary.replace(path)  # before the lock is given back
            _sync(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


def _require_no_device(path: Path) -> None:
    """Refuse what is no file in the place of one that is to be written: it would be replaced, ``/dev/null`` for all."""
    try:
        mode = path.stat().st_mode
    except OSError:  # nothing is there, or what the system says of it
        return
    # The terminal or pipe of /dev/stdout is a link to what the process has open.
    stream = path.is_symlink() and os.readlink(path).startswith("/proc/")
    if stream or not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise InputError(str(path), "must be a file, or nothing yet", _NO_FILE, "Give a place for a new file.")


def _made_file(path: Path) -> tuple[Path, int]:
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.doedesign-file.", dir=path.parent)
    return Path(name), handle


def _made_folder(path: Path, what: str) -> tuple[Path, int]:
    while True:
        name = tempfile.mkdtemp(prefix=f".{path.name}.doedesign-{what}.", dir=path.parent)
        with contextlib.suppress(FileNotFoundError):  # cleared by another process before it was opened
            return Path(name), os.open(name, os.O_RDONLY)


def _locked(make: Callable[[], tuple[Path, int]]) -> tuple[Path, int]:
    """Make a temporary file or folder, and lock it until its handle is closed: its process lives."""
    while True:
        path, handle = make()
        if lock(handle) is not False and path.exists():
            return path, handle
        os.close(handle)  # cleared by another process before it was locked


def lock(handle: int, *, shared: bool = False) -> bool | None:
    """Lock an open file or folder until its handle is closed, without waiting.

    Args:
        handle: descriptor of the open file or folder.
        shared: beside others that ask for the same, which only look whether one works there.

    Returns:
        whether it could be had; None where the file system has no locks.
    """
    try:
        fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def clear_killed(folder: Path, ours: Callable[[str], object]) -> None:
    """Remove what killed processes were writing in a folder under the names that are `ours`.

    What a living process writes is locked, and stays. An earlier result that a killed one had moved aside comes back
    where there is none.
    """
    for entry in [Path(entry) for entry in os.scandir(folder)]:
        found = _UNFINISHED.fullmatch(entry.name)
        if found is None or not ours(found["name"]):
            continue
        with contextlib.suppress(OSError):  # another process clears it, or may not
            handle = os.open(entry, os.O_RDONLY | os.O_NOFOLLOW)
            try:
                if not lock(handle):
                    continue
                path = folder / found["name"]
                if not path.exists() and (entry / path.name).exists():
                    (entry / path.name).rename(path)
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
            finally:
                os.close(handle)


def _umask() -> int:
    # There is no call that only reads it.
    mask = os.umask(0)
    os.umask(mask)
    return mask


def require_text(path: Path) -> None:
    """Refuse a path with bytes that are no UTF-8, which libraries for layouts and solids cannot open."""
    if _NO_TEXT.search(str(path)):
        raise InputError(str(path), "the path must be UTF-8 text", "other bytes", "Rename it.")


def _require_replaceable(path: Path) -> None:
    require_text(path)
    if path.is_symlink():  # still, with all links followed
        raise InputError(str(path), "the output must be a folder", "a link to itself", "Choose another output path.")
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    if not path.is_dir():
        raise InputError(str(path), "the output must be a folder", "a file", "Choose another output path.")
    if not (path / MANIFEST_NAME).is_file():
        raise InputError(
            str(path),
            f"an output folder that exists must be empty or an earlier result (with {MANIFEST_NAME})",
            f"a folder with other content, such as {min(p.name for p in path.iterdir())!r}",
            "Choose another output folder, or empty this one yourself.",
        )


def _swap(fresh: Path, path: Path) -> None:
    """Put `fresh` at `path`; an earlier result moves aside first and comes back if the rename fails or is stopped."""
    aside, handle = _locked(lambda: _made_folder(path, "old"))
    try:
        if path.exists():
            path.rename(aside / path.name)
        fresh.rename(path)
    except BaseException:
        if not path.exists() and (aside / path.name).exists():
            (aside / path.name).rename(path)
        raise
    finally:
        if path.exists() or not any(aside.iterdir()):  # else the earlier result is in there, and cannot come back
            shutil.rmtree(aside, ignore_errors=True)
        os.close(handle)
    _sync(path.parent)


def real_path(path: Path) -> Path:
    """Where a path leads to through links; one that goes round in links, for which `Path.resolve` fails, stays so."""
    return Path(os.path.realpath(path))


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Fill a folder that appears at its final path only when everything in it is on the disk.

    The temporary folder beside it, which is yielded, is removed if the body raises. An earlier result (with
    ``manifest.json``) is replaced whole.

    Raises:
        InputError: the path is a file, a folder with foreign content, or refused by the system.
    """
    path = Path(path)
    if path.is_symlink():
        path = real_path(path)  # the link stays, and what it points to is replaced
    with os_errors_explained(path):
        if path.parent.is_dir():
            clear_killed(path.parent, path.name.__eq__)
        _require_replaceable(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary, handle = _locked(lambda: _made_folder(path, "new"))
        try:
            temporary.chmod(0o777 & ~_umask())
            yield temporary
            for file in temporary.rglob("*"):
                _sync(file)
            _sync(temporary)
            _swap(temporary, path)
        except InputError as error:
            # An error in the temporary folder is one in the folder that was asked for.
            error.where = error.where.replace(str(temporary), str(path))
            raise
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
            os.close(handle)


@contextmanager
def scratch_folder(within: Path | None = None) -> Iterator[Path]:
    """Make a folder, by default among the system's temporary ones, removed in the end; an error names that place."""
    place = Path(tempfile.gettempdir()) if within is None else within
    with os_errors_explained(place):
        folder = Path(tempfile.mkdtemp(prefix="doedesign-", dir=place))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def sha256_bytes(data: bytes | memoryview) -> str:
    """Return the SHA-256 of a byte string, in lower-case hexadecimal."""
    return hashlib.sha256(data).hexdigest()


@contextmanager
def opened(path: str | Path) -> Iterator[FileIO]:
    """Open a regular file to read it; an InputError for anything else, such as a pipe that nobody may ever write to."""
    with os_errors_explained(path):
        # Not to wait for the other end of a pipe.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with os.fdopen(handle, "rb", buffering=0) as stream:
            mode = os.fstat(handle).st_mode
            if stat.S_ISDIR(mode):
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
            if not stat.S_ISREG(mode):
                raise InputError(str(path), "must be a file", _NO_FILE, "Copy its content to a file.")
            yield stream


def read_bytes(path: str | Path, most: int = 1 << 30) -> bytes:
    """Read a whole file of at most `most` bytes."""
    with opened(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > most:
            raise InputError(str(path), f"must have at most {most} bytes", size, "Give the file that was meant.")
        return stream.read()


def sha256_file(path: str | Path) -> str:
    """Return the SHA-256 of a file's content, in lower-case hexadecimal."""
    with opened(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def canonical_json(value: object) -> bytes:
    """Return a value as JSON whose bytes depend on it alone; NaN and infinities raise a ValueError.

    Bytes of a file name that are no UTF-8 are written as the text of their escapes.
    """
    text = json.dumps(value, sort_keys=True, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    return _NO_TEXT.sub(lambda found: f"\\\\u{ord(found[0]):04x}", text).encode()


def _unlike(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make a JSON object of pairs whose keys differ."""
    value = dict(pairs)
    if len(value) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice!r} stands twice")
    return value


def _non_finite(value: object, key: str = "") -> tuple[str, object] | None:
    """Find the first NaN, infinity or number that no float holds of a parsed JSON value, with its dotted key."""
    if isinstance(value, float):
        return None if math.isfinite(value) else (key, value)
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        return key, f"a whole number of {len(str(abs(value)))} digits"
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found = (_non_finite(part, f"{key}.{name}" if key else str(name)) for name, part in inner)
    return next((one for one in found if one is not None), None)


def csv_table(rows: Sequence[NamedTuple], digits: int = 9) -> str:
    """Return rows of one kind as CSV under the names of their fields, numbers with so many digits.

    Whole numbers and text stay what they are; None is left out.
    """
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(rows[0]._fields)
    lines.writerows([f"{value:.{digits}g}" if isinstance(value, float) else value for value in row] for row in rows)
    return text.getvalue()


def read_json(path: str | Path) -> dict[str, Any]:
    """Read a JSON file that holds one object; no key twice, no NaN, no infinity, no number that no float holds."""
    cure = "Write it again from its source."
    text = read_bytes(path, 1 << 28)
    try:
        value = json.loads(text, object_pairs_hook=_unlike)
        wrong = _non_finite(value)
    except RecursionError as error:
        raise InputError(str(path), "the file must be JSON", "brackets without end", cure) from error
    except ValueError as error:
        raise InputError(str(path), "the file must be JSON", str(error), cure) from error
    if not isinstance(value, dict):
        raise InputError(str(path), "the file must hold one JSON object", type(value).__name__, cure)
    if wrong is not None:
        raise InputError(f"{path}: {wrong[0]}", "must be a finite number", wrong[1], cure)
    return value


def read_npy(path: str | Path, most: int = 1 << 28) -> NDArray[Any]:
    """Read an array file of at most `most` elements; anything but one whole array of plain numbers is an InputError."""
    rule = f"the file must be a whole .npy file of 1 to {most} plain numbers"
    cure = "Write the file again from its source."
    with opened(path):
        pass  # numpy would wait for a pipe
    try:
        with warnings.catch_warnings():
            # A damaged header can look like one of an old version of Python.
            warnings.simplefilter("ignore", UserWarning)
            # Mapped, so that a header that promises more than the file holds asks for no memory.
            mapped = np.load(path, mmap_mode="r", allow_pickle=False)
    except OSError as error:
        raise explain_os_error(error, path) from error
    # What numpy raises on a damaged header depends on where the damage is: syntax, token, type, value errors.
    except Exception as error:
        raise InputError(str(path), rule, str(error) or type(error).__name__, cure) from error
    if not isinstance(mapped, np.ndarray) or not 0 < mapped.size <= most:
        got = f"shape {mapped.shape}" if isinstance(mapped, np.ndarray) else "an archive of several arrays"
        raise InputError(str(path), rule, got, cure)
    return np.array(mapped)
