"""The picture of a mask plate."""

import numpy as np
import pytest

from fab.aperture import RoundAperture
from fab.figure import png_bytes
from fab.layout.frame import draw_frame
from fab.layout.geometry import Shapes
from fab.layout.lettering import Job
from fab.layout.part import photomasks_of
from fab.layout.polygons import annulus_sectors
from fab.layout.split import splits_of
from fab.layout.wafer import Wafer
from fab.levels import Levels
from fab.plots.wafer import plot_wafer
from tests.fab.maps import level_map_from
from tests.pictures import dots_of, require_place_of_axes, require_whole


def plot(wafer, ax=None):
    level_map = level_map_from(np.zeros((8, 8)), Levels(4, 300e-9), 500e-6, 4e-3)
    levels = level_map.levels
    frame = draw_frame(
        wafer,
        photomasks_of(levels, (0, 1), "clear", wafer.chrome, wafer.zero_layer),
        level_map,
        splits=splits_of(wafer, levels, (0,) * levels.bits, 1e-9),
        job=Job("A", "A", 500e-6, "0" * 64),
        minimum_line_m=1e-6,
        chrome=Shapes(polygons=tuple(annulus_sectors(2_000_000, 4_000_000, 5))),
        dbu_m=1e-9,
    )
    return plot_wafer(wafer, frame, RoundAperture(4e-3), 1e-9, "plate", ax)


@pytest.mark.slow
def test_every_relief_is_there_and_the_bytes_repeat():
    pictures = (dots_of(plot(Wafer(dies=(3, 3)))), dots_of(plot(Wafer(dies=(2, 2)))))
    grey = [int((np.abs(255 * p - [0x8C, 0x8F, 0x94]).sum(axis=2) < 12).sum()) for p in pictures]
    # Nine discs against four; rims and the frames of dies blur it by a few per cent.
    assert 2.0 < grey[0] / grey[1] < 2.5
    assert png_bytes(plot(Wafer())) == png_bytes(plot(Wafer()))


def test_it_is_whole_also_with_splits_and_on_given_axes():
    split = Wafer(line_splits_m=(1e-7, -1e-7))
    require_whole(plot(split))
    require_place_of_axes(lambda ax: plot(split, ax))
