"""Sources by rows and columns: the same waves as the full map in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fab.grid import Grid
from sim.camera import Camera, Colour, source_path_m, wrapped_waves
from sim.propagation.pupil import PhaseRows, phase_pupil
from sim.source import SourceColumns, SourceRows, source_at, source_pupil

LINES = (656e-9, 486e-9)


def camera(defocus_m: float = 0.0) -> Camera:
    """The paper's aperture on a coarse grid."""
    colours = tuple(Colour(f"c{k}", (line,), (1.0,)) for k, line in enumerate(LINES))
    return Camera(Grid((96, 96), 4.44e-3 / 96), 4.4e-3, "fused_silica", colours, 8e-3, 3.7e-6, 65, 1.0, defocus_m)


@pytest.mark.parametrize("depth_m", [0.05, 0.12, 5.0, np.inf])
@pytest.mark.parametrize("field_rad", [(0.0, 0.0), (0.2, -0.1)])
@pytest.mark.parametrize("defocus_m", [0.0, 20e-6])
def test_the_field_is_that_of_the_whole_map(depth_m: float, field_rad: tuple[float, float], defocus_m: float) -> None:
    optics = camera(defocus_m)
    height = jnp.asarray(np.random.default_rng(0).random((96, 96), np.float32) * 1e-6)
    coverage = jnp.ones((96, 96))
    source = source_at(optics, LINES, depth_m, field_rad)
    y_m, x_m = (jnp.asarray(optics.grid.axis_m(axis), jnp.float32) for axis in ("y", "x"))
    path = source_path_m(optics, depth_m, field_rad)
    for k, line in enumerate(LINES):
        waves = jnp.asarray(wrapped_waves(path, line))
        wanted = phase_pupil(PhaseRows(height, waves, coverage), jnp.float32(optics.waves_per_metre(line, field_rad)))
        columns = SourceColumns(
            x_m,
            jnp.asarray(source.waves_x[k]),
            jnp.asarray(source.curvature),
            jnp.asarray(source.sines),
            jnp.asarray(source.rates[k]),
            jnp.asarray(source.inverse_wavelengths[k]),
        )
        found = jax.jit(source_pupil)(SourceRows(height, coverage, y_m, jnp.asarray(source.waves_y[k])), columns)
        # The remainder is up to ten waves off the axis, in single precision: 1e-6 waves each, and cis has 4e-6.
        np.testing.assert_allclose(found, wanted, atol=5e-5)


def test_what_remains_is_small_and_what_is_taken_off_is_not() -> None:
    optics = camera()
    path = source_path_m(optics, 0.05)
    y, x = (optics.grid.axis_m(axis) for axis in ("y", "x"))
    parabola = (y[:, None] ** 2 + x[None, :] ** 2) / (2 * 0.05)
    assert np.ptp(path) / LINES[0] > 100
    assert np.abs(path - parabola).max() / LINES[0] < 0.2


def test_errors_of_a_plate_multiply_its_transmission() -> None:
    optics = camera()
    source = source_at(optics, LINES, 0.08)
    ones = jnp.ones((96, 96))
    y_m, x_m = (jnp.asarray(optics.grid.axis_m(axis), jnp.float32) for axis in ("y", "x"))
    columns = SourceColumns(
        x_m,
        jnp.asarray(source.waves_x[0]),
        jnp.asarray(source.curvature),
        jnp.asarray(source.sines),
        jnp.asarray(source.rates[0]),
        jnp.asarray(source.inverse_wavelengths[0]),
    )
    rows = SourceRows(0 * ones, ones, y_m, jnp.asarray(source.waves_y[0]))
    factor = 0.5 * jnp.exp(1j * ones)
    with_errors = jax.jit(source_pupil)(rows._replace(errors=factor), columns)
    np.testing.assert_allclose(with_errors, factor * jax.jit(source_pupil)(rows, columns), atol=1e-6)
