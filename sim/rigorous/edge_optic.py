"""A DOE whose walls are part of its light: thin cells, and a line of light along every wall between them.

Light that passes near a wall is not that of a thin element (`sim.rigorous.edge_widths`). The lines of light lie on the
borders of cells, where the transform has no sample: they are spread over the cells to either side, by weights whose far
field is that of a line up to the highest wave number on the sensor, the obliquity of a near source included. So a PSF
with edges takes the same transform as one without; where the light of a near source or that to the window's edge is too
oblique for the cells, every cell is first split into two by two.

The wall between two cells side by side along x is crossed by light polarised along x (TM), and lies along light
polarised along y (TE). The mean image of unpolarised light is that of mean widths: the square of half the difference
between TE and TM, which is left out, is 0.1 % of a PSF at most.
"""

# Abstract fields become fields, or properties, of subclasses.
# pyright: reportIncompatibleVariableOverride=false

from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.interpolate import CubicSpline

from fab.errors import InputError
from fab.grid import Grid
from sim.aperture import circle_coverage
from sim.camera import Camera, SpectralLine
from sim.material import refractive_index
from sim.optic import CellOptic
from sim.propagation.pupil import cis
from sim.rigorous.edge_widths import edge_widths
from sim.source import SourceMap
from sim.tracing import is_traced

POLARISATIONS = ("unpolarised", "x", "y")
# Root mean square error of a line's far field that is good enough, and the largest that is borne before cells are
# split; lines are about a tenth of the light.
_GOOD, _WORST, _MOST_TAPS = 0.005, 0.03, 10
_NODE_M, _PER_NODE = 25e-9, 16  # between heights of walls that are solved, and steps of the table between two of them


class EdgeOptic(CellOptic):
    """A DOE with the light of its walls.

    Attributes:
        camera: lens, sensor and substrate. Its grid is that of the cells here: those of the DOE, or a whole number of
            parts of them.
        coverage: `[y, x]` open share of every cell.
        transmission: `[wavelength, y, x]` values of the cells whose far field is that of cells and walls.
        wavelengths_m: different vacuum wavelengths.
        source_kind: how sources are described.
    """

    camera: Camera = eqx.field(static=True)
    coverage: Float[Array, "y x"]
    transmission: Complex[Array, "w y x"]
    wavelengths_m: tuple[float, ...] = eqx.field(static=True)
    source_kind: type[SourceMap] = eqx.field(static=True, default=SourceMap)

    @property
    def means(self) -> Complex[Array, "w y x"]:
        """The transmission: weights of a line sum to its light."""
        return self.transmission

    def cells(self, line: SpectralLine) -> tuple[None, Array]:
        """Transmission at one wavelength."""
        return None, self.transmission[self.wavelengths_m.index(line.wavelength_m)]


def with_edges(
    height_m: Any, camera: Camera, polarisation: str = "unpolarised", *, nearest_m: float = np.inf
) -> EdgeOptic:
    """A DOE of upright walls, with their light.

    Args:
        height_m: `[y, x]` height of every cell of `camera.grid`, metres; numpy, or jax, perhaps traced.
        camera: DOE grid, aperture, substrate, lens and sensor.
        polarisation: "unpolarised", or the axis along which the light's electric field lies.
        nearest_m: depth of the nearest source that will be looked at, metres.

    Returns:
        the DOE, lit from the side of its relief.

    Raises:
        ValueError: heights of another shape than the grid's.
        InputError: a polarisation that is none.
    """
    if polarisation not in POLARISATIONS:
        raise InputError("polarisation", 'must be "unpolarised", "x" or "y"', repr(polarisation), "Choose one of them.")
    height = jnp.asarray(height_m, jnp.float32)
    if height.shape != camera.grid.shape:
        raise ValueError(f"`height_m` must have the grid's shape {camera.grid.shape}, but got {height.shape}")
    wavelengths = tuple(dict.fromkeys(line.wavelength_m for line in camera.lines))
    oblique = [oblique_waves(camera, wavelength, nearest_m) for wavelength in wavelengths]
    parts = 1
    while max(line_taps(seen / parts, lit / parts)[1] for seen, lit in oblique) > _WORST:
        parts += 1
    if parts > 1:
        height = jnp.repeat(jnp.repeat(height, parts, axis=0), parts, axis=1)
        grid = Grid((camera.grid.shape[0] * parts, camera.grid.shape[1] * parts), camera.grid.pitch_m / parts)
        camera = replace(camera, grid=grid)
    found = []
    for wavelength, (seen, lit) in zip(wavelengths, oblique, strict=True):
        index = refractive_index(camera.material, wavelength)
        # Walls of two waves, where heights are traced.
        highest = 2 * wavelength / (index - 1) if is_traced(height) else float(jnp.ptp(height))
        nodes = max(2, int(np.ceil(highest / _NODE_M - 1e-3)) + 1)
        table = [_table(wavelength, index, polarisation, axis, nodes) for axis in ("y", "x")]
        taps, _ = line_taps(seen / parts, lit / parts)
        rate = camera.waves_per_metre(wavelength)
        found.append(_transmission(height, rate, *table, taps, camera.grid.pitch_m))
    coverage = jnp.asarray(circle_coverage(camera.grid, camera.aperture_m))
    return EdgeOptic(camera, coverage, jnp.stack(found), wavelengths)


def oblique_waves(camera: Camera, wavelength_m: float, depth_m: float) -> tuple[float, float]:
    """Highest wave numbers of the light of a source at a depth and of that to a pixel of the window, waves per cell.

    Returns:
        to a pixel on the window's edge, and from the source to a cell on the aperture's rim.
    """
    seen = (camera.window / 2 + 1) * camera.pixel_m / camera.sensor_distance_m
    curvature = 1 / depth_m + 1 / camera.sensor_distance_m - 1 / camera.focal_length_m
    lit = camera.aperture_m / 2 * abs(curvature)
    return seen * camera.grid.pitch_m / wavelength_m, lit * camera.grid.pitch_m / wavelength_m


@lru_cache(maxsize=64)
def line_taps(seen: float, lit: float) -> tuple[tuple[float, ...], float]:
    """Weights on the cells 1/2, 3/2 ... away from a line whose far field is that of the line.

    A cell's far field falls off like sinc(u), that of a line does not: the sum of 2 a_k cos(2 pi u (k - 1/2)) is fitted
    to 1 / sinc(u) by least squares, exact on the axis, with as few weights as leave an error of half a percent, or ten.
    Here u is the wave number from the light that falls on a cell to that which reaches a pixel; those that few cells
    and pixels have count little.

    Args:
        seen: highest wave number of a pixel, waves per cell.
        lit: highest wave number of the light on a cell.

    Returns:
        the weights, and the root mean square of their error over the cells of the DOE and the pixels of the window.
    """
    waves, across = np.linspace(0, seen + lit, 600), (np.arange(400) + 0.5) * np.pi / 400
    # Cells on a chord of the aperture, each with all pixels.
    share = (np.abs(waves[:, None] - lit * np.cos(across)) <= seen) @ np.sin(across) ** 2
    count_of = np.sqrt(share / share.sum()) * np.sinc(waves)
    weights, error = np.array([0.5]), np.inf
    for count in range(1, _MOST_TAPS + 1):
        basis = 2 * np.cos(2 * np.pi * waves[:, None] * (np.arange(1, count + 1) - 0.5))
        wanted = 1 / np.sinc(waves) - basis[:, 0] / 2
        scaled = (basis[:, 1:] - basis[:, :1]) * count_of[:, None]
        rest = np.linalg.lstsq(scaled, wanted * count_of, rcond=None)[0]
        weights = np.concatenate([[0.5 - rest.sum()], rest])
        error = float(np.linalg.norm((basis @ weights - 1 / np.sinc(waves)) * count_of))
        if error <= _GOOD:
            break
    return tuple(weights.tolist()), error


@lru_cache(maxsize=64)
def _table(wavelength_m: float, index: float, polarisation: str, axis: str, nodes: int) -> Complex[np.ndarray, " step"]:
    """Light of walls across an axis over that of the lower cell, metres, one per `_NODE_M / _PER_NODE` of height."""
    heights = np.arange(nodes) * _NODE_M
    ways = {"unpolarised": ("TE", "TM"), axis: ("TM",)}.get(polarisation, ("TE",))
    widths = np.mean([edge_widths(tuple(heights.tolist()), wavelength_m, index, way) for way in ways], axis=0)
    # The lower cell's light is delayed by its own glass; all of the wall's height is air to it.
    fine = np.arange((nodes - 1) * _PER_NODE + 1) * (_NODE_M / _PER_NODE)
    turned = CubicSpline(heights, widths)(fine) * np.exp(-2j * np.pi * fine / wavelength_m)
    return turned.astype(np.complex64)


@partial(jax.jit, static_argnames=("taps",))
def _transmission(
    height_m: Float[Array, "y x"],
    rate: Any,
    across_y: Complex[Array, " step"],
    across_x: Complex[Array, " step"],
    taps: tuple[float, ...],
    pitch_m: Any,
) -> Complex[Array, "y x"]:
    light = cis(height_m * rate)

    def lines(first: Array, second: Array, first_light: Array, second_light: Array, table: Array) -> Array:
        place = jnp.abs(second - first) * (_PER_NODE / _NODE_M)
        below = jnp.clip(place.astype(jnp.int32), 0, table.shape[0] - 2)
        share = place - below
        width = table[below] * (1 - share) + table[below + 1] * share
        return width * jnp.where(first < second, first_light, second_light) / pitch_m

    def spread(wall: Array, axis: int) -> Array:
        reach = len(taps)
        padded = jnp.pad(wall, [(reach, reach) if a == axis else (0, 0) for a in range(2)])
        count = wall.shape[axis] + 1
        parts = [
            taps[k] * jax.lax.slice_in_dim(padded, start, start + count, axis=axis)
            for k in range(reach)
            for start in (reach + k, reach - 1 - k)
        ]
        return sum(parts[1:], parts[0])

    over_y = lines(height_m[:-1], height_m[1:], light[:-1], light[1:], across_y)
    over_x = lines(height_m[:, :-1], height_m[:, 1:], light[:, :-1], light[:, 1:], across_x)
    return light + spread(over_y, 0) + spread(over_x, 1)
