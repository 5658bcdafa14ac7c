"""Parameters to heights: what is optimised must be what is drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from doedesign.design.parametrize import LevelParametrization, softness_at
from fab.levels import Levels, height_of, quantise

SIXTEEN = LevelParametrization.at("fused_silica", 550e-9, Levels(16, 75e-9))


def test_one_radian_is_a_wave_over_two_pi() -> None:
    # 1195.9 nm delay one wave at 550 nm in fused silica (Malitson); 0.1 nm is the rounding of that figure.
    assert SIXTEEN.metres_per_radian * 2 * np.pi == pytest.approx(1195.9e-9, abs=0.1e-9)


@given(st.floats(-200, 200, width=32))
def test_heights_are_levels_of_the_process(radians: float) -> None:
    height = float(SIXTEEN.height_m(jnp.float32(radians), jnp.float32(0.0)))
    # float32 heights: one part in 1e6 of a step is several of its roundings.
    assert height / 75e-9 == pytest.approx(round(height / 75e-9), abs=1e-5)
    assert 0 <= height < 15.5 * 75e-9


def test_quantised_height_is_what_the_masks_would_round_to() -> None:
    radians = jnp.linspace(-10, 10, 4002).reshape(2, -1)
    continuous = SIXTEEN.continuous_m(radians)
    wrapped = np.asarray(jnp.where(continuous > 15.5 * 75e-9, continuous - 1200e-9, continuous))
    expected = height_of(quantise(np.maximum(wrapped, 0), SIXTEEN.levels), SIXTEEN.levels)
    drawn = np.asarray(SIXTEEN.height_m(radians, jnp.float32(0.0)))
    # Ties may round either way in float32; nothing else may differ.
    near_tie = np.abs(np.mod(np.asarray(continuous) / 75e-9, 1.0) - 0.5) < 1e-4
    np.testing.assert_allclose(drawn[~near_tie], expected[~near_tie], atol=1e-12)


def test_straight_through_passes_the_continuous_gradient() -> None:
    slope = jax.grad(lambda r: SIXTEEN.height_m(r, jnp.float32(0.0)))(jnp.float32(1.234))
    assert float(slope) == pytest.approx(SIXTEEN.metres_per_radian, rel=1e-6)


def test_annealing_blends_from_continuous_to_drawn() -> None:
    radians = jnp.linspace(0, 6, 101)
    heights = [SIXTEEN.height_m(radians, jnp.float32(s)) for s in (1.0, 0.5, 0.0)]
    np.testing.assert_allclose(heights[0], SIXTEEN.continuous_m(radians), rtol=1e-6)
    np.testing.assert_allclose(heights[1], (heights[0] + heights[2]) / 2, atol=1e-12)
    assert softness_at("annealed", 0, 100) == 1.0
    assert softness_at("annealed", 50, 100) == 0.5**3  # half of the way from a tenth to nine tenths of the steps
    assert softness_at("annealed", 90, 100) == 0.0
    assert softness_at("straight_through", 0, 100) == 0.0
    assert softness_at("none", 99, 100) == 1.0


def test_radians_of_inverts_the_height() -> None:
    heights = np.arange(16) * 75e-9
    np.testing.assert_allclose(SIXTEEN.continuous_m(jnp.asarray(SIXTEEN.radians_of(heights))), heights, atol=1e-13)
