"""A point source at any depth and field angle, described by a few numbers and two rows of phase.

The path from a source to the cells of a plate (`sim.camera.path_at_m`) is a hundred waves from side to side, so it is
wrapped in double precision. All of that but a few waves is a parabola, and a parabola is a sum over y and x: it is
wrapped per axis, in double precision, on the host. What remains, for a chief ray of curvature k = 1 / c and direction
sines s, is

    -k q² / (2 (1 + sqrt(1 + k q))²),    q = k r² + 2 s·r,

free of cancellation and small enough for single precision. So a source may be traced: one compiled step serves every
depth.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from sim.camera import Camera, direction_sines, wrapped_waves
from sim.propagation.pupil import cis


class Source(NamedTuple):
    """A point source, for every line (wavelength) of a camera.

    Attributes:
        curvature: inverse of the chief ray's length, 1/m; 0 for a star.
        sines: direction sines (y, x) of the chief ray.
        waves_y: `[line, y]` wrapped parabola along y, waves.
        waves_x: `[line, x]` the same along x.
        rates: `[line]` waves per metre of DOE height for this chief ray.
        inverse_wavelengths: `[line]` waves per metre of path.
    """

    curvature: Float[Array, ""] | np.float32
    sines: Float[Array, "2"] | Float[np.ndarray, "2"]
    waves_y: Float[Array, "line y"] | Float[np.ndarray, "line y"]
    waves_x: Float[Array, "line x"] | Float[np.ndarray, "line x"]
    rates: Float[Array, " line"] | Float[np.ndarray, " line"]
    inverse_wavelengths: Float[Array, " line"] | Float[np.ndarray, " line"]


def source_at(
    camera: Camera, wavelengths_m: tuple[float, ...], depth_m: float, field_rad: tuple[float, float] = (0.0, 0.0)
) -> Source:
    """Describe a source.

    Args:
        camera: lens and grid.
        wavelengths_m: vacuum wavelength of every line.
        depth_m: axial distance of the source from the DOE; `inf` for a star.
        field_rad: field angles (y, x) of the chief ray (`sim.camera.direction_sines`).
    """
    tangents = np.tan(np.asarray(field_rad, np.float64))
    curvature = 0.0 if np.isinf(depth_m) else 1 / (depth_m * np.sqrt(1 + np.sum(tangents**2)))
    bend = curvature + 1 / camera.sensor_distance_m - 1 / camera.focal_length_m
    rows = [
        np.stack([wrapped_waves(bend / 2 * camera.grid.axis_m(axis) ** 2, line) for line in wavelengths_m])
        for axis in ("y", "x")
    ]
    rates = np.array([camera.waves_per_metre(line, field_rad) for line in wavelengths_m], np.float32)
    sines = direction_sines(field_rad).astype(np.float32)
    inverse = np.array([1 / line for line in wavelengths_m], np.float32)
    return Source(np.float32(curvature), sines, rows[0], rows[1], rates, inverse)


class SourceRows(NamedTuple):
    """Row-wise description of a phase-only pupil and where it lies.

    Attributes:
        height_m: `[y, x]` DOE height, metres.
        coverage: `[y, x]` open share of each cell.
        y_m: `[y]` position of the rows.
        waves_y: `[y]` see `Source`, of one line.
        errors: `[y, x]` factor of the transmission beside what the height does, if there is one.
    """

    height_m: Float[Array, "y x"]
    coverage: Float[Array, "y x"]
    y_m: Float[Array, " y"]
    waves_y: Float[Array, " y"]
    errors: Complex[Array, "y x"] | None = None


class SourceColumns(NamedTuple):
    """What all rows share.

    Attributes:
        x_m: `[x]` position of the columns.
        waves_x: `[x]` see `Source`, of one line.
        curvature: see `Source`.
        sines: see `Source`.
        rate: waves per metre of height.
        inverse_wavelength: waves per metre of path.
    """

    x_m: Float[Array, " x"]
    waves_x: Float[Array, " x"]
    curvature: Float[Array, ""]
    sines: Float[Array, "2"]
    rate: Float[Array, ""]
    inverse_wavelength: Float[Array, ""]


def remainder_m(rows_y_m: Array, columns: SourceColumns) -> Float[Array, "y x"]:
    """The path less its parabola and its tilt, metres."""
    y, x = rows_y_m[:, None], columns.x_m[None, :]
    k = columns.curvature
    q = k * (y * y + x * x) + 2 * (columns.sines[0] * y + columns.sines[1] * x)
    return -k * q * q / (2 * (1 + jnp.sqrt(1 + k * q)) ** 2)


def source_pupil(rows: SourceRows, columns: SourceColumns) -> Complex[Array, "y x"]:
    """Field coverage * exp(2 pi i (height * rate + source)) of rows (`sim.propagation.pupil.phase_pupil`)."""
    waves = rows.height_m * columns.rate + rows.waves_y[:, None] + columns.waves_x[None, :]
    waves = waves + remainder_m(rows.y_m, columns) * columns.inverse_wavelength
    field = rows.coverage * cis(waves)
    return field if rows.errors is None else field * rows.errors
