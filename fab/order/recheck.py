"""Files by which a lab looks at an order and checks it again with KLayout alone.

<JOB>_LAYERS.lyp    names and colours of all layers of the review file, for KLayout's layer panel
<JOB>_CHECK.drc     lines, spaces, grid, overlaps, and every plate file against the review file
"""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

from fab.figure import CHROME, FAINT, SERIES
from fab.layout.geometry import Layer
from fab.order.order import Order
from fab.units import UM

_ZERO = "#5b3a1e"


def layer_properties(order: Order, layers: Iterable[Layer]) -> bytes:
    """Return KLayout's layer properties (XML): masks in their colours, outlines as outlines."""
    entries = []
    for layer in sorted(layers, key=lambda one: (one.number, one.datatype)):
        photomask = next((one for one in order.photomasks if one.layer == layer.number), None)
        if photomask is None:
            colour, pattern = FAINT, "I1"  # an outline, hollow
        else:
            colour = CHROME if photomask.makes != "zero layer" else _ZERO
            colour = colour if photomask.bit is None else SERIES[photomask.bit % len(SERIES)]
            pattern = "I9" if layer.datatype == 0 else "I5"
        properties = {
            "frame-color": colour,
            "fill-color": colour,
            "dither-pattern": pattern,
            "valid": "true",
            "visible": "true",
            "transparent": "true",
            "width": "1",
            "name": layer.name,
            "source": f"{layer}@1",
        }
        lines = (f"  <{key}>{escape(value)}</{key}>\n" for key, value in properties.items())
        entries.append(f" <properties>\n{''.join(lines)} </properties>\n")
    return (
        f'<?xml version="1.0" encoding="utf-8"?>\n<layer-properties>\n{"".join(entries)}</layer-properties>\n'.encode()
    )


def drc_deck(order: Order, review: str) -> bytes:
    """Return the deck of checks (Ruby) for KLayout, which reads the review file of that name beside it.

    The process prints the planes as designed from edges that were moved against its bias; so the deck moves them back
    before it measures lines and spaces, as the rules do (`fab.rules.check`).
    """
    process, grid_m = order.process, order.terms.address_grid_m or order.dbu_m
    masks = [
        [photomask.name, order.plate_file(order.photomask_stem(photomask)), photomask.layer, photomask.bit is not None]
        for photomask in order.photomasks
    ]
    constants: dict[str, Any] = {
        "JOB": order.stem,
        "REVIEW": review,
        "GRID_UM": round(grid_m / UM, 9),
        "LINE_UM": round(process.minimum_line_m / UM, 9),
        "SPACE_UM": round(process.minimum_space_m / UM, 9),
        "MASKS": masks,
        # How far the edges of every mask are moved outward, mask 1 first.
        "DOES": [
            [f"{order.stem}_{split.code}", [round(move * order.dbu_m / UM, 9) for move in split.moves]]
            for split in order.splits
        ],
    }
    # JSON of text, numbers, lists and booleans is Ruby.
    head = "".join(f"{name} = {json.dumps(value)}\n" for name, value in constants.items())
    return head.encode() + b"\n" + Path(__file__).with_name("recheck.drc").read_bytes()
