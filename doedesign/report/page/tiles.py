"""Pyramids of tiles, for a map to pan and zoom down to single pixels.

A tile is a PNG with one byte per pixel, the number of a colour; kept here is only its compressed data (IDAT chunk). The
page puts the colours before it, so that one pyramid of level numbers shows heights, levels and every etch mask, each
with its own colours, and nothing is stored twice. Reduced copies need their own data: the mean of heights is not that
of a mask.
"""

import base64
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

TILE = 512
_LEVEL = 6


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def tile_head(height: int, width: int) -> str:
    """Signature and IHDR chunk of a PNG of so many rows and columns with a palette, base 64."""
    header = struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)
    return base64.b64encode(b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header)).decode()


def palette(colours: NDArray[np.uint8]) -> str:
    """PLTE chunk of colours `[number, 3]`, base 64."""
    return base64.b64encode(_chunk(b"PLTE", colours.astype(np.uint8).tobytes())).decode()


def tile_data(numbers: NDArray[np.uint8]) -> str:
    """IDAT chunk of the numbers `[y, x]` of colours, the first row on top, base 64."""
    rows = np.zeros((numbers.shape[0], numbers.shape[1] + 1), np.uint8)  # a filter byte of 0 before every row
    rows[:, 1:] = numbers
    return base64.b64encode(_chunk(b"IDAT", zlib.compress(rows.tobytes(), _LEVEL))).decode()


def tile_rows(numbers: NDArray[np.uint8]) -> list[list[str]]:
    """Tiles of a map `[y, x]` whose first row is on top."""
    return [
        [tile_data(numbers[y : y + TILE, x : x + TILE]) for x in range(0, numbers.shape[1], TILE)]
        for y in range(0, numbers.shape[0], TILE)
    ]


def heads(shape: tuple[int, int], reductions: tuple[int, ...]) -> dict[str, str]:
    """Beginnings of all tiles of a map of a shape in pixels and of its reductions, by "height x width"."""
    sizes = {
        (min(TILE, ny - y), min(TILE, nx - x))
        for ny, nx in (reduced_shape(shape, factor) for factor in reductions)
        for y in range(0, ny, TILE)
        for x in range(0, nx, TILE)
    }
    return {f"{y}x{x}": tile_head(y, x) for y, x in sorted(sizes)}


def reduced_shape(shape: tuple[int, int], factor: int) -> tuple[int, int]:
    """Shape of a map whose pixels are averaged in squares of `factor`."""
    return -(-shape[0] // factor), -(-shape[1] // factor)


def reductions_of(shape: tuple[int, int]) -> tuple[int, ...]:
    """Factors 1, 2, 4 ... down to a map of a shape that fills one tile at the most."""
    factors = [1]
    while max(reduced_shape(shape, factors[-1])) > TILE:
        factors.append(2 * factors[-1])
    return tuple(factors)


def reduced(values: NDArray[Any], factors: tuple[int, ...]) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Means of a map `[y, x]` in squares of every factor beyond 1, each with its factor."""
    current, at = values.astype(np.float32), 1
    for factor in factors:
        if factor == 1:
            continue
        while at < factor:
            ny, nx = current.shape
            padded = np.pad(current, ((0, ny % 2), (0, nx % 2)), mode="edge")
            current = padded.reshape(-(-ny // 2), 2, -(-nx // 2), 2).mean(axis=(1, 3), dtype=np.float32)
            at *= 2
        yield factor, current
