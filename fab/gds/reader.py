"""This package's own GDSII reader: a walk along the chain of records, without any library.

It accepts what `fab.gds.writer` writes and no more: cells of plain boundaries and upright references, every record in
its place. Anything else is refused with the file and the offset, so a damaged file cannot pass for a different drawing.
The file is read a few megabytes at a time; a compiled kernel takes whole elements from the front of each block and what
is left moves to the front of the next.
"""

import gzip
import os
import struct
import zlib
from collections import defaultdict
from pathlib import Path
from typing import BinaryIO, NoReturn

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fab.errors import InputError
from fab.files import opened
from fab.gds import writer as gds
from fab.layout.geometry import Cell, Layer, Layout, Reference, Shapes, in_order
from fab.layout.limits import Tally
from fab.units import UM

_BLOCK = 1 << 20
# No record, and so no element of this kind, is longer than its 16-bit length says.
_LONGEST = 1 << 17
# The shortest element: a closed triangle.
_SHORTEST = 4 + 6 + 6 + 4 + 4 * 8 + 4
# A packed file holds at most this many bytes for each of its own; rectangles of one size on a raster come to thirty.
_MOST_UNPACKED = 100
_SPOILED = "Write the order again, or fetch the file again."
# The words that mark an element: length of the record, then its type.
_BOUNDARY, _LAYER = 4 << 16 | gds.BOUNDARY, 6 << 16 | gds.LAYER
_ENDEL, _ENDSTR = 4 << 16 | gds.ENDEL, 4 << 16 | gds.ENDSTR
_SREF, _AREF = 4 << 16 | gds.SREF, 4 << 16 | gds.AREF
# Records that people know by name and no mask holds.
_FOREIGN: dict[int | None, str] = {
    0x0900: "a path",
    0x0C00: "a text",
    0x1500: "a node",
    0x2D00: "a box",
    0x1A01: "a turned or mirrored reference",
}
_MORE, _DONE, _UNEXPECTED, _OPEN, _REFERENCE = 0, 1, 2, 3, 4


def _from_real(data: bytes) -> float:
    return int.from_bytes(data[1:], "big") / 2**56 * 16.0 ** (data[0] - 64)


@njit(cache=True, nogil=True)
def _walk(words, rects, rect_keys, points, ends, keys):  # pragma: no cover - compiled
    """Read whole elements from the front of the words into the arrays of `_Found`.

    Every record of a boundary ends on a multiple of four bytes, so an element is a row of 32-bit words: BOUNDARY, LAYER
    with its number across two words, DATATYPE likewise, XY, points, ENDEL. Returns the counts of words read, rectangles
    and polygons, and why it stopped.
    """
    p = 0
    count = polygons = used = 0
    stop = words.size
    while p < stop:
        if words[p] == _ENDSTR:
            return p + 1, count, polygons, _DONE
        if words[p] == _SREF or words[p] == _AREF:
            return p, count, polygons, _REFERENCE
        if words[p] != _BOUNDARY:
            return p, count, polygons, _UNEXPECTED
        if p + 5 > stop:
            break
        if words[p + 1] != _LAYER or words[p + 2] & 0xFFFF != 6 or words[p + 3] >> 16 != gds.DATATYPE:
            return p + 1, count, polygons, _UNEXPECTED
        length = (words[p + 4] >> 16) & 0xFFFF
        if words[p + 4] & 0xFFFF != gds.XY or length < 36 or length % 8 != 4:
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

    def take(self, front: NDArray[np.uint8], tally: Tally) -> tuple[int, int]:
        """Read the whole elements at the front of some bytes; return the bytes used and why it stopped."""
        words = self.words[: front.size // 4]
        np.copyto(words, front[: words.size * 4].view(">i4"))
        read, count, polygons, why = _walk(words, self.rects, self.rect_keys, self.points, self.ends, self.keys)
        tally.add("polygons that are no rectangles", int(polygons))
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
        """Return everything, by layer number; the block lists are emptied on the way to save memory."""
        none = [np.empty((0, 4), dtype=np.int32)]
        return {
            Layer(key >> 16 & 0xFFFF, key & 0xFFFF): Shapes(
                np.concatenate(self.all_rects.pop(key, none)), tuple(self.all_polygons.pop(key, ()))
            )
            for key in sorted({*self.all_rects, *self.all_polygons})
        }


def _fail(path: str | Path, rule: str, offset: int, kind: int | None = None) -> NoReturn:
    raise InputError(str(path), rule, f"{_FOREIGN.get(kind, 'something else')} at byte {offset}", _SPOILED)


class _Stream:
    """A file read block by block, of which the front is looked at and then dropped."""

    def __init__(self, path: str | Path, file: BinaryIO) -> None:
        self.path, self._file, self.tally = path, file, Tally(str(path))
        self._most = os.fstat(file.fileno()).st_size
        if Path(path).suffix == ".gz":
            self._file = gzip.GzipFile(fileobj=file, mode="rb")
            self._most = _BLOCK + _MOST_UNPACKED * self._most
        self._buffer = np.empty(_BLOCK + _LONGEST, dtype=np.uint8)
        self._start = self._end = self.offset = 0

    @property
    def front(self) -> NDArray[np.uint8]:
        """Bytes that were read and not yet dropped."""
        return self._buffer[self._start : self._end]

    def fill(self) -> bool:
        """Read on, as far as there is room; return whether anything came."""
        kept = self._end - self._start
        self._buffer[:kept] = self.front.copy()
        room = min(_BLOCK, self._buffer.size - kept)
        got = self._file.readinto(self._buffer.data[kept : kept + room])  # type: ignore[attr-defined]
        self._start, self._end = 0, kept + got
        if self.offset + self._end > self._most:
            rule = f"a packed file must hold at most {_MOST_UNPACKED} bytes for each of its own"
            raise InputError(str(self.path), rule, "more", _SPOILED)
        return bool(got)

    def drop(self, count: int) -> None:
        """Forget the front."""
        self._start += count
        self.offset += count

    def record(self, rule: str, *kinds: int) -> tuple[int, bytes]:
        """Take the next record, which must be of one of these kinds; return its kind and data."""
        length = self._ahead(4, rule)
        kind = int.from_bytes(self.front[2:4].tobytes(), "big")
        if kind not in kinds or length < 4:
            _fail(self.path, rule, self.offset, kind)
        self._ahead(length, rule)
        data = self.front[4:length].tobytes()
        self.drop(length)
        return kind, data

    def _ahead(self, count: int, rule: str) -> int:
        """Have some bytes ready; return the length of the record at the front."""
        while self._end - self._start < count:
            if not self.fill():
                _fail(self.path, rule, self.offset)
        return int.from_bytes(self.front[:2].tobytes(), "big")


_WHOLE = "the file must be a whole GDSII stream"


def _name(data: bytes) -> str:
    return data.rstrip(b"\0").decode("ascii", "backslashreplace")


def _read_unit(stream: _Stream) -> float:
    """Read the opening of the file; return the database unit in metres."""
    for kind in (gds.HEADER, gds.BGNLIB, gds.LIBNAME):
        stream.record(_WHOLE, kind)
    units = stream.record(_WHOLE, gds.UNITS)[1]
    dbu_m = _from_real(units[8:16])
    if len(units) != 16 or not 1e-12 <= dbu_m <= 1e-3 or abs(_from_real(units[:8]) * UM / dbu_m - 1) > 1e-9:
        rule = "the user unit must be 1 um and the database unit must lie from 1 pm to 1 mm"
        raise InputError(str(stream.path), rule, f"UNITS {units.hex()}", _SPOILED)
    return dbu_m


def _read_reference(stream: _Stream) -> Reference:
    rule = "a reference must be upright and whole"
    kind, _ = stream.record(rule, gds.SREF, gds.AREF)
    name = _name(stream.record(rule, gds.SNAME)[1])
    at = stream.offset
    counts = stream.record(rule, gds.COLROW)[1] if kind == gds.AREF else struct.pack(">2h", 1, 1)
    points = stream.record(rule, gds.XY)[1]
    if len(counts) != 4 or len(points) != (24 if kind == gds.AREF else 8):
        _fail(stream.path, rule, at)
    stream.record(rule, gds.ENDEL)
    columns, rows = struct.unpack(">2h", counts)
    if columns < 1 or rows < 1:
        _fail(stream.path, rule, at)
    x, y, *ends = struct.unpack(f">{len(points) // 4}i", points)
    if not ends:
        return Reference(name, x, y)
    width, height = ends[0] - x, ends[3] - y
    if ends[1] != y or ends[2] != x or width % columns or height % rows:
        _fail(stream.path, rule, at)
    return Reference(name, x, y, columns, rows, width // columns, height // rows)


def _read_cell(stream: _Stream, found: _Found) -> Cell:
    """Read a cell from its name to its end."""
    name = _name(stream.record(_WHOLE, gds.STRNAME)[1])
    references = []
    most = _LONGEST  # little at first: a file may have many small cells
    while True:
        read, why = found.take(stream.front[:most], stream.tally)
        stream.drop(read)
        if why == _OPEN:
            _fail(stream.path, "every boundary must end at its first point", stream.offset)
        if why == _UNEXPECTED:
            rule = "a cell must hold plain boundaries (layer, datatype, points) and references only"
            _fail(stream.path, rule, stream.offset, int.from_bytes(stream.front[2:4].tobytes(), "big"))
        if why == _DONE:
            return Cell(name, found.shapes(), tuple(references))
        if why == _REFERENCE:
            references.append(_read_reference(stream))
            stream.tally.add("placed copies", references[-1].columns * references[-1].rows)
            most = _LONGEST
        elif read == 0 and not stream.fill():
            _fail(stream.path, "the file must be whole, up to its end record", stream.offset)
        else:
            most = _BLOCK + _LONGEST


def read_gds(path: str | Path) -> Layout:
    """Read a GDSII file of boundaries and upright references, packed if it ends in .gz, and check every record of it.

    Axis-parallel boundaries of four points become rectangles, in the order of the file, all others (degenerate ones
    too) polygons; layers are sorted and have no names.

    Raises:
        InputError: the file is missing, cut off, not GDSII, or holds anything else (the message names the offset), or
            more than `fab.layout.limits` allows.
    """
    with opened(path) as file:
        stream = _Stream(path, file)
        try:
            dbu_m, cells = _read_cells(stream)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise InputError(str(path), "a packed file must be whole", str(error), _SPOILED) from error
    try:
        ordered = in_order(cells)
    except ValueError as error:
        raise InputError(str(path), "the cells must make one drawing", str(error), _SPOILED) from error
    stream.tally.add_places(ordered)
    return Layout(dbu_m, ordered)


def _read_cells(stream: _Stream) -> tuple[float, list[Cell]]:
    """Read a whole file; return its database unit in metres, and its cells."""
    found, cells = _Found(), []
    dbu_m = _read_unit(stream)
    while stream.record(_WHOLE, gds.BGNSTR, gds.ENDLIB)[0] == gds.BGNSTR:
        stream.tally.add("cells")
        cells.append(_read_cell(stream, found))
    # Zeros may follow, since some programs fill the last block of a tape.
    while stream.front.size or stream.fill():
        if stream.front.any():
            _fail(stream.path, "the file must end with its end record", stream.offset)
        stream.drop(stream.front.size)
    return dbu_m, cells
