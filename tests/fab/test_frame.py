"""What lies around a DOE: rasters of dies, sites beside them, labels, and wafers that are too small."""

import klayout.db as kdb
import numpy as np
import pytest

from fab.errors import InputError
from fab.gds.writer import write_gds
from fab.grid import Grid
from fab.layout.frame import BLANK, DIE, RELIEF, WAFER, draw_frame
from fab.layout.geometry import Cell, Layer, Layout, Shapes, box_around, chrome_layer
from fab.layout.lettering import Job
from fab.layout.part import photomasks_of
from fab.layout.polygons import annulus_sectors
from fab.layout.split import splits_of
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.levels import Levels
from tests.fab.parts import region

LEVELS = Levels(16, 75e-9)
MAP = LevelMap(np.zeros((2400, 2400), np.uint8), LEVELS, Grid((2400, 2400), 1.85e-6), 4.44e-3)
DOE = Cell("A_DOE", {Layer(1): Shapes(np.array([[-1000, -1000, 1000, 1000]], np.int32))})


def ring(chrome_m):
    """The chrome around an aperture of three fifths of its diameter."""
    return Shapes(polygons=tuple(annulus_sectors(round(chrome_m * 3e8), round(chrome_m * 5e8), 5)))


def framed(wafer=None, chrome_m=7.4e-3, order=(0, 1, 2, 3)):
    wafer = wafer or Wafer()
    plates = photomasks_of(LEVELS, order, "clear", wafer.chrome, wafer.zero_layer)
    return draw_frame(
        wafer,
        plates,
        MAP,
        splits=splits_of(wafer, LEVELS, (0,) * LEVELS.bits, 1e-9),
        job=Job("A", "A", 1.85e-6, "0" * 64),
        minimum_line_m=1e-6,
        chrome=ring(chrome_m),
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
    assert frame.pitch_m - frame.die_m == pytest.approx(200e-6)
    assert len(boxes(layout, RELIEF.number)) == len(middles)
    assert boxes(layout, BLANK.number) == [(-63500000, -63500000, 63500000, 63500000)]
    (wafer,) = boxes(layout, WAFER.number)
    # A polygon of 180 corners comes within its sagitta of the circle; the flat of 32.5 mm is a chord of it.
    assert wafer[2] == pytest.approx(50e6, rel=2e-4)
    assert wafer[1] == pytest.approx(-np.sqrt(50e6**2 - 16.25e6**2), abs=1)


def test_nothing_of_one_mask_overlaps_and_all_marks_lie_on_the_wafer(tmp_path):
    frame = framed(Wafer(zero_layer=True))
    layout = read_by_klayout(frame, tmp_path / "a.gds")
    for number in (1, 2, 3, 4, 5, 10):
        parts = []
        for datatype in (0, 1, 2, 3):
            region = kdb.Region(layout.top_cell().begin_shapes_rec(layout.layer(number, datatype)))
            region.merged_semantics = False
            parts.append(region)
        assert (parts[0] + parts[1] + parts[2] + parts[3]).merged(False, 2).is_empty()
        for left, bottom, right, top in boxes(layout, number, 1) + boxes(layout, number, 2):
            # But for the marks at the flat, half of which lie outside the wafer.
            at_flat = number == 10 and top < -46.7e6
            assert at_flat or np.hypot(max(-left, right), max(-bottom, top)) < 46e6
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
        ({"pitch_m": 0.0}, "pitch_m: must be positive and below 1 m"),
        ({"pitch_m": float("nan")}, "pitch_m: must be positive and below 1 m"),
        ({"pitch_m": float("inf")}, "pitch_m: must be positive and below 1 m"),
        ({"lane_m": -1e-6}, "lane_m: must lie from 0"),
        ({"edge_exclusion_m": 30e-3}, "edge_exclusion_m: must lie from 0 to 25 mm"),
        ({"blank_m": 101e-3, "edge_exclusion_m": 1e-3}, "leave room for the labels"),
        ({"blank_m": 90e-3}, "must hold the wafer"),
        ({"dies": (0, 3)}, "1 or more rows"),
        ({"dies": (1.5, 3)}, "1 or more rows"),
        ({"chrome": "etched"}, 'chrome: must be "liftoff" or "etch"'),
        ({"chrome": "none"}, 'chrome: must be "liftoff" or "etch"'),
        ({"thickness_m": -1.0}, "positive and below 1 m"),
    ],
)
def test_what_does_not_fit_is_refused(wafer, words):
    with pytest.raises(InputError, match=words):
        framed(Wafer(**wafer))


def test_dies_fill_the_wafer_around_five_monitors():
    """No place of the raster is left empty that is on the wafer and not taken."""
    frame = framed()
    assert len(frame.dies) == 39
    assert len(frame.plan.monitors) == 5
    taken = {*frame.dies, *frame.plan.monitors.values()}
    pitch, half = frame.pitch_m, frame.die_m / 2
    for x in np.arange(-5, 6) * pitch:
        for y in np.arange(-5, 6) * pitch:
            on_wafer = np.hypot(abs(x) + half, abs(y) + half) <= 46e-3 and y - half > -43.2e-3
            free = on_wafer and not np.any(np.all(np.isclose([*taken], (x, y)), axis=1))
            # Beside the dies lie the alignment sites alone, on the x axis.
            assert not free or (y == 0 and abs(x) > 25e-3)
    reach = [np.hypot(*at) for at in frame.plan.monitors.values()]
    assert min(reach) == 0
    assert sorted(reach)[1] > 0.5 * 46e-3


@pytest.mark.parametrize("wafer", [Wafer(), Wafer(dies=(3, 3)), Wafer(zero_layer=True, chrome="etch", dies=(1, 2))])
def test_nothing_lies_on_anything_else(wafer):
    """Boxes of dies, alignment sites and monitors, 0.2 mm apart unless they are dies."""
    frame = framed(wafer)
    cells = {cell.name: cell for cell in frame.cells}
    boxes = []
    for one in cells["A_WAFER"].references:
        box = box_around(shapes.box for shapes in cells[one.cell].shapes.values() if shapes.box)
        assert box is not None
        boxes.append((box[0] + one.x, box[1] + one.y, box[2] + one.x, box[3] + one.y))
    for number, (x0, y0, x1, y1) in enumerate(boxes):
        for u0, v0, u1, v1 in boxes[number + 1 :]:
            assert x1 <= u0 or u1 <= x0 or y1 <= v0 or v1 <= y0


def test_chrome_reaches_the_edges_of_the_die_but_not_its_marks():
    level = chrome_layer(LEVELS)
    frame = framed()
    die = next(cell for cell in frame.cells if cell.name == "A_DIE")
    around = region(die, level)
    assert around.merged(False, 2).is_empty()
    edge = round(frame.die_m * 5e8)
    whole = kdb.Region(kdb.Box(-edge, -edge, edge, edge))
    assert (around - whole).is_empty()
    disc = kdb.Region(kdb.Polygon([kdb.Point(*p) for s in ring(7.4e-3).polygons for p in s[: len(s) // 2].tolist()]))
    assert (around & disc.merged()).is_empty()
    bare = whole - around - disc
    marks = [layer for layer in die.shapes if layer.datatype in (1, 3)]
    drawn = kdb.Region()
    for layer in marks:
        drawn += region(die, layer)
    inside = drawn & whole
    assert (inside - bare).is_empty()
    # Nothing but the marks' own box and 20 um around it is bare.
    box = inside.bbox()
    assert (bare - kdb.Region(box.enlarged(20_000, 20_000))).is_empty()
    plain = next(cell for cell in framed(Wafer(chrome_to_edge=False)).cells if cell.name == "A_DIE")
    assert level not in plain.shapes


def test_angles_stand_in_the_saw_lanes_at_every_corner_of_a_die():
    frame = framed()
    die = next(cell for cell in frame.cells if cell.name == "A_DIE")
    edge, pitch = round(frame.die_m * 5e8), round(frame.pitch_m * 5e8)
    drawn = region(die, Layer(1, 1))
    lane = kdb.Region(kdb.Box(-pitch, -pitch, pitch, pitch)) - kdb.Region(kdb.Box(-edge, -edge, edge, edge))
    angles = (drawn & lane).merged()
    assert angles.count() == 4
    assert angles.area() == 4 * (230 * 20 + 210 * 20) * 10**6
    none = next(cell for cell in framed(Wafer(lane_m=50e-6)).cells if cell.name == "A_DIE")
    edge = round(edge + 75e3)
    assert (region(none, Layer(1, 1)) - kdb.Region(kdb.Box(-edge, -edge, edge, edge))).is_empty()


@pytest.mark.parametrize(("diameter_m", "kind", "count"), [(0.1, "flat", 4), (0.2, "notch", 2), (0.06, "", 0)])
def test_the_first_photomask_shows_where_the_flat_or_the_notch_belongs(diameter_m, kind, count):
    frame = framed(Wafer(diameter_m=diameter_m, blank_m=diameter_m + 27e-3), chrome_m=4e-3, order=(2, 0, 1, 3))
    top = frame.cells[-1]
    marks = {layer: shapes for layer, shapes in top.shapes.items() if layer.datatype == 1}
    assert sum(len(shapes) for shapes in marks.values()) == count
    assert {layer.number for layer in marks} <= {3}
    assert any(name.startswith(kind) for name in frame.places) if kind else not marks
    if kind == "notch":
        assert [at for name, at in frame.places.items() if name.startswith("notch")] == [(0.0, -0.1)]
        boxes = marks[Layer(3, 1)].rectangles
        assert (boxes[:, 3] < -100e6).all()  # beyond the rim, to both sides of the notch
        assert sorted(np.sign(boxes[:, 0]).tolist()) == [-1, 1]
    if kind == "flat":
        y = -round(np.sqrt(50e6**2 - 16.25e6**2))
        gaps = sorted(box[3] if box[1] < y else box[1] for box in marks[Layer(3, 1)].rectangles.tolist())
        assert gaps == [y - 50_000] * 2 + [y + 50_000] * 2


def test_no_die_lies_over_the_notch():
    frame = framed(Wafer(diameter_m=0.2, blank_m=0.2286, edge_exclusion_m=0.0, pitch_m=6.87e-3), chrome_m=4e-3)
    lowest = [(x, y - frame.die_m / 2) for x, y in frame.dies if abs(x) < frame.die_m / 2 + 1e-3]
    assert -0.099 <= min(y for _, y in lowest) < -0.092


def test_marks_at_the_notch_are_as_long_as_the_blank_has_room():
    def lengths(blank_m):
        wafer = Wafer(diameter_m=0.2, blank_m=blank_m)
        shapes = framed(wafer, chrome_m=4e-3).cells[-1].shapes
        drawn = next(drawn.rectangles for layer, drawn in shapes.items() if layer.datatype == 1)
        assert (drawn[:, 1] >= -round((blank_m / 2 - 1e-3) * 1e9)).all()
        return (drawn[:, 3] - drawn[:, 1]).tolist()

    assert lengths(0.2286) == [3_000_000] * 2
    # Of 8 inches: 1.6 mm below the wafer, less half the gap and the rim of 1 mm that holds nothing.
    assert lengths(0.2032) == [550_000] * 2
    with pytest.raises(InputError, match="below the notch for marks, but got 203 mm"):
        lengths(0.203)


def test_splits_are_repeated_all_over_the_wafer():
    frame = framed(Wafer(line_splits_m=(1e-7, -1e-7), order_control=True))
    for number in (1, 2, 3):
        places = np.array([die for die, drawn in zip(frame.dies, frame.splits, strict=True) if drawn == number])
        assert len(places) == 5
        assert np.all(np.ptp(places, axis=0) > 35e-3)
    assert frame.splits.count(0) > len(frame.dies) / 2
    assert frame.splits[frame.dies.index(min(frame.dies, key=lambda die: np.hypot(*die)))] == 0


def test_large_dies_leave_their_place_to_no_monitor():
    """Of 24 mm six fit on 100 mm, of 40 mm two; of very large ones there is none."""
    assert [len(framed(chrome_m=size).dies) for size in (21e-3, 37e-3)] == [6, 2]
    assert len(framed(chrome_m=21e-3).plan.monitors) == 5
    with pytest.raises(InputError, match=r"as many dies as fit.*Take a larger wafer"):
        framed(chrome_m=80e-3)
    with pytest.raises(InputError, match="1 of 1 dies"):
        framed(Wafer(dies=(1, 1), order_control=True), chrome_m=37e-3)
