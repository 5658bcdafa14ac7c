"""PSFs of a design as one draw of a process makes it, and where its light goes."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from doedesign.design.design import Design
from doedesign.prediction import on_target, plate_rows
from doedesign.runs.folder import Run
from doedesign.runs.level_maps import open_design
from doedesign.runs.results import results_folder
from doedesign.runtime.progress import meter
from doedesign.spec import variation_to_toml
from fab.errors import CheckFailed
from fab.figure import save
from fab.files import canonical_json
from fab.process import Process, Variation
from sim.metrics import without_infinities
from sim.plots.leakage import plot_split
from sim.plots.psfs import plot_psfs
from sim.psf_bank import PsfBank, psf
from sim.store import write_bank
from sim.surface import as_fabricated
from sim.surface.leakage import SplitPsf, split_psf

if TYPE_CHECKING:
    from doedesign.areas.shape import AreaTable, AreaTables
    from doedesign.focus.depth import FocusTable
    from doedesign.spots.orders import OrderTable, OrderTables

# Interference beyond what two fields can do is rounding of single precision, far below one part in a thousand; of sharp
# spots the transform's own error is as much, so that they are looked at again with as many samples as leave none of it.
_MOST_EXCESS, _FINE = 1e-3, 6.0

log = logging.getLogger("doedesign")


class FabricatedPsfs(NamedTuple):
    """Light of a DOE as fabricated, beside the same design without errors.

    Attributes:
        bank: PSFs of the DOE, energy per pixel per unit power incident on the clear aperture.
        nominal: PSFs of the design exactly as drawn.
        splits: leaked and diffracted light by (colour, depth), positions in the bank.
        rows: metrics of both, "nominal" and "fabricated", a row per depth and colour (`doedesign.prediction`); those of
            the DOE with "split", the energy in the window by origin, whose three parts sum to the throughput.
        variation: errors of the DOE.
        aimed: tables of both where the spec has spots, an area or foci, under the same names as the rows; else empty.
    """

    bank: PsfBank
    nominal: PsfBank
    splits: dict[tuple[int, int], SplitPsf]
    rows: dict[str, list[dict[str, Any]]]
    variation: Variation
    aimed: "dict[str, OrderTable | OrderTables | AreaTable | AreaTables | FocusTable]"


def fabricated(
    source: Design | Run | str | Path,
    masks: str | Path | None = None,
    *,
    process: Process | str | Path | None = None,
    variation: Variation | str | Path | None = None,
    seed: int | None = None,
    draw: str = "normal/0",
    out: str | Path | None = None,
) -> FabricatedPsfs:
    """Predict the light of a DOE as fabricated; with neither a variation nor a seed, with every error at its mean.

    Args:
        source: a design, a finished run or its folder.
        masks: mask order of the run, whose files are read; `masks/NAME` if there is one, else the run's own map.
        process: a process, the name of a stock process or a TOML file; that of the design's spec by default.
        variation: errors of the DOE, or a TOML file with them.
        seed: take the errors from this seed of the process instead.
        draw: which draw of the seed, as in a tolerance study.
        out: folder for the bank, the metrics (SI units), the errors and pictures.

    Raises:
        InputError: something that cannot be read, or errors beyond the model.
        CheckFailed: leaked and diffracted light do not make up the whole.
    """
    design = open_design(source, masks)
    made_by = design.process(process)
    errors, words = design.plate_errors(made_by, variation, seed, draw)
    log.info(f"plate: {words}")
    about = {"level_map_sha256": design.level_map.digest, "plate": words, "light": design.camera.light}
    with results_folder(out, design.name, design.folder, **about) as folder:
        found = _computed(design, made_by, errors)
        if folder is not None:
            log.info("writing bank and pictures")
            _write(folder, design, found, words)
    return found


def _computed(design: Design, process: Process, errors: Variation) -> FabricatedPsfs:
    camera, level = design.camera, design.level_map.level
    surface = as_fabricated(level, camera, process, errors, depths_m=design.depths_m)
    splits: dict[tuple[int, int], SplitPsf] = {}
    with meter("PSFs", len(design.depths_m) * len(camera.colours)) as progress:
        for d, depth in enumerate(design.depths_m):
            for c, colour in enumerate(camera.colours):
                splits[c, d] = split_psf(surface, depth, colour)
                progress.advance(len(splits))
    excess = max(split.excess() for split in splits.values())
    if excess > _MOST_EXCESS:
        fine = (split_psf(surface, design.depths_m[d], camera.colours[c], sampling=_FINE) for c, d in splits)
        excess = max(split.excess() for split in fine)
    if excess > _MOST_EXCESS:
        raise CheckFailed([f"leaked and diffracted light miss the plate's by {excess:.1e} of its brightest pixel"])
    drawn = as_fabricated(level, camera, process, Variation(), depths_m=design.depths_m)
    nominal = psf(drawn, depths=design.depths_m)
    energy = [[splits[c, d].total for d in range(len(design.depths_m))] for c in range(len(camera.colours))]
    bank = PsfBank(np.array(energy), nominal.colours, design.depths_m, camera.pixel_m, camera=camera)
    tables = {"nominal": plate_rows(design, drawn, nominal), "fabricated": plate_rows(design, surface, bank)}
    rows = {name: without_infinities(found) for name, found in tables.items()}
    for row in rows["fabricated"]:
        d = bank.depths_m.index(float("inf") if row["depth_m"] is None else row["depth_m"])
        split = splits[bank.colours.index(row["colour"]), d]
        parts = {"leaked": split.leaked, "diffracted": split.diffracted, "interference": split.interference}
        row["split"] = {name: float(part.sum(dtype=np.float64)) for name, part in parts.items()}
    aimed = {name: on_target(design, doe) for name, doe in (("nominal", drawn), ("fabricated", surface))}
    return FabricatedPsfs(bank, nominal, splits, rows, errors, {k: v for k, v in aimed.items() if v is not None})


def _write(folder: Path, design: Design, found: FabricatedPsfs, words: str) -> None:
    write_bank(
        folder / "fabricated.exr", found.bank, {"design": design.name, "plate": words, "lens": design.camera.lens_text}
    )
    (folder / "variation.toml").write_text(variation_to_toml(found.variation, [words]), encoding="utf-8")
    metrics: dict[str, Any] = {**found.rows, "lens": design.camera.lens_text}
    if found.aimed:
        made = found.aimed["fabricated"]
        metrics[made.name] = {name: table.summary() for name, table in found.aimed.items()}
        log.info(made.describe())
        (folder / f"{made.name}.csv").write_text(made.to_csv(), encoding="utf-8")
        save(made.plot(), folder / f"{made.name}.png")
    (folder / "metrics.json").write_bytes(canonical_json(metrics))
    whose = f"{design.name}, as fabricated"
    picture = plot_psfs(found.bank, design.camera, design.near_m, design.far_m, title=whose)
    save(picture, folder / "fabricated_psf.png")
    orders = [
        tuple(
            next(r["zeroth_order"] for r in found.rows[name] if r["colour"] == colour)
            for name in ("nominal", "fabricated")
        )
        for colour in found.bank.colours
    ]
    save(plot_split(found.nominal, found.splits, design.camera, 0, orders), folder / "leakage.png")
