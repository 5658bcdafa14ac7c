"""From the process to the wafer: tolerances, calibration, the mask order, its run sheet, and plates as measured."""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from doedesign.report.labels import error_label, value_text
from doedesign.report.page.blocks import (
    ChartBlock,
    ChartSeries,
    ModelBlock,
    PageBlock,
    PageSection,
    PictureBlock,
    TableBlock,
    TextBlock,
    section,
)
from doedesign.report.page.files import (
    RunFiles,
    listed_csv,
    listed_json,
    listed_lines,
    listed_picture,
    packed,
    picture_image,
)
from doedesign.report.page.numbers import SHARES, label_of, length, number, percent, rounded, value_of
from doedesign.spec.process import leading_quantity
from fab.errors import InputError
from fab.files import read_bytes, read_json, sha256_bytes
from fab.manifest.records import Manifest

_BINS = 24
_MOST_EFFECTS = 12


def tolerance_section(files: RunFiles) -> PageSection | None:
    """How plates are distributed, and which errors matter.

    Args:
        files: the run.
    """
    folder = files.folder / "tolerance"
    found = listed_json(folder, "results.json")
    if found is None:
        return None
    return section("tolerance", "Tolerances", [_statistics(found), *_histograms(folder, found), _sensitivities(found),
                                               _budget(found), *_draws_pictures(folder)])  # fmt: skip


def _statistics(found: Mapping[str, Any]) -> TableBlock:
    rows = tuple(
        (label_of(one["quantity"]),
         *(value_of(one["quantity"], one[key]) for key in ("mean", "std", "p05", "median", "p95", "min", "max")))
        for one in found["plates"]["statistics"] if one["colour"] is None
    )  # fmt: skip
    head = ("number", "mean", "standard deviation", "5 %", "median", "95 %", "least", "most")
    note = f"{found['plates']['count']} plates, the worst colour and depth of each; seed {found['seed']}."
    return TableBlock("Plates as the process makes them", head, rows, note)


def _histograms(folder: Path, found: Mapping[str, Any]) -> Iterator[ChartBlock]:
    """How every number is distributed over the plates: its worst colour and depth."""
    rows = listed_csv(folder, "draws.csv") or []
    quantities = [one["quantity"] for one in found["plates"]["statistics"] if one["colour"] is None]
    worst = {one["quantity"]: one for one in found["plates"]["statistics"] if one["colour"] is None}
    for name in quantities:
        by_draw: dict[str, list[float]] = {}
        for row in rows:
            if row["key"].startswith("normal/") and row.get(name):
                by_draw.setdefault(row["key"], []).append(float(row[name]))
        # The side on which a plate is bad is that whose extreme the statistics are of.
        least = np.array([min(values) for values in by_draw.values()])
        most = np.array([max(values) for values in by_draw.values()])
        if not least.size:
            continue
        values = least if abs(least.mean() - worst[name]["mean"]) <= abs(most.mean() - worst[name]["mean"]) else most
        values = values[np.isfinite(values)]
        factor, unit = (100.0, " (%)") if name in SHARES else (1.0, "")
        low, high = float(values.min()), float(values.max())
        if not high > low:
            continue
        counts, edges = np.histogram(values, _BINS, (low, high))
        at = tuple(rounded(factor * float(edge)) or 0.0 for edge in edges)
        series = (ChartSeries("plates", (*(float(count) for count in counts), None)),)
        yield ChartBlock(f"Plates by {label_of(name)}", f"{label_of(name)}{unit}", "plates", at, series, steps=True)


def _sensitivities(found: Mapping[str, Any]) -> TableBlock | None:
    """The errors that move `leading_quantity` most, each alone at both ends of its spread."""
    effects = [one for one in found.get("one_at_a_time") or [] if one["colour"] is None]
    known = [str(one["quantity"]) for one in effects]
    if not known:
        return None
    quantity = leading_quantity(known)
    own = sorted((one for one in effects if one["quantity"] == quantity), key=lambda one: -one["variance"])
    rows = tuple(
        (error_label(one["error"]), value_of(quantity, one["low"]), value_of(quantity, one["expected"]),
         value_of(quantity, one["high"])) for one in own[:_MOST_EFFECTS]
    )  # fmt: skip
    head = ("error", "at its lower end", "at its mean", "at its upper end")
    title = f"Each error alone: {label_of(quantity)} of the worst colour and depth"
    return TableBlock(title, head, rows, f"The {len(rows)} errors that move it most, of {len(own)}.")


def _budget(found: Mapping[str, Any]) -> TextBlock | None:
    budget = found.get("budget")
    if not budget:
        return None
    sigmas = ", ".join(f"{error_label(name)} {value_text(name, value)}"
                       for name, value in sorted((budget.get("sigmas") or {}).items()))  # fmt: skip
    return TextBlock((f"{budget.get('verdict', '')}: largest standard deviations {sigmas or 'none'}.",), title="Budget")


def _draws_pictures(folder: Path) -> Iterator[PictureBlock]:
    for name, title in (("yield.png", "Yield over the limit"), ("one_at_a_time.png", "Effects of every error"),
                        ("sobol.png", "Shares of variance"), ("budget.png", "Budget")):  # fmt: skip
        picture = listed_picture(folder, name)
        if picture is not None:
            yield PictureBlock(title, f"{title}, of the tolerance study", picture)


def calibration_section(files: RunFiles) -> PageSection | None:
    """Errors that measured PSFs tell, and what could explain a ratio.

    Args:
        files: the run.
    """
    return section("calibration", "Calibration", [*_calibration(files.folder / "calibration"),
                                                  *_explanations(files.folder / "explanations"),
                                                  *_precompensation(files)])  # fmt: skip


def _calibration(folder: Path) -> Iterator[PageBlock]:
    found = listed_json(folder, "calibration.json")
    if found is None:
        return
    verdict = "The measurement is explained" if found["explained"] else "The measurement is not explained"
    lines = (f"{verdict}: {number(found['chi2_per_pixel'])} chi² per pixel (noise alone gives 1).",)
    yield TextBlock((*lines, *found["remarks"]), title="Verdict")
    rows = tuple(
        (error_label(one["name"]), value_text(one["name"], one["value"], one["sigma"]),
         value_text(one["name"], one["prior_mean"], one["prior_sigma"]),
         "yes" if one["determined"] else "no", "assumed" if one["assumed"] else "process")
        for one in found["errors"]
    )  # fmt: skip
    head = ("error", "found", "before", "determined", "spread before from")
    yield TableBlock("Errors of this plate", head, rows)
    rows = tuple(
        (one["image"], label_of(one["quantity"]), _with_sigma(one["quantity"], one["measured"]),
         _with_sigma(one["quantity"], one["predicted"])) for one in found["readings"]
    )  # fmt: skip
    yield TableBlock("Read from the images and from the model", ("image", "number", "measured", "model"), rows)
    for name, title in (("errors.png", "Errors before and after"), ("check.png", "Check"), ("psfs.png", "PSFs")):
        picture = listed_picture(folder, name, photo=name == "psfs.png")
        if picture is not None:
            yield PictureBlock(title, f"{title}, of the calibration", picture, ink=name != "psfs.png")


def _with_sigma(name: str, pair: Sequence[float] | None) -> str:
    return "–" if pair is None else f"{value_of(name, pair[0])} ± {value_of(name, pair[1])}"


def _explanations(folder: Path) -> Iterator[PageBlock]:
    lines = listed_lines(folder, "explanations.txt")
    if lines is None:
        return
    yield TextBlock(tuple(lines), preformatted=True, title="Explanations of a ring:disc ratio")
    picture = listed_picture(folder, "explanations.png")
    if picture is not None:
        yield PictureBlock("Explanations", "Ratio by every error", picture)


def _precompensation(files: RunFiles) -> Iterator[PageBlock]:
    for name, title in (("precompensation.csv", "Pre-compensation"), ("refinement.csv", "Refinement")):
        rows = listed_csv(files.folder, name)
        if rows:
            body = tuple(tuple(_short(value) for value in row.values()) for row in rows)
            yield TableBlock(title, tuple(map(label_of, rows[0])), body)


def _short(text: str | None) -> str:
    try:
        return f"{float(text or ''):.6g}"
    except ValueError:
        return text or ""


def order_section(files: RunFiles) -> PageSection | None:
    """The plate as a model, wafer and marks, the form for the mask shop, and the run sheet.

    Args:
        files: the run.
    """
    if files.order is None:
        return None
    order, folder = files.order, files.order_folder
    return section("order", "Order", [*_facts(order), _model(order, folder), *_order_pictures(order, folder),
                                          *_form(order, folder), *_sheet(order, folder), *_as_built(files),
                                          _order_files(order)])  # fmt: skip


def _ordered(order: Manifest, folder: Path, ending: str) -> bytes | None:
    """Content of the file of an order with an ending; None where it has none."""
    entry = next((one for one in order.files if one.file.endswith(ending)), None)
    if entry is None:
        return None
    data = read_bytes(folder / entry.file)
    if sha256_bytes(data) != entry.sha256:
        cure = "Fetch it again, or write the order again."
        raise InputError(str(folder / entry.file), "must be the file that the manifest lists", "a changed file", cure)
    return data


def _name(order: Manifest, ending: str) -> str:
    return next(one.file for one in order.files if one.file.endswith(ending))


def _facts(order: Manifest) -> Iterator[PageBlock]:
    wafer = order.wafer
    rows = (
        ("photomasks", str(len(order.plates))),
        ("wafer", f"{wafer.diameter_mm:g} mm, {wafer.thickness_mm:g} mm thick"),
        ("dies", f"{len(wafer.dies_mm)} of {wafer.die_mm:g} mm every {wafer.die_pitch_mm:g} mm"),
        ("database unit", f"{order.dbu_nm:g} nm"),
    )
    yield TableBlock("Layout", ("", ""), rows)
    rows = tuple(
        (one.mask, one.makes, "–" if one.depth_nm is None else f"{one.depth_nm:g} nm", one.file, one.field, one.reading)
        for one in order.plates
    )
    yield TableBlock("Photomasks in the order of use", ("mask", "makes", "depth", "file", "field", "reading"), rows)


def _model(order: Manifest, folder: Path) -> ModelBlock | None:
    data = _ordered(order, folder, "_RELIEF.glb")
    if data is None:
        return None
    entry = next(one for one in order.models if one.file.endswith("_RELIEF.glb"))
    # Steps as high as a thirtieth of the plate's width are seen.
    total_m, width_m = float(order.staircase().total_m), max(order.relief.extent_m)
    higher = max(1, round(width_m / 30 / total_m))
    note = f"{entry.content}. Heights are drawn {higher} times as high."
    return ModelBlock("The plate", _name(order, "_RELIEF.glb"), packed(data), higher, note)


def _order_pictures(order: Manifest, folder: Path) -> Iterator[PictureBlock]:
    for ending, title in (("_WAFER.png", "Wafer"), ("_MARKS.png", "Marks and test structures")):
        if _ordered(order, folder, ending) is not None:
            yield PictureBlock(title, f"{title} of the order", picture_image(folder / _name(order, ending)))


def _form(order: Manifest, folder: Path) -> Iterator[TableBlock]:
    """The order form, a column per mask: it has many lines."""
    data = _ordered(order, folder, "_ORDER.csv")
    if data is None:
        return
    lines = list(csv.reader(io.StringIO(data.decode())))
    columns = tuple(tuple(line[k] if k < len(line) else "" for line in lines[1:]) for k in range(len(lines[0])))
    rows = tuple((name.replace("_", " "), *values) for name, values in zip(lines[0], columns, strict=True))
    yield TableBlock("Order form", ("field", *rows[0][1:]), rows[1:], folded=True)


def _sheet(order: Manifest, folder: Path) -> Iterator[PageBlock]:
    """Steps of the run sheet with what the lab should find."""
    if _ordered(order, folder, "_RUNSHEET.json") is None:
        return
    sheet = read_json(folder / _name(order, "_RUNSHEET.json"))
    rows = []
    for step in sheet["steps"]:
        etch = step.get("etch") or {}
        pads = "; ".join(f"{pad['pad']}: {number(pad['expected_nm'])} nm" for pad in etch.get("pads", []))
        target = "–" if etch.get("target_nm") is None else f"{number(etch['target_nm'])} nm"
        overlay = "–" if step.get("overlay_tolerance_um") is None else f"{number(step['overlay_tolerance_um'])} µm"
        rows.append((str(step["number"]), step["title"], step["makes"], target, pads or "–", overlay))
    head = ("step", "title", "makes", "target depth", "expected on the pads", "overlay within")
    yield TableBlock("Run sheet", head, tuple(rows), f"In full: {_name(order, '_RUNSHEET.html')}.")
    predicted = sheet.get("predicted") or {}
    rows = [
        (kind.replace("_", " "), one["colour"], length(one["depth_m"]), number(one["strehl"]),
         percent(one["zeroth_order"]), percent(one["throughput"]), number(one["ring_to_disc"]),
         percent(one["far_spot"]))
        for kind in ("as_drawn", "expected") for one in predicted.get(kind) or []
    ]  # fmt: skip
    if rows:
        head = ("plate", "colour", "depth", "relative Strehl ratio", "0th order", "throughput", "ring:disc", "far spot")
        yield TableBlock("Predicted on the sheet", head, tuple(rows), folded=True)
    entries = tuple(_entries(sheet.get("measured"), ""))
    if entries:
        yield TableBlock("Measured on the sheet of the order", ("entry", "value"), entries)


def _entries(value: Any, key: str) -> Iterator[tuple[str, str]]:
    """Blanks that were filled in."""
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _entries(inner, f"{key}, {name}".removeprefix(", "))
    elif value is not None:
        yield key.replace("_", " "), number(value, 6)


def _as_built(files: RunFiles) -> Iterator[PageBlock]:
    """The filled sheet of a wafer: its errors, and its light beside that of the sheet."""
    found = listed_json(files.folder / "as-built", "as-built.json")
    if found is None:
        return
    if found["notes"]:
        notes = tuple((key, str(value)) for key, value in sorted(found["notes"].items()))
        yield TableBlock("Wafer as measured: notes", ("", ""), notes)
    measured = [one for one in found["errors"] if one["source"] == "measured"]
    others = [one for one in found["errors"] if one not in measured]
    for title, some in (("errors that were measured", measured), ("other errors", others)):
        rows = tuple((error_label(one["error"]), value_text(one["error"], one["value"]), one["source"]) for one in some)
        if rows:
            yield TableBlock(f"Wafer as measured: {title}", ("error", "value", "from"), rows, folded=some is others)
    predicted = [one for one in found["comparison"] if one["as_drawn"] is not None]
    for title, some in (("light beside that of the sheet", predicted), ("all light", found["comparison"])):
        rows = tuple(
            (label_of(one["quantity"]), one["colour"], length(one["depth_m"]),
             *(value_of(one["quantity"], one[kind]) for kind in ("as_drawn", "expected", "as_built")))
            for one in some
        )  # fmt: skip
        head = ("number", "colour", "depth", "as drawn", "expected", "as built")
        if rows:
            yield TableBlock(f"Wafer as measured: {title}", head, rows, folded=some is not predicted)
    rows = tuple(
        (one["grating"], *(percent(one[kind]) for kind in ("as_drawn", "as_built", "measured")))
        for one in found["gratings"]
    )
    if rows:
        yield TableBlock("Test gratings", ("grating", "as drawn", "as built", "measured"), rows)


def _order_files(order: Manifest) -> TableBlock:
    rows = tuple((one.file, one.format, f"{one.bytes:,}".replace(",", " "), one.sha256) for one in order.files)
    return TableBlock("Files of the order", ("file", "format", "bytes", "SHA-256"), rows, folded=True)
