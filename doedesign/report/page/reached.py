"""Bars of all that was asked of a design and reached, the 0th order on its way to the wafer, and the yield."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from doedesign.overview.numbers import zeroth_note
from doedesign.report.history import history_note
from doedesign.report.page.blocks import Bar, BarBlock, PageSection, TableBlock, section
from doedesign.report.page.files import RunFiles, digest_of, listed_json
from doedesign.report.page.numbers import SHARES, label_of, length, number, percent, value_of
from doedesign.spec.process import leading_quantity

Rows = Sequence[Mapping[str, Any]]

# Limits that may be asked for, by the number that plates are told by.
_SUCH_AS = {"uniformity_error": "uniformity_error <= 10 %", "on_target": "on_target >= 80 %", "strehl": "strehl >= 0.6"}
_WIDEST = 4.0  # width of a focus, over that wanted, up to which it is known (`doedesign.focus.depth`)


def reached_section(files: RunFiles, metrics: Mapping[str, Any], history: Rows) -> PageSection | None:
    """The first part of a page.

    Args:
        files: the run.
        metrics: its `metrics.json`; empty while it works.
        history: records of its steps.
    """
    tolerance = listed_json(files.folder / "tolerance", "results.json")
    blocks = [asked_block(files, metrics), _orders_zeroth(files, metrics, tolerance), *_yield(tolerance)]
    return section("reached", "Asked and reached", [*blocks, _terms(files, history)])


def _bar(label: str, values: Sequence[float | None], name: str, **more: Any) -> Bar | None:
    """A bar of the mean of some values, with their range where they differ."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    mean = sum(known) / len(known)
    low, high = min(known), max(known)
    spread = f" ({value_of(name, low)} to {value_of(name, high)})" if high > low else ""
    mark = more.get("mark")
    end = more.pop("end", None) or (1.0 if name in SHARES else 1.15 * max(high, mark or 0.0, 1e-12))
    ends: dict[str, Any] = {"low": low, "high": high} if high > low else {}
    return Bar(label, mean, f"{value_of(name, mean)}{spread}", end, **ends, **more)


def asked_block(files: RunFiles, metrics: Mapping[str, Any]) -> BarBlock | None:
    """Bars of all that the spec asks for, with ceilings, bounds and limits drawn in.

    Args:
        files: the run.
        metrics: its `metrics.json`.
    """
    bars = [bar for bar in (*_aims(metrics), *_plates(files, metrics)) if bar is not None]
    note = "A line in a bar is what light allows, or what was asked for; a thin line under it spans colours and depths."
    return BarBlock("Asked and reached", tuple(bars), note) if bars else None


def _aims(metrics: Mapping[str, Any]) -> Iterator[Bar | None]:
    """Bars of spots, areas, foci and patterns."""
    tables = metrics.get("orders") or []
    for orders in [tables] if isinstance(tables, Mapping) else tables:
        where = f", {orders['colour']}" if "colour" in orders else ""
        ceiling = orders.get("ceiling")
        known: dict[str, Any] = {} if ceiling is None else {"mark": ceiling, "mark_text": f"ceiling {percent(ceiling)}"}
        yield _bar(f"light on the spots{where}", [orders["on_target"]], "on_target", **known)
        most = max(0.05, 1.2 * orders["uniformity_error"])
        yield _bar(f"uniformity error{where}", [orders["uniformity_error"]], "uniformity_error", end=most)
        if orders.get("strongest_stray") is not None:
            each = orders["on_target"] / max(len(orders["spots"]), 1)
            given: dict[str, Any] = {"mark": each, "mark_text": f"mean spot {percent(each)}"}
            end = 1.2 * max(each, orders["strongest_stray"])
            yield _bar(f"strongest stray order{where}", [orders["strongest_stray"]], "on_target", end=end, **given)
    areas = metrics.get("area") or []
    for area in [areas] if isinstance(areas, Mapping) else areas:
        where = "" if "distance_m" not in area else f", {area['colour']}, {length(area['distance_m'])}"
        yield _bar(f"light on the area{where}", [area["on_target"]], "on_target")
        yield _bar(f"contrast of the area{where}", [area["contrast"]], "contrast")
    if focus := metrics.get("focus"):
        yield _focus_widths(focus["foci"])
        yield _bar("Strehl ratio on the axis", [one["strength"] for one in focus["foci"]], "strehl", end=1.0)
        yield _bar("light in the foci", [one["share"] for one in focus["foci"]], "on_target")
    for pattern in metrics.get("patterns") or []:
        where = f", {pattern['colour']}" if "colour" in pattern else ""
        yield _bar(f"light on the pattern{where}", [pattern["on_target"]], "on_target")
        yield _bar(f"uniformity of the pattern{where}", [pattern["uniformity"]], "strehl", end=1.0)


def _focus_widths(foci: Rows) -> Bar | None:
    """The bar of how wide foci are over what is wanted; those that have no width count as the widest that has one."""
    sides = [(one["width_x_m"], one["width_y_m"], one["width_wanted_m"]) for one in foci]
    widths = [None if x is None or y is None else max(x, y) / wanted for x, y, wanted in sides]
    filled = [_WIDEST if width is None else width for width in widths]
    label, name, end = "width of the foci over that wanted", "focus_width", 1.15 * max([1.0, *filled])
    bar, others = _bar(label, filled, name, end=end, mark=1.0, mark_text="wanted 100 %"), _bar(label, widths, name)
    if bar is None or None not in widths:
        return bar
    text = f"{widths.count(None)} of {len(foci)} beyond {100 * _WIDEST:g} %"
    return bar._replace(text=f"{text}, others {others.text}" if others else text, state="missed")


def _plates(files: RunFiles, metrics: Mapping[str, Any]) -> Iterator[Bar | None]:
    """Bars of plates to see through: their far spot, spread near by, and light in the window."""
    rows: Rows = metrics.get("psf") or []
    options = {one.name: one.options for one in files.spec.objectives}
    if not files.spec.objectives:
        return
    asked = options.get("spot_energy", {}).get("energy")
    given: dict[str, Any] = {"mark": asked, "mark_text": f"asked {percent(asked)}"} if _is_number(asked) else {}
    yield _bar("light in the far spot", [row.get("far_spot") for row in rows], "far_spot", **given)
    near = [row for row in rows if row.get("concentration") is not None]
    bounds = [row["concentration_bound"] for row in near if row.get("concentration_bound") is not None]
    if near:
        bound = sum(bounds) / len(bounds) if bounds else None
        given = {} if bound is None else {"mark": bound, "mark_text": f"bound {number(bound)} (less is spread wider)"}
        yield _bar("concentration of near light", [row["concentration"] for row in near], "concentration", **given)
        ratios = [row.get("ring_to_disc") for row in near]
        given = _at_least(options.get("ring_to_disc", {}).get("least"), ratios, number)
        yield _bar("ring:disc of near light", ratios, "ring_to_disc", **given)
    shares = [row.get("throughput") for row in rows]
    given = _at_least(options.get("window_share", {}).get("least"), shares, percent)
    yield _bar("throughput, light in the window", shares, "throughput", **given)


def _at_least(least: Any, values: Sequence[Any], words: Callable[[float], str]) -> dict[str, Any]:
    """The mark of a bar whose values an objective keeps from below, and whether all reach it."""
    if not _is_number(least):
        return {}
    met = all(value is None or value >= least for value in values)
    return {"mark": least, "mark_text": f"at least {words(least)}", "state": "met" if met else "missed"}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _orders_zeroth(files: RunFiles, metrics: Mapping[str, Any], tolerance: Mapping[str, Any] | None) -> BarBlock | None:
    """The 0th order as drawn, with edges, and as fabricated."""
    rows: Rows = metrics.get("psf") or []
    drawn = [row.get("zeroth_order") for row in rows]
    certified = ()
    if files.run is not None and (files.folder / "certificate").is_dir():
        from doedesign.runs.verdict import certified_orders  # slow to import

        certified = certified_orders(files.folder, digest_of(files.run))
    bars = [_bar("as drawn, a thin element", drawn, "zeroth_order", end=1.0)]
    if certified:
        edges = [one.edges for one in certified]
        bars.append(_bar("as drawn, with the light of its edges", edges, "zeroth_order", end=1.0))
    plates = {} if tolerance is None else tolerance["plates"]
    for one in plates.get("statistics", []):
        if one["quantity"] == "zeroth_order" and one["colour"] is None:
            text = f"median {percent(one['median'])} ({percent(one['p05'])} to {percent(one['p95'])} in 90 % of plates)"
            label = f"as fabricated, {plates['count']} plates, their worst colour"
            bars.append(Bar(label, one["median"], text, 1.0, one["p05"], one["p95"]))
    made = listed_json(files.folder / "fabricated", "metrics.json")
    if made is not None:
        values = [row.get("zeroth_order") for row in made["fabricated"]]
        bars.append(_bar("as fabricated, one plate", values, "zeroth_order", end=1.0))
    built = listed_json(files.folder / "as-built", "as-built.json")
    if built is not None:
        values = [row["as_built"] for row in built["comparison"] if row["quantity"] == "zeroth_order"]
        bars.append(_bar("as built, from measurements", values, "zeroth_order", end=1.0))
    there = [bar for bar in bars if bar is not None]
    if not there:
        return None
    end = min(1.0, 1.25 * max(max(bar.value, bar.high or 0.0) for bar in there)) or 1.0
    note = "The share of the light that passes as if the plate were flat, over the colours."
    wanted = zeroth_note(metrics)
    return BarBlock(
        f"0th order ({wanted})" if wanted else "0th order",
        tuple(bar._replace(end=end) for bar in there),
        note,
    )


def _yield(tolerance: Mapping[str, Any] | None) -> Iterator[BarBlock | None]:
    """Yield, limit by limit, and the sources of the most broken one."""
    if tolerance is None:
        return
    plates = tolerance["plates"]
    found = plates["yield"]
    shares = tolerance.get("shares") or {}
    quantity = leading_quantity(shares or ["strehl"])
    if found is not None:
        wanted = tolerance["plan"]["wanted"]
        bars = [_share_bar("plates that obey every limit", found, wanted)]
        bars += [_share_bar(one["limit"], one) for one in found["limits"]]
        note = f"{plates['count']} plates drawn from the process; the thin line is the 95 % interval."
        yield BarBlock("Yield", tuple(bars), note)
        worst = min(found["limits"], key=lambda one: one["share"], default=None)
        quantity = quantity if worst is None else worst["limit"].split(" ")[0]
    by_source = shares.get(quantity) or next(iter(shares.values()), None)
    if by_source:
        name = quantity if quantity in shares else next(iter(shares))
        ordered = sorted(by_source.items(), key=lambda one: (-one[1], one[0]))
        bars = [Bar(source, value, percent(value), 1.0) for source, value in ordered if value >= 5e-4]
        note = f"Share of each source of error in the variance of the {label_of(name)} over all plates."
        if found is None:
            limit = _SUCH_AS.get(name, "zeroth_order <= 5 %")
            note += f' No limits were given, so there is no yield: ask with limits such as "{limit}".'
        yield BarBlock("What limits it", tuple(bars), note)


def _share_bar(label: str, one: Mapping[str, Any], wanted: float | None = None) -> Bar:
    text = f"{percent(one['share'])} ({percent(one['low'])} to {percent(one['high'])})"
    if wanted is None:
        return Bar(label, one["share"], text, 1.0, one["low"], one["high"])
    state = "met" if one["share"] >= wanted else "missed"
    mark = f"wanted {percent(wanted)}"
    return Bar(label, one["share"], text, 1.0, one["low"], one["high"], wanted, mark, state)


def _terms(files: RunFiles, history: Rows) -> TableBlock | None:
    """Terms of the loss: weight and value at the first and the last step."""
    if not history or not files.spec.objectives:
        return None
    first, last = history[0], history[-1]
    weights = [one.weight for one in files.spec.objectives]
    if len(weights) != len(last.get("terms", [])):
        return None
    rows = tuple(
        (name, f"{weight:g}", number(begun), number(ended))
        for name, weight, begun, ended in zip(last["names"], weights, first["terms"], last["terms"], strict=True)
    )
    rows += (("loss", "", number(first["loss"]), number(last["loss"])),)
    head = ("objective", "weight", f"step {first['step'] + 1}", f"step {last['step'] + 1}")
    note = f"Values without weights. {history_note(files.spec)}".rstrip()
    return TableBlock("Objectives", head, rows, note, folded=True)
