"""The papers of an order: pictures, the order form, the run sheet, and the files for KLayout."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from fab.figure import png_bytes
from fab.files import canonical_json, sha256_bytes
from fab.layout.marks import alignment_site
from fab.order.drawing import DrawnOrder
from fab.order.form import form_csv, form_page, form_record
from fab.order.recheck import drc_deck, layer_properties
from fab.order.request import request_of
from fab.runsheet.tables import Die, PhotomaskFile, RunSheet
from fab.runsheet.write import record, run_sheet_page

Paper = Callable[[], bytes]


def papers(
    drawing: DrawnOrder, plates: Mapping[str, str], made_by: Mapping[str, Any], psfs: bytes | None = None
) -> dict[str, Paper]:
    """Return what makes the content of every paper of an order, by file name.

    Args:
        drawing: the order.
        plates: SHA-256 of the file of every photomask, by its name.
        made_by: versions of the tools that made the order.
        psfs: PNG of the PSFs for the run sheet, if there is one.
    """
    order, kept = drawing.order, pictures(drawing)
    stem = order.stem
    form = form_record(drawing, plates)
    sheets: dict[str, Paper] = {
        "ORDER.csv": lambda: form_csv(form),
        "ORDER.html": lambda: form_page(form, f"{stem}_ORDER.csv"),
        "LAYERS.lyp": lambda: layer_properties(order, drawing.layout.layers),
        "CHECK.drc": lambda: drc_deck(order, f"{stem}_ALL.oas"),
    }
    if order.papers:
        content = record(run_sheet(drawing, plates, made_by))
        sheets["RUNSHEET.json"] = lambda: canonical_json(content)
        sheets["RUNSHEET.html"] = lambda: run_sheet_page(content, f"{stem}_RUNSHEET.json", shown())

    def shown() -> dict[str, bytes]:
        embedded = {"wafer": kept["WAFER.png"](), "marks": kept["MARKS.png"]()}
        return embedded if psfs is None else {**embedded, "psfs": psfs}

    return {f"{stem}_{name}": make for name, make in {**kept, **sheets}.items()}


def pictures(drawing: DrawnOrder) -> dict[str, Paper]:
    """Return what draws every picture of an order, by the end of its name; each is drawn once and kept."""
    order = drawing.order
    drawn: dict[str, Paper] = {"PREVIEW.png": lambda: png_bytes(order.plot())}
    if order.papers:
        drawn["WAFER.png"] = partial(_wafer, drawing)
        drawn["MARKS.png"] = partial(_marks, drawing)
        if not order.rules.clean:
            title = f"{order.stem}: where the masks break the rules of {order.process.name}"
            drawn["RULES.png"] = lambda: png_bytes(order.rules.plot(title=title))
    return {name: partial(drawing.kept, name, draw) for name, draw in drawn.items()}


def _wafer(drawing: DrawnOrder) -> bytes:
    from fab.plots.wafer import plot_wafer

    order = drawing.order
    title = f"{order.stem}: what lies where"
    return png_bytes(plot_wafer(order.wafer, drawing.frame, order.level_map.relief, order.dbu_m, title))


def _marks(drawing: DrawnOrder) -> bytes:
    from fab.plots.marks import plot_part

    masks, title = drawing.order.photomasks, f"{drawing.order.stem}: alignment site, every mask in its colour"
    return png_bytes(plot_part(alignment_site(masks, drawing.order.dbu_m), masks, title))


def run_sheet(drawing: DrawnOrder, plates: Mapping[str, str], made_by: Mapping[str, Any]) -> RunSheet:
    """Return the run sheet of an order (see `papers`)."""
    order, frame = drawing.order, drawing.frame
    moves = order.edge_moves()
    stems = {photomask.name: order.photomask_stem(photomask) for photomask in order.photomasks}
    files = {
        photomask.name: PhotomaskFile(
            file=order.plate_file(stems[photomask.name]),
            sha256=plates[order.plate_file(stems[photomask.name])],
            cell=stems[photomask.name],
            edge_move_m=0.0 if photomask.bit is None else moves[photomask.bit] * order.dbu_m,
        )
        for photomask in order.photomasks
    }
    return RunSheet(
        stem=order.stem,
        level_map=order.level_map,
        photomasks=order.photomasks,
        files=files,
        process=order.process,
        opening=order.chrome.opening(order.level_map.relief),
        wafer=order.wafer,
        places=frame.places,
        dies=tuple(
            Die(f"die {number}", x, y, order.splits[split].words)
            for number, ((x, y), split) in enumerate(zip(frame.dies, frame.splits, strict=True), 1)
        ),
        material=order.material,
        predictions=None if order.light is None else order.light.predictions,
        request_sha256=request_digest(request_of(order), made_by),
    )


def request_digest(request: Mapping[str, Any], made_by: Mapping[str, Any]) -> str:
    """Return the digest of what was asked for and of the tools that made it, which ties a run sheet to its order."""
    return sha256_bytes(canonical_json([dict(request), dict(made_by)]))
