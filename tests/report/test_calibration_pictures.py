"""Pictures of calibrations are whole, repeatable, and show what they are given."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure

from doedesign.calibration.estimate import Calibration, calibrate
from doedesign.calibration.explanations import Curve, Explanation, ExplanationSet, Targets
from doedesign.calibration.plots import plot_check, plot_estimates, plot_explanations, plot_fitted_psfs
from doedesign.calibration.uncertainty import left_out
from doedesign.report.labels import error_label, value_text
from fab.figure import SERIES, png_bytes
from tests.doedesign.analytic_plate import SIGMA, analytic_calibration
from tests.doedesign.calibration_fakes import light_of, photograph, plate_drawn, usual_process
from tests.pictures import dots_of, panel, require_place_of_axes, require_whole


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    """One mask, two images, some pixels full."""
    folder = tmp_path_factory.mktemp("measured")
    drawn = plate_drawn(48, 2, window=24)
    process = usual_process(drawn)
    lights = light_of(drawn, process, {"common_depth_scale": 0.03}, (6e-3, np.inf), margin=4)
    path = photograph(folder, lights, (6e-3, np.inf), exposures=(1.0,), electrons=3e6)
    return calibrate(drawn, path, process=process)


@pytest.fixture(scope="module")
def analytic() -> Calibration:
    """Two errors found from two images that are known in closed form."""
    found = analytic_calibration()
    return replace(found, left_out=left_out(found.fit))


def family() -> ExplanationSet:
    curve = Curve((-1.0, 0.0, 1.0), (2.0, 3.0, 4.5), (0.8, 0.9, 0.7))
    single = Explanation({"common_cd_bias_m": 1.2e-7}, {"common_cd_bias_m": 1.2}, 1.2, 1.0, 0.85, 0.1, 0.7, True)
    values, scores = {"depth_scale[3]": -0.03, "sidewall_rad": 0.1}, {"depth_scale[3]": -1.5, "sidewall_rad": 1.0}
    pair = Explanation(values, scores, 1.8, 1.0, 0.5, 0.2, 0.6, False)
    return ExplanationSet(
        Targets(520e-9, 0.1, 1.0, 0.86),
        {"ring_to_disc": 3.0, "throughput": 0.9, "zeroth_order": 0.01},
        [single],
        [pair],
        [("etch_lag",), ("etch_lag", "corner_radius_m")],
        {"common_cd_bias_m": curve, "etch_lag": curve},
        {},
        4.0,
    )


@pytest.mark.study
@pytest.mark.parametrize("plot", [plot_fitted_psfs, plot_estimates, plot_check])
def test_every_picture_is_whole_and_repeatable(result: Calibration, plot: Callable[..., Figure]):
    require_whole(plot(result))
    assert png_bytes(plot(result)) == png_bytes(plot(result))
    require_place_of_axes(lambda ax: plot(result, ax))


@pytest.mark.slow
def test_explanations_are_drawn_also_if_there_are_none():
    without = family()._replace(singles=[], pairs=[])
    for one in (family(), without):
        require_whole(plot_explanations(one))
        require_place_of_axes(lambda ax, one=one: plot_explanations(one, ax))
    assert png_bytes(plot_explanations(family())) != png_bytes(plot_explanations(without))


@pytest.mark.study
def test_a_difference_is_seen(result: Calibration):
    """A bright pixel that the model lacks makes a red dot."""
    at = result.fit.at
    spoilt, weights = at.matches[0].residual.copy(), at.matches[0].weights
    y, x = np.argwhere(weights > 0)[100]
    spoilt[y, x] = 1e3 / np.sqrt(weights[y, x])
    changed = at._replace(matches=(at.matches[0]._replace(residual=spoilt), *at.matches[1:]))
    spoilt_result = replace(result, fit=result.fit._replace(at=changed))
    plain, dotted = (dots_of(plot_fitted_psfs(one)) for one in (result, spoilt_result))
    changed = np.abs(plain - dotted).sum(axis=2) > 0.05
    rows, columns = np.nonzero(changed)
    assert rows.size
    # In the third panel of the first row, and nowhere else; the end of the scale is a dark red.
    assert columns.min() > 0.6 * plain.shape[1]
    assert rows.max() < 0.5 * plain.shape[0]
    red, green, blue = dotted[changed].mean(axis=0)
    assert red > 2 * max(green, blue)


def test_differences_have_colours_up_to_five_standard_deviations(analytic: Calibration):
    """From there on all pixels have the colour of the scale's end."""
    at = analytic.fit.at
    pulls = np.zeros_like(at.matches[0].residual)
    wanted = [-9.0, -5.0, -4.5, 0.0, 4.5, 5.0, 9.0]
    pulls[3, : len(wanted)] = wanted
    changed = at.matches[0]._replace(residual=pulls / np.sqrt(at.matches[0].weights))
    at = at._replace(matches=(changed, *at.matches[1:]))
    figure = plot_fitted_psfs(replace(analytic, fit=analytic.fit._replace(at=at)))
    shown: Any = panel(figure, "difference").get_images()[0]
    values = shown.get_array().data
    np.testing.assert_allclose(values, pulls, rtol=1e-6, atol=1e-9)
    colours = [tuple(colour) for colour in shown.to_rgba(values)[3, : len(wanted)]]
    assert colours[0] == colours[1]
    assert colours[-1] == colours[-2]
    assert len(set(colours)) == 5
    assert shown.get_clim() == (-5, 5)


def test_errors_are_drawn_in_standard_deviations_of_their_prior(analytic: Calibration):
    drawn = panel(plot_estimates(analytic), "errors of the plate")
    bars = [one for one in drawn.containers if isinstance(one, ErrorbarContainer)]
    ends = np.array([bar.lines[2][0].get_segments()[0][:, 0] for bar in bars])
    values, sigma = analytic.posterior.values, analytic.posterior.sigma
    np.testing.assert_allclose(ends, np.array([values - sigma, values + sigma]).T / SIGMA[:, None], rtol=1e-9)
    labels = [text.get_text() for text in drawn.get_yticklabels()]
    assert labels == ["common depth scale", "common cd bias"]


def test_the_fit_of_every_image_stands_beside_the_line_of_one(analytic: Calibration):
    figure: Any = plot_check(analytic)
    (images,) = (axes for axes in figure.axes if axes.get_xlabel() == "chi2 per pixel")
    (line,) = images.lines
    assert list(line.get_xdata()) == [1, 1]
    fitted, predicted = ([bar.get_width() for bar in bars] for bars in images.containers)
    assert fitted == [found.chi2_per_pixel for found in analytic.fit.at.matches]
    assert predicted == analytic.left_out


@pytest.mark.parametrize("count", [2, 8])
def test_curves_are_solid_until_their_colours_come_again(count: int):
    found = family()
    names = [f"{key}[{mask}]" for key in ("depth_scale", "overlay_x_m") for mask in range(4)][:count]
    singles = [found.singles[0]._replace(values={name: 0.01}, scores={name: 1.0}) for name in names]
    curves = dict.fromkeys(names, next(iter(found.curves.values())))
    figure: Any = plot_explanations(found._replace(singles=singles, curves=curves))
    *lines, measured = figure.axes[0].lines
    assert [line.get_label() for line in lines] == list(map(error_label, names))
    assert [line.get_linestyle() for line in lines] == (["-"] * len(SERIES) + [":"] * len(SERIES))[:count]
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == count
    assert list(measured.get_ydata()) == [found.targets.ring_to_disc] * 2


def test_values_have_as_many_digits_as_mean_something():
    assert value_text("overlay_x_m[2]", -1.2345e-7, 3.21e-9) == "-123.5 ± 3.2 nm"
    assert value_text("common_depth_scale", 0.0312, 0.02) == "3.1 ± 2.0 %"
    assert value_text("sidewall_rad", np.radians(5.0)) == "5 °"
    assert value_text("magnification[1]", 3e-6) == "3 ppm"
    assert value_text("overlay_x_m[0]", 1e-7, 0.0) == "100 nm"
