"""The DOE that the lab measured beside the predictions of its run sheet."""

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from doedesign.build import resolve_process
from doedesign.design.design import Design
from doedesign.lab.as_built import COMPARED, AsBuiltDoe, as_built_doe, compare_gratings, compare_with_sheet
from doedesign.prediction import Prediction, predict
from doedesign.runs.folder import Run
from doedesign.runs.level_maps import open_design
from doedesign.runs.results import results_folder
from doedesign.spec import variation_to_toml
from fab.errors import InputError
from fab.figure import save
from fab.files import canonical_json, sha256_file
from fab.process import Process, deviation_of
from fab.runsheet.as_built import AsBuilt, read_as_built
from sim.metrics import METRICS
from sim.plots.psfs import plot_psfs
from sim.store import write_bank

log = logging.getLogger("doedesign")


class AsBuiltPrediction(NamedTuple):
    """Prediction of a DOE as the lab measured it.

    Attributes:
        doe: its errors, SI units, and where each comes from.
        prediction: DOE, PSFs and metrics.
        comparison: a row per colour, depth and quantity with what the run sheet predicted
            (`doedesign.lab.as_built.compare_with_sheet`).
    """

    doe: AsBuiltDoe
    prediction: Prediction
    comparison: list[dict[str, Any]]


def as_built(
    source: Design | Run | str | Path,
    file: str | Path,
    masks: str | Path | None = None,
    *,
    process: Process | str | Path | None = None,
    out: str | Path | None = None,
) -> AsBuiltPrediction:
    """Predict the DOE of a filled run sheet.

    Args:
        source: the design that the wafer was made from, its finished run, or the run's folder.
        file: JSON of the run sheet, with measured numbers; what is null is taken at the process's mean.
        masks: mask order of the run, whose files are read; `masks/NAME` if there is one, else the run's own map.
        process: a process, the name of a stock process or a TOML file; that of the design's spec by default.
        out: folder for the PSF bank `as-built.exr` and its picture, `as-built.json` with every error, where it comes
            from and the comparison with the sheet, and `variation.toml`, which a prediction with given errors reads.

    Raises:
        InputError: a file that cannot be read or is not of this design, an impossible value, or errors beyond the
            model.
    """
    design = open_design(source, masks)
    made_by = resolve_process(process, design.levels, design.spec and design.spec.process)
    measured = read_as_built(Path(file), design.level_map)
    doe = as_built_doe(measured, made_by)
    count = Counter(one.source for one in doe.taken)
    sources = [each for each in ("measured", "process mean", "not measured, taken as 0") if count[each]]
    log.info(", ".join(f"{count[each]} errors: {each}" for each in sources))
    about = {"level_map_sha256": design.level_map.digest, "measured_sha256": sha256_file(Path(file))}
    with results_folder(out, design.name, design.folder, **about) as folder:
        try:
            prediction = predict(design, made_by, doe.variation)
        except InputError as error:
            raise InputError(f"{file}: {error.where}", error.rule, error.got, error.cure) from error
        found = AsBuiltPrediction(doe, prediction, compare_with_sheet(prediction.rows, measured.predicted))
        if folder is not None:
            _write(folder, design, made_by, measured, found)
    for quantity in COMPARED:
        if of := [row for row in found.comparison if row["quantity"] == quantity]:
            log.info(_worst(quantity, of))
    return found


def _write(folder: Path, design: Design, process: Process, measured: AsBuilt, found: AsBuiltPrediction) -> None:
    doe, bank = found.doe, found.prediction.bank
    record = {
        "format": "doedesign as-built 1",
        "design": design.name,
        "level_map_sha256": design.level_map.digest,
        "units": "SI; a depth of null is infinity; null in a comparison is what the sheet does not say",
        "notes": dict(measured.notes),
        "errors": [{**one._asdict(), "unit": deviation_of(one.error).unit} for one in doe.taken],
        "etch_lag_per_nm": doe.lag_per_nm,
        "comparison": found.comparison,
        "gratings": compare_gratings(measured, process, doe.variation, design.camera.material),
    }
    write_bank(folder / "as-built.exr", bank, {"design": design.name, "plate": "as built"})
    save(plot_psfs(bank, design.camera, design.near_m, design.far_m), folder / "as-built_psf.png")
    (folder / "as-built.json").write_bytes(canonical_json(record))
    head = [f"plate of {design.name} as it was measured"]
    (folder / "variation.toml").write_text(variation_to_toml(doe.variation, head), encoding="utf-8")


def _worst(quantity: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """The worst row of a quantity in words."""
    row = (max if METRICS[quantity].worse == "high" else min)(rows, key=lambda row: row["as_built"])
    known = [kind for kind in ("as_drawn", "expected") if type(row[kind]) in (int, float)]  # a sheet may hold anything
    words = ", ".join(f"{row[kind]:.4g} {kind.replace('_', ' ')}" for kind in known)
    said = f" (the sheet: {words})" if words else ""
    return f"{METRICS[quantity].label}, worst colour and depth: {row['as_built']:.4g}{said}"
