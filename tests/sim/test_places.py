"""Where pixels lie among the directions of light, by hand."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from bench.reference import make_camera
from sim.propagation.places import CUBIC, cubic_places, largest_reach, window_places

CAMERA = make_camera(64, 0.2e-3, 1e-3, 4e-6, 40)
SAMPLE_M = 0.5e-6
# Every term of a cubic displacement, of y and x in half windows.
TERMS = (
    lambda y, x: 1.0,
    lambda y, x: y,
    lambda y, x: x,
    lambda y, x: y * y,
    lambda y, x: y * x,
    lambda y, x: x * x,
    lambda y, x: y * y * y,
    lambda y, x: y * y * x,
    lambda y, x: y * x * x,
    lambda y, x: x * x * x,
)


def test_pixels_of_a_sine_lens_lie_evenly():
    # Eight samples of half a micrometre to a pixel of four.
    assert window_places(CAMERA, SAMPLE_M, (0.2, -0.1))(3.0, -5.5) == pytest.approx((24.0, -44.0))


@pytest.mark.parametrize("field_rad", [(0.0, 0.0), (0.2, -0.1)])
def test_pixels_of_a_tangent_lens_lie_at_the_sines_of_their_angles(field_rad: tuple[float, float]):
    camera = replace(CAMERA, mapping="tangent")
    row, column = window_places(camera, SAMPLE_M, field_rad)(np.array([7.0, -20.0]), np.array([-3.0, 12.5]))
    chief = np.tan(field_rad)
    at = chief[:, None] + np.array([[7.0, -20.0], [-3.0, 12.5]]) * 4e-6 / 1e-3
    sines = at / np.sqrt(1 + np.sum(at**2, axis=0)) - (chief / np.sqrt(1 + np.sum(chief**2)))[:, None]
    np.testing.assert_allclose([row, column], sines * 1e-3 / SAMPLE_M, rtol=1e-9)


@pytest.mark.parametrize("term", range(len(TERMS)))
def test_each_term_of_a_displacement_is_what_it_says(term: int):
    assert len(CUBIC) == len(TERMS)
    displacement = np.zeros((2, len(TERMS)))
    displacement[:, term] = 3e-6, -2e-6
    places = cubic_places(window_places(CAMERA, SAMPLE_M), CAMERA, jnp.asarray(displacement))
    row, column = np.array([-14.0, 3.0, 20.0]), np.array([5.0, -11.0, 8.0])
    # A window of 40 pixels has half windows of 20.
    value = TERMS[term](row / 20, column / 20)
    # Single precision of places up to 160.
    np.testing.assert_allclose(places(row, column)[0], row * 8 + value * 6, atol=3e-5)
    np.testing.assert_allclose(places(row, column)[1], column * 8 - value * 4, atol=3e-5)


def test_a_turned_sensor_turns_its_pixels():
    """By a small angle from +x toward +y, about its middle: (a x, -a y) half windows of 80 um."""
    angle, displacement = 1e-3, np.zeros((2, len(CUBIC)))
    displacement[0, CUBIC.index((0, 1))], displacement[1, CUBIC.index((1, 0))] = angle * 80e-6, -angle * 80e-6
    y, x = map(float, cubic_places(window_places(CAMERA, SAMPLE_M), CAMERA, jnp.asarray(displacement))(6.0, 17.0))
    turn = np.arctan2(y, x) - np.arctan2(6.0, 17.0)
    # Places in single precision; the square of the angle.
    assert turn == pytest.approx(angle, rel=1e-3)
    assert np.hypot(y, x) == pytest.approx(8 * np.hypot(6.0, 17.0), rel=2e-6)


@pytest.mark.parametrize("toward", [(1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)])
@pytest.mark.parametrize("window", [40, 41])
def test_a_window_reaches_as_far_as_its_farthest_corner(window: int, toward: tuple[float, float]):
    """Of a map that stretches one of its four corners."""

    def places(row: Any, column: Any) -> tuple[Any, Any]:
        far = (row * toward[0] + window / 2) * (column * toward[1] + window / 2) / window**2
        return row * (2 + far), column * 2

    assert largest_reach(places, window) == pytest.approx(window / 2 * 3, rel=1e-12)
    assert largest_reach(lambda row, column: (row, 4 * column), window) == pytest.approx(2 * window, rel=1e-12)
