"""The folder that goes to the lab: every mask as a file, the whole as a review file, and the proof.

    DOE_<ID>_ALL.gds, .oas          all layers, for review
    DOE_<ID>_M<n>_B<k>_<depth>.gds  one file per etch mask, on its own layer k + 1
    DOE_<ID>_CHROME.gds             the chrome around the clear aperture
    DOE_<ID>_ZERO.gds               the chrome marks that are made first, if the wafer has any
    DOE_<ID>_LEVELS.npy             the level map (uint8, row 0 at the lowest y)
    DOE_<ID>_PREVIEW.png            a picture for people
    manifest.json                   what each file is, its digest, its geometry
    ...                             solids and height maps (`fab.models`); what the caller adds

The folder appears at its final path only after everything in it was read back and found equal to the
level map.
"""

import platform
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fab.compensation import edge_moves
from fab.doe import mask_layout
from fab.errors import InputError
from fab.files import MANIFEST_NAME, atomic_folder, explain_os_error, sha256_file
from fab.frame import Frame, draw_frame
from fab.grid import Grid
from fab.inventory import cell_entry, geometry, shapes_digest
from fab.layout import (
    Cell,
    Chrome,
    Layer,
    Layout,
    PixelEdges,
    Shapes,
    chrome_layer,
    etch_layer,
    pixel_edges,
)
from fab.levels import Levels
from fab.manifest import (
    CONVENTIONS,
    FORMAT,
    CellEntry,
    ChromeEntry,
    DrawnEntry,
    FileEntry,
    Manifest,
    MaskEntry,
    PlateEntry,
    SplitEntry,
    WaferEntry,
    map_digest,
    plane_digest,
    read_manifest,
)
from fab.masks import planes, unetched_outside
from fab.models import Relief, write_models
from fab.part import Plate, plates_of
from fab.patch import Patch
from fab.polygons import smallest_runs
from fab.preview import preview_png
from fab.process import Process
from fab.rules import Rules, RulesReport, check
from fab.split import Split, splits_of
from fab.stream import write_gds, write_oasis
from fab.units import MM, NM, UM, format_length
from fab.verify import Report, verify_order
from fab.wafer import READING, Wafer

__all__ = ["Add", "Order", "mask_file", "order_id", "write_order"]

# What is left of 32 characters beside "DOE_" and the longest ending, "_M6_B5_1234P5NM".
_LONGEST_ID = 13
_TOOLS = ("numpy", "numba", "klayout", "gdstk", "matplotlib")


def _silent(step: str) -> None:
    """Take the name of a step and do nothing with it."""


def _nothing(folder: Path, order: "Order", frame: Frame) -> Sequence[str]:
    """Add no files."""
    return ()


@dataclass(frozen=True, eq=False)
class Order:
    """A mask order in numbers, before it becomes files.

    Attributes:
        name: the name its owner gave it.
        level_map: level numbers ``[y, x]``, blank outside the clear aperture.
        levels: the staircase.
        grid: the raster.
        aperture_m: diameter of the clear aperture, metres.
        chrome: how the chrome is drawn.
        source: where the height map came from.
        process: in which order the masks are etched, and what their polygons are on the plates.
        wafer: what the masks are filled with.
        patch: a window that is wanted as a solid at full resolution, if any.
    """

    name: str
    level_map: NDArray[np.uint8]
    levels: Levels
    grid: Grid
    aperture_m: float
    chrome: Chrome
    source: Mapping[str, Any]
    process: Process
    wafer: Wafer
    patch: Patch | None = None

    @property
    def plates(self) -> tuple[Plate, ...]:
        """The masks in the order in which they are used."""
        process, wafer = self.process, self.wafer
        return plates_of(self.levels, process.order, process.tone, wafer.chrome, wafer.zero_layer)

    @cached_property
    def rules(self) -> RulesReport:
        """Check every etch mask against what the process prints."""
        return check(self.level_map, self.levels, self.grid, self.aperture_m, Rules.of(self.process))

    def edge_moves(self) -> tuple[int, ...]:
        """How far the edges of every mask are moved outward against the bias of the process, database units."""
        if not self.wafer.compensate:
            return (0,) * self.levels.bits
        usual = self.process.expected()
        own = usual.cd_bias_m or (0.0,) * self.levels.bits
        return edge_moves([float(usual.common_cd_bias_m + bias) for bias in own], pixel_edges(self.grid).dbu_m)

    @property
    def splits(self) -> tuple[Split, ...]:
        """How the dies draw the DOE, the plate as ordered first."""
        return splits_of(self.wafer, self.levels, self.edge_moves(), pixel_edges(self.grid).dbu_m)

    def plate_stem(self, plate: Plate) -> str:
        """Return the name of a mask's file (without suffix) and top cell."""
        if plate.bit is not None:
            return self.mask_stem(plate.bit)
        return f"{self.stem}_{'ZERO' if plate.makes == 'zero layer' else 'CHROME'}"

    @property
    def stem(self) -> str:
        """What all file names begin with."""
        return f"DOE_{order_id(self.name, map_digest(self.level_map))}"

    def mask_stem(self, bit: int) -> str:
        """Return the name of an etch mask's file (without suffix) and cell."""
        depth = f"{self.levels.etch_depth_m(bit) / NM:.1f}".removesuffix(".0").replace(".", "P")
        return f"{self.stem}_M{bit + 1}_B{bit}_{depth}NM"


Add = Callable[[Path, Order, Frame], Sequence[str]]


def order_id(name: str, digest: str) -> str:
    """Turn a name into what mask shops accept in file and cell names.

    Args:
        name: any text.
        digest: SHA-256 of the level map, which keeps shortened names apart.

    Returns:
        The name in capitals, with _ for everything that is not a letter or digit; if that is longer
        than 13 characters, its first 8 and 4 of the digest.

    Raises:
        InputError: nothing of the name is left.
    """
    plain = re.sub(r"[^A-Z0-9]+", "_", name.upper()).strip("_")
    if not plain:
        raise InputError("mask order name", "must hold a letter A-Z or a digit", repr(name), "Choose another name.")
    return plain if len(plain) <= _LONGEST_ID else f"{plain[:8].rstrip('_')}_{digest[:4].upper()}"


class Content(NamedTuple):
    """What the manifest says of a file besides its bytes; of a mask file also top cell, DOE layers and other cells."""

    file: str
    format: str
    cell: str | None = None
    layers: Sequence[Layer] = ()
    cells: Sequence[CellEntry] = ()


def _merged(parts: list[Shapes]) -> Shapes:
    if len(parts) == 1:
        return parts[0]
    polygons = tuple(polygon for part in parts for polygon in part.polygons)
    return Shapes(np.concatenate([part.rectangles for part in parts]), polygons)


def mask_file(layout: Layout, layer: Layer, top: str) -> Layout:
    """The drawing of one plate: one layer number, every datatype of it merged onto datatype 0.

    Args:
        layout: the whole drawing.
        layer: the layer of the plate, datatype 0.
        top: name of the top cell.
    """
    cells = []
    for cell in layout.cells:
        parts = [shapes for other, shapes in cell.shapes.items() if other.number == layer.number and len(shapes)]
        name = top if cell is layout.top else cell.name
        cells.append(Cell(name, {layer: _merged(parts)} if parts else {}, cell.references))
    return Layout(layout.dbu_m, tuple(cells))


def _mask_entry(order: Order, layout: Layout, bit: int, plane: NDArray[np.uint8]) -> MaskEntry:
    layer = etch_layer(bit, order.levels)
    runs = (None if run is None else round(run * order.grid.pitch_m / UM, 6) for run in smallest_runs(plane))
    width_um, space_um = runs
    stem = order.mask_stem(bit)
    return MaskEntry(
        mask=bit + 1,
        bit=bit,
        layer=layer.number,
        datatype=layer.datatype,
        file=f"{stem}.gds",
        cell=stem,
        depth_nm=round(order.levels.etch_depth_m(bit) / NM, 9),
        edge_move_nm=round(order.edge_moves()[bit] * layout.dbu_m / NM, 9),
        polygon_means=CONVENTIONS["etch layers"],
        smallest_width_um=width_um,
        smallest_space_um=space_um,
        plane_sha256=plane_digest(plane),
        **geometry(layout.cells[0].shapes[layer], layout.dbu_m),  # type: ignore[arg-type]
    )


def _chrome_entry(order: Order, layout: Layout) -> ChromeEntry:
    layer = chrome_layer(order.levels)
    inner, outer = (round(radius / layout.dbu_m) for radius in order.chrome.radii_m(order.grid, order.aperture_m))
    return ChromeEntry(
        layer=layer.number,
        datatype=layer.datatype,
        file=f"{order.stem}_CHROME.gds",
        cell=f"{order.stem}_CHROME",
        polygon_means=CONVENTIONS["chrome layer"],
        opening_diameter_mm=round(2 * inner * layout.dbu_m / MM, 9),
        outer_diameter_mm=round(2 * outer * layout.dbu_m / MM, 9),
        overlap_um=round(order.chrome.overlap_m / UM, 9),
        chord_error_nm=round(order.chrome.chord_error_m / NM, 9),
        shapes_sha256=shapes_digest(layout.cells[0].shapes[layer]),
        **geometry(layout.cells[0].shapes[layer], layout.dbu_m),  # type: ignore[arg-type]
    )


def _write_map(path: Path, level_map: NDArray[np.uint8]) -> None:
    try:
        np.save(path, level_map, allow_pickle=False)
    except OSError as error:
        raise explain_os_error(error, path) from error


def _edges_told(edges: PixelEdges) -> str:
    unit = format_length(edges.dbu_m)
    if edges.shift_m == 0:
        return f"every pixel edge is a whole number of {unit}"
    return (
        f"each pixel edge is rounded to {unit}, neighbours alike; the largest shift is {format_length(edges.shift_m)}"
    )


def _frame(order: Order, dbu_m: float) -> Frame:
    return draw_frame(
        order.wafer,
        order.plates,
        order.levels,
        splits=order.splits,
        stem=order.stem,
        digest=map_digest(order.level_map),
        pitch_m=order.grid.pitch_m,
        minimum_line_m=order.process.minimum_line_m,
        chrome_m=2 * order.chrome.radii_m(order.grid, order.aperture_m)[1],
        aperture_m=order.aperture_m,
        dbu_m=dbu_m,
    )


def _plate_entry(order: Order, plate: Plate) -> PlateEntry:
    dark_field = plate.tone == "clear"
    return PlateEntry(
        mask=plate.name,
        makes=plate.makes,
        layer=plate.layer,
        bit=plate.bit,
        depth_nm=None if plate.bit is None else round(plate.depth_m / NM, 9),
        file=f"{order.plate_stem(plate)}.gds",
        polygons=f"digitised data {plate.tone}: polygons are {'clear' if dark_field else 'chrome'} on the plate",
        field="dark field" if dark_field else "clear field",
        reading=READING,
    )


def _wafer_entry(order: Order, frame: Frame) -> WaferEntry:
    wafer = order.wafer
    places = {name: [round(x / UM, 6), round(y / UM, 6)] for name, (x, y) in sorted(frame.places.items())}
    return WaferEntry(
        diameter_mm=round(wafer.diameter_m / MM, 9),
        thickness_mm=round(wafer.thickness_m / MM, 9),
        blank_mm=round(wafer.blank_m / MM, 9),
        die_pitch_mm=round(frame.die_m / MM, 9),
        dies_mm=[[round(x / MM, 9), round(y / MM, 9)] for x, y in frame.dies],
        places_um=places,
    )


def _around(order: Order, layout: Layout) -> list[CellEntry]:
    """What the manifest says of every cell but those of the DOE, which come first."""
    return [cell_entry(cell, layout.dbu_m) for cell in layout.cells[len(order.splits) :]]


def _drawn_does(order: Order) -> Layout:
    """Draw the DOE in all the ways that the dies ask for, the plate as ordered first."""
    drawn = [
        mask_layout(
            order.level_map,
            order.levels,
            order.grid,
            order.aperture_m,
            f"{order.stem}_{split.code}",
            order.chrome,
            split.moves,
            split.bits,
        )
        for split in order.splits
    ]
    return Layout(drawn[0].dbu_m, tuple(one.top for one in drawn))


def _split_entry(split: Split, cell: Cell, die: int, levels: Levels, dbu_m: float) -> SplitEntry:
    layers = [
        DrawnEntry(
            layer=layer.number,
            datatype=layer.datatype,
            bit=bit,
            edge_move_nm=round(move * dbu_m / NM, 9),
            **geometry(cell.shapes[layer], dbu_m),  # type: ignore[arg-type]
        )
        for mask, (bit, move) in enumerate(zip(split.bits, split.moves, strict=True))
        for layer in [etch_layer(mask, levels)]
    ]
    return SplitEntry(cell.name, split.words, die, layers)


def _write_masks(
    folder: Path,
    order: Order,
    layout: Layout,
    doe_layers: list[Layer],
    gds: str,
    oasis: str,
    say: Callable[[str], None],
) -> list[Content]:
    """Write the review files and one file per mask."""
    say("writing GDSII")
    write_gds(folder / gds, layout)
    contents = [Content(gds, "GDSII", layout.top.name, doe_layers, _around(order, layout))]
    for plate in order.plates:
        name, layer = order.plate_stem(plate), Layer(plate.layer)
        one = mask_file(layout, layer, name)
        write_gds(folder / f"{name}.gds", one)
        on = [layer] if layer in doe_layers else []
        contents.append(Content(f"{name}.gds", "GDSII", name, on, _around(order, one)))
    say("writing OASIS")
    write_oasis(folder / oasis, folder / gds, layout.layers)
    return [*contents, Content(oasis, "OASIS", layout.top.name, doe_layers, contents[0].cells)]


def _file_entry(folder: Path, content: Content) -> FileEntry:
    path = folder / content.file
    return FileEntry(
        file=content.file,
        format=content.format,
        bytes=path.stat().st_size,
        sha256=sha256_file(path),
        cell=content.cell,
        layers=[str(layer) for layer in content.layers],
        cells=list(content.cells),
    )


def _write_files(folder: Path, order: Order, add: Add, say: Callable[[str], None]) -> Manifest:
    """Write everything but the manifest, and return it."""
    say("drawing the masks")
    drawn = _drawn_does(order)
    frame = _frame(order, drawn.dbu_m)
    splits = [
        _split_entry(split, cell, frame.splits.index(number) + 1, order.levels, drawn.dbu_m)
        for number, (split, cell) in enumerate(zip(order.splits, drawn.cells, strict=True))
        if number
    ]
    layout = Layout(drawn.dbu_m, (*drawn.cells, *frame.cells))
    doe_cell, doe_layers = drawn.cells[0].name, list(drawn.cells[0].shapes)
    del drawn
    bit_planes = planes(order.level_map, order.levels)
    masks = [_mask_entry(order, layout, bit, plane) for bit, plane in enumerate(bit_planes)]
    chrome = _chrome_entry(order, layout)
    gds, oasis, levels_file, preview = (
        f"{order.stem}_{end}" for end in ("ALL.gds", "ALL.oas", "LEVELS.npy", "PREVIEW.png")
    )
    contents = _write_masks(folder, order, layout, doe_layers, gds, oasis, say)
    dbu_m = layout.dbu_m
    del layout
    say("drawing the preview")
    _write_map(folder / levels_file, order.level_map)
    digest = map_digest(order.level_map)
    title = f"{order.stem}: {order.levels.told}, level map {digest[:12]}"
    radii_m = order.chrome.radii_m(order.grid, order.aperture_m)
    picture = preview_png(title, bit_planes, order.level_map, order.levels, order.grid, order.aperture_m, radii_m)
    (folder / preview).write_bytes(picture)
    say("drawing the solids")
    shown = Relief(
        order.level_map,
        order.levels,
        order.grid,
        order.aperture_m,
        order.chrome,
        order.wafer,
        frame.die_m,
        frame.dies,
        order.patch,
    )
    # What is added takes long where it follows light; the solids are drawn meanwhile.
    with ThreadPoolExecutor(1) as pool:
        solids = pool.submit(write_models, folder, order.stem, shown)
        added = add(folder, order, frame)
        models = solids.result()
    others = [*(model.file for model in models), *added, levels_file, preview]
    contents += [Content(name, Path(name).suffix[1:].upper()) for name in others]
    return Manifest(
        format=FORMAT,
        name=order.name,
        source=dict(order.source),
        conventions=CONVENTIONS,
        levels=order.levels.count,
        step_nm=round(order.levels.step_m / NM, 9),
        shape=list(order.grid.shape),
        pitch_um=round(order.grid.pitch_m / UM, 12),
        aperture_mm=round(order.aperture_m / MM, 9),
        dbu_nm=round(dbu_m / NM, 9),
        pixel_edges=_edges_told(pixel_edges(order.grid)),
        level_map_file=levels_file,
        level_map_sha256=digest,
        combined_gds=gds,
        combined_oasis=oasis,
        preview=preview,
        doe_cell=doe_cell,
        plates=[_plate_entry(order, plate) for plate in order.plates],
        wafer=_wafer_entry(order, frame),
        rules=order.rules.as_record(),
        masks=masks,
        splits=splits,
        chrome=chrome,
        models=models,
        files=[_file_entry(folder, content) for content in contents],
        tools={"python": platform.python_version(), **{tool: version(tool) for tool in _TOOLS}},
    )


def _require_own(folder: Path) -> None:
    """Refuse to replace anything but an earlier mask order and the files it lists."""
    if not (folder / MANIFEST_NAME).exists():
        return
    listed = {MANIFEST_NAME, *(entry.file for entry in read_manifest(folder).files)}
    extra = sorted({path.name for path in folder.iterdir()} - listed)
    if extra:
        rule = "a mask order that is replaced must hold its own files only"
        raise InputError(str(folder), rule, f"also {extra[0]!r}", "Move that file, or choose another folder.")


def write_order(
    folder: str | Path,
    level_map: NDArray[np.integer],
    levels: Levels,
    grid: Grid,
    aperture_m: float,
    name: str,
    source: Mapping[str, Any],
    *,
    chrome: Chrome | None = None,
    process: Process | None = None,
    wafer: Wafer | None = None,
    patch: Patch | None = None,
    add: Add = _nothing,
    say: Callable[[str], None] = _silent,
) -> Report:
    """Write a mask order and prove it; the folder appears only if the proof holds.

    Args:
        folder: the final folder; missing, empty, or an earlier order, which is replaced.
        level_map: level numbers ``[y, x]``; outside the clear aperture the glass is left blank.
        levels: the staircase.
        grid: the raster of the map.
        aperture_m: diameter of the clear aperture, metres.
        name: the owner's name for it; file names are made from it.
        source: where the height map came from, for the manifest; JSON values only.
        chrome: how the chrome is drawn; the defaults of `Chrome` if left out.
        process: order of the etches and tone of the masks; an ideal process if left out.
        wafer: what the masks are filled with; the defaults of `Wafer` if left out.
        patch: a window to write as a solid at full resolution, too.
        add: writes further files into the folder and returns their names; what needs light to be written.
        say: told the name of each step as it begins.

    Returns:
        The report of the read-back, every check passed.

    Raises:
        InputError: an argument is out of range; the folder holds anything else than an earlier order;
            the system refuses it.
        CheckFailed: what was read back differs; nothing is left at the final path.
    """
    _require_own(Path(folder))
    blank = unetched_outside(level_map, levels, grid, aperture_m)
    made = process or Process(levels)
    order = Order(name, blank, levels, grid, aperture_m, chrome or Chrome(), source, made, wafer or Wafer(), patch)
    if patch is not None:
        patch.require(blank, levels, grid)
    with atomic_folder(folder) as fresh:
        manifest = _write_files(fresh, order, add, say)
        (fresh / MANIFEST_NAME).write_bytes(manifest.to_json())
        say("reading everything back")
        report = verify_order(fresh)
        report.require()
        say("moving the folder into place")
    return report
