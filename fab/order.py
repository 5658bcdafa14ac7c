"""The folder that goes to the lab: every mask as a file, the whole as a review file, and the proof.

    DOE_<ID>_ALL.gds, .oas          all layers, for review
    DOE_<ID>_M<n>_B<k>_<depth>.gds  one file per etch mask, on its own layer k + 1
    DOE_<ID>_CHROME.gds             the chrome around the clear aperture
    DOE_<ID>_LEVELS.npy             the level map (uint8, row 0 at the lowest y)
    DOE_<ID>_PREVIEW.png            a picture for people
    manifest.json                   what each file is, its digest, its geometry

The folder appears at its final path only after everything in it was read back and found equal to the
level map. Later content (marks, rules, run sheet, solids) joins as further files of the manifest.
"""

import platform
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.files import MANIFEST_NAME, atomic_folder, explain_os_error, sha256_file
from fab.grid import Grid
from fab.inventory import cell_entry, geometry
from fab.layout import (
    Cell,
    Chrome,
    Layer,
    Layout,
    PixelEdges,
    Reference,
    Shapes,
    chrome_layer,
    etch_layer,
    mask_layout,
    pixel_edges,
)
from fab.levels import Levels
from fab.manifest import (
    CONVENTIONS,
    FORMAT,
    CellEntry,
    ChromeEntry,
    FileEntry,
    Manifest,
    MaskEntry,
    map_digest,
    plane_digest,
    read_manifest,
)
from fab.masks import planes, unetched_outside
from fab.polygons import smallest_runs
from fab.preview import preview_png
from fab.stream import write_gds, write_oasis
from fab.units import MM, NM, UM, format_length
from fab.verify import Report, verify_order

__all__ = ["Order", "order_id", "write_order"]

# What is left of 32 characters beside "DOE_" and the longest ending, "_M6_B5_1234P5NM".
_LONGEST_ID = 13
_TOOLS = ("numpy", "numba", "klayout", "gdstk", "matplotlib")


def _silent(step: str) -> None:
    """Take the name of a step and do nothing with it."""


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
    """

    name: str
    level_map: NDArray[np.uint8]
    levels: Levels
    grid: Grid
    aperture_m: float
    chrome: Chrome
    source: Mapping[str, Any]

    @property
    def stem(self) -> str:
        """What all file names begin with."""
        return f"DOE_{order_id(self.name, map_digest(self.level_map))}"

    def mask_stem(self, bit: int) -> str:
        """Return the name of an etch mask's file (without suffix) and cell."""
        depth = f"{self.levels.etch_depth_m(bit) / NM:.1f}".removesuffix(".0").replace(".", "P")
        return f"{self.stem}_M{bit + 1}_B{bit}_{depth}NM"


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


def _around(layout: Layout) -> list[CellEntry]:
    """What the manifest says of every cell but that of the DOE, which comes first."""
    return [cell_entry(cell, layout.dbu_m) for cell in layout.cells[1:]]


def _write_files(folder: Path, order: Order, say: Callable[[str], None]) -> Manifest:
    """Write everything but the manifest, and return it."""
    say("drawing the masks")
    doe_cell = f"{order.stem}_DOE"
    drawn = mask_layout(order.level_map, order.levels, order.grid, order.aperture_m, doe_cell, order.chrome)
    layout = Layout(drawn.dbu_m, (*drawn.cells, Cell(order.stem, {}, (Reference(doe_cell),))))
    doe_layers = list(drawn.top.shapes)
    del drawn
    bit_planes = planes(order.level_map, order.levels)
    masks = [_mask_entry(order, layout, bit, plane) for bit, plane in enumerate(bit_planes)]
    chrome = _chrome_entry(order, layout)
    gds, oasis, levels_file, preview = (
        f"{order.stem}_{end}" for end in ("ALL.gds", "ALL.oas", "LEVELS.npy", "PREVIEW.png")
    )
    say("writing GDSII")
    write_gds(folder / gds, layout)
    files = [(gds, "GDSII", layout, doe_layers)]
    for entry in (*masks, chrome):
        layer = Layer(entry.layer, entry.datatype)
        plate = mask_file(layout, layer, entry.cell)
        write_gds(folder / entry.file, plate)
        files.append((entry.file, "GDSII", plate, [layer]))
    say("writing OASIS")
    write_oasis(folder / oasis, folder / gds, layout.layers)
    files.append((oasis, "OASIS", layout, doe_layers))
    dbu_m = layout.dbu_m
    contents = [(name, kind, one.top.name, on, _around(one)) for name, kind, one, on in files]
    del layout, files
    say("drawing the preview")
    _write_map(folder / levels_file, order.level_map)
    digest = map_digest(order.level_map)
    title = (
        f"{order.stem}: {order.levels.count} levels of {format_length(order.levels.step_m)}, level map {digest[:12]}"
    )
    radii_m = order.chrome.radii_m(order.grid, order.aperture_m)
    picture = preview_png(title, bit_planes, order.level_map, order.levels, order.grid, order.aperture_m, radii_m)
    (folder / preview).write_bytes(picture)
    contents += [(levels_file, "NPY", None, [], []), (preview, "PNG", None, [], [])]
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
        masks=masks,
        chrome=chrome,
        files=[
            FileEntry(
                file=name,
                format=kind,
                bytes=(folder / name).stat().st_size,
                sha256=sha256_file(folder / name),
                cell=top,
                layers=[str(layer) for layer in on],
                cells=around,
            )
            for name, kind, top, on, around in contents
        ],
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
    order = Order(name, blank, levels, grid, aperture_m, chrome or Chrome(), source)
    with atomic_folder(folder) as fresh:
        manifest = _write_files(fresh, order, say)
        (fresh / MANIFEST_NAME).write_bytes(manifest.to_json())
        say("reading everything back")
        report = verify_order(fresh)
        report.require()
        say("moving the folder into place")
    return report
