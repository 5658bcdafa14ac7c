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
from fab.files import MANIFEST_NAME, atomic_folder, path_of, sha256_bytes, sha256_file, write_atomic
from fab.gds.oasis import write_oasis
from fab.gds.writer import write_gds
from fab.layout.geometry import Chrome
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.manifest.records import Manifest, ModelEntry, read_manifest
from fab.order.drawing import DrawnOrder, draw, file_entries, manifest_of, tools
from fab.order.formats import Formats
from fab.order.order import Light, OnViolation, Order, plan_order
from fab.order.papers import papers, pictures
from fab.order.request import as_recorded
from fab.order.terms import OrderTerms
from fab.order.verify import FilesRead, read_files, verify_folder
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


def _write_files(folder: Path, order: Order, predict: Predict) -> tuple[Manifest, FilesRead]:
    """Write everything but the manifest; return it, and what was found in the files that know of no light."""
    log.info("drawing the masks")
    drawing = draw(order)
    _write_masks(folder, drawing)
    np.save(folder / f"{order.stem}_LEVELS.npy", order.level_map.level, allow_pickle=False)
    # What follows light takes long; all that knows of no light is drawn, and read back, meanwhile.
    with ThreadPoolExecutor(1) as beside:
        solids = beside.submit(_write_models, folder, drawing)
        drawn = beside.submit(_draw_pictures, drawing)
        read = beside.submit(lambda: read_files(folder, drawing, _manifest(folder, drawing, solids.result())))
        try:
            seen = predict(order) if order.papers else None
        except BaseException:
            beside.shutdown(wait=False, cancel_futures=True)  # what has begun is waited for, and no more
            raise
        models, _, found = solids.result(), drawn.result(), read.result()
    psfs = None
    if seen is not None:
        psfs = seen.picture()
        drawing = replace(drawing, order=replace(order, light=Light(seen.predictions, sha256_bytes(psfs))))
    names = [order.plate_file(order.photomask_stem(photomask)) for photomask in order.photomasks]
    plates = {name: sha256_file(folder / name) for name in names}
    for name, content in papers(drawing, plates, tools(), psfs).items():
        write_atomic(folder / name, content())
    return _manifest(folder, drawing, models), found


def _write_models(folder: Path, drawing: DrawnOrder) -> list[ModelEntry]:
    """Write solids and height maps."""
    log.info("drawing the solids")
    return write_models(folder, drawing.order.stem, drawing.model)


def _draw_pictures(drawing: DrawnOrder) -> None:
    """Draw the pictures, which are kept."""
    log.info("drawing the pictures")
    for draw_picture in pictures(drawing).values():
        draw_picture()


def _manifest(folder: Path, drawing: DrawnOrder, models: list[ModelEntry]) -> Manifest:
    """Return the manifest of an order, of those of its files that are there."""
    files = [
        replace(entry, bytes=(folder / entry.file).stat().st_size, sha256=sha256_file(folder / entry.file))
        for entry in file_entries(drawing, models)
        if (folder / entry.file).exists()
    ]
    return manifest_of(drawing, models, files, tools())


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
    """A mask order in a folder.

    Attributes:
        folder: the folder.
        order: the drawing.
        manifest: what every file is.
        report: the read-back, of which every check passed.
    """

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
    one_to_one: bool = False,
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
        one_to_one: whether plates at 1:1 are taken for a stepper, too, from which a mask shop makes its reticles.

    Raises:
        InputError: an argument is out of range; a stepper's reticles, which are not drawn; the folder holds anything
            else than an earlier order.
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
        one_to_one=one_to_one,
    )
    return write_planned(folder, order)


def write_planned(folder: str | Path, order: Order, *, predict: Predict = lambda _: None) -> WrittenOrder:
    """Write an order of `plan_order`, and prove it; see `write_order`.

    The light that its run sheet speaks of comes from `predict`.
    """
    folder, order = path_of(folder, "folder"), as_recorded(order)
    _require_own(folder)
    with atomic_folder(folder) as fresh:
        manifest, found = _write_files(fresh, order, predict)
        (fresh / MANIFEST_NAME).write_bytes(manifest.to_json())
        log.info("comparing everything")
        report = verify_folder(fresh, found)
        report.require()
        log.info("moving the folder into place")
    return WrittenOrder(folder, order, manifest, report)
