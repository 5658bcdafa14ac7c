"""The order form: what a mask shop has to know about every mask, after the fields of SEMI P10.

The same form comes as CSV, a row per mask and the unit of every number in its column's name, and as a page to print.
What the customer did not say stays blank in both, and the last column of the CSV lists these blanks.
"""

import csv
import io
from collections.abc import Mapping
from typing import Any

from fab.layout.frame import Frame
from fab.layout.geometry import Box, Layer, box_around, placed_boxes
from fab.layout.part import Photomask
from fab.layout.structures import BAR_WIDTHS_UM
from fab.order.drawing import DrawnOrder
from fab.order.order import Order
from fab.runsheet.page import html_page
from fab.units import MM, NM, UM

Values = dict[str, Any]

# Keys that every mask of an order shares, in the order of the form, with the words of the page. None in a record is a
# blank; forms of earlier orders say nothing of sizing.
SHARED: Mapping[str, str] = {
    "revision": "revision",
    "company": "company",
    "contact": "contact",
    "purchase_order": "purchase order",
    "ship_to": "ship to",
    "quantity": "quantity, copies of each mask",
    "plate_size_mm": "plate size (mm, square)",
    "plate_thickness_mm": "plate thickness (mm)",
    "plate_flatness_um": "plate flatness (um)",
    "glass": "glass",
    "chrome": "chrome",
    "orientation": "orientation",
    "scale": "scale of the data",
    "sizing": "sizing of the data by the mask shop",
    "data_grid_nm": "grid of the data (nm)",
    "address_grid_nm": "address grid of the writer (nm)",
    "cd_tolerance_nm": "tolerance of line widths (nm, plus or minus)",
    "registration_nm": "registration (nm, plus or minus)",
    "defect_class": "defect class",
    "defect_size_um": "smallest defect that counts (um)",
    "defects_per_cm2": "accepted defects (per cm2)",
    "pellicle": "pellicle",
    "remarks": "remarks",
}


def form_record(drawing: DrawnOrder, plates: Mapping[str, str]) -> Values:
    """Return the form as JSON values, None where it is blank; `plates` are the SHA-256 of the masks' files by name."""
    order, boxes = drawing.order, placed_boxes(drawing.layout)
    return {
        "job": order.stem,
        "geometry_sha256": order.geometry,
        "shared": _shared(order),
        "masks": [_mask(drawing, photomask, plates, boxes) for photomask in order.photomasks],
    }


def _shared(order: Order) -> Values:
    terms = order.terms

    def in_units(length_m: float | None, unit_m: float) -> float | None:
        return None if length_m is None else round(length_m / unit_m, 9)

    return {
        **{key: getattr(terms, key, None) for key in SHARED if key != "sizing" or terms.sizing},
        "plate_size_mm": in_units(order.wafer.blank_m, MM),
        "plate_thickness_mm": in_units(terms.blank_thickness_m, MM),
        "plate_flatness_um": in_units(terms.blank_flatness_m, UM),
        "orientation": f"{order.wafer.reading}; the data are not mirrored",
        "scale": _scale(order),
        "data_grid_nm": in_units(order.dbu_m, NM),
        "address_grid_nm": in_units(terms.address_grid_m, NM),
        "cd_tolerance_nm": in_units(terms.cd_tolerance_m, NM),
        "registration_nm": in_units(terms.registration_m, NM),
        "defect_size_um": in_units(terms.defect_size_m, UM),
    }


def _scale(order: Order) -> str:
    reduction = order.process.reduction
    return "1:1" if reduction == 1 else f"1:1; the reticle is the cell of a die, {reduction} times as large"


def _mask(drawing: DrawnOrder, photomask: Photomask, plates: Mapping[str, str], boxes: Mapping[Layer, Box]) -> Values:
    order, stem = drawing.order, drawing.order.photomask_stem(photomask)
    file = order.plate_file(stem)
    written = box_around(box for layer, box in boxes.items() if layer.number == photomask.layer)
    field, opposite = ("dark field", "chrome") if photomask.tone == "clear" else ("clear field", "clear")
    x0, y0, x1, y1 = (round(edge * order.dbu_m / MM, 6) for edge in written or (0, 0, 0, 0))
    return {
        "mask": photomask.name,
        "makes": f"etch {photomask.depth}" if photomask.bit is not None else photomask.makes,
        "polarity": f"{field}: polygons {photomask.tone}, {opposite} elsewhere",
        "file": file,
        "format": "GDSII, packed by gzip" if file.endswith(".gz") else "GDSII",
        "sha256": plates[file],
        "top_cell": stem,
        "layer": f"{photomask.layer}/0",
        "data_left_mm": x0,
        "data_bottom_mm": y0,
        "data_right_mm": x1,
        "data_top_mm": y1,
        **_line_width(order, drawing.frame, photomask),
        "title": stem,
    }


def _line_width(order: Order, frame: Frame, photomask: Photomask) -> Values:
    """Return the line by which the mask shop measures its line width: the narrowest that the process prints."""
    printed = [width for width in BAR_WIDTHS_UM if width * UM >= order.process.minimum_line_m * (1 - 1e-9)]
    for width in printed or BAR_WIDTHS_UM[-1:]:
        ending = f"CD {width:g} um line, {photomask.name}"
        for name, (x_m, y_m) in frame.places.items():
            if name.endswith(ending):
                x_mm, y_mm = round(x_m / MM, 6), round(y_m / MM, 6)
                return {"cd_line": f"{photomask.tone} line", "cd_um": width, "cd_x_mm": x_mm, "cd_y_mm": y_mm}
    return {"cd_line": "no line on this mask", "cd_um": None, "cd_x_mm": None, "cd_y_mm": None}


def form_csv(record: Values) -> bytes:
    """Return a form as CSV: a row per mask, what all masks share repeated in each, blanks empty and listed at last."""
    job = {"job": record["job"], "geometry_sha256": record["geometry_sha256"]}
    blanks = "; ".join(key for key, value in record["shared"].items() if value is None)
    rows = [{**job, **mask, **record["shared"], "to_be_filled_in": blanks} for mask in record["masks"]]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\r\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def form_page(record: Values, csv_name: str) -> bytes:
    """Return a form as a page to print, which tells the reader the name of the CSV."""
    words = {key: text for key, text in SHARED.items() if key in record["shared"]}
    return html_page("order.html", form=record, words=words, csv_name=csv_name)
