"""The run sheet: the work of the cleanroom on one wafer, with blanks for measurements.

The same sheet comes as a page to print and write on, and as JSON. What was written on paper goes into the JSON under
"measured", and `fab.runsheet.as_built` reads it back; null stands for what was not measured.
"""

import base64
from collections.abc import Iterator, Mapping
from math import degrees, hypot
from types import MappingProxyType
from typing import Any, NamedTuple

from fab.layout.marks import BOXES, VERNIER_STEP_M
from fab.layout.part import Photomask
from fab.layout.structures import BAR_WIDTHS_UM, PAD_SIDES_UM
from fab.process import Normal
from fab.runsheet.page import html_page
from fab.runsheet.recipe import (
    RATES_M_PER_S,
    Action,
    Step,
    depths_m,
    expected_m,
    next_target_m,
    spread_of,
    steps_of,
    tone_words,
)
from fab.runsheet.tables import OPENING_KEYS, SILICA, Predictions, RunSheet
from fab.units import MM, NM, UM

FORMAT = "doedesign run sheet 1"

# The blanks of every mask: CD bars and depth pads by name, with their drawn width in metres.
BARS: Mapping[str, float] = {f"{w:g} um {kind}": w * UM for w in BAR_WIDTHS_UM for kind in ("line", "gap")}
PADS: Mapping[str, float] = {f"{side:g} um": side * UM for side in PAD_SIDES_UM}

# The pad whose depth is compared over the wafer: wide enough for a stylus, and in all monitors.
_COMPARED = "100 um"

_TWO_SIGMA = 2.0
_NONE: dict[str, str | None] = dict.fromkeys(("wafer", "marks", "psfs"))
_NO_PICTURES: Mapping[str, bytes] = MappingProxyType({})
_MISSES_NM = (-10.0, -5.0, 5.0, 10.0)


def _nm(length_m: float) -> float:
    return round(length_m / NM, 6)


def _um(length_m: float) -> float:
    return round(length_m / UM, 6)


def _mm(place_m: tuple[float, float]) -> dict[str, float]:
    return {"x_mm": round(place_m[0] / MM, 6), "y_mm": round(place_m[1] / MM, 6)}


def _named(sheet: RunSheet, what: str, photomask: Photomask) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield the places of a photomask whose own name begins with `what`: where ("" if not said), and coordinates."""
    ending = f", {photomask.name}"
    for name, place in sheet.places.items():
        where, _, own = name.rpartition(": ")
        if own.startswith(what) and own.endswith(ending):
            yield where, _mm(place)


def _nearest_place(sheet: RunSheet, what: str, photomask: Photomask) -> dict[str, Any]:
    """Where to measure: nearest to the DOE that is predicted, whose errors the measurements will be taken for."""
    y, x = (at / MM for at in sheet.process.die_m)
    places = list(_named(sheet, f"{what}, ", photomask))
    if not places:
        return {"where": "", "x_mm": None, "y_mm": None}
    where, place = min(places, key=lambda named: hypot(named[1]["x_mm"] - x, named[1]["y_mm"] - y))
    return {"where": where, **place}


def _width_rows(sheet: RunSheet, photomask: Photomask) -> list[dict[str, Any]]:
    """List the CD bars of a photomask: drawn width, the width at which the DOE comes out as designed, and tolerance."""
    move_m = sheet.files[photomask.name].edge_move_m
    sigma = Normal().sigma
    if photomask.bit is not None:
        sigma = spread_of(sheet.process, photomask.bit, "common_cd_bias_m", "cd_bias_m").sigma
    rows = []
    for name, drawn_m in BARS.items():
        outward = 1 if name.endswith("line") else -1
        smallest = sheet.process.minimum_line_m if outward > 0 else sheet.process.minimum_space_m
        rows.append(
            {
                "bar": name,
                "drawn_um": _um(drawn_m),
                "target_um": _um(drawn_m - 2 * outward * move_m),
                # Both edges of a bar move.
                "tolerance_um": round(2 * _TWO_SIGMA * sigma / UM, 3) or None,
                "below_process": bool(drawn_m < smallest * (1 - 1e-9)),
                **_nearest_place(sheet, f"CD {name}", photomask),
            }
        )
    return rows


def _depth_rows(sheet: RunSheet, photomask: Photomask) -> list[dict[str, Any]]:
    lag, aim_m = sheet.process.spreads.get("etch_lag", Normal()).mean, expected_m(photomask, sheet.process)
    return [
        {
            "pad": name,
            "target_nm": _nm(photomask.depth_m),
            # A pad loses the share lag x depth / width of its depth.
            "expected_nm": round(aim_m * (1 - lag * aim_m / side_m) / NM, 2),
            **_nearest_place(sheet, f"depth pad {name}", photomask),
        }
        for name, side_m in PADS.items()
    ]


def _uniformity_rows(sheet: RunSheet, photomask: Photomask) -> list[dict[str, Any]]:
    """List the places of one pad of a photomask in every process monitor, for the depth over the wafer."""
    places = _named(sheet, f"depth pad {_COMPARED}, ", photomask)
    return [{"pad": _COMPARED, "where": where, **place} for where, place in places]


def _inspected(sheet: RunSheet) -> list[dict[str, Any]]:
    """List the first place of every staircase and grating."""
    found: dict[str, dict[str, Any]] = {}
    for name, place in sheet.places.items():
        where, _, own = name.rpartition(": ")
        if own.startswith(("staircase", "grating")) and own not in found:
            found[own] = {"what": own, "where": where, **_mm(place)}
    return list(found.values())


def _marks(sheet: RunSheet, photomask: Photomask, key: str, *kinds: str, prefix: str = "") -> list[dict[str, Any]]:
    """List where the marks of a photomask are, except for the first one, to which all others are aligned."""
    found = (
        (kind, _named(sheet, f"{prefix}{kind}, ", photomask)) for kind in kinds if photomask is not sheet.photomasks[0]
    )
    return [{key: kind, "where": where, **place} for kind, places in found for where, place in places]


def _etch_record(sheet: RunSheet, step: Step, later: tuple[Photomask, ...]) -> dict[str, Any]:
    """Describe the depth of one etch: times, pads, and what to do if it is off."""
    photomask = step.photomask
    # The sum of all depths is the full one only where the deepest floor is made by all masks.
    following = later[0] if later and sheet.level_map.levels.is_full else None
    corrections, aim_m = [], expected_m(photomask, sheet.process)
    if following:
        next_m = expected_m(following, sheet.process)
        told = following.depth_m / next_m  # what the process is told, over what it etches
        corrections = [
            {"off_by_nm": miss, "next_target_nm": _nm(told * next_target_m(aim_m, aim_m + miss * NM, next_m))}
            for miss in _MISSES_NM
        ]
    return {
        "target_nm": _nm(photomask.depth_m),
        "expected_nm": _nm(aim_m),
        "deepest_floor_nm": _nm(step.deepest_m),
        "time_formula": "time = target / rate",
        "times": [
            {"rate_nm_per_min": round(rate * 60 / NM, 6), "time_s": round(photomask.depth_m / rate)}
            for rate in RATES_M_PER_S
            if sheet.material == SILICA
        ],
        "pads": _depth_rows(sheet, photomask),
        "over_the_wafer": _uniformity_rows(sheet, photomask),
        "next": following.name if following else None,
        "corrections": corrections,
    }


def _actions(actions: tuple[Action, ...]) -> list[dict[str, Any]]:
    return [{"task": one.task, "how": one.how, "fill": list(one.fill)} for one in actions]


def _step_record(sheet: RunSheet, number: int, step: Step) -> dict[str, Any]:
    photomask = step.photomask
    later = tuple(other for other in sheet.photomasks[number:] if other.bit is not None)
    titles = {"etch": f"etch {photomask.depth}", "zero layer": "chrome marks", "liftoff": "the aperture, by lift-off"}
    structures = photomask.makes != "zero layer"
    overlay = spread_of(sheet.process, photomask.bit, "", "overlay_x_m") if photomask.bit is not None else Normal()
    return {
        "number": number,
        "plate": photomask.name,
        "code": photomask.code,
        "title": f"{photomask.name.capitalize()}: {titles.get(photomask.makes, 'the aperture, by wet etch')}",
        "makes": photomask.makes,
        "file": sheet.files[photomask.name].file,
        "before": _actions(step.before),
        "after": _actions(step.after),
        "marks": _marks(sheet, photomask, "mark", "finder", *(f"box {mark.gap_um:g} um" for mark in BOXES)),
        "widths": _width_rows(sheet, photomask) if structures else [],
        "overlay": _marks(sheet, photomask, "axis", "x", "y", prefix="vernier "),
        "overlay_tolerance_um": round(_TWO_SIGMA * overlay.sigma / UM, 3) or None,
        "etch": _etch_record(sheet, step, later) if photomask.makes == "etch" else None,
    }


def _order_record(sheet: RunSheet) -> list[dict[str, Any]]:
    return [
        {
            "plate": photomask.name,
            "code": photomask.code,
            "file": sheet.files[photomask.name].file,
            "sha256": sheet.files[photomask.name].sha256,
            "cell": sheet.files[photomask.name].cell,
            "layer": f"{photomask.layer}/0",
            "bit": photomask.bit,
            "depth_nm": _nm(photomask.depth_m) if photomask.bit is not None else None,
            "polygons_mean": "chrome here" if photomask.bit is None else "etched here",
            "tone": tone_words(photomask),
            "reading": sheet.wafer.reading,
            "edge_move_nm": _nm(sheet.files[photomask.name].edge_move_m),
        }
        for photomask in sheet.photomasks
    ]


def _row(values: NamedTuple) -> dict[str, Any]:
    """Write a row with six digits: more of them are not the same on every machine."""
    row = values._asdict()
    return {key: float(f"{value:.6g}") if isinstance(value, float) else value for key, value in row.items()}


def _predicted_record(predictions: Predictions) -> dict[str, Any]:
    full, index = predictions.full_wave_m, predictions.index
    wave_m = predictions.design_m / (index - 1) if index else 0.0
    return {
        "as_drawn": [_row(seen) for seen in predictions.drawn],
        "expected": [_row(seen) for seen in predictions.expected],
        "design_wavelength_nm": _nm(predictions.design_m),
        **({"index": round(index, 5), "wave_height_nm": round(wave_m / NM, 2)} if index else {}),
        "full_wave_wavelength_nm": None if full is None else round(full / NM, 1),
        "probe_wavelength_nm": _nm(predictions.probe_m),
        "waves_at_probe": round(predictions.probe_waves, 5),
        "gratings": [_row(grating) for grating in predictions.gratings],
        "matters": [_row(one) for one in predictions.ranking],
        **({"certified": [_row(one) for one in predictions.certified]} if predictions.certified else {}),
    }


def _blanks(sheet: RunSheet) -> dict[str, Any]:
    """Return everything that may be measured, unfilled; `fab.runsheet.as_built` says what each key means."""
    overlay = {"overlay_x_um": None, "overlay_y_um": None}
    widths = {"cd_bias_um": None, "cd_um": dict.fromkeys(BARS)}
    mask = {**overlay, **widths, "times_etched": None, "depth_nm": None, "depth_by_pad_nm": dict.fromkeys(PADS)}
    chrome = {**overlay, **widths, **dict.fromkeys(OPENING_KEYS[len(sheet.opening.sizes_m)])}
    etched = [photomask for photomask in sheet.photomasks if photomask.bit is not None]
    named = {photomask.name: dict(mask) for photomask in sorted(etched, key=lambda photomask: photomask.layer)}
    for key in overlay if sheet.photomasks[0].bit is not None else ():
        del named[sheet.photomasks[0].name][key]  # its marks are what the others are measured against
    if any(photomask.name == "chrome" for photomask in sheet.photomasks):
        named["chrome"] = chrome
    corners = {"corner_radius_um": None, "sidewall_deg": None}
    light = {"grating_binary": None, "grating_blazed": None}
    return {**named, "plate": {**corners, **light}, "notes": {"wafer": None, "date": None, "remarks": None}}


def record(sheet: RunSheet) -> dict[str, Any]:
    """Return the run sheet as JSON values, the unit of every length in its key, all under "measured" null."""
    process, wafer = sheet.process, sheet.wafer
    wall = process.spreads.get("sidewall_rad", Normal())
    by_bit = {photomask.bit: expected_m(photomask, process) for photomask in sheet.photomasks}
    expected = [by_bit[bit] for bit in range(sheet.level_map.levels.bits)]
    return {
        "format": FORMAT,
        "job": sheet.stem,
        "level_map_sha256": sheet.level_map.digest,
        "request_sha256": sheet.request_sha256,
        "levels": sheet.level_map.levels.count,
        "aperture_mm": sheet.level_map.relief.sizes(MM, 9),
        "opening_um": sheet.opening.sizes(UM, 6),
        "process": {
            "name": process.name,
            "order": [f"mask {bit + 1}" for bit in process.order],
            "minimum_line_um": _um(process.minimum_line_m),
            "minimum_space_um": _um(process.minimum_space_m),
            "usual_wall_tilt_deg": round(degrees(wall.mean), 3) or None,
        },
        "order": _order_record(sheet),
        "wafer": {
            "material": sheet.material,
            "recipe_for": SILICA,
            "diameter_mm": round(wafer.diameter_m / MM, 6),
            "thickness_mm": round(wafer.thickness_m / MM, 6),
            "finish": "both faces polished",
            "mask_blank_mm": round(wafer.blank_m / MM, 6),
            "edge_exclusion_mm": round(wafer.edge_exclusion_m / MM, 6),
            "flat_mm": round(wafer.usual_flat_m / MM, 6) or None,
            "notch_mm": round(wafer.notch_m / MM, 6) or None,
            "saw_lane_mm": round(wafer.lane_m / MM, 6),
        },
        "dies": [{"name": die.name, **_mm((die.x_m, die.y_m)), "note": die.note} for die in sheet.dies],
        "chrome": {"thickness_nm": _nm(sheet.chrome_m), "deposition": sheet.deposition},
        "vernier_step_um": _um(VERNIER_STEP_M),
        "reference": sheet.photomasks[0].name,
        "steps": [_step_record(sheet, number, step) for number, step in enumerate(steps_of(sheet), start=1)],
        "staircase_nm": [_nm(depth) for depth in depths_m(sheet.level_map.levels, expected)],
        "inspected": _inspected(sheet),
        "places_mm": {name: [*_mm(place).values()] for name, place in sheet.places.items()},
        "predicted": None if sheet.predictions is None else _predicted_record(sheet.predictions),
        "measured": _blanks(sheet),
    }


def run_sheet_page(content: Mapping[str, Any], json_name: str, pictures: Mapping[str, bytes] = _NO_PICTURES) -> bytes:
    """Return what `record` returned as one page of HTML that needs nothing else, for A4 and for the screen.

    The page tells the reader to fill in the JSON file. `pictures` are PNGs of the "wafer", of the "marks" and of the
    "psfs" that the camera should show; each may be left out.
    """
    sources = {name: "data:image/png;base64," + base64.b64encode(png).decode() for name, png in pictures.items()}
    return html_page("runsheet.html", sheet=content, json_name=json_name, pictures=_NONE | sources)
