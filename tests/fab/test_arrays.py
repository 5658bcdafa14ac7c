"""Plates whose relief repeats: drawn as arrays of one cell, read by other libraries, proved from their files."""

import shutil

import klayout.db as kdb
import numpy as np
import pytest

from fab.errors import InputError
from fab.gds.reader import read_gds
from fab.gds.writer import write_gds
from fab.grid import Grid
from fab.layout.arrays import MOST_COPIES, cell_name, period_of, unfolded
from fab.layout.compensation import read_back
from fab.layout.doe import mask_layout
from fab.layout.geometry import Cell, Layout, Reference, etch_layer, pixel_edges
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.manifest.records import read_manifest
from fab.order.verify import verify
from fab.order.write import write_order
from fab.process import Normal, Process
from tests.fab.maps import FEW, PLAIN
from tests.fab.mended import mend, told

UM = 1e-6
LEVELS = Levels(16, 75e-9)


def repeated(cells: int = 12, pixels: tuple[int, int] = (12, 15), block: int = 1, levels: Levels = LEVELS) -> LevelMap:
    """So many cells of random levels along each axis, in blocks of pixels, within a round aperture."""
    ny, nx = (side // block for side in pixels)
    cell = np.kron(np.random.default_rng(3).integers(0, levels.count, (ny, nx)), np.ones((block, block), int))
    level = np.tile(cell, (cells, cells)).astype(np.uint8)
    return LevelMap(level, levels, Grid(level.shape, 2 * UM), 0.97 * min(level.shape) * 2 * UM, "rep")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Lines of three pixels, a bias that is made up for, a line-width split, and the control of the etch order."""
    process = Process(LEVELS, spreads={"common_cd_bias_m": Normal(0.3e-6, 0.0)})
    wafer = Wafer(compensate=True, line_splits_m=(0.5e-6,), order_control=True, dies=(3, 3))
    folder = tmp_path_factory.mktemp("arrays") / "order"
    level_map = repeated(block=3)
    assert write_order(folder, level_map, process=process, wafer=wafer, formats=PLAIN).report.passed
    return folder, level_map


@pytest.mark.parametrize("move", [0, 1, 150, -150, 999, -700])
def test_copies_and_the_rest_are_the_plane_and_fewer_shapes(move):
    # Lines and gaps are two pixels of 2 um or more.
    level_map = repeated(12, (12, 16), 2)
    edges, planes = pixel_edges(level_map.grid), level_map.planes()
    layout = mask_layout(level_map, "T_DOE", edge_moves=(move,) * 4)
    one, doe = layout.cells
    assert (one.name, {at.cell for at in doe.references}) == (cell_name("T_DOE"), {one.name})
    whole = unfolded(layout, ["T_DOE"], 10**6).top
    for bit, plane in enumerate(planes):
        layer = etch_layer(bit, LEVELS)
        np.testing.assert_array_equal(read_back(whole.shapes[layer], edges, move), plane)
        assert len(one.shapes[layer]) + len(doe.shapes[layer]) < 0.6 * len(whole.shapes[layer])


def test_every_whole_cell_of_the_aperture_is_a_copy():
    level_map = repeated(12, (12, 15))
    layout = mask_layout(level_map, "T_DOE")
    ny, nx = (size // 12 for size in level_map.grid.shape)
    inside = level_map.relief.inside(level_map.grid).reshape(12, ny, 12, nx).all(axis=(1, 3))
    assert sum(at.columns * at.rows for at in layout.top.references) == np.count_nonzero(inside) == 68


def test_other_libraries_see_the_plate_pixel_by_pixel(written):
    """KLayout and its rasteriser, with the bias of the process undone by its own sizing."""
    folder, level_map = written
    manifest = read_manifest(folder)
    (ny, nx), pitch = level_map.grid.shape, 2000
    for file in (manifest.combined_gds, manifest.combined_oasis):
        layout = kdb.Layout()
        layout.read(str(folder / file))
        cell = layout.cell(manifest.doe_cell)
        (instances,) = {one.cell.name for one in cell.each_inst()}
        assert instances == f"{manifest.doe_cell}CELL"
        for bit, plane in enumerate(level_map.planes()):
            region = kdb.Region(cell.begin_shapes_rec(layout.find_layer(bit + 1, 0)))
            assert region.merged(2).is_empty(), "copies overlap"
            step, origin = kdb.Vector(pitch, pitch), kdb.Point(-nx * pitch // 2, -ny * pitch // 2)
            areas = region.merged().sized(300, 2).rasterize(origin, step, step, nx, ny)
            np.testing.assert_array_equal(np.array(areas), plane.astype(int) * pitch**2)


def test_splits_repeat_cells_of_their_own(written):
    folder, _ = written
    manifest = read_manifest(folder)
    for file in (manifest.combined_gds, manifest.masks[1].file):
        layout = read_gds(folder / file)
        for name in manifest.drawn():
            cell = layout.cell(name)
            assert cell is not None
            assert {at.cell for at in cell.references} == {cell_name(name)}


def _altered(layout: Layout, change) -> Layout:
    return Layout(layout.dbu_m, tuple(change(cell) for cell in layout.cells))


def _step_aside(cell: Cell) -> Cell:
    """The first array of the DOE is a pixel further to the right."""
    if not cell.name.endswith("_DOE"):
        return cell
    first, *others = cell.references
    return Cell(cell.name, cell.shapes, (Reference(**{**vars(first), "x": first.x + 2000}), *others))


def _copy_less(cell: Cell) -> Cell:
    if not cell.name.endswith("_DOE"):
        return cell
    *others, last = cell.references
    return Cell(cell.name, cell.shapes, (*others, Reference(**{**vars(last), "columns": last.columns - 1})))


def _shape_less(cell: Cell) -> Cell:
    if not cell.name.endswith("_DOECELL"):
        return cell
    return Cell(cell.name, {k: type(s)(s.rectangles[1:]) for k, s in cell.shapes.items()}, cell.references)


@pytest.mark.slow
@pytest.mark.parametrize("change", [_step_aside, _copy_less, _shape_less])
def test_what_differs_in_an_array_is_found(written, tmp_path, change):
    folder = tmp_path / "order"
    shutil.copytree(written[0], folder)
    file = read_manifest(folder).masks[1].file
    write_gds(folder / file, _altered(read_gds(folder / file), change))
    mend(folder, file)
    found = told(folder, file)
    assert "own reader" in found
    assert "gdstk" in found


def test_a_copy_that_lies_outside_the_doe_is_told(written, tmp_path):
    folder = tmp_path / "order"
    shutil.copytree(written[0], folder)
    file = read_manifest(folder).masks[1].file

    def change(cell: Cell) -> Cell:
        more = (Reference(cell_name(cell.references[0].cell)),) if cell.name.endswith("_DIE") else ()
        return Cell(cell.name, cell.shapes, (*cell.references, *more))

    layout = _altered(read_gds(folder / file), change)
    write_gds(folder / file, layout)
    mend(folder, file)
    assert "places other cells, or elsewhere" in told(folder, file)


def test_an_array_that_stands_for_too_much_is_not_unfolded(written, tmp_path):
    """Every copy a hundred times: copies within the limits of a drawing, shapes beyond those of the manifest."""
    folder = tmp_path / "order"
    shutil.copytree(written[0], folder)
    file = read_manifest(folder).masks[1].file

    def change(cell: Cell) -> Cell:
        many = tuple(Reference(**{**vars(at), "columns": 300, "rows": 30}) for at in cell.references)
        return Cell(cell.name, cell.shapes, many) if cell.name.endswith("_DOE") else cell

    write_gds(folder / file, _altered(read_gds(folder / file), change))
    mend(folder, file)
    assert "must stand for at most" in told(folder, file)
    layout = read_gds(folder / file)
    with pytest.raises(InputError, match="at most 1000 shapes"):
        unfolded(layout, [cell.name for cell in layout.cells], 1000)


def test_many_small_cells_become_fewer_larger_ones():
    level_map = repeated(300, (3, 4))
    one, doe = mask_layout(level_map, "T_DOE").cells
    assert 0.5 * MOST_COPIES < sum(at.columns * at.rows for at in doe.references) <= MOST_COPIES
    # Four by four periods: 300 times 300 copies of one would be nine times as many as may be.
    boxes = [box for shapes in one.shapes.values() if (box := shapes.box)]
    assert (max(box[2] for box in boxes), max(box[3] for box in boxes)) <= (3 * 4 * 2000, 3 * 3 * 2000)


@pytest.mark.parametrize("why", ["lines", "random", "three cells", "uneven pixels"])
def test_other_plates_are_drawn_as_ever(why):
    rng = np.random.default_rng(1)
    level, pitch_m = {
        "lines": (np.tile(np.arange(16), (160, 10)), 2 * UM),
        "random": (rng.integers(0, 16, (160, 160)), 2 * UM),
        "three cells": (np.tile(rng.integers(0, 16, (40, 40)), (3, 3)), 2 * UM),
        # Edges of pixels of 1.0001 um in database units of 0.1 nm would be even, those of a third of a micrometre not.
        "uneven pixels": (np.tile(rng.integers(0, 16, (10, 10)), (12, 12)), 1e-6 / 3),
    }[why]
    grid = Grid(level.shape, pitch_m)
    layout = mask_layout(LevelMap(level.astype(np.uint8), LEVELS, grid, min(grid.extent_m), "x"), "T_DOE")
    assert [cell.name for cell in layout.cells] == ["T_DOE"]


@pytest.mark.parametrize(("period", "shape"), [((7, 9), (140, 180)), ((5, 5), (63, 71)), ((1, 4), (40, 40))])
def test_the_smallest_period_of_both_axes_is_found(period, shape):
    cell = np.random.default_rng(4).permutation(period[0] * period[1]).reshape(period).astype(np.uint8)
    level = np.tile(cell, [-(-size // side) for size, side in zip(shape, period, strict=True)])[: shape[0], : shape[1]]
    assert period_of(level) == period
    spoiled = level.copy()
    spoiled[shape[0] // 2, shape[1] // 2] ^= 1
    assert period_of(spoiled) is None
    spoiled = level.copy()
    spoiled[0, 0] ^= 1
    assert period_of(spoiled) == period


@pytest.mark.slow
def test_an_order_of_few_dies_with_six_levels_is_proved(tmp_path):
    levels = Levels(6, 100e-9)
    written = write_order(tmp_path / "order", repeated(8, levels=levels), wafer=FEW)
    assert verify(tmp_path / "order").differences == ()
    assert {one.name for one in written.folder.iterdir()} >= {"manifest.json"}
