"""Files for direct-write and greyscale exposure: a layer per level, merged, and a table of doses with blanks."""

import csv
import io

import klayout.db as kdb
import numpy as np
import pytest

from fab.levels import Levels
from fab.order.verify import verify
from fab.order.write import write_order
from fab.pictures import read_pixels
from tests.fab.maps import FEW, level_map_from
from tests.fab.mended import mend, told
from tests.orders import named

LEVELS = Levels(4, 300e-9)
# More than one field of 64 pixels either way, with rings, which have holes.
Y, X = np.indices((70, 90)) - 40
LEVEL = (np.hypot(X, Y).astype(int) // 3) % 4


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    level_map = level_map_from(LEVEL, LEVELS, 2e-6, 140e-6, "grey")
    return write_order(tmp_path_factory.mktemp("direct") / "o", level_map, wafer=FEW, direct_write=True).folder


@pytest.mark.parametrize("ending", ["DIRECT.oas", "DIRECT.dxf"])
def test_every_level_is_a_layer_of_merged_polygons(folder, ending):
    options = kdb.LoadLayoutOptions()
    options.dxf_dbu = 1e-3
    layout = kdb.Layout()
    layout.read(str(named(folder, ending)), options)
    level = np.load(named(folder, "LEVELS.npy"))
    names = {info.name: index for index, info in zip(layout.layer_indexes(), layout.layer_infos(), strict=True)}
    origin, pixel = kdb.Point(-90_000, -70_000), kdb.Vector(2000, 2000)
    for number in range(4):
        region = kdb.Region(layout.top_cell().begin_shapes_rec(names[f"LEVEL_{number}_{300 * number}NM_HIGH"]))
        region.merged_semantics = False
        areas = np.array(region.rasterize(origin, pixel, pixel, 90, 70))
        assert np.array_equal(areas, (level == number) * 2000**2)
        # A rectangle per run of pixels would be hundreds.
        assert region.count() < 200


def test_the_drawing_says_its_unit(folder):
    begun = named(folder, "DIRECT.dxf").read_text().splitlines()[:4]
    assert begun == ["999", "unit of all lengths: 1 micrometre", "0", "SECTION"]


def test_the_dose_is_for_the_lab_to_fill_in(folder):
    rows = list(csv.DictReader(io.StringIO(named(folder, "DOSE.csv").read_text())))
    assert [(row["level"], row["layer"], float(row["height_nm"]), float(row["depth_nm"])) for row in rows] == [
        ("3", "4/0", 900, 0),
        ("2", "3/0", 600, 300),
        ("1", "2/0", 300, 600),
        ("0", "1/0", 0, 900),
    ]
    assert {row["dose_mJ_per_cm2"] for row in rows} == {""}


def test_greyscale_has_sixteen_bits(folder):
    grey = read_pixels(named(folder, "GREY.png"))
    assert sorted(set(grey.ravel())) == [0, 21845, 43690, 65535]


def test_a_pixel_more_is_told(folder):
    assert verify(folder).passed
    path = named(folder, "DIRECT.oas")
    kept = path.read_bytes(), (folder / "manifest.json").read_bytes()
    layout = kdb.Layout()
    layout.read(str(path))
    layout.top_cell().shapes(layout.layer_indexes()[0]).insert(kdb.Box(0, 0, 2000, 2000))
    layout.write(str(path))
    mend(folder, path.name)
    assert "1 pixels differ from the level map" in told(folder, path.name)
    path.write_bytes(kept[0])
    (folder / "manifest.json").write_bytes(kept[1])
