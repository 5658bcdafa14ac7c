"""Light of a run: PSFs to look through, orders, metrics through depths, energy and error budget, certificate."""

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from doedesign.report.page.blocks import (
    ChartBlock,
    ChartSeries,
    PageBlock,
    PageSection,
    PictureBlock,
    TableBlock,
    TextBlock,
    section,
)
from doedesign.report.page.files import RunFiles, listed_csv, listed_json, listed_picture
from doedesign.report.page.numbers import label_of, length, percent, rounded, value_of
from doedesign.report.page.psfs import banks_of, psf_block
from fab.figure import evenly_spaced

Rows = Sequence[Mapping[str, Any]]

_MOST_DEPTHS = 3  # of which curves are shown
_OVER = {
    "frequency_per_mm": "frequency along x (cycles/mm)",
    "frequency_per_deg": "frequency along x (cycles/degree)",
    "radius_um": "radius (µm)",
    "radius_deg": "radius (°)",
}
_BUDGET = {
    "far_spot": "far spot",
    "window_beside_spot": "rest of the window",
    "uncollected": "beside the window",
    "higher_orders": "higher orders of the pixel raster",
    "reflected": "reflected by the faces",
    "blocked": "blocked",
}


def light_section(files: RunFiles, metrics: Mapping[str, Any]) -> PageSection | None:
    """PSFs and everything that is computed from them.

    Args:
        files: the run.
        metrics: its `metrics.json`.
    """
    blocks: list[PageBlock | None] = [psf_block(banks_of(files))]
    if blocks[0] is None:
        picture = listed_picture(files.folder, "psf.png", photo=True)
        if picture is not None:
            command = shlex.join(["doedesign", "psf", f"runs/{files.folder.name}"])
            note = f"To look through depths and colours: {command}, and this report again."
            blocks.append(PictureBlock("PSFs", "PSFs by depth and colour", picture, note, ink=False))
    blocks += [*_orders(files, metrics), *_curves(files), *_through_focus(metrics)]
    return section("light", "Light", [*blocks, *_tables(metrics)])


def budget_section(files: RunFiles, metrics: Mapping[str, Any]) -> PageSection | None:
    """Where the light goes, how far the numbers can be relied on, and the certificate.

    Args:
        files: the run.
        metrics: its `metrics.json`.
    """
    return section("budget", "Energy and errors", [_energy(metrics), _accuracy(metrics), *_certificate(files),
                                                         *_fabricated(files)])  # fmt: skip


def _orders(files: RunFiles, metrics: Mapping[str, Any]) -> Iterator[PageBlock | None]:
    """Tables and pictures of spots, areas and foci."""
    for name, title in (("orders", "Spots and orders"), ("area", "Area of light"), ("focus", "Foci")):
        rows = listed_csv(files.folder, f"{name}.csv")
        if rows is None:
            continue
        picture = listed_picture(files.folder, f"{name}.png")
        if picture is not None:
            yield PictureBlock(title, f"{title} of the design", picture, _source(metrics.get(name)))
        if name == "area":
            yield _profiles(rows)
        elif rows:
            head = tuple(label_of(key) for key in rows[0])
            body = tuple(tuple(_cell(value) for value in row.values()) for row in rows)
            yield TableBlock(f"{title}, table", head, body, folded=len(rows) > 30)
    for number_of in range(1, 10):
        name = "pattern.png" if number_of == 1 else f"pattern_{number_of}.png"
        picture = listed_picture(files.folder, name)
        if picture is not None:
            yield PictureBlock(f"Pattern {number_of}", "Light of a pattern beside its target", picture)


def _source(record: Any) -> str:
    words = record.get("ceiling_source") if isinstance(record, Mapping) else None
    return f"Ceiling: {words}." if words else ""


def _cell(text: str | None) -> str:
    try:
        return f"{float(text or ''):.6g}"
    except ValueError:
        return text or ""


def _profiles(rows: Sequence[Mapping[str, str]]) -> ChartBlock | None:
    """Light of an area along x, over the place."""
    key = next((key for key in (rows[0] if rows else {}) if key.startswith("place_")), None)
    along = [row for row in rows if row.get("axis") == "x" and row.get("area", "1") == "1"]
    if key is None or not along:
        return None
    lines = [ChartSeries(name, tuple(rounded(float(row[name])) for row in along), name == "wanted")
             for name in ("light", "wanted")]  # fmt: skip
    places = tuple(float(row[key]) for row in along)
    return ChartBlock("Profile along x", f"place ({key[6:]})", "light", places, tuple(lines))


def _curves(files: RunFiles) -> Iterator[PageBlock]:
    """MTF and encircled energy: of runs that have them as numbers a chart per depth, of others the picture."""
    for name, title, note in (
        ("mtf", "MTF", "Modulation along x that plate, lens and pixel pass, by spatial frequency."),
        ("encircled", "Encircled energy", "Share of the light within a radius."),
    ):
        rows, picture = listed_csv(files.folder, f"{name}.csv"), listed_picture(files.folder, f"{name}.png")
        if rows:
            yield from _curves_of(rows, title, note, max(files.spec.scene.near_m, default=0.0))
        elif picture is not None:
            yield PictureBlock(title, f"{title} by depth and colour", picture, note)


def _curves_of(rows: Sequence[Mapping[str, str]], title: str, note: str, near_m: float) -> Iterator[ChartBlock]:
    """A chart per depth of a table of curves, at most three; a colour has a hue. Light up to `near_m` is near."""
    over = next(key for key in rows[0] if key.startswith(("frequency_", "radius_")))
    colours = list(dict.fromkeys(row["colour"] for row in rows))
    depths = list(dict.fromkeys(row["depth_m"] for row in rows))
    for depth in (depths[k] for k in evenly_spaced(len(depths), _MOST_DEPTHS)):
        of_depth = {c: [row for row in rows if (row["depth_m"], row["colour"]) == (depth, c)] for c in colours}
        places = tuple(float(row[over]) for row in of_depth[colours[0]])
        # Near light is meant to be blurred, so its contrast dies at low frequencies.
        x_log = over.startswith("radius_") or float(depth) <= near_m
        first = 1 if x_log and places[0] <= 0 else 0
        lines = [
            ChartSeries(label, tuple(rounded(float(row[key])) for row in one[first:]), key == "without", hue)
            for key, ending in (("design", ""), ("without", ", without plate"))
            for hue, (label, one) in enumerate((f"{c}{ending}", one) for c, one in of_depth.items())
        ]
        where = f"{title}, source at {length(math.inf if depth == 'inf' else float(depth))}"
        yield ChartBlock(where, _OVER[over], title, places[first:], tuple(lines), x_log=x_log, note=note)


def _depths(rows: Rows) -> list[float | None]:
    return sorted({row["depth_m"] for row in rows}, key=lambda depth: math.inf if depth is None else depth)


def _through_focus(metrics: Mapping[str, Any]) -> Iterator[ChartBlock]:
    """Metrics over the depth of the source, a line per colour; at least two finite depths."""
    focus = metrics.get("focus")
    if focus:
        foci = focus["foci"]
        colours = list(dict.fromkeys(one["colour"] for one in foci))
        places = tuple(sorted({one["distance_m"] for one in foci}))
        for key, title in (("strength", "Strehl ratio on the axis"), ("share", "light in the focus")):
            found = {(one["colour"], one["distance_m"]): one[key] for one in foci}
            lines = tuple(ChartSeries(c, tuple(rounded(found.get((c, at))) for at in places)) for c in colours)
            millimetres = tuple(rounded(1e3 * at) or 0.0 for at in places)
            yield ChartBlock(f"Through focus: {title}", "distance (mm)", title, millimetres, lines, markers=True)
    rows: Rows = metrics.get("psf") or []
    depths = [depth for depth in _depths(rows) if depth is not None]
    colours = list(dict.fromkeys(row["colour"] for row in rows))
    for name in ("throughput", "ring_to_disc", "concentration", "far_spot"):
        found = {(row["colour"], row["depth_m"]): row.get(name) for row in rows}
        there = [depth for depth in depths if any(found.get((c, depth)) is not None for c in colours)]
        if len(there) < 2:
            continue
        lines = [ChartSeries(c, tuple(rounded(found.get((c, depth))) for depth in there)) for c in colours]
        if name == "concentration":
            bound = [[row["concentration_bound"] for row in rows if row["depth_m"] == depth] for depth in there]
            means = tuple(rounded(sum(one) / len(one)) if None not in one else None for one in bound)
            lines.append(ChartSeries("bound, mean of the colours", means, dashed=True))
        at = tuple(rounded(1e3 * depth) or 0.0 for depth in there)
        title = f"Through depth: {label_of(name)}"
        yield ChartBlock(title, "depth of the source (mm)", label_of(name), at, tuple(lines), x_log=True, markers=True)


def _tables(metrics: Mapping[str, Any]) -> Iterator[TableBlock]:
    rows: Rows = metrics.get("psf") or []
    if rows:
        keys = [key for key in dict.fromkeys(k for row in rows for k in row)
                if key not in ("colour", "depth_m", "budget", "certified")]  # fmt: skip
        body = tuple(
            (length(row["depth_m"]), row["colour"], *(value_of(key, row[key]) if key in row else "" for key in keys))
            for row in rows
        )
        note = f"Lens: {metrics.get('lens', '')}; light: {metrics.get('light', '')}."
        yield TableBlock("Metrics", ("depth", "colour", *map(label_of, keys)), body, note)


def _energy(metrics: Mapping[str, Any]) -> TableBlock | None:
    rows = [row for row in metrics.get("psf") or [] if row.get("budget")]
    if not rows:
        return None
    keys = [key for key in _BUDGET if any(key in row["budget"] for row in rows)]
    body = tuple(
        (length(row["depth_m"]), row["colour"], *(percent(row["budget"].get(key)) for key in keys),
         percent(sum(row["budget"].values()))) for row in rows
    )  # fmt: skip
    head = ("depth", "colour", *(_BUDGET[key] for key in keys), "sum")
    return TableBlock("Where the light goes", head, body, "Shares of the light on the clear aperture.")


def _accuracy(metrics: Mapping[str, Any]) -> TableBlock | None:
    rows: Rows = metrics.get("accuracy") or []
    if not rows:
        return None
    keys = [key for key in rows[0] if key not in ("colour", "depth_m")]
    body = tuple((length(row["depth_m"]), row["colour"], *(percent(row.get(key)) for key in keys)) for row in rows)
    names = {
        "numerics": "numerics",
        "rim": "square cells on the rim",
        "walls": "light of walls left out",
        "lens_mapping": "lens mapping (sine or tangent)",
    }
    head = ("depth", "colour", *(names.get(key, key) for key in keys))
    return TableBlock("How far PSFs may be off", head, body, "Relative differences (L2) of PSFs, by what causes them.")


def _certificate(files: RunFiles) -> Iterator[PageBlock]:
    record = listed_json(files.folder / "certificate", "certificate.json")
    if record is None:
        return
    yield TextBlock(tuple(f"{line}." for line in record["verdict"]), title="Certificate")
    rows = tuple(
        (one["colour"], f"{one['wavelength_m'] * 1e9:.0f} nm", percent(one["zeroth_order_scalar"]),
         percent(one["zeroth_order_edges"]), percent((one["rows"] or {}).get("rigorous")),
         percent((one["pieces"] or {}).get("rigorous"))) for one in record["whole"]
    )  # fmt: skip
    head = ("colour", "wavelength", "0th order, thin element", "with edges", "rigorous, rows", "rigorous, squares")
    yield TableBlock("0th orders by Maxwell's equations", head, rows)
    picture = listed_picture(files.folder / "certificate", "certificate.png")
    if picture is not None:
        yield PictureBlock("Cut-outs", "Orders of cut-outs: thin, with edges, rigorous", picture)


def _fabricated(files: RunFiles) -> Iterator[PageBlock]:
    record = listed_json(files.folder / "fabricated", "metrics.json")
    if record is None:
        return
    keys = [key for key in record["fabricated"][0] if key not in ("colour", "depth_m", "split", "key")]
    pairs = zip(record["nominal"], record["fabricated"], strict=True)
    body = tuple(
        (length(made["depth_m"]), made["colour"],
         *(f"{value_of(key, drawn.get(key))} → {value_of(key, made.get(key))}" if key in made else "" for key in keys))
        for drawn, made in pairs
    )  # fmt: skip
    head = ("depth", "colour", *map(label_of, keys))
    yield TableBlock("One plate as fabricated, as drawn → as fabricated", head, body, folded=True)
    splits = [row for row in record["fabricated"] if row.get("split")]
    if splits:
        names = ("leaked", "diffracted", "interference")
        body = tuple((length(row["depth_m"]), row["colour"], *(percent(row["split"][name]) for name in names))
                     for row in splits)  # fmt: skip
        yield TableBlock("Leaked and diffracted light of this plate", ("depth", "colour", *names), body, folded=True)
    picture = listed_picture(files.folder / "fabricated", "leakage.png", photo=True)
    if picture is not None:
        yield PictureBlock("Leaked and diffracted light", "PSFs split by origin", picture, ink=False)
