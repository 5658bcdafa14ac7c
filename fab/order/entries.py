"""Entries of the manifest of an order: its masks, its chrome, its photomasks, its wafer and its splits."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fab.layout.frame import Frame
from fab.layout.geometry import Cell, PixelEdges, chrome_layer, etch_layer, on_units
from fab.layout.part import Photomask
from fab.layout.polygons import smallest_runs
from fab.layout.split import DieSplit
from fab.manifest.cells import geometry, shapes_digest
from fab.manifest.records import (
    CHROME_MEANS,
    ChromeEntry,
    DrawnEntry,
    MaskEntry,
    PhotomaskEntry,
    SplitEntry,
    WaferEntry,
    etch_means,
    plane_digest,
)
from fab.order.order import Order
from fab.units import MM, NM, UM, format_length


def mask_entry(order: Order, doe: Cell, bit: int, plane: NDArray[np.uint8]) -> MaskEntry:
    """Return the manifest's entry of an etch mask, from the DOE's cell and from its plane before the edges moved."""
    levels, pitch_m = order.level_map.levels, order.level_map.grid.pitch_m
    layer = etch_layer(bit, levels)
    width_um, space_um = (None if run is None else round(run * pitch_m / UM, 6) for run in smallest_runs(plane))
    stem = order.mask_stem(bit)
    return MaskEntry(
        mask=bit + 1,
        bit=bit,
        layer=layer.number,
        datatype=layer.datatype,
        file=order.plate_file(stem),
        cell=stem,
        depth_nm=round(levels.etch_depth_m(bit) / NM, 9),
        edge_move_nm=round(order.edge_moves()[bit] * order.dbu_m / NM, 9),
        polygon_means=etch_means(order.process.tone),
        smallest_width_um=width_um,
        smallest_space_um=space_um,
        plane_sha256=plane_digest(plane),
        **geometry(doe.shapes[layer], order.dbu_m),  # type: ignore[arg-type]
    )


def chrome_entry(order: Order, doe: Cell) -> ChromeEntry:
    """Return the manifest's entry of the chrome around the clear aperture."""
    layer = chrome_layer(order.level_map.levels)
    opening = on_units(order.chrome.opening(order.level_map.relief), order.dbu_m)
    outer = round(order.chrome.rim_m(order.level_map) / order.dbu_m)
    return ChromeEntry(
        layer=layer.number,
        datatype=layer.datatype,
        file=order.plate_file(f"{order.stem}_CHROME"),
        cell=f"{order.stem}_CHROME",
        polygon_means=CHROME_MEANS,
        opening_diameter_mm=opening.record(MM, 9),
        outer_diameter_mm=round(2 * outer * order.dbu_m / MM, 9),
        overlap_um=round(order.chrome.overlap_m / UM, 9),
        chord_error_nm=round(order.chrome.chord_error_m / NM, 9),
        shapes_sha256=shapes_digest(doe.shapes[layer]),
        **geometry(doe.shapes[layer], order.dbu_m),  # type: ignore[arg-type]
    )


def photomask_entry(order: Order, photomask: Photomask) -> PhotomaskEntry:
    """Return the manifest's entry of a mask as the shop makes it."""
    dark_field = photomask.tone == "clear"
    return PhotomaskEntry(
        mask=photomask.name,
        makes=photomask.makes,
        layer=photomask.layer,
        bit=photomask.bit,
        depth_nm=None if photomask.bit is None else round(photomask.depth_m / NM, 9),
        file=order.plate_file(order.photomask_stem(photomask)),
        polygons=f"digitised data {photomask.tone}: polygons are {'clear' if dark_field else 'chrome'} on the plate",
        field="dark field" if dark_field else "clear field",
        reading=order.wafer.reading,
    )


def wafer_entry(order: Order, frame: Frame) -> WaferEntry:
    """Return the manifest's entry of the wafer, and of what lies where on it."""
    wafer = order.wafer
    places = {name: [round(x / UM, 6), round(y / UM, 6)] for name, (x, y) in sorted(frame.places.items())}
    return WaferEntry(
        diameter_mm=round(wafer.diameter_m / MM, 9),
        thickness_mm=round(wafer.thickness_m / MM, 9),
        blank_mm=round(wafer.blank_m / MM, 9),
        edge_exclusion_mm=round(wafer.edge_exclusion_m / MM, 9),
        flat_mm=round(wafer.usual_flat_m / MM, 9),
        notch_mm=round(wafer.notch_m / MM, 9),
        die_mm=round(frame.die_m / MM, 9),
        die_pitch_mm=round(frame.pitch_m / MM, 9),
        dies_mm=[[round(x / MM, 9), round(y / MM, 9)] for x, y in frame.dies],
        places_um=places,
    )


def split_entries(order: Order, does: Sequence[Cell], frame: Frame) -> list[SplitEntry]:
    """Return the manifest's entries of the dies that draw the DOE differently, as the cells of `does` say."""
    return [
        SplitEntry(
            cell.name,
            split.words,
            [n for n, die in enumerate(frame.splits, 1) if die == number],
            _drawn_entries(order, split, cell),
        )
        for number, (split, cell) in enumerate(zip(order.splits, does, strict=True))
        if number
    ]


def _drawn_entries(order: Order, split: DieSplit, cell: Cell) -> list[DrawnEntry]:
    layers = [etch_layer(mask, order.level_map.levels) for mask in range(order.process.masks)]
    return [
        DrawnEntry(
            layer=layer.number,
            datatype=layer.datatype,
            bit=bit,
            edge_move_nm=round(move * order.dbu_m / NM, 9),
            **geometry(cell.shapes[layer], order.dbu_m),  # type: ignore[arg-type]
        )
        for layer, bit, move in zip(layers, split.bits, split.moves, strict=True)
    ]


def describe_edges(edges: PixelEdges) -> str:
    """Return in words how pixel edges were rounded to the database unit."""
    unit = format_length(edges.dbu_m)
    if edges.shift_m == 0:
        return f"every pixel edge is a whole number of {unit}"
    return (
        f"each pixel edge is rounded to {unit}, neighbours alike; the largest shift is {format_length(edges.shift_m)}"
    )
