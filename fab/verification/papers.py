"""Comparison of papers (pictures, run sheets, lists) with what an order should have; a sentence per difference.

Pictures are drawn again and compared by the mean of every block of 8 x 8 dots, in red, green and blue, which has to be
the same within an eighth of the way from black to white: another processor may round an edge to the next dot. Another
version of the library that draws them may also move a text by some dots; then the blocks are of 48 x 48 dots.
"""

import base64
import binascii
import hashlib
import io
import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.files import read_bytes, read_json
from fab.verification.values import differences

_BLOCK, _COARSE_BLOCK, _MOST_OFF = 8, 48, 32.0
_PICTURE = re.compile(r"data:image/png;base64,([A-Za-z0-9+/=]*)")
_LARGEST = 1 << 26


def paper_problems(path: Path, wanted: bytes, alike: bool = True) -> list[str]:
    """Compare a file with what it should hold: pictures as they look, JSON by its values, all else as text.

    `alike` says that both were drawn by the same version of the library that draws pictures.
    """
    try:
        if path.suffix == ".json":
            return differences(read_json(path), json.loads(wanted))
        found = read_bytes(path, _LARGEST)
    except InputError as error:
        return [f"it cannot be read: {error.got}"]
    if found == wanted:
        return []
    block = _BLOCK if alike else _COARSE_BLOCK
    picture = path.suffix == ".png"
    return _picture_problems(found, wanted, block) if picture else list(_text_problems(found, wanted, block))


def picture_of_digest(path: Path, sha256: str) -> bytes | None:
    """Return the picture of a digest that is embedded in a page; None if there is none."""
    try:
        page = read_bytes(path, _LARGEST).decode()
    except (InputError, UnicodeDecodeError):
        return None
    return next((data for data in _embedded(page) if hashlib.sha256(data).hexdigest() == sha256), None)


def _embedded(page: str) -> Iterator[bytes]:
    for found in _PICTURE.finditer(page):
        try:
            yield base64.b64decode(found[1], validate=True)
        except binascii.Error:
            yield b""


def _text_problems(found: bytes, wanted: bytes, block: int) -> Iterator[str]:
    try:
        here = found.decode()
    except UnicodeDecodeError:
        yield "it is no text in UTF-8"
        return
    there = wanted.decode()
    pairs = zip(*(_PICTURE.sub("(picture)", text).splitlines() for text in (here, there)), strict=False)
    counts = [_PICTURE.sub("", text).count("\n") for text in (here, there)]
    odd = next(((n, *pair) for n, pair in enumerate(pairs, 1) if pair[0].rstrip() != pair[1].rstrip()), None)
    if odd is not None:
        number, one, other = odd
        start = next((n for n, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), min(len(one), len(other)))
        start = max(0, start - 20)
        yield f"line {number} says {one[start : start + 60]!r} instead of {other[start : start + 60]!r}"
    elif counts[0] != counts[1]:
        yield f"it has {counts[0]} lines instead of {counts[1]}"
    pictures = list(_embedded(here)), list(_embedded(there))
    if len(pictures[0]) != len(pictures[1]):
        yield f"it shows {len(pictures[0])} pictures instead of {len(pictures[1])}"
    else:
        for number, (one, other) in enumerate(zip(*pictures, strict=True), 1):
            yield from (f"picture {number}: {problem}" for problem in _picture_problems(one, other, block))


def _picture_problems(found: bytes, wanted: bytes, block: int) -> list[str]:
    if found == wanted:
        return []
    try:
        here, there = _pixels(found), _pixels(wanted)
    # Pillow raises what it likes on a damaged file.
    except Exception as error:
        return [f"it is no whole picture: {error}"]
    if here.shape != there.shape:
        (ny, nx), (my, mx) = here.shape[:2], there.shape[:2]
        return [f"{nx} x {ny} dots instead of {mx} x {my}"]
    off = np.abs(_blocks(here, block) - _blocks(there, block)).max(axis=2)
    count = int(np.count_nonzero(off > _MOST_OFF))
    if not count:
        return []
    row, column = np.unravel_index(int(np.argmax(off)), off.shape)
    place = f"the worst about dot {block * int(column)}, {block * int(row)}"
    return [f"it shows something else in {100 * count / off.size:.2g} % of its area, {place}"]


def _pixels(data: bytes) -> NDArray[np.uint8]:
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        if image.width * image.height > _LARGEST:
            raise ValueError(f"{image.width} x {image.height} dots")
        return np.asarray(image.convert("RGB"))


def _blocks(dots: NDArray[np.uint8], block: int) -> NDArray[np.float64]:
    """Return means over square blocks of dots, ``[y, x, colour]``; the last ones are filled up with their edge."""
    ny, nx = (-n % block for n in dots.shape[:2])
    full = np.pad(dots, ((0, ny), (0, nx), (0, 0)), mode="edge")
    rows, columns = (n // block for n in full.shape[:2])
    return full.reshape(rows, block, columns, block, 3).mean(axis=(1, 3))
