"""Small files that stand for immense things: drawings, pictures and archives that a reader must refuse unopened.

Each function returns the bytes of the files by name; the ending says what kind of file it is.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path

import gdstk

TOP = "DOE_EXAMPLE_DOE"
UM, NM = 1e-6, 1e-9


def _library() -> tuple[gdstk.Library, gdstk.Cell]:
    library = gdstk.Library(unit=UM, precision=NM)
    cell = gdstk.Cell("LEAF")
    cell.add(gdstk.rectangle((0, 0), (1, 1), layer=1))
    library.add(cell)
    return library, cell


def nested_arrays(depth: int = 5, count: int = 32767) -> gdstk.Library:
    """Arrays of arrays: one square, drawn (count^2)^depth times."""
    library, cell = _library()
    for level in range(depth):
        above = gdstk.Cell(f"ARRAY_{level}")
        above.add(gdstk.Reference(cell, columns=count, rows=count, spacing=(1, 1)))
        library.add(above)
        cell = above
    return library


def doublings(depth: int = 30) -> gdstk.Library:
    """Cells that place the one below twice: one square, drawn 2^depth times without a single array."""
    library, cell = _library()
    for level in range(depth):
        above = gdstk.Cell(f"TWICE_{level}")
        above.add(gdstk.Reference(cell), gdstk.Reference(cell, (1, 0)))
        library.add(above)
        cell = above
    return library


def chain(length: int = 20_000) -> gdstk.Library:
    """Cells that each place the one before."""
    library, cell = _library()
    for level in range(length):
        above = gdstk.Cell(f"LINK_{level}")
        above.add(gdstk.Reference(cell))
        library.add(above)
        cell = above
    return library


def many_cells(count: int = 30_000) -> gdstk.Library:
    """A heap of cells that nothing places."""
    library = _library()[0]
    for number in range(count):
        cell = gdstk.Cell(f"CELL_{number}")
        cell.add(gdstk.rectangle((0, 0), (1, 1), layer=1))
        library.add(cell)
    return library


def many_polygons(count: int = 200_000) -> gdstk.Library:
    """One cell of pentagons."""
    library = gdstk.Library(unit=UM, precision=NM)
    cell = gdstk.Cell(TOP)
    for k in range(count):
        cell.add(gdstk.Polygon([(k, 0), (k + 1, 0), (k + 1, 1), (k + 0.5, 2), (k, 1)], layer=1))
    library.add(cell)
    return library


def repeated_shapes(count: int = 32767) -> gdstk.Library:
    """One square, repeated in place: OASIS keeps that as one record."""
    library, cell = _library()
    square = gdstk.rectangle((0, 0), (1, 1), layer=1)
    square.repetition = gdstk.Repetition(columns=count, rows=count, spacing=(2, 2))
    cell.add(square)
    return library


DRAWINGS: dict[str, Callable[[], gdstk.Library]] = {
    function.__name__: function for function in (nested_arrays, doublings, chain, many_cells, many_polygons)
}


def gds_bombs() -> dict[str, bytes]:
    """Drawings as GDSII."""
    return {f"{name}.gds": drawn(make(), ".gds") for name, make in DRAWINGS.items()}


def oasis_bombs() -> dict[str, bytes]:
    """Drawings as OASIS."""
    return {
        f"{name}.oas": drawn(make(), ".oas") for name, make in {**DRAWINGS, "repeated_shapes": repeated_shapes}.items()
    }


def drawn(library: gdstk.Library, ending: str) -> bytes:
    """Bytes of a drawing as ".gds" or ".oas"."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"drawing{ending}"
        (library.write_gds if ending == ".gds" else library.write_oas)(str(path))
        return path.read_bytes()
