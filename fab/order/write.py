"""The folder that goes to the lab: every mask as a file, the whole as a review file, and the proof.

    DOE_<ID>_ALL.gds, .oas          all layers, for review
    DOE_<ID>_M<n>_B<k>_<depth>.gds  one file per etch mask, on its own layer k + 1
    DOE_<ID>_CHROME.gds             the chrome around the clear aperture
    DOE_<ID>_ZERO.gds               the chrome marks that are made first, if the wafer has any
    DOE_<ID>_LEVELS.npy             the level map (uint8, row 0 at the lowest y)
    DOE_<ID>_PREVIEW.png            a picture for people
    manifest.json                   what each file is, its digest, its geometry
    ...                             solids and height maps (`fab.solids.write`); what the caller adds

The folder appears at its final path only after everything in it was read back and found equal to the
level map.
"""

import logging
import platform
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fab.errors import InputError
from fab.figure import html_of, save
from fab.files import MANIFEST_NAME, atomic_folder, sha256_file
from fab.gds.writer import write_gds, write_oasis
from fab.layout.doe import mask_layout
from fab.layout.frame import Frame, draw_frame
from fab.layout.geometry import Cell, Chrome, Layer, Layout, merged, pixel_edges
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.manifest.cells import cell_entry
from fab.manifest.records import CONVENTIONS, FORMAT, CellEntry, FileEntry, Manifest, read_manifest
from fab.order.entries import chrome_entry, describe_edges, mask_entry, photomask_entry, split_entries, wafer_entry
from fab.order.order import OnViolation, Order, plan_order
from fab.process import Process
from fab.solids.model import DoeModel
from fab.solids.patch import Patch
from fab.solids.write import write_models
from fab.units import MM, NM, UM
from fab.verification.verify import VerificationReport, verify

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

log = logging.getLogger("doedesign")
_TOOLS = ("numpy", "numba", "klayout", "gdstk", "matplotlib")

Add = Callable[[Path, Order, Frame], Sequence[str]]


def mask_file(layout: Layout, layer: Layer, top: str) -> Layout:
    """Return the drawing of one photomask: one layer number, every datatype of it merged onto datatype 0."""
    cells = []
    for cell in layout.cells:
        parts = [shapes for other, shapes in cell.shapes.items() if other.number == layer.number and len(shapes)]
        name = top if cell is layout.top else cell.name
        cells.append(Cell(name, {layer: merged(parts)} if parts else {}, cell.references))
    return Layout(layout.dbu_m, tuple(cells))


def _around(order: Order, layout: Layout) -> list[CellEntry]:
    """Return the manifest's entries of every cell but those of the DOE, which come first."""
    return [cell_entry(cell, layout.dbu_m) for cell in layout.cells[len(order.splits) :]]


def _file_entry(
    path: Path, kind: str = "", cell: str | None = None, layers: Sequence[Layer] = (), cells: Sequence[CellEntry] = ()
) -> FileEntry:
    """Return the manifest's entry of a file; that of a mask file has a top cell, DOE layers and other cells, too."""
    named = [str(layer) for layer in layers]
    size, digest = path.stat().st_size, sha256_file(path)
    return FileEntry(path.name, kind or path.suffix[1:].upper(), size, digest, cell, named, list(cells))


def _write_masks(
    folder: Path, order: Order, layout: Layout, doe_layers: list[Layer], gds: str, oasis: str
) -> list[FileEntry]:
    """Write the review files and one file per mask."""
    log.info("writing GDSII")
    write_gds(folder / gds, layout)
    review = (layout.top.name, doe_layers, _around(order, layout))
    entries = [_file_entry(folder / gds, "GDSII", *review)]
    for photomask in order.photomasks:
        name, layer = order.photomask_stem(photomask), Layer(photomask.layer)
        one = mask_file(layout, layer, name)
        write_gds(folder / f"{name}.gds", one)
        on = [layer] if layer in doe_layers else []
        entries.append(_file_entry(folder / f"{name}.gds", "GDSII", name, on, _around(order, one)))
    log.info("writing OASIS")
    write_oasis(folder / oasis, folder / gds, layout.layers)
    return [*entries, _file_entry(folder / oasis, "OASIS", *review)]


def _write_files(folder: Path, order: Order, add: Add) -> Manifest:
    """Write everything but the manifest, and return it."""
    level_map = order.level_map
    levels, grid = level_map.levels, level_map.grid
    log.info("drawing the masks")
    does = [
        mask_layout(level_map, f"{order.stem}_{split.code}", order.chrome, split.moves, split.bits)
        for split in order.splits
    ]
    drawn = Layout(does[0].dbu_m, tuple(one.top for one in does))
    dbu_m = drawn.dbu_m
    frame = draw_frame(
        order.wafer,
        order.photomasks,
        level_map,
        splits=order.splits,
        stem=order.stem,
        minimum_line_m=order.process.minimum_line_m,
        chrome_m=2 * order.chrome.radii_m(level_map)[1],
        dbu_m=dbu_m,
    )
    splits = split_entries(order, drawn, frame)
    layout = Layout(dbu_m, (*drawn.cells, *frame.cells))
    doe_cell, doe_layers = drawn.cells[0].name, list(drawn.cells[0].shapes)
    masks = [mask_entry(order, layout, bit, plane) for bit, plane in enumerate(level_map.planes())]
    chrome = chrome_entry(order, layout)
    endings = ("ALL.gds", "ALL.oas", "LEVELS.npy", "PREVIEW.png")
    gds, oasis, levels_file, preview = (f"{order.stem}_{end}" for end in endings)
    files = _write_masks(folder, order, layout, doe_layers, gds, oasis)
    del does, drawn, layout
    log.info("drawing the preview")
    np.save(folder / levels_file, level_map.level, allow_pickle=False)
    save(order.plot(), folder / preview)
    log.info("drawing the solids")
    model = DoeModel(level_map, order.chrome, order.wafer, frame.die_m, frame.dies, order.patch)
    # What is added takes long where it follows light; the solids are drawn meanwhile.
    with ThreadPoolExecutor(1) as pool:
        solids = pool.submit(write_models, folder, order.stem, model)
        added = add(folder, order, frame)
        models = solids.result()
    files += [_file_entry(folder / name) for name in (*(m.file for m in models), *added, levels_file, preview)]
    return Manifest(
        format=FORMAT,
        name=level_map.name,
        source=dict(order.source),
        conventions=CONVENTIONS,
        levels=levels.count,
        step_nm=round(levels.step_m / NM, 9),
        shape=list(grid.shape),
        pitch_um=round(grid.pitch_m / UM, 12),
        aperture_mm=round(level_map.aperture_m / MM, 9),
        dbu_nm=round(dbu_m / NM, 9),
        pixel_edges=describe_edges(pixel_edges(grid)),
        level_map_file=levels_file,
        level_map_sha256=level_map.digest,
        combined_gds=gds,
        combined_oasis=oasis,
        preview=preview,
        doe_cell=doe_cell,
        plates=[photomask_entry(order, photomask) for photomask in order.photomasks],
        wafer=wafer_entry(order, frame),
        rules=order.rules.as_record(),
        masks=masks,
        splits=splits,
        chrome=chrome,
        models=models,
        files=files,
        tools={"python": platform.python_version(), **{tool: version(tool) for tool in _TOOLS}},
    )


def _require_own(folder: Path) -> None:
    """Check that nothing but an earlier mask order and the files it lists is replaced."""
    if not (folder / MANIFEST_NAME).exists():
        return
    listed = {MANIFEST_NAME, *(entry.file for entry in read_manifest(folder).files)}
    extra = sorted({path.name for path in folder.iterdir()} - listed)
    if extra:
        rule = "a mask order that is replaced must hold its own files only"
        raise InputError(str(folder), rule, f"also {extra[0]!r}", "Move that file, or choose another folder.")


@dataclass(frozen=True, eq=False)
class WrittenOrder:
    """A mask order in a folder: what was drawn, what every file is, and the read-back, every check passed."""

    folder: Path
    order: Order
    manifest: Manifest
    report: VerificationReport

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw heights, chrome and every etch mask (`fab.plots.masks.plot_masks`)."""
        return self.order.plot(ax)

    def _repr_html_(self) -> str:
        rows = {entry.file: f"{entry.format}, {entry.bytes} bytes" for entry in self.manifest.files}
        return html_of(f"Mask order {self.folder}, {len(self.report.checks)} checks passed", rows, self.plot())


def write_order(
    folder: str | Path,
    level_map: LevelMap,
    *,
    process: Process | str | None = None,
    wafer: Wafer | None = None,
    chrome: Chrome | None = None,
    patch: Patch | None = None,
    source: Mapping[str, Any] | None = None,
    on_violation: OnViolation = "warn",
    waves_per_metre: float | None = None,
) -> WrittenOrder:
    """Write a mask order and prove it; the folder appears only if the proof holds.

    Args:
        folder: the final folder; missing, empty, or an earlier order, which is replaced.
        level_map: the DOE; file names are made from its name.
        process: order of the etches, tone of the masks and what is printed, or the name of a stock process; ideal by
            default.
        wafer: what the masks are filled with.
        chrome: how the chrome is drawn.
        patch: a window to write as a solid at full resolution, too.
        source: where the level map came from, for the manifest; JSON values only.
        on_violation: what to do where the process cannot print a mask: warn, fail, or fix the level map.
        waves_per_metre: waves of light per metre of height, for a repair (`fab.rules.repair.repair`).

    Raises:
        InputError: an argument is out of range; the folder holds anything else than an earlier order.
        CheckFailed: what was read back differs; nothing is left at the final path.
    """
    order = plan_order(
        level_map,
        process=process,
        wafer=wafer,
        chrome=chrome,
        patch=patch,
        source=source,
        on_violation=on_violation,
        waves_per_metre=waves_per_metre,
    )
    return write_planned(folder, order)


def write_planned(folder: str | Path, order: Order, *, add: Add = lambda *_: ()) -> WrittenOrder:
    """Write an order of `plan_order`, and prove it; see `write_order`.

    What needs light is written by `add`, which puts further files into the folder and returns their names.
    """
    folder = Path(folder)
    _require_own(folder)
    with atomic_folder(folder) as fresh:
        manifest = _write_files(fresh, order, add)
        (fresh / MANIFEST_NAME).write_bytes(manifest.to_json())
        log.info("reading everything back")
        report = verify(fresh)
        report.require()
        log.info("moving the folder into place")
    return WrittenOrder(folder, order, manifest, report)
