"""Pictures of tolerance studies are whole, repeatable, and show what they are given."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.patches import Rectangle

from doedesign.report.labels import error_label
from doedesign.spec import LimitSpec
from doedesign.tolerancing.analysis import QUANTITIES, Sample, limit_from_text, yield_of
from doedesign.tolerancing.budget import Budget
from doedesign.tolerancing.plots import plot_budget, plot_effects, plot_histograms, plot_variance_shares, plot_yield
from doedesign.tolerancing.sensitivity import Effect, SensitivityIndex, VarianceShare
from fab.figure import png_bytes
from fab.grid import Grid
from sim.camera import Camera, Colour
from tests.pictures import dots_of, panel, require_place_of_axes, require_whole

RGB = (Colour("656nm", (656e-9,), (1.0,)), Colour("589nm", (589e-9,), (1.0,)), Colour("486nm", (486e-9,), (1.0,)))
CAMERA = Camera(Grid((64, 64), 1.85e-6), 116e-6, "fused_silica", RGB, 1e-3, 1.85e-6, 32)
PLACES = tuple((colour.name, depth) for colour in RGB for depth in (0.05, np.inf))
NEAR_ROWS = np.array([depth < 1 for _, depth in PLACES])
LIMITS = [
    limit_from_text(text) for text in ("zeroth_order <= 5 %", "ring_to_disc >= 2", "ring_to_disc >= 2.5 for 656nm")
]
# The lines that stand for limits.
MARK = np.array([0xD1, 0x49, 0x5B]) / 255


def random_table(rng: np.random.Generator, limits: Sequence[LimitSpec] = (), plates: int = 60) -> Sample:
    shape = (plates, len(PLACES))
    values = {
        "zeroth_order": rng.gamma(3, 0.01, shape),
        "strehl": 1 - rng.gamma(2, 0.03, shape),
        "throughput": np.full(shape, 0.9),  # a number that does not vary
        "outside_window": rng.gamma(3, 0.02, shape),
        "ring_to_disc": np.where(NEAR_ROWS, rng.normal(3, 0.5, shape), np.nan),
        "far_spot": np.where(NEAR_ROWS, np.nan, rng.normal(0.4, 0.02, shape)),
    }
    values["ring_to_disc"][0, 0] = np.inf  # a plate without any light in the disc
    return Sample(tuple(f"normal/{i}" for i in range(plates)), PLACES, values, tuple(limits))


def changes(rng: np.random.Generator) -> list[Effect]:
    names = [f"{key}[{k}]" for key in ("overlay_x_m", "overlay_y_m", "depth_scale", "cd_bias_m") for k in range(4)]

    def change(name: str, quantity: str, colour: str | None) -> Effect:
        low, high = 0.4 + 0.01 * rng.normal(size=2)
        return Effect(name, "overlay", quantity, colour, float(low), 0.4, float(high), 1e-6)

    out = [
        change(name, quantity, colour)
        for quantity in ("zeroth_order", "far_spot")
        for colour in (None, "656nm")
        for name in names
    ]
    return [*out, Effect("corner_radius_m", "corners", "far_spot", None, None, 0.4, 0.38, 1e-6)]


def shares(rng: np.random.Generator) -> list[VarianceShare]:
    def index() -> SensitivityIndex:
        value = float(rng.uniform(0, 0.6))
        return SensitivityIndex(value, value - 0.1, value + 0.1)

    return [
        VarianceShare(source, quantity, colour, index(), index())
        for quantity in ("zeroth_order", "strehl", "far_spot", "ring_to_disc")
        for colour in (None, *(colour.name for colour in RGB))
        for source in ("depth", "overlay", "cd", "roughness", "defects")
    ]


def budget(verdict: str = "found") -> Budget:
    yields = [yield_of(np.arange(64) < good) for good in (64, 62, 50, 30)]
    return Budget("overlay", 0.9, (0.0, 0.5, 1.0, 2.0), tuple(yields), verdict, 0.7, 0.5, 0.9, {"overlay_x_m[0]": 4e-7})  # pyright: ignore[reportArgumentType]


def plot(name: str, ax: Axes | None = None) -> Axes | FigureBase:
    rng = np.random.default_rng(5)
    table = random_table(rng, () if name == "bare" else LIMITS)
    match name:
        case "histograms":
            return plot_histograms(table, table.of(["normal/3"]), CAMERA, ax)
        case "yield":
            return plot_yield(table, ax)
        case "one_at_a_time":
            return plot_effects(changes(rng), ax)
        case "sobol":
            return plot_variance_shares(shares(rng), CAMERA, ax)
        case "bare":
            return plot_yield(table, ax)
        case _:
            return plot_budget(budget(name), ax)


@pytest.mark.parametrize(
    "name",
    [
        "found",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("histograms", "yield", "one_at_a_time")),
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("sobol", "bare", "beyond")),
    ],
)
def test_a_picture_is_whole_and_the_same_whatever_the_user_has_set(name: str):
    require_whole(plot(name))
    require_place_of_axes(lambda ax: plot(name, ax))
    data = png_bytes(plot(name))
    with mpl.rc_context({"font.size": 20, "axes.grid": True, "axes.formatter.useoffset": True}):
        assert png_bytes(plot(name)) == data


def coloured(drawn: Axes | FigureBase, hue: np.ndarray) -> int:
    """Number of dots of a colour."""
    return int(np.all(np.abs(dots_of(drawn) - hue) < 0.02, axis=-1).sum())


@pytest.mark.slow
@pytest.mark.parametrize(
    "draw",
    [lambda table: plot_histograms(table, table, CAMERA), plot_yield],
    ids=["histograms", "yield"],
)
def test_a_limit_is_marked_wherever_it_lies(draw: Callable[[Sample], FigureBase], rng: np.random.Generator):
    table = random_table(rng)
    assert coloured(draw(table), MARK) == 0
    # Far from all plates: the view is widened.
    # One line over the height of a panel, 1.7 inches of 160 dots, about 2 wide; not all of them are of the pure colour.
    assert coloured(draw(replace(table, limits=(limit_from_text("ring_to_disc >= 9"),))), MARK) > 200


def test_a_longer_bar_is_a_larger_change():
    blue = []
    for size in (0.01, 0.04):
        change = Effect("overlay_x_m[0]", "overlay", "far_spot", None, 0.4 - size, 0.4, 0.4 + size / 4, 1e-4)
        other = Effect("depth_scale[0]", "depth", "far_spot", None, 0.36, 0.4, 0.44, 1e-4)
        blue.append(coloured(plot_effects([change, other]), np.array([0x56, 0xB4, 0xE9]) / 255))
    assert blue[1] > 1.3 * blue[0]


def test_an_error_is_named_in_words():
    assert error_label("overlay_x_m[2]") == "overlay x, mask 3"
    assert error_label("sidewall_rad") == "sidewall"
    assert error_label("radial_nonuniformity") == "radial nonuniformity"


def test_a_yield_has_a_curve_per_place_and_a_share_is_in_per_cent():
    drawn = plot_yield(random_table(np.random.default_rng(5), LIMITS))
    assert isinstance(drawn, Figure)
    panels = {axes.get_title(loc="left").rsplit(" at ", 1)[0]: axes for axes in drawn.axes}
    assert set(panels) == {QUANTITIES[one.quantity].label for one in LIMITS}
    for name, axes in panels.items():
        (quantity,) = [one for one in QUANTITIES.values() if one.label == name]
        places = {(one.colour, one.depth_m) for one in LIMITS if QUANTITIES[one.quantity].label == name}
        assert len([line for line in axes.lines if len(np.asarray(line.get_xdata())) > 2]) >= max(len(places), 1)
        assert axes.get_xlabel() == quantity.label + (" (%)" if quantity.share else "")


def test_bars_of_shares_are_as_long_as_the_indices():
    def index(value: float) -> SensitivityIndex:
        return SensitivityIndex(value, value - 0.05, value + 0.1)

    found = [
        VarianceShare("overlay", "strehl", None, index(0.25), index(0.5)),
        VarianceShare("overlay", "strehl", "656nm", index(0.3), index(0.7)),
        VarianceShare("depth", "strehl", None, index(-0.01), index(0.4)),  # by chance below zero
    ]
    drawn: Any = plot_variance_shares(found, CAMERA)
    axes = panel(drawn, QUANTITIES["strehl"].label)
    rows = {text.get_text(): row for row, text in enumerate(axes.get_yticklabels())}
    bars = [(bar.get_y() + bar.get_height() / 2, bar.get_width()) for bar in axes.patches if isinstance(bar, Rectangle)]
    expected = [(rows[name], share) for name, share in (("overlay", 50), ("overlay", 25), ("depth", 40), ("depth", 0))]
    np.testing.assert_allclose(bars, expected, atol=1e-9)
    lines = [np.asarray(line.get_xdata()).tolist() for line in axes.lines]
    np.testing.assert_allclose(np.concatenate(lines), [45, 60, 70, 35, 50])
    # More sources take more room.
    higher: Any = plot_variance_shares([*found, found[0]._replace(source="roughness")], CAMERA)
    assert higher.get_figheight() > drawn.get_figheight()


def test_a_budget_out_of_reach_says_what_the_yield_is_without_these_errors():
    assert str(budget("out of reach")) == (
        "without overlay errors the yield is 100.0 % (94.3 to 100.0 %), so no budget gives a yield of 90 %"
    )


def test_an_error_that_leaves_the_model_comes_first_and_is_hatched():
    """Its bars go to the end of the axis, and the note says why."""
    known = Effect("depth_scale[0]", "depth", "strehl", None, 0.9, 1.0, 0.95, 0.01)
    beyond = Effect("overlay_x_m[0]", "overlay", "strehl", None, -math.inf, 1.0, -math.inf, math.nan)
    figure = plot_effects([known, beyond])
    assert isinstance(figure, Figure)
    (axes,) = figure.axes
    hatched = [bar for bar in axes.patches if isinstance(bar, Rectangle) and bar.get_hatch()]
    assert len(hatched) == 2
    assert all(bar.get_x() + bar.get_width() == pytest.approx(axes.get_xlim()[0]) for bar in hatched)
    assert [label.get_text() for label in axes.get_yticklabels()] == ["overlay x, mask 1", "depth scale, mask 1"]
