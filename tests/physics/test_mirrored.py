"""Layers with a mirror: a plate's closed form, another library's orders, and finite differences."""

import numpy as np
import pytest

from fab.errors import InputError
from sim.rigorous import MirroredLayer
from sim.rigorous.crossed import layered_orders

PIXELS, PERIOD_M, WAVELENGTH_M, GLASS, DEPTH_M = 60, 2.4e-6, 632.8e-9, 1.46, 0.7e-6


def relief(seed: int = 0) -> np.ndarray:
    """Blobs of glass in air, alike to the left and to the right."""
    place = np.fft.fftfreq(PIXELS, 1 / PIXELS)
    kernel = np.exp(-(place[:, None] ** 2 + place**2) / 32)
    noise = np.fft.ifft2(np.fft.fft2(np.random.default_rng(seed).normal(size=(PIXELS, PIXELS))) * kernel).real
    return np.where(noise + np.roll(noise[:, ::-1], 1, 1) > 0, GLASS**2, 1.0)


def layer(terms: int, along_x: bool = False) -> MirroredLayer:
    return MirroredLayer(PIXELS, PERIOD_M, WAVELENGTH_M, (GLASS, 1.0), terms, along_x)


NO_WALLS = np.zeros((3, PIXELS, PIXELS))


@pytest.mark.parametrize("index", [1.0, 1.2, 1.46, 2.0])
def test_a_plate_has_the_closed_form_of_two_faces(index: float):
    found = layer(40).solve(np.full((PIXELS, PIXELS), index**2), DEPTH_M, NO_WALLS, 1)
    first, second = (GLASS - index) / (GLASS + index), (index - 1) / (index + 1)
    turn = np.exp(2j * np.pi * index * DEPTH_M / WAVELENGTH_M)
    amplitude = (1 + first) * (1 + second) * turn / (1 + first * second * turn**2)
    wanted = np.zeros((3, 3))
    wanted[1, 1] = abs(amplitude) ** 2 / GLASS
    # Single precision.
    assert found.orders == pytest.approx(wanted, abs=1e-5)
    assert found.transmitted == pytest.approx(wanted.sum(), abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("along_x", [False, True])
def test_orders_are_those_of_another_library(along_x: bool):
    fmmax = pytest.importorskip("fmmax")
    permittivity, own = relief(), layer(100, along_x)
    walls = own.products_of_directions(permittivity)
    layers = [np.array([[GLASS**2]]), permittivity, np.array([[1.0]])]
    # Without directions the equations are the same: single precision is left. With them the imaginary part of their
    # products, which fmmax has and this has not, counts in second order.
    for name, given, tolerance in (("FFT", NO_WALLS, 5e-6), ("JONES_DIRECT_FOURIER", walls, 1e-3)):
        formulation = getattr(fmmax.Formulation, name)
        wanted = layered_orders(layers, [0, DEPTH_M, 0], (PERIOD_M, PERIOD_M), WAVELENGTH_M, 100, formulation)
        found = own.solve(permittivity, DEPTH_M, given, 2)
        assert found.orders == pytest.approx(wanted.within(2, 2)[int(not along_x)], abs=tolerance)
        assert found.transmitted == pytest.approx(wanted.transmitted[int(not along_x)].sum(), abs=tolerance)


@pytest.mark.slow
def test_directions_are_those_of_another_library():
    fmmax = pytest.importorskip("fmmax")
    import jax
    import jax.numpy as jnp

    permittivity = relief()
    with jax.enable_x64(True):
        lattice = fmmax.LatticeVectors(u=jnp.array([1.0, 0.0]), v=jnp.array([0.0, 1.0]))
        expansion = fmmax.generate_expansion(lattice, 100, fmmax.Truncation.CIRCULAR)
        scheme = fmmax.vector.VECTOR_FIELD_SCHEMES["jones_direct_fourier"]
        x, y = (np.asarray(each).T for each in scheme(jnp.asarray(permittivity.T), expansion, lattice))
    wanted = np.stack([abs(x) ** 2, abs(y) ** 2, np.real(np.conj(x) * y)]) / (abs(x) ** 2 + abs(y) ** 2)
    # Its phases of half a pixel are single precision.
    assert layer(100).products_of_directions(permittivity) == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize("along_x", [False, True])
def test_the_gradient_is_that_of_finite_differences(along_x: bool):
    permittivity, own = relief(), layer(60, along_x)
    walls, rng = own.products_of_directions(permittivity), np.random.default_rng(1)
    weights = rng.normal(size=(5, 5))
    found, (none, slopes) = own.gradients(permittivity, DEPTH_M, walls, 2, lambda _: np.stack([0 * weights, weights]))
    assert none.depth == 0
    assert np.all(none.permittivity == 0)

    def number(change: float, deeper_m: float) -> float:
        orders = own.solve(permittivity + change * direction, DEPTH_M + deeper_m, walls, 2).orders
        return float((weights * orders).sum())

    direction = rng.normal(size=permittivity.shape)
    direction = direction + np.roll(direction[:, ::-1], 1, 1)
    assert number(0, 0) == pytest.approx((weights * found.orders).sum(), abs=1e-6)
    # Single precision over the step, and the step squared.
    wanted = (number(1e-2, 0) - number(-1e-2, 0)) / 2e-2
    assert (slopes.permittivity * direction).sum() == pytest.approx(wanted, rel=5e-3, abs=1e-3)
    wanted = (number(0, 1e-9) - number(0, -1e-9)) / 2e-9
    assert slopes.depth == pytest.approx(wanted, rel=5e-3, abs=5e3)


@pytest.mark.parametrize("permittivity", [np.arange(3600.0).reshape(60, 60) + 1, -relief()])
def test_other_layers_are_refused(permittivity: np.ndarray):
    with pytest.raises(InputError, match="mirror"):
        layer(20).solve(permittivity, DEPTH_M, NO_WALLS, 1)


@pytest.mark.slow
def test_orders_near_the_limits_are_as_right_as_is_said():
    """100 terms grow by a factor of e^7 over 0.7 um, and light turns by 10 rad."""
    fmmax = pytest.importorskip("fmmax")
    permittivity, depth_m = relief(), 1.96 * DEPTH_M
    layers = [np.array([[GLASS**2]]), permittivity, np.array([[1.0]])]
    wanted = layered_orders(layers, [0, depth_m, 0], (PERIOD_M, PERIOD_M), WAVELENGTH_M, 100, fmmax.Formulation.FFT)
    found = layer(100).solve(permittivity, depth_m, NO_WALLS, 2)
    assert found.orders == pytest.approx(wanted.within(2, 2)[1], abs=1e-4)
    assert found.transmitted == pytest.approx(wanted.transmitted[1].sum(), abs=1e-4)


def test_layers_too_deep_for_single_precision_are_refused():
    for own, permittivity, depth_m in (
        (layer(100), relief(), 2.1 * DEPTH_M),
        (layer(6), np.full((PIXELS, PIXELS), 4.0), 1.6e-6),  # 32 rad
        (layer(6), relief(), np.nan),
        (layer(6), relief(), -1e-7),
    ):
        with pytest.raises(InputError, match=r"depth_m: .*single precision"):
            own.solve(permittivity, depth_m, NO_WALLS, 1)
    layer(6).gradients(relief(), DEPTH_M, NO_WALLS, 1, lambda orders: orders[None])
    own = layer(100)
    own.solve(relief(), 1.5 * DEPTH_M, NO_WALLS, 2)
    with pytest.raises(InputError, match=r"depth_m: .*single precision"):
        own.gradients(relief(), 1.5 * DEPTH_M, NO_WALLS, 2, lambda orders: orders[None])


def test_the_gradient_by_the_depth_is_right_to_its_limit():
    permittivity, own, depth_m = relief(), layer(100), 1.33 * DEPTH_M
    weights = np.random.default_rng(1).normal(size=(6, 5, 5))
    _, found = own.gradients(permittivity, depth_m, NO_WALLS, 2, lambda _: weights)
    ends = [own.solve(permittivity, depth_m + step_m, NO_WALLS, 2).orders for step_m in (4e-9, -4e-9)]
    wanted = ((ends[0] - ends[1]) / 8e-9 * weights).sum((1, 2))
    assert np.linalg.norm([one.depth for one in found] - wanted) < 0.05 * np.linalg.norm(wanted)


def test_orders_at_grazing_and_rasters_too_coarse_are_refused():
    with pytest.raises(InputError, match=r"period_m: .*grazing"):
        MirroredLayer(PIXELS, 4 * WAVELENGTH_M, WAVELENGTH_M, (GLASS, 1.0), 100)
    with pytest.raises(InputError, match=r"pixels: .*20"):
        MirroredLayer(20, PERIOD_M, WAVELENGTH_M, (GLASS, 1.0), 100)
    MirroredLayer(21, 4.001 * WAVELENGTH_M, WAVELENGTH_M, (GLASS, 1.0), 100)


def test_layers_of_another_size_are_refused():
    with pytest.raises(InputError, match="60 x 60"):
        layer(20).solve(np.ones((10, 10)), DEPTH_M, np.zeros((3, 10, 10)), 1)
