"""Loss curves of optimisations and trainings."""

import numpy as np
import pytest
from matplotlib.axes import Axes

from doedesign.report.history import plot_history, plot_spot_history, plot_training
from doedesign.report.page.networks import history_chart
from fab.figure import png_bytes
from tests.pictures import require_place_of_axes, require_whole

RECORDS = [{"step": i, "loss": 1 / (i + 1), "terms": [0.3, 0.9 / (i + 1)], "names": ["a", "my:b"]} for i in range(130)]
TRAINING = [{"step": i, "loss": 1 / (i + 1), "parts": {"l1": 0.5 / (i + 1), "masked": 0.0}} for i in range(130)]


def legend_of(axes: Axes) -> list[str]:
    legend = axes.get_legend()
    assert legend is not None
    return [text.get_text() for text in legend.get_texts()]


def test_a_long_history_is_drawn_under_its_mean():
    axes = plot_history(RECORDS)
    require_whole(axes)
    assert png_bytes(axes) == png_bytes(plot_history(RECORDS))
    require_place_of_axes(lambda ax: plot_history(RECORDS, ax))
    assert legend_of(axes) == ["loss", "a", "b"]
    assert "mean of 2" in axes.get_xlabel()
    faint, mean = axes.lines[:2]
    np.testing.assert_array_equal(faint.get_ydata(), [record["loss"] for record in RECORDS])
    assert np.asarray(mean.get_ydata())[0] == pytest.approx((1 + 0.5) / 2)
    assert axes.get_yscale() == "log"


SPOTS = [
    {"step": i, "loss": 0.1, "terms": [0.91 + 1e-5 * i, 1e-2 / (i + 1)], "names": ["efficiency", "uniformity_error"]}
    for i in range(50)
]


def test_light_and_uniformity_of_spots_have_axes_of_their_own():
    figure = plot_spot_history(SPOTS, title="fan")
    require_whole(figure)
    require_place_of_axes(lambda ax: plot_spot_history(SPOTS, ax))
    root = figure.get_figure(root=True)
    assert root.get_suptitle() == "fan: light on the spots and uniformity error over the steps"
    light, uneven = root.axes
    assert (light.get_ylabel(), uneven.get_ylabel()) == ("light on the spots (%)", "uniformity error (%)")
    np.testing.assert_allclose(np.asarray(light.lines[0].get_ydata()), [100 * one["terms"][0] for one in SPOTS])
    np.testing.assert_allclose(np.asarray(uneven.lines[0].get_ydata()), [100 * one["terms"][1] for one in SPOTS])
    assert (light.get_yscale(), uneven.get_yscale()) == ("linear", "log")
    # What changes by 0.05 % fills its panel.
    low, high = light.get_ylim()
    assert high - low < 0.1


def test_the_page_draws_the_light_that_spots_miss():
    chart = history_chart(SPOTS, "Weights follow.")
    assert chart is not None
    assert [one.label for one in chart.series] == ["loss", "1 - efficiency", "uniformity_error"]
    assert chart.series[1].y[0] == pytest.approx(0.09)
    # Spots have one colour and one depth, so that no step looks at some of them.
    assert chart.note == "Weights follow."


def test_an_only_term_is_the_loss():
    axes = plot_history([{"step": i, "loss": 0.5, "terms": [0.5], "names": ["a"]} for i in range(3)])
    assert legend_of(axes) == ["loss"]


def test_a_training_shows_no_term_without_weight():
    figure = plot_training(TRAINING, "small")
    require_whole(figure)
    require_place_of_axes(lambda ax: plot_training(TRAINING, "small", ax))
    assert legend_of(figure.get_figure(root=True).axes[0]) == ["loss", "l1"]


def test_no_steps_are_a_mistake():
    for draw in (plot_history, plot_spot_history, plot_training):
        with pytest.raises(ValueError, match="at least one step"):
            draw([])
