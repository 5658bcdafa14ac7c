"""The picture of a height map, and what height maps, level maps and reports of rules show of themselves."""

import dataclasses

import numpy as np
import pytest
from matplotlib.figure import Figure

from fab.figure import png_bytes
from fab.grid import Grid
from fab.height import HeightMap
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.plots.height import height_shares, plot_height
from fab.rules.check import Rules, check
from tests.fab.maps import level_map_from
from tests.pictures import panel, panel_dots, require_place_of_axes, require_whole

LEVELS = Levels(16, 75e-9)
GRID = Grid((64, 64), 1.85e-6)


def random_map(rng: np.random.Generator) -> LevelMap:
    return LevelMap(rng.integers(0, 16, GRID.shape).astype(np.uint8), LEVELS, GRID, 116e-6, "a $name$ of one's own")


@pytest.mark.slow
def test_it_is_whole_and_repeatable(rng: np.random.Generator):
    level_map = random_map(rng)
    require_whole(level_map.plot())
    assert png_bytes(level_map.plot()) == png_bytes(level_map.plot())


def test_a_map_that_rises_upward_is_brighter_on_top():
    rise = np.tile(np.linspace(0, 3.6e-6, 64, dtype=np.float32)[:, None], 64)
    drawn = plot_height(HeightMap(rise, GRID, 116e-6), None, "wedge")
    dots = panel_dots(panel(drawn, "64 × 64")).sum(axis=2)
    column = dots[:, dots.shape[1] // 4]
    inside = column[len(column) // 5 : -len(column) // 5]  # away from the chrome
    ninth = len(inside) // 9
    assert inside[:ninth].mean() > inside[-ninth:].mean() + 0.5  # viridis is brighter where the map is higher


def test_large_maps_are_averaged_and_say_so(rng: np.random.Generator):
    height = HeightMap(rng.uniform(0, 1e-6, (900, 700)).astype(np.float32), Grid((900, 700), 1e-6), 600e-6)
    drawn = plot_height(height)
    whole = panel(drawn, "700 × 900 cells, mean over about 1.3 × 1.3")
    shown = np.ma.asarray(whole.images[0].get_array())
    assert shown.shape == (672, 672)
    inside = height.height_m[height.relief.inside(height.grid)].mean() * 1e9
    # Half a million cells; the two means weigh cells at the edge differently.
    assert shown.mean() == pytest.approx(inside, rel=0.01)


@pytest.mark.parametrize("levels", [None, Levels(2, 5e-7)], ids=["no levels", "above the staircase"])
def test_unusual_maps_are_drawn(levels: Levels | None):
    flat = np.zeros((7, 7)) if levels is None else np.full((7, 7), 1e-6)
    require_whole(plot_height(HeightMap(flat, Grid((7, 7), 1e-6), 5e-6), levels, "t" * 500))


@pytest.mark.slow
def test_maps_and_reports_draw_themselves(rng: np.random.Generator):
    level_map = random_map(rng)
    height = HeightMap(level_map.height_m, GRID, 116e-6)
    cut = level_map_from(rng.integers(0, 16, (30, 40)), LEVELS)  # without an aperture
    report = check(level_map, Rules(4e-6, 4e-6))
    for value in (level_map, cut, height, report):
        figure = value.plot()
        assert isinstance(figure, Figure)
        require_whole(figure)
        require_place_of_axes(value.plot)
        page = value._repr_html_()
        assert page.count("<tr>") >= 3
        assert "data:image/png;base64," in page
    assert "1.85 µm" in level_map._repr_html_()
    assert "touch only at a corner" in report._repr_html_()
    assert "breaks no rule" in check(level_map, Rules())._repr_html_()
    assert dataclasses.replace(level_map, name="<b>")._repr_html_().startswith("<div><strong>&lt;b&gt;")


def test_shares_of_area_are_counted_once_each(rng: np.random.Generator):
    heights = (rng.integers(0, 16, 64**2) * LEVELS.step_m).astype(np.float32)
    edges, shares = height_shares(heights, LEVELS, (-0.5 * LEVELS.step_m, 15.5 * LEVELS.step_m))
    assert len(shares) == 16
    np.testing.assert_allclose(edges, (np.arange(17) - 0.5) * 75e-9, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(shares, np.bincount(np.rint(heights / 75e-9).astype(int), minlength=16) / 64**2)
    smooth = rng.uniform(0, 1.2e-6, 5000).astype(np.float32)
    for levels in (None, LEVELS):
        _, shares = height_shares(smooth, levels, (float(smooth.min()), float(smooth.max())))
        assert len(shares) > 16  # what stands between levels is not rounded to them
        assert shares.sum() == pytest.approx(1.0)
    _, beyond = height_shares(np.array([0.0, 20 * 75e-9]), LEVELS, (0.0, 21 * 75e-9))
    assert beyond[0] == beyond[20] == 0.5
