"""Bitmaps as rectangles, and circles as sectors: the two shapes that masks are drawn from.

A pixel plane becomes rectangles in one sweep. Every row is cut into its maximal runs of ones; a run that has exactly
the columns of a run in the row below continues that rectangle, any other opens a new one. The result covers each set
pixel once and nothing else, has no holes and no polygon that touches itself at a corner. It is not the smallest cover,
but it is linear in the pixels, while a merge to large polygons is quadratic in their holes.

A clear aperture is drawn as the annulus around it. GDSII knows neither circles nor holes, so the annulus is cut into
equal sectors of few vertices that share their radial edges point by point. Around a rectangle they end at a square,
and two angles fill what is left: no corner is sharper than 45 degrees.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

# The classic limit of 200 points per GDSII boundary counts the closing point.
MAX_VERTICES = 199


@njit(cache=True, nogil=True)
def _count_runs(bitmap):  # pragma: no cover - compiled
    runs = 0
    for y in range(bitmap.shape[0]):
        before = 0
        for x in range(bitmap.shape[1]):
            value = bitmap[y, x] != 0
            runs += value & (before ^ 1)
            before = value
    return runs


@njit(cache=True, nogil=True)
def _sweep(bitmap, x_edges, y_edges, out):  # pragma: no cover - compiled
    ny, nx = bitmap.shape
    # The runs of the row below: first column, end column, and the rectangle each belongs to.
    below = np.empty((3, nx // 2 + 2), np.int32)
    here = np.empty((3, nx // 2 + 2), np.int32)
    below_count = 0
    used = 0
    for y in range(ny):
        count = 0
        candidate = 0
        x = 0
        while x < nx:
            if bitmap[y, x] == 0:
                x += 1
                continue
            start = x
            while x < nx and bitmap[y, x] != 0:
                x += 1
            while candidate < below_count and below[0, candidate] < start:
                candidate += 1
            if candidate < below_count and below[0, candidate] == start and below[1, candidate] == x:
                index = below[2, candidate]
            else:
                index = used
                used += 1
                out[index, 0] = x_edges[start]
                out[index, 1] = y_edges[y]
                out[index, 2] = x_edges[x]
            out[index, 3] = y_edges[y + 1]
            here[0, count] = start
            here[1, count] = x
            here[2, count] = index
            count += 1
        below, here = here, below
        below_count = count
    return used


def rectangles(
    bitmap: NDArray[np.uint8], x_edges: NDArray[np.int32] | None = None, y_edges: NDArray[np.int32] | None = None
) -> NDArray[np.int32]:
    """Cover the set pixels of a bitmap ``[y, x]`` with disjoint rectangles ``(n, 4)``: x0, y0, x1, y1 by y0, then x0.

    The edges are the coordinates of the pixel edges, increasing, ``(nx + 1,)`` and ``(ny + 1,)``; pixel numbers if left
    out.
    """
    bitmap = np.ascontiguousarray(bitmap).view(np.uint8)
    ny, nx = bitmap.shape
    x_edges = np.arange(nx + 1, dtype=np.int32) if x_edges is None else x_edges
    y_edges = np.arange(ny + 1, dtype=np.int32) if y_edges is None else y_edges
    # Memory beyond the rectangles that are found is reserved but never touched.
    out = np.empty((_count_runs(bitmap), 4), dtype=np.int32)
    return out[: _sweep(bitmap, x_edges, y_edges, out)]


@dataclass(frozen=True)
class Painted:
    """Pixels covered again by rectangles of a plane; how many, and first which (or -1), lie off the pixel raster."""

    overlaps: int
    strays: int
    first_stray: int


@njit(cache=True, nogil=True)
def _paint(rects, x_edges, y_edges, value, canvas):  # pragma: no cover - compiled
    x_scale = (x_edges.size - 1) / (x_edges[-1] - x_edges[0])
    y_scale = (y_edges.size - 1) / (y_edges[-1] - y_edges[0])
    # Half a pixel below the first edge, so that cutting off the fraction rounds to the nearest edge.
    x_start = x_edges[0] - 0.5 / x_scale
    y_start = y_edges[0] - 0.5 / y_scale
    overlaps = 0
    strays = 0
    first = -1
    for i in range(rects.shape[0]):
        x0 = np.int32((rects[i, 0] - x_start) * x_scale)
        y0 = np.int32((rects[i, 1] - y_start) * y_scale)
        x1 = np.int32((rects[i, 2] - x_start) * x_scale)
        y1 = np.int32((rects[i, 3] - y_start) * y_scale)
        sound = x0 >= 0 and y0 >= 0 and x1 < x_edges.size and y1 < y_edges.size and x0 < x1 and y0 < y1
        sound = sound and x_edges[x0] == rects[i, 0] and x_edges[x1] == rects[i, 2]
        if not (sound and y_edges[y0] == rects[i, 1] and y_edges[y1] == rects[i, 3]):
            if first < 0:
                first = i
            strays += 1
            continue
        for y in range(y0, y1):
            for x in range(x0, x1):
                overlaps += (canvas[y, x] & value) != 0
                canvas[y, x] |= value
    return overlaps, strays, first


def paint(
    rects: NDArray[np.int32],
    x_edges: NDArray[np.int32],
    y_edges: NDArray[np.int32],
    bit: int,
    canvas: NDArray[np.uint8],
) -> Painted:
    """Paint rectangles ``(n, 4)`` of a plane back onto its pixels: set a bit of the canvas ``[y, x]``, in place.

    Edges are as in `rectangles`, even to half a pixel. A pixel where the bit is set already counts as covered.
    """
    overlaps, strays, first = _paint(rects, x_edges, y_edges, np.uint8(1 << bit), canvas)
    return Painted(int(overlaps), int(strays), int(first))


class Covered(NamedTuple):
    """Cells between lines, 1 where covered; how many are covered again, and how many rectangles end at no line."""

    cells: NDArray[np.uint8]
    overlaps: int
    strays: int


@njit(cache=True, nogil=True)
def _fill(boxes, out):  # pragma: no cover - compiled
    overlaps = 0
    for k in range(boxes.shape[0]):
        for j in range(boxes[k, 1], boxes[k, 3]):
            for i in range(boxes[k, 0], boxes[k, 2]):
                overlaps += out[j, i]
                out[j, i] = 1
    return overlaps


def covered(rects: NDArray[np.integer], x: NDArray[np.integer], y: NDArray[np.integer]) -> Covered:
    """Paint rectangles ``(n, 4)`` onto the cells between lines along x and y, rising, which may be uneven."""
    lines = (x, y, x, y)
    places = [np.minimum(np.searchsorted(axis, rects[:, k]), len(axis) - 1) for k, axis in enumerate(lines)]
    on_line = [axis[place] == rects[:, k] for k, (place, axis) in enumerate(zip(places, lines, strict=True))]
    sound = np.logical_and.reduce(on_line)
    cells = np.zeros((len(y) - 1, len(x) - 1), dtype=np.uint8)
    overlaps = _fill(np.stack(places, axis=1)[sound], cells)
    return Covered(cells, int(overlaps), int(np.count_nonzero(~sound)))


@njit(cache=True, nogil=True)
def _smallest_runs(bitmap, none):  # pragma: no cover - compiled
    width = space = none
    for y in range(bitmap.shape[0]):
        start = 0
        for x in range(1, bitmap.shape[1] + 1):
            if x < bitmap.shape[1] and (bitmap[y, x] != 0) == (bitmap[y, x - 1] != 0):
                continue
            if bitmap[y, x - 1] != 0:
                width = min(width, x - start)
            elif start > 0 and x < bitmap.shape[1]:
                space = min(space, x - start)
            start = x
        if width == 1 and space == 1:
            break
    return width, space


def smallest_runs(bitmap: NDArray[np.uint8]) -> tuple[int | None, int | None]:
    """Return narrowest line, and gap between two, of a plane ``[y, x]`` along x or y, in pixels; None if none."""
    none = max(bitmap.shape) + 1
    lines = (np.ascontiguousarray(bitmap), np.ascontiguousarray(bitmap.T))
    width, space = (min(pair) for pair in zip(*(_smallest_runs(line, none) for line in lines), strict=True))
    return (width if width < none else None), (space if space < none else None)


@njit(cache=True, nogil=True)
def _run_lengths(bitmap, out):  # pragma: no cover - compiled
    for y in range(bitmap.shape[0]):
        start = 0
        for x in range(1, bitmap.shape[1] + 1):
            if x < bitmap.shape[1] and (bitmap[y, x] != 0) == (bitmap[y, x - 1] != 0):
                continue
            if bitmap[y, x - 1] != 0:
                out[y, start:x] = min(x - start, 255)
            start = x


def run_lengths(bitmap: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the length of the run along x of every set pixel ``[y, x]``, at most 255; 0 where it is clear."""
    out = np.zeros(bitmap.shape, dtype=np.uint8)
    _run_lengths(np.ascontiguousarray(bitmap), out)
    return out


def annulus_sectors(inner: int, outer: int, chord_error: float) -> list[NDArray[np.int32]]:
    """Draw the annulus between two centred circles as sectors ``(v, 2)`` of at most `MAX_VERTICES`; database units.

    The vertices lie on the circles (rounded to whole units) and the chords inside them, so the opening is smaller than
    the circle by at most the chord error. The number of sectors is a multiple of four. ValueError unless 0 < inner <
    outer.
    """
    if not 0 < inner < outer or not chord_error > 0:
        raise ValueError(f"need 0 < inner < outer and chord_error > 0, but got {inner}, {outer}, {chord_error}")
    circle, per_sector = _circle(outer, chord_error)
    near, far = (np.rint(radius * circle).astype(np.int32) for radius in (inner, outer))
    starts = range(0, len(circle) - 1, per_sector)
    return [np.concatenate([far[s : s + per_sector + 1], near[s : s + per_sector + 1][::-1]]) for s in starts]


def _circle(radius: int, chord_error: float) -> tuple[NDArray[np.float64], int]:
    """Return points ``(n, 2)`` once around the unit circle, the first one again at the end, and steps per sector."""
    # A chord that spans the angle a leaves the sagitta r (1 - cos(a / 2)); the outer circle decides.
    half = math.acos(max(0.0, 1 - chord_error / radius))
    steps = math.ceil(math.pi / half)
    sectors = 4 * math.ceil(steps / (4 * (MAX_VERTICES // 2 - 1)))
    per_sector = math.ceil(steps / sectors)
    angle = np.arange(sectors * per_sector + 1) * (2 * math.pi / (sectors * per_sector))
    angle[-1] = 0.0
    return np.stack([np.cos(angle), np.sin(angle)], axis=1), per_sector


def sectors_around_square(half: int, outer: int, chord_error: float) -> list[NDArray[np.int32]]:
    """Draw what lies between a centred square, of half its edge, and a circle, as `annulus_sectors` does an annulus.

    Radial edges meet the sides of the square at 45 degrees or more. ValueError unless the circle lies around it.
    """
    if not 0 < math.hypot(half, half) < outer or not chord_error > 0:
        raise ValueError(f"need a circle around the square and chord_error > 0, but got {half}, {outer}, {chord_error}")
    circle, per_sector = _circle(outer, chord_error)
    far = np.rint(outer * circle).astype(np.int32)
    # Sectors are a multiple of four: their rays begin and end in one quadrant, whose corner may lie between.
    ends = circle[::per_sector]
    near = np.rint(half / np.abs(ends).max(axis=1)[:, None] * ends).astype(np.int64)
    found = []
    for number, start in enumerate(range(0, len(circle) - 1, per_sector)):
        first, last = near[number], near[number + 1]
        corner = np.copysign(half, ends[number] + ends[number + 1]).astype(np.int64)
        turns = [x0 * y1 - y0 * x1 for (x0, y0), (x1, y1) in ((first, corner), (corner, last))]
        inner = [last, corner, first] if min(turns) > 0 else [last, first]
        found.append(np.concatenate([far[start : start + per_sector + 1], np.array(inner, np.int32)]))
    return found


def frame_around_box(half_x: int, half_y: int, half: int) -> list[NDArray[np.int32]]:
    """Draw what lies between a centred rectangle, of half its sides, and a square around it, as two angles."""
    x, y, s = half_x, half_y, half
    lower = [(-s, -s), (s, -s), (s, -y), (-x, -y), (-x, s), (-s, s)]
    upper = [(s, -y), (s, s), (-x, s), (-x, y), (x, y), (x, -y)]
    return [np.array(corners, np.int32) for corners in (lower, upper)]


def doubled_area(polygon: NDArray[np.integer]) -> int:
    """Return twice the signed area of a polygon ``(v, 2)`` of integers, exact; counter-clockwise is positive."""
    x, y = polygon.astype(np.int64).T
    # Differences from the first vertex keep the products of most polygons far from the limits of int64.
    x, y = x - x[0], y - y[0]
    if int(np.abs(x).max()) * int(np.abs(y).max()) * 2 * len(x) >= 2**63:
        x, y = x.astype(object), y.astype(object)
    return int(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
