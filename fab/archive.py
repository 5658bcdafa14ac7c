"""Arrays on the disk: a header of JSON and named arrays in one file, whole or not at all.

It is a plain archive, as `numpy.savez` writes it: member "header" is JSON, what the caller says and "sha256" of that
and of all arrays; the other members are the arrays. Nothing is compressed, nothing is ever unpickled, the same content
gives the same bytes, and a full disk or a kill leaves the old file (`fab.files.write_atomic`).
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fab.errors import InputError
from fab.files import canonical_json, read_bytes, write_atomic

_HEADER, _DIGEST = "header", "sha256"
_MOST_BYTES = 1 << 33


def write_archive(path: str | Path, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write a header for JSON and named arrays; the folder of the file is made if missing."""
    text = canonical_json({**header, _DIGEST: _digest(header, arrays)})
    named: dict[str, Any] = {_HEADER: np.frombuffer(text, np.uint8), **arrays}
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **named)
    write_atomic(path, stream.getvalue())


def read_archive(path: Path, what: str, cure: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the header and the arrays by name that `write_archive` wrote, after every check on the way.

    Raises:
        InputError: the file is missing, cut off, another archive, or changed since it was written; the message says
            that it must be a whole `what` ("checkpoint") and ends with `cure`.
    """
    rule = f"must be a whole {what}"
    data = read_bytes(path, _MOST_BYTES)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            # A compressed member was not written here, and could unfold to more than memory holds.
            raw = {each.filename.removesuffix(".npy"): archive.read(each) for each in _members(archive, len(data))}
        arrays = {name: np.lib.format.read_array(io.BytesIO(each), allow_pickle=False) for name, each in raw.items()}
        header = json.loads(arrays.pop(_HEADER).tobytes()) if _HEADER in arrays else None
        stated = header.pop(_DIGEST, None) if isinstance(header, dict) else None
        found = _digest(header, arrays) if isinstance(header, dict) else None
    # What a damaged archive raises depends on where the damage is.
    except Exception as error:
        got = f'"{error}"' if str(error) else type(error).__name__
        raise InputError(str(path), rule, got, cure) from error
    if not isinstance(header, dict):
        raise InputError(str(path), rule, "another archive, without a header", cure)
    if stated != found:
        raise InputError(str(path), rule, "a file changed since it was written", cure)
    return header, arrays


def _members(archive: zipfile.ZipFile, size: int) -> list[zipfile.ZipInfo]:
    """List the members that this module may have written: compressed ones could unfold to more than memory holds."""
    members = [member for member in archive.infolist() if member.compress_type == zipfile.ZIP_STORED]
    if sum(member.file_size for member in members) > size:
        raise ValueError("members that lie over each other")
    return members


def _digest(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 over the header, then over names, kinds, shapes and numbers of the arrays in their order."""
    digest = hashlib.sha256(canonical_json(header))
    for name, array in arrays.items():
        if array.dtype.kind not in "biufc":
            raise TypeError(f"{name} holds {array.dtype}, which is no kind of number")
        digest.update(canonical_json([name, array.dtype.str, list(array.shape)]))
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
