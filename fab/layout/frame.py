"""Where everything lies: the photomask, the wafer on it, its dies, alignment sites and test structures.

    PLATE    outline of the mask blank (100/0), labels beside the wafer
    WAFER    outline (101/0), dies on a raster, alignment sites left and right, test structures
    DIE      the DOE in its middle, marks below it, the die's box (110/0) and the relief's outline (102/0)

All cells are upright, about the middle of the photomask, which is the middle of the wafer. Layers from 100 on say
where things are; they are in the review files and on no mask.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fab.errors import InputError
from fab.layout.geometry import Cell, Layer, Reference, Shapes
from fab.layout.lettering import label_block, mask_label, written
from fab.layout.marks import alignment_site, die_marks
from fab.layout.part import Part, Photomask, centred, joined, moved, prefixed, row
from fab.layout.split import DieSplit
from fab.layout.structures import process_monitor
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.units import MM, UM, format_length

BLANK, WAFER = Layer(100, 0, "BLANK_OUTLINE"), Layer(101, 0, "WAFER_OUTLINE")
RELIEF, DIE = Layer(102, 0, "RELIEF"), Layer(110, 0, "DIE_BOX")

# The rim that is held, beaded or ground.
_RIM_M = 4 * MM
_GAP_M = 200 * UM
_LETTERS_M = 0.5 * MM
_TITLE_STROKE_UM = 16
# Rows and columns of dies, if nobody says how many.
_USUAL_DIES = (3, 2, 1)
# A circle of so many corners has no more vertices than every reader knows.
_CORNERS = 180


class Frame(NamedTuple):
    """The cells around a DOE.

    Attributes:
        cells: die, sites, test structures, wafer and photomask, each after those that it places.
        places: where on the wafer people measure, ``(x_m, y_m)`` by name.
        raster: rows and columns of dies.
        dies: middles of the dies, ``(x_m, y_m)``, row by row from the lowest y.
        splits: how each of them is drawn, by number; 0 is the DOE as ordered.
        die_m: edge of a die, metres.
    """

    cells: tuple[Cell, ...]
    places: Mapping[str, tuple[float, float]]
    raster: tuple[int, int]
    dies: tuple[tuple[float, float], ...]
    splits: tuple[int, ...]
    die_m: float


def draw_frame(
    wafer: Wafer,
    photomasks: Sequence[Photomask],
    level_map: LevelMap,
    *,
    splits: Sequence[DieSplit],
    stem: str,
    minimum_line_m: float,
    chrome_m: float,
    dbu_m: float,
) -> Frame:
    """Draw everything around a DOE; lengths in metres.

    The photomasks come in the order in which they are used. The DOE as ordered is the first of the splits; the others
    take one die each, the last ones. `stem` names the job and the top cell, and begins the names of the others.
    `chrome_m` is the diameter of the DOE with its chrome.

    Raises:
        InputError: the wafer is too small for what is asked, or the dies lie too close.
    """
    marks = die_marks(photomasks, dbu_m)
    site = alignment_site(photomasks, dbu_m)
    monitor = process_monitor(level_map.levels, photomasks, level_map.grid.pitch_m, dbu_m, minimum_line_m)
    # The DOE is in the middle of its die, the marks are below its chrome.
    width, height = _size_m(marks)
    half = chrome_m / 2 + 2 * _GAP_M + height
    marks, side_m = moved(marks, 0, -(half - _GAP_M / 2 - height / 2)), max(2 * half, width + _GAP_M)
    pitch = wafer.pitch_m or math.ceil(side_m / MM - 1e-6) * MM
    if pitch < side_m - dbu_m:
        rule = f"must be {format_length(side_m)} or more, what a die with its marks needs"
        raise InputError(
            "wafer: pitch of the dies", rule, format_length(pitch), "Leave it out, or choose a larger one."
        )
    raster, site_m, monitor_m = _room(wafer, pitch, site, monitor)
    wafer.require_room(raster)
    dies = _raster(raster, pitch)
    unit = _InUnits(dbu_m)
    relief = unit.circle(level_map.aperture_m)
    names = {part: f"{stem}_{part}" for part in ("SITE", "TEST", "WAFER")}
    die_cells = [
        Cell(
            f"{stem}_DIE" if number == 0 else f"{stem}_{split.code}_DIE",
            {DIE: unit.square(pitch), RELIEF: relief, **_titled(marks, split, photomasks[0]).shapes},
            (Reference(f"{stem}_{split.code}"),),
        )
        for number, split in enumerate(splits)
    ]
    drawn = (*(0,) * (len(dies) - len(splits) + 1), *range(1, len(splits)))
    placed = [Reference(names["SITE"], -unit(site_m)), Reference(names["SITE"], unit(site_m))]
    placed += [Reference(names["TEST"], 0, unit(monitor_m))]
    on_wafer = [Reference(die_cells[n].name, unit(x), unit(y)) for n, (x, y) in zip(drawn, dies, strict=True)]
    if not any(drawn):
        # One raster, since all dies are alike.
        (rows, columns), step = raster, unit(pitch)
        raster_steps = (step * (columns > 1), step * (rows > 1))
        on_wafer = [Reference(on_wafer[0].cell, on_wafer[0].x, on_wafer[0].y, columns, rows, *raster_steps)]
    wafer_cell = Cell(names["WAFER"], {WAFER: unit.circle(wafer.diameter_m)}, (*on_wafer, *placed))
    labels = _labels(photomasks, wafer, stem, level_map.digest, dbu_m)
    top = Cell(stem, {BLANK: unit.square(wafer.blank_m), **labels.shapes}, (Reference(names["WAFER"]),))
    sites = [prefixed(moved(site, x, 0), f"{side} site: ") for side, x in (("left", -site_m), ("right", site_m))]
    # Every die has its marks; the places are those of the one in the middle.
    middle = dies[len(dies) // 2]
    beside = prefixed(moved(marks, *middle), "middle die: ")
    places = joined([*sites, beside, moved(monitor, 0, monitor_m), labels]).places
    small = (Cell(names["SITE"], site.shapes), Cell(names["TEST"], monitor.shapes))
    return Frame((*die_cells, *small, wafer_cell, top), places, raster, dies, drawn, pitch)


def _titled(marks: Part, split: DieSplit, photomask: Photomask) -> Part:
    """Add what is special about a die above its DOE, where the marks are below."""
    if not split.lettering:
        return marks
    title = centred(written(photomask, split.lettering, _TITLE_STROKE_UM, marks.dbu_m))
    _, y0, _, y1 = marks.box
    return joined([marks, moved(title, 0, -(y0 + y1) / 2 * marks.dbu_m)])


class _InUnits:
    """Lengths and outlines in database units."""

    def __init__(self, dbu_m: float) -> None:
        self.dbu_m = dbu_m

    def __call__(self, length_m: float) -> int:
        return round(length_m / self.dbu_m)

    def square(self, side_m: float) -> Shapes:
        half = self(side_m / 2)
        return Shapes(np.array([[-half, -half, half, half]], dtype=np.int32))

    def circle(self, diameter_m: float) -> Shapes:
        angle = (np.arange(_CORNERS) + 0.5) * 2 * np.pi / _CORNERS
        points = diameter_m / 2 / self.dbu_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return Shapes(polygons=(np.rint(points).astype(np.int32),))


def _size_m(part: Part) -> tuple[float, float]:
    x0, y0, x1, y1 = part.box
    return (x1 - x0) * part.dbu_m, (y1 - y0) * part.dbu_m


def _raster(dies: tuple[int, int], pitch_m: float) -> tuple[tuple[float, float], ...]:
    rows, columns = dies
    return tuple(
        ((column - (columns - 1) / 2) * pitch_m, (line - (rows - 1) / 2) * pitch_m)
        for line in range(rows)
        for column in range(columns)
    )


def _room(wafer: Wafer, pitch_m: float, site: Part, monitor: Part) -> tuple[tuple[int, int], float, float]:
    """Return rows and columns of dies, x of the right site and y of the test structures, metres, that fit."""
    rasters = [(n, n) for n in _USUAL_DIES] if wafer.dies is None else [wafer.dies]
    for raster in rasters:
        found = _beside(wafer, _raster(raster, pitch_m), pitch_m, site, monitor)
        if found is not None:
            return raster, *found
    rows, columns = rasters[-1]
    rule = f"must hold the dies of {format_length(pitch_m)}, two alignment sites and the test structures"
    got = f"{rows} x {columns} dies on a wafer of {format_length(wafer.diameter_m)}"
    cure = "Take fewer dies, or a larger wafer." if rows * columns > 1 else "Take a larger wafer."
    raise InputError("wafer", rule, got, cure)


def _beside(
    wafer: Wafer, dies: Sequence[tuple[float, float]], pitch_m: float, site: Part, monitor: Part
) -> tuple[float, float] | None:
    """Return x of the right site and y of the test structures, metres; None if the wafer is too small."""
    usable = wafer.diameter_m / 2 - _RIM_M
    (site_w, site_h), (test_w, test_h) = _size_m(site), _size_m(monitor)
    farthest = max(math.hypot(abs(x) + pitch_m / 2, abs(y) + pitch_m / 2) for x, y in dies)
    most_x, most_y = (max(abs(die[axis]) for die in dies) + pitch_m / 2 for axis in (0, 1))
    # As far apart as they can be, for the best angle, though no farther than the usual stage of a microscope pair.
    site_m = min(0.7 * wafer.diameter_m / 2, math.sqrt(max(usable**2 - (site_h / 2) ** 2, 0)) - site_w / 2)
    monitor_m = -(most_y + _GAP_M + test_h / 2)
    corner = math.hypot(test_w / 2, monitor_m - test_h / 2)
    if farthest > usable or site_m - site_w / 2 < most_x + _GAP_M or corner > usable:
        return None
    return round(site_m / MM, 1) * MM, monitor_m


def _labels(photomasks: Sequence[Photomask], wafer: Wafer, stem: str, digest: str, dbu_m: float) -> Part:
    """Labels of all masks side by side, above the wafer on the blank; each mask carries its own."""
    blocks = [label_block([(p, mask_label(stem, p, wafer.reading, digest))], _LETTERS_M, dbu_m) for p in photomasks]
    labels = centred(row(blocks, 4 * _LETTERS_M))
    width, height = _size_m(labels)
    y = wafer.diameter_m / 2 + _GAP_M + height / 2
    if max(width / 2, y + height / 2) > wafer.blank_m / 2 - 1 * MM:
        # No room beside the wafer: the labels go to its lower rim.
        y = -(wafer.diameter_m / 2 - _RIM_M / 2)
    return moved(labels, 0, y)
