"""The main numbers of a folder of results, read from its files.

A number is what `metrics.json` or another record states, or a plain mean of such numbers over colours and depths; its
key is the one there, and says of a mean which ("near", "far" or none for all).
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from doedesign.overview.kinds import TABLE_NAME, Record
from doedesign.spec.targets.areas import WITHIN_THE_AREA
from doedesign.spec.targets.spots import ONE_OF_THE_SPOTS
from fab.errors import InputError
from fab.files import read_json

METRICS_FILE, TOLERANCE_FILES = "metrics.json", ("results.json", "tolerance.json")
COUNT = "count"

_GROUPED = 10_000  # counts from here on have their digits in groups of three
_SMALL_PERCENT = 0.995  # which one decimal would round away
LEAST_PERCENT = 1e-4  # of which digits are told; those of less would be powers of ten


class MainNumber(NamedTuple):
    """One number of a result.

    Attributes:
        key: its name for programs.
        label: its name for people.
        value: the number, in the unit; None where it is not known or infinite.
        unit: "%", "dB", "" of a plain number, `COUNT` of things that the label names.
        better: which side is better, where that is known.
        note: what people should know of it, in a few words.
    """

    key: str
    label: str
    value: float | None
    unit: str = ""
    better: Literal["high", "low"] | None = None
    note: str = ""

    def text(self) -> str:
        """Label, value and note in words."""
        words = f"{self.value_text()} {self.label}" if self.unit == COUNT else f"{self.label} {self.value_text()}"
        return f"{words} ({self.note})" if self.note else words

    def value_text(self) -> str:
        """The value with its unit."""
        if self.value is None:
            return "unknown"
        return number_text(self.value, self.unit)


def number_text(value: float, unit: str = "") -> str:
    """A number as the tables of this program write it; a percentage below 1 has two significant digits, down to 0.0001.

    Args:
        value: the number.
        unit: its unit.
    """
    if unit == COUNT:
        return f"{value:,.0f}".replace(",", " ") if abs(value) >= _GROUPED else f"{value:.0f}"
    if unit == "%" and 0 < abs(value) < LEAST_PERCENT:
        return f"below {LEAST_PERCENT:.4f} %"
    if unit == "%" and 0 < abs(value) < _SMALL_PERCENT:
        return f"{value:.2g} %"
    digits = {"%": 1, "dB": 2}.get(unit, 3)
    return f"{value:.{digits}f}{' ' + unit if unit else ''}"


def main_numbers(folder: Path, record: Record) -> tuple[MainNumber, ...]:
    """The main numbers of a folder, the most important first; none where its files do not have them.

    Args:
        folder: the folder.
        record: what it says of itself.
    """
    reader = _READERS.get(record.kind)
    if reader is None:
        return ()
    try:
        found = tuple(reader(folder, record.found))
        known = [one.value for one in found if one.value is not None]
        return found if all(math.isfinite(value) for value in known) else ()
    # A record that another version wrote, or that somebody edited, has not got what is looked for.
    except (InputError, KeyError, TypeError, ValueError, ArithmeticError, AttributeError, IndexError):
        return ()


def _mean(rows: Iterable[Mapping[str, Any]], value: Callable[[Mapping[str, Any]], Any]) -> float | None:
    found = [float(one) for row in rows if (one := value(row)) is not None]
    return sum(found) / len(found) if found else None


def _percent(share: Any) -> float | None:
    return None if share is None else 100 * float(share)


def zeroth_note(metrics: Mapping[str, Any]) -> str:
    """The note on a 0th order that is wanted: one of the spots, or light of the area, of several areas of each.

    Args:
        metrics: of a run or of a plate.
    """
    for name, note in (("orders", ONE_OF_THE_SPOTS), ("area", WITHIN_THE_AREA)):
        tables = _tables_in(metrics.get(name))
        if tables and all(table.get("zeroth_order_wanted") for table in tables):
            return note
    return ""


def _tables_in(found: Any) -> list[Mapping[str, Any]]:
    """Tables of spots or areas: a plate has one as drawn and one as fabricated, several areas one each."""
    if isinstance(found, Mapping) and "on_target" not in found:
        return [table for one in found.values() for table in _tables_in(one)]
    if isinstance(found, list):
        return [table for one in found for table in _tables_in(one)]
    return [found] if isinstance(found, Mapping) else []


_REFINED: tuple[tuple[str, str, Literal["high", "low"]], ...] = (
    ("on_target", "light on target", "high"),
    ("uniformity_error", "uniformity error", "low"),
    ("zeroth_order_efficiency", "0th order", "low"),
)


def _of_run(folder: Path, _: Mapping[str, Any]) -> Iterator[MainNumber]:
    metrics = read_json(folder / METRICS_FILE)
    rigorous = [row for row in metrics.get("refinement", ()) if row["cell"] == "refined" and row["terms"]]
    if rigorous:
        finest = max(rigorous, key=lambda row: row["terms"])
        for key, label, better in _REFINED:
            note = zeroth_note(metrics) if label == "0th order" else ""
            side = None if note else better
            yield MainNumber(
                f"{key}_rigorous", f"{label} by Maxwell's equations", _percent(finest[key]), "%", side, note
            )
    for name in ("orders", "area", "focus"):
        if name in metrics:
            yield from _of_aim(metrics[name], zeroth_note(metrics))
            return
    rows = metrics["psf"]
    near = [row for row in rows if "concentration" in row]
    far = [row for row in rows if "far_spot" in row]
    if far:
        share = _mean(far, lambda row: row["far_spot"])
        yield MainNumber("far_spot", "far spot", _percent(share), "%", "high")
    if near:
        # Less concentration, and so less of the bound, means that near light is spread better.
        over = _mean(near, lambda row: row["concentration"] / row["concentration_bound"])
        yield MainNumber("concentration_over_bound", "near light's concentration over its bound", over, "", "low")
    inside = _percent(_mean(rows, lambda row: row["throughput"]))
    yield MainNumber("throughput", "light in the window", inside, "%", "high")
    order = _percent(_mean(rows, lambda row: row["zeroth_order"]))
    # Wanted where a scene should stay sharp: it is the spot.
    yield MainNumber("zeroth_order", "0th order", order, "%")


def _of_aim(found: Any, note: str = "") -> Iterator[MainNumber]:
    """Numbers of spots, areas or foci, of several areas or colours the worst; with a note on the 0th order."""
    tables = found if isinstance(found, list) else [found]
    one = tables[0]
    if "on_target" in one:
        share = min(each["on_target"] for each in tables)
        yield MainNumber("on_target", "light on target", _percent(share), "%", "high")
    if "uniformity_error" in one:
        worst = max(each["uniformity_error"] for each in tables)
        yield MainNumber("uniformity_error", "uniformity error", _percent(worst), "%", "low")
    if "contrast" in one:
        worst = max(each["contrast"] for each in tables)
        yield MainNumber("contrast", "contrast of the area", _percent(worst), "%", "low")
    if "focus_width" in one:
        yield MainNumber("focus_width", "width of the worst focus over that wanted", one["focus_width"], "", "low")
    for key in ("zeroth_order", "zeroth_order_efficiency"):
        if key in one:
            # A spot or a focus of its own may be wanted there; of several areas those count where it is not.
            wanted = None if "foci" in one or "spots" in one or note else "low"
            leaked = [each for each in tables if not each.get("zeroth_order_wanted")] or tables
            share = _percent(max(each[key] for each in leaked))
            yield MainNumber(key, "0th order", share, "%", wanted, note)
    if one.get("ceiling") is not None:
        yield MainNumber("ceiling", "ceiling of light on target", _percent(one["ceiling"]), "%")


_ON_PLATES: tuple[tuple[str, str, str, Literal["high", "low"]], ...] = (
    ("uniformity_error", "uniformity error", "%", "low"),
    ("on_target", "light on target", "%", "high"),
    ("strehl", "relative Strehl ratio", "", "high"),
)


def _of_plates(means: Mapping[str, float | None], words: str = "") -> Iterator[MainNumber]:
    """The numbers of plates that tell of spots, areas and foci; where none does, how like their design they are."""
    there = [one for one in _ON_PLATES if means[one[0]] is not None]
    for key, label, unit, better in [one for one in there if one[0] != "strehl"] or there:
        mean = means[key]
        yield MainNumber(key, label + words, _percent(mean) if unit else mean, unit, better)


def _of_plate(folder: Path, _: Mapping[str, Any]) -> Iterator[MainNumber]:
    metrics = read_json(folder / METRICS_FILE)
    rows = metrics["fabricated"]

    def mean(name: str) -> float | None:
        return _mean(rows, lambda row: row.get(name))

    yield from _of_plates({name: mean(name) for name, *_ in _ON_PLATES})
    yield MainNumber("zeroth_order", "0th order", _percent(mean("zeroth_order")), "%", note=zeroth_note(metrics))
    yield MainNumber("throughput", "light in the window", _percent(mean("throughput")), "%", "high")


def tolerance_record(folder: Path) -> dict[str, Any]:
    """Results of a tolerance study in its folder, or beside a released design.

    Args:
        folder: the folder.

    Raises:
        InputError: none there, or one that cannot be read.
    """
    for name in TOLERANCE_FILES:
        if (folder / name).is_file():
            return read_json(folder / name)
    return read_json(folder / TOLERANCE_FILES[0])


def _note_of_run(folder: Path) -> str:
    """The note on the 0th order of the run that a study is of, whose folder it is in or beside; none elsewhere."""
    for path in (folder / METRICS_FILE, folder.parent / METRICS_FILE):
        if path.is_file():
            return zeroth_note(read_json(path))
    return ""


def _of_tolerance(folder: Path, _: Mapping[str, Any]) -> Iterator[MainNumber]:
    found = tolerance_record(folder)
    plates = found["plates"]
    if plates.get("yield") is not None:
        share = plates["yield"]["share"] if isinstance(plates["yield"], dict) else plates["yield"]
        yield MainNumber("yield", "yield", _percent(share), "%", "high")

    def mean(quantity: str) -> float | None:
        return _mean((row for row in plates["statistics"] if row["quantity"] == quantity), lambda row: row["mean"])

    yield from _of_plates({name: mean(name) for name, *_ in _ON_PLATES}, " of plates")
    if (order := mean("zeroth_order")) is not None:
        yield MainNumber("zeroth_order", "0th order of plates", 100 * order, "%", note=_note_of_run(folder))
    yield MainNumber("plates", "plates", plates["count"], COUNT)


def _of_scores(scores: Mapping[str, Any], before: Mapping[str, Any] | None = None) -> Iterator[MainNumber]:
    made, seen = scores["reconstruction"], scores["capture"]
    yield MainNumber("psnr_occluded", "PSNR where it is covered", made["occluded"]["psnr"], "dB", "high")
    if before is not None:
        yield MainNumber("before_psnr_occluded", "before", before["occluded"]["psnr"], "dB")
    else:
        yield MainNumber("capture_psnr_occluded", "of the capture", seen["occluded"]["psnr"], "dB")
    yield MainNumber("psnr_full", "over all", made["full"]["psnr"], "dB", "high")
    yield MainNumber("ssim_full", "SSIM over all", made["full"]["ssim"], "", "high")


def _of_training(folder: Path, _: Mapping[str, Any]) -> Iterator[MainNumber]:
    found = read_json(folder / METRICS_FILE)
    yield from _of_scores(found, found.get("before"))


def _of_model(_: Path, found: Mapping[str, Any]) -> Iterator[MainNumber]:
    yield from _of_scores(found["held_out"])


def _of_evaluation(folder: Path, _: Mapping[str, Any]) -> Iterator[MainNumber]:
    rows = {row["name"]: row["scores"] for row in read_json(folder / TABLE_NAME)["rows"] if row["scores"]}
    for name in (name for name in ("proposed", "capture", "conventional_capture") if name in rows):
        score = rows[name]["occluded"]["psnr"]["mean"]
        label = f"PSNR where it is covered, {name.replace('_', ' ')}"
        yield MainNumber(f"{name}_psnr_occluded", label, score, "dB", "high" if name == "proposed" else None)


def _of_order(_: Path, found: Mapping[str, Any]) -> Iterator[MainNumber]:
    yield MainNumber("masks", "masks", len(found["masks"]), COUNT)
    yield MainNumber("levels", "levels", found["levels"], COUNT)
    if found.get("rules"):
        yield _of_rules(found["rules"])


def _of_rules(rules: Mapping[str, Any]) -> MainNumber:
    """Places where masks break the rules of the process, and of which kinds they are."""
    # Without a rule nothing is broken, whatever the corners do.
    planes = rules["planes"] if rules["headlines"] else []
    counts = {
        "touching corners": [plane["kissing"] for plane in planes],
        "narrow lines": [plane["line"]["narrow"] for plane in planes],
        "narrow spaces": [plane["space"]["narrow"] for plane in planes],
    }
    broken = {kind: sum(map(bool, each)) for kind, each in counts.items()}
    told = [f"{kind} on {masks} mask{'s' if masks > 1 else ''}" for kind, masks in broken.items() if masks]
    total = sum(map(sum, counts.values()))
    return MainNumber("rules_broken", "places that break rules", total, COUNT, "low", ", ".join(told))


def _of_certificate(folder: Path, _: Mapping[str, Any]) -> Iterator[MainNumber]:
    from doedesign.runs.verdict import CERTIFICATE_FILE  # whose module loads what draws sheets

    whole = read_json(folder / CERTIFICATE_FILE)["whole"]
    for key, label in (("scalar", "0th order as thin elements"), ("edges", "0th order with edges")):
        share = _percent(_mean(whole, lambda row, key=key: row[f"zeroth_order_{key}"]))
        yield MainNumber(f"zeroth_order_{key}", label, share, "%")


def _of_calibration(folder: Path, _: Mapping[str, Any]) -> Iterator[MainNumber]:
    found = read_json(folder / "calibration.json")
    yield MainNumber("chi2_per_pixel", "chi² per pixel", found["chi2_per_pixel"])
    yield MainNumber("errors", "errors of the plate", len(found["errors"]), COUNT)
    known = sum(bool(one["determined"]) for one in found["errors"])
    yield MainNumber("determined", "of them determined", known, COUNT)


def _of_simulation(_: Path, found: Mapping[str, Any]) -> Iterator[MainNumber]:
    items = [name for name in found.get("results_sha256", {}) if name.count("/") == 1]
    yield MainNumber("items", "items", len({name.partition("/")[0] for name in items}), COUNT)


_READERS: Mapping[str, Callable[[Path, Mapping[str, Any]], Iterator[MainNumber]]] = {
    "run": _of_run,
    "fabricated": _of_plate,
    "tolerance": _of_tolerance,
    "training": _of_training,
    "fine-tuning": _of_training,
    "released model": _of_model,
    "evaluation": _of_evaluation,
    "order": _of_order,
    "certificate": _of_certificate,
    "calibration": _of_calibration,
    "simulation": _of_simulation,
}
