"""The clear aperture: how much of each DOE cell is open.

The chrome opening is a true circle, or a rectangle. The amplitude of a cell on its edge is the open share of its area;
what it scatters beyond the angles of the cell grid (a few parts in ten thousand of the light) counts among the higher
orders.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fab.aperture import Aperture, RoundAperture
from fab.grid import Grid
from sim.tracing import is_traced, single, stacked


def open_cells(grid: Grid, aperture: Aperture) -> Float[np.ndarray, "y x"]:
    """Share of each cell's area inside an aperture about the middle of the grid, float32 in 0-1."""
    if isinstance(aperture, RoundAperture):
        return circle_coverage(grid, aperture.diameter_m)
    half_y, half_x = (side / 2 / grid.pitch_m for side in aperture.extent_m)
    y, x = (grid.axis_m(axis) / grid.pitch_m for axis in ("y", "x"))
    return box_shares(y, x, (half_y, half_x), np).astype(np.float32)


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


def outline_of(aperture: Aperture, wider_m: Array | float = 0.0) -> RoundOutline | BoxOutline:
    """The outline of an aperture whose sizes are larger by some length, metres; perhaps traced."""
    if isinstance(aperture, RoundAperture):
        return RoundOutline(single(aperture.diameter_m + wider_m))
    return BoxOutline(stacked([single(side_m + wider_m) for side_m in aperture.extent_m]))


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
