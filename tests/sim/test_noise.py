"""Noise: distributions against closed forms, and gradients that pass through a draw."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from sim.sensor import noise
from sim.sensor.noise import clipped, photon_noise, poisson, rounded, uniform_noise

DRAWS = 1 << 20


def draws(mean: float, seed: int = 0) -> np.ndarray:
    counts = jax.jit(poisson)(jax.random.key(seed), jnp.full(DRAWS, mean, jnp.float32))
    return np.asarray(counts, np.float64)


@pytest.mark.parametrize("mean", [1e-3, 0.1, 1.0, 7.9, 8.0, 30.0, 1e3, 1e5, 4e6])
def test_mean_and_variance_of_counts(mean: float):
    mean = float(np.float32(mean))
    counts = draws(mean, seed=int(mean))
    # Five standard errors of the mean and of the variance, whose own variance is var^2 (2 + 1 / mean) / draws.
    assert abs(counts.mean() - mean) < 5 * np.sqrt(mean / DRAWS)
    assert abs(counts.var() - mean) < 5 * mean * np.sqrt((2 + 1 / mean) / DRAWS)
    assert np.all(counts == np.round(counts))
    assert counts.min() >= 0


@pytest.mark.parametrize("mean", [0.3, 5.0, 8.0, 20.0])
def test_counts_are_poisson(mean: float):
    """Chi-square over all counts expected at least ten times."""
    seen = np.bincount(draws(mean, seed=3).astype(int), minlength=100)
    expected = DRAWS * stats.poisson.pmf(np.arange(len(seen)), mean)
    often = expected > 10
    observed = np.append(seen[often], seen[~often].sum())
    wanted = np.append(expected[often], DRAWS - expected[often].sum())
    chi = np.sum((observed - wanted) ** 2 / np.maximum(wanted, 1))
    assert chi < stats.chi2.isf(1e-5, often.sum())


@pytest.mark.parametrize(("mean", "most"), [(8.0, 7.2e-5), (10.0, 3.9e-5), (16.0, 1.2e-5), (50.0, 5e-6)])
def test_distance_of_the_expansion_to_poisson(mean: float, most: float):
    """Total variation, from the normal quantiles at which the rounded-down expansion steps."""
    w = np.linspace(-5.5, 5.5, 4_000_001)
    with jax.enable_x64(True):
        counts = np.asarray(noise._expanded(jnp.full(w.shape, mean, jnp.float64), jnp.asarray(w, jnp.float64)))
    edges = special.ndtr((w[1:] + w[:-1]) / 2)
    weights = np.diff(np.concatenate([[0.0], edges, [1.0]]))
    share = np.bincount(counts.astype(int), weights)
    distance = 0.5 * np.abs(share - stats.poisson.pmf(np.arange(len(share)), mean)).sum()
    # Each step is found to 1.4e-6 in w, which moves 5e-7 of the probability; of fifty, that is most of 5e-6.
    assert distance < most


def test_no_light_no_photons_and_the_same_seed_the_same_counts():
    assert not np.any(draws(0.0))
    assert not np.any(np.asarray(poisson(jax.random.key(0), jnp.asarray([-1.0, -1e-7]))))
    assert np.array_equal(draws(20.0, seed=5), draws(20.0, seed=5))
    assert not np.array_equal(draws(20.0, seed=5), draws(20.0, seed=6))


@pytest.mark.parametrize(("signal", "sigma", "scale"), [(500.0, 3.0, 1.0), (0.5, 1e-5, 4e-5), (0.0, 2.0, 1.0)])
def test_shot_and_read_noise_add_up(signal: float, sigma: float, scale: float):
    drawn = photon_noise(jax.random.key(1), jnp.full(DRAWS, signal), sigma, scale=scale)
    drawn = np.asarray(drawn, np.float64)
    variance = scale * signal + sigma**2
    assert abs(drawn.mean() - signal) < 5 * np.sqrt(variance / DRAWS)
    assert drawn.var() == pytest.approx(variance, rel=0.01)  # five standard errors of 0.14 %, and then some


def test_uniform_noise():
    drawn = np.asarray(uniform_noise(jax.random.key(2), jnp.full(DRAWS, 0.5), 0.008))
    assert np.abs(drawn - 0.5).max() <= 0.008 * (1 + 1e-5)  # rounding of numbers near 0.5
    assert drawn.std() == pytest.approx(0.008 / np.sqrt(3), rel=0.01)


@pytest.mark.parametrize("scale", [1.0, 4e-5])
def test_gradient_is_that_of_the_fixed_standardised_draw(scale: float):
    """d/dx (x + sqrt(v(x)) z) by finite differences with the draw's own z; `scale` is the light of one count."""
    signal, key, sigma = scale * jnp.asarray([0.5, 4.0, 30.0, 2000.0, 3e4]), jax.random.key(4), 2.0 * scale
    weights = jnp.asarray([0.3, -1.0, 2.0, 0.7, -0.2])
    noisy = partial(photon_noise, key, sigma=sigma, scale=scale)
    found = jax.grad(lambda x: jnp.sum(weights * noisy(x)))(signal)
    x = np.asarray(signal, np.float64)
    z = (np.asarray(noisy(signal), np.float64) - x) / np.sqrt(scale * x + sigma**2)
    steps = 1e-4 * x
    up, down = (x + s + np.sqrt(scale * (x + s) + sigma**2) * z for s in (steps, -steps))
    # Errors: 1e-8 of the differences, 1e-7 of single precision and of the rounding of the draw over its deviation.
    assert np.asarray(found) == pytest.approx(np.asarray(weights) * (up - down) / (2 * steps), rel=1e-4)


def test_gradient_is_the_slope_of_the_draws_themselves():
    """With a fixed key, more light gives more counts; over many pixels the steps of the counts average out."""
    key, x = jax.random.key(5), jnp.full(1 << 18, 900.0)
    weights = jnp.asarray(np.random.default_rng(0).uniform(0, 1, x.shape), jnp.float32)

    @jax.jit
    def total(shift):
        return jnp.sum(weights * photon_noise(key, x + shift, 0.0))

    slope = float(jax.grad(total)(0.0))
    # Rounded counts differ by at most 1 from smooth ones: 1 / (40 sqrt(2^18)) per pixel; terms beyond the square root
    # of the expansion change slopes by w / (72 mean^1.5), which is less.
    assert float(total(20.0) - total(-20.0)) / 40 == pytest.approx(slope, rel=2e-3)


def test_a_full_pixel_of_just_so_many_counts_is_not_saturated():
    signal, key = jnp.float32(50.0), jax.random.key(7)
    drawn = float(photon_noise(key, signal, 0.0))
    slopes = [float(jax.grad(partial(photon_noise, key, sigma=0.0, most=most))(signal)) for most in (drawn, drawn - 1)]
    assert slopes == [pytest.approx(1 + (drawn - 50) / 100, rel=1e-5), 0.0]


@pytest.mark.parametrize("mean", [0.4, 3.0, 7.99])
def test_tails_down_to_one_in_a_million_are_summed(mean: float):
    """Against the quantiles of the distribution; single precision knows shares near 1 to 6e-8."""
    share = np.array([1e-6, 1e-3, 0.3, 0.9, 0.999, 1 - 1e-5, 1 - 1e-6])
    found = noise._summed(jnp.full(share.shape, mean, jnp.float32), jnp.asarray(share, jnp.float32))
    assert np.asarray(found).tolist() == stats.poisson.ppf(share, mean).tolist()


def test_gradient_in_the_dark_stays_bounded():
    found = jax.grad(lambda x: jnp.sum(photon_noise(jax.random.key(0), x, 0.0)))(jnp.full(10_000, 1e-3))
    assert np.isfinite(found).all()
    assert np.abs(found).max() < 3  # 1 + n / 2 with a photon or two where none is expected


def test_saturation_stops_the_gradient():
    bright = jnp.asarray([100.0, 5000.0])
    drawn, slope = jax.value_and_grad(lambda x: jnp.sum(photon_noise(jax.random.key(0), x, 0.0, most=1000.0)))(bright)
    assert slope[0] > 0
    assert slope[1] == 0
    assert drawn < 1200


@pytest.mark.parametrize(
    ("function", "values", "wanted", "slopes"),
    [
        (partial(clipped, low=0.0, high=1.0), [-0.1, 0.0, 0.3, 1.0, 1.1], [0.0, 0.0, 0.3, 1.0, 1.0], [0, 1, 1, 1, 0]),
        (rounded, [-0.6, 0.4, 0.6, 7.0], [-1.0, 0.0, 1.0, 7.0], [1, 1, 1, 1]),
    ],
    ids=["clipped", "rounded"],
)
def test_straight_through(function, values, wanted, slopes):
    given = jnp.asarray(values)
    assert np.array_equal(function(given), jnp.asarray(wanted))
    assert np.array_equal(jax.grad(lambda x: jnp.sum(function(x)))(given), np.asarray(slopes, np.float32))
