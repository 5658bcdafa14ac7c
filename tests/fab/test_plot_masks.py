"""The picture of a mask set."""

import numpy as np
import pytest

from fab.aperture import RoundAperture
from fab.figure import png_bytes
from fab.levels import Levels
from fab.plots.masks import plot_masks
from fab.units import NM, UM
from tests.fab.maps import level_map_from
from tests.pictures import dots_of, panel, require_place_of_axes, require_whole


@pytest.mark.slow
@pytest.mark.parametrize(("count", "shape"), [(2, (3, 5)), pytest.param(64, (70, 64), marks=pytest.mark.slow)])
def test_the_bytes_depend_on_the_masks_alone(count, shape):
    level = np.random.default_rng(1).integers(0, count, shape)
    level_map = level_map_from(level, Levels(count, 75 * NM), UM, 3 * UM)

    def draw():
        return plot_masks(level_map, (RoundAperture(2 * UM), 600 * UM), "DOE")

    require_whole(draw())
    data = png_bytes(draw())
    assert data == png_bytes(draw())
    assert b"Software" not in data
    assert len(np.unique(dots_of(draw()).sum(axis=2))) > 10


def test_masks_are_shown_where_they_etch():
    level = np.full((40, 40), 3)
    level[30:, 5:10] = 2  # bit 0 alone, above and left of the middle
    drawn = plot_masks(level_map_from(level, Levels(4, 300 * NM)), (RoundAperture(20 * UM), 50 * UM))
    first, second = (panel(drawn, f"mask {k}: etches").images[0] for k in (1, 2))
    x0, x1, y0, y1 = first.get_extent()
    assert (x0, y0) == (-x1, -y1)
    assert first.origin == "lower"
    np.testing.assert_array_equal(np.asarray(first.get_array()), level == 2)
    assert first.get_clim() == (0, 1)
    glass, etched = np.asarray(first.cmap(np.array([0.0, 1.0])))[:, :3]
    assert etched[2] > etched[0] + 0.3  # where it is blue, as its title says
    assert np.ptp(glass) < 0.1
    assert not np.any(second.get_array())
    heights = np.asarray(panel(drawn, "height: ").images[0].get_array())
    np.testing.assert_allclose(heights, 300 * level, rtol=1e-6)  # nanometres in float32


def test_it_takes_the_place_of_axes():
    level_map = level_map_from(np.random.default_rng(1).integers(0, 4, (20, 20)), Levels(4, 300 * NM))
    require_place_of_axes(lambda ax: plot_masks(level_map, (RoundAperture(20 * UM), 50 * UM), "DOE", ax))
