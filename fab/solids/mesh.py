"""The relief as a closed mesh: for viewers (GLB), for printers and slicers (3MF, STL).

Every cell is a column with a flat top, walls are vertical, and a flat base closes the mesh below. Corners of cells
carry one vertex per height that meets there, and the walls use all of them, so that no vertex lies inside an edge and
the mesh is closed whatever the map. Where two columns meet at a corner alone, each has its own vertex on top of the
common edge, so that every edge belongs to two triangles, as 3MF demands. The volume is the sum of the columns.

The origin is the centre of the clear aperture, z = 0 the blank surface and +z away from the glass, as in STEP files.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fab.errors import CheckFailed, InputError
from fab.solids.columns import Columns
from fab.units import UM, format_length

# Triangles of which a sum is taken together, few enough for a processor's cache.
_TOGETHER = 2**16


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles ``(m, 3)`` of vertices ``(n, 3)`` x, y, z in metres, counter-clockwise seen from outside.

    `about` is one line of ASCII about what it shows; it goes into the files.
    """

    vertices_m: NDArray[np.float64]
    triangles: NDArray[np.int32]
    about: str = ""

    @property
    def corners_m(self) -> tuple[NDArray[np.float64], ...]:
        """First, second and third corner of every triangle, ``(m, 3)``."""
        return tuple(self.vertices_m[self.triangles[:, corner]] for corner in range(3))

    @cached_property
    def areas_m2(self) -> NDArray[np.float64]:
        """Areas of the triangles as seen from +z, negative from below, ``(m,)``."""
        a, b, c = self.corners_m
        along, across = b - a, c - a
        return (along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]) / 2

    @property
    def volume_m3(self) -> float:
        """Enclosed volume in cubic metres, each triangle counted with the prism between it and z = 0."""
        volume = 0.0
        for start in range(0, len(self.triangles), _TOGETHER):
            part = Mesh(self.vertices_m, self.triangles[start : start + _TOGETHER])
            volume += float(np.sum(part.areas_m2 * sum(corner[:, 2] for corner in part.corners_m)))
        return volume / 3


@njit(cache=True)
def _stack(height, base, j, i, out):  # pragma: no cover - compiled
    """Sort the distinct heights that meet at a corner into `out` and return their number."""
    ny, nx = height.shape
    count = 0
    for y in range(j - 1, j + 1):
        for x in range(i - 1, i + 1):
            value = height[y, x] if 0 <= y < ny and 0 <= x < nx else base
            at = 0
            while at < count and out[at] < value:
                at += 1
            if at < count and out[at] == value:
                continue
            for k in range(count, at, -1):
                out[k] = out[k - 1]
            out[at] = value
            count += 1
    return count


@njit(cache=True)
def _kiss(height, j, i):  # pragma: no cover - compiled
    """Return the height up to which two columns meet at a corner alone, -inf if none do."""
    ny, nx = height.shape
    if not (0 < j < ny and 0 < i < nx):
        return -np.inf
    one = min(height[j - 1, i - 1], height[j, i])
    other = min(height[j - 1, i], height[j, i - 1])
    if one > max(height[j - 1, i], height[j, i - 1]):
        return one
    return other if other > max(height[j - 1, i - 1], height[j, i]) else -np.inf


@njit(cache=True)
def _corners(height, base):  # pragma: no cover - compiled
    """Return the number of the first vertex of every corner, and the z and the twin of every vertex (-1 for none)."""
    ny, nx = height.shape
    stack = np.empty(4)
    first = np.empty((ny + 1, nx + 1), np.int32)
    used = 0
    for j in range(ny + 1):
        for i in range(nx + 1):
            first[j, i] = used
            used += _stack(height, base, j, i, stack)
    z = np.empty(used)
    twin = np.full(used, -1, np.int32)
    for j in range(ny + 1):
        for i in range(nx + 1):
            count = _stack(height, base, j, i, stack)
            kiss = _kiss(height, j, i)
            for k in range(count):
                z[first[j, i] + k] = stack[k]
                if stack[k] == kiss:
                    twin[first[j, i] + k] = used
                    used += 1
    return first, z, twin


@njit(cache=True)
def _seek(z, start, value):  # pragma: no cover - compiled
    while z[start] != value:
        start += 1
    return start


@njit(cache=True)
def _named(twin, vertex, north):  # pragma: no cover - compiled
    return twin[vertex] if north and twin[vertex] >= 0 else vertex


@njit(cache=True)
def _wall(z, twin, p, q, north_p, north_q, low, high, flip, out, used):  # pragma: no cover - compiled
    """Cover a wall between two corners with triangles of all vertices on either side; return the count.

    `p` and `q` are the first vertices of the corners. Unflipped triangles face the right of the way from p to q: +x for
    a way toward +y. An empty `out` only counts.
    """
    p, q = _seek(z, p, low), _seek(z, q, low)
    while z[p] != high or z[q] != high:
        # The side whose next vertex is lower goes up first, so that the triangles stay short.
        up_q = z[p] == high or (z[q] != high and z[q + 1] <= z[p + 1])
        if out.shape[0]:
            second = _named(twin, q, north_q)
            third = _named(twin, q + 1, north_q) if up_q else _named(twin, p + 1, north_p)
            out[used, 0] = _named(twin, p, north_p)
            out[used, 1] = third if flip else second
            out[used, 2] = second if flip else third
        used += 1
        if up_q:
            q += 1
        else:
            p += 1
    return used


@njit(cache=True)
def _triangles(height, base, first, z, twin, out):  # pragma: no cover - compiled
    """Write tops and walls, or count them if `out` is empty; return their number."""
    ny, nx = height.shape
    used = 0
    for j in range(ny + 1):
        for i in range(nx + 1):
            here = height[j, i] if j < ny and i < nx else base
            if j < ny and i < nx:
                if out.shape[0]:
                    a = _named(twin, _seek(z, first[j, i], here), True)
                    b = _named(twin, _seek(z, first[j, i + 1], here), True)
                    c = _seek(z, first[j + 1, i + 1], here)
                    d = _seek(z, first[j + 1, i], here)
                    out[used, 0], out[used, 1], out[used, 2] = a, b, c
                    out[used + 1, 0], out[used + 1, 1], out[used + 1, 2] = a, c, d
                used += 2
            # A wall belongs to its higher column, which names the vertices.
            if j < ny:
                left = height[j, i - 1] if i > 0 else base
                low, high = min(left, here), max(left, here)
                if low < high:
                    p, q = first[j, i], first[j + 1, i]
                    used = _wall(z, twin, p, q, True, False, low, high, left < here, out, used)
            if i < nx:
                below = height[j - 1, i] if j > 0 else base
                low, high = min(below, here), max(below, here)
                if low < high:
                    p, q, north = first[j, i], first[j, i + 1], here > below
                    used = _wall(z, twin, p, q, north, north, low, high, not north, out, used)
    return used


def _bottom(first: NDArray[np.int32]) -> NDArray[np.int32]:
    """Cover the base with triangles that use every vertex of its rim and none inside."""
    south, north, west, east = first[0], first[-1], first[:, 0], first[:, -1]
    ones = np.ones_like
    parts = [
        # A strip of triangles between the low and the high rim; the first and the last one ...
        np.stack([south[1:-1], north[1:-1], south[2:]], axis=1),
        np.stack([north[:-2], north[1:-1], south[1:-1]], axis=1),
        # ... are fans, because the left and the right rim have vertices of their own.
        np.stack([west[:-1], west[1:], south[1] * ones(west[1:])], axis=1),
        np.stack([north[-2] * ones(east[1:]), east[1:], east[:-1]], axis=1),
    ]
    return np.concatenate(parts)


def relief_mesh(cells: Columns, base_m: float) -> Mesh:
    """Build the closed mesh of a relief on a slab `base_m` (metres) below the deepest floor.

    Its volume is ``cells.volume_m3 + base_m * cells.area_m2``.
    """
    if not 0 < base_m < math.inf:
        raise InputError("mesh base", "must be positive and finite", base_m, "Choose a positive number.")
    height = cells.height_m - cells.blank_m
    base = -cells.blank_m - base_m
    first, z, twin = _corners(height, base)
    sides = np.empty((_triangles(height, base, first, z, twin, np.empty((0, 3), np.int32)), 3), dtype=np.int32)
    _triangles(height, base, first, z, twin, sides)
    counts = np.diff(np.append(first.ravel(), z.size))
    corners_x, corners_y = np.meshgrid(cells.x_edges_m, cells.y_edges_m)
    vertices = np.stack([np.repeat(corners_x.ravel(), counts), np.repeat(corners_y.ravel(), counts), z], axis=1)
    vertices = np.concatenate([vertices, vertices[twin >= 0]])
    about = (
        f"DOE relief, heights x 1, blocks of {cells.block} x {cells.block} pixels, "
        f"base {format_length(base_m)}, z = 0 at the blank surface, origin at the centre of the clear aperture"
    )
    return Mesh(vertices, np.concatenate([_bottom(first), sides]), about)


def closed_volume_m3(mesh: Mesh) -> float:
    """Return the volume of a mesh, cubic metres; CheckFailed unless manifold3d finds it to be the skin of a solid.

    The library works in float32 here, on micrometres, as the files do. Triangles without common vertices, as in an STL
    file, are joined where they touch.
    """
    import manifold3d

    raw = manifold3d.Mesh((mesh.vertices_m / UM).astype(np.float32), mesh.triangles.astype(np.uint32))
    if len(mesh.vertices_m) == 3 * len(mesh.triangles):
        raw.merge()
    solid = manifold3d.Manifold(raw)
    volume = solid.volume()
    if solid.status() != manifold3d.Error.NoError or not volume > 0:
        raise CheckFailed([f"mesh: not the skin of a solid ({solid.status().name}, volume {volume:g} um3)"])
    return volume * UM**3


def is_closed(mesh: Mesh) -> bool:
    """Whether every edge is run through as often one way as the other, vertices at one place being one.

    Every edge gets a random number that depends on its two ends, and their sum, with the sign of the way, is taken: it
    is 0 for a closed surface, and for any other but once in 2^64.
    """
    bits = (mesh.vertices_m + 0.0).view(np.uint64)  # + 0.0: no minus before a zero
    ends = _mixed(bits[:, 0] + _mixed(bits[:, 1] + _mixed(bits[:, 2])))
    total = 0
    for start in range(0, len(mesh.triangles), _TOGETHER):
        corners = ends[mesh.triangles[start : start + _TOGETHER]]
        ahead = np.roll(corners, -1, axis=1)
        edges = _mixed(np.minimum(corners, ahead) + _mixed(np.maximum(corners, ahead)))
        total += int(np.sum(np.where(corners < ahead, edges, ~edges + np.uint64(1)), dtype=np.uint64))
    return total % 2**64 == 0


def _mixed(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Scatter numbers over all of 64 bits (the finaliser of SplitMix64)."""
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))
