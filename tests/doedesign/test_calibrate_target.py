"""A measured image beside a model's: weights, gain and background in closed form, and their derivatives."""

import numpy as np
import pytest

from doedesign.calibration.target import MeasuredImage, Target, match, weights_at
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
