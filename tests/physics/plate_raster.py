"""A plate on a raster of many samples per cell: what the process model is judged by.

Nothing here shares code with `sim.surface`. Every error is done to the samples themselves: openings are
widened by morphology, corners are cut out circle by circle, walls are ramps, masks are shifted sample by sample, and
the far field is summed at the sample positions. Lengths should be whole samples where they are meant to be exact.
"""

from itertools import groupby

import numpy as np
from jaxtyping import Complex, Float
from scipy.ndimage import distance_transform_cdt, maximum_filter, minimum_filter

from fab.levels import Levels
from fab.process import Variation


def raster_height_m(
    level_map: np.ndarray,
    levels: Levels,
    pitch_m: float,
    samples: int,
    variation: Variation,
    die_m: tuple[float, float] = (0.0, 0.0),
    wafer_radius_m: float = 50e-3,
) -> Float[np.ndarray, "y x"]:
    """Height of every sample above the deepest nominal floor, metres.

    Args:
        level_map: `[y, x]` levels; the glass around the map is blank.
        levels: the staircase.
        pitch_m: edge of a cell.
        samples: samples per cell and axis.
        variation: the errors; roughness, defects and chrome are left out.
        die_m: middle of the map on the wafer (y, x).
        wafer_radius_m: where the non-uniformity has its full size.
    """
    step_m = pitch_m / samples
    ny, nx = (n * samples for n in level_map.shape)
    rows, columns = np.arange(ny), np.arange(nx)
    y = die_m[0] + ((rows + 0.5) - ny / 2)[:, None] * step_m
    x = die_m[1] + ((columns + 0.5) - nx / 2)[None, :] * step_m
    uniform = 1.0 + variation.radial_nonuniformity * (y**2 + x**2) / wafer_radius_m**2
    uniform = uniform + (variation.linear_nonuniformity_y * y + variation.linear_nonuniformity_x * x) / wafer_radius_m
    depth = np.zeros((ny, nx))
    for k in range(levels.bits):
        own = {name: _of(getattr(variation, name), k) for name in _PER_MASK}
        deep = levels.etch_depth_m(k) * (1 + variation.common_depth_scale) * (1 + own["depth_scale"])
        deep *= 1 + _of(variation.repeats, k)
        drawn = (levels.count - 1 - level_map.astype(int)) >> k & 1
        share = np.where(drawn, np.maximum(1 - variation.etch_lag * deep / (_widths(drawn) * pitch_m), 0), 0.0)
        plane = np.kron(share, np.ones((samples, samples)))
        bias = round((variation.common_cd_bias_m + own["cd_bias_m"]) / step_m)
        if bias:
            plane = (maximum_filter if bias > 0 else minimum_filter)(plane, 2 * abs(bias) + 1, mode="constant")
        radius = round(variation.corner_radius_m / step_m)
        if radius:
            plane = _rounded(plane, radius)
        if variation.sidewall_rad:
            ramp = deep * np.tan(variation.sidewall_rad) / step_m
            inside = np.asarray(distance_transform_cdt(np.pad(plane > 0, 1), "chessboard"))[1:-1, 1:-1]
            plane = plane * (_climbed(inside, ramp) - _climbed(inside - 1, ramp))
        # Where a point of the wafer was on the mask, to first order in the small turn and growth.
        turn, growth = own["rotation_rad"], own["magnification"]
        from_y = rows[:, None] - (own["overlay_y_m"] + growth * y + turn * x) / step_m
        from_x = columns[None, :] - (own["overlay_x_m"] + growth * x - turn * y) / step_m
        from_y, from_x = np.broadcast_arrays(np.rint(from_y).astype(int), np.rint(from_x).astype(int))
        there = (from_y >= 0) & (from_y < ny) & (from_x >= 0) & (from_x < nx)
        depth += deep * np.where(there, plane[from_y % ny, from_x % nx], 0.0)
    return (levels.count - 1) * levels.step_m - depth * uniform


_PER_MASK = (
    "depth_scale",
    "overlay_y_m",
    "overlay_x_m",
    "rotation_rad",
    "magnification",
    "cd_bias_m",
)


def _climbed(distance: np.ndarray, ramp: float) -> np.ndarray:
    """Integral from 0 of a ramp that rises to 1 over the given distance."""
    on_ramp = np.clip(distance, 0, ramp)
    return on_ramp**2 / (2 * ramp) + np.maximum(distance - ramp, 0)


def _of(values: tuple[float, ...], mask: int) -> float:
    return values[mask] if values else 0.0


def _widths(drawn: np.ndarray) -> np.ndarray:
    """The shorter of the runs of equal pixels through every pixel, along x and along y."""

    def runs(line: np.ndarray) -> list[int]:
        return [n for _, group in groupby(line) for n in [len(list(group))] for _ in range(n)]

    along_x = np.array([runs(line) for line in drawn])
    along_y = np.array([runs(line) for line in drawn.T]).T
    return np.minimum(along_x, along_y)


def _rounded(plane: np.ndarray, radius: int) -> np.ndarray:
    """Cut the corners of openings and fill those of islands along a circle that touches both edges."""
    out = plane.copy()
    offset = np.arange(radius) + 0.5
    hook = (radius - offset[:, None]) ** 2 + (radius - offset[None, :]) ** 2 > radius**2
    opening = (plane > 0).astype(int)
    count = opening[:-1, :-1] + opening[1:, :-1] + opening[:-1, 1:] + opening[1:, 1:]
    for y, x in np.argwhere((count == 1) | (count == 3)) + 1:
        around = opening[y - 1 : y + 1, x - 1 : x + 1]
        odd = int(around.sum() == 1)
        up, right = np.argwhere(around == odd)[0]
        own = hook[:: 1 if up else -1, :: 1 if right else -1]
        rows = slice(y, y + radius) if up else slice(y - radius, y)
        columns = slice(x, x + radius) if right else slice(x - radius, x)
        # The neighbours' state: closed beside an odd opening, as deep as the opening around an odd gap.
        out[rows, columns][own] = 0.0 if odd else plane[y - up, x - right]
    return out


def far_field(
    cells: Complex[np.ndarray, "y x"], per_cell: int, band: float, count: int = 81, slope: float = 0.0
) -> Complex[np.ndarray, "v u"]:
    """Fourier transform of a plate of squares, `count` x `count` values from -band to band waves per cell.

    Args:
        cells: transmission of every square.
        per_cell: squares per cell and axis.
        band: highest wave number.
        count: values along each axis.
        slope: how much more oblique each cell is lit than the one before, waves per cell and cell.
    """
    u = np.linspace(-band, band, count)
    x = (np.arange(cells.shape[1]) + 0.5) / per_cell - cells.shape[1] / per_cell / 2
    seen = np.sinc((u[:, None] - slope * x[None, :]) / per_cell)
    waves = np.exp(-2j * np.pi * u[:, None] * x[None, :] + 1j * np.pi * slope * x[None, :] ** 2) * seen / per_cell
    return waves @ cells @ waves.T
