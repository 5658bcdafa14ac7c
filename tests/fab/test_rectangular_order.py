"""An order whose chrome has a rectangular opening: drawn, read back by other libraries, and proved."""

import json
import math
import shutil
from dataclasses import replace
from typing import Any

import gdstk
import numpy as np
import pytest
from klayout import db

from fab.aperture import RectangularAperture
from fab.errors import InputError
from fab.gds.reader import read_gds
from fab.gds.writer import write_gds
from fab.grid import Grid
from fab.layout.geometry import Chrome, Layer, Shapes
from fab.layout.polygons import MAX_VERTICES, frame_around_box, sectors_around_square
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.manifest.records import read_manifest
from fab.order.drawing import draw
from fab.order.order import plan_order
from fab.order.verify import verify
from fab.order.write import write_planned
from fab.runsheet.as_built import read_as_built
from fab.solids.step import step_bodies
from fab.verification.shop_checks import drawing_problems
from tests.fab.maps import FEW, PLAIN
from tests.fab.mended import mend, restate, told
from tests.fab.parts import chrome_of_dies, marks_window_um

UM, MM = 1e-6, 1e-3
LEVELS = Levels(4, 0.3e-6)
GRID = Grid((30, 40), 2 * UM)
RELIEF = RectangularAperture((60 * UM, 80 * UM))
OPENING_UM = (70.0, 50.0)  # less twice the overlap of 5 um


def slit() -> LevelMap:
    level = np.random.default_rng(5).integers(0, 4, GRID.shape).astype(np.uint8)
    return LevelMap(level, LEVELS, GRID, RELIEF, "slit")


@pytest.fixture(scope="session")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("orders") / "slit"
    write_planned(folder, plan_order(slit(), wafer=FEW, formats=PLAIN, papers=True))
    return folder


def hole_of(region):
    """The one hole of a region without overlaps."""
    (merged,) = region.merged().each()
    assert merged.holes() == 1
    return db.Polygon(list(merged.each_point_hole(0)))


@pytest.mark.parametrize(
    ("half_x", "half_y", "outer", "chord"),
    [(35_000, 25_000, 600_000, 5), (100, 100, 200, 1), (90_001, 7, 150_003, 0.5), (3, 2_000_000, 3_500_000, 5)],
)
def test_sectors_around_a_rectangle_leave_exactly_it(half_x, half_y, outer, chord):
    half = max(half_x, half_y) + 3
    sectors = sectors_around_square(half, outer, chord)
    assert len(sectors) % 4 == 0
    sectors += frame_around_box(half_x, half_y, half)
    assert max(map(len, sectors)) <= MAX_VERTICES
    region = db.Region()
    region.merged_semantics = False
    for sector in sectors:
        region.insert(db.Polygon([db.Point(*vertex) for vertex in sector.tolist()]))
    (whole,) = region.merged().each()
    assert Shapes(polygons=tuple(sectors)).doubled_area == whole.area2()  # no overlap
    assert hole_of(region) == db.Polygon(db.Box(-half_x, -half_y, half_x, half_y))
    circle = math.pi * outer**2
    assert region.area() + 4 * half_x * half_y == pytest.approx(circle, abs=2 * math.pi * outer * (chord + 1))
    with pytest.raises(ValueError, match="around the square"):
        sectors_around_square(half, math.floor(math.hypot(half, half)), chord)


REACH_M = math.sqrt(2) * (35 * UM + 100 * UM)  # of the corners of the frame


@pytest.mark.parametrize(
    ("outer_m", "chord_error_m"),
    [(1.0001 * REACH_M, 5e-9), (1.001 * REACH_M, 5e-9), (REACH_M + 14e-9, 5e-9), (1.06 * REACH_M, 1e-5)],
)
def test_chrome_that_ends_near_its_frame_reaches_the_edges_of_the_die(outer_m, chord_error_m):
    order = plan_order(slit(), chrome=Chrome(outer_m=outer_m, chord_error_m=chord_error_m), wafer=FEW)
    drawn = draw(order)
    assert list(drawing_problems(drawn.layout, order.wafer.blank_m)) == []
    (die,) = (cell for cell in drawn.layout.cells if cell.name == f"{order.stem}_DIE")
    around, doe = (next(s for layer, s in c.shapes.items() if layer == Layer(5)) for c in (die, drawn.does[0]))
    area_m2 = (around.doubled_area + doe.doubled_area) / 2 * order.dbu_m**2
    bare_m2 = sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in drawn.frame.bare_m)
    opening_m2 = OPENING_UM[0] * OPENING_UM[1] * UM**2
    assert area_m2 == pytest.approx(drawn.frame.die_m**2 - opening_m2 - bare_m2, abs=1e-15)


def test_chrome_that_ends_at_its_frame_is_refused():
    with pytest.raises(InputError, match="chrome outer radius: must exceed what the opening needs"):
        plan_order(slit(), chrome=Chrome(outer_m=REACH_M + 9e-9)).chrome.rim_m(slit())


def test_another_library_sees_the_rectangle_where_it_should_be(written):
    chrome = read_manifest(written).chrome
    assert chrome.opening_diameter_mm == [0.07, 0.05]
    library = gdstk.read_gds(str(written / chrome.file))
    cells: list[Any] = library.cells
    (cell,) = (cell for cell in cells if cell.name == read_manifest(written).doe_cell)
    outer = gdstk.ellipse((0, 0), chrome.outer_diameter_mm / 2 * 1e3, tolerance=1e-5)
    drawn = [polygon for polygon in cell.polygons if polygon.layer == chrome.layer]
    (opening,) = gdstk.boolean(gdstk.rectangle((-200, -200), (200, 200)), drawn, "not", precision=1e-4)
    assert opening.area() == pytest.approx(OPENING_UM[0] * OPENING_UM[1], rel=1e-9)
    np.testing.assert_allclose(opening.bounding_box(), [(-35, -25), (35, 25)], atol=1e-9)
    area = sum(polygon.area() for polygon in drawn)
    # Chords leave the circle by up to 5 nm.
    assert area == pytest.approx(outer.area() - 3500, abs=2 * math.pi * 600 * 5e-3)
    assert chrome.area_um2 == pytest.approx(area, rel=1e-9)


def test_no_chrome_of_a_die_lies_in_its_opening(written):
    """All of the die counts: that around the DOE, and that from there to the edges of the die."""
    for drawn in chrome_of_dies(written):
        around = gdstk.rectangle((-560, -560), (560, 560))  # its corners lie beyond the outer circle
        (opening,) = gdstk.boolean(around, drawn, "not", precision=1e-4)
        assert opening.area() == pytest.approx(OPENING_UM[0] * OPENING_UM[1], rel=1e-6)


def test_the_order_is_proved_from_its_files_and_its_request(written):
    report = verify(written)
    assert report.differences == ()
    manifest = read_manifest(written)
    assert manifest.aperture_mm == [0.08, 0.06]
    assert manifest.relief.extent_m == pytest.approx(RELIEF.extent_m, rel=1e-12)
    assert manifest.request["level_map"]["aperture_m"] == [80 * UM, 60 * UM]


def test_solids_have_the_volumes_of_the_rectangle(written):
    manifest = read_manifest(written)
    plate = next(written.glob("*_PLATE.step"))
    bodies = step_bodies(plate)
    x0, y0, x1, y1 = marks_window_um(written)
    wanted = (manifest.wafer.die_mm**2 - 0.07 * 0.05 - (x1 - x0) * (y1 - y0) * 1e-6) * 1e-4
    assert bodies["CHROME"].volume_m3 / MM**3 == pytest.approx(wanted, rel=1e-9)
    wafer = step_bodies(next(written.glob("*_WAFER.step")))
    assert wafer["CHROME"].volume_m3 / MM**3 == pytest.approx(9 * wanted, rel=1e-9)
    text = plate.read_text()
    # The outline of the relief, a face of its own on the surface.
    assert text.count("'DATUM_RELIEF'") > 0
    assert "CYLINDRICAL_SURFACE" not in text  # of a ring


def test_the_run_sheet_asks_for_width_and_height(written, tmp_path):
    sheet = json.loads(next(written.glob("*_RUNSHEET.json")).read_text())
    assert sheet["opening_um"] == [70.0, 50.0]
    assert {"opening_width_um", "opening_height_um"} <= sheet["measured"]["chrome"].keys()
    assert "width and height; target 70.0 and 50.0" in next(written.glob("*_RUNSHEET.html")).read_text()
    sheet["measured"]["chrome"] |= {"opening_width_um": 70.6, "opening_height_um": 50.2}
    filled = tmp_path / "filled.json"
    filled.write_text(json.dumps(sheet))
    # One number of the model is how much wider and higher the opening is: their mean.
    assert read_as_built(filled, slit()).chrome.wider_m == pytest.approx(0.4 * UM)
    sheet["measured"]["chrome"]["opening_height_um"] = 0.05
    filled.write_text(json.dumps(sheet))
    with pytest.raises(InputError, match="that it is the height"):
        read_as_built(filled, slit())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: np.where(p == 35_000, 34_000, p), "leaves its outline by 1e+03 nm"),
        (lambda p: np.where(p == -25_000, -25_001, p), "lie on neither of the two outlines"),
        (lambda p: p[~np.all(np.abs(p) == [35_000, 25_000], axis=1)], "leaves its outline by"),
    ],
    ids=["narrower", "a unit higher", "without corners"],
)
def test_a_forged_opening_is_refused(written, tmp_path, change, words):
    folder = shutil.copytree(written, tmp_path / "order")
    manifest = read_manifest(folder)
    path, layer = folder / manifest.chrome.file, Layer(manifest.chrome.layer)
    layout = read_gds(path)

    def forged(cell):
        if cell.name != manifest.doe_cell:
            return cell
        polygons = tuple(change(polygon).astype(np.int32) for polygon in cell.shapes[layer].polygons)
        return replace(cell, shapes={**cell.shapes, layer: Shapes(polygons=polygons)})

    write_gds(path, replace(layout, cells=tuple(map(forged, layout.cells))))
    mend(folder, path.name)
    assert words in told(folder, path.name)


def test_a_manifest_that_states_another_opening_is_refused(written, tmp_path):
    folder = shutil.copytree(written, tmp_path / "order")
    restate(folder, lambda m: replace(m, chrome=replace(m.chrome, opening_diameter_mm=[0.08, 0.06])))
    assert any("opening_diameter_mm" in difference for difference in verify(folder).differences)
