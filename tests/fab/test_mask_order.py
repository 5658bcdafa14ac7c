"""An order whose chrome has the opening of a mask: drawn, read back by other libraries, and proved."""

import json
import math
import shutil
from dataclasses import replace
from typing import Any

import gdstk
import numpy as np
import pytest
from klayout import db

from fab.aperture import MaskAperture
from fab.gds.reader import read_gds
from fab.gds.writer import write_gds
from fab.grid import Grid
from fab.layout.frame import RELIEF
from fab.layout.geometry import Layer, Shapes
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.manifest.records import read_manifest
from fab.order.order import plan_order
from fab.order.verify import verify
from fab.order.write import write_planned
from fab.solids.step import step_bodies
from tests.fab.maps import FEW, PLAIN
from tests.fab.mended import mend, restate, told
from tests.fab.parts import chrome_of_dies, marks_window_um

UM = 1e-6
GRID = Grid((30, 40), 2 * UM)
OVERLAP_UM = 5.0  # of chrome over every edge

# Boxes in micrometres, x0, y0, x1, y1, about the middle of the plate, each a whole number of cells: a block with an
# island, a tower that leaves the middle aside, and what closes under the overlap.
OPEN = [(-36, -26, 20, 14), (20, -26, 36, 28)]
ISLAND = (-20, -14, -8, 2)
NARROW = (-36, 18, -16, 26)
# The block and the tower are one area of which every edge lies 5 um further in; around the island, further out.
LEFT_OPEN = [(-31, -21, 31, 9), (25, 9, 31, 23)]
LEFT_ISLAND = (-25, -19, -3, 7)
AREA_UM2 = 62 * 30 + 6 * 14 - 22 * 26


def cells_of(boxes: list[tuple[int, int, int, int]]) -> np.ndarray:
    plane = np.zeros(GRID.shape, bool)
    for x0, y0, x1, y1 in boxes:
        plane[(y0 + 30) // 2 : (y1 + 30) // 2, (x0 + 40) // 2 : (x1 + 40) // 2] = True
    return plane


MASK = MaskAperture.of(cells_of([*OPEN, NARROW]) & ~cells_of([ISLAND]), GRID.pitch_m)


def stencil() -> LevelMap:
    level = np.random.default_rng(5).integers(0, 4, GRID.shape).astype(np.uint8)
    return LevelMap(level, Levels(4, 0.3e-6), GRID, MASK, "stencil")


@pytest.fixture(scope="session")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("orders") / "stencil"
    write_planned(folder, plan_order(stencil(), wafer=FEW, formats=PLAIN, papers=True))
    return folder


def wanted_opening() -> db.Region:
    """In nanometres."""
    block, tower, island = (db.Region(db.Box(*(1000 * at for at in box))) for box in (*LEFT_OPEN, LEFT_ISLAND))
    return block + tower - island


def region(polygons) -> db.Region:
    """Polygons of gdstk, micrometres."""
    found = db.Region()
    for polygon in polygons:
        found.insert(db.Polygon([db.Point(*np.rint(at * 1000).astype(int).tolist()) for at in polygon.points]))
    return found


def test_another_library_sees_the_mask_where_it_should_be(written):
    chrome = read_manifest(written).chrome
    cells: list[Any] = gdstk.read_gds(str(written / chrome.file)).cells
    (cell,) = (cell for cell in cells if cell.name == read_manifest(written).doe_cell)
    drawn = [polygon for polygon in cell.polygons if polygon.layer == chrome.layer]
    whole = region(drawn)
    around = db.Region(db.Box(-200_000, -200_000, 200_000, 200_000))
    assert (around - whole ^ wanted_opening()).is_empty()
    # No piece of chrome lies on another.
    assert sum(polygon.area() for polygon in drawn) == pytest.approx(whole.merged().area() * 1e-6, rel=1e-12)
    outer_um = chrome.outer_diameter_mm / 2 * 1e3
    # Chords leave the circle by up to 5 nm.
    assert chrome.area_um2 == pytest.approx(math.pi * outer_um**2 - AREA_UM2, abs=2 * math.pi * outer_um * 5e-3)
    assert chrome.area_um2 == pytest.approx(sum(polygon.area() for polygon in drawn), rel=1e-9)


def test_klayout_reads_the_same(written):
    manifest = read_manifest(written)
    layout = db.Layout()
    layout.read(str(written / manifest.combined_oasis))
    layer = layout.layer(manifest.chrome.layer, manifest.chrome.datatype)
    cell = layout.cell(manifest.doe_cell)
    found = db.Region(cell.begin_shapes_rec(layer))
    around = db.Region(db.Box(-200_000, -200_000, 200_000, 200_000))
    assert (around - found ^ wanted_opening()).is_empty()


def test_no_chrome_of_a_die_lies_in_its_opening(written):
    """All of the die counts: that around the DOE, and that from there to the edges of the die."""
    for drawn in chrome_of_dies(written):
        around = db.Region(db.Box(-560_000, -560_000, 560_000, 560_000))  # its corners lie beyond the outer circle
        assert (around - region(drawn) ^ wanted_opening()).is_empty()


def test_the_order_is_proved_from_its_files_and_its_request(written):
    assert verify(written).differences == ()
    manifest = read_manifest(written)
    assert manifest.relief == MASK
    assert manifest.chrome.opening_diameter_mm == {**MASK.record(1e-3, 9), "inset": 0.005}
    assert manifest.request["level_map"]["aperture_m"] == MASK.record()
    # The relief is drawn for people, in cells.
    layout = db.Layout()
    layout.read(str(written / manifest.combined_oasis))
    die = next(cell for cell in layout.each_cell() if cell.name.endswith("_DIE"))
    relief = db.Region(die.shapes(layout.layer(RELIEF.number, RELIEF.datatype)))
    assert relief.merged().area() * 1e-6 == pytest.approx(MASK.area_m2 / UM**2)


def test_solids_have_the_volumes_and_the_centres_of_the_mask(written):
    manifest = read_manifest(written)
    plate, wafer = (step_bodies(next(written.glob(f"*_{name}.step"))) for name in ("PLATE", "WAFER"))
    window = marks_window_um(written)
    bare = (window[2] - window[0]) * (window[3] - window[1])
    area = (manifest.wafer.die_mm * 1e3) ** 2 - AREA_UM2 - bare
    wanted = area * 0.1 * 1e-9  # mm3
    assert plate["CHROME"].volume_m3 * 1e9 == pytest.approx(wanted, rel=1e-9)
    assert wafer["CHROME"].volume_m3 * 1e9 == pytest.approx(9 * wanted, rel=1e-9)
    # Sums of x and y over the open area, box by box; the chrome's centre lies on the other side.
    boxes = [(*LEFT_OPEN[0], 1), (*LEFT_OPEN[1], 1), (*LEFT_ISLAND, -1), (*window, 1)]
    sums = [
        sum(sign * (x1 - x0) * (y1 - y0) * at for x0, y0, x1, y1, sign in boxes for at in [middle(x0, y0, x1, y1)])
        for middle in (lambda x0, y0, x1, y1: (x0 + x1) / 2, lambda x0, y0, x1, y1: (y0 + y1) / 2)
    ]
    centre = [-one / area * UM for one in sums]
    assert plate["CHROME"].centre_m[:2] == pytest.approx(centre, abs=1e-12)


def test_outlines_that_meet_leave_the_solids_out_and_say_so(tmp_path, caplog):
    plane = np.zeros(GRID.shape, bool)
    plane[4:15, 4:20] = plane[15:26, 20:36] = True
    level_map = replace(stencil(), aperture=MaskAperture.of(plane, GRID.pitch_m))
    write_planned(tmp_path / "order", plan_order(level_map, wafer=FEW, formats=PLAIN, papers=False))
    assert not list((tmp_path / "order").glob("*.step"))
    assert list((tmp_path / "order").glob("*.stl"))
    assert "no STEP files of this plate" in caplog.text
    assert verify(tmp_path / "order").differences == ()


def test_the_run_sheet_asks_for_width_and_height(written):
    sheet = json.loads(next(written.glob("*_RUNSHEET.json")).read_text())
    assert (sheet["aperture_mm"], sheet["opening_um"]) == ([0.072, 0.054], [62.0, 44.0])
    text = next(written.glob("*_RUNSHEET.html")).read_text()
    assert "over 0.072 x 0.054 mm" in text
    assert "width and height; target 62.0 and 44.0" in text


def shifted(shapes: Shapes) -> Shapes:
    """A rectangle that ends at the left side of the opening, a unit further in."""
    boxes = shapes.rectangles.copy()
    boxes[np.flatnonzero(boxes[:, 2] == -31_000)[0], 2] += 1
    return Shapes(boxes, shapes.polygons)


def covered(shapes: Shapes) -> Shapes:
    """The island, moved a cell to the right."""
    boxes = shapes.rectangles.copy()
    island = np.flatnonzero((boxes == np.array(LEFT_ISLAND) * 1000).all(axis=1))
    assert len(island) == 1
    boxes[island] += [28_000, 0, 28_000, 0]
    return Shapes(boxes, shapes.polygons)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (shifted, "1 rectangles in the chrome are off the edges of the opening"),
        (covered, "cells of the opening are covered by chrome"),
        (
            lambda s: Shapes(s.rectangles[[0, *range(len(s.rectangles) - 1)]], s.polygons),
            "cells around the opening are not covered",
        ),
        (lambda s: Shapes(s.rectangles[1:], s.polygons), "chrome polygons instead of"),
        (lambda s: Shapes(s.rectangles, (*s.polygons[1:], s.polygons[0][:-1])), "lies|leaves|chrome"),
    ],
    ids=["a unit", "island", "twice", "missing", "corner"],
)
def test_a_forged_opening_is_refused(written, tmp_path, change, words):
    folder = shutil.copytree(written, tmp_path / "order")
    manifest = read_manifest(folder)
    path, layer = folder / manifest.chrome.file, Layer(manifest.chrome.layer)
    layout = read_gds(path)
    cells = [
        replace(cell, shapes={**cell.shapes, layer: change(cell.shapes[layer])})
        if cell.name == manifest.doe_cell
        else cell
        for cell in layout.cells
    ]
    write_gds(path, replace(layout, cells=tuple(cells)))
    mend(folder, path.name)
    assert any(word in told(folder, path.name) for word in words.split("|"))


def test_a_manifest_that_states_another_opening_is_refused(written, tmp_path):
    folder = shutil.copytree(written, tmp_path / "order")
    other = MaskAperture.of(np.ones(GRID.shape, bool), GRID.pitch_m).record(1e-3, 9)
    restate(folder, lambda m: replace(m, chrome=replace(m.chrome, opening_diameter_mm=other)))
    assert any("opening_diameter_mm" in difference for difference in verify(folder).differences)


@pytest.mark.parametrize("key", ["aperture_mm", "opening"])
def test_a_manifest_with_a_damaged_mask_is_refused_by_its_name(written, tmp_path, key):
    folder = shutil.copytree(written, tmp_path / "order")
    wrong = {**MASK.record(1e-3, 9), "rows": [[10**9, 0, 40]]}

    def damage(manifest):
        if key == "aperture_mm":
            return replace(manifest, aperture_mm=wrong)
        return replace(manifest, chrome=replace(manifest.chrome, opening_diameter_mm=wrong))

    restate(folder, damage)
    with pytest.raises(Exception, match=r"manifest\.json.*rows of a mask") as error:
        read_manifest(folder)
    assert type(error.value).__name__ == "InputError"
