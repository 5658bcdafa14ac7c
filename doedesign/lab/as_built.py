"""Errors of a DOE from the measurements of a lab, and the DOE as built beside the predictions of its run sheet.

An error that was not measured is taken at the mean that the process states, which is 0 if it states none. An error that
was measured replaces the common part, too: a depth of a mask is all that happened to it.
"""

import logging
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from doedesign.build import resolve_process
from doedesign.design.design import Design
from doedesign.lab.predictions import grating_orders, predicted_metrics
from doedesign.prediction import Prediction, predict
from doedesign.runs.folder import Run
from doedesign.runs.level_maps import open_design
from doedesign.runs.results import results_folder
from doedesign.spec import variation_to_toml
from fab.errors import InputError
from fab.figure import save
from fab.files import canonical_json, path_of, sha256_file
from fab.process import Normal, Process, Variation, deviation_of, error_names, variation_of
from fab.runsheet.as_built import AsBuilt, MaskMeasured, read_as_built
from fab.runsheet.tables import PredictedMetrics
from fab.units import NM
from sim.metrics import METRICS
from sim.plots.psfs import plot_psfs
from sim.store import write_bank

log = logging.getLogger("doedesign")

_COMPARED = ("strehl", "zeroth_order", "throughput", "ring_to_disc", "far_spot")
_ROUNDS = 20
_COMMON = ("common_depth_scale", "common_cd_bias_m")


class ErrorValue(NamedTuple):
    """One error by flat name, SI, and its source: "measured", "process mean", or "not measured, taken as 0"."""

    error: str
    value: float
    source: str


class AsBuiltDoe(NamedTuple):
    """Errors of a DOE as it was built, each with its source.

    1 nm of error in one depth changes the etch lag by `lag_per_nm`; None if it was not measured.
    """

    variation: Variation
    taken: tuple[ErrorValue, ...]
    lag_per_nm: float | None


def _fitted(masks: Sequence[MaskMeasured], lag: float) -> tuple[float, dict[int, float], float | None]:
    """Find etch lag and depths by least squares over all pads of all masks; a lag is never negative.

    A pad of width w is D (1 - lag D / w) deep, with a depth D of each mask; `lag` is taken where no mask has pads of
    two widths.

    Returns:
        the lag, the depths of wide openings by mask, and how fast the lag follows an error of a depth, 1/m.
    """
    pads = {k: [(1 / w, depth) for w, depth in mask.depths_m] for k, mask in enumerate(masks) if mask.depths_m}
    depths = {k: max(depth for _, depth in found) for k, found in pads.items()}
    per_m = None
    # Linear in the depths and the lag but for the square of the depth, which hardly changes.
    for _ in range(_ROUNDS):
        factors = {k: [depths[k] ** 2 * narrow for narrow, _ in found] for k, found in pads.items()}
        around = {k: [x - math.fsum(xs) / len(xs) for x in xs] for k, xs in factors.items()}
        square = math.fsum(x * x for xs in around.values() for x in xs)
        if square > 0:
            fall = math.fsum(-x * depth for k, xs in around.items() for x, (_, depth) in zip(xs, pads[k], strict=True))
            lag, per_m = max(0.0, fall / square), 1 / math.sqrt(square)
        for k, found in pads.items():
            depths[k] = math.fsum(d + lag * x for (_, d), x in zip(found, factors[k], strict=True)) / len(found)
    return lag, depths, per_m


def _mask_errors(
    process: Process,
    mean: Mapping[str, float],
    bit: int,
    mask: MaskMeasured,
    depth_m: float | None,
    marks_m: tuple[float, float],
) -> dict[str, float]:
    """Measured numbers of one mask as errors by flat name, given the process's means.

    The marks that overlay is measured against lie off at the die by `marks_m` (y, x).
    """
    found = {}
    times = 1 if mask.times_etched is None else mask.times_etched
    if depth_m is not None and times:
        # The die is etched as deep as the process's mean non-uniformity has it there.
        found[f"depth_scale[{bit}]"] = depth_m / (times * process.depths_m()[bit] * process.depth_at_die) - 1
    if mask.edges_m is not None:
        found[f"cd_bias_m[{bit}]"] = mask.edges_m
    # The verniers stand at the die; an overlay is that of the middle of the wafer.
    y, x = process.die_m
    turn, growth = mean[f"rotation_rad[{bit}]"], mean[f"magnification[{bit}]"]
    if mask.overlay_y_m is not None:
        found[f"overlay_y_m[{bit}]"] = mask.overlay_y_m + marks_m[0] - growth * y - turn * x
    if mask.overlay_x_m is not None:
        found[f"overlay_x_m[{bit}]"] = mask.overlay_x_m + marks_m[1] - growth * x + turn * y
    return found


def _marks_m(process: Process, mean: Mapping[str, float], reference: int | None) -> tuple[float, float]:
    """Where the marks of a mask lie at the die (y, x) by the process's means; those of a zero layer, where they should.

    Args:
        process: the process.
        mean: its means by flat name.
        reference: bit of the mask; None for a zero layer.
    """
    if reference is None:
        return 0.0, 0.0
    y, x = process.die_m
    turn, growth = mean[f"rotation_rad[{reference}]"], mean[f"magnification[{reference}]"]
    return (
        mean[f"overlay_y_m[{reference}]"] + growth * y + turn * x,
        mean[f"overlay_x_m[{reference}]"] + growth * x - turn * y,
    )


def as_built_doe(measured: AsBuilt, process: Process) -> AsBuiltDoe:
    """Turn measured numbers into the errors of a DOE; the process has target depths and means of what was not measured.

    Depths and line widths of all masks are whole, the common parts are 0. Edges that were moved on the mask count with
    the line width.
    """
    mean = {name: process.spreads.get(name, Normal()).mean for name in error_names(process.masks)}
    values = mean | dict.fromkeys(_COMMON, 0.0)
    lag, depths_m, per_m = _fitted(measured.masks, mean["etch_lag"])
    found = {} if per_m is None else {"etch_lag": lag}
    marks_m = _marks_m(process, mean, measured.reference)
    for bit, mask in enumerate(measured.masks):
        # The common parts count with the mask's own.
        values[f"depth_scale[{bit}]"] = (1 + mean["common_depth_scale"]) * (1 + mean[f"depth_scale[{bit}]"]) - 1
        values[f"cd_bias_m[{bit}]"] += mean["common_cd_bias_m"]
        found |= _mask_errors(process, mean, bit, mask, depths_m.get(bit), marks_m)
    plain = {
        "corner_radius_m": measured.corner_radius_m,
        "sidewall_rad": measured.sidewall_rad,
        "chrome_x_m": None if (x_m := measured.chrome.overlay_x_m) is None else x_m + marks_m[1],
        "chrome_y_m": None if (y_m := measured.chrome.overlay_y_m) is None else y_m + marks_m[0],
        "chrome_diameter_m": measured.chrome.wider_m,
    }
    found |= {name: value for name, value in plain.items() if value is not None}
    values |= found
    stated = dict(values)
    for bit, mask in enumerate(measured.masks):
        values[f"cd_bias_m[{bit}]"] += mask.edge_move_m
    repeats = tuple(0 if mask.times_etched is None else mask.times_etched - 1 for mask in measured.masks)
    sources = {
        name: "measured" if name in found else "process mean" if value else "not measured, taken as 0"
        for name, value in stated.items()
        if name not in _COMMON
    }
    given = {name: value for name, value in values.items() if value}
    variation = variation_of(process.masks, given, repeats=repeats if any(repeats) else ())
    taken = tuple(ErrorValue(name, values[name], source) for name, source in sources.items())
    return AsBuiltDoe(variation, taken, None if per_m is None else per_m * NM)


def _of_sheet(predicted: Mapping[str, Any] | None, kind: str, now: PredictedMetrics) -> Mapping[str, Any]:
    """Prediction of a sheet for the same colour and depth; nothing if it did not."""
    rows = (predicted or {}).get(kind)
    for row in rows if isinstance(rows, list) else []:
        if isinstance(row, Mapping) and row.get("colour") == now.colour and _same(row.get("depth_m"), now.depth_m):
            return row
    return {}


def _same(one: Any, other: float | None) -> bool:
    if one is None or other is None:
        return one is other
    return isinstance(one, int | float) and math.isclose(one, other, rel_tol=1e-6)


def compare_with_sheet(rows: Sequence[dict[str, Any]], predicted: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """Compare the prediction of a DOE as built with those of its run sheet.

    Returns:
        A row per colour, depth and quantity: `as_drawn` and `expected` of the sheet (None if it has no such row) and
        `as_built`.
    """
    out = []
    for now in predicted_metrics(rows):
        before = {kind: _of_sheet(predicted, kind, now) for kind in ("as_drawn", "expected")}
        place = {"colour": now.colour, "depth_m": now.depth_m}
        for quantity in _COMPARED:
            if (value := getattr(now, quantity)) is not None:
                old = {kind: row.get(quantity) for kind, row in before.items()}
                out.append({**place, "quantity": quantity, **old, "as_built": value})
    return out


def compare_gratings(measured: AsBuilt, process: Process, variation: Variation, material: str) -> list[dict[str, Any]]:
    """Compare what the test gratings showed with what they should according to the measured depths.

    Returns:
        A row per grating with `as_drawn`, `as_built` and `measured` (None if it was not); none if the sheet does not
        say at which wavelength.
    """
    probe_nm = (measured.predicted or {}).get("probe_wavelength_nm")
    if not isinstance(probe_nm, int | float) or isinstance(probe_nm, bool) or probe_nm <= 0:
        return []
    nominal = process.depths_m()
    scales = variation.depth_scale or (0.0,) * process.masks
    repeats = variation.repeats or (0,) * process.masks
    # Gratings lie beside the pads, whose depth has the mean non-uniformity in it (`_mask_errors`).
    here = process.depth_at_die
    built = [d * here * (1 + s) * (1 + again) for d, s, again in zip(nominal, scales, repeats, strict=True)]
    # The binary grating is that of the deepest target, whatever became of it.
    deepest = max(range(process.masks), key=lambda bit: nominal[bit])
    drawn = grating_orders(nominal, material, probe_nm * NM)
    binary = grating_orders([built[deepest]], material, probe_nm * NM)[0]
    now = (binary, grating_orders(built, material, probe_nm * NM)[1])
    shown = (measured.grating_binary, measured.grating_blazed)
    return [
        {"grating": name, "wavelength_nm": probe_nm, "as_drawn": a, "as_built": b, "measured": m}
        for name, a, b, m in zip(("binary", "blazed"), drawn, now, shown, strict=True)
    ]


class AsBuiltPrediction(NamedTuple):
    """Prediction of a DOE as the lab measured it.

    Attributes:
        doe: its errors, SI units, and where each comes from.
        prediction: DOE, PSFs and metrics.
        comparison: with what the run sheet predicted (`compare_with_sheet`).
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
    measured = read_as_built(path_of(file, "file"), design.level_map)
    doe = as_built_doe(measured, made_by)
    count = Counter(one.source for one in doe.taken)
    sources = [each for each in ("measured", "process mean", "not measured, taken as 0") if count[each]]
    log.info(", ".join(f"{count[each]} errors: {each}" for each in sources))
    about = {"level_map_sha256": design.level_map.digest, "measured_sha256": sha256_file(Path(file))}
    about["light"] = design.camera.light
    with results_folder(out, design.name, design.folder, **about) as folder:
        try:
            prediction = predict(design, made_by, doe.variation)
        except InputError as error:
            raise InputError(f"{file}: {error.where}", error.rule, error.got, error.cure) from error
        found = AsBuiltPrediction(doe, prediction, compare_with_sheet(prediction.rows, measured.predicted))
        if folder is not None:
            _write(folder, design, made_by, measured, found)
    for quantity in _COMPARED:
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
    picture = plot_psfs(bank, design.camera, design.near_m, design.far_m, title=f"{design.name}, as built")
    save(picture, folder / "as-built_psf.png")
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
