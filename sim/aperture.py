"""The clear aperture: how much of each DOE cell is open.

The chrome opening is a true circle, so cells on its edge are partly covered. A cell's amplitude is the open share
of its area; what an edge cell scatters at angles beyond the
cell grid (a few parts in ten thousand of the light) counts among the higher orders of the energy budget.
"""

import numpy as np
from jaxtyping import Float

from fab.grid import Grid


def circle_coverage(grid: Grid, diameter_m: float) -> Float[np.ndarray, "y x"]:
    """Share of each cell's area inside a centred circle, float32 in 0-1.

    Args:
        grid: cells of the DOE.
        diameter_m: diameter of the clear aperture, metres.

    Each edge cell is cut into 64 strips along y whose open length along x is exact, so the total area is
    right to about 1e-7 of the circle for apertures of a thousand cells or more.
    """
    radius = diameter_m / 2 / grid.pitch_m
    y = np.abs(grid.axis_m("y")) / grid.pitch_m
    x = np.abs(grid.axis_m("x")) / grid.pitch_m
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


def clear_area_m2(diameter_m: float) -> float:
    """Area of the clear aperture in square metres."""
    return np.pi * diameter_m**2 / 4
