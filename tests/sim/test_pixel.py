import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.propagation.pixel import Banded, disc_autocorrelation, pixel_weights, sampling_for


def test_disc_autocorrelation_by_counting():
    """Overlap of a disc with a copy of itself, counted on a grid."""
    axis = (np.arange(2000) - 999.5) / 1000
    disc = np.hypot(axis[:, None], axis[None, :]) <= 0.5
    for shift in (0, 250, 500, 900, 1000, 1200):
        overlap = disc[:, shift:] & disc[:, : 2000 - shift]
        # A thousand samples per diameter leave 1e-3 of its edge uncertain.
        share = float(disc_autocorrelation(np.array([shift / 1000]))[0])
        assert share == pytest.approx(overlap.sum() / disc.sum(), abs=1e-3)


@pytest.mark.parametrize("width", [0.8, 3.14, 7.5])
def test_weights_sum_to_the_pixel(width: float):
    centres = 40 + np.linspace(-20, 20, 17)
    weights = pixel_weights(centres, width, 0.48, 81)
    # The weight of the mean against speckle is set for 1e-5; see `MEAN_WEIGHT`.
    np.testing.assert_allclose(weights.matrix.sum(axis=0), width, rtol=3e-5)


def test_the_predicted_error_is_that_of_speckle():
    """Plane waves of every frequency in the band, weighted as speckle holds them, against the exact integral."""
    width, cutoff = 3.3, 0.45
    centres = 30 + np.arange(16) / 16
    weights = pixel_weights(centres, width, cutoff, 64)
    frequency = np.linspace(-cutoff, cutoff, 301)
    along = disc_autocorrelation(np.hypot(frequency[:, None], frequency[None, :]) / cutoff)
    power = (along * np.sinc(width * frequency) ** 2).sum(axis=1)
    waves = np.exp(2j * np.pi * frequency[:, None] * np.arange(64))
    exact = width * np.sinc(width * frequency)[:, None] * np.exp(2j * np.pi * frequency[:, None] * centres)
    missed = np.mean(np.abs(waves @ weights.matrix - exact) ** 2, axis=1) @ power
    error = np.sqrt(missed / (np.mean(np.abs(exact) ** 2, axis=1) @ power))
    assert error < 0.01
    # The two sums differ in how finely they divide the band.
    assert weights.expected_error == pytest.approx(error, rel=0.03)


@pytest.mark.parametrize("width", [0.8, 3.0, 3.3, 4.0])
def test_mirrored_pixels_have_mirrored_weights(width: float):
    """So a pixel takes as many samples on either side as it can."""
    centres = np.array([20.0, 20.2, 21.4, 22.7])
    one, other = (pixel_weights(at, width, 0.45, 44).matrix for at in (centres, 43 - centres))
    same = np.mod(centres - (np.ceil(width) + 4) / 2, 1) != 0.5  # halfway between, either side will do
    np.testing.assert_allclose(one[::-1, same], other[:, same], atol=1e-9)


def test_denser_samples_are_better():
    errors = [
        pixel_weights(np.array([20.3, 21.8]), 1.5 * s, 1 / s, 60).expected_error for s in (1.0, 1.5, 2.05, 2.5, 4.0)
    ]
    assert all(np.diff(errors) < 0)


@pytest.mark.parametrize("pixel", [0.7, 1.57, 3.0, 6.0])
def test_the_sampling_chosen_is_the_coarsest_that_does(pixel: float):
    sampling = sampling_for(pixel, 2e-3)
    assert 2.05 <= sampling <= 6
    assert sampling_for(pixel, 1e-2) <= sampling <= sampling_for(pixel, 3e-4)


@pytest.mark.parametrize("centre", [1.0, 57.0])
def test_a_pixel_beyond_the_samples_is_refused(centre: float):
    with pytest.raises(ValueError, match="pixels need samples"):
        pixel_weights(np.array([centre]), 3.0, 0.5, 60)


def require_the_dense_product(inputs: int, outputs: int, tile: int, half_width: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    middle = np.sort(rng.integers(0, inputs, outputs))
    band = np.abs(np.arange(inputs)[:, None] - middle) <= half_width
    # Some outputs use no input at all.
    dense = np.where(band, rng.normal(size=(2, *band.shape)), 0.0) * (rng.random(outputs) < 0.8)
    x = rng.normal(size=(2, inputs)).astype(np.float32)
    got = np.asarray(Banded.from_dense(dense[0], tile)(jnp.asarray(x)))
    assert got.shape == (2, outputs)
    # Sums of at most 25 (complex: 50) float32 products of order 1.
    np.testing.assert_allclose(got, x @ dense[0], atol=1e-4)
    weights = dense[0] + 1j * dense[1]
    real, imaginary = np.asarray(Banded.from_dense(weights, tile, batched=True).of_complex(jnp.asarray(x)))
    np.testing.assert_allclose(real + 1j * imaginary, (x[0] + 1j * x[1]) @ weights, atol=2e-4)


def test_banded_is_the_dense_product():
    require_the_dense_product(150, 67, 16, 5, seed=0)  # the last tile is not full


@pytest.mark.slow  # every example is compiled anew
@settings(max_examples=10)
@given(st.integers(1, 200), st.integers(1, 90), st.integers(1, 70), st.integers(0, 12), st.integers(0, 2**32 - 1))
def test_banded_is_the_dense_product_at_any_size(inputs: int, outputs: int, tile: int, half_width: int, seed: int):
    require_the_dense_product(inputs, outputs, tile, half_width, seed)
