"""The order form: CSV and page say the same, from the drawing and from what the customer said, and nothing else."""

import csv
import io
import re
from collections import defaultdict
from dataclasses import asdict, replace
from typing import Any

import klayout.db as kdb
import numpy as np
import pytest

from fab.errors import InputError
from fab.files import canonical_json, sha256_file
from fab.manifest.records import read_manifest
from fab.order.drawing import draw
from fab.order.form import SHARED, form_csv, form_page, form_record
from fab.order.order import plan_order
from fab.order.request import request_of
from fab.order.terms import OrderTerms
from tests.fab.maps import FEW
from tests.orders import named


@pytest.fixture(scope="module")
def rows(written_order):
    text = named(written_order, "ORDER.csv").read_bytes().decode()
    return list(csv.DictReader(io.StringIO(text)))


def test_every_mask_has_its_row_in_order_of_use_with_the_digest_of_its_file(written_order, rows):
    manifest = read_manifest(written_order)
    assert [row["mask"] for row in rows] == [plate.mask for plate in manifest.plates]
    for row, plate in zip(rows, manifest.plates, strict=True):
        assert row["file"] == plate.file
        assert row["sha256"] == sha256_file(written_order / plate.file)
        assert row["polarity"].startswith(plate.field)
        assert row["geometry_sha256"] == manifest.geometry_sha256


def test_the_written_area_and_the_line_to_measure_are_those_of_the_file(written_order, rows):
    for row in rows:
        layout = kdb.Layout()
        layout.read(str(written_order / row["file"]))
        number = int(row["layer"].split("/")[0])
        assert layout.top_cell().name == row["top_cell"]
        box = layout.top_cell().bbox()
        stated = [float(row[f"data_{side}_mm"]) * 1e6 for side in ("left", "bottom", "right", "top")]
        assert stated == pytest.approx([box.left, box.bottom, box.right, box.top], abs=0.5)
        # Across the middle of the lone bar, one polygon as wide as the form says.
        x, y = (round(float(row[f"cd_{axis}_mm"]) * 1e6) for axis in ("x", "y"))
        drawn = kdb.Region(layout.top_cell().begin_shapes_rec(layout.layer(number, 0))).merged()
        across = drawn & kdb.Region(kdb.Box(x - 5000, y - 10, x + 5000, y + 10))
        assert [polygon.bbox().width() for polygon in across.each()] == [round(float(row["cd_um"]) * 1e3)]


def test_what_nobody_said_is_blank_and_listed(written_order, rows):
    page = named(written_order, "ORDER.html").read_text()
    blanks = rows[0]["to_be_filled_in"].split("; ")
    for row in rows:
        assert row["to_be_filled_in"].split("; ") == blanks
        assert {"quantity", "glass", "chrome", "cd_tolerance_nm", "pellicle", "contact"} <= set(blanks)
        assert [key for key in SHARED if row[key] == ""] == blanks
        assert row["revision"] == "A"
        assert (float(row["plate_size_mm"]), float(row["data_grid_nm"])) == (127, 1)
        assert row["sha256"] in page
    assert page.count("to be filled in</small>") == len(blanks)


def test_what_was_said_stands_in_every_row():
    shared = dict.fromkeys(SHARED) | {"quantity": 2, "glass": 'quartz, "synthetic"', "cd_tolerance_nm": 150.0}
    record = {"job": "J", "geometry_sha256": "0", "shared": shared, "masks": [{"mask": "mask 1"}, {"mask": "chrome"}]}
    rows = list(csv.DictReader(io.StringIO(form_csv(record).decode())))
    assert [(row["mask"], row["quantity"], row["glass"], row["cd_tolerance_nm"]) for row in rows] == [
        ("mask 1", "2", 'quartz, "synthetic"', "150.0"),
        ("chrome", "2", 'quartz, "synthetic"', "150.0"),
    ]


@pytest.mark.parametrize(
    ("terms", "where"),
    [
        ({"revision": "a"}, "revision"),
        ({"revision": "ABCD"}, "revision"),
        ({"contact": "two\nlines"}, "contact"),
        ({"remarks": "x" * 201}, "remarks"),
        ({"quantity": 0}, "quantity"),
        ({"quantity": "3"}, "quantity"),
        ({"cd_tolerance_m": -1e-9}, "cd_tolerance_m"),
        ({"blank_thickness_m": 2.3}, "blank_thickness_m"),
        ({"defects_per_cm2": float("nan")}, "defects_per_cm2"),
    ],
)
def test_impossible_terms_are_refused(terms, where):
    with pytest.raises(InputError, match=re.escape(f"order: {where}")):
        OrderTerms(**terms)


def test_a_quantity_of_numpy_goes_into_json():
    copies: Any = np.int64(2)
    assert canonical_json(asdict(OrderTerms(quantity=copies))) == canonical_json(asdict(OrderTerms(quantity=2)))


def test_the_form_says_that_the_mask_shop_moves_no_edges_or_how_far(written_order, rows, level_map):
    assert {row["sizing"] for row in rows} == {"none: lines on the plate as wide as in the data"}
    assert "sizing of the data by the mask shop" in named(written_order, "ORDER.html").read_text()
    order = plan_order(level_map, terms=OrderTerms(sizing="0.1 um inward"))
    assert order.terms.sizing == "0.1 um inward"


def test_the_form_of_an_order_that_said_nothing_of_sizing_stays_as_it_is(level_map):
    earlier = draw(replace(plan_order(level_map, wafer=FEW), terms=OrderTerms()))
    assert "sizing" not in request_of(earlier.order)["terms"]
    record = form_record(earlier, defaultdict(str))
    assert "sizing" not in record["shared"]
    assert b"sizing" not in form_csv(record)
    assert b"sizing of the data" not in form_page(record, "FORM.csv")
