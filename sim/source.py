"""Point sources: the optical path from a source to the cells of a DOE, for one wavelength, depth and field angle.

`SourceMap` holds the path to every cell, wrapped in double precision on the host (`source_waves`).

`SeparableSource` describes it by a few numbers and two rows of phase, so that one compiled step serves every depth. The
path from side to side of the aperture is a hundred waves. All but a few of them are a parabola, and a parabola is a sum
over y and x: it is wrapped per axis, in double precision, on the host. What remains, for a chief ray of curvature
k = 1 / c and direction sines s, is

    -k q² / (2 (1 + sqrt(1 + k q))²),    q = k r² + 2 s·r,

free of cancellation and small enough for single precision.
"""

import itertools
from functools import lru_cache
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from fab.grid import Grid
from sim.camera import Camera
from sim.illumination import path_from_point_m
from sim.lens import direction_sines

Real = Array | np.ndarray | np.float32


def source_path_m(
    camera: Camera, depth_m: float, field_rad: tuple[float, float] = (0.0, 0.0)
) -> Float[np.ndarray, "y x"]:
    """Optical path from a point source to every DOE cell, relative to the chief ray, metres in float64.

    Eq. 1 of the paper with the constant subtracted, plus r^2/2 times `Camera.curvature_per_m`, which is 1/d - 1/f for a
    sensor at distance d. The linear path of field angles (y, x), the tilt that moves the image, is removed: the window
    follows the chief ray.
    """
    return _whole(_distinct_path_m(camera, depth_m, field_rad), camera.grid.shape)


def source_waves(
    camera: Camera, wavelength_m: float, depth_m: float, field_rad: tuple[float, float] = (0.0, 0.0)
) -> Float[np.ndarray, "y x"]:
    """`source_path_m` in waves, as `wrapped_waves` has it."""
    return _whole(wrapped_waves(_distinct_path_m(camera, depth_m, field_rad), wavelength_m), camera.grid.shape)


# Colours of one depth share the path, and so do those who look at a PSF in several ways; arrays are read-only.
@lru_cache(maxsize=4)
def _distinct_path_m(camera: Camera, depth_m: float, field_rad: tuple[float, float]) -> Float[np.ndarray, "v u"]:
    """`source_path_m` to cells from which all follow: on the axis those of a quarter, else all."""
    y, x = (camera.grid.axis_m(axis) for axis in ("y", "x"))
    if not any(field_rad):
        y, x = y[len(y) // 2 :], x[len(x) // 2 :]
    path = path_at_m(camera, y[:, None], x, depth_m, field_rad)
    path.setflags(write=False)
    return path


def _whole(distinct: Float[np.ndarray, "v u"], shape: tuple[int, int]) -> Float[np.ndarray, "y x"]:
    """Values of all cells, of those of a quarter or of all."""
    if distinct.shape == shape:
        return distinct
    across_y, across_x = (np.abs(np.arange(1 - count, count, 2)) // 2 for count in shape)
    return distinct[across_y[:, None], across_x]


def path_at_m(
    camera: Camera,
    y_m: Float[np.ndarray, "*s"],
    x_m: Float[np.ndarray, "*t"],
    depth_m: float,
    field_rad: tuple[float, float] = (0.0, 0.0),
) -> Float[np.ndarray, "*u"]:
    """`source_path_m` at any points (y, x) of the aperture, broadcast against each other."""
    square = y_m**2 + x_m**2
    defocus = (square / 2) * camera.curvature_per_m()
    if np.isinf(depth_m):
        return defocus
    return path_from_point_m(y_m, x_m, depth_m, field_rad) + defocus


def wrapped_waves(path_m: Float[np.ndarray, "*s"], wavelength_m: float) -> Float[np.ndarray, "*s"]:
    """Path in waves, wrapped to [-1/2, 1/2] in float64 and only then rounded to float32.

    5 cm from a 4.4 mm aperture the path is a hundred waves; float32 would leave 1e-5 of them.
    """
    waves = path_m / wavelength_m
    waves -= np.round(waves)
    return waves.astype(np.float32)


def depth_on_axis_m(depth_m: float, field_rad: tuple[float, float]) -> float:
    """Depth on the axis from which light is as oblique to the cells as that of a source at field angles (y, x), metres.

    About a chief ray of length c at an angle t to the axis a wave has the curvatures 1 / c across the plane of both and
    cos² t / c in it; this is where their mean comes from.
    """
    cosine = 1 / float(np.sqrt(1 + np.sum(np.tan(field_rad) ** 2)))
    return depth_m / (cosine * (1 + cosine**2) / 2)


class MapColumns(NamedTuple):
    """Waves per metre of DOE height; the rows are the waves of the source."""

    waves_per_metre: Real

    def waves(self, rows: Array, height_m: Array | None) -> Float[Array, "y x"]:
        """Optical path in waves."""
        return rows if height_m is None else height_m * self.waves_per_metre + rows


class SourceMap(eqx.Module):
    """A point source by its path to every cell.

    The wrapped path `[y, x]` (or `[subring]`) in waves, and waves per metre of DOE height for this chief ray.
    """

    source_waves: Float[Array, "*cell"]
    waves_per_metre: Float[Array, ""]

    @classmethod
    def at(
        cls, camera: Camera, wavelength_m: float, depth_m: float, field_rad: tuple[float, float] = (0.0, 0.0)
    ) -> "SourceMap":
        """A source at a depth (metres, `inf` allowed) and field angles (y, x), as every cell of the camera sees it."""
        waves = source_waves(camera, wavelength_m, depth_m, field_rad)
        return cls(jnp.asarray(waves), jnp.float32(camera.waves_per_metre(wavelength_m, field_rad)))

    def over(self, grid: Grid) -> tuple[Array, MapColumns]:
        """Arguments of `sim.propagation.pupil.doe_field`: by row, and for all rows alike."""
        return self.source_waves, MapColumns(self.waves_per_metre)


class SeparableColumns(NamedTuple):
    """A `SeparableSource` on columns at `x_m`; the rows are their positions and `waves_y`."""

    x_m: Array
    waves_x: Array
    curvature: Array
    sines: Array
    waves_per_metre: Array
    inverse_wavelength: Array

    def waves(self, rows: tuple[Array, Array], height_m: Array | None) -> Float[Array, "y x"]:
        """Optical path in waves."""
        y_m, waves_y = rows
        waves = waves_y[:, None] if height_m is None else height_m * self.waves_per_metre + waves_y[:, None]
        return waves + self.waves_x[None, :] + self.remainder_m(y_m) * self.inverse_wavelength

    def remainder_m(self, y_m: Array) -> Float[Array, "y x"]:
        """The path less its parabola and its tilt, metres."""
        y, x = y_m[:, None], self.x_m[None, :]
        k = self.curvature
        q = k * (y * y + x * x) + 2 * (self.sines[0] * y + self.sines[1] * x)
        return -k * q * q / (2 * (1 + jnp.sqrt(1 + k * q)) ** 2)


class SeparableSource(NamedTuple):
    """A point source by a few numbers; all of them may be traced."""

    curvature: Real  # inverse of the chief ray's length, 1/m; 0 for a star
    sines: Real  # direction sines (y, x) of the chief ray
    waves_y: Real  # `[y]` wrapped parabola along y, waves
    waves_x: Real  # `[x]` the same along x
    waves_per_metre: Real  # waves of delay per metre of DOE height for this chief ray
    inverse_wavelength: Real  # waves per metre of path

    @classmethod
    def at(
        cls, camera: Camera, wavelength_m: float, depth_m: float, field_rad: tuple[float, float] = (0.0, 0.0)
    ) -> "SeparableSource":
        """A source at a depth (metres, `inf` allowed) and field angles (y, x) of the chief ray."""
        tangents = np.tan(np.asarray(field_rad, np.float64))
        curvature = 0.0 if np.isinf(depth_m) else 1 / (depth_m * np.sqrt(1 + np.sum(tangents**2)))
        bend = camera.curvature_per_m(curvature)
        waves_y, waves_x = (
            wrapped_waves(bend / 2 * camera.grid.axis_m(axis) ** 2, wavelength_m) for axis in ("y", "x")
        )
        sines = direction_sines(field_rad).astype(np.float32)
        per_metre = np.float32(camera.waves_per_metre(wavelength_m, field_rad))
        return cls(np.float32(curvature), sines, waves_y, waves_x, per_metre, np.float32(1 / wavelength_m))

    def over(self, grid: Grid) -> tuple[tuple[Array, Array], SeparableColumns]:
        """The same as of `SourceMap`."""
        y_m, x_m = (jnp.asarray(grid.axis_m(axis), jnp.float32) for axis in ("y", "x"))
        curvature, sines, waves_y, waves_x, *scales = (jnp.asarray(part) for part in self)
        return (y_m, waves_y), SeparableColumns(x_m, waves_x, curvature, sines, *scales)


class LitSource(eqx.Module):
    """A point source, and the amplitude `[y, x]` of the beam that lights a DOE beside that of its wave."""

    path: SourceMap | SeparableSource
    light: Complex[Array, "y x"]

    def over(self, grid: Grid) -> tuple[Any, Any]:
        """The same as of its path."""
        return self.path.over(grid)


class View(NamedTuple):
    """One wavelength and a range of depths, metres, from which a DOE looks like certain values of its cells."""

    wavelength_m: float
    nearest_m: float
    farthest_m: float

    @classmethod
    def several(cls, wavelength_m: float, depths_m: tuple[float, float], count: int) -> "list[View]":
        """Views from the nearest depth to the farthest, equally wide in obliquity, the farthest first."""
        nearest, farthest = depths_m
        with np.errstate(divide="ignore"):  # of infinity
            bounds = 1 / np.linspace(1 / farthest, 1 / nearest, count + 1)
        bounds[[0, -1]] = farthest, nearest
        return [cls(wavelength_m, float(near), float(far)) for far, near in itertools.pairwise(bounds)]


class ViewedSource(eqx.Module):
    """A point source, and by its number how a DOE looks from there (`sim.optic.ViewedOptic.views`).

    Besides, how many waves per metre of height its chief ray is delayed more than one on the axis; None on the axis.
    """

    path: SourceMap | SeparableSource | LitSource
    view: Int[Array, ""]
    more_waves_per_metre: Float[Array, ""] | None = None

    def over(self, grid: Grid) -> tuple[Any, Any]:
        """The same as of its path."""
        return self.path.over(grid)


def light_of(source: Any) -> Complex[Array, "y x"] | None:
    """Amplitude of the beam of a source, or None for a wave that is as bright everywhere."""
    path = source.path if isinstance(source, ViewedSource) else source
    return path.light if isinstance(path, LitSource) else None
