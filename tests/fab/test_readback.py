from typing import Any

import gdstk
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fab.gds.gdstk_reader import GdstkReader
from fab.gds.oasis import write_oasis
from fab.gds.writer import write_gds
from fab.grid import Grid
from fab.layout.doe import mask_layout
from fab.layout.geometry import Cell, Layer, Layout, Shapes, pixel_edges
from fab.layout.polygons import rectangles
from fab.units import NM, UM

TRIANGLE = np.array([[0, 0], [1000, 0], [0, -1000]], dtype=np.int32)


def written(folder, edges, **planes):
    """Write planes to layers 1, 2, ... as GDSII and OASIS."""
    shapes = {
        Layer(number): Shapes(rectangles(plane, edges.x, edges.y), (TRIANGLE,))
        for number, plane in enumerate(planes.values(), 1)
    }
    layout = Layout(edges.dbu_m, (Cell("TOP", shapes),))
    write_gds(folder / "a.gds", layout)
    write_oasis(folder / "a.oas", layout)
    return {layer: len(drawn) for layer, drawn in shapes.items()}


PLANE = hnp.arrays(np.uint8, (7, 10), elements=st.integers(0, 1))


@pytest.mark.parametrize("pitch_m", [1.85 * UM, UM / 3, 1.0005 * UM])
@given(one=PLANE, two=PLANE)
def test_the_other_library_counts_every_pixel_once(tmp_path_factory, pitch_m, one, two):
    folder = tmp_path_factory.mktemp("again")
    edges = pixel_edges(Grid((7, 10), pitch_m))
    layers = written(folder, edges, one=one, two=two)
    again = GdstkReader(["TOP"], edges)
    both = again.gds(folder / "a.gds", layers, []), again.oasis(folder / "a.oas", layers)
    for readings in map(list, both):
        assert [reading.layer for reading in readings] == list(layers)
        for reading, plane in zip(readings, (one, two), strict=True):
            assert np.array_equal(reading.winding, plane)
            assert reading.strays == 0
            assert [sorted(map(tuple, p.tolist())) for p in reading.polygons] == [sorted(map(tuple, TRIANGLE.tolist()))]
    assert again.problems == []
    assert again.around == []


def test_repetitions_of_oasis_are_unfolded(tmp_path):
    # A regular pattern folds: the library then holds far fewer polygons than are drawn.
    plane = np.zeros((40, 40), dtype=np.uint8)
    plane[::2, ::2] = 1
    edges = pixel_edges(Grid(plane.shape, UM))
    layers = written(tmp_path, edges, plane=plane)
    cells: list[Any] = gdstk.read_oas(str(tmp_path / "a.oas")).cells
    assert len(cells[0].polygons) < 10
    (reading,) = GdstkReader(["TOP"], edges).oasis(tmp_path / "a.oas", layers)
    assert np.array_equal(reading.winding, plane)


def test_overlaps_and_strays_are_seen(tmp_path):
    edges = pixel_edges(Grid((4, 4), UM))
    rects = np.array([[-2000, -2000, 0, 0], [-1000, -1000, 1000, 1000], [0, 0, 1001, 1000], [0, 0, 3000, 1000]])
    slanted = np.array([[0, 0], [1000, 0], [1000, 1000], [1, 1000]], dtype=np.int32)
    shapes = {Layer(1): Shapes(rects.astype(np.int32), (slanted,))}
    write_gds(tmp_path / "a.gds", Layout(NM, (Cell("TOP", shapes),)))
    (reading,) = GdstkReader(["TOP"], edges).gds(tmp_path / "a.gds", {Layer(1): 5}, [])
    assert reading.strays == 3
    assert reading.winding.tolist() == [[1, 1, 0, 0], [1, 2, 1, 0], [0, 1, 1, 0], [0, 0, 0, 0]]


def test_layers_are_read_in_as_many_passes_as_memory_asks_for(tmp_path, monkeypatch, level_map, levels, grid):
    layout = mask_layout(level_map, "TOP")
    write_gds(tmp_path / "a.gds", layout)
    passes = []
    read = gdstk.read_gds

    def counted(path, **options):
        passes.append(options["filter"])
        return read(path, **options)

    monkeypatch.setattr("fab.gds.gdstk_reader.gdstk.read_gds", counted)
    edges = pixel_edges(grid)

    def windings(count: int, *others: Layer) -> list[np.ndarray]:
        layers = {Layer(n): count for n in (1, 2, 3)}
        return [reading.winding for reading in GdstkReader(["TOP"], edges).gds(tmp_path / "a.gds", layers, others)]

    together = windings(1)
    assert len(passes) == 1
    apart = windings(2_000_000, Layer(7, 1), Layer(1))
    assert passes[1:] == [{(1, 0), (7, 1)}, {(2, 0)}, {(3, 0)}]
    assert np.array_equal(together, apart)


def test_what_does_not_belong_in_an_oasis_file_is_told(tmp_path):
    library = gdstk.Library()
    cell = library.new_cell("TOP")
    cell.add(gdstk.rectangle((0, 0), (1, 1), layer=9), gdstk.Label("text", (0, 0)))
    library.new_cell("OTHER")
    library.write_oas(str(tmp_path / "a.oas"))
    again = GdstkReader(["TOP"], pixel_edges(Grid((2, 2), UM)))
    (reading,) = again.oasis(tmp_path / "a.oas", [Layer(1)])
    assert not reading.winding.any()
    assert [any(word in problem for problem in again.problems) for word in ("labels", "9/0")] == [True] * 2
    assert [cell.name for cell in again.around] == ["OTHER"]


def test_another_database_unit_is_told_and_places_are_compared_in_metres(tmp_path):
    plane = np.array([[1, 0, 1], [0, 1, 1]], dtype=np.uint8)
    edges = pixel_edges(Grid(plane.shape, UM))
    shapes = Shapes(2 * rectangles(plane, edges.x, edges.y))
    write_gds(tmp_path / "a.gds", Layout(0.5 * NM, (Cell("TOP", {Layer(1): shapes}),)))
    again = GdstkReader(["TOP"], edges)
    (reading,) = again.gds(tmp_path / "a.gds", {Layer(1): len(shapes)}, [])
    assert again.problems == ["the database unit is 0.5 nm instead of 1 nm"]
    assert np.array_equal(reading.winding, plane)
