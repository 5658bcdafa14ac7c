"""Pictures of calibrations are whole, repeatable, and show what they are given."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from doedesign.calibration import Calibration, Explanation, Family, Targets, calibrate, load_shots
from doedesign.calibration.explanations import Curve
from doedesign.report.calibration import value_text
from doedesign.report.pictures import draw_check, draw_estimates, draw_family, draw_fitted_psfs
from tests.doedesign.calibration_fakes import light_of, photograph, plate_drawn, usual_process

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    """One mask, two images, some pixels full."""
    folder = tmp_path_factory.mktemp("measured")
    drawn = plate_drawn(48, 2, window=24)
    process = usual_process(drawn)
    lights = light_of(drawn, process, {"common_depth_scale": 0.03}, (6e-3, np.inf), margin=4)
    path = photograph(folder, lights, (6e-3, np.inf), exposures=(1.0,), electrons=3e6)
    return calibrate(drawn, process, load_shots(path, drawn.camera))


def family() -> Family:
    curve = Curve((-1.0, 0.0, 1.0), (2.0, 3.0, 4.5), (0.8, 0.9, 0.7))
    single = Explanation({"common_cd_bias_m": 1.2e-7}, {"common_cd_bias_m": 1.2}, 1.2, 1.0, 0.85, 0.1, 0.7, True)
    values, scores = {"depth_scale[3]": -0.03, "sidewall_rad": 0.1}, {"depth_scale[3]": -1.5, "sidewall_rad": 1.0}
    pair = Explanation(values, scores, 1.8, 1.0, 0.5, 0.2, 0.6, False)
    return Family(
        Targets(520e-9, 0.1, 1.0, 0.86),
        {"ring_to_disc": 3.0, "throughput": 0.9, "zeroth_order": 0.01},
        [single],
        [pair],
        [("etch_lag",), ("etch_lag", "corner_radius_m")],
        {"common_cd_bias_m": curve, "etch_lag": curve},
        {},
        4.0,
    )


def test_every_picture_is_whole_and_repeatable(result: Calibration, tmp_path: Path):
    for draw in (draw_fitted_psfs, draw_estimates, draw_check):
        for name in ("a.png", "b.png"):
            draw(tmp_path / name, result)
        assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
        picture = imread(tmp_path / "a.png")[..., :3]
        assert min(picture.shape[:2]) > 200
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20
    draw_family(tmp_path / "f.png", family())
    draw_family(tmp_path / "none.png", family()._replace(singles=[], pairs=[]))
    assert imread(tmp_path / "f.png").shape[:2] != (0, 0)
    assert (tmp_path / "f.png").read_bytes() != (tmp_path / "none.png").read_bytes()


def test_a_difference_is_seen(result: Calibration, tmp_path: Path):
    """A bright pixel that the model lacks makes a red dot."""
    at, fit = result.fit.at, result.fit
    spoilt = at.matches[0].residual.copy()
    y, x = np.argwhere(fit.weights[0] > 0)[100]
    spoilt[y, x] = 1e3 / np.sqrt(fit.weights[0][y, x])
    changed = at._replace(matches=(at.matches[0]._replace(residual=spoilt), *at.matches[1:]))
    linear = fit.linearization._replace(at=changed)
    draw_fitted_psfs(tmp_path / "plain.png", result)
    draw_fitted_psfs(tmp_path / "spoilt.png", replace(result, fit=fit._replace(linearization=linear)))
    plain, dotted = (imread(tmp_path / name)[..., :3] for name in ("plain.png", "spoilt.png"))
    changed = np.abs(plain - dotted).sum(axis=2) > 0.05
    rows, columns = np.nonzero(changed)
    assert rows.size
    # In the third panel of the first row, and nowhere else; the end of the scale is a dark red.
    assert columns.min() > 0.6 * plain.shape[1]
    assert rows.max() < 0.5 * plain.shape[0]
    red, green, blue = dotted[changed].mean(axis=0)
    assert red > 2 * max(green, blue)


def test_values_have_as_many_digits_as_mean_something():
    assert value_text("overlay_x_m[2]", -1.2345e-7, 3.21e-9) == "-123.5 ± 3.2 nm"
    assert value_text("common_depth_scale", 0.0312, 0.02) == "3.1 ± 2.0 %"
    assert value_text("sidewall_rad", np.radians(5.0)) == "5 °"
    assert value_text("magnification[1]", 3e-6) == "3 ppm"
    assert value_text("overlay_x_m[0]", 1e-7, 0.0) == "100 nm"
