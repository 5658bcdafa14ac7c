"""The clear aperture: how much of each DOE cell is open.

The chrome opening is a true circle. The amplitude of a cell on its edge is the open share of its area; what it scatters
beyond the angles of the cell grid (a few parts in ten thousand of the light) counts among the higher orders.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fab.grid import Grid
from sim.tracing import is_traced, single


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
