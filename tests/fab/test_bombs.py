"""Small files that stand for immense things: each is refused by counting, before anything is unfolded."""

from pathlib import Path

import numpy as np
import pytest

from fab.errors import InputError
from fab.gds.gdstk_reader import GdstkReader
from fab.gds.reader import read_gds
from fab.gds.writer import oasis_to_gds, write_gds
from fab.grid import Grid
from fab.layout.geometry import Cell, Layer, Layout, Reference, Shapes, in_order, pixel_edges
from fab.layout.limits import MOST, Tally
from fab.units import NM, UM
from tests.campaign import bombs

SAYS = {
    "nested_arrays": "at most 100000 placed copies",
    "doublings": "at most 10000000 copies through all levels",
    "chain": "at most 32 cells placed one within another",
    "many_cells": "at most 2000 cells",
    "many_polygons": "at most 20000 polygons that are no rectangles",
    "repeated_shapes": "at most 1000 shapes",
}
# As large as a refusal takes: the files of the campaign take seconds to make.
SMALLER = {"chain": 100, "many_cells": 2001, "many_polygons": 20_001}
EDGES = pixel_edges(Grid((8, 8), 1 * UM))


def planted(folder: Path, name: str, ending: str) -> Path:
    make = {**bombs.DRAWINGS, "repeated_shapes": bombs.repeated_shapes}[name]
    path = folder / f"{name}{ending}"
    path.write_bytes(bombs.drawn(make(*[SMALLER[name]] if name in SMALLER else []), ending))
    return path


@pytest.mark.parametrize("name", bombs.DRAWINGS)
def test_a_drawing_that_unfolds_without_bounds_is_refused_as_it_is_read(tmp_path: Path, name: str):
    with pytest.raises(InputError, match=SAYS[name]):
        read_gds(planted(tmp_path, name, ".gds"))


@pytest.mark.parametrize("name", ["nested_arrays", "many_cells", "many_polygons", "repeated_shapes"])
def test_an_oasis_file_that_unfolds_without_bounds_is_refused_by_the_library_s_counts(tmp_path: Path, name: str):
    path = planted(tmp_path, name, ".oas")
    most = 1000 if name == "repeated_shapes" else 10**6
    with pytest.raises(InputError, match=SAYS[name]):
        list(GdstkReader([], EDGES).oasis(path, [], most))


def test_an_altered_oasis_file_is_not_written_out(tmp_path: Path):
    with pytest.raises(InputError, match="at most 1000 shapes"):
        oasis_to_gds(planted(tmp_path, "repeated_shapes", ".oas"), tmp_path / "out.gds", 1000)
    assert not (tmp_path / "out.gds").exists()


def test_a_drawing_at_the_limits_is_read(tmp_path: Path):
    # A raster of as many copies as may be, as deep as may be.
    cells = [Cell("C0", {Layer(1): Shapes(np.array([[0, 0, 5, 5]], np.int32))})]
    for level in range(1, MOST["cells placed one within another"] - 1):
        cells.append(Cell(f"C{level}", {}, (Reference(f"C{level - 1}"),)))
    wide = Reference(cells[-1].name, 0, 0, 200, 300, 10, 10)
    write_gds(tmp_path / "most.gds", Layout(NM, (*cells, Cell("TOP", {}, (wide,)))))
    assert read_gds(tmp_path / "most.gds").top.references == (wide,)


def test_cells_are_sorted_by_rounds_and_then_as_they_came():
    # Each round takes every cell all of whose placed cells are there already.
    cells = [
        Cell("TOP", {}, (Reference("B"), Reference("D"))),
        Cell("B", {}, (Reference("A"),)),
        Cell("D", {}),
        Cell("A", {}),
    ]
    assert [cell.name for cell in in_order(cells)] == ["D", "A", "B", "TOP"]


def test_a_long_chain_is_sorted_and_counted_at_once():
    names = [f"C{n}" for n in range(20_000)]
    cells = [
        Cell(name, {}, (Reference(below),) if below else ()) for name, below in zip(names, [None, *names], strict=False)
    ]
    ordered = in_order(reversed(cells))
    assert [cell.name for cell in ordered] == names
    with pytest.raises(
        InputError, match=r"f\.gds: a drawing may hold at most 32 cells placed one within another, but got"
    ):
        Tally("f.gds").add_places(ordered)
