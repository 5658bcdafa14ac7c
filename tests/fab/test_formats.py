"""The formats of an order: small by default, everything on request, and every one of them proved."""

import gzip
import shutil
from dataclasses import replace

import klayout.db as kdb
import numpy as np
import pytest

from fab.errors import InputError
from fab.gds.reader import read_gds
from fab.gds.writer import write_gds
from fab.layout.geometry import Cell, Layer, Layout, Shapes
from fab.manifest.records import read_manifest
from fab.order.formats import Formats
from fab.order.verify import verify
from fab.order.write import write_order
from fab.units import NM
from tests.fab.maps import FEW, SMALL
from tests.fab.mended import mend

M1 = f"{SMALL}_M1_75NM.gds.gz"


@pytest.fixture(scope="module")
def packed(tmp_path_factory, level_map):
    folder = tmp_path_factory.mktemp("formats") / "small"
    write_order(folder, level_map, source={"height_map": "a test"}, wafer=FEW)
    return folder


def test_a_usual_order_holds_packed_plates_and_one_layout(packed, written_order):
    assert read_manifest(packed).combined_gds is None
    assert {path.name for path in packed.glob("*.gds*")} == {
        f"{path.name}.gz" for path in written_order.glob("*.gds") if not path.name.endswith("ALL.gds")
    }
    for path in packed.glob("*.gds.gz"):
        assert gzip.decompress(path.read_bytes()) == (written_order / path.stem).read_bytes()
        # Neither the name nor the time is in the file.
        assert path.read_bytes()[3:8] == bytes(5)
    assert (packed / f"{SMALL}_ALL.oas").read_bytes() == (written_order / f"{SMALL}_ALL.oas").read_bytes()


def test_every_mask_file_is_read_by_two(packed):
    asked = {(check.file, check.question) for check in verify(packed).checks}
    for plate in read_manifest(packed).plates:
        assert {(plate.file, "own reader, every pixel"), (plate.file, "gdstk, every pixel")} < asked
    oasis = read_manifest(packed).combined_oasis
    assert {(oasis, "KLayout and own reader, every pixel"), (oasis, "gdstk, every pixel")} < asked


def test_klayout_opens_a_packed_plate_as_it_is(packed):
    layout = kdb.Layout()
    layout.read(str(packed / M1))
    assert layout.top_cell().name == M1.removesuffix(".gds.gz")
    drawn = read_gds(packed / M1)
    assert kdb.Region(layout.cell(f"{SMALL}_DOE").shapes(layout.find_layer(1, 0))).area() == sum(
        shapes.doubled_area / 2 for shapes in drawn.cells[0].shapes.values()
    )


def test_a_rectangle_moved_in_a_packed_plate_is_seen_by_both_readers(packed, tmp_path):
    folder = shutil.copytree(packed, tmp_path / "order")
    layout = read_gds(folder / M1)
    doe = layout.cells[0]
    rects = doe.shapes[Layer(1)].rectangles.copy()
    rects[0] += [1, 0, 1, 0]
    cells = (replace(doe, shapes={Layer(1): Shapes(rects, doe.shapes[Layer(1)].polygons)}), *layout.cells[1:])
    write_gds(folder / M1, Layout(layout.dbu_m, cells))
    mend(folder, M1)
    told = [difference for difference in verify(folder).differences if difference.startswith(M1)]
    assert any("own reader" in one and "off the pixel raster" in one for one in told)
    assert any("gdstk" in one and "no rectangles on the pixel raster" in one for one in told)


@pytest.mark.parametrize("harm", ["cut", "flipped", "plain", "trailing"])
def test_a_damaged_packed_file_is_refused(tmp_path, harm):
    path = tmp_path / "a.gds.gz"
    rects = np.array([[10 * i, 0, 10 * i + 5, 5] for i in range(999)], dtype=np.int32)
    write_gds(path, Layout(NM, (Cell("TOP", {Layer(1): Shapes(rects)}),)))
    assert np.array_equal(read_gds(path).top.shapes[Layer(1)].rectangles, rects)
    data = path.read_bytes()
    spoiled = {
        "cut": data[: len(data) // 2],
        "flipped": data[:200] + bytes([data[200] ^ 1]) + data[201:],
        "plain": gzip.decompress(data),
        "trailing": data + gzip.compress(b"more"),
    }
    path.write_bytes(spoiled[harm])
    with pytest.raises(InputError, match=r"a\.gds\.gz"):
        read_gds(path)


def test_a_packed_flood_is_refused(tmp_path):
    path = tmp_path / "a.gds.gz"
    write_gds(path, Layout(NM, (Cell("TOP", {Layer(1): Shapes(np.array([[0, 0, 1, 1]], dtype=np.int32))}),)))
    path.write_bytes(path.read_bytes() + gzip.compress(bytes(1 << 24)))
    with pytest.raises(InputError, match="at most 100 bytes for each of its own"):
        read_gds(path)


@pytest.mark.parametrize("wrong", [{"plates": "dxf"}, {"mesh_cells": 0}, {"mesh_cells": 5000}])
def test_formats_that_there_are_not_are_refused(wrong):
    with pytest.raises(InputError, match="formats"):
        Formats(**wrong)
