"""What lies around a DOE: rasters of dies, sites beside them, labels, and wafers that are too small."""

import klayout.db as kdb
import numpy as np
import pytest

from fab.errors import InputError
from fab.gds.writer import write_gds
from fab.grid import Grid
from fab.layout.frame import BLANK, DIE, RELIEF, WAFER, draw_frame
from fab.layout.geometry import Cell, Layer, Layout, Shapes
from fab.layout.part import photomasks_of
from fab.layout.split import splits_of
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.levels import Levels

LEVELS = Levels(16, 75e-9)
MAP = LevelMap(np.zeros((2400, 2400), np.uint8), LEVELS, Grid((2400, 2400), 1.85e-6), 4.44e-3)
DOE = Cell("A_DOE", {Layer(1): Shapes(np.array([[-1000, -1000, 1000, 1000]], np.int32))})


def framed(wafer=None, chrome_m=7.4e-3, order=(0, 1, 2, 3)):
    wafer = wafer or Wafer()
    plates = photomasks_of(LEVELS, order, "clear", wafer.chrome, wafer.zero_layer)
    return draw_frame(
        wafer,
        plates,
        MAP,
        splits=splits_of(wafer, LEVELS, (0,) * LEVELS.bits, 1e-9),
        stem="A",
        minimum_line_m=1e-6,
        chrome_m=chrome_m,
        dbu_m=1e-9,
    )


def read_by_klayout(frame, path):
    write_gds(path, Layout(1e-9, (DOE, *frame.cells)))
    layout = kdb.Layout()
    layout.read(str(path))
    return layout


def boxes(layout, number, datatype=0):
    region = kdb.Region(layout.top_cell().begin_shapes_rec(layout.layer(number, datatype)))
    return sorted((b.left, b.bottom, b.right, b.top) for b in (p.bbox() for p in region.each()))


@pytest.mark.parametrize("dies", [(1, 1), (2, 3), (3, 2), (1, 4)])
def test_doe_and_die_come_where_they_are_said_to_be(tmp_path, dies):
    frame = framed(Wafer(dies=dies))
    layout = read_by_klayout(frame, tmp_path / "a.gds")
    assert layout.top_cell().name == "A"
    middles = sorted((round(x * 1e9), round(y * 1e9)) for x, y in frame.dies)
    assert len(middles) == dies[0] * dies[1]
    assert np.allclose(np.mean(middles, axis=0), 0, atol=1)
    does = [box for box in boxes(layout, 1) if box[2] - box[0] == 2000]
    assert [(x0 + 1000, y0 + 1000) for x0, y0, _, _ in does] == middles
    found = boxes(layout, DIE.number)
    assert [((x0 + x1) // 2, (y0 + y1) // 2) for x0, y0, x1, y1 in found] == middles
    assert {x1 - x0 for x0, _, x1, _ in found} == {round(frame.die_m * 1e9)}
    assert len(boxes(layout, RELIEF.number)) == len(middles)
    assert boxes(layout, BLANK.number) == [(-63500000, -63500000, 63500000, 63500000)]
    (wafer,) = boxes(layout, WAFER.number)
    # A polygon of 180 corners comes within its sagitta of the circle.
    assert wafer[2] == pytest.approx(50e6, rel=2e-4)


def test_nothing_of_one_mask_overlaps_and_all_marks_lie_on_the_wafer(tmp_path):
    frame = framed(Wafer(zero_layer=True))
    layout = read_by_klayout(frame, tmp_path / "a.gds")
    for number in (1, 2, 3, 4, 5, 10):
        parts = []
        for datatype in (0, 1, 2, 3):
            region = kdb.Region(layout.top_cell().begin_shapes_rec(layout.layer(number, datatype)))
            region.merged_semantics = False
            parts.append(region)
        area = sum(part.area() for part in parts)
        whole = parts[0] + parts[1] + parts[2] + parts[3]
        assert whole.merged().area() == area
        for left, bottom, right, top in boxes(layout, number, 1) + boxes(layout, number, 2):
            assert np.hypot(max(-left, right), max(-bottom, top)) < 46e6
        # Labels stand on the blank, beside the wafer.
        (corner,) = {min(b[1] for b in boxes(layout, number, 3) if b[1] > 40e6)}
        assert corner > 50e6


def test_measurement_places_lie_where_the_marks_are(tmp_path):
    frame = framed()
    layout = read_by_klayout(frame, tmp_path / "a.gds")
    names = [name for name in frame.places if "box 5 um, mask 3" in name]
    assert {name.partition(":")[0] for name in names} == {"left site", "right site", "middle die"}
    # Mask 3 is dark field: its window around the wafer's frame is clear, and the square in its middle is not.
    drawn = kdb.Region(layout.top_cell().begin_shapes_rec(layout.layer(3, 1))).merged()
    for name in names:
        x, y = (round(v * 1e9) for v in frame.places[name])
        spot = kdb.Region(kdb.Box(x - 100, y - 100, x + 100, y + 100))
        assert (drawn & spot).is_empty()
        around = kdb.Region(kdb.Box(x - 40000, y - 40000, x + 40000, y + 40000))
        assert not (drawn & around).is_empty()


@pytest.mark.parametrize(
    ("wafer", "words"),
    [
        ({"dies": (20, 20)}, "Take fewer dies"),
        ({"diameter_m": 20e-3}, "two alignment sites and the test structures"),
        ({"pitch_m": 2e-3}, r"must be 9\.\d+ mm or more"),
        ({"blank_m": 90e-3}, "must hold the wafer"),
        ({"dies": (0, 3)}, "1 or more rows"),
        ({"thickness_m": -1.0}, "positive and below 1 m"),
    ],
)
def test_what_does_not_fit_is_refused(wafer, words):
    with pytest.raises(InputError, match=words):
        framed(Wafer(**wafer))


def test_a_large_die_gets_as_many_places_as_there_are():
    """Dies of 10 mm lie in threes on 100 mm, larger ones in twos; of very large ones there is one, or none."""
    assert [framed(chrome_m=size).raster for size in (7.4e-3, 21e-3, 37e-3)] == [(3, 3), (2, 2), (1, 1)]
    with pytest.raises(InputError, match=r"1 x 1 dies.*Take a larger wafer"):
        framed(chrome_m=80e-3)
    with pytest.raises(InputError, match="1 of 1 dies"):
        framed(Wafer(order_control=True), chrome_m=37e-3)
