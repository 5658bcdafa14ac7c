"""Pictures of marks: whole, repeatable, and with the plate hiding what it hides."""

import numpy as np
import pytest
from matplotlib.image import imread

from doedesign.report.marks import draw_part, draw_view
from fab.layout.marks import alignment_site
from fab.layout.part import photomasks_of
from fab.layout.structures import process_monitor
from fab.levels import Levels
from fab.units import NM, UM

LEVELS = Levels(4, 300 * NM)


def share(path, colour: tuple[float, float, float], tolerance: float) -> float:
    pixels = imread(path)[..., :3]
    return float((np.abs(pixels - colour).max(axis=2) < tolerance).mean())


def test_parts_are_drawn_the_same_every_time(tmp_path):
    plates = photomasks_of(LEVELS, (1, 0), "clear", "liftoff", True)
    for name in ("a.png", "b.png"):
        draw_part(tmp_path / name, process_monitor(LEVELS, plates, 2 * UM, NM, 2 * UM), plates, "all masks")
    draw_part(tmp_path / "c.png", alignment_site(plates, NM), plates, "one corner", (0, 0, 1e-3, 1e-3))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    # Square window, square panel: 9 in and the margins at 160 dots per inch.
    assert imread(tmp_path / "c.png").shape[:2] == (round(10.3 * 160), round(9.9 * 160))


@pytest.mark.parametrize(
    ("tone", "dark", "wafer"), [("clear", (0.3, 0.6), (0.03, 0.2)), ("dark", (0.04, 0.3), (0.06, 0.3))]
)
def test_a_dark_field_plate_shows_the_wafer_in_its_windows_only(tmp_path, tone, dark, wafer):
    plates = photomasks_of(LEVELS, (1, 0), tone, "none", False)
    draw_view(tmp_path / "view.png", alignment_site(plates, NM), plates[0], plates[1], "mask 1 over the wafer")
    # The plate's grey over glass, and the colour of mask 2; both are the drawing's own.
    assert dark[0] < share(tmp_path / "view.png", (0.27, 0.275, 0.285), 0.03) < dark[1]
    assert wafer[0] < share(tmp_path / "view.png", (0.835, 0.369, 0.0), 0.03) < wafer[1]
