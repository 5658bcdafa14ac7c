"""Calibration closes the loop: hidden errors are found from photographs, and what is not to be found is said so."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from doedesign.calibration.estimate import Calibration, calibrate
from doedesign.calibration.fit import search
from doedesign.calibration.forward_model import ForwardModel
from doedesign.calibration.measurement import read_measurement
from doedesign.calibration.objective import FitObjective
from doedesign.calibration.target import measured_weights
from doedesign.calibration.uncertainty import posterior_of
from doedesign.calibration.unknowns import definite_means, unknowns_of
from doedesign.design.design import Design
from fab.errors import InputError
from fab.process import Normal, Process
from tests.doedesign.calibration_fakes import light_of, photograph, plate_drawn, usual_process

NEAR_M, FAR_M = 6e-3, np.inf
HIDDEN = {
    "common_depth_scale": 0.03,
    "common_cd_bias_m": -0.15e-6,
    "overlay_y_m[1]": 0.9e-6,
    "overlay_y_m[2]": -0.5e-6,
    "overlay_y_m[3]": 0.2e-6,
    "overlay_x_m[1]": -0.3e-6,
    "overlay_x_m[2]": 0.7e-6,
    "overlay_x_m[3]": -1.0e-6,
}
FEW = {"common_depth_scale": -0.02, "common_cd_bias_m": 0.1e-6, "overlay_y_m[1]": 0.5e-6, "overlay_x_m[1]": -0.7e-6}


def measured(
    folder: Path,
    design: Design,
    process: Process,
    hidden: dict[str, float],
    depths_m: tuple[float, ...] = (NEAR_M, FAR_M),
    errors: tuple[str, ...] = (),
    electrons: float = 3e7,
    margin: int = 20,
    **options: Any,
) -> Calibration:
    path = photograph(folder, light_of(design, process, hidden, depths_m, margin), depths_m, electrons=electrons)
    return calibrate(design, read_measurement(path, design.camera), errors, process=process, **options)


def small(cells: int = 96, count: int = 4, relief: float = 1.0) -> tuple[Design, Process]:
    design = plate_drawn(cells, count, relief, window=48)
    return design, usual_process(design)


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    """Sixteen levels, eight hidden errors, two images in brackets with full pixels, noise, background, an offset."""
    design = plate_drawn()
    return measured(tmp_path_factory.mktemp("loop"), design, usual_process(design), HIDDEN)


@pytest.fixture(scope="module")
def objective(tmp_path_factory: pytest.TempPathFactory) -> FitObjective:
    """A small measurement of four errors, before the search."""
    design, process = small()
    return measured(tmp_path_factory.mktemp("small"), design, process, FEW).objective


def found(result: Calibration) -> dict[str, tuple[float, float]]:
    names = result.objective.unknowns.names
    return dict(zip(names, zip(result.posterior.values, result.posterior.sigma, strict=True), strict=True))


@pytest.mark.slow
def test_hidden_errors_are_recovered(loop: Calibration):
    """To the limits that are promised: overlay 0.1 um, depth 0.5 %, line width 0.05 um."""
    for name, (value, sigma) in found(loop).items():
        limit = {"overlay": 0.1e-6, "common_": 0.005}.get(name[:7], 0.0)
        limit = 0.05e-6 if "cd_bias" in name else limit
        assert abs(value - HIDDEN[name]) < limit, name
        # The truth lies where the uncertainty says; six, because the light was computed over a larger window, in which
        # the model's own small errors are others.
        assert abs(value - HIDDEN[name]) < 6 * sigma, name
        assert sigma < limit / 5, name
    assert loop.explained
    assert all(loop.determined.values())


@pytest.mark.slow
def test_the_posterior_check_finds_nothing_wrong(loop: Calibration):
    assert 0.6 < loop.posterior.chi2_per_pixel < 1.2
    # An error of 1 is expected for each; central differences and curvature leave a little.
    assert loop.rises == pytest.approx([1.0] * len(loop.rises), abs=0.4)
    for predicted, together in zip(loop.left_out, loop.fit.at.matches, strict=True):
        # Eight errors hardly matter among ten thousand pixels, whether they come from this image or from the others.
        assert predicted == pytest.approx(together.chi2_per_pixel, rel=0.05)
    numbers = {(r.image, r.quantity): r for r in loop.readings}
    for image, quantity in (("near0", "ring_to_disc"), ("far1", "far_spot")):
        reading = numbers[image, quantity]
        assert reading.measured is not None
        spread = np.hypot(reading.measured[1], reading.predicted[1])
        assert abs(reading.measured[0] - reading.predicted[0]) < 4 * spread
    assert numbers["near0", "throughput"].measured is None  # nobody measured how much light there was


@pytest.mark.slow
def test_the_estimate_predicts_the_fitted_images(loop: Calibration):
    """The process that comes out, used as any process is, makes the images that were fitted."""
    model, at = loop.objective.model, loop.fit.at
    nothing = unknowns_of(replace(loop.process, spreads=loop.process.spreads), ["etch_lag"])
    assert definite_means(nothing.process) == {name: spread.mean for name, spread in loop.process.spreads.items()}
    again = ForwardModel(model.level, model.camera, nothing, model.depths_m, model.geometry).plate(np.zeros(1))
    for i, image in enumerate(found.model for found in at.matches):
        predicted = again.image(i, loop.objective.motion(at.scores, i))
        np.testing.assert_allclose(predicted, image, rtol=0, atol=1e-5 * image.max())  # single precision
    assert loop.process.spreads["overlay_x_m[0]"] == Normal(0.0, 0.0)  # the reference
    assert loop.process.spreads["common_depth_scale"].sigma < 0.001


@pytest.mark.study
def test_without_relief_nothing_is_claimed(tmp_path: Path):
    """A flat plate has no etched edge: what is known afterwards is what was believed before."""
    result = measured(tmp_path, *small(relief=0.0), {})
    np.testing.assert_allclose(result.posterior.ratio, 1.0, atol=1e-3)
    assert result.explained
    assert not any(result.determined.values())
    assert any("Not determined by the images" in remark for remark in result.remarks)


@pytest.mark.slow
def test_what_only_adds_up_is_known_only_as_a_sum(tmp_path: Path):
    """Of one mask the common depth and its own cannot be told apart; their sum can."""
    design = plate_drawn(96, 2, window=48)
    process = usual_process(design, depth_scale=0.02)
    result = measured(tmp_path, design, process, {"common_depth_scale": 0.03}, errors=("depth",))
    (common, common_sigma), (own, own_sigma) = found(result).values()
    assert (1 + common) * (1 + own) == pytest.approx(1.03, abs=5e-3)
    # Two beliefs of 3 % and 2 % and one exact sum leave 0.03 * 0.02 / hypot(0.03, 0.02) = 1.66 % for each.
    assert (common_sigma, own_sigma) == pytest.approx((0.0166, 0.0166), rel=0.05)
    assert result.posterior.correlation[0, 1] < -0.95
    assert not any(result.determined.values())


@pytest.mark.slow
def test_fewer_electrons_are_less_certain_and_still_right(tmp_path: Path):
    design, process = small()
    sigmas = {}
    for electrons in (3e5, 3e6):
        folder = tmp_path / f"{electrons:g}"
        folder.mkdir()
        # Light of the very window that is fitted: what is tested here is noise, not the model's own small errors.
        result = measured(folder, design, process, FEW, electrons=electrons, margin=4)
        for name, (value, sigma) in found(result).items():
            assert abs(value - FEW[name]) < 4 * sigma, name
        sigmas[electrons] = result.fit.sigma[: result.objective.errors]  # what noise alone leaves unknown
    # A tenth of the light: sqrt(10) in the shot noise, and more where the read noise matters.
    assert (sigmas[3e5] > 2.0 * sigmas[3e6]).all()


@pytest.mark.slow
def test_one_colour_of_a_mosaic_is_enough(tmp_path: Path):
    """Half of the pixels, as the green ones of a RAW file lie; the others are never looked at."""
    design, process = small()
    lights = light_of(design, process, FEW, (NEAR_M, FAR_M), margin=4)
    whole = read_measurement(photograph(tmp_path, lights, (NEAR_M, FAR_M), electrons=3e6), design.camera)
    green = np.add.outer(*(np.arange(n) for n in whole.images[0].psf.rate.shape)) % 2 == 1
    shots = []
    for shot in whole.images:
        valid = shot.psf.valid & green
        shots.append(shot._replace(psf=shot.psf._replace(rate=np.where(valid, shot.psf.rate, 0.0), valid=valid)))
    half = calibrate(design, whole._replace(images=tuple(shots)), process=process)
    both = calibrate(design, whole, process=process)
    for name, (value, sigma) in found(half).items():
        assert abs(value - FEW[name]) < 5 * sigma, name
    # Half the light is sqrt(2) less certain, if noise alone counts.
    assert 1.2 < np.median(half.fit.sigma / both.fit.sigma) < 1.6
    assert half.explained


@pytest.mark.slow
def test_a_known_brightness_measures_the_throughput(tmp_path: Path):
    design, process = small()
    lights = light_of(design, process, FEW, (NEAR_M,))
    # 1.5e7 counts in a second for all light on the aperture, known to a per cent.
    path = photograph(tmp_path, lights, (NEAR_M,), image_more="incident = 15000000.0\nincident_sigma = 0.01")
    result = calibrate(design, read_measurement(path, design.camera), process=process)
    (reading,) = [r for r in result.readings if r.quantity == "throughput"]
    assert reading.measured is not None
    assert reading.measured[0] == pytest.approx(reading.predicted[0], rel=0.03)
    assert reading.measured[1] == pytest.approx(0.01 * reading.measured[0], rel=0.05)
    assert not result.left_out  # there is no other image


@pytest.mark.study
def test_a_process_that_is_something_else_is_not_explained(tmp_path: Path):
    """Corners were rounded, and nobody asked: the fit must not pass the errors it finds off as sure."""
    design, process = small()
    wrong = measured(tmp_path, design, process, {**FEW, "corner_radius_m": 0.8e-6})
    assert not wrong.explained
    assert "does not explain the images" in wrong.remarks[0]
    assert wrong.posterior.inflation > 1.2


@pytest.mark.study
def test_a_picture_the_wrong_way_up_is_noticed(tmp_path: Path):
    design, process = small()
    lights = [np.rot90(light, 2).copy() for light in light_of(design, process, {}, (NEAR_M, FAR_M))]
    path = photograph(tmp_path, lights, (NEAR_M, FAR_M))
    result = calibrate(design, path, process=process, evaluations=0)
    assert any("turned left by 2 more quarter turns" in remark for remark in result.remarks)


@pytest.mark.slow
def test_an_error_beyond_its_range_ends_at_the_end(tmp_path: Path):
    """Believed to a tenth of what it is, the error is looked for no further than five standard deviations."""
    design, _ = small()
    timid = usual_process(design, common_cd_bias_m=0.02e-6)
    result = measured(tmp_path, design, timid, {"common_cd_bias_m": 0.2e-6}, errors=("common_cd_bias",), evaluations=0)
    assert found(result)["common_cd_bias_m"][0] == pytest.approx(0.1e-6, rel=1e-6)
    assert any("At the end of the range" in remark for remark in result.remarks)


@pytest.mark.study
def test_the_global_search_helps_where_steps_end_astray(objective: FitObjective, monkeypatch: pytest.MonkeyPatch):
    """From a start two standard deviations off in everything, and the same for the same seed."""
    monkeypatch.setattr("doedesign.calibration.fit._SHIFTS", ())  # which come before it
    far = replace(objective.unknowns, start=objective.unknowns.high * 0.9)
    astray = FitObjective(replace(objective.model, unknowns=far), objective.targets)
    alone = search(astray)
    helped = search(astray, evaluations=80, seed=3)
    assert helped.at.cost <= alone.at.cost
    first, again = (search(astray, evaluations=16, seed=3).at.scores for _ in range(2))
    np.testing.assert_array_equal(first, again)
    values = astray.values(helped.at.scores)
    for name, value in zip(far.names, values, strict=True):
        assert value == pytest.approx(FEW[name], abs=0.05 * far.sigma[far.names.index(name)]), name


def scores_near_the_truth(objective: FitObjective) -> np.ndarray:
    unknowns = objective.unknowns
    values = np.array([FEW[name] for name in unknowns.names])
    return np.concatenate([unknowns.scores(values) + 0.05, np.full(objective.scores - objective.errors, 0.02)])


@pytest.mark.slow
def test_slopes_of_the_objective(objective: FitObjective):
    """Gauss-Newton's half gradient is that of the objective."""
    weights = tuple(measured_weights(target, 0.01) for target in objective.targets)
    scores = scores_near_the_truth(objective)
    at = objective.evaluate(weights, scores)
    linear = at.linearised(at.difference_jacobian(np.full(len(scores), 0.01)))
    gradient = 2 * (scores - sum(linear.descents))
    for k in range(len(scores)):
        step = 0.005 * np.eye(len(scores))[k]
        high, low = (objective.evaluate(weights, scores + sign * step).cost for sign in (1, -1))
        # Differences of the objective, whose third derivative is felt at this step.
        assert gradient[k] == pytest.approx((high - low) / 0.01, rel=0.02, abs=0.02 * np.abs(gradient).max())


@pytest.mark.study
def test_the_exact_gradient_agrees(objective: FitObjective):
    """Backwards through light and plate: the same slope as central differences."""
    weights = tuple(measured_weights(target, 0.01) for target in objective.targets)
    scores = scores_near_the_truth(objective)
    at, gradient = objective.evaluate_with_gradient(weights, scores)
    linear = at.linearised(at.difference_jacobian(np.full(len(scores), 0.005)))
    expected = 2 * (scores - sum(linear.descents))
    np.testing.assert_allclose(gradient, expected, rtol=0.01, atol=0.01 * np.abs(expected).max())


@pytest.mark.study
def test_the_exact_gradient_polishes_nothing_away(objective: FitObjective):
    """It ends where central differences end."""
    plain, polished = search(objective), search(objective, polish=2)
    assert polished.at.cost <= plain.at.cost
    moved = objective.values(polished.at.scores) - objective.values(plain.at.scores)
    assert (np.abs(moved) < posterior_of(plain).sigma).all()


def test_errors_are_named_as_users_name_them():
    design, process = small()
    pitch = design.camera.grid.pitch_m
    assert unknowns_of(process, ["overlay_x", "depth_scale[1]"], pitch).names == ("depth_scale[1]", "overlay_x_m[1]")
    assert "corner_radius_m" in unknowns_of(process, ["corners"], pitch).names
    assert unknowns_of(process, ["corner_radius"], pitch).assumed == ("corner_radius_m",)
    with pytest.raises(InputError, match="Did you mean overlay_x"):
        unknowns_of(process, ["overlayx"], pitch)
    with pytest.raises(InputError, match="a plate has in a definite way, but got roughness"):
        unknowns_of(process, ["roughness"], pitch)
    with pytest.raises(InputError, match="one of the masks 0 to 1"):
        unknowns_of(process, ["overlay_x[4]"], pitch)
    with pytest.raises(InputError, match="something must be left"):
        unknowns_of(process, ["overlay_x[0]"], pitch)


def test_beliefs_of_relative_places():
    """Places relative to mask 0 are as uncertain as two masks, and share that of mask 0."""
    design = plate_drawn(32, 16, window=24)
    unknowns = unknowns_of(usual_process(design), ["overlay_x"])
    covariance = unknowns.root @ unknowns.root.T
    np.testing.assert_allclose(np.diag(covariance), 2 * 0.5e-6**2)
    np.testing.assert_allclose(covariance[0, 1:], 0.5e-6**2)
