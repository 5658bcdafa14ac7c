import logging
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest

from fab.errors import CheckFailed, InputError
from fab.files import sha256_file
from fab.gds.reader import read_gds
from fab.grid import Grid
from fab.layout.geometry import Chrome, Layer, pixel_edges
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.manifest.records import read_manifest
from fab.order.order import plain_name, plan_order
from fab.order.terms import OrderTerms
from fab.order.verify import verify
from fab.order.write import write_order
from fab.process import Normal, Process
from fab.solids.patch import Patch
from fab.units import UM
from fab.verification.files import read_drawn_levels
from tests.fab.maps import FEW, PLAIN, SMALL, level_map_from, wide_map

NAMES = [
    f"{SMALL}_ALL.gds",
    f"{SMALL}_ALL.oas",
    f"{SMALL}_CHECK.drc",
    f"{SMALL}_CHROME.gds",
    f"{SMALL}_GREY.png",
    f"{SMALL}_HEIGHT.npy",
    f"{SMALL}_HEIGHT.tif",
    f"{SMALL}_LAYERS.lyp",
    f"{SMALL}_LEVELS.npy",
    f"{SMALL}_M1_75NM.gds",
    f"{SMALL}_M2_150NM.gds",
    f"{SMALL}_M3_300NM.gds",
    f"{SMALL}_M4_600NM.gds",
    f"{SMALL}_ORDER.csv",
    f"{SMALL}_ORDER.html",
    f"{SMALL}_PLATE.step",
    f"{SMALL}_PREVIEW.png",
    f"{SMALL}_RELIEF.3mf",
    f"{SMALL}_RELIEF.glb",
    f"{SMALL}_RELIEF_MM.stl",
    f"{SMALL}_SAG.DAT",
    f"{SMALL}_WAFER.step",
    "manifest.json",
]


def test_the_folder_holds_the_files_of_a_mask_order(written_order):
    assert sorted(path.name for path in written_order.iterdir()) == NAMES
    assert [path.name for path in written_order.parent.iterdir()] == ["small"]


def test_every_mask_file_holds_its_own_layer_in_a_cell_of_its_own_name(written_order):
    for bit, depth in enumerate((75, 150, 300, 600)):
        stem = f"{SMALL}_M{bit + 1}_{depth}NM"
        layout = read_gds(written_order / f"{stem}.gds")
        assert layout.top.name == stem
        assert list(layout.cells[0].shapes) == [Layer(bit + 1)]
    assert list(read_gds(written_order / f"{SMALL}_CHROME.gds").cells[0].shapes) == [Layer(5)]
    assert len(read_gds(written_order / f"{SMALL}_ALL.gds").cells[0].shapes) == 5


def test_the_level_map_is_stored_and_drawn(written_order, level_map, levels, grid):
    blank = level_map.level
    assert np.array_equal(np.load(written_order / f"{SMALL}_LEVELS.npy"), blank)
    drawn = read_drawn_levels([written_order / f"{SMALL}_ALL.gds"], levels, pixel_edges(grid), f"{SMALL}_DOE")
    assert np.array_equal(drawn, blank)
    assert read_manifest(written_order).level_map_sha256 == level_map.digest


def test_the_manifest_tells_what_each_mask_is(written_order, level_map):
    manifest = read_manifest(written_order)
    assert [(m.mask, m.bit, m.layer, m.datatype, m.depth_nm) for m in manifest.masks] == [
        (1, 0, 1, 0, 75.0),
        (2, 1, 2, 0, 150.0),
        (3, 2, 3, 0, 300.0),
        (4, 3, 4, 0, 600.0),
    ]
    assert all("etched here" in mask.polygon_means for mask in manifest.masks)
    for mask in manifest.masks:
        pixels = np.count_nonzero((15 - level_map.level) >> mask.bit & 1)
        # Areas are rounded to 1e-6 square micrometres.
        assert mask.area_um2 == pytest.approx(pixels * 1.85**2, abs=1e-6)
        assert mask.smallest_width_um == mask.smallest_space_um == 1.85
        assert mask.box_um is not None
        assert mask.box_um[0] >= -16 * 1.85 / 2
    assert "chrome stays here" in manifest.chrome.polygon_means
    assert manifest.chrome.opening_diameter_mm == pytest.approx((16 * 1.85 - 10) / 1000)
    assert manifest.dbu_nm == 1.0
    assert manifest.pixel_edges == "every pixel edge is a whole number of 1 nm"
    assert set(manifest.tools) == {"doedesign", "python", "numpy", "numba", "klayout", "gdstk", "matplotlib"}
    for entry in manifest.files:
        assert entry.sha256 == sha256_file(written_order / entry.file)
        assert entry.bytes == (written_order / entry.file).stat().st_size


def test_the_same_inputs_give_the_same_bytes_in_every_file(written_order, tmp_path, level_map):
    again = tmp_path / "elsewhere" / "again"
    write_order(again, level_map, source={"height_map": "a test"}, wafer=FEW, formats=PLAIN)
    for name in NAMES:
        assert (again / name).read_bytes() == (written_order / name).read_bytes(), name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "step_nm", "shape", "fill"),
    [
        (2, 275.5, (5, 9), None),
        (64, 17.25, (6, 6), None),
        (4, 300.0, (8, 3), 3),  # all blank: four empty layers
        (16, 75.0, (4, 5), 0),  # all etched
    ],
)
def test_orders_of_every_kind_verify(tmp_path, caplog, count, step_nm, shape, fill):
    caplog.set_level(logging.INFO)
    levels, grid = Levels(count, step_nm * 1e-9), Grid(shape, 6.45e-6)
    rng = np.random.default_rng(1)
    level_map = rng.integers(0, count, shape) if fill is None else np.full(shape, fill)
    given = wide_map(level_map, levels, grid, "kind")
    assert write_order(tmp_path / "o", given, chrome=Chrome(1e-6), wafer=FEW).report.passed
    warnings = caplog.messages[: caplog.messages.index("drawing the masks")]
    assert any("what flat glass does" in line for line in warnings) == (fill is not None)
    assert any("are hard to see" in line for line in warnings) == (step_nm < 150 and count > 1)
    manifest = read_manifest(tmp_path / "o")
    assert len(manifest.masks) == levels.bits
    assert manifest.chrome.layer == max(5, levels.bits + 1)


@pytest.mark.slow
def test_edges_that_had_to_be_rounded_are_stated_and_verify(tmp_path, levels):
    grid = Grid((5, 7), 1e-6 / 3)
    rng = np.random.default_rng(1)
    given = LevelMap(rng.integers(0, 16, (5, 7), np.uint8), levels, grid, 1.6e-6, "thirds")
    assert write_order(tmp_path / "o", given, chrome=Chrome(1e-7), wafer=FEW).report.passed
    assert read_manifest(tmp_path / "o").pixel_edges.startswith("each pixel edge is rounded to 1 nm")


@pytest.mark.slow
def test_an_order_that_does_not_verify_never_appears(tmp_path, monkeypatch, level_map):
    def crooked(bitmap, *edges):
        found = rectangles(bitmap, *edges)
        return found[:-1]

    from fab.layout.polygons import rectangles

    monkeypatch.setattr("fab.layout.compensation.rectangles", crooked)
    with pytest.raises(CheckFailed, match=r"M1_75NM\.gds\.gz: own reader, every pixel: layer 1/0: \d+ pixel"):
        write_order(tmp_path / "o", level_map, wafer=FEW)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_an_earlier_order_is_replaced(order_folder, level_map):
    write_order(order_folder, replace(level_map, name="other"), wafer=FEW)
    assert read_manifest(order_folder).name == "other"
    assert not (order_folder / f"{SMALL}_ALL.gds").exists()


def test_nothing_but_an_earlier_order_is_replaced(order_folder, tmp_path, level_map):
    def write(folder):
        write_order(folder, replace(level_map, name="other"), wafer=FEW)

    (order_folder / "notes.txt").write_text("from the lab")
    with pytest.raises(InputError, match=r"notes\.txt"):
        write(order_folder)
    assert (order_folder / f"{SMALL}_ALL.gds").exists()
    run = tmp_path / "run"
    run.mkdir()
    (run / "manifest.json").write_text('{"format": "a run"}')
    with pytest.raises(InputError, match="format"):
        write(run)
    shutil.rmtree(order_folder)
    order_folder.write_text("a file")
    with pytest.raises(InputError, match="must be a folder"):
        write(order_folder)
    with pytest.raises(InputError, match="order/inside"):
        write(order_folder / "inside")


@pytest.mark.parametrize(
    ("name", "plain"), [("small", "SMALL"), ("Auto motive-2", "AUTO_MOTIVE_2"), ("main", "MAIN"), ("größe", "GR_SSE")]
)
def test_names_become_what_mask_shops_accept(name, plain):
    assert plain_name(name) == plain


def job(name="lens", pitch_m=1.85e-6, step_m=75e-9, revision="A", **wafer):
    """The order of a bare map."""
    level = np.random.default_rng(3).integers(0, 16, (9, 9))
    drawn = level_map_from(level, Levels(16, step_m), pitch_m, 9 * pitch_m, name)
    return plan_order(drawn, wafer=Wafer(**wafer), terms=OrderTerms(revision=revision))


def test_jobs_that_draw_something_else_have_other_names():
    """Revision and pitch can be read, and the digest differs with all that is drawn."""
    jobs = [job(), job(pitch_m=2e-6), job(step_m=80e-9), job(revision="B"), job(zero_layer=True), job(dies=(1, 1))]
    assert len({one.stem for one in jobs}) == len(jobs)
    assert jobs[0].stem == f"LENS_A_1P85_{jobs[0].geometry[:4].upper()}"
    assert jobs[1].stem.startswith("LENS_A_2_")
    assert jobs[3].stem.startswith("LENS_B_1P85_")
    assert jobs[3].geometry == jobs[0].geometry
    assert job("other").geometry == jobs[0].geometry


@pytest.mark.parametrize(("pitch_m", "step_m"), [(1.2345e-6, 123.45e-9), (12.34e-9, 9.4e-6), (999e-6, 75e-9)])
def test_the_longest_names_fit_thirty_two_characters(pitch_m, step_m):
    order = job("a_very_long_name_of_a_lens", pitch_m, step_m, "XYZ")
    assert order.stem.startswith("A_V")
    assert max(len(order.mask_stem(bit)) for bit in range(4)) <= 32
    assert len(f"{order.stem}_ORDER_DIE") <= 32


def test_the_process_has_its_doe_on_the_wafer_that_is_ordered(level_map):
    wafer, process = Wafer(150e-3, blank_m=178e-3), Process(level_map.levels, die_m=(0.0, 30e-3))
    with pytest.raises(InputError, match=r"wafer_radius_m: must be half of .* that is ordered, 150 mm, but got 50 mm"):
        plan_order(level_map, process=process, wafer=wafer)
    assert plan_order(level_map, process=replace(process, wafer_radius_m=75e-3), wafer=wafer)
    # In the middle of the wafer its size does not matter.
    assert plan_order(level_map, process=replace(process, die_m=(0.0, 0.0)), wafer=wafer)


def test_floors_leave_glass_below_them(level_map, caplog):
    """A step of 75 um for 75 nm."""
    deep = replace(level_map, levels=Levels(level_map.levels.count, 75 * UM))
    with pytest.raises(InputError, match=r"wafer: thickness: must be thicker than the deepest floor.*but got 500 um"):
        plan_order(deep)
    plan_order(replace(level_map, levels=Levels(level_map.levels.count, 5 * UM)), wafer=Wafer(thickness_m=0.6e-3))
    assert "the deepest floor lies 75 um below the face of a wafer of 600 um" in caplog.text


def test_the_blank_fits_the_coordinates(level_map):
    """A pitch on tenths of a nanometre makes them the unit."""
    wafer = Wafer(400e-3, blank_m=450e-3, dies=(1, 1))
    assert plan_order(level_map, wafer=wafer).dbu_m == 1e-9
    fine = replace(level_map, grid=replace(level_map.grid, pitch_m=1.8502e-6))
    with pytest.raises(InputError, match=r"blank_m: must be at most 429\.\d+ mm in 32-bit coordinates of 0\.1 nm"):
        plan_order(fine, wafer=wafer)


@pytest.mark.parametrize("length_m", [1e300, math.inf, math.nan, 0.0, -1e-7])
def test_lengths_that_no_drawing_has_are_refused(length_m):
    """Before anything is computed with them: their squares and sums are no numbers."""
    with pytest.raises(InputError, match="level step: must be positive and at most 1 mm, in metres"):
        Levels(4, length_m)
    with pytest.raises(InputError, match="etch depths: must be positive and at most 1 mm, in metres"):
        Levels(4, 1e-7, (1e-7, length_m))
    for pitch_m in (length_m, 1e-300):
        with pytest.raises(InputError, match="grid: pitch: must be positive, from"):
            Grid((4, 4), pitch_m)


@pytest.mark.parametrize("word", ["error", "Fail", "fial", None])
def test_what_to_do_about_broken_rules_is_one_of_three_words(level_map, word):
    """A misspelt word would be a warning, and an order that the process cannot print."""
    with pytest.raises(InputError, match=r"on_violation: must be one of warn, fail, fix, but got .*Choose"):
        plan_order(level_map, process="contact_aligner", on_violation=word)


def test_a_name_of_which_nothing_is_left_is_refused():
    with pytest.raises(InputError, match="mask order name"):
        plain_name("***")


@pytest.mark.parametrize(("name", "lost"), [("größe", ["größe leave out öß and begin with GR_SSE"]), ("plate", [])])
def test_letters_that_mask_shops_do_not_take_are_said_to_be_left_out(name, lost, caplog):
    """They were left out without a word."""
    job(name=name)
    assert [
        line.split(": of ")[1].replace("the names of files and cells ", "") for line in caplog.messages if "A-Z" in line
    ] == lost


def test_whole_numbers_stand_for_lengths_and_shares_too(tmp_path, levels):
    level_map = wide_map(np.indices((40, 40)).sum(axis=0) % 16, levels, Grid((40, 40), 4e-6))
    asked = {
        "process": Process(levels, spreads={"common_depth_scale": Normal(0, 1)}, minimum_line_m=0, die_m=(0, 0)),
        "wafer": Wafer(dies=(1, 1), lane_m=0, edge_moves_m=(0,) * levels.bits),
        "chrome": Chrome(overlap_m=0),
        "patch": Patch(0, 0, 2e-5),
        "terms": OrderTerms(defects_per_cm2=0),
    }
    order = write_order(tmp_path / "whole", level_map, **asked)
    assert order.manifest.request["terms"]["defects_per_cm2"] == 0
    assert verify(order.folder).passed


def test_a_value_of_another_kind_is_named_before_anything_is_drawn(tmp_path, level_map):
    with pytest.raises(InputError, match=r"^wafer: zero_layer: .* but got 'maybe'"):
        write_order(tmp_path / "odd", level_map, wafer=replace(FEW, zero_layer="maybe"))
    assert not any(tmp_path.iterdir())
