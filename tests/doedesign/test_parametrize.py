"""Parameters to heights: what is optimised must be what is drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from doedesign.design.levels.parametrize import LevelParametrization
from doedesign.design.levels.quantisation import Rounding, rounding_at
from fab.levels import Levels, height_of, quantise

SIXTEEN = LevelParametrization.at("fused_silica", 550e-9, Levels(16, 75e-9))


def test_one_radian_is_a_wave_over_two_pi() -> None:
    # 1195.9 nm delay one wave at 550 nm in fused silica (Malitson); 0.1 nm is the rounding of that figure.
    assert SIXTEEN.metres_per_radian * 2 * np.pi == pytest.approx(1195.9e-9, abs=0.1e-9)


@given(st.floats(-200, 200, width=32))
def test_heights_are_levels_of_the_process(radians: float) -> None:
    height = float(SIXTEEN.height_m(jnp.float32(radians), Rounding(jnp.float32(0.0))))
    # float32 heights: one part in 1e6 of a step is several of its roundings.
    assert height / 75e-9 == pytest.approx(round(height / 75e-9), abs=1e-5)
    assert 0 <= height < 15.5 * 75e-9


def test_quantised_height_is_what_the_masks_would_round_to() -> None:
    radians = jnp.linspace(-10, 10, 4002).reshape(2, -1)
    continuous = SIXTEEN.continuous_m(radians)
    wrapped = np.asarray(jnp.where(continuous > 15.5 * 75e-9, continuous - 1200e-9, continuous))
    expected = height_of(quantise(np.maximum(wrapped, 0), SIXTEEN.levels), SIXTEEN.levels)
    drawn = np.asarray(SIXTEEN.height_m(radians, Rounding(jnp.float32(0.0))))
    # Ties may round either way in float32; nothing else may differ.
    near_tie = np.abs(np.mod(np.asarray(continuous) / 75e-9, 1.0) - 0.5) < 1e-4
    np.testing.assert_allclose(drawn[~near_tie], expected[~near_tie], atol=1e-12)


def test_straight_through_passes_the_continuous_gradient() -> None:
    slope = jax.grad(lambda r: SIXTEEN.height_m(r, Rounding(jnp.float32(0.0))))(jnp.float32(1.234))
    assert float(slope) == pytest.approx(SIXTEEN.metres_per_radian, rel=1e-6)


def test_annealing_blends_from_continuous_to_drawn() -> None:
    radians = jnp.linspace(0, 6, 101)
    heights = [SIXTEEN.height_m(radians, Rounding(jnp.float32(s))) for s in (1.0, 0.5, 0.0)]
    np.testing.assert_allclose(heights[0], SIXTEEN.continuous_m(radians), rtol=1e-6)
    np.testing.assert_allclose(heights[1], (heights[0] + heights[2]) / 2, atol=1e-12)
    softness = {
        ("annealed", 0): 1.0,
        ("annealed", 50): 0.5**3,  # half of the way from a tenth to nine tenths of the steps
        ("annealed", 90): 0.0,
        ("straight_through", 0): 0.0,
        ("none", 99): 1.0,
        ("at_end", 99): 1.0,
    }
    for (strategy, step), due in softness.items():
        assert rounding_at(strategy, 0, step, 100) == (pytest.approx(due, rel=1e-6), None)


def heights_at(quantisation: str, radians: jax.Array, step: int, seed: int = 0) -> jax.Array:
    staircase = LevelParametrization.at("fused_silica", 550e-9, Levels(16, 75e-9), quantisation)
    return staircase.height_m(radians, rounding_at(quantisation, seed, step, 100))


def test_stochastic_rounding_is_right_in_the_mean() -> None:
    """Every height is one of the two levels beside it, and the last one is beside level 0 of the next wave."""
    radians = jnp.asarray(SIXTEEN.radians_of(np.array([3.3, 15.6]) * 75e-9))[:, None] * jnp.ones(20_000)
    low, high = np.round(np.asarray(heights_at("stochastic", radians, 4)) / 75e-9).astype(int)
    assert (set(low), set(high)) == ({3, 4}, {15, 0})
    # Four standard deviations of the mean of 20 000 draws, sqrt(0.3 x 0.7 / 20 000) = 0.0032 each.
    assert low.mean() == pytest.approx(3.3, abs=0.013)
    assert (high == 0).mean() == pytest.approx(0.6, abs=0.014)
    assert float(jax.grad(lambda r: heights_at("stochastic", r, 4))(jnp.float32(1.0))) == pytest.approx(
        SIXTEEN.metres_per_radian, rel=1e-6
    )


def test_gumbel_begins_between_levels_and_ends_on_them() -> None:
    radians = jnp.linspace(0, 12, 4001)
    first, last = (np.mod(np.asarray(heights_at("gumbel", radians, step)) / 75e-9, 16) for step in (0, 99))
    off = [np.abs(level - np.round(level)) for level in (first, last)]
    assert off[0].mean() > 0.1
    assert np.quantile(off[1], 0.9) < 0.02
    nearest = np.asarray(SIXTEEN.level(SIXTEEN.continuous_m(radians)))
    # The nearest level is taken in most cells, and a neighbour in the others.
    away = np.mod(np.round(last) - nearest + 8, 16) - 8
    assert (away == 0).mean() > 0.75
    assert np.abs(away).max() <= 1


def test_gumbel_has_the_gradient_of_its_blend() -> None:
    radians = jnp.linspace(0.1, 6, 37)
    slope = jax.vmap(jax.grad(lambda r: heights_at("gumbel", r, 40)))(radians)
    step = 1e-3
    up, down = (jax.vmap(lambda r: heights_at("gumbel", r, 40))(radians + d) for d in (step, -step))
    found = np.asarray(up - down, np.float64) / (2 * step)
    smooth = np.abs(found) < 5 * np.abs(found).mean()  # no wrap, and no change of the four levels, between the two
    np.testing.assert_allclose(np.asarray(slope)[smooth], found[smooth], rtol=0.05, atol=0.02 * np.abs(found).mean())


def test_chance_follows_from_seed_and_step() -> None:
    radians = jnp.linspace(0, 6, 500)
    for strategy in ("stochastic", "gumbel"):
        one = heights_at(strategy, radians, 40)
        np.testing.assert_array_equal(one, heights_at(strategy, radians, 40))
        assert not np.array_equal(one, heights_at(strategy, radians, 41))
        assert not np.array_equal(one, heights_at(strategy, radians, 40, seed=1))


def test_radians_of_inverts_the_height() -> None:
    heights = np.arange(16) * 75e-9
    np.testing.assert_allclose(SIXTEEN.continuous_m(jnp.asarray(SIXTEEN.radians_of(heights))), heights, atol=1e-13)
