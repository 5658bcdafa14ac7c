"""The folder that goes to the lab: every mask as a file, the whole as a review file, and the proof.

    <JOB>_ALL.oas                 all layers, for review; on request also .gds
    <JOB>_M<n>_<depth>.gds.gz     one file per etch mask n, on its own layer n; on request plain .gds, as all of them
    <JOB>_CHROME.gds.gz           the chrome around the clear aperture
    <JOB>_ZERO.gds.gz             the chrome marks that are made first, if the wafer has any
    <JOB>_LEVELS.npy              the level map (uint8, row 0 at the lowest y)
    manifest.json                 what each file is, its digest, its geometry
    ...                           solids and height maps (`fab.solids.write`), papers (`fab.order.papers`)

<JOB> is `fab.order.order.Order.stem`, such as QUICK_A_1P85_3F2A.

The folder appears at its final path only after everything in it was read back and found equal to the
level map.
"""

import logging
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fab.errors import InputError
from fab.figure import html_of
from fab.files import MANIFEST_NAME, atomic_folder, sha256_bytes, sha256_file, write_atomic
from fab.gds.oasis import write_oasis
from fab.gds.writer import write_gds
from fab.layout.geometry import Chrome
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.manifest.records import Manifest, read_manifest
from fab.order.drawing import DrawnOrder, draw, file_entries, manifest_of, tools
from fab.order.formats import Formats
from fab.order.order import Light, OnViolation, Order, plan_order
from fab.order.papers import papers
from fab.order.terms import OrderTerms
from fab.order.verify import verify
from fab.process import Process
from fab.runsheet.tables import SheetPrediction
from fab.solids.patch import Patch
from fab.solids.write import write_models
from fab.verification.report import VerificationReport

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

log = logging.getLogger("doedesign")
_WRITERS = 2


Predict = Callable[[Order], SheetPrediction | None]


def _write_masks(folder: Path, drawing: DrawnOrder) -> None:
    """Write the review files and one file per mask."""
    order, layout = drawing.order, drawing.layout
    log.info("writing the mask files")
    # What packs lets go of the interpreter lock; more threads would only hold more at once.
    with ThreadPoolExecutor(_WRITERS) as pool:
        begun = [pool.submit(write_oasis, folder / f"{order.stem}_ALL.oas", layout)]
        if order.combined_gds is not None:
            begun.append(pool.submit(write_gds, folder / order.combined_gds, layout))
        for photomask in order.photomasks:
            name = order.plate_file(order.photomask_stem(photomask))
            begun.append(pool.submit(write_gds, folder / name, drawing.plate(photomask)))
        for one in begun:
            one.result()


def _write_files(folder: Path, order: Order, predict: Predict) -> Manifest:
    """Write everything but the manifest, and return it."""
    log.info("drawing the masks")
    drawing = draw(order)
    _write_masks(folder, drawing)
    np.save(folder / f"{order.stem}_LEVELS.npy", order.level_map.level, allow_pickle=False)
    log.info("drawing the solids")
    # What follows light takes long; the solids are drawn meanwhile.
    with ThreadPoolExecutor(1) as pool:
        solids = pool.submit(write_models, folder, order.stem, drawing.model)
        seen = predict(order) if order.papers else None
        models = solids.result()
    if seen is not None:
        light = Light(seen.predictions, sha256_bytes(seen.picture))
        drawing = replace(drawing, order=replace(order, light=light))
    log.info("drawing the pictures")
    names = [order.plate_file(order.photomask_stem(photomask)) for photomask in order.photomasks]
    plates = {name: sha256_file(folder / name) for name in names}
    made_by = tools()
    for name, content in papers(drawing, plates, made_by, seen and seen.picture).items():
        write_atomic(folder / name, content())
    files = [
        replace(entry, bytes=(folder / entry.file).stat().st_size, sha256=sha256_file(folder / entry.file))
        for entry in file_entries(drawing, models)
    ]
    return manifest_of(drawing, models, files, made_by)


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
    terms: OrderTerms | None = None,
    direct_write: bool = False,
    source: Mapping[str, Any] | None = None,
    on_violation: OnViolation = "warn",
    waves_per_metre: float | None = None,
    formats: Formats | None = None,
) -> WrittenOrder:
    """Write a mask order and prove it; the folder appears only if the proof holds.

    Args:
        folder: the final folder; missing, empty, or an earlier order, which is replaced.
        level_map: the DOE; file names begin with its name.
        process: order of the etches, tone of the masks and what is printed, or the name of a stock process; ideal by
            default.
        wafer: what the masks are filled with.
        chrome: how the chrome is drawn.
        patch: a window to write as a solid at full resolution, too.
        terms: what is asked of the mask shop besides the drawing; revision A and blanks by default.
        direct_write: whether to write one layer per level with merged polygons (OASIS, DXF) and a table of doses, too.
        source: where the level map came from, for the manifest; JSON values only.
        on_violation: what to do where the process cannot print a mask: warn, fail, or fix the level map.
        waves_per_metre: waves of light per metre of height, for a repair (`fab.rules.repair.repair`).
        formats: in which formats it is written; packed and coarse enough to mail by default.

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
        terms=terms,
        direct_write=direct_write,
        source=source,
        on_violation=on_violation,
        waves_per_metre=waves_per_metre,
        formats=formats,
    )
    return write_planned(folder, order)


def write_planned(folder: str | Path, order: Order, *, predict: Predict = lambda _: None) -> WrittenOrder:
    """Write an order of `plan_order`, and prove it; see `write_order`.

    The light that its run sheet speaks of comes from `predict`.
    """
    folder = Path(folder)
    _require_own(folder)
    with atomic_folder(folder) as fresh:
        manifest = _write_files(fresh, order, predict)
        (fresh / MANIFEST_NAME).write_bytes(manifest.to_json())
        log.info("reading everything back")
        report = verify(fresh)
        report.require()
        log.info("moving the folder into place")
    return WrittenOrder(folder, order, manifest, report)
