"""Pictures of marks: whole, repeatable, and with the plate hiding what it hides."""

import numpy as np
import pytest

from fab.figure import png_bytes
from fab.layout.marks import alignment_site
from fab.layout.part import photomasks_of
from fab.layout.structures import process_monitor
from fab.levels import Levels
from fab.plots.marks import plot_part, plot_through_mask
from fab.units import NM, UM
from tests.pictures import dots_of, require_place_of_axes, require_whole

LEVELS = Levels(4, 300 * NM)


def share(drawn, colour: tuple[float, float, float], tolerance: float) -> float:
    return float((np.abs(dots_of(drawn) - colour).max(axis=2) < tolerance).mean())


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


@pytest.mark.parametrize(
    ("tone", "dark", "wafer"), [("clear", (0.3, 0.6), (0.03, 0.2)), ("dark", (0.04, 0.3), (0.06, 0.3))]
)
def test_a_dark_field_plate_shows_the_wafer_in_its_windows_only(tone, dark, wafer):
    plates = photomasks_of(LEVELS, (1, 0), tone, "none", False)
    drawn = plot_through_mask(alignment_site(plates, NM), plates[0], plates[1], "mask 1 over the wafer")
    require_whole(drawn)
    # The plate's grey over glass, and the colour of mask 2; both are the drawing's own.
    assert dark[0] < share(drawn, (0.27, 0.275, 0.285), 0.03) < dark[1]
    assert wafer[0] < share(drawn, (0.835, 0.369, 0.0), 0.03) < wafer[1]
