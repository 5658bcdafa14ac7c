"""The drawing of an order, and all that its manifest says, before anything is written.

The writer writes what is drawn here; `fab.order.verify` draws it again from the manifest and compares.
"""

import platform
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from typing import Any, TypeVar

from fab.files import canonical_json, sha256_bytes
from fab.layout.arrays import unfolded
from fab.layout.doe import mask_layout
from fab.layout.frame import Frame, draw_frame
from fab.layout.geometry import Cell, Layer, Layout, chrome_layer, merged, pixel_edges
from fab.layout.part import Photomask
from fab.manifest.cells import cell_entry
from fab.manifest.records import FORMAT, FileEntry, Manifest, ModelEntry, conventions_of
from fab.order.entries import chrome_entry, describe_edges, mask_entry, photomask_entry, split_entries, wafer_entry
from fab.order.order import Order
from fab.order.request import request_of
from fab.solids.model import DoeModel
from fab.units import MM, NM, UM

_TOOLS = ("doedesign", "numpy", "numba", "klayout", "gdstk", "matplotlib")
# What is drawn from an order that was drawn just now need not be drawn again: small things of a few orders.
_MOST_KEPT = 32
_KEPT: dict[tuple[str, str], Any] = {}

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class DrawnOrder:
    """An order, every cell of its combined layout (those of the DOE first), and where everything lies."""

    order: Order
    layout: Layout
    frame: Frame

    @cached_property
    def does(self) -> tuple[Cell, ...]:
        """The cells of the DOE, one for each split, with all that they draw, even where it is an array of one cell."""
        names = [f"{self.order.stem}_{split.code}" for split in self.order.splits]
        cells = unfolded(self.layout, names, sys.maxsize).cells
        return cells[: len(names)]

    def plate(self, photomask: Photomask) -> Layout:
        """Return the drawing of one photomask."""
        return plate_of(self.layout, Layer(photomask.layer), self.order.photomask_stem(photomask))

    @cached_property
    def model(self) -> DoeModel:
        """The DOE as solids and height maps show it."""
        order, frame = self.order, self.frame
        at, cells = (frame.die_m, frame.dies, frame.bare_m), order.formats.mesh_cells
        return DoeModel(order.level_map, order.chrome, order.wafer, *at, order.patch, order.direct_write, cells)

    def kept(self, what: str, make: Callable[[], T]) -> T:
        """Return what was made from this very order before, whatever its light, or make it."""
        return _kept(self.order, what, make)


def _kept(order: Order, what: str, make: Callable[[], T]) -> T:
    request = request_of(replace(order, light=None))
    key = (what, sha256_bytes(canonical_json([request, order.level_map.digest])))
    if key not in _KEPT:
        while len(_KEPT) >= _MOST_KEPT:
            del _KEPT[next(iter(_KEPT))]
        _KEPT[key] = make()
    return _KEPT[key]


def plate_of(layout: Layout, layer: Layer, top: str) -> Layout:
    """Return the part of a layout that is on a photomask: one layer number, all datatypes merged onto datatype 0."""
    cells = []
    for cell in layout.cells:
        parts = [shapes for other, shapes in cell.shapes.items() if other.number == layer.number and len(shapes)]
        name = top if cell is layout.top else cell.name
        cells.append(Cell(name, {layer: merged(parts)} if parts else {}, cell.references))
    return Layout(layout.dbu_m, tuple(cells))


def draw(order: Order) -> DrawnOrder:
    """Draw the DOE as its dies hold it, and everything around it."""
    level_map = order.level_map
    does = [
        mask_layout(level_map, f"{order.stem}_{split.code}", order.chrome, split.moves, split.bits)
        for split in order.splits
    ]

    def around() -> Frame:
        return draw_frame(
            order.wafer,
            order.photomasks,
            level_map,
            splits=order.splits,
            job=order.job,
            minimum_line_m=order.process.minimum_line_m,
            chrome=does[0].top.shapes[chrome_layer(level_map.levels)],
            dbu_m=order.dbu_m,
        )

    frame = _kept(order, "frame", around)
    cells = [cell for doe in does for cell in doe.cells]
    return DrawnOrder(order, Layout(order.dbu_m, (*cells, *frame.cells)), frame)


def _mask_file(name: str, kind: str, layout: Layout, layers: Iterable[Layer], around: int) -> FileEntry:
    """Return the entry of a mask file but for its bytes; the last cells of the layout are those around the DOE."""
    entries = [cell_entry(cell, layout.dbu_m) for cell in layout.cells[-around:]]
    return FileEntry(name, kind, 0, "", layout.top.name, [str(layer) for layer in layers], entries)


def _paper_names(order: Order) -> Sequence[str]:
    always = ("CHECK.drc", "LAYERS.lyp", "ORDER.csv", "ORDER.html", "PREVIEW.png")
    rules = () if order.rules.clean else ("RULES.png",)
    return (*always, *(("WAFER.png", "MARKS.png", "RUNSHEET.html", "RUNSHEET.json", *rules) if order.papers else ()))


def file_entries(drawing: DrawnOrder, models: Sequence[ModelEntry]) -> list[FileEntry]:
    """Return the entries of all files of an order, their sizes and digests still missing."""
    order, layout, around = drawing.order, drawing.layout, len(drawing.frame.cells)
    drawn = list(drawing.does[0].shapes)
    plates = [(drawing.plate(photomask), {Layer(photomask.layer)} & {*drawn}) for photomask in order.photomasks]
    others = [model.file for model in models]
    others += [f"{order.stem}_{ending}" for ending in (*_paper_names(order), "LEVELS.npy")]
    return [
        *(_mask_file(name, "GDSII", layout, drawn, around) for name in [order.combined_gds] if name),
        *(_mask_file(order.plate_file(plate.top.name), "GDSII", plate, layers, around) for plate, layers in plates),
        _mask_file(f"{order.stem}_ALL.oas", "OASIS", layout, drawn, around),
        *(FileEntry(name, name.rpartition(".")[2].upper(), 0, "", None, [], []) for name in others),
    ]


def tools() -> dict[str, str]:
    """Return the versions of the programs that an order comes from."""
    return {"python": platform.python_version(), **{tool: version(tool) for tool in _TOOLS}}


def manifest_of(
    drawing: DrawnOrder, models: Sequence[ModelEntry], files: Sequence[FileEntry], made_by: Mapping[str, Any]
) -> Manifest:
    """Return the manifest of an order whose files are known, made by tools of these versions."""
    order, layout, frame = drawing.order, drawing.layout, drawing.frame
    level_map, stem = order.level_map, order.stem
    levels, grid = level_map.levels, level_map.grid
    return Manifest(
        format=FORMAT,
        name=level_map.name,
        geometry_sha256=order.geometry,
        source=dict(order.source),
        conventions=conventions_of(levels, order.process.tone),
        request=request_of(order),
        levels=levels.count,
        step_nm=round(levels.step_m / NM, 9),
        shape=list(grid.shape),
        pitch_um=round(grid.pitch_m / UM, 12),
        aperture_mm=level_map.relief.record(MM, 9),
        dbu_nm=round(layout.dbu_m / NM, 9),
        pixel_edges=describe_edges(pixel_edges(grid)),
        level_map_file=f"{stem}_LEVELS.npy",
        level_map_sha256=level_map.digest,
        combined_gds=order.combined_gds,
        combined_oasis=f"{stem}_ALL.oas",
        preview=f"{stem}_PREVIEW.png",
        doe_cell=drawing.does[0].name,
        plates=[photomask_entry(order, photomask) for photomask in order.photomasks],
        wafer=wafer_entry(order, frame),
        rules=order.rules.as_record(),
        masks=[mask_entry(order, drawing.does[0], bit, plane) for bit, plane in enumerate(level_map.planes())],
        splits=split_entries(order, drawing.does, frame),
        chrome=chrome_entry(order, drawing.does[0]),
        models=list(models),
        files=list(files),
        tools=dict(made_by),
    )
