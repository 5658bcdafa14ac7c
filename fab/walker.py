"""This package's own GDSII reader: a walk along the chain of records, without any library.

It accepts what `fab.stream` writes and no more: one cell, plain boundaries, every record in its place.
Whatever it does not expect is refused with the file and the offset, so a damaged file cannot pass for a
different drawing. The file is read a few megabytes at a time; a compiled kernel takes whole elements
from the front of each block and what is left moves to the front of the next.
"""

from collections import defaultdict
from pathlib import Path
from typing import BinaryIO, NoReturn

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fab.errors import InputError
from fab.files import explain_os_error
from fab.layout import Layer, Layout, Shapes
from fab.stream import (
    BGNLIB,
    BGNSTR,
    BOUNDARY,
    DATATYPE,
    ENDEL,
    ENDLIB,
    ENDSTR,
    HEADER,
    LAYER,
    LIBNAME,
    STRNAME,
    UNITS,
    XY,
)
from fab.units import UM

__all__ = ["read_gds"]

_BLOCK = 1 << 20
# No record, and so no element of this kind, is longer than its 16-bit length says.
_LONGEST = 1 << 17
# The shortest element: a closed triangle.
_SHORTEST = 4 + 6 + 6 + 4 + 4 * 8 + 4
_SPOILED = "Write the order again, or fetch the file again."
_END_OF_FILE = (4).to_bytes(2, "big") + ENDLIB.to_bytes(2, "big")
# The words that mark an element: length of the record, then its type.
_BOUNDARY, _LAYER = 4 << 16 | BOUNDARY, 6 << 16 | LAYER
_ENDEL, _ENDSTR = 4 << 16 | ENDEL, 4 << 16 | ENDSTR
_MORE, _DONE, _UNEXPECTED, _OPEN = 0, 1, 2, 3


def _from_real(data: bytes) -> float:
    return int.from_bytes(data[1:], "big") / 2**56 * 16.0 ** (data[0] - 64)


@njit(cache=True, nogil=True)
def _walk(words, rects, rect_keys, points, ends, keys):  # pragma: no cover - compiled
    """Read whole elements from the front of the words; see `_Found` for the arrays that are filled.

    Every record of a boundary ends on a multiple of four bytes from the start of the element, so an element
    is a row of 32-bit words: BOUNDARY, LAYER with its number across two words, DATATYPE likewise, XY, points,
    ENDEL. Returns how many words were read, how many rectangles and polygons, and why it stopped.
    """
    p = 0
    count = polygons = used = 0
    stop = words.size
    while p < stop:
        if words[p] == _ENDSTR:
            return p + 1, count, polygons, _DONE
        if words[p] != _BOUNDARY:
            return p, count, polygons, _UNEXPECTED
        if p + 5 > stop:
            break
        if words[p + 1] != _LAYER or words[p + 2] & 0xFFFF != 6 or words[p + 3] >> 16 != DATATYPE:
            return p + 1, count, polygons, _UNEXPECTED
        length = (words[p + 4] >> 16) & 0xFFFF
        if words[p + 4] & 0xFFFF != XY or length < 36 or length % 8 != 4:
            return p + 4, count, polygons, _UNEXPECTED
        q = p + 5
        end = q + length // 4 - 1
        if end >= stop:
            break
        if words[end] != _ENDEL:
            return end, count, polygons, _UNEXPECTED
        x0, y0, x1, y1 = words[q], words[q + 1], words[q + 2], words[q + 3]
        x2, y2, x3, y3 = words[q + 4], words[q + 5], words[q + 6], words[q + 7]
        if words[end - 2] != x0 or words[end - 1] != y0:
            return p + 4, count, polygons, _OPEN
        key = (words[p + 2] & 0xFFFF0000) | (words[p + 3] & 0xFFFF)
        lying = y0 == y1 and x1 == x2 and y2 == y3 and x3 == x0
        standing = x0 == x1 and y1 == y2 and x2 == x3 and y3 == y0
        if length == 44 and (lying or standing) and x0 != x2 and y0 != y2:
            rects[count, 0] = min(x0, x2)
            rects[count, 1] = min(y0, y2)
            rects[count, 2] = max(x0, x2)
            rects[count, 3] = max(y0, y2)
            rect_keys[count] = key
            count += 1
        else:
            for i in range(q, end - 2, 2):
                points[used, 0] = words[i]
                points[used, 1] = words[i + 1]
                used += 1
            ends[polygons] = used
            keys[polygons] = key
            polygons += 1
        p = end + 1
    return p, count, polygons, _MORE


class _Found:
    """Shapes by layer, collected block by block."""

    def __init__(self) -> None:
        most = (_BLOCK + _LONGEST) // _SHORTEST + 1
        self.rects = np.empty((most, 4), dtype=np.int32)
        self.words = np.empty((_BLOCK + _LONGEST) // 4, dtype=np.int32)
        self.rect_keys = np.empty(most, dtype=np.int64)
        self.points = np.empty(((_BLOCK + _LONGEST) // 8, 2), dtype=np.int32)
        self.ends = np.empty(most, dtype=np.int64)
        self.keys = np.empty(most, dtype=np.int64)
        self.all_rects: dict[int, list[NDArray[np.int32]]] = defaultdict(list)
        self.all_polygons: dict[int, list[NDArray[np.int32]]] = defaultdict(list)

    def take(self, buffer: NDArray[np.uint8], stop: int) -> tuple[int, int]:
        """Read the whole elements at the front of `buffer[:stop]`; return the bytes used and why it stopped."""
        words = self.words[: stop // 4]
        np.copyto(words, buffer[: words.size * 4].view(">i4"))
        read, count, polygons, why = _walk(words, self.rects, self.rect_keys, self.points, self.ends, self.keys)
        rects, keys = self.rects[:count], self.rect_keys[:count]
        mixed = count and (keys != keys[0]).any()
        for key in np.unique(keys) if mixed else keys[:1]:
            self.all_rects[int(key)].append(rects[keys == key] if mixed else rects.copy())
        start = 0
        for key, end in zip(self.keys[:polygons], self.ends[:polygons], strict=True):
            self.all_polygons[int(key)].append(self.points[start:end].copy())
            start = end
        return 4 * int(read), int(why)

    def shapes(self) -> dict[Layer, Shapes]:
        """Hand over everything, by layer number; the block lists are emptied on the way to save memory."""
        none = [np.empty((0, 4), dtype=np.int32)]
        return {
            Layer(key >> 16 & 0xFFFF, key & 0xFFFF): Shapes(
                np.concatenate(self.all_rects.pop(key, none)), tuple(self.all_polygons.pop(key, ()))
            )
            for key in sorted({*self.all_rects, *self.all_polygons})
        }


def _refuse(path: str | Path, rule: str, offset: int) -> NoReturn:
    raise InputError(str(path), rule, f"something else at byte {offset}", _SPOILED)


def _read_opening(path: str | Path, stream: BinaryIO) -> tuple[str, float]:
    """Read up to the cell's name; return it and the database unit in metres."""
    data: dict[int, bytes] = {}
    for kind in (HEADER, BGNLIB, LIBNAME, UNITS, BGNSTR, STRNAME):
        offset = stream.tell()
        head = stream.read(4)
        length = int.from_bytes(head[:2], "big")
        data[kind] = stream.read(max(0, length - 4))
        if head[2:] != kind.to_bytes(2, "big") or len(data[kind]) != length - 4:
            _refuse(path, "the file must be a whole GDSII stream with one cell", offset)
    units = data[UNITS]
    dbu_m = _from_real(units[8:16])
    if len(units) != 16 or not 1e-12 <= dbu_m <= 1e-3 or abs(_from_real(units[:8]) * UM / dbu_m - 1) > 1e-9:
        rule = "the user unit must be 1 um and the database unit must lie from 1 pm to 1 mm"
        raise InputError(str(path), rule, f"UNITS {units.hex()}", _SPOILED)
    return data[STRNAME].rstrip(b"\0").decode("ascii", "backslashreplace"), dbu_m


def _read_body(path: str | Path, stream: BinaryIO) -> dict[Layer, Shapes]:
    buffer = np.empty(_BLOCK + _LONGEST, dtype=np.uint8)
    view = buffer.data
    found = _Found()
    offset, kept = stream.tell(), 0
    while True:
        got = stream.readinto(view[kept : kept + _BLOCK])  # type: ignore[attr-defined]
        read, why = found.take(buffer, kept + got)
        if why == _OPEN:
            _refuse(path, "every boundary must end at its first point", offset + read)
        if why == _UNEXPECTED:
            _refuse(path, "the cell must hold plain boundaries (layer, datatype, points) only", offset + read)
        kept += got - read
        rest = buffer[read : read + kept].tobytes()
        if why == _DONE:
            break
        if not got:
            _refuse(path, "the file must be whole, up to its end record", offset + read)
        view[:kept] = rest
        offset += read
    # Zeros may follow, since some programs fill the last block of a tape.
    tail = rest + stream.read()
    if tail[:4] != _END_OF_FILE or tail[4:].strip(b"\0"):
        _refuse(path, "the file must end with its end record after the one cell", offset + read)
    return found.shapes()


def read_gds(path: str | Path) -> Layout:
    """Read a GDSII file of one cell that holds boundaries only, and check every record of it.

    Args:
        path: the file.

    Returns:
        The cell. Axis-parallel boundaries of four points come back as rectangles, in the order of the
        file, all others (degenerate ones too) as polygons; layers are sorted and have no names.

    Raises:
        InputError: the file is missing, cut off, not GDSII, or holds anything else; the message names
            the file and the offset.
    """
    try:
        with open(path, "rb", buffering=0) as stream:
            cell, dbu_m = _read_opening(path, stream)
            return Layout(cell, dbu_m, _read_body(path, stream))
    except OSError as error:
        raise explain_os_error(error, path) from error
