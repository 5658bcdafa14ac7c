"""GDSII: the files that carry the geometry, written.

A GDSII file is a chain of records: two bytes of length, two bytes of type, then big-endian data. A rectangle takes
exactly 64 bytes, sixteen 32-bit words of which only ten change, so rectangles go to the disk as rows of an integer
array, a few megabytes at a time. Times are fixed, so the same layout gives the same bytes.
"""

import gzip
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.files import os_errors_explained
from fab.layout.geometry import Layer, Layout, Reference, require_name
from fab.layout.limits import Tally
from fab.units import UM

# Record types: the kind of record, then the kind of its data.
HEADER, BGNLIB, LIBNAME, UNITS, ENDLIB = 0x0002, 0x0102, 0x0206, 0x0305, 0x0400
BGNSTR, STRNAME, ENDSTR, BOUNDARY, ENDEL = 0x0502, 0x0606, 0x0700, 0x0800, 0x1100
LAYER, DATATYPE, XY = 0x0D02, 0x0E02, 0x1003
SREF, AREF, SNAME, COLROW = 0x0A00, 0x0B00, 0x1206, 0x1302

# The version that introduced long polygons; every reader knows it.
_VERSION = 600
_TIME = struct.pack(">12H", *(2000, 1, 1, 0, 0, 0) * 2)
_LIBRARY = "DOE"
# Which of x0, y0, x1, y1 the ten words of a closed counter-clockwise boundary hold.
_CORNERS = np.array([0, 1, 2, 1, 2, 3, 0, 3, 0, 1])
_BATCH = 1 << 15


def _record(kind: int, data: bytes = b"") -> bytes:
    return struct.pack(">HH", 4 + len(data), kind) + data


def _text(kind: int, name: str) -> bytes:
    data = name.encode("ascii")
    return _record(kind, data + b"\0" * (len(data) % 2))


def _real(value: float) -> bytes:
    """Return an eight-byte real: exponent of 16 with offset 64, and a 56-bit fraction in [1/16, 1)."""
    exponent = 64
    while value < 1 / 16:
        value *= 16
        exponent -= 1
    return bytes([exponent]) + round(value * 2**56).to_bytes(7, "big")


def _reference(reference: Reference) -> bytes:
    x, y, columns, rows = reference.x, reference.y, reference.columns, reference.rows
    name = _text(SNAME, require_name(reference.cell))
    if columns == rows == 1:
        return _record(SREF) + name + _record(XY, struct.pack(">2i", x, y)) + _record(ENDEL)
    # The second and third point lie one step beyond the last column and the last row.
    points = (x, y, x + columns * reference.step_x, y, x, y + rows * reference.step_y)
    raster = _record(COLROW, struct.pack(">2h", columns, rows)) + _record(XY, struct.pack(">6i", *points))
    return _record(AREF) + name + raster + _record(ENDEL)


def _element_start(layer: Layer) -> bytes:
    numbers = _record(LAYER, struct.pack(">H", layer.number)) + _record(DATATYPE, struct.pack(">H", layer.datatype))
    return _record(BOUNDARY) + numbers


def _write_rectangles(stream: BinaryIO, layer: Layer, rects: NDArray[np.int32]) -> None:
    # Big-endian from the start to the end: every cast into these words swaps the bytes, none drops the order.
    words = np.empty((min(_BATCH, len(rects)), 16), dtype=">i4")
    words[:, :5] = np.frombuffer(_element_start(layer) + struct.pack(">HH", 44, XY), dtype=">i4")
    words[:, 15] = np.frombuffer(_record(ENDEL), dtype=">i4")
    for start in range(0, len(rects), _BATCH):
        batch = rects[start : start + _BATCH]
        words[: len(batch), 5:15] = batch[:, _CORNERS]
        stream.write(words[: len(batch)].view(np.uint8).data)


@contextmanager
def _opened(path: str | Path) -> Iterator[BinaryIO]:
    with open(path, "wb", buffering=0) as stream:
        if Path(path).suffix != ".gz":
            yield stream
            return
        # No name and no time in it. More effort packs rectangles no closer and takes several times as long.
        with gzip.GzipFile("", "wb", compresslevel=1, fileobj=stream, mtime=0) as packed:
            yield packed  # type: ignore[misc]


def write_gds(path: str | Path, layout: Layout) -> None:
    """Write a layout as GDSII, packed if the path ends in .gz; the memory needed does not grow with the file.

    Not atomic: use `atomic_folder`.
    """
    with os_errors_explained(path), _opened(path) as stream:
        stream.write(_record(HEADER, struct.pack(">H", _VERSION)) + _record(BGNLIB, _TIME) + _text(LIBNAME, _LIBRARY))
        stream.write(_record(UNITS, _real(layout.dbu_m / UM) + _real(layout.dbu_m)))
        for cell in layout.cells:
            stream.write(_record(BGNSTR, _TIME) + _text(STRNAME, require_name(cell.name)))
            for layer, shapes in cell.shapes.items():
                _write_rectangles(stream, layer, shapes.rectangles)
                for polygon in shapes.polygons:
                    closed = np.concatenate([polygon, polygon[:1]]).astype(">i4")
                    stream.write(_element_start(layer) + _record(XY, closed.tobytes()) + _record(ENDEL))
            stream.write(b"".join(_reference(reference) for reference in cell.references) + _record(ENDSTR))
        stream.write(_record(ENDLIB))


def oasis_to_gds(path: str | Path, gds: str | Path, most: int) -> None:
    """Write an OASIS file, which may be broken and so stand for billions of shapes, as GDSII through KLayout."""
    import klayout.db as kdb

    layout = kdb.Layout(False)  # which keeps repeated shapes folded
    options = kdb.SaveLayoutOptions()
    options.format = "GDS2"
    cure = "Write the order again, or fetch the file again."
    quiet = kdb.LoadLayoutOptions()
    quiet.warn_level = 0
    try:
        layout.read(str(path), quiet)
        Tally(str(path)).add("cells", layout.cells())
        count = sum(cell.shapes(index).size() for cell in layout.each_cell() for index in layout.layer_indexes())
        if count > most:
            raise InputError(str(path), f"must hold at most {most} shapes", f"{count} shapes", cure)
        layout.write(str(gds), options)
    except RuntimeError as error:
        raise InputError(str(path), "the file must be whole OASIS", str(error), cure) from error
