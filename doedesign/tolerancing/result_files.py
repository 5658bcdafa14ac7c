"""Files of a tolerance study: tables of draws and errors, results and pictures.

draws.csv       one line per draw, colour and depth with every metric
errors.csv      one line per draw with every error, SI units
results.json    `ToleranceResult.record`
*.png           `doedesign.tolerancing.plots`, and the PSFs of the nominal and the worst DOE
manifest.json   SHA-256 of all these
"""

import csv
import io
import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from doedesign.runtime.pool import evaluate_here
from doedesign.tolerancing.plots import plot_budget, plot_effects, plot_variance_shares, plot_yield
from doedesign.tolerancing.pool import DrawModel, OutOfModel, predicted_bank
from doedesign.tolerancing.studies import FORMAT, Study
from fab.draws import NOMINAL
from fab.figure import save
from fab.files import MANIFEST_NAME, canonical_json, read_json, sha256_file, write_atomic
from fab.process import error_names
from sim.plots.psfs import plot_psfs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from doedesign.tolerancing.results import ToleranceResult

log = logging.getLogger("doedesign")


def write_results(folder: Path, result: "ToleranceResult") -> None:
    """Write tables, results, pictures and a manifest of them, in the place of those of an earlier call.

    Raises:
        InputError: the system refuses the folder.
    """
    if (folder / MANIFEST_NAME).is_file():
        # Pictures of another plan would stay otherwise.
        for name in read_json(folder / MANIFEST_NAME).get("results_sha256", ()):
            if Path(name).name == name:
                (folder / name).unlink(missing_ok=True)
        (folder / MANIFEST_NAME).unlink()
    write_atomic(folder / "draws.csv", _csv(_draw_lines(result.study, result.keys)))
    write_atomic(folder / "errors.csv", _csv(_error_lines(result.study, result.keys)))
    write_atomic(folder / "results.json", canonical_json(result.record()))
    pictures = _draw(folder, result)
    digests = {name: sha256_file(folder / name) for name in ("draws.csv", "errors.csv", "results.json", *pictures)}
    manifest = {"format": FORMAT, "run": result.study.design.name, "results_sha256": digests}
    write_atomic(folder / MANIFEST_NAME, canonical_json(manifest))


def _draw(folder: Path, result: "ToleranceResult") -> list[str]:
    """Draw all pictures; returns their names."""
    study, design = result.study, result.study.design
    drawn: dict[str, Axes | FigureBase] = {"histograms.png": result.plot(), "yield.png": plot_yield(result.sample)}
    if result.effects is not None:
        drawn["one_at_a_time.png"] = plot_effects(result.effects)
    if result.variance_shares is not None:
        drawn["sobol.png"] = plot_variance_shares(result.variance_shares, design.camera)
    if result.budget is not None:
        drawn["budget.png"] = plot_budget(result.budget)
    shown = {NOMINAL: "nominal_psf.png", result.worst: "worst_psf.png"}
    # By a worker: it finds there what the others have compiled, and gives the same bytes whatever this process is like.
    model = DrawModel(predicted_bank, design, study.process)
    for key, bank in evaluate_here(model, {key: study.variation(key) for key in shown}, 1):
        if isinstance(bank, OutOfModel):  # another evaluation may follow what this one does not
            log.info("no PSFs of %s: %s", key, bank.reason)
            continue
        whose = f"{design.name}, {'as drawn' if key == NOMINAL else f'worst plate ({key})'}"
        drawn[shown[key]] = plot_psfs(bank, design.camera, design.near_m, design.far_m, title=whose)
    for name, picture in drawn.items():
        save(picture, folder / name)
    return list(drawn)


def _draw_lines(study: Study, keys: Sequence[str]) -> Iterable[Sequence[object]]:
    """One line per draw, colour and depth, with every metric; empty where a row has no such metric."""
    found = {key: study.journal.finished[key] for key in keys}
    tables = {key: rows for key, rows in found.items() if not isinstance(rows, OutOfModel)}
    numbers = sorted({name for rows in tables.values() for row in rows for name in row} - {"colour", "depth_m"})
    yield ("key", "colour", "depth_m", *numbers)
    for key, rows in tables.items():
        for row in rows:
            depth = "inf" if row["depth_m"] is None else row["depth_m"]
            values = ("inf" if row.get(name, "") is None else row.get(name, "") for name in numbers)
            yield (key, row["colour"], depth, *values)


def _error_lines(study: Study, keys: Sequence[str]) -> Iterable[Sequence[object]]:
    """One line per draw with every error in SI units, and the number of rare events."""
    names = error_names(study.process.masks)
    yield ("key", *names, "missed_etches", "doubled_etches", "particles", "pinholes", "roughness_seed")
    for key in keys:
        draw = study.variation(key)
        events = (draw.repeats.count(-1), draw.repeats.count(1), len(draw.particles), len(draw.pinholes))
        yield (key, *(draw.value(name) for name in names), *events, draw.seed)


def _csv(lines: Iterable[Sequence[object]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue().encode()
