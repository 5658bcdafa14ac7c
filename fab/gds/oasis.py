"""OASIS (SEMI P39), written: a fiftieth of the bytes of GDSII, for mail and review.

Rectangles of one size on one layer are one record: the first of them, and steps from each to the next. Steps are
counted in pixels wherever all of them are whole, so most take a byte. Each layer of a cell is one deflated block.
Nothing in the file depends on the time or the place, and a CRC-32 of all of it stands at its end for readers to check.

Numbers are written seven bits at a time, lowest first, the high bit of a byte saying that more follows.
"""

import struct
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fab.files import os_errors_explained
from fab.layout.geometry import Cell, Layer, Layout, Reference, Shapes, require_name
from fab.units import UM

_MAGIC, _VERSION = b"%SEMI-OASIS\r\n", b"1.0"
_START, _END, _LAYERNAME, _CELL, _PLACEMENT = 1, 2, 11, 14, 17
_RECTANGLE, _POLYGON, _CBLOCK = 20, 21, 34
# Which fields follow a record's kind: width, height, x, y, datatype and layer; points instead of the first two; a cell
# by its name, x and y. `_REPEATED` adds a repetition.
_OF_RECTANGLE, _OF_POLYGON, _OF_PLACEMENT, _REPEATED = 0b01111011, 0b00111011, 0b10110000, 0b00000100
# Repetitions: any steps, any steps in units of a grid, a raster, a row.
_STEPS, _GRID_STEPS, _RASTER, _ROW = 10, 11, 8, 9
_ANY_ANGLE = 4
_EXACTLY = 3
_CRC32 = 1
_END_BYTES = 256
# The most bytes of a rectangle without repetition, of a repetition without steps, and of a step.
_MOST_BYTES, _MOST_STEP = 64, 12


@njit(cache=True, nogil=True)
def _put(out, at, value):  # pragma: no cover - compiled
    """Write an unsigned number; return where the next byte goes."""
    while value >= 128:
        out[at] = value & 127 | 128
        value >>= 7
        at += 1
    out[at] = value
    return at + 1


@njit(cache=True, nogil=True)
def _put_signed(out, at, value):  # pragma: no cover - compiled
    return _put(out, at, abs(value) << 1 | (value < 0))


@njit(cache=True, nogil=True)
def _put_step(out, at, x, y):  # pragma: no cover - compiled
    """Write a displacement: a length along an axis, or x and y."""
    if y == 0:
        return _put(out, at, abs(x) << 4 | (4 if x < 0 else 0))
    if x == 0:
        return _put(out, at, abs(y) << 4 | (6 if y < 0 else 2))
    return _put_signed(out, _put(out, at, abs(x) << 2 | (2 if x < 0 else 0) | 1), y)


@njit(cache=True, nogil=True)
def _put_rectangles(boxes, layer, datatype, grid, out):  # pragma: no cover - compiled
    """Write rectangles x, y, width, height, those of one size together; return the number of bytes."""
    at = i = 0
    while i < boxes.shape[0]:
        end = i + 1
        while end < boxes.shape[0] and boxes[end, 2] == boxes[i, 2] and boxes[end, 3] == boxes[i, 3]:
            if boxes[end, 0] == boxes[end - 1, 0] and boxes[end, 1] == boxes[end - 1, 1]:
                break  # readers leave out steps of no length
            end += 1
        out[at] = _RECTANGLE
        out[at + 1] = _OF_RECTANGLE | (_REPEATED if end - i > 1 else 0)
        at = _put(out, _put(out, at + 2, layer), datatype)
        at = _put(out, _put(out, at, boxes[i, 2]), boxes[i, 3])
        at = _put_signed(out, _put_signed(out, at, boxes[i, 0]), boxes[i, 1])
        if end - i > 1:
            at = _put(out, _put(out, at, _GRID_STEPS if grid > 1 else _STEPS), end - i - 2)
            if grid > 1:
                at = _put(out, at, grid)
            for k in range(i + 1, end):
                x, y = boxes[k, 0] - boxes[k - 1, 0], boxes[k, 1] - boxes[k - 1, 1]
                at = _put_step(out, at, x // grid, y // grid)
        i = end
    return at


def _rectangles(layer: Layer, rects: NDArray[np.int32]) -> bytes:
    boxes = rects.astype(np.int64)
    boxes[:, 2:] -= boxes[:, :2]
    boxes = boxes[np.lexsort((boxes[:, 3], boxes[:, 2]))]
    grid = int(np.gcd.reduce((boxes[:, :2] - boxes[0, :2]).ravel()))
    changes = np.diff(boxes, axis=0)
    records = 1 + np.count_nonzero(changes[:, 2:].any(axis=1) | ~changes.any(axis=1))
    out = np.empty(_MOST_BYTES * records + _MOST_STEP * len(boxes), dtype=np.uint8)
    return out[: _put_rectangles(boxes, layer.number, layer.datatype, max(1, grid), out)].tobytes()


def _number(value: int) -> bytes:
    out = np.empty(10, dtype=np.uint8)
    return out[: _put(out, 0, value)].tobytes()


def _signed(value: int) -> bytes:
    return _number(abs(value) << 1 | (value < 0))


def _step(x: int, y: int) -> bytes:
    out = np.empty(20, dtype=np.uint8)
    return out[: _put_step(out, 0, x, y)].tobytes()


def _text(text: str) -> bytes:
    data = text.encode("ascii")
    return _number(len(data)) + data


def _polygon(layer: Layer, points: NDArray[np.int32]) -> bytes:
    steps = np.diff(points.astype(np.int64), axis=0).tolist()
    where = b"".join(map(_signed, points[0].tolist()))
    numbers = _number(layer.number) + _number(layer.datatype)
    corners = _number(_ANY_ANGLE) + _number(len(steps)) + b"".join(_step(x, y) for x, y in steps)
    return bytes([_POLYGON, _OF_POLYGON]) + numbers + corners + where


def _block(layer: Layer, shapes: Shapes) -> bytes:
    """Return the shapes of a layer, deflated."""
    plain = _rectangles(layer, shapes.rectangles) if len(shapes.rectangles) else b""
    plain += b"".join(_polygon(layer, polygon) for polygon in shapes.polygons)
    deflate = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    packed = deflate.compress(plain) + deflate.flush()
    return bytes([_CBLOCK, 0]) + _number(len(plain)) + _number(len(packed)) + packed


def _placement(reference: Reference) -> bytes:
    columns, rows, x, y = reference.columns, reference.rows, reference.step_x, reference.step_y
    repetition = b""
    if columns > 1 and rows > 1:
        repetition = bytes([_RASTER]) + _number(columns - 2) + _number(rows - 2) + _step(x, 0) + _step(0, y)
    elif columns > 1 or rows > 1:
        repetition = bytes([_ROW]) + _number(columns * rows - 2) + (_step(x, 0) if columns > 1 else _step(0, y))
    fields = _OF_PLACEMENT | (_REPEATED << 1 if repetition else 0)
    name = _text(require_name(reference.cell))
    return bytes([_PLACEMENT, fields]) + name + _signed(reference.x) + _signed(reference.y) + repetition


def _layer_names(layout: Layout) -> Iterator[bytes]:
    for layer in layout.layers:
        if layer.name:
            numbers = (bytes([_EXACTLY]) + _number(number) for number in (layer.number, layer.datatype))
            yield bytes([_LAYERNAME]) + _text(layer.name) + b"".join(numbers)


def _unit(dbu_m: float) -> bytes:
    """Return the database units in a micrometre: a whole number, or an eight-byte real."""
    per_um = UM / dbu_m
    if abs(per_um - round(per_um)) < 1e-9 * per_um:
        return _number(0) + _number(round(per_um))
    return _number(7) + struct.pack("<d", per_um)


def _cell(cell: Cell, blocks: Iterator[bytes]) -> bytes:
    head = bytes([_CELL]) + _text(require_name(cell.name))
    return head + b"".join(next(blocks) for _ in cell.shapes) + b"".join(map(_placement, cell.references))


def write_oasis(path: str | Path, layout: Layout) -> None:
    """Write a layout as compressed OASIS, with the names of its layers. Not atomic: use `atomic_folder`."""
    shapes = [pair for cell in layout.cells for pair in cell.shapes.items()]
    # Kernels and zlib let go of the interpreter lock.
    with ThreadPoolExecutor() as pool:
        blocks = pool.map(_block, *zip(*shapes, strict=True)) if shapes else iter(())
        cells = [_cell(cell, blocks) for cell in layout.cells]
    # Tables have no offsets: six pairs of zeros.
    start = bytes([_START]) + _number(len(_VERSION)) + _VERSION + _unit(layout.dbu_m) + bytes(13)
    # Of the end's 256 bytes two say how long the padding is, and five are the kind of the checksum and the checksum.
    padding = bytes(_END_BYTES - 8)
    end = bytes([_END]) + _number(len(padding)) + padding + bytes([_CRC32])
    content = b"".join([_MAGIC, start, *_layer_names(layout), *cells, end])
    with os_errors_explained(path), open(path, "wb", buffering=0) as stream:
        stream.write(content)
        stream.write(struct.pack("<I", zlib.crc32(content)))
