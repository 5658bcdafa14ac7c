"""Loss curves of optimisations and trainings."""

import numpy as np
import pytest
from matplotlib.axes import Axes

from doedesign.report.history import plot_history, plot_training
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


def test_an_only_term_is_the_loss():
    axes = plot_history([{"step": i, "loss": 0.5, "terms": [0.5], "names": ["a"]} for i in range(3)])
    assert legend_of(axes) == ["loss"]


def test_a_training_shows_no_term_without_weight():
    figure = plot_training(TRAINING, "small")
    require_whole(figure)
    require_place_of_axes(lambda ax: plot_training(TRAINING, "small", ax))
    assert legend_of(figure.get_figure(root=True).axes[0]) == ["loss", "l1"]


def test_no_steps_are_a_mistake():
    for draw in (plot_history, plot_training):
        with pytest.raises(ValueError, match="at least one step"):
            draw([])
