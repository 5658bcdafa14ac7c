"""Where everything lies: the photomask, the wafer on it, its dies, alignment sites and test structures.

    PLATE    outline of the mask blank (100/0), labels beside the wafer, and on the first photomask the marks by which
             it is brought to the flat or the notch
    WAFER    outline (101/0), dies on a raster, alignment sites left and right, process monitors
    DIE      the DOE in its middle, marks below it, chrome to its edges, marks of the saw lanes at its corners, its box
             without the lanes (110/0) and the relief's outline (102/0)

All cells are upright, about the middle of the photomask, which is the middle of the wafer. Layers from 100 on say
where things are; they are in the review files and on no mask.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.layout.floorplan import GAP_M, Floorplan, floorplan, middle_of
from fab.layout.geometry import Box, Cell, Layer, Reference, Shapes, chrome_layer, outline_shapes
from fab.layout.lettering import Job, label_block, mask_label, written
from fab.layout.marks import alignment_site, die_marks
from fab.layout.part import Part, Photomask, centred, joined, moved, prefixed, row, without
from fab.layout.split import DieSplit
from fab.layout.structures import process_monitor
from fab.layout.wafer import Wafer
from fab.level_map import LevelMap
from fab.units import MM, UM, format_length

BLANK, WAFER = Layer(100, 0, "BLANK_OUTLINE"), Layer(101, 0, "WAFER_OUTLINE")
RELIEF, DIE = Layer(102, 0, "RELIEF"), Layer(110, 0, "DIE_BOX")

_LETTERS_M = 0.5 * MM
_TITLE_STROKE_UM = 16
# A circle of so many corners has no more vertices than every reader knows.
_CORNERS = 180
# Marks of the saw lanes: bars of this width and length, so far from the die and reaching so far beyond its corner.
_BAR_M, _BAR_LONG_M, _BAR_GAP_M = 20 * UM, 200 * UM, 10 * UM
# Marks at the flat: two bars of this length and width, and between them the gap in which the edge of the wafer lies.
_EDGE_LONG_M, _EDGE_WIDE_M, _EDGE_GAP_M = 3 * MM, 0.4 * MM, 0.1 * MM
# Bars at a notch are at least so long, where the blank leaves less room than their usual length; its rim holds nothing.
_SHORTEST_BAR_M, _BLANK_RIM_M = 0.5 * MM, 1 * MM


class Frame(NamedTuple):
    """The cells around a DOE.

    Attributes:
        cells: die, sites, test structures, wafer and photomask, each after those that it places.
        places: where on the wafer people measure, ``(x_m, y_m)`` by name.
        plan: where dies, sites and monitors lie.
        pitch_m: distance of the dies, metres.
        die_m: edge of a die without the saw lanes, metres.
        bare_m: boxes x0, y0, x1, y1 that chrome to the edges of a die as ordered leaves around marks, metres.
    """

    cells: tuple[Cell, ...]
    places: Mapping[str, tuple[float, float]]
    plan: Floorplan
    pitch_m: float
    die_m: float
    bare_m: tuple[tuple[float, float, float, float], ...]

    @property
    def dies(self) -> tuple[tuple[float, float], ...]:
        """Middles of the dies, ``(x_m, y_m)``, row by row from the lowest y."""
        return self.plan.dies

    @property
    def splits(self) -> tuple[int, ...]:
        """How each die is drawn, by number; 0 is the DOE as ordered."""
        return self.plan.splits


def draw_frame(
    wafer: Wafer,
    photomasks: Sequence[Photomask],
    level_map: LevelMap,
    *,
    splits: Sequence[DieSplit],
    job: Job,
    minimum_line_m: float,
    chrome: Shapes,
    dbu_m: float,
) -> Frame:
    """Draw everything around a DOE; lengths in metres.

    The photomasks come in the order in which they are used. The DOE as ordered is the first of the splits; the others
    take some dies each. The stem of the job names the top cell, and begins the names of the others. `chrome` is the
    chrome around the DOE (`fab.layout.geometry.chrome_shapes`).

    Raises:
        InputError: the wafer is too small for what is asked, or the dies lie too close.
    """
    stem, unit = job.stem, _InUnits(dbu_m)
    marks = die_marks(photomasks, dbu_m)
    site = alignment_site(photomasks, dbu_m)
    monitor = process_monitor(level_map.levels, photomasks, level_map.grid.pitch_m, dbu_m, minimum_line_m)
    # The DOE is in the middle of its die, the marks are below its chrome.
    width, height = _size_m(marks)
    chrome_m = max(map(abs, chrome.box or (0,))) * dbu_m
    half = chrome_m + 2 * GAP_M + height
    marks, side_m = moved(marks, 0, -(half - GAP_M / 2 - height / 2)), max(2 * half, width + GAP_M)
    pitch = wafer.pitch_m or math.ceil((side_m + wafer.lane_m) / MM - 1e-6) * MM
    if pitch < side_m + wafer.lane_m - dbu_m:
        rule = f"must be {format_length(side_m + wafer.lane_m)} or more, what a die with its marks and a saw lane needs"
        raise InputError(
            "wafer: pitch of the dies", rule, format_length(pitch), "Leave it out, or choose a larger one."
        )
    die_m = pitch - wafer.lane_m
    plan = floorplan(wafer, pitch, die_m, _size_m(site), _size_m(monitor), len(splits))
    relief = outline_shapes(level_map.relief, dbu_m, _CORNERS)
    names = {part: f"{stem}_{part}" for part in ("SITE", "TEST", "WAFER")}
    die_cells = []
    for number, split in enumerate(splits):
        # What is special about a die stands above its DOE.
        titled = [marks, _title(marks, split, photomasks[0])] if split.lettering else [marks]
        parts = [*titled, _lane_marks(photomasks[0], die_m, wafer.lane_m, dbu_m)]
        if wafer.chrome_to_edge:
            parts.append(_chrome_to_edge(chrome, chrome_layer(level_map.levels), die_m, titled))
        shapes = {DIE: unit.square(die_m), RELIEF: relief, **joined(parts).shapes}
        name = f"{stem}_DIE" if number == 0 else f"{stem}_{split.code}_DIE"
        die_cells.append(Cell(name, shapes, (Reference(f"{stem}_{split.code}"),)))
    placed = [Reference(names["SITE"], unit(x)) for x in (-plan.site_m, plan.site_m)]
    placed += [Reference(names["TEST"], unit(x), unit(y)) for x, y in plan.monitors.values()]
    on_wafer = [
        Reference(die_cells[n].name, unit(x), unit(y)) for n, (x, y) in zip(plan.splits, plan.dies, strict=True)
    ]
    wafer_cell = Cell(names["WAFER"], {WAFER: unit.wafer(wafer)}, (*on_wafer, *placed))
    labels = joined([_labels(photomasks, wafer, job, dbu_m), _edge_marks(photomasks[0], wafer, dbu_m)])
    top = Cell(stem, {BLANK: unit.square(wafer.blank_m), **labels.shapes}, (Reference(names["WAFER"]),))
    sites = [
        prefixed(moved(site, x, 0), f"{side} site: ") for side, x in (("left", -plan.site_m), ("right", plan.site_m))
    ]
    # Every die has its marks; the places are those of the one in the middle.
    beside = prefixed(moved(marks, *plan.dies[middle_of(plan.dies)]), "middle die: ")
    monitors = [prefixed(moved(monitor, *at), f"{name}: ") for name, at in plan.monitors.items()]
    places = joined([*sites, beside, *monitors, labels]).places
    x0, y0, x1, y1 = (edge * dbu_m for edge in _bare(marks))
    bare_m = ((x0, y0, x1, y1),) if wafer.chrome_to_edge else ()
    small = (Cell(names["SITE"], site.shapes), Cell(names["TEST"], monitor.shapes))
    return Frame((*die_cells, *small, wafer_cell, top), places, plan, pitch, die_m, bare_m)


def _title(marks: Part, split: DieSplit, photomask: Photomask) -> Part:
    """Write what is special about a die above its DOE, where the marks are below."""
    title = centred(written(photomask, split.lettering, _TITLE_STROKE_UM, marks.dbu_m))
    _, y0, _, y1 = marks.box
    return moved(title, 0, -(y0 + y1) / 2 * marks.dbu_m)


def _lane_marks(photomask: Photomask, die_m: float, lane_m: float, dbu_m: float) -> Part:
    """Draw an angle of two bars around each corner of a die, in its half of the saw lanes, if there is room."""
    unit = _InUnits(dbu_m)
    edge, near, wide, long = unit(die_m / 2), unit(_BAR_GAP_M), unit(_BAR_M), unit(_BAR_LONG_M)
    if unit(lane_m) < 4 * (near + wide) or edge < long:
        return Part(dbu_m, {}, {})
    outer = edge + near + wide
    corner = [(edge - long, edge + near, outer, outer), (edge + near, edge - long, outer, edge + near)]
    boxes = [
        (*sorted((sx * x0, sx * x1)), *sorted((sy * y0, sy * y1)))
        for x0, y0, x1, y1 in corner
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    return Part(dbu_m, {photomask.on(1): Shapes(np.array(boxes, dtype=np.int32)[:, [0, 2, 1, 3]])}, {})


def _chrome_to_edge(chrome: Shapes, layer: Layer, die_m: float, bare: Sequence[Part]) -> Part:
    """Draw chrome from that around the aperture to the edges of the die, with room around marks and words."""
    dbu_m = bare[0].dbu_m
    unit = _InUnits(dbu_m)
    edge = unit(die_m / 2)
    square = max(map(abs, chrome.box or (0,))) + unit(GAP_M / 2)
    holes = [(-square, -square, square, square), *map(_bare, bare)]
    rest = without([(-edge, -edge, edge, edge)], holes)
    # Sectors reach the outer circle; the frame around a rectangular opening lies within them.
    reaches = [np.hypot(*polygon.T.astype(np.float64)).max() for polygon in chrome.polygons]
    sectors = (p for p, reach in zip(chrome.polygons, reaches, strict=True) if reach > max(reaches) - 2)
    polygons = tuple(_to_square(sector, square) for sector in sectors)
    return Part(dbu_m, {layer: Shapes(rest.astype(np.int32), polygons)}, {})


def _bare(part: Part) -> Box:
    """Return the box that chrome leaves around marks or words."""
    margin = _InUnits(part.dbu_m)(_BAR_M)
    x0, y0, x1, y1 = part.box
    return x0 - margin, y0 - margin, x1 + margin, y1 + margin


def _to_square(sector: NDArray[np.int32], square: int) -> NDArray[np.int32]:
    """Return what lies between the outer arc of a sector and a centred square around it, of half the edge."""
    radius = np.hypot(*sector.T.astype(np.float64))
    arc = sector[radius > radius.max() - 2].astype(np.float64)
    first, last = (np.rint(point * (square / np.abs(point).max())) for point in (arc[0], arc[-1]))
    corner = np.copysign(square, arc[0] + arc[-1])
    between = [corner] if not np.any(np.all([first == corner, last == corner], axis=1)) and _within(corner, arc) else []
    return np.concatenate([arc[::-1], [first, *between, last]]).astype(np.int32)


def _within(point: NDArray[np.float64], arc: NDArray[np.float64]) -> bool:
    """Whether the ray to a point lies strictly between the ends of an arc, counter-clockwise."""
    first, last = arc[0], arc[-1]
    return bool(first[0] * point[1] - first[1] * point[0] > 0 and point[0] * last[1] - point[1] * last[0] > 0)


def _edge_marks(photomask: Photomask, wafer: Wafer, dbu_m: float) -> Part:
    """Draw the marks by which the first photomask is turned: at both ends of the flat, or beside the notch.

    The edge of the wafer lies in the gap between the two bars of each mark; the middle of a notch between two upright
    bars below the wafer.

    Raises:
        InputError: a blank without room for the bars at the notch.
    """
    flat_m, unit = wafer.usual_flat_m, _InUnits(dbu_m)
    long, wide, gap = unit(_EDGE_LONG_M), unit(_EDGE_WIDE_M), unit(_EDGE_GAP_M / 2)
    places: dict[str, tuple[float, float]] = {}
    if flat_m:
        y = -unit(wafer.flat_y_m)
        boxes = []
        for name, x_m in (("left", -flat_m / 2 + _EDGE_LONG_M), ("right", flat_m / 2 - _EDGE_LONG_M)):
            x = unit(x_m)
            boxes += [(x - long // 2, low, x + long // 2, low + wide) for low in (y + gap, y - gap - wide)]
            places[f"flat {name}, {photomask.name}"] = (x * dbu_m, y * dbu_m)
    elif wafer.notch_m:
        y = -unit(wafer.diameter_m / 2) - gap
        long = min(long, unit(wafer.blank_m / 2 - _BLANK_RIM_M) + y)
        if long < unit(_SHORTEST_BAR_M):
            room = format_length(_BLANK_RIM_M + _SHORTEST_BAR_M + _EDGE_GAP_M / 2)
            rule = f"must leave {room} below the notch for marks"
            raise InputError("wafer: blank_m", rule, format_length(wafer.blank_m), "Choose a larger mask blank.")
        boxes = [(-gap - wide, y - long, -gap, y), (gap, y - long, gap + wide, y)]
        places[f"notch, {photomask.name}"] = (0.0, -wafer.diameter_m / 2)
    else:
        return Part(dbu_m, {}, {})
    return Part(dbu_m, {photomask.on(1): Shapes(np.array(boxes, dtype=np.int32))}, places)


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
        return self._polygon(diameter_m / 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1))

    def wafer(self, wafer: Wafer) -> Shapes:
        """Outline with its flat or its notch at -y."""
        radius = wafer.diameter_m / 2
        depth = wafer.notch_m
        half = wafer.usual_flat_m / 2 or depth
        if not half:
            return self.circle(wafer.diameter_m)
        # From the right end of the flat, or of the notch, around to its left end.
        start = -math.pi / 2 + math.asin(half / radius)
        angle = np.linspace(start, math.pi - start, _CORNERS)
        points = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return self._polygon(np.concatenate([points, [(0.0, depth - radius)]]) if depth else points)

    def _polygon(self, points_m: NDArray[np.float64]) -> Shapes:
        return Shapes(polygons=(np.rint(points_m / self.dbu_m).astype(np.int32),))


def _size_m(part: Part) -> tuple[float, float]:
    x0, y0, x1, y1 = part.box
    return (x1 - x0) * part.dbu_m, (y1 - y0) * part.dbu_m


def _labels(photomasks: Sequence[Photomask], wafer: Wafer, job: Job, dbu_m: float) -> Part:
    """Labels of all masks side by side, above the wafer on the blank; each mask carries its own.

    Where the blank has no room beside the wafer, they are smaller, on the rim that is excluded.
    """
    radius, most = wafer.diameter_m / 2, wafer.blank_m / 2 - _BLANK_RIM_M
    for letters_m, low in ((_LETTERS_M, radius + GAP_M), (_LETTERS_M / 2, radius - wafer.edge_exclusion_m)):
        blocks = [label_block([(p, mask_label(job, p, wafer.reading))], letters_m, dbu_m) for p in photomasks]
        labels = centred(row(blocks, 4 * letters_m))
        width, height = _size_m(labels)
        if max(width / 2, low + height) <= most:
            return moved(labels, 0, low + height / 2)
    rule = "must leave room for the labels beside the wafer or on its excluded rim"
    raise InputError("wafer: blank_m", rule, format_length(wafer.blank_m), "Choose a larger mask blank.")
