"""Slips of those who make plates in Python: what is no staircase, raster or map is told in words."""

# What is given here is of other types than annotations say, on purpose.
# pyright: reportArgumentType=false

import numpy as np
import pytest

from fab.aperture import RectangularAperture, RoundAperture
from fab.archive import read_archive, write_archive
from fab.errors import InputError
from fab.grid import Grid
from fab.height import HeightMap, read_height
from fab.layout.geometry import Chrome
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap, read_level_map, write_level_map
from fab.levels import Levels
from fab.order.formats import Formats
from fab.order.terms import OrderTerms
from fab.order.write import write_order
from fab.process import Process
from fab.rules.check import Rules
from fab.rules.repair import repair
from fab.solids.patch import Patch
from fab.stock import process_from
from fab.units import NM, metres
from tests.fab.maps import FEW, level_map_from

SIXTEEN = Levels(16, 75 * NM)
GRID = Grid((4, 4), 2e-6)
HEIGHT_M = np.zeros((4, 4))
BLANK = LevelMap(np.zeros((4, 4), np.uint8), SIXTEEN, GRID, 8e-6)


@pytest.mark.usefixtures("annotations_unchecked")
@pytest.mark.parametrize(
    ("make", "told"),
    [
        (
            lambda: Levels(4, "100 nm"),
            r"level step: must be positive .* but got '100 nm'\. Give 75e-9 for 75 nm",
        ),
        (lambda: Levels(4, None), "level step: must be positive"),
        (lambda: Levels(4, True), "level step: must be positive"),
        (lambda: Levels(4, 100), r"level step: .*at most 1 mm, in metres, but got 100\."),
        (lambda: Levels(4, 1e-7, ("100 nm", "200 nm")), "etch depths: must be positive.*'100 nm'"),
        (lambda: Levels(4, 1e-7, 1e-7), "etch depths: must be a depth for each mask, but got 1e-07"),
        (lambda: Grid(32, 2e-6), r"grid: shape: must be two counts of pixels \(ny, nx\), but got 32"),
        (lambda: Grid((32, 32, 3), 2e-6), "grid: shape: must be two counts"),
        (lambda: Grid(None, 2e-6), "grid: shape: must be two counts"),
        (lambda: Grid((32, 32), "2 um"), "grid: pitch: must be positive.*'2 um'.*2e-6 for 2 um"),
        (lambda: Grid((32, 32), None), "grid: pitch: must be positive.*None"),
        (lambda: HeightMap(HEIGHT_M, (4, 4), 8e-6), r"grid: must be a Grid, but got a tuple\. Give a fab\.Grid"),
        (lambda: HeightMap([[0.0], [0.0, 1.0]], GRID, 8e-6), "height map: must be an array .*different lengths"),
        (lambda: LevelMap(HEIGHT_M.astype(np.uint8), 4, GRID, 8e-6), "levels: must be a Levels, but got an int"),
        (lambda: LevelMap(HEIGHT_M.astype(np.uint8), SIXTEEN, (4, 4), 8e-6), "grid: must be a Grid, but got a tuple"),
        (lambda: LevelMap.from_height(HEIGHT_M, SIXTEEN), r"height: must be a HeightMap, .*Give a fab\.HeightMap"),
        (lambda: LevelMap.from_height(HeightMap(HEIGHT_M, GRID, 8e-6), 4), "levels: must be a Levels"),
        (lambda: LevelMap.from_height(HeightMap(HEIGHT_M + 2e-6, GRID, 8e-6), SIXTEEN), r"\(wrapped=True\)"),
        (
            lambda: RoundAperture("1 mm"),
            r"aperture: diameter_m: must be a number of metres, but got '1 mm'\. For example 1e-3 for 1 mm",
        ),
        (lambda: RoundAperture(np.nan), "aperture: diameter_m: must be a number"),
        (lambda: RectangularAperture(1e-3), r"aperture: size_m: must be two numbers \(y, x\), .* but got 0\.001"),
        (lambda: RectangularAperture((1e-3, "1 mm")), "aperture: size_m: must be two numbers"),
        (lambda: HeightMap(HEIGHT_M, GRID, "5"), r"must be a diameter or \[width, height\], but got '5'"),
        (lambda: HeightMap(HEIGHT_M, GRID, True), "must be a diameter"),
        (lambda: Process(SIXTEEN, 3), "process: order: must name each of the masks 0 to 3 once, but got 3"),
        (lambda: Process(SIXTEEN, spreads=[1]), "process: spreads: must be a Mapping, but got a list"),
        (lambda: Process(SIXTEEN, tone=np.zeros(3)), 'process: tone: must be "clear" or "dark"'),
        (lambda: Process(SIXTEEN, die_m=0.01), r"process: die_m: must lie on the wafer .*\(y, x\) .* but got 0\.01"),
        (lambda: Process(SIXTEEN, die_m=("1 cm", 0.0)), "process: die_m: must lie on the wafer"),
        (lambda: Process(SIXTEEN, reduction="5"), "process: reduction: must be a whole number"),
        (lambda: process_from("ideal", 16), r"levels: must be a Levels, but got an int\. A level map has them"),
        (lambda: Rules("1 um"), "rules: minimum_line_m: must be finite and not negative, in metres, but got '1 um'"),
        (lambda: Rules(window_m=None), "rules: window_m: must be positive and finite"),
        (lambda: repair(BLANK, "contact_aligner", "1"), r"waves per metre: must be .*'1'\. Give \(n - 1\)"),
        (lambda: Formats(mesh_cells="200"), "formats: mesh_cells: must be a whole number from 1 to 1000"),
        (lambda: Formats(combined_gds="yes"), "formats: combined_gds: must be a bool, but got a str"),
        (lambda: OrderTerms(3), "order: revision: must be text, but got 3"),
        (lambda: OrderTerms(blank_thickness_m="2 mm"), "order: blank_thickness_m: must be metres.*'2 mm'"),
        (lambda: OrderTerms(defects_per_cm2="few"), "order: defects_per_cm2: must be 0 or more.*'few'"),
        (lambda: Wafer("4 in"), r"wafer: diameter_m: must be positive and below 1 m, but got '4 in'\. Check its unit"),
        (lambda: Wafer(pitch_m="1 cm"), "wafer: pitch_m: must be positive"),
        (lambda: Wafer(lane_m=None), "wafer: lane_m: must lie from 0 to 10 mm, but got None"),
        (lambda: Wafer(dies=3), "wafer: dies: must be 1 or more rows and columns, but got 3"),
        (lambda: Wafer(dies=(3,)), "wafer: dies: must be"),
        (lambda: Wafer(chrome=["etch"]), "wafer: chrome: must be"),
        (lambda: Wafer(line_splits_m=1e-7), "wafer: line_splits_m: must be several numbers of metres, but got 1e-07"),
        (lambda: Wafer(edge_moves_m=("1 um",)), "wafer: edge_moves_m: must be several numbers"),
        (lambda: Patch("0 um", 0.0, 5e-5), "patch: x_m: must be a number of metres, but got '0 um'"),
        (lambda: Chrome("5 um").opening(RoundAperture(8e-6)), "chrome overlap: must be 0 or more.* but got '5 um'"),
        (lambda: write_level_map(BLANK, "x.npz"), "path: must be the path of a file or a folder, but got a LevelMap"),
        (lambda: read_level_map("a\0b"), "path: must be the path"),
        (lambda: read_height("", "1 um"), "path: must be the path of a file or a folder, but got ''"),
        (lambda: metres(np.zeros(3), "depth", infinite=True), "depth: must be metres or text"),
        (lambda: GRID.axis_m("z"), """axis: must be "x" or "y", but got 'z'"""),
        (lambda: BLANK.plot("x.png"), r"ax: must be an Axes, but got a str\. Leave it out for a new figure; .*save"),
    ],
)
def test_arguments_of_another_kind_are_told_in_words(make, told):
    """What a first-time user types: text with a unit, whole metres, a bare array, a tuple for a raster."""
    with pytest.raises(InputError, match=told):
        make()


def test_lists_of_heights_are_a_map():
    height = HeightMap([[0.0, 75e-9], [150e-9, 0.0]], Grid((2, 2), 2e-6), 4e-6)
    assert LevelMap.from_height(height, SIXTEEN).level.tolist() == [[0, 1], [2, 0]]


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("pitch_m", -2e-6, "grid: pitch: must be positive"),
        ("levels", 1, "levels: must"),
        ("aperture_m", 1.0, "aperture: must lie"),
    ],
)
def test_a_level_map_file_with_a_wrong_header_is_named(tmp_path, key, value, told):
    """The message named the key and no file."""
    path = tmp_path / "plate.npz"
    write_level_map(path, BLANK)
    header, arrays = read_archive(path, "level map", "")
    write_archive(path, {**header, key: value}, arrays)
    with pytest.raises(InputError) as error:
        read_level_map(path)
    assert str(error.value).startswith(f"{path}: {told}")
    assert str(error.value).endswith("Write it again from its run.")


def test_the_source_of_an_order_may_have_numbers_of_numpy(tmp_path):
    level_map = level_map_from(np.random.default_rng(0).integers(0, 16, (19, 18)), aperture_m=18e-6, name="toy")
    order = write_order(tmp_path / "o", level_map, wafer=FEW, source={"run": np.int64(3), "loss": np.array([0.5])})
    assert order.manifest.source == {"run": 3, "loss": [0.5]}
    for source in ({"run": {1, 2}}, {"loss": np.nan}):
        with pytest.raises(InputError, match=r"source: must be what JSON can hold, but got \{.* Give text"):
            write_order(tmp_path / "p", level_map, wafer=FEW, source=source)
    assert not (tmp_path / "p").exists()
