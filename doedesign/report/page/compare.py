"""Runs side by side: what was reached, metrics with their differences, heights, PSFs, losses and specs."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from doedesign.report.page.blocks import ChartBlock, ChartSeries, PageBlock, PageContent, TableBlock, TextBlock, section
from doedesign.report.page.files import RunFiles, history_of, listed_bytes, listed_json, open_files, understood
from doedesign.report.page.gather import facts_of
from doedesign.report.page.maps import difference_block, height_block
from doedesign.report.page.numbers import label_of, length, number, rounded, value_of
from doedesign.report.page.psfs import compared_psfs, with_field
from doedesign.report.page.reached import asked_block
from doedesign.runs.folder import LEVEL_MAP
from doedesign.spec import spec_to_json
from fab.errors import InputError
from fab.level_map import read_level_map
from sim.store import read_stored_bank

_MOST = 4
_GIVEN = ("disc_radius_m", "spot_radius_m", "spot_radius_rad")  # by the camera, not by the plate
_MOST_POINTS = 1500


def compared(folders: Sequence[Path]) -> PageContent:
    """Read all that a page of several runs shows; differences are to the first.

    Args:
        folders: the run folders, two to four.

    Raises:
        InputError: too few or too many runs, or one that is damaged or was changed.
    """
    if not 2 <= len(folders) <= _MOST:
        raise InputError("compare", f"must be from 1 to {_MOST - 1} other runs", len(folders) - 1, "Give fewer.")
    runs = [open_files(folder) for folder in folders]
    names = _names(runs)
    with understood(folders[0], "results to compare"):
        metrics = [(listed_json(one.folder, "metrics.json") or {}) if one.run is not None else {} for one in runs]
        asked = [asked_block(one, values) for one, values in zip(runs, metrics, strict=True)]
        named = [
            None if block is None else replace(block, title=name) for name, block in zip(names, asked, strict=True)
        ]
        sections = [
            section("reached", "Asked and reached", named),
            section("metrics", "Metrics", [_metrics(names, metrics), _aims(names, metrics), _tolerances(names, runs)]),
            section("maps", "Heights", [*_maps(names, runs)]),
            section("light", "Light", [compared_psfs([*_banks(names, runs)])]),
            section("history", "Optimisation", [_losses(names, runs)]),
            section("specs", "Specs", [_specs(names, runs)]),
        ]
    facts = tuple((name, "; ".join(value for _, value in facts_of(one))) for name, one in zip(names, runs, strict=True))
    title = " and ".join(names)
    return PageContent(title, ("Differences are to the first.",), tuple(one for one in sections if one), facts)


def _names(runs: Sequence[RunFiles]) -> list[str]:
    """A name for every run: that of its design, where those are the same that of its folder, with the outer one."""
    places = [one.folder.resolve() for one in runs]
    own, inner, outer = (
        [one.name for one in runs],
        [p.name for p in places],
        [f"{p.parent.name}/{p.name}" for p in places],
    )
    for names in (own, inner, outer):
        if len(set(names)) == len(names):
            return names
    return [f"{one.name} ({k})" for k, one in enumerate(runs, 1)]


def _difference(name: str, values: Sequence[float | None], k: int) -> str:
    first, other = values[0], values[k]
    if first is None or other is None:
        return "–"
    sign = "+" if other >= first else "−"
    share = f" ({100 * (other / first - 1):+.1f} %)" if first else ""
    return f"{sign}{value_of(name, abs(other - first))}{share}"


def _columns(names: Sequence[str]) -> tuple[str, ...]:
    return (*names, *(f"{name} less {names[0]}" for name in names[1:]))


def _row(name: str, values: Sequence[float | None]) -> tuple[str, ...]:
    return (*(value_of(name, one) for one in values), *(_difference(name, values, k) for k in range(1, len(values))))


def _metrics(names: Sequence[str], metrics: Sequence[Mapping[str, Any]]) -> TableBlock | None:
    """Metrics by depth, means over the colours: colours of designs may differ."""
    tables = [_means(one.get("psf") or []) for one in metrics]
    keys = [key for key in dict.fromkeys(key for table in tables for key in table) if all(key in t for t in tables)]
    rows = tuple(
        (label_of(name), length(depth), *_row(name, [table[name, depth] for table in tables]))
        for name, depth in keys
        if name not in _GIVEN
    )
    head = ("metric", "depth", *_columns(names))
    return TableBlock("Metrics, means over the colours", head, rows) if rows else None


def _means(rows: Sequence[Mapping[str, Any]]) -> dict[tuple[str, float | None], float]:
    found: dict[tuple[str, float | None], list[float]] = {}
    for row in rows:
        for name, value in row.items():
            if name not in ("colour", "depth_m", "budget", "certified") and value is not None:
                found.setdefault((name, row["depth_m"]), []).append(value)
    return {key: sum(values) / len(values) for key, values in found.items()}


def _aims(names: Sequence[str], metrics: Sequence[Mapping[str, Any]]) -> TableBlock | None:
    """Numbers of spots, areas and foci that all runs have."""
    rows = []
    for table in ("orders", "area", "focus"):
        found = [one.get(table) for one in metrics]
        own = [_worst(one) if isinstance(one, list) else one for one in found]
        one_of = "colour" if table == "orders" else "area"
        which = f", worst {one_of}" if any(isinstance(one, list) for one in found) else ""
        if not all(isinstance(one, Mapping) for one in own):
            continue
        for key, value in own[0].items():  # type: ignore[union-attr]
            values = [one.get(key) for one in own]  # type: ignore[union-attr]
            if isinstance(value, float) and all(isinstance(one, float) for one in values):
                rows.append((label_of(key) + which, *_row(key, values)))
    return TableBlock("What is aimed at", ("number", *_columns(names)), tuple(rows)) if rows else None


def _worst(tables: Sequence[Mapping[str, Any]]) -> Mapping[str, float]:
    """Numbers of the worst of several areas or colours, each of its own."""
    sides = {"on_target": min, "uniformity_error": max, "contrast": max, "zeroth_order": max}
    shared = [key for key in sides if tables and all(key in one for one in tables)]
    return {key: sides[key](one[key] for one in tables) for key in shared}


def _tolerances(names: Sequence[str], runs: Sequence[RunFiles]) -> TableBlock | None:
    """Yield, and medians of plates, where all runs have a study."""
    studies = [listed_json(one.folder / "tolerance", "results.json") for one in runs]
    plates = [one["plates"] for one in studies if one is not None]
    if len(plates) < len(runs):
        return None
    medians = [{s["quantity"]: s["median"] for s in one["statistics"] if s["colour"] is None} for one in plates]
    keys = [key for key in medians[0] if all(key in one for one in medians)]
    rows = [(f"median {label_of(key)}", *_row(key, [one[key] for one in medians])) for key in keys]
    shares = [None if one["yield"] is None else one["yield"]["share"] for one in plates]
    if None not in shares:
        rows.insert(0, ("yield", *_row("on_target", shares)))
    counts = ", ".join(f"{name}: {one['count']}" for name, one in zip(names, plates, strict=True))
    return TableBlock("As fabricated", ("number", *_columns(names)), tuple(rows), f"Plates of each study: {counts}.")


def _maps(names: Sequence[str], runs: Sequence[RunFiles]) -> Iterator[PageBlock]:
    """Heights of all runs that are finished, and differences of rasters of the same size."""
    there = [(name, read_level_map(one.run.path(LEVEL_MAP))) for name, one in zip(names, runs, strict=True) if one.run]
    for name, level_map in there:
        yield height_block(name, level_map)
    for name, level_map in there[1:]:
        first = there[0][1]
        if (level_map.shape, level_map.grid.pitch_m) == (first.shape, first.grid.pitch_m):
            yield difference_block(f"{name} less {there[0][0]}", first, level_map)
        else:
            yield TextBlock((f"{name} and {there[0][0]} have different rasters, so no difference is drawn.",))


def _banks(names: Sequence[str], runs: Sequence[RunFiles]) -> Iterator[tuple[str, Any]]:
    for name, one in zip(names, runs, strict=True):
        if listed_bytes(one.folder / "psf", "quantised.exr") is not None:
            bank = read_stored_bank(one.folder / "psf" / "quantised.exr")
            yield with_field(name, bank), bank


def _losses(names: Sequence[str], runs: Sequence[RunFiles]) -> ChartBlock | None:
    """Losses over the steps, which are comparable where objectives are the same."""
    histories = [history_of(one) for one in runs]
    longest = max(map(len, histories))
    if not longest:
        return None
    kept = range(0, longest, -(-longest // _MOST_POINTS))
    series = tuple(
        ChartSeries(name, tuple(rounded(history[k]["loss"]) if k < len(history) else None for k in kept))
        for name, history in zip(names, histories, strict=True)
    )
    note = "Losses are of one kind only where the objectives and their weights are the same."
    return ChartBlock("Loss", "step", "loss", tuple(float(k + 1) for k in kept), series, note=note)


def _specs(names: Sequence[str], runs: Sequence[RunFiles]) -> TableBlock:
    """Keys of the specs that differ, as they stand there in SI units."""
    flat = [dict(_flat(spec_to_json(one.spec), "")) for one in runs]
    keys = sorted({key for one in flat for key in one})
    differing = [key for key in keys if len({repr(one.get(key)) for one in flat}) > 1]
    rows = tuple((key, *(number(one.get(key), 6) for one in flat)) for key in differing)
    return TableBlock("Keys of the specs that differ", ("key", *names), rows, "SI units.")


def _flat(value: Any, key: str) -> Iterator[tuple[str, Any]]:
    inner = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else None
    if inner is None:
        yield key, value
    else:
        for name, part in inner:
            yield from _flat(part, f"{key}.{name}".removeprefix("."))
