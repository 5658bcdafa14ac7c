"""The camera's geometry: where pixels look, what is known of it beforehand, and that it is fitted like any motion."""

from pathlib import Path

import numpy as np
import pytest

from doedesign.calibration.estimate import remarks_on
from doedesign.calibration.fit import search
from doedesign.calibration.geometry import GeometryPrior, geometry_text, places
from doedesign.calibration.measurement import load_measurement
from doedesign.calibration.uncertainty import left_out, posterior_of
from fab.errors import InputError
from tests.doedesign.analytic_plate import NOISE, SIDE, AnalyticImages, analytic_calibration, analytic_objective

TRUTH = np.array([1.3, -0.4])
STOOD = (0.01, -0.02, 0.015, 0.3)
LOOSE = GeometryPrior((0.0, 0.0, 0.0, 0.0), (0.02, 0.02, 0.02, 0.5))
HEAD = 'probe = "520 nm"\npixel = "1.85 um"\ngain = 2.0\nread_noise = 4.0\n'
IMAGE = '[[image]]\ndepth = "6 mm"\nfiles = ["a.tiff"]\n'


def seen(geometry: tuple[float, ...], row: float, column: float, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    return np.array([float(v) for v in places(geometry, shift, 200.0)(row, column)])


def test_a_camera_turned_from_x_toward_y_sees_what_lies_there():
    np.testing.assert_allclose(seen((np.pi / 2, 0, 0, 0), 0.0, 30.0), [30, 0], atol=1e-5)
    np.testing.assert_allclose(seen((np.pi / 2, 0, 0, 0), 30.0, 0.0), [0, -30], atol=1e-5)


def test_scales_are_those_of_the_sensors_own_axes():
    """Stretched first and turned then: what is twice as wide on the sensor lies along y after a quarter turn."""
    np.testing.assert_allclose(seen((0.0, 0.1, -0.2, 0), 10.0, 30.0), [11, 24], rtol=1e-6)
    np.testing.assert_allclose(seen((np.pi / 2, 0, 1.0, 0), 0.0, 30.0), [60, 0], atol=1e-5)


def test_everything_happens_about_the_chief_ray():
    shift = (3.0, -5.0)
    np.testing.assert_allclose(seen(STOOD, *shift, shift), shift, rtol=1e-6)
    expected = np.array(shift) + seen(STOOD, 20.0, -31.0)
    np.testing.assert_allclose(seen(STOOD, 23.0, -36.0, shift), expected, rtol=1e-6)


def test_a_distortion_of_a_half_lies_between_sine_and_tangent():
    """Where a lens that maps to f tan has r, one that maps to f sin has r (1 - r² / 2 f²), to order 4."""
    angle = 0.1
    y, _ = seen((0, 0, 0, 0.5), 200 * np.tan(angle), 0.0)
    assert y == pytest.approx(200 * np.sin(angle), abs=200 * angle**5)  # the next order, 3/8 of it


def test_values_are_told_with_their_unit():
    assert geometry_text("rotation", np.radians(1.00234), np.radians(0.0042)) == "1.0023 ± 0.0042 °"
    assert geometry_text("scale_x", 0.02, 0.0011) == "2.00 ± 0.11 %"
    assert geometry_text("distortion", -0.25, 0.031) == "-0.250 ± 0.031"


def written(folder: Path, text: str) -> Path:
    path = folder / "measurement.toml"
    path.write_text(HEAD + text + IMAGE)
    return path


def test_a_bench_of_which_nothing_is_said_is_looked_at_for_its_camera(tmp_path: Path):
    """To a degree, two per cent, and the difference between two kinds of lens."""
    prior = load_measurement(written(tmp_path, "")).camera.prior
    assert prior.mean == (0, 0, 0, 0)
    assert prior.sigma == (np.radians(1), 0.02, 0.02, 0.5)
    assert prior.unknown == (0, 1, 2, 3)
    assert not prior.upright


def test_what_is_said_of_the_camera_is_taken(tmp_path: Path):
    said = '[camera]\nrotation = "-2 deg"\nrotation_sigma = "0 deg"\nscale_x = 0.01\nscale_sigma = 0.0\n'
    prior = load_measurement(written(tmp_path, f"{said}distortion_sigma = 0.1\n")).camera.prior
    assert prior.mean == pytest.approx((np.radians(-2), 0, 0.01, 0))
    assert prior.sigma == (0, 0, 0, 0.1)
    assert prior.unknown == (3,)
    exact = 'rotation_sigma = "0 deg"\nscale_sigma = 0.0\ndistortion_sigma = 0.0\n'
    assert load_measurement(written(tmp_path, f"[camera]\n{exact}")).camera.prior.upright
    # Known, and not nothing.
    turned = load_measurement(written(tmp_path, f'[camera]\nrotation = "1 deg"\n{exact}')).camera.prior
    assert not turned.unknown
    assert not turned.upright


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("rotation = 1", r"camera\.rotation: must be a number with a unit"),
        ('rotation = "30 deg"', r"camera\.rotation: must lie between -10 deg and 10 deg"),
        ('rotation_sigma = "-1 deg"', r"camera\.rotation_sigma: must lie between 0 deg and 10 deg"),
        ("scale_y = 2", r"camera\.scale_y: must lie between -0\.1 and 0\.1"),
        ('scale_x = "1 %"', r"camera\.scale_x: must be a number"),
        ("scale_sigma = -0.01", r"camera\.scale_sigma: must lie between 0 and 0\.1"),
        ("distortion = 3", r"camera\.distortion: must lie between -2 and 2"),
        ("distortion_sigma = nan", r"camera\.distortion_sigma: must lie between 0 and 2"),
        ("rotaton = 0", r"must be a known key of \[camera\].*Did you mean `rotation`"),
    ],
)
def test_mistakes_about_the_camera_are_named(tmp_path: Path, line: str, message: str):
    with pytest.raises(InputError, match=message):
        load_measurement(written(tmp_path, f"[camera]\n{line}\n"))


def test_all_images_share_the_camera_and_no_motion():
    prior = GeometryPrior((0.1, 0.2, 0.3, 0.4), (0.02, 0.0, 0.03, 0.0))
    objective = analytic_objective(TRUTH, geometry=prior)
    assert (objective.errors, objective.shared, objective.scores) == (2, 4, 8)
    scores = np.arange(1.0, 9.0)
    first, second = (objective.motion(scores, i) for i in (0, 1))
    np.testing.assert_allclose(first, [2 * 5, 2 * 6, 0, 0.1 + 0.02 * 3, 0.2, 0.3 + 0.03 * 4, 0.4])
    np.testing.assert_allclose(second, [2 * 7, 2 * 8, 0, 0.1 + 0.02 * 3, 0.2, 0.3 + 0.03 * 4, 0.4])


def test_the_exact_gradient_is_the_slope_of_the_cost_along_the_camera_too():
    objective = analytic_objective(TRUTH, geometry=LOOSE, stood=STOOD)
    scores = np.random.default_rng(1).normal(size=objective.scores) * 0.1
    weights = tuple(np.full((SIDE, SIDE), NOISE**-2) for _ in objective.targets)
    _, gradient = objective.evaluate_with_gradient(weights, scores)
    for k in range(objective.scores):
        step = 1e-4 * np.eye(objective.scores)[k]
        ends = [objective.evaluate(weights, scores + sign * step).cost for sign in (1, -1)]
        assert gradient[k] == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=1e-5, abs=1e-5 * abs(gradient).max())


def test_how_the_camera_stood_is_found_with_its_uncertainty():
    found = search(analytic_objective(TRUTH, geometry=LOOSE, stood=STOOD))
    posterior = posterior_of(found)
    # Five standard deviations of six numbers; images say all of them.
    assert abs(posterior.values - TRUTH) == pytest.approx(0, abs=5 * posterior.sigma.max())
    assert (abs(posterior.geometry - STOOD) < 5 * posterior.geometry_sigma).all()
    assert (posterior.geometry_sigma < np.array(LOOSE.sigma)).all()
    assert posterior.correlation.shape == (6, 6)
    np.testing.assert_allclose(np.diag(posterior.correlation), 1)


def test_an_image_is_predicted_from_the_others_with_a_camera_that_the_model_follows(monkeypatch: pytest.MonkeyPatch):
    """Where the others say little of it, one linear step may lead anywhere, and light of such places is no number."""
    found = search(analytic_objective(TRUTH, geometry=LOOSE, stood=STOOD))
    seen, image = [], AnalyticImages.image

    def kept(images: AnalyticImages, index: int, motion: np.ndarray) -> np.ndarray:
        seen.append(motion[3:])
        return image(images, index, motion)

    monkeypatch.setattr(AnalyticImages, "image", kept)
    left_out(found._replace(descents=tuple(1e4 * each for each in found.descents)))
    away = abs(np.array(seen)) / LOOSE.sigma
    assert away.max() == pytest.approx(4.0)


def test_a_camera_that_is_known_is_not_looked_for():
    known = GeometryPrior(STOOD, (0.0, 0.0, 0.0, 0.0))
    posterior = posterior_of(search(analytic_objective(TRUTH, geometry=known, stood=STOOD)))
    assert tuple(posterior.geometry) == STOOD
    assert not posterior.geometry_sigma.any()
    assert posterior.correlation.shape == (2, 2)
    assert posterior.chi2_per_pixel == pytest.approx(1.0, abs=0.15)  # of 648 pixels: 0.055 is one standard deviation


def test_the_camera_is_told_with_the_errors():
    result = analytic_calibration(analytic_objective(TRUTH, geometry=LOOSE, stood=STOOD))
    assert list(result.camera) == ["rotation", "scale_y", "scale_x", "distortion"]
    lines = str(result).splitlines()
    assert [line.split("  ")[0] for line in lines[3:7]] == [f"camera {n.replace('_', ' ')}" for n in result.camera]
    assert len(result.rows) == 6


@pytest.mark.parametrize(("stood", "warned"), [(0.01, False), (0.3, True)])
def test_a_camera_far_from_what_was_expected_is_told(stood: float, warned: bool):
    """Three standard deviations of 0.02 are 0.06; of two thirds of that nothing is said."""
    narrow = GeometryPrior(sigma=(0.02, 0.0, 0.0, 0.0))
    result = analytic_calibration(analytic_objective(TRUTH, geometry=narrow, stood=(stood, 0, 0, 0)))
    said = [one for one in remarks_on(result, result.fit.at.matches[0].model) if "camera rotation" in one]
    assert len(said) == warned
    if warned:
        assert "standard deviations from what was expected: check the bench" in said[0]
