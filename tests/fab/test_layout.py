from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fab.errors import InputError
from fab.grid import Grid
from fab.layout.doe import mask_layout
from fab.layout.geometry import (
    Chrome,
    Layer,
    Shapes,
    chrome_layer,
    chrome_shapes,
    etch_layer,
    pixel_edges,
    require_name,
)
from fab.levels import Levels
from fab.units import MM, NM, UM


def test_layers_are_equal_by_number_and_datatype():
    assert Layer(3, 0, "a") == Layer(3, 0, "b")
    assert Layer(3, 0) != Layer(3, 1)
    assert str(Layer(3, 1)) == "3/1"


@pytest.mark.parametrize(("count", "chrome"), [(2, 5), (16, 5), (32, 6), (64, 7)])
def test_chrome_is_layer_five_or_the_next_free_one(count, chrome):
    levels = Levels(count, 75 * NM)
    assert chrome_layer(levels) == Layer(chrome)
    assert [etch_layer(bit, levels).number for bit in range(levels.bits)] == list(range(1, levels.bits + 1))


@pytest.mark.parametrize(
    ("count", "pitch_um", "dbu_nm", "first"),
    [
        (2400, 1.85, 1.0, -2_220_000),
        (2800, 6.45, 1.0, -9_030_000),
        (4400, 1.0, 1.0, -2_200_000),
        (3, 1.85, 1.0, -2775),
        (3, 1.001, 0.5, -3003),  # half a nanometre at the rim of an odd count
        (4, 0.1001, 0.1, -2002),
        (4, 2.00025, 0.25, -16002),
    ],
)
def test_edges_are_exact_wherever_a_unit_allows(count, pitch_um, dbu_nm, first):
    edges = pixel_edges(Grid((count, count), pitch_um * UM))
    assert edges.dbu_m == pytest.approx(dbu_nm * NM, rel=1e-15)
    assert edges.shift_m == 0
    assert edges.x[0] == first == -edges.x[-1]
    assert len(set(np.diff(edges.x).tolist())) == 1


def test_edges_that_fit_no_unit_are_rounded_once_and_the_shift_is_stated():
    grid = Grid((7, 10), UM / 3)
    edges = pixel_edges(grid)
    assert edges.dbu_m == 1e-9
    # A third of a nanometre is the largest rest of thirds.
    assert edges.shift_m == pytest.approx(NM / 3, rel=1e-4)
    exact = (np.arange(11) - 5) * grid.pitch_m / NM
    assert np.abs(edges.x - exact).max() <= 0.5
    assert np.array_equal(edges.x, -edges.x[::-1])
    assert np.array_equal(edges.y, -edges.y[::-1])
    assert (np.diff(edges.x) > 0).all()


@given(st.integers(1, 60), st.integers(10_000, 5_000_000))
def test_edges_are_symmetric_even_and_within_half_a_unit(count, pitch_pm):
    grid = Grid((count, 2), pitch_pm * 1e-12)
    edges = pixel_edges(grid)
    assert np.array_equal(edges.y, -edges.y[::-1])
    exact = (np.arange(count + 1) - count / 2) * pitch_pm * 1e-12 / edges.dbu_m
    # 1e-6: float64 rounding of these products.
    assert np.abs(edges.y - exact).max() <= 0.5 + 1e-6
    assert edges.shift_m <= 0.5e-9


@pytest.mark.parametrize("grid", [Grid((4, 4), 9 * NM), Grid((2, 50_000), 0.1 * MM)])
def test_rasters_that_cannot_be_drawn_are_refused(grid):
    with pytest.raises(InputError, match="10 nm or more"):
        pixel_edges(grid)


@pytest.mark.parametrize("axis", [0, 1])
def test_an_edge_may_lie_on_the_last_32_bit_coordinate_and_no_further(axis):
    last = 2_147_483_647
    shape = [(2, 1), (1, 2)][axis]
    edges = pixel_edges(Grid(shape, last * NM))
    assert [edges.y, edges.x][axis].tolist() == [-last, 0, last]
    with pytest.raises(InputError, match="the raster must fit 32-bit nanometres"):
        pixel_edges(Grid(shape, (last + 1) * NM))


@pytest.mark.parametrize("name", ["", "main", "MAIN", "DOE-1", "DOE 1", "Ä", "A" * 33, "doe"])
def test_names_that_mask_shops_refuse_are_refused(name):
    with pytest.raises(InputError, match="mask name"):
        require_name(name)
    assert require_name("A" * 32) == "A" * 32


def test_a_layout_holds_each_plane_on_its_layer_and_the_chrome_last(level_map, levels, grid):
    layout = mask_layout(level_map, "DOE")
    assert [str(layer) for layer in layout.cells[0].shapes] == ["1/0", "2/0", "3/0", "4/0", "5/0"]
    assert layout.dbu_m == 1e-9
    inside = grid.inside_circle(grid.extent_m[1])
    for bit in range(4):
        etched = ((15 - level_map.level) >> bit & 1).astype(bool) & inside
        # Twice the area of a pixel of 1850 units.
        assert layout.cells[0].shapes[Layer(bit + 1)].doubled_area == 2 * 1850**2 * np.count_nonzero(etched)


def test_the_chrome_reaches_inside_the_aperture_and_past_the_corners(level_map, levels, grid):
    layout = mask_layout(replace(level_map, aperture=25 * UM), "DOE", Chrome(overlap_m=2 * UM))
    vertices = np.concatenate(layout.cells[0].shapes[Layer(5)].polygons).astype(float)
    radius_m = np.hypot(*vertices.T) * layout.dbu_m
    assert radius_m.min() == pytest.approx(10.5 * UM, abs=NM)
    assert radius_m.max() > np.hypot(*grid.extent_m) / 2
    # A rim on a whole tenth of a millimetre, for the order form.
    assert radius_m.max() / (0.1 * MM) == pytest.approx(round(radius_m.max() / (0.1 * MM)), abs=1e-4)


@pytest.mark.parametrize(
    ("chrome", "rule"),
    [
        (Chrome(overlap_m=20 * UM), "chrome overlap"),
        (Chrome(overlap_m=-1 * UM), "chrome overlap"),
        (Chrome(outer_m=1 * UM), "chrome outer radius"),
        (Chrome(outer_m=10.0), "32-bit"),
        (Chrome(chord_error_m=0.1 * NM), "chord error"),
    ],
)
def test_impossible_chrome_is_refused(level_map, levels, grid, chrome, rule):
    with pytest.raises(InputError, match=rule):
        mask_layout(replace(level_map, aperture=25 * UM), "DOE", chrome)


def test_the_rim_of_the_chrome_may_lie_on_the_last_32_bit_coordinate_and_no_further(level_map):
    last = 2_147_483_647
    # One micrometre of chord error, so that few vertices are needed.
    rim, beyond = (Chrome(outer_m=units * NM, chord_error_m=UM) for units in (last, last + 1))
    assert chrome_shapes(level_map, NM, rim).box == (-last, -last, last, last)
    with pytest.raises(InputError, match="chrome outer radius: must fit 32-bit coordinates"):
        chrome_shapes(level_map, NM, beyond)


def test_an_aperture_wider_than_the_raster_is_refused(level_map, levels, grid):
    for aperture_m in (0.0, 50 * UM):
        with pytest.raises(InputError, match="aperture"):
            mask_layout(replace(level_map, aperture=aperture_m), "DOE")


def test_area_and_box_of_shapes():
    triangle = np.array([[0, 0], [4, 0], [0, -4]], dtype=np.int32)
    shapes = Shapes(np.array([[1, 2, 3, 5]], dtype=np.int32), (triangle,))
    assert (len(shapes), shapes.doubled_area, shapes.box) == (2, 2 * 6 + 16, (0, -4, 4, 5))
    far = 2**31 - 1
    wide = Shapes(np.array([[-far, -far, far, far], [-far, 0, far, 1]], dtype=np.int32))
    assert wide.doubled_area == 2 * ((2 * far) ** 2 + 2 * far)
    nothing = Shapes(np.empty((0, 4), dtype=np.int32))
    assert (len(nothing), nothing.doubled_area, nothing.box) == (0, 0, None)
