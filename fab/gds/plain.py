"""GDSII streams as a library writes them, taken apart with numpy alone.

For the second reader of mask files: a library reads a file of any kind and writes what it found as a plain stream, a
hundred times faster than it hands out shapes one by one. This shares no code with the writer and the walker of this
package. Elements that differ from the one before in their coordinates alone, as nearly all do, are read together.
"""

import struct
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fab.layout.geometry import Layer, Reference

_BGNSTR, _STRNAME, _ENDSTR, _ENDLIB = 0x0502, 0x0606, 0x0700, 0x0400
_BOUNDARY, _SREF, _AREF, _ENDEL = 0x0800, 0x0A00, 0x0B00, 0x1100
_LAYER, _DATATYPE, _XY, _SNAME, _COLROW = 0x0D02, 0x0E02, 0x1003, 0x1206, 0x1302
_STRANS, _MAG, _ANGLE = 0x1A01, 0x1B05, 0x1C05
_HEAD = struct.Struct(">HH")
# Elements looked at together: few at first, most runs being short.
_FEWEST, _MOST = 16, 1 << 16


class PlainCell(NamedTuple):
    """A cell: corners of its polygons by layer, ``(n, v, 2)`` with one v each, its references, and other elements."""

    name: str
    polygons: dict[Layer, list[NDArray[np.int32]]]
    references: tuple[Reference, ...]
    others: int


class _Stream:
    """The records of a file, from its front on."""

    def __init__(self, path: str | Path) -> None:
        self._bytes = np.memmap(path, dtype=np.uint8, mode="r").data
        self.at = 0

    def head(self) -> int:
        """Return the kind of the record at the front."""
        return _HEAD.unpack_from(self._bytes, self.at)[1]

    def record(self) -> tuple[int, bytes]:
        """Take a record; return its kind and data."""
        length, kind = _HEAD.unpack_from(self._bytes, self.at)
        if length < _HEAD.size or self.at + length > len(self._bytes):
            raise ValueError(f"a record of {length} bytes at {self.at}")
        data = bytes(self._bytes[self.at + _HEAD.size : self.at + length])
        self.at += length
        return kind, data

    def element(self) -> dict[int, bytes]:
        """Take an element; return the data of its records by kind."""
        found: dict[int, bytes] = {}
        while _ENDEL not in found:
            kind, data = self.record()
            if kind in found:
                raise ValueError(f"two records of kind {kind:04x} in an element before {self.at}")
            found[kind] = data
        return found

    def alike(self, start: int) -> NDArray[np.int32]:
        """Take the elements that are like the one before, which began at `start`; return its corners and theirs."""
        words = (self.at - start) // 4
        first = self._words(start, 1, words)
        parts, step = [first], _FEWEST
        while True:
            rows = min(step, (len(self._bytes) - self.at) // (4 * words))
            part = self._words(self.at, rows, words)
            same = (part[:, :5] == first[:, :5]).all(axis=1) & (part[:, -1] == first[0, -1])
            count = rows if same.all() else int(np.argmin(same))
            parts.append(part[:count])
            self.at += 4 * words * count
            if count < step:
                break
            step = min(4 * step, _MOST)
        # The last point is the first once more.
        corners = np.concatenate([part[:, 5:-3] for part in parts]).astype(np.int32)
        return corners.reshape(len(corners), -1, 2)

    def _words(self, start: int, rows: int, columns: int) -> NDArray[np.int32]:
        return np.frombuffer(self._bytes, ">i4", rows * columns, start).reshape(rows, columns)


def plain_cells(path: str | Path) -> Iterator[PlainCell]:
    """Read the cells of a stream that a library has just written, one after the other.

    Raises:
        ValueError, struct.error: it is cut off, or no plain stream.
    """
    stream = _Stream(path)
    kind = stream.record()[0]
    while kind != _ENDLIB:
        if kind == _BGNSTR:
            yield _cell(stream)
        kind = stream.record()[0]


def _cell(stream: _Stream) -> PlainCell:
    kind, name = stream.record()
    if kind != _STRNAME:
        raise ValueError(f"no name of a cell before {stream.at}")
    polygons: dict[Layer, list[NDArray[np.int32]]] = defaultdict(list)
    references, others = [], 0
    while (kind := stream.head()) != _ENDSTR:
        start = stream.at
        found = stream.element()
        if kind == _BOUNDARY and found.keys() == {_BOUNDARY, _LAYER, _DATATYPE, _XY, _ENDEL}:
            polygons[Layer(_short(found[_LAYER]), _short(found[_DATATYPE]))].append(stream.alike(start))
        elif kind in (_SREF, _AREF):
            references.append(_reference(found))
        else:
            others += 1
    stream.record()
    return PlainCell(_name(name), polygons, tuple(references), others)


def _name(data: bytes) -> str:
    return data.rstrip(b"\0").decode("ascii", "backslashreplace")


def _short(data: bytes) -> int:
    return int.from_bytes(data, "big", signed=True)


def _reference(found: dict[int, bytes]) -> Reference:
    name = _name(found[_SNAME])
    if any(any(found.get(kind, b"")) for kind in (_STRANS, _ANGLE, _MAG)):
        name += " (turned, mirrored or scaled)"
    points = np.frombuffer(found[_XY], ">i4").reshape(-1, 2).tolist()
    columns, rows = struct.unpack(">2h", found[_COLROW]) if _COLROW in found else (1, 1)
    (x, y), *ends = points
    if not ends:
        return Reference(name, x, y)
    (right, off_y), (off_x, upper) = ends
    if columns < 1 or rows < 1 or (columns > 1 and off_y != y) or (rows > 1 and off_x != x):
        name += " (a raster that is not upright)"
    return Reference(name, x, y, columns, rows, (right - x) // max(1, columns), (upper - y) // max(1, rows))
