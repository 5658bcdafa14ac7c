"""Small files that stand for immense things: each is refused by counting, before anything is unfolded."""

import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from fab.archive import read_archive, write_archive
from fab.errors import InputError
from fab.files import read_npy
from fab.gds.gdstk_reader import GdstkReader
from fab.gds.reader import read_gds
from fab.gds.writer import oasis_to_gds, write_gds
from fab.grid import Grid
from fab.layout.geometry import Cell, Layer, Layout, Reference, Shapes, in_order, pixel_edges
from fab.layout.limits import MOST, Tally
from fab.pictures import read_display, read_pixels, write_pixels
from fab.solids.columns import reduced_cells
from fab.solids.mesh import relief_mesh
from fab.solids.meshfile import read_mesh, write_glb
from fab.units import NM, UM
from tests.campaign import bombs

SAYS = {
    "nested_arrays": "at most 500000 placed copies",
    "doublings": "at most 100000000 copies through all levels",
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


def test_an_oasis_file_may_stand_for_a_hundred_million_shapes_and_no_more(tmp_path: Path):
    # One record for 1.07e9 squares, so that a limit ten times as high refuses it too, and does not unfold it.
    with pytest.raises(InputError, match="at most 100000000 shapes"):
        list(GdstkReader([], EDGES).oasis(planted(tmp_path, "repeated_shapes", ".oas"), []))


@pytest.mark.parametrize("name", ["many_cells", "repeated_shapes"])
def test_an_altered_oasis_file_is_not_written_out(tmp_path: Path, name: str):
    with pytest.raises(InputError, match=SAYS[name]):
        oasis_to_gds(planted(tmp_path, name, ".oas"), tmp_path / "out.gds", 1000)
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


# --- pictures, meshes and arrays --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("a.png", lambda: bombs.png_bomb(8200, 8200), "from 1 to 67108864 pixels"),
        ("a.tif", lambda: bombs.tiff_bomb(8200, 8200, 1), "from 1 to 67108864 pixels"),
        ("a.tif", lambda: bombs.tiff_bomb(100, 100, 1 << 20), "a strip must unfold to its size"),
        ("a.tif", lambda: bombs.tiff_bomb(100, 100, 1 << 20, 34925), "must be packed by LZW, Deflate, PackBits"),
    ],
)
def test_a_picture_that_decodes_to_gigabytes_is_refused_by_its_header(tmp_path: Path, monkeypatch, name, data, says):
    monkeypatch.setattr("fab.pictures._SMALL_STRIP", 100)
    (tmp_path / name).write_bytes(data())
    with pytest.raises(InputError, match=says):
        read_pixels(tmp_path / name)


def test_a_photograph_that_promises_gigabytes_is_refused_by_its_header(tmp_path: Path):
    (tmp_path / "a.jpg").write_bytes(bombs.jpeg_bomb(9000, 9000))
    with pytest.raises(InputError, match="from 1 to 67108864 pixels"):
        read_display(tmp_path / "a.jpg", 100)


def test_a_large_picture_in_a_large_file_is_read(tmp_path: Path, monkeypatch):
    # As many pixels as the limit, and more in a file that has a byte for every eight.
    monkeypatch.setattr("fab.pictures.MOST_PIXELS", 100)
    values = np.random.default_rng(0).integers(0, 256, (40, 40), np.uint8)
    write_pixels(tmp_path / "a.png", values)
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png"), values)
    write_pixels(tmp_path / "b.png", values * 0)
    with pytest.raises(InputError, match="pixels"):
        read_pixels(tmp_path / "b.png")


def test_other_kinds_of_pictures_are_not_even_tried(tmp_path: Path):
    # EPS would start another program, and GIF was never promised.
    (tmp_path / "a.jpg").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n")
    with pytest.raises(InputError, match="must be a whole picture"):
        read_display(tmp_path / "a.jpg")


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("a.3mf", lambda: bombs.mesh_3mf_bomb(40_000), "more than 1000 triangles"),
        ("a.3mf", lambda: bombs.mesh_3mf_bomb(0, 4 << 20), "a model of .* bytes, where .* are the most"),
        ("a.glb", bombs.glb_bomb, "bufferView"),
        ("a.stl", lambda: bytes(80) + b"\xff\xff\xff\x7f", "84 bytes for 2147483647 triangles"),
    ],
)
def test_a_mesh_that_unfolds_without_bounds_is_refused(tmp_path: Path, name, data, says):
    (tmp_path / name).write_bytes(data())
    with pytest.raises(InputError, match=says):
        read_mesh(tmp_path / name, "mm" if name == "a.stl" else None, most=1000)


def test_a_mesh_with_data_in_other_files_is_refused(tmp_path: Path, level_map):
    mesh = relief_mesh(reduced_cells(level_map, 10), 1e-3)
    write_glb(tmp_path / "a.glb", mesh)
    assert len(read_mesh(tmp_path / "a.glb").triangles) == len(mesh.triangles)
    whole = (tmp_path / "a.glb").read_bytes()
    here = b'"buffers": [{"byteLength": '
    elsewhere = b'"buffers":[{"uri":"a","b":'.ljust(len(here))
    (tmp_path / "a.glb").write_bytes(whole.replace(here, elsewhere))
    with pytest.raises(InputError, match="data in other files"):
        read_mesh(tmp_path / "a.glb")


@pytest.mark.parametrize(
    "change",
    [
        {"nodes": [{"mesh": 0}] * 500, "scenes": [{"nodes": list(range(500))}]},
        {"nodes": [{"mesh": 0}], "scenes": [{"nodes": [0] * 500}]},
        {"nodes": [{"mesh": 0}, *({"children": [n, n]} for n in range(30))], "scenes": [{"nodes": [30]}]},
        {"meshes": [{"primitives": [{"attributes": {"POSITION": 1}, "indices": 0}] * 500}]},
        {"accessors": [{"bufferView": 0, "componentType": 5125, "count": 3, "type": "SCALAR"}] * 500},
    ],
)
def test_a_mesh_that_is_placed_many_times_is_refused(tmp_path: Path, level_map, change):
    write_glb(tmp_path / "a.glb", relief_mesh(reduced_cells(level_map, 10), 10 * UM))
    data = (tmp_path / "a.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    text = json.dumps(json.loads(data[20 : 20 + length]) | change).encode()
    text += b" " * (-len(text) % 4)
    parts = [
        struct.pack("<III", 0x46546C67, 2, len(data) - length + len(text)),
        struct.pack("<II", len(text), 0x4E4F534A),
    ]
    (tmp_path / "a.glb").write_bytes(b"".join([*parts, text, data[20 + length :]]))
    with pytest.raises(InputError, match="other than one mesh of one part, which is placed once"):
        read_mesh(tmp_path / "a.glb")


def test_an_array_that_promises_more_than_it_holds_is_refused(tmp_path: Path):
    (tmp_path / "a.npy").write_bytes(bombs.npy_bomb())
    with pytest.raises(InputError, match=r"whole \.npy file"):
        read_npy(tmp_path / "a.npy")


def test_an_archive_whose_members_lie_over_each_other_is_refused(tmp_path: Path):
    write_archive(tmp_path / "a.npz", {}, {"a": np.zeros(1000)})
    data = (tmp_path / "a.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        start = archive.start_dir
    # The directory lists the same members fifty times.
    end = data.rindex(b"PK\5\6")
    entries = data[start:end] * 50
    tail = struct.pack("<HHHHIIH", 0, 0, 100, 100, len(entries), start, 0)
    (tmp_path / "a.npz").write_bytes(data[:start] + entries + b"PK\5\6" + tail)
    with pytest.raises(InputError, match="lie over each other"):
        read_archive(tmp_path / "a.npz", "archive", "Write it again.")
