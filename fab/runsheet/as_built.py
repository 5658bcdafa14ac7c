"""Measurements of a lab: the run sheet's JSON, read back with the blanks filled in.

Anything may stay null, which means that it was not measured. What is there has to be possible: a depth in micrometres
where nanometres are asked for, a wall measured from the horizontal or a share in per cent is refused by its key.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

from fab.errors import InputError
from fab.files import read_json
from fab.level_map import LevelMap
from fab.runsheet.tables import OPENING_KEYS
from fab.runsheet.write import BARS, FORMAT, PADS
from fab.units import NM, UM


class MaskMeasured(NamedTuple):
    """Measurements of one etch mask; metres, None where there is none.

    Attributes:
        overlay_x_m: how far the mask lies toward +x of the first photomask's marks, at the die.
        overlay_y_m: the same toward +y.
        edges_m: how far edges of etched areas lie outward of the test structure's drawing, mean over the measured bars.
        edge_move_m: how far the edges of the DOE, not those of the bars, were moved outward on the mask.
        times_etched: 0 for a missed etch, 2 for a doubled one.
        depths_m: depth by the width of the pad; a depth without a pad has an infinite width.
    """

    overlay_x_m: float | None = None
    overlay_y_m: float | None = None
    edges_m: float | None = None
    edge_move_m: float = 0.0
    times_etched: int | None = None
    depths_m: tuple[tuple[float, float], ...] = ()


class ChromeMeasured(NamedTuple):
    """Shift of the chrome's opening toward +x and +y, and how much wider than drawn it is; metres, None if unknown."""

    overlay_x_m: float | None = None
    overlay_y_m: float | None = None
    wider_m: float | None = None


@dataclass(frozen=True)
class AsBuilt:
    """All measurements of one wafer.

    Attributes:
        level_map_sha256: digest of the design that the wafer was made from.
        masks: the etch masks, mask 1 (bit 0) first.
        chrome: the chrome.
        corner_radius_m: radius of the corners, metres; None if not measured, as below.
        sidewall_rad: tilt of the walls from the upright, radians.
        grating_binary: share of the light that the binary grating sends straight on at the probe wavelength.
        grating_blazed: the same of the blazed grating.
        notes: wafer, date and remarks, as text.
        predicted: what the sheet predicted ("as_drawn", "expected", "probe_wavelength_nm" ...); None if nothing.
        reference: bit of the mask whose marks overlay was measured against; None where a zero layer has them.
    """

    level_map_sha256: str
    masks: tuple[MaskMeasured, ...]
    chrome: ChromeMeasured
    corner_radius_m: float | None
    sidewall_rad: float | None
    grating_binary: float | None
    grating_blazed: float | None
    notes: Mapping[str, str]
    predicted: Mapping[str, Any] | None
    reference: int | None = None


class _Table:
    """A part of the JSON, with its name for messages. Each key is asked for once; what is left over is a mistake."""

    def __init__(self, path: Path, name: str, data: Any) -> None:
        self.name = f"{path}: {name}"
        if not isinstance(data, Mapping):
            cure = "Fill in the JSON of the run sheet, and leave its structure as it is."
            raise InputError(self.name, "must be a group of blanks", _short(data), cure)
        self.path, self._short, self._data, self._asked = path, name, data, set()

    def _take(self, key: str) -> Any:
        self._asked.add(key)
        return self._data.get(key)

    def table(self, key: str) -> "_Table":
        """Return a table inside this one; one that is null or missing is empty."""
        data = self._take(key)
        return _Table(self.path, f"{self._short}.{key}", {} if data is None else data)

    def number(self, key: str, low: float, high: float, cure: str, unit: float = 1.0) -> float | None:
        """Return a number between two bounds, both allowed, times a unit; None for null."""
        value = self._take(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self.error(key, "must be a number, or null if it was not measured", value, "Write 74.2, not text.")
        if not low <= value <= high:
            raise self.error(key, f"must lie between {low:.6g} and {high:.6g}", value, cure)
        return value * unit

    def text(self, key: str) -> str | None:
        """Return a text; a number, such as a wafer's, is one."""
        value = self._take(key)
        if value is None or (isinstance(value, str | int | float) and not isinstance(value, bool)):
            return None if value is None else str(value)
        raise self.error(key, "must be text, or null", value, 'Put it in quotes: "...".')

    def error(self, key: str, rule: str, got: object, cure: str) -> InputError:
        return InputError(f"{self.name}.{key}", rule, _short(got), cure)

    def finish(self) -> None:
        """Check that every key was asked for."""
        for key in self._data:
            if key not in self._asked:
                near = get_close_matches(str(key), self._asked, 1) or sorted(self._asked)
                raise self.error(str(key), "must be a blank of the run sheet", key, f"Perhaps it is {near[0]!r}.")


def _short(value: object) -> str:
    return repr(value)[:60]


_WIDEST_UM = 2.0
_FARTHEST_UM = 50.0
_NOT_PRINTED = "Check the unit (micrometres). A bar that did not print stays null."


def _edges_m(table: _Table) -> float | None:
    """Return how far edges lie outward, from the bars or as it was given."""
    bars = table.table("cd_um")
    outward_um = []
    for name, drawn_m in BARS.items():
        drawn = drawn_m / UM
        width = bars.number(name, max(0.0, drawn - _WIDEST_UM), drawn + _WIDEST_UM, _NOT_PRINTED)
        if width is None:
            continue
        if width == 0:
            raise bars.error(name, "must be the width of a bar that is there", width, "Leave it null if it is lost.")
        # A line that is etched too wide grew at both edges; the gap between two of them shrank at both.
        outward_um.append((width - drawn) / 2 if name.endswith("line") else (drawn - width) / 2)
    bars.finish()
    cure = "Check the unit (micrometres), and that it is per edge: half of what a bar grew."
    given_m = table.number("cd_bias_um", -_WIDEST_UM, _WIDEST_UM, cure, UM)
    if given_m is not None and outward_um:
        raise table.error("cd_bias_um", "must not be given besides cd_um", "both", "Leave one of them null.")
    return math.fsum(outward_um) / len(outward_um) * UM if outward_um else given_m


def _overlay(table: _Table, reference: bool = False) -> tuple[float | None, float | None]:
    cure = "Check the unit (micrometres): number of the vernier's line x 0.25."
    x, y = (table.number(f"overlay_{axis}_um", -_FARTHEST_UM, _FARTHEST_UM, cure, UM) for axis in ("x", "y"))
    if reference and (x, y) != (None, None):
        rule = "must stay null, because the others are aligned to the marks of this mask"
        key, got = ("overlay_y_um", y) if x is None else ("overlay_x_um", x)
        raise table.error(key, rule, got, "Fill in how far the others lie from it.")
    return x, y


def _depths(table: _Table, target_m: float, times: int | None) -> tuple[tuple[float, float], ...]:
    """Return measured depths by width of pad; all within half of the target, so that units cannot be confused."""
    due = target_m / NM * (1 if times is None else times)
    low, high = due / 2, due * 1.5
    cure = "Check the unit (nanometres). If the etch was missed or repeated, fill in times_etched."
    pads = table.table("depth_by_pad_nm")
    by_pad = {side: pads.number(name, low, high, cure, NM) for name, side in PADS.items()}
    pads.finish()
    found = [(side, depth) for side, depth in by_pad.items() if depth is not None]
    alone = table.number("depth_nm", low, high, cure, NM)
    if alone is not None and found:
        raise table.error("depth_nm", "must not be given besides depth_by_pad_nm", "both", "Leave one of them null.")
    return tuple(found) if alone is None else ((math.inf, alone),)


def _mask(table: _Table, target_m: float, edge_move_m: float, reference: bool) -> MaskMeasured:
    x, y = _overlay(table, reference)
    cure = "0 is a missed etch, 2 a doubled one."
    times = table.number("times_etched", 0, 10, cure)
    if times is not None and times != int(times):
        raise table.error("times_etched", "must be a whole number", times, cure)
    times = None if times is None else int(times)
    measured = MaskMeasured(x, y, _edges_m(table), edge_move_m, times, _depths(table, target_m, times))
    table.finish()
    return measured


def _chrome(table: _Table, sizes_m: Sequence[float]) -> ChromeMeasured:
    x, y = _overlay(table)
    edges = _edges_m(table)
    wider = []
    for key, target in zip(OPENING_KEYS[len(sizes_m)], (size_m / UM for size_m in sizes_m), strict=True):
        cure = f"Check the unit (micrometres), and that it is the {key.split('_')[1]}."
        opening = table.number(key, 0.9 * target, 1.1 * target, cure)
        wider += [] if opening is None else [(opening - target) * UM]
    table.finish()
    if wider:
        return ChromeMeasured(x, y, sum(wider) / len(wider))
    return ChromeMeasured(x, y, None if edges is None else -2 * edges)  # growing chrome closes it from both sides


def _sheet_number(path: Path, data: Mapping[str, Any], key: str) -> float:
    value = data.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        cure = "Fill in a copy of the sheet as it was written, and change nothing but the blanks."
        raise InputError(f"{path}: {key}", "must be a number", _short(value), cure)
    return float(value)


def read_as_built(path: Path, level_map: LevelMap) -> AsBuilt:
    """Read a filled run sheet; InputError for none, one of another design, or an impossible value, named by key."""
    data = read_json(path)
    if data.get("format") != FORMAT:
        cure = "Give the filled JSON of the run sheet of this order."
        raise InputError(str(path), f'the format must be "{FORMAT}"', _short(data.get("format")), cure)
    levels, digest = level_map.levels, level_map.digest
    if data.get("level_map_sha256") != digest:
        rule = f"must be the run sheet of this design (level map {digest[:12]})"
        cure = "Give the run that the wafer was made from, or its masks."
        raise InputError(str(path), rule, _short(data.get("level_map_sha256"))[:14], cure)
    order = data.get("order")
    rows = [row for row in order if isinstance(row, Mapping)] if isinstance(order, list) else []
    moves = {str(row.get("plate")): _sheet_number(path, row, "edge_move_nm") * NM for row in rows}
    measured = _Table(path, "measured", data.get("measured"))
    names = [f"mask {bit + 1}" for bit in range(levels.bits)]
    masks = tuple(
        _mask(measured.table(name), levels.etch_depth_m(bit), moves.get(name, 0.0), name == data.get("reference"))
        for bit, name in enumerate(names)
    )
    opening = data.get("opening_um")
    sizes = opening if isinstance(opening, list) and len(opening) == 2 else [opening]
    sizes_m = [_sheet_number(path, {"opening_um": size}, "opening_um") * UM for size in sizes]
    chrome = _chrome(measured.table("chrome"), sizes_m)
    plate, notes = measured.table("plate"), measured.table("notes")
    tilt = "Give the tilt from the upright: 5 for a wall of 85 degrees."
    share = "Write 5 % as 0.05; it is a share of the light through the empty window."
    corner = plate.number("corner_radius_um", 0.0, 20.0, "Check the unit (micrometres).", UM)
    sidewall = plate.number("sidewall_deg", 0.0, 44.9, tilt)
    gratings = [plate.number(f"grating_{kind}", 0.0, 1.0, share) for kind in ("binary", "blazed")]
    said = {key: notes.text(key) for key in ("wafer", "date", "remarks")}
    for table in (plate, notes, measured):
        table.finish()
    predicted = data.get("predicted")
    return AsBuilt(
        level_map_sha256=digest,
        masks=masks,
        chrome=chrome,
        corner_radius_m=corner,
        sidewall_rad=None if sidewall is None else math.radians(sidewall),
        grating_binary=gratings[0],
        grating_blazed=gratings[1],
        notes={key: text for key, text in said.items() if text is not None},
        reference=names.index(data["reference"]) if data.get("reference") in names else None,
        predicted=predicted if isinstance(predicted, Mapping) else None,
    )
