"""The search and its uncertainty on a plate whose images are known in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from doedesign.calibration.fit import search
from doedesign.calibration.objective import FitObjective, Linearization
from doedesign.calibration.target import match
from doedesign.calibration.uncertainty import Reading, cost_rises, left_out, posterior_of, readings
from fab.errors import InputError
from tests.doedesign.analytic_plate import (
    NEAR_M,
    NOISE,
    SIDE,
    SIGMA,
    AnalyticImages,
    AnalyticModel,
    analytic_objective,
)

TRUTH = np.array([1.3, -0.4])
# Radii of the blur and of the first dark ring of the lens, in pixels.
NEAR_PX = 200e-6 * 1e-3 / (2 * NEAR_M) / 1.85e-6
FAR_PX = 1.2197 * 520e-9 * 1e-3 / 200e-6 / 1.85e-6


def weights_of(objective: FitObjective) -> tuple[np.ndarray, ...]:
    return tuple(np.full((SIDE, SIDE), NOISE**-2) for _ in objective.targets)


def asked(objective: FitObjective) -> list[np.ndarray]:
    """Values of every plate that was asked for."""
    assert isinstance(objective.model, AnalyticModel)
    return objective.model.asked


def patterns_of(objective: FitObjective) -> np.ndarray:
    """Patterns of all images."""
    assert isinstance(objective.model, AnalyticModel)
    return objective.model.patterns


def test_motions_are_two_of_every_image_and_a_third_where_the_depth_is_uncertain():
    objective = analytic_objective(TRUTH, defocus_sigma=0.2)
    assert objective.motions == ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1))
    scores = np.arange(1.0, 8.0)
    # Two pixels per standard deviation, and the curvature's own.
    np.testing.assert_allclose(objective.motion(scores, 0), [2 * 3, 2 * 4, 0.2 * 5, 0, 0, 0, 0])
    np.testing.assert_allclose(objective.motion(scores, 1), [2 * 6, 2 * 7, 0, 0, 0, 0, 0])


@pytest.mark.parametrize("gain_sigma", [None, 0.03])
def test_the_exact_gradient_is_the_slope_of_the_cost(gain_sigma: float | None):
    objective = analytic_objective(TRUTH, waves=0.3, defocus_sigma=0.2, gain_sigma=gain_sigma)
    scores = np.random.default_rng(1).normal(size=7) * 0.1
    at, gradient = objective.evaluate_with_gradient(weights_of(objective), scores)
    assert at.cost == pytest.approx(objective.evaluate(weights_of(objective), scores).cost, rel=1e-12)
    for k in range(7):
        ends = [objective.evaluate(weights_of(objective), scores + s * np.eye(7)[k]).cost for s in (1e-4, -1e-4)]
        # The cost is of 1e4, its difference of 1, in double precision; curvature of the wave: 1e-4 squared.
        assert gradient[k] == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=1e-5, abs=1e-5 * abs(gradient).max())


def test_differences_are_the_patterns_themselves():
    """The images are linear in errors and motions, so any step gives the derivative; and so it is for the 0th order."""
    objective = analytic_objective(TRUTH, defocus_sigma=0.2)
    patterns = patterns_of(objective)
    at, told = objective.evaluate(weights_of(objective), np.zeros(7)), []
    jacobian = at.difference_jacobian(np.full(7, 0.05), told.append)
    first = [SIGMA[0] * patterns[0, 1], SIGMA[1] * patterns[0, 2], 2 * patterns[0, 3], 2 * patterns[0, 4]]
    zeros = np.zeros((2, SIDE, SIDE))
    np.testing.assert_allclose(jacobian.images[0], [*first, 0.2 * patterns[0, 5], *zeros], atol=1e-12)
    second = [SIGMA[0] * patterns[1, 1], SIGMA[1] * patterns[1, 2], *np.zeros((3, SIDE, SIDE))]
    np.testing.assert_allclose(jacobian.images[1], [*second, 2 * patterns[1, 3], 2 * patterns[1, 4]], atol=1e-12)
    np.testing.assert_allclose(jacobian.zeroth_order, [0.02 * SIGMA[0], 0.05 * SIGMA[1], 0, 0, 0, 0, 0], atol=1e-12)
    assert told == ["derivatives"] * 2  # one for every error


def test_at_the_end_of_a_range_the_derivative_is_that_to_one_side():
    objective = analytic_objective(TRUTH, high=np.array([0.0, 2.0]), waves=0.3)
    at = objective.evaluate(weights_of(objective), np.zeros(6))
    asked(objective).clear()
    column = at.difference_jacobian(np.full(6, 0.05)).images[0][0]
    assert max(values[0] for values in asked(objective)) == 0.0
    pattern = patterns_of(objective)[0, 1]
    slope = (0.1 + 0.3 * np.sin(0.2)) / 0.05  # s over a step of 0.05 standard deviations of 2
    np.testing.assert_allclose(column, slope * pattern, rtol=1e-9)


@pytest.mark.parametrize("polish", [0, 5])
def test_errors_are_found_as_weighted_least_squares_has_them(polish: int):
    """The images are linear in the errors, so the answer is one linear system; gain and background are solved for."""
    objective = analytic_objective(TRUTH, gain_sigma=None, noise=NOISE)
    found = search(objective, polish=polish)
    posterior = posterior_of(found)
    assert abs(posterior.values - TRUTH) == pytest.approx(0, abs=4 * posterior.sigma.max())
    # At a minimum the exact gradient is nothing beside what a standard deviation changes.
    _, gradient = objective.evaluate_with_gradient(found.at.weights, found.at.scores)
    assert abs(gradient * found.sigma).max() < 0.25  # a tenth of a standard deviation may be left, of slope 2
    assert posterior.chi2_per_pixel == pytest.approx(1.0, abs=0.15)  # of 648 pixels: 0.055 is one standard deviation


def test_weights_come_from_the_model_once_it_explains_the_images():
    """Then they know of the model's own error, 0.4 % of the light about a pixel, and no more of the image's noise."""
    objective = analytic_objective(TRUTH)
    weights = search(objective).at.weights
    found = search(objective).at.matches[0]
    expected = 1 / (NOISE**2 + 4e-3**2 * gaussian_filter((found.gain * found.model) ** 2, 1.0))
    # A last step of a tenth of a standard deviation comes after the weights.
    np.testing.assert_allclose(weights[0], expected, rtol=2e-3)


def test_images_found_in_the_wrong_place_are_moved_by_a_pixel():
    """Steps from where the images were found end at the wave's first top; from a pixel beside it they get over it."""
    truth, words = np.array([3.0, 0.2]), []
    assert posterior_of(search(analytic_objective(truth, waves=1.0))).values[0] < 1.2
    found = search(analytic_objective(truth, waves=1.0), evaluations=60, on_model=words.append)
    assert posterior_of(found).values == pytest.approx(truth, abs=0.05)
    assert not [word for word in words if word.startswith("global")]


def test_a_search_through_the_range_gets_behind_waves(monkeypatch: pytest.MonkeyPatch):
    """s climbs to 1.91, falls to 1.23 and climbs again: steps from zero end at the first top, the truth lies behind."""
    monkeypatch.setattr("doedesign.calibration.fit._SHIFTS", ())
    truth = np.array([3.0, 0.2])
    near = search(analytic_objective(truth, waves=1.0))
    assert posterior_of(near).values[0] < 1.2
    objective, words = analytic_objective(truth, waves=1.0), []
    found = search(objective, evaluations=60, seed=4, on_model=words.append)
    assert posterior_of(found).values == pytest.approx(truth, abs=0.05)
    assert sum(word.startswith("global") for word in words) in (60, 61)  # NLopt may compute one more than its limit
    assert found.at.cost < near.at.cost


def test_the_search_through_the_range_stays_within_two_standard_deviations(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("doedesign.calibration.fit._SHIFTS", ())
    objective = analytic_objective(np.array([3.0, 0.2]), waves=1.0)
    seen: list[np.ndarray] = []
    search(objective, evaluations=60, on_model=lambda w: seen.append(asked(objective)[-1]) if "global" in w else None)
    farthest = abs(np.array(seen) / SIGMA).max(axis=0)
    assert (farthest <= 2 + 1e-9).all()
    assert (farthest > 1.7).all()  # 60 points of a square: with odds of one in 1e4 none comes so near its edge


def test_plates_beyond_the_model_are_passed_over(monkeypatch: pytest.MonkeyPatch):
    """Some errors are refused together only, so that no range of one of them keeps them away."""
    monkeypatch.setattr("doedesign.calibration.fit._SHIFTS", ())
    objective, plate, refused = analytic_objective(np.array([3.0, 0.2]), waves=1.0), AnalyticModel.plate, []

    def limited(model: AnalyticModel, values: np.ndarray) -> AnalyticImages:
        if values[0] / SIGMA[0] - values[1] / SIGMA[1] > 1.5:  # a fifth of the square that is looked through
            refused.append(values)
            raise InputError("overlay", "must stay below", f"{values}", "Align better.")
        return plate(model, values)

    monkeypatch.setattr(AnalyticModel, "plate", limited)
    found = search(objective, evaluations=60, seed=4)
    assert refused
    assert posterior_of(found).values == pytest.approx([3.0, 0.2], abs=0.05)


def test_a_mean_outside_the_range_leaves_a_range_to_search(monkeypatch: pytest.MonkeyPatch):
    """Two standard deviations of 2 round a mean of 7 lie beyond a range that ends at 2.5."""
    monkeypatch.setattr("doedesign.calibration.fit._SHIFTS", ())
    mean, low, high = np.array([7.0, 0.0]), np.array([-3.0, -2.5]), np.array([2.5, 2.5])
    start, words = np.array([2.5, 0.0]), list[str]()
    objective = analytic_objective(np.array([3.0, 0.2]), waves=1.0, mean=mean, low=low, high=high, start=start)
    search(objective, evaluations=20, on_model=words.append)
    assert [word for word in words if word.startswith("global")]


def test_steps_go_on_until_the_images_are_explained():
    """s bends: a step along its slope at zero ends at 2.3 instead of 3, and only a second one explains the images."""
    words: list[str] = []
    found = search(analytic_objective(np.array([3.0, 0.2]), waves=0.2), on_model=words.append)
    assert posterior_of(found).values == pytest.approx([3.0, 0.2], abs=0.05)
    first, *_, last = (float(word.partition(" ")[0]) for word in words if word != "derivatives")
    assert first > 3
    assert last < 1.2


def test_a_search_may_begin_at_the_low_end_of_a_range():
    """Of some ends, offset to 5 standard deviations and back, rounding makes a little more than 5."""
    low = next(end for end in -np.linspace(3.1, 4.9, 1000) if end - (end - 5.0) > 5.0) * SIGMA[0]
    truth, start = np.array([low - 0.05, 0.1]), np.array([low, 0.0])
    found = search(analytic_objective(truth, low=np.array([low, -2.5]), start=start))
    assert posterior_of(found).values[0] == pytest.approx(low)


def test_what_is_explained_needs_no_search_through_the_range():
    words: list[str] = []
    search(analytic_objective(TRUTH), evaluations=60, on_model=words.append)
    assert not [word for word in words if word.startswith("global")]


def test_the_posterior_of_a_linear_model_is_the_inverse_of_its_normal_matrix():
    """Errors, motions, gain and background of one image as columns of one least-squares problem with a prior."""
    objective = analytic_objective(TRUTH, images=1, gain_sigma=None)
    found = search(objective)
    at, posterior = found.at.matches[0], posterior_of(found)
    patterns = patterns_of(objective)[0]
    scaled = at.gain * np.array([SIGMA[0], SIGMA[1], 2.0, 2.0])[:, None, None] * patterns[1:5]
    columns = np.array([*scaled, at.model, np.ones((SIDE, SIDE))]).reshape(6, -1)
    prior = np.diag([1.0, 1.0, 1.0, 1.0, 0.0, 0.0])
    images = (columns * at.weights.ravel()) @ columns.T / posterior.inflation**2
    expected = np.sqrt(np.diag(np.linalg.inv(images + prior)))[:2] * SIGMA
    # The scatter over 36 blocks may widen a standard deviation, by what 36 numbers know of their own variance.
    assert (posterior.sigma >= expected * (1 - 1e-6)).all()
    assert (posterior.sigma < 1.5 * expected).all()
    np.testing.assert_allclose(posterior.ratio, posterior.sigma / SIGMA)
    np.testing.assert_allclose(np.diag(posterior.correlation), 1.0)
    gradient = np.array([1.0, 2.0, 0.0, 0.0])
    assert posterior.spread(gradient) == pytest.approx(np.sqrt(gradient @ posterior.covariance @ gradient))


def weighed(found: Linearization, factor: float) -> Linearization:
    """The same fit by somebody who takes all variances for this factor smaller."""
    at = found.at.reweighted(tuple(factor * each for each in found.at.weights))
    return at.linearised(found.jacobian)


def test_chi2_is_told_per_pixel_that_is_left():
    """Of two images of 18 x 18 pixels less four places, two gains, two backgrounds and two errors."""
    found = search(analytic_objective(TRUTH, gain_sigma=None))
    left = 2 * SIDE**2 - 4 - 2 - 2 - 2
    # What the prior says of errors is a thousandth of what the images say.
    assert posterior_of(found).chi2_per_pixel == pytest.approx(found.at.chi2 / left, rel=1e-4)


def test_noise_that_was_understated_is_made_up_for_and_no_more():
    """Of nine times the weight chi2 is nine times as large, and standard deviations are what they were."""
    found = search(analytic_objective(TRUTH, gain_sigma=None))
    plain, bold, timid = (posterior_of(weighed(found, factor)) for factor in (1.0, 9.0, 0.25))
    stretched = max(plain.chi2_per_pixel, 1.0) / plain.chi2_per_pixel  # where noise is overstated nothing is made of it
    np.testing.assert_allclose(bold.sigma, plain.sigma / np.sqrt(stretched), rtol=0.05)  # blocks scatter a little
    assert bold.inflation == pytest.approx(3 * np.sqrt(plain.chi2_per_pixel), rel=1e-3)
    assert timid.inflation == 1.0
    rises = cost_rises(weighed(found, 9.0), bold)
    assert rises == pytest.approx([1.0] * 4, abs=0.1)  # a model that is a little curved


def test_what_images_leave_to_the_prior_is_not_widened():
    """An error that no image shows is as uncertain as before, however badly images are explained."""
    objective = analytic_objective(TRUTH, gain_sigma=None)
    hidden = patterns_of(objective).copy()
    hidden[:, 2] = 0.0
    assert isinstance(objective.model, AnalyticModel)
    found = search(FitObjective(replace(objective.model, patterns=hidden), objective.targets))
    posterior = posterior_of(weighed(found, 9.0))
    assert posterior.inflation > 3
    assert posterior.ratio[1] == pytest.approx(1.0, rel=1e-6)


def test_misfits_that_differ_from_place_to_place_widen_standard_deviations():
    """A patch of 3 x 3 pixels with more of an error's pattern: the sandwich of the gradients of 6 x 6 such patches."""
    objective = analytic_objective(TRUTH, images=1, gain_sigma=None)
    target, extra = objective.targets[0], np.zeros((SIDE, SIDE))
    extra[6:9, 3:6] = 4 * SIGMA[0] * patterns_of(objective)[0, 1, 6:9, 3:6]
    found = search(
        FitObjective(objective.model, (target._replace(psf=target.psf._replace(rate=target.psf.rate + extra)),))
    )
    match_, slopes = found.at.matches[0], found.jacobian.of_residuals(found.at)[0].reshape(-1, SIDE, SIDE)
    pulls = np.sqrt(match_.weights) * match_.residual
    scatter = np.zeros((len(slopes), len(slopes)))
    for row in range(0, SIDE, 3):
        for column in range(0, SIDE, 3):
            patch = (slice(row, row + 3), slice(column, column + 3))
            gradient = (slopes[:, *patch] * pulls[patch]).sum(axis=(1, 2))
            scatter += np.outer(gradient, gradient)
    inverse = np.linalg.inv(found.half_hessian)
    posterior = posterior_of(found)
    even = np.linalg.inv(found.hessians[0] / posterior.inflation**2 + np.eye(len(slopes)))
    sandwich = np.diag(inverse @ scatter @ inverse)[:2]
    assert sandwich[0] > 1.2 * even[0, 0]
    expected = np.sqrt(np.maximum(sandwich, np.diag(even)[:2])) * SIGMA
    np.testing.assert_allclose(posterior.sigma, expected, rtol=1e-6)


def test_what_finer_cells_would_show_counts_as_a_standard_deviation():
    """Images that would be brighter by the first error's pattern: the fit would end that much lower."""
    objective = analytic_objective(TRUTH, gain_sigma=None)
    found = search(objective)
    plain, values = posterior_of(found), posterior_of(found).values
    missed = 0.03 * SIGMA[0] * patterns_of(objective)[:, 1]
    assert isinstance(objective.model, AnalyticModel)
    finer = FitObjective(replace(objective.model, missed=missed), objective.targets)
    after = posterior_of(found._replace(at=found.at._replace(objective=finer)))
    # The gain, the prior and the other error take a little of it.
    assert after.sigma[0] ** 2 - plain.sigma[0] ** 2 == pytest.approx((0.03 * SIGMA[0]) ** 2, rel=0.02)
    assert after.sigma[1] == pytest.approx(plain.sigma[1], rel=0.02)
    np.testing.assert_array_equal(after.values, values)


def test_an_image_left_out_is_predicted_from_the_others():
    """One linear step is exact here: the same as a fit of the other image alone."""
    objective = analytic_objective(TRUTH, gain_sigma=None)
    found = search(objective)
    for i, chi2 in enumerate(left_out(found)):
        other = FitObjective(objective.model, (objective.targets[1 - i],))
        patterns, root = patterns_of(objective)[1 - i], np.sqrt(found.at.weights[1 - i]).ravel()
        columns = [SIGMA[0] * patterns[1], SIGMA[1] * patterns[2], 2 * patterns[3], 2 * patterns[4]]
        # Gain times (base + columns · scores) + background: linear in gain and gain · scores; without a prior, whose
        # pull is a ten-thousandth of the images'.
        design = np.array([patterns[0], np.ones((SIDE, SIDE)), *columns]).reshape(6, -1).T * root[:, None]
        fitted = np.linalg.lstsq(design, other.targets[0].psf.rate.ravel() * root, rcond=None)[0]
        scores = found.at.scores.copy()
        scores[:2] = fitted[2:4] / fitted[0]
        image = objective.model.plate(objective.values(scores)).image(i, objective.motion(scores, i))
        expected = match(objective.targets[i], found.at.weights[i], image).chi2_per_pixel
        assert chi2 == pytest.approx(expected, rel=2e-3)  # the gain of the images left in moved with them


def test_the_cost_of_a_linear_model_rises_by_one():
    found = search(analytic_objective(TRUTH, gain_sigma=None))
    rises = cost_rises(found, posterior_of(found))
    # Two directions, both ways; gain times error makes the model a little curved.
    assert rises == pytest.approx([1.0] * 4, abs=0.05)


def test_directions_beyond_the_range_are_left_out():
    found = search(analytic_objective(np.array([1.3, 0.0]), gain_sigma=None, high=np.array([1.3, 2.5])))
    assert len(cost_rises(found, posterior_of(found))) in (1, 2, 3)


def read(found: Linearization) -> dict[tuple[str, str], Reading]:
    return {(one.image, one.quantity): one for one in readings(found, posterior_of(found))}


def disc(radius_px: float, centre_px: tuple[float, float]) -> np.ndarray:
    """Share of every pixel inside a disc, by 40 x 40 samples."""
    y, x = (np.arange(40 * SIDE) + 0.5) / 40 - SIDE / 2 - np.array(centre_px)[:, None]
    inside = np.hypot(y[:, None], x) <= radius_px
    return inside.reshape(SIDE, 40, SIDE, 40).mean(axis=(1, 3))


def test_readings_are_those_of_a_lab():
    """Ring over disc of the near image, share in the spot of the far one, about the chief ray that the fit finds."""
    objective = analytic_objective(TRUTH)
    found = search(objective)
    numbers, scores = read(found), found.at.scores
    for i, (quantity, radius_px) in enumerate((("ring_to_disc", NEAR_PX), ("far_spot", FAR_PX))):
        y, x = objective.motion(scores, i)[:2]
        inner, fitted = disc(radius_px + 1, (y, x)), found.at.matches[i]
        light = (objective.targets[i].psf.rate - fitted.background) / fitted.gain
        reading = numbers[f"image{i}", quantity]
        assert reading.measured is not None
        for seen, (value, _) in ((light, reading.measured), (fitted.model, reading.predicted)):
            inside = (inner * seen).sum()
            expected = seen.sum() / inside - 1 if quantity == "ring_to_disc" else inside / seen.sum()
            assert value == pytest.approx(expected, rel=2e-3)  # of 1600 samples in a pixel on the rim
        assert numbers[f"image{i}", "throughput"].predicted[0] == pytest.approx(fitted.model.sum(), rel=1e-12)
        measured = numbers[f"image{i}", "throughput"].measured
        assert measured is not None
        assert measured == pytest.approx((light.sum() * fitted.gain, 0.03 * light.sum()), rel=1e-12)
    zeroth = numbers["plate", "zeroth_order"]
    assert zeroth.measured is None
    values = posterior_of(found).values
    assert zeroth.predicted[0] == pytest.approx(0.1 + 0.02 * values[0] + 0.05 * values[1], rel=1e-9)


def test_unusable_pixels_are_read_off_the_model():
    objective = analytic_objective(TRUTH)
    target = objective.targets[0]
    rate, valid = target.psf.rate.copy(), target.psf.valid.copy()
    rate[8, 9], valid[8, 9] = 1e6, False
    holed = target._replace(psf=target.psf._replace(rate=rate, valid=valid))
    found = search(FitObjective(objective.model, (holed, objective.targets[1])))
    plain = read(search(objective))["image0", "ring_to_disc"]
    assert plain.measured is not None
    assert read(found)["image0", "ring_to_disc"].measured == pytest.approx(plain.measured, rel=0.02)


@pytest.mark.parametrize("image", [0, 1])
def test_the_uncertainty_of_a_reading_is_the_scatter_of_many(image: int):
    """Of 60 measurements of one plate, read about the same point: their scatter is known to a tenth."""
    quantity, values, stated = ("ring_to_disc", "far_spot")[image], [], []
    for seed in range(60):
        objective = analytic_objective(TRUTH, gain_sigma=None, noise_seed=seed, noise=0.05)
        at = objective.evaluate(weights_of(objective), np.array([*(TRUTH / SIGMA), 0, 0, 0, 0]))
        at = at.reweighted(tuple(w / 25 for w in weights_of(objective)))
        found = at.linearised(at.difference_jacobian(np.full(6, 0.01)))
        measured = read(found)[f"image{image}", quantity].measured
        assert measured is not None
        values.append(measured[0])
        stated.append(measured[1])
    assert np.mean(stated) == pytest.approx(np.std(values, ddof=1), rel=0.3)  # three standard deviations of 60


@pytest.mark.parametrize(("image", "radius_px"), [(0, NEAR_PX), (1, FAR_PX)])
def test_the_uncertainty_of_a_reading_is_that_of_pixels_and_background(image: int, radius_px: float):
    """Of ring over disc and of the share in a spot, by their slopes; as much wider as the images' misfit says."""
    plain, bright = analytic_objective(TRUTH), 5 * disc(2.0, (0.0, 0.0))  # without it a background hardly matters
    assert isinstance(plain.model, AnalyticModel)
    patterns = plain.model.patterns.copy()
    patterns[:, 0] += bright
    shown = tuple(one._replace(psf=one.psf._replace(rate=one.psf.rate + bright)) for one in plain.targets)
    found = search(FitObjective(replace(plain.model, patterns=patterns), shown))
    at, fitted, posterior = found.at, found.at.matches[image], posterior_of(found)
    inner = disc(radius_px + 1, tuple(at.objective.motion(at.scores, image)[:2]))
    light = (fitted.target.psf.rate - fitted.background) / fitted.gain
    inside, total = (inner * light).sum(), light.sum()
    slope = 1 / inside - inner * total / inside**2 if image == 0 else inner / total - inside / total**2
    by_pixels, by_background = (slope**2 / fitted.weights).sum(), slope.sum() ** 2 / fitted.weights.sum()
    assert by_background > 0.05 * by_pixels
    key = (f"image{image}", ("ring_to_disc", "far_spot")[image])
    for inflation in (1.0, 3.0):
        every = readings(found, posterior._replace(inflation=inflation))
        measured = next(one.measured for one in every if (one.image, one.quantity) == key)
        assert measured is not None
        # Discs of samples.
        assert measured[1] == pytest.approx(inflation * np.sqrt(by_pixels + by_background) / fitted.gain, rel=5e-3)


def test_the_uncertainty_of_a_prediction_is_that_of_errors_and_motions():
    found = search(analytic_objective(TRUTH))
    at, posterior, zeroth = found.at, posterior_of(found), read(found)["plate", "zeroth_order"]
    gradient = np.array([0.02 * SIGMA[0], 0.05 * SIGMA[1], 0, 0, 0, 0])
    assert zeroth.predicted[1] == pytest.approx(np.sqrt(gradient @ posterior.covariance @ gradient), rel=1e-6)

    def predicted(scores: np.ndarray) -> tuple[float, float, float]:
        """Ring over disc, share in the spot and throughput about fixed places."""
        doe = at.objective.model.plate(at.objective.values(scores))
        out = []
        for i, radius_px in enumerate((NEAR_PX + 1, FAR_PX + 1)):
            y, x = at.objective.motion(at.scores, i)[:2]
            image = doe.image(i, at.objective.motion(scores, i))
            inside = (disc(radius_px, (y, x)) * image).sum()
            out.append(image.sum() / inside - 1 if i == 0 else inside / image.sum())
        return out[0], out[1], float(doe.image(1, at.objective.motion(scores, 1)).sum())

    numbers = read(found)
    keys = [("image0", "ring_to_disc"), ("image1", "far_spot"), ("image1", "throughput")]
    slopes = np.array(
        [np.subtract(predicted(at.scores + 1e-3 * e), predicted(at.scores - 1e-3 * e)) for e in np.eye(6)]
    )
    for key, slope in zip(keys, (slopes / 2e-3).T, strict=True):
        expected = np.sqrt(slope @ posterior.covariance @ slope)
        assert numbers[key].predicted[1] == pytest.approx(expected, rel=0.01)  # discs of samples


def test_a_search_ends_when_its_steps_no_longer_matter():
    """Plates of a linear model: the first, three rounds of two central differences each, and four steps."""
    objective = analytic_objective(TRUTH, gain_sigma=None)
    asked(objective).clear()
    search(objective)
    assert len(asked(objective)) <= 1 + 3 * 4 + 4


def test_an_error_is_determined_where_the_prior_says_less_than_half():
    posterior = posterior_of(search(analytic_objective(TRUTH)))
    assert posterior._replace(ratio=np.array([0.49, 0.51])).determined == [True, False]
    assert posterior.determined == [True, True]
