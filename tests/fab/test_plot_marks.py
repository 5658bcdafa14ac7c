"""Pictures of marks: whole and repeatable."""

import pytest

from fab.figure import png_bytes
from fab.layout.marks import alignment_site
from fab.layout.part import photomasks_of
from fab.layout.structures import process_monitor
from fab.levels import Levels
from fab.plots.marks import plot_part
from fab.units import NM, UM
from tests.pictures import require_place_of_axes, require_whole

LEVELS = Levels(4, 300 * NM)


def test_parts_are_drawn_the_same_every_time():
    plates = photomasks_of(LEVELS, (1, 0), "clear", "liftoff", True)
    monitor = process_monitor(LEVELS, plates, 2 * UM, NM, 2 * UM)
    first = png_bytes(plot_part(monitor, plates, "all masks"))
    assert first == png_bytes(plot_part(monitor, plates, "all masks"))
    require_whole(plot_part(monitor, plates, "all masks"))
    corner = plot_part(alignment_site(plates, NM), plates, "one corner", (0, 0, 1e-3, 1e-3))
    require_whole(corner)
    box = corner.get_window_extent()
    # Square window, square panel: about 9 in at 160 dots per inch.
    assert box.width == pytest.approx(box.height)
    assert box.width == pytest.approx(9 * 160, rel=0.05)
    require_place_of_axes(lambda ax: plot_part(monitor, plates, "all masks", ax=ax))
