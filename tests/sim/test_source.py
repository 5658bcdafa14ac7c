"""Sources by rows and columns: the same waves as the full map in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fab.grid import Grid
from sim.camera import Camera, Colour
from sim.optic import HeightOptic
from sim.propagation.pupil import doe_field
from sim.source import SeparableSource, SourceMap, source_path_m

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
    doe = HeightOptic.of(optics, np.random.default_rng(0).random((96, 96), np.float32) * 1e-6)
    for line in optics.lines:
        found, wanted = (
            jax.jit(doe_field)(*doe.rows(line, kind.at(optics, line.wavelength_m, depth_m, field_rad)))
            for kind in (SeparableSource, SourceMap)
        )
        # The remainder is up to ten waves off the axis, in single precision: 1e-6 waves each, and cis has 4e-6.
        np.testing.assert_allclose(found, wanted, atol=5e-5)


def test_what_remains_is_small_and_what_is_taken_off_is_not() -> None:
    optics = camera()
    path = source_path_m(optics, 0.05)
    y, x = (optics.grid.axis_m(axis) for axis in ("y", "x"))
    parabola = (y[:, None] ** 2 + x[None, :] ** 2) / (2 * 0.05)
    assert np.ptp(path) / LINES[0] > 100
    assert np.abs(path - parabola).max() / LINES[0] < 0.2


def test_deviations_of_a_doe_multiply_its_transmission() -> None:
    optics = camera()
    line = optics.lines[0]
    source = SeparableSource.at(optics, line.wavelength_m, 0.08)
    ones = jnp.ones((96, 96))
    factor = 0.5 * jnp.exp(1j * ones)
    both = {line.wavelength_m: factor} | {other.wavelength_m: ones + 0j for other in optics.lines[1:]}
    plain, deviating = HeightOptic(optics, ones, 0 * ones), HeightOptic(optics, ones, 0 * ones, both)
    found, wanted = (jax.jit(doe_field)(*doe.rows(line, source)) for doe in (deviating, plain))
    np.testing.assert_allclose(found, factor * wanted, atol=1e-6)
