"""`doedesign masks RUN --as-built FILE`: the DOE that the lab measured beside the predictions of its run sheet."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from doedesign.build import resolve_process
from doedesign.design.design import Design
from doedesign.lab.as_built import AsBuiltDoe, as_built_doe, compare_gratings, compare_with_sheet
from doedesign.prediction import predict
from doedesign.runs.folder import alone_in, open_run
from doedesign.runs.level_maps import open_design
from doedesign.runs.results import require_own
from doedesign.spec import variation_to_toml
from fab.errors import InputError
from fab.figure import save
from fab.files import MANIFEST_NAME, atomic_folder, canonical_json, sha256_file
from fab.process import Process, deviation_of
from fab.runsheet.as_built import AsBuilt, read_as_built
from sim.plots.psfs import plot_psfs
from sim.store import write_bank

FORMAT = "doedesign as-built 1"

log = logging.getLogger("doedesign")

_TITLES = {
    "strehl": "Strehl ratio",
    "zeroth_order": "0th order",
    "throughput": "throughput",
    "ring_to_disc": "ring:disc",
    "far_spot": "far spot",
}


def as_built(run_folder: Path, file: Path, masks: Path | None = None, *, process: Path | None = None) -> Path:
    """Predict the DOE of a filled run sheet and write what was found into RUN/as-built.

    Args:
        run_folder: the finished run that the wafer was made from.
        file: the JSON of its run sheet, with measured numbers; what is null is taken at the process's mean.
        masks: its mask order, whose files are read; `masks/NAME` if there is one, else the run's own map.
        process: TOML file with a process; the run's own process by default.

    Returns:
        the folder: the PSF bank `as-built.exr` and its picture, `as-built.json` with every error, where it comes from
        and the comparison with the sheet, and `variation.toml`, which a prediction with given errors reads.

    Raises:
        InputError: a file that cannot be read or is not of this design, an impossible value, or errors beyond the
            model.
    """
    run = open_run(run_folder)
    design = open_design(run, masks)
    made_by = resolve_process(process, design.levels, run.spec.process)
    measured = read_as_built(file, design.level_map)
    doe = as_built_doe(measured, made_by)
    log.info(_sources(doe))
    folder = run.path("as-built")
    require_own(folder)
    with alone_in(run.folder), atomic_folder(folder) as fresh:
        rows = _write(fresh, design, made_by, measured, doe, file)
    for line in _lines(rows):
        log.info(line)
    return folder


def _sources(doe: AsBuiltDoe) -> str:
    """Return in words how many errors were measured."""
    count = {source: 0 for source in ("measured", "process mean", "not measured, taken as 0")}
    for one in doe.taken:
        count[one.source] += 1
    return ", ".join(f"{number} errors: {source}" for source, number in count.items() if number)


def _write(
    folder: Path, design: Design, process: Process, measured: AsBuilt, doe: AsBuiltDoe, file: Path
) -> list[dict[str, Any]]:
    try:
        prediction = predict(design, process, doe.variation)
    except InputError as error:
        raise InputError(f"{file}: {error.where}", error.rule, error.got, error.cure) from error
    rows = compare_with_sheet(prediction.rows, measured.predicted)
    found = {
        "format": FORMAT,
        "design": design.name,
        "level_map_sha256": design.level_map.digest,
        "units": "SI; a depth of null is infinity; null in a comparison is what the sheet does not say",
        "notes": dict(measured.notes),
        "errors": [{**one._asdict(), "unit": deviation_of(one.error).unit} for one in doe.taken],
        "etch_lag_per_nm": doe.lag_per_nm,
        "comparison": rows,
        "gratings": compare_gratings(measured, process, doe.variation, design.camera.material),
    }
    write_bank(folder / "as-built.exr", prediction.bank, {"design": design.name, "plate": "as built"})
    save(plot_psfs(prediction.bank, design.camera, design.near_m, design.far_m), folder / "as-built_psf.png")
    (folder / "as-built.json").write_bytes(canonical_json(found))
    head = [f"plate of {design.name} as it was measured"]
    (folder / "variation.toml").write_text(variation_to_toml(doe.variation, head), encoding="utf-8")
    digests = {path.name: sha256_file(path) for path in sorted(folder.iterdir())}
    manifest = {
        "format": FORMAT,
        "run": design.name,
        "level_map_sha256": design.level_map.digest,
        "measured_sha256": sha256_file(file),
        "results_sha256": digests,
    }
    (folder / MANIFEST_NAME).write_bytes(canonical_json(manifest))
    return rows


def _lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the worst row of every quantity in words."""
    lines = []
    for quantity, title in _TITLES.items():
        of = [row for row in rows if row["quantity"] == quantity]
        if not of:
            continue
        row = (max if quantity == "zeroth_order" else min)(of, key=lambda row: row["as_built"])
        before = [
            f"{row[kind]:.4g} {kind.replace('_', ' ')}" for kind in ("as_drawn", "expected") if _number(row[kind])
        ]
        said = f" (the sheet: {', '.join(before)})" if before else ""
        lines.append(f"{title}, worst colour and depth: {row['as_built']:.4g}{said}")
    return lines


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
