"""A measured image beside a model's: weights, gain and background in closed form, and their derivatives."""

import numpy as np
import pytest

from doedesign.calibration.target import MeasuredImage, Target, match, target_of, weights_at
from sim.measured import MeasuredPsf

RNG = np.random.default_rng(7)
SHAPE = (12, 13)


def target(rate: np.ndarray, gain_sigma: float | None = None) -> Target:
    valid = np.ones(SHAPE, bool)
    valid[3, 4] = False
    psf = MeasuredPsf(rate, np.full(SHAPE, 0.3), np.full(SHAPE, 0.02), valid)
    image = MeasuredImage("a", 0.1, psf, (6.0, 6.0), None if gain_sigma is None else (1.0, gain_sigma))
    return Target(image, psf, 1.0, (0.0, 0.0))


def test_weights_are_inverse_variances_of_noise_and_of_the_models_own_error():
    """Of even light: floor + slope (signal + background) + (error signal)²."""
    weights = weights_at(target(np.zeros(SHAPE)), np.full(SHAPE, 5.0), 0.1, background=2.0)
    assert weights[3, 4] == 0
    assert weights[0, 0] == pytest.approx(1 / (0.3 + 0.02 * 7.0 + 0.25), rel=1e-12)


@pytest.mark.parametrize("gain_sigma", [None, 0.05])
def test_gain_and_background_are_those_of_least_squares(gain_sigma: float | None):
    model, weights = RNG.uniform(0, 1, SHAPE), RNG.uniform(0.5, 2, SHAPE)
    weights[3, 4] = 0
    rate = 1.2 * model + 0.4 + 0.05 * RNG.normal(size=SHAPE)
    found = match(target(rate, gain_sigma), weights, model)
    root = np.sqrt(weights).ravel()
    columns, right = np.stack([model.ravel(), np.ones(model.size)], 1) * root[:, None], rate.ravel() * root
    if gain_sigma:  # one more measurement: the gain is 1
        columns, right = np.vstack([columns, [1 / gain_sigma, 0]]), np.append(right, 1 / gain_sigma)
    expected, chi2, *_ = np.linalg.lstsq(columns, right, rcond=None)
    assert [found.gain, found.background] == pytest.approx(expected, rel=1e-10)
    assert found.chi2 == pytest.approx(chi2[0], rel=1e-10)
    assert (found.residuals() ** 2).sum() == pytest.approx(chi2[0], rel=1e-10)
    assert found.chi2_per_pixel == pytest.approx(chi2[0] / (model.size - 1), rel=1e-10)


@pytest.mark.parametrize("gain_sigma", [None, 0.05])
def test_derivatives_of_residuals_give_the_gradient_of_chi2(gain_sigma: float | None):
    """Kaufman's derivatives leave out what is orthogonal to the residuals: their product is the exact gradient."""
    model, weights = RNG.uniform(0, 1, SHAPE), RNG.uniform(0.5, 2, SHAPE)
    rate = 1.2 * model + 0.4 + 0.05 * RNG.normal(size=SHAPE)
    seen, columns = target(rate, gain_sigma), RNG.normal(size=(2, *SHAPE))
    found = match(seen, weights, model)
    gradient = 2 * found.residual_jacobian(columns) @ found.residuals()
    for k, column in enumerate(columns):
        high, low = (match(seen, weights, model + step * column).chi2 for step in (1e-5, -1e-5))
        # A difference of numbers of 1e2 over 2e-5, in double precision.
        assert gradient[k] == pytest.approx((high - low) / 2e-5, rel=1e-5, abs=1e-6)


def blobs(side: int, place: tuple[float, float]) -> np.ndarray:
    """Three spots of which none is like another, and whose centre of light lies at a place (y, x) from the middle."""
    y, x = (np.arange(side) - (side - 1) / 2 - at for at in place)
    spots = ((5.0, -1.0, -4.0), (3.0, -1.0, 4.0), (2.0, 4.0, 4.0))  # light, y, x: centred together
    return sum(light * np.exp(-np.add.outer((y - b) ** 2, (x - a) ** 2) / 4) for light, b, a in spots)  # pyright: ignore


@pytest.mark.parametrize("place", [(5.3, -4.4), (-3.2, 6.1), (0.3, -0.4)])
@pytest.mark.parametrize("brightness", [None, 400.0])
def test_an_image_is_cut_where_it_looks_like_the_model(place: tuple[float, float], brightness: float | None):
    """Found by its centre up to six pixels off, it lies within one of the window's middle, and where it says."""
    middle, rate = (31.5, 31.5), 30 * blobs(64, place)
    # Where `rate` has 30 times the light of the model, its variance is a thousandth of it and a little more.
    psf = MeasuredPsf(rate, np.full(rate.shape, 0.3), np.full(rate.shape, 1e-3), np.ones(rate.shape, bool))
    known = None if brightness is None else (brightness, 0.02)
    found = target_of(MeasuredImage("a", 0.1, psf, middle, known), 32, blobs(32, (0.0, 0.0)))
    light, around = found.psf.rate, np.arange(32) - 15.5
    centre = [(light.sum(axis=1 - axis) * around).sum() / light.sum() for axis in (0, 1)]
    assert max(map(abs, found.shift_px)) <= 1
    assert found.shift_px == pytest.approx(centre, abs=0.1)  # a parabola through three pixels of a peak
    # In units of all light in the window, or of that on the aperture.
    assert found.scale == pytest.approx(brightness or rate.sum(), rel=1e-3)
    np.testing.assert_allclose(
        found.psf.variance(light), (0.3 + 1e-3 * light * found.scale) / found.scale**2, rtol=1e-9
    )
