"""The clear aperture: how much of each DOE cell is open.

The chrome opening is a true circle, a rectangle, or any open cells. The amplitude of a cell on its edge is the open
share of its area; what it scatters beyond the angles of the cell grid (a few parts in ten thousand of the light) counts
among the higher orders.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import csr_array

from fab.aperture import Aperture, MaskAperture, RoundAperture
from fab.grid import Grid
from fab.units import UM
from sim.tracing import is_traced, single, stacked

_ROOM_M = 5 * UM  # corners of a mask move by no more
_ROUNDING = 1e-4
_TILE = 64  # cells


def open_cells(grid: Grid, aperture: Aperture) -> Float[np.ndarray, "y x"]:
    """Share of each cell's area inside an aperture about the middle of the grid, float32 in 0-1."""
    if isinstance(aperture, RoundAperture):
        return circle_coverage(grid, aperture.diameter_m)
    if isinstance(aperture, MaskAperture):
        return _mask_coverage(grid, aperture)
    half_y, half_x = (side / 2 / grid.pitch_m for side in aperture.extent_m)
    y, x = (grid.axis_m(axis) / grid.pitch_m for axis in ("y", "x"))
    return box_shares(y, x, (half_y, half_x), np).astype(np.float32)


def _mask_coverage(
    grid: Grid, aperture: MaskAperture, centre_m: tuple[Any, Any] = (0.0, 0.0)
) -> Float[np.ndarray, "y x"]:
    """Share of each cell's area inside a mask about a centre (y, x), metres; exact."""
    area = aperture.area
    if not area.cells.size:
        return np.zeros(grid.shape, np.float32)
    centres = (grid.axis_m("y") - float(centre_m[0]), grid.axis_m("x") - float(centre_m[1]))
    rows, columns = (
        _overlaps(places / grid.pitch_m, lines * (aperture.pitch_m / grid.pitch_m))
        for places, lines in zip(centres, area[:2], strict=True)
    )
    found = np.asarray(rows @ (columns @ area.cells.T.astype(np.float64)).T)
    # Parts of a cell sum to all of it but for rounding.
    return found.round(9).astype(np.float32)


def _overlaps(places: Float[np.ndarray, " n"], lines: Float[np.ndarray, " m"]) -> csr_array:
    """How much of unit lengths about some places lies between one line and the next, `[place, line]`."""
    first = np.clip(np.searchsorted(lines, places - 0.5, side="right") - 1, 0, len(lines) - 2)
    last = np.clip(np.searchsorted(lines, places + 0.5, side="left") - 1, 0, len(lines) - 2)
    rows = np.repeat(np.arange(len(places)), last - first + 1)
    columns = np.concatenate([np.arange(a, b + 1) for a, b in zip(first, last, strict=True)])
    shares = np.minimum(places[rows] + 0.5, lines[columns + 1]) - np.maximum(places[rows] - 0.5, lines[columns])
    return csr_array((np.maximum(shares, 0.0), (rows, columns)), shape=(len(places), len(lines) - 1))


def circle_coverage(
    grid: Grid, diameter_m: float, centre_m: tuple[float, float] = (0.0, 0.0)
) -> Float[np.ndarray, "y x"]:
    """Share of each cell's area inside a circle, float32 in 0-1; lengths in metres, the centre as (y, x).

    Each edge cell is cut into 64 strips along y whose open length along x is exact, so the total area is right to about
    1e-7 of the circle for apertures of a thousand cells or more.
    """
    radius = diameter_m / 2 / grid.pitch_m
    y = np.abs(grid.axis_m("y") - centre_m[0]) / grid.pitch_m
    x = np.abs(grid.axis_m("x") - centre_m[1]) / grid.pitch_m
    far = np.hypot(y[:, None] + 0.5, x[None, :] + 0.5)
    near = np.hypot(np.maximum(y[:, None] - 0.5, 0), np.maximum(x[None, :] - 0.5, 0))
    coverage = (far <= radius).astype(np.float32)
    rows, columns = np.nonzero((far > radius) & (near < radius))
    strips = (np.arange(64) + 0.5) / 64 - 0.5
    offsets = y[rows][:, None] + strips[None, :]
    half_chord = np.sqrt(np.maximum(radius**2 - offsets**2, 0.0))
    left = x[columns][:, None] - 0.5
    open_length = np.clip(half_chord - left, 0.0, 1.0) - np.clip(-half_chord - left, 0.0, 1.0)
    coverage[rows, columns] = open_length.mean(axis=1)
    return coverage


class RoundOutline(NamedTuple):
    """A round outline, as numbers that may be traced."""

    diameter_m: Any

    def shares(self, y: Any, x: Any, side_m: Any, xp: Any = jnp) -> Any:
        """Open share of squares of a side (metres) in rows `y` and columns `x`, in sides from its middle, `[y, x]`."""
        return open_shares(y, x, self.diameter_m / 2 / side_m, xp)


class BoxOutline(NamedTuple):
    """A rectangular outline, height and width, as numbers that may be traced."""

    size_m: Any

    def shares(self, y: Any, x: Any, side_m: Any, xp: Any = jnp) -> Any:
        """The same as of a `RoundOutline`; exact."""
        return box_shares(y, x, (self.size_m[0] / 2 / side_m, self.size_m[1] / 2 / side_m), xp)


class MaskOutline(eqx.Module):
    """The outline of a mask whose parts are wider, and higher, by a length that may be traced.

    Its corners move by half of that along either axis, those of open parts outward and those of closed parts inward: as
    a rim moves, while parts do not meet as they grow and none vanishes as it shrinks.
    """

    y: Any  # lines between cells, in cells of the mask from its middle
    x: Any
    open: Any  # `[y, x]` which cells between them are
    wider_m: Any
    pitch_m: float = eqx.field(static=True)

    @classmethod
    def of(cls, aperture: MaskAperture, wider_m: Any) -> "MaskOutline":
        """That of an aperture."""
        y, x, cells = aperture.area
        return cls(single(y), single(x), cells.view(np.uint8), single(wider_m), aperture.pitch_m)

    def shares(self, y: Any, x: Any, side_m: Any) -> Any:
        """The same as of a `RoundOutline`; exact but for rounding, where corners move by 5 um at the most."""
        (rows, low), (columns, left) = (self._near(lines, at, side_m) for lines, at in ((self.y, y), (self.x, x)))
        cells = jax.lax.dynamic_slice(jnp.asarray(self.open), (low, left), (len(rows) - 1, len(columns) - 1))
        ramps_y, ramps_x = (
            {sign: jnp.clip(at[:, None] + 0.5 - lines - sign * self.wider_m / 2 / side_m, 0.0, 1.0) for sign in (-1, 1)}
            for at, lines in ((y, rows), (x, columns))
        )
        found = sum(
            jnp.einsum("pi,ij,qj->pq", ramps_y[up], corners, ramps_x[right], precision=jax.lax.Precision.HIGHEST)
            for (up, right), corners in _moving_corners(cells).items()
        )
        # Sums of ones and minus ones are whole but for rounding.
        whole = jnp.abs(found - jnp.rint(found)) < _ROUNDING
        return jnp.clip(jnp.where(whole, jnp.rint(found), found), 0.0, 1.0)

    def _near(self, lines: Any, at: Any, side_m: Any) -> tuple[Any, Any]:
        """Lines about some squares, in their sides, and the number of the first."""
        lines = jnp.asarray(lines) * (self.pitch_m / side_m)
        # Edges of cells moved both ways: at most two lines to a cell.
        count = 2 * math.ceil(len(at) * float(side_m) / self.pitch_m + 2 * _ROOM_M / self.pitch_m) + 6
        if count >= len(lines):
            return lines, 0
        first = jnp.searchsorted(lines, at[0] - 0.5 - _ROOM_M / side_m) - 1
        first = jnp.clip(first, 0, len(lines) - count)
        return jax.lax.dynamic_slice(lines, (first,), (count,)), first


def _moving_corners(cells: Array) -> dict[tuple[int, int], Array]:
    """Corners of open cells by the direction (y, x) in which they move as what is open grows, `[line, line]`.

    Each is the sign of the quadrant above and right of it; what is open is the sum of these. Where two open parts
    touch, the closed ones have a corner each.
    """
    padded = jnp.pad(cells, 1).astype(jnp.float32)
    low_left, low_right, up_left, up_right = padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]

    def toward(ahead: Array, behind: Array, one: Array, other: Array) -> Array:
        return (1 - ahead) * (behind * (1 - one - other) - (1 - behind) * one * other)

    return {
        (1, 1): toward(up_right, low_left, up_left, low_right),
        (-1, -1): toward(low_left, up_right, up_left, low_right),
        (1, -1): -toward(up_left, low_right, up_right, low_left),
        (-1, 1): -toward(low_right, up_left, up_right, low_left),
    }


def outline_of(aperture: Aperture, wider_m: Array | float = 0.0) -> RoundOutline | BoxOutline | MaskOutline:
    """The outline of an aperture whose sizes are larger by some length, metres; perhaps traced."""
    if isinstance(aperture, RoundAperture):
        return RoundOutline(single(aperture.diameter_m + wider_m))
    if isinstance(aperture, MaskAperture):
        return MaskOutline.of(aperture, wider_m)
    return BoxOutline(stacked([single(side_m + wider_m) for side_m in aperture.extent_m]))


@partial(jax.jit, static_argnames="pitch_m")
def _by_tiles(outline: MaskOutline, y: Array, x: Array, pitch_m: float) -> Array:
    """Open share of cells of a pitch in rows `y` and columns `x`, metres, `[y, x]`, a tile of them at a time."""
    tiles = [jnp.pad(at / pitch_m, (0, -len(at) % _TILE), mode="reflect", reflect_type="odd") for at in (y, x)]
    rows, columns = (at.reshape(-1, _TILE) for at in tiles)
    found = jax.lax.map(lambda row: jax.lax.map(lambda column: outline.shares(row, column, pitch_m), columns), rows)
    return jnp.transpose(found, (0, 2, 1, 3)).reshape(rows.size, columns.size)[: len(y), : len(x)]


def displaced_cells(
    grid: Grid, aperture: Aperture, wider_m: Array | float, centre_m: tuple[Array | float, Array | float]
) -> Float[Array, "y x"]:
    """Share of each cell's area inside an aperture, differentiable in its place (y, x) and in its size.

    Args:
        grid: the cells.
        aperture: as it is meant.
        wider_m: by how much it is wider, and higher.
        centre_m: where its middle lies.
    """
    if isinstance(aperture, RoundAperture):
        return displaced_circle_coverage(grid, aperture.diameter_m + wider_m, centre_m)
    traced = is_traced(wider_m, centre_m)
    if isinstance(aperture, MaskAperture):
        if not traced and float(wider_m) / 2 <= aperture.inset_m:
            return jnp.asarray(_mask_coverage(grid, aperture.shrunk(-float(wider_m) / 2), centre_m))
        places = [
            jnp.asarray(grid.axis_m(axis), jnp.float32) - at for axis, at in zip(("y", "x"), centre_m, strict=True)
        ]
        return _by_tiles(MaskOutline.of(aperture, wider_m), *places, grid.pitch_m)
    xp, real = (jnp, jnp.float32) if traced else (np, np.float64)
    y, x = (xp.asarray(grid.axis_m(axis), real) - at for axis, at in zip(("y", "x"), centre_m, strict=True))
    half_y, half_x = ((side_m + wider_m) / 2 / grid.pitch_m for side_m in aperture.extent_m)
    return jnp.asarray(box_shares(y / grid.pitch_m, x / grid.pitch_m, (half_y, half_x), xp), jnp.float32)


def displaced_circle_coverage(
    grid: Grid, diameter_m: Array | float, centre_m: tuple[Array | float, Array | float]
) -> Float[Array, "y x"]:
    """Share of each cell's area inside a large circle, differentiable in its diameter and centre (y, x).

    Within a cell the circle is taken as straight: the area of a unit square on one side of a line is a closed form,
    and what the bow leaves out is pitch / (12 diameter) of an edge cell, 1e-7 of a circle of a thousand cells.
    """
    # A known circle is NumPy's: one by one, jax's operations take a second to compile. They divide by a number as these
    # do; under a trace the compiler folds it.
    traced = is_traced(diameter_m, centre_m)
    per_pitch = np.float32(1) / np.float32(grid.pitch_m)
    y, x = single(grid.axis_m("y")) - centre_m[0], single(grid.axis_m("x")) - centre_m[1]
    y, x = (axis / grid.pitch_m if traced else axis * per_pitch for axis in (y, x))
    return jnp.asarray(open_shares(y, x, diameter_m / 2 / grid.pitch_m, jnp if traced else np))


def open_shares(y: Any, x: Any, radius: Any, xp: Any = jnp) -> Any:
    """Share of the area of unit squares with their centres at the rows `y` and columns `x` inside a circle, `[y, x]`.

    The circle of a `radius` about the origin is taken as straight within a square; `xp` is jax.numpy or numpy.
    """
    y, x = y[:, None], x[None, :]
    distance = xp.sqrt(xp.maximum(y * y + x * x, 1e-6))
    # At least 0.7, but in the very middle of the circle, where nothing is to be divided by zero.
    steep = xp.maximum(xp.maximum(xp.abs(y), xp.abs(x)) / distance, 0.5)
    flat = xp.maximum(xp.minimum(xp.abs(y), xp.abs(x)) / distance, 1e-4)
    inward = radius - distance
    far, near = (steep + flat) / 2, (steep - flat) / 2
    # A line through opposite sides cuts a trapezoid; nearer to a corner, a triangle.
    triangle = xp.square(xp.maximum(far - xp.abs(inward), 0.0)) / (2 * steep * flat)
    beyond = xp.where(inward > 0, 1.0 - triangle, triangle)
    return xp.where(xp.abs(inward) <= near, 0.5 + inward / steep, beyond)


def box_shares(y: Any, x: Any, half: tuple[Any, Any], xp: Any = jnp) -> Any:
    """Share of the area of unit squares, as in `open_shares`, inside a rectangle of half the sides (y, x); exact."""
    along_y, along_x = (
        xp.clip(xp.minimum(at + 0.5, side) - xp.maximum(at - 0.5, -side), 0.0, 1.0)
        for at, side in zip((y, x), half, strict=True)
    )
    return along_y[:, None] * along_x[None, :]
