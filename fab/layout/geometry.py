"""The geometry of a mask set: cells with layers of rectangles and polygons in integer database units.

The centre of the clear aperture is (0, 0). Mask bit k is layer k + 1, datatype 0 (the number is the bit, not the order
of etching); chrome is layer 5 for up to four masks and the next free one otherwise. A polygon in an etch layer means
"etched here", in the chrome layer "chrome here". Names of cells hold A-Z, 0-9 and _ only, up to 32 characters, and are
never "main", which some writers keep for themselves.

The database unit is 1 nm where every pixel edge falls on it, otherwise the coarsest finer unit on which it does; where
none does, each edge is rounded once, so that neighbours still share it.
"""

import graphlib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fab.aperture import Aperture, MaskAperture, RoundAperture, aperture_from
from fab.aperture.mask import OpenArea
from fab.errors import InputError
from fab.grid import Grid
from fab.layout.polygons import annulus_sectors, doubled_area, frame_around_box, rectangles, sectors_around_square
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.units import MM, NM, UM, format_length, number_of, told_length

_NAME = re.compile(r"[A-Z0-9_]{1,32}")
_FEMTO = 10**15
_NANO_FM = 10**6
_UNITS_FM = (1000_000, 500_000, 250_000, 200_000, 100_000)
_LIMIT = 2**31 - 1
# Width of the square frame around an opening that is not round.
_FRAME_M = 100 * UM
# Between the chrome's outer circle and what lies within it, some of the largest database units.
_CLEAR_M = 5 * NM

# x0, y0, x1, y1
Box = tuple[int, int, int, int]


def box_around(boxes: Iterable[Box]) -> Box | None:
    """Return the smallest box around some; None if there are none."""
    x0, y0, x1, y1 = list(zip(*boxes, strict=True)) or [()] * 4
    return (min(x0), min(y0), max(x1), max(y1)) if x0 else None


@dataclass(frozen=True)
class Layer:
    """A layer of the drawing by its GDSII numbers; its name, for people, is left out of files and comparisons."""

    number: int
    datatype: int = 0
    name: str = field(default="", compare=False)

    def __str__(self) -> str:
        """Return the usual short form, such as ``3/0``."""
        return f"{self.number}/{self.datatype}"


@dataclass(frozen=True, eq=False)
class Shapes:
    """Rectangles ``(n, 4)``, x0 < x1 and y0 < y1, and simple polygons ``(v, 2)``, not closed, in database units."""

    rectangles: NDArray[np.int32] = field(default_factory=lambda: np.empty((0, 4), dtype=np.int32))
    polygons: tuple[NDArray[np.int32], ...] = ()

    def __len__(self) -> int:
        return len(self.rectangles) + len(self.polygons)

    @property
    def doubled_area(self) -> int:
        """Twice the summed area of the shapes in squared database units, exact."""
        total = sum(abs(doubled_area(polygon)) for polygon in self.polygons)
        if len(self.rectangles):
            x0, y0, x1, y1 = self.rectangles.T.astype(np.int64)
            # Sides of up to 32 bits: an area fills 64, and the sums of the halves of many are exact.
            areas = (x1 - x0).astype(np.uint64) * (y1 - y0).astype(np.uint64)
            total += 2 * ((int(np.sum(areas >> 32)) << 32) + int(np.sum(areas & 0xFFFFFFFF)))
        return total

    @property
    def box(self) -> Box | None:
        """The smallest x0, y0, x1, y1 around all shapes, or None if there are none."""
        corners = [(polygon, polygon) for polygon in self.polygons]
        if len(self.rectangles):
            corners.append((self.rectangles[:, :2], self.rectangles[:, 2:]))
        return box_around((*low.min(axis=0).tolist(), *high.max(axis=0).tolist()) for low, high in corners)


def merged(parts: Sequence[Shapes]) -> Shapes:
    """Put shapes of one layer together."""
    polygons = tuple(polygon for part in parts for polygon in part.polygons)
    return Shapes(np.concatenate([part.rectangles for part in parts]), polygons)


@dataclass(frozen=True)
class Reference:
    """A cell placed with its origin at x, y (database units), once or on a raster; never turned, never mirrored."""

    cell: str
    x: int = 0
    y: int = 0
    columns: int = 1
    rows: int = 1
    step_x: int = 0
    step_y: int = 0


@dataclass(frozen=True, eq=False)
class Cell:
    """A named drawing that others may place: its layers in the order they are written, and the cells it places."""

    name: str
    shapes: Mapping[Layer, Shapes]
    references: tuple[Reference, ...] = ()


@dataclass(frozen=True, eq=False)
class Layout:
    """Everything in one file: its database unit in metres, and every cell after those that it places, the top last."""

    dbu_m: float
    cells: tuple[Cell, ...]

    @property
    def top(self) -> Cell:
        """The cell that no other places."""
        return self.cells[-1]

    def cell(self, name: str) -> Cell | None:
        """The cell of a name, or None."""
        return next((cell for cell in self.cells if cell.name == name), None)

    @property
    def layers(self) -> tuple[Layer, ...]:
        """All layers, in the order in which the cells first use them, the top first."""
        return tuple(dict.fromkeys(layer for cell in reversed(self.cells) for layer in cell.shapes))


def placed_boxes(layout: Layout) -> dict[Layer, Box]:
    """Return the smallest box around all of every layer, what cells place included, database units."""
    done: dict[str, dict[Layer, Box]] = {}
    for cell in layout.cells:
        boxes = [(layer, box) for layer, shapes in cell.shapes.items() if (box := shapes.box) is not None]
        for at in cell.references:
            (left, right), (low, high) = (
                sorted((start, start + (count - 1) * step))
                for start, count, step in ((at.x, at.columns, at.step_x), (at.y, at.rows, at.step_y))
            )
            for layer, (x0, y0, x1, y1) in done[at.cell].items():
                boxes.append((layer, (x0 + left, y0 + low, x1 + right, y1 + high)))
        found: dict[Layer, Box] = {}
        for layer, box in boxes:
            found[layer] = box_around([box, found.get(layer, box)]) or box
        done[cell.name] = found
    return done[layout.top.name]


def in_order(cells: Iterable[Cell]) -> tuple[Cell, ...]:
    """Sort cells so that each comes after those that it places, the one top cell last; ValueError if they cannot be."""
    waiting = {}
    for cell in cells:
        if cell.name in waiting:
            raise ValueError(f"two cells are named {cell.name!r}")
        waiting[cell.name] = cell
    placed = {reference.cell for cell in waiting.values() for reference in cell.references}
    tops = [name for name in waiting if name not in placed]
    if missing := sorted(placed - set(waiting)):
        raise ValueError(f"the placed cell {missing[0]!r} is missing")
    if len(tops) != 1:
        raise ValueError(f"{len(tops)} cells instead of one are placed by no other")
    sorter = graphlib.TopologicalSorter({name: {r.cell for r in cell.references} for name, cell in waiting.items()})
    try:
        sorter.prepare()
    except graphlib.CycleError as error:
        raise ValueError(f"cell {min(error.args[1])!r} places itself") from error
    rank = {name: n for n, name in enumerate(waiting)}
    done: list[Cell] = []
    while ready := sorter.get_ready():
        done += [waiting[name] for name in sorted(ready, key=rank.__getitem__)]
        sorter.done(*ready)
    return tuple(done)


@dataclass(frozen=True)
class Chrome:
    """The chrome around the clear aperture, as it is drawn.

    Attributes:
        overlap_m: how far the chrome reaches over the edge of the relief, metres, so that it stays covered
            when the chrome is aligned a little off.
        outer_m: outer radius, metres, 5 nm and more beyond the opening, or the square frame of one that is not round
            and the chord error; by default the corners of the raster and half a millimetre more.
        chord_error_m: largest distance between the circles and their chords, metres.
    """

    overlap_m: float = 5e-6
    outer_m: float | None = None
    chord_error_m: float = 5e-9

    def opening(self, relief: Aperture) -> Aperture:
        """Return the opening for a DOE with this relief."""
        opening = relief.shrunk(self.overlap_m) if number_of(self.overlap_m) >= 0 else None
        if opening is None or not opening.narrowest_m > 0:
            rule = f"must be 0 or more and leave an opening in an aperture of {relief}"
            raise InputError("chrome overlap", rule, told_length(self.overlap_m), "Choose a smaller one.")
        return opening

    def rim_m(self, level_map: LevelMap) -> float:
        """Return the outer radius for one DOE, metres."""
        opening, outer = self.opening(level_map.relief), self.outer_m
        extent_m, reach_m = level_map.grid.extent_m, opening.reach_m
        if not isinstance(opening, RoundAperture):  # there is a square frame around it
            extent_m = (max(extent_m), max(extent_m))
            # Its corners lie within the chords of the circle.
            reach_m = math.sqrt(2) * (opening.widest_m / 2 + _FRAME_M) + max(0.0, self.chord_error_m)
        if outer is None:
            # Whole tenths of a millimetre, because this number stands on the order form.
            outer = (np.ceil((np.hypot(*extent_m) / 2 + 0.5 * MM) / (0.1 * MM) - 1e-9)) * 0.1 * MM
        reach_m += _CLEAR_M
        if not reach_m < number_of(outer) < float("inf"):
            rule, got = f"must exceed what the opening needs, {format_length(reach_m)}", told_length(outer)
            raise InputError("chrome outer radius", rule, got, "Choose a larger one.")
        return float(outer)


@dataclass(frozen=True, eq=False)
class PixelEdges:
    """Pixel edges of a grid in the drawing: ``(nx + 1,)`` x and ``(ny + 1,)`` y in database units of `dbu_m` metres.

    `shift_m` is how far the worst edge was moved to fall on the database unit; 0 if every one is exact.
    """

    x: NDArray[np.int32]
    y: NDArray[np.int32]
    dbu_m: float
    shift_m: float


def _axis_edges(count: int, pitch_fm: int, unit_fm: int) -> tuple[NDArray[np.int32], float]:
    """Return the edges of an axis in units, symmetric about 0, and the largest shift in femtometres."""
    doubled_fm = np.arange(-count, count + 1, 2) * pitch_fm
    # Half a unit goes outward on both sides, so that the drawing stays symmetric.
    edges = np.sign(doubled_fm) * ((np.abs(doubled_fm) + unit_fm) // (2 * unit_fm))
    return edges.astype(np.int32), float(np.max(np.abs(2 * unit_fm * edges - doubled_fm))) / 2


def pixel_edges(grid: Grid) -> PixelEdges:
    """Place the pixel edges of a grid on a database unit, 1 nm wherever it can be; the grid's centre is the origin."""
    # The pitch is meant as a decimal number; whole femtometres recover it from the binary one.
    pitch_fm = round(grid.pitch_m * _FEMTO)
    if pitch_fm < 10 * _NANO_FM or max(grid.extent_m) / 2 > _LIMIT * NM:
        got = f"{grid.shape} pixels of {format_length(grid.pitch_m)}"
        rule = "the pixels must measure 10 nm or more and the raster must fit 32-bit nanometres"
        raise InputError("grid", rule, got, "Check the unit of the pitch.")
    ny, nx = grid.shape
    # Every edge is exact if the pitch and half of either side are whole units.
    doubled_fm = (2 * pitch_fm, ny * pitch_fm, nx * pitch_fm)
    exact = (u for u in _UNITS_FM if all(v % (2 * u) == 0 for v in doubled_fm) and max(doubled_fm) < 2 * u * _LIMIT)
    unit_fm = next(exact, _NANO_FM)
    (x, shift_x), (y, shift_y) = (_axis_edges(n, pitch_fm, unit_fm) for n in (nx, ny))
    return PixelEdges(x, y, unit_fm / _FEMTO, max(shift_x, shift_y) / _FEMTO)


def require_name(name: str) -> str:
    """Check the name of a cell or of a mask file (without its suffix) and return it."""
    if not _NAME.fullmatch(name) or name == "MAIN":
        rule = "must be 1 to 32 characters A-Z, 0-9 or _, and not MAIN"
        raise InputError("mask name", rule, repr(name), "Choose a plainer or shorter name.")
    return name


def etch_layer(bit: int, levels: Levels) -> Layer:
    """Return the layer of an etch mask: number ``bit + 1``, datatype 0."""
    return Layer(bit + 1, 0, f"ETCH_B{bit}_{format_length(levels.etch_depth_m(bit)).replace(' ', '')}")


def chrome_layer(levels: Levels) -> Layer:
    """Return the chrome layer: 5 for up to four masks, otherwise the next free number."""
    return Layer(max(5, levels.bits + 1), 0, "CHROME")


def chrome_shapes(level_map: LevelMap, dbu_m: float, chrome: Chrome) -> Shapes:
    """Draw the chrome around the clear aperture as sectors that share their radial edges.

    They reach to an opening that is round, and to a square frame around any other, which is drawn as well.
    """
    opening, outer = chrome.opening(level_map.relief), round(chrome.rim_m(level_map) / dbu_m)
    if outer > _LIMIT:
        got = format_length(outer * dbu_m)
        raise InputError("chrome outer radius", "must fit 32-bit coordinates", got, "Choose a smaller one.")
    if not number_of(chrome.chord_error_m) >= dbu_m:
        got = told_length(chrome.chord_error_m)
        raise InputError("chrome chord error", "must be one database unit or more", got, "Choose a larger one.")
    chord_error, (half_y, half_x) = chrome.chord_error_m / dbu_m, half_extent(opening, dbu_m)
    if isinstance(opening, RoundAperture):
        return Shapes(polygons=tuple(annulus_sectors(half_x, outer, chord_error)))
    half = frame_half(opening, dbu_m)
    sectors = sectors_around_square(half, outer, chord_error)
    if isinstance(opening, MaskAperture):
        return Shapes(rectangles_around(opening_units(opening, pixel_edges(level_map.grid)), half), tuple(sectors))
    return Shapes(polygons=(*sectors, *frame_around_box(half_x, half_y, half)))


def opening_units(opening: MaskAperture, edges: PixelEdges) -> OpenArea:
    """Return the open area of a mask over the pixels of a DOE, database units."""
    y, x = (axis.astype(np.int64) for axis in (edges.y, edges.x))
    return opening.area_on(y, x, round(opening.inset_m / edges.dbu_m))


def rectangles_around(area: OpenArea, half: int) -> NDArray[np.int32]:
    """Draw what is not open within a centred square, of half its edge, around an area."""
    closed = np.pad(~area.cells, 1, constant_values=True).view(np.uint8)
    x, y = (np.concatenate([[-half], lines, [half]]).astype(np.int32) for lines in (area.x, area.y))
    return rectangles(closed, x, y)


def half_extent(aperture: Aperture, dbu_m: float) -> tuple[int, int]:
    """Return half of height and width ``(y, x)`` of the box around an aperture, whole database units."""
    half_y, half_x = (round(side_m / 2 / dbu_m) for side_m in aperture.extent_m)
    return half_y, half_x


def frame_half(opening: Aperture, dbu_m: float) -> int:
    """Return half of the edge of the square frame around an opening that is not round, whole database units."""
    return max(half_extent(opening, dbu_m)) + round(_FRAME_M / dbu_m)


def on_units(aperture: Aperture, dbu_m: float) -> Aperture:
    """Return an aperture as it is drawn: half of its sizes, or the inset of a mask, is whole database units."""
    if isinstance(aperture, MaskAperture):
        return replace(aperture, inset_m=round(aperture.inset_m / dbu_m) * dbu_m)
    sizes = [2 * round(size_m / 2 / dbu_m) * dbu_m for size_m in aperture.sizes_m]
    return aperture_from(sizes if len(sizes) > 1 else sizes[0])


def outline_shapes(aperture: Aperture, dbu_m: float, corners: int) -> Shapes:
    """Draw the outline of an aperture, with so many corners where it is round."""
    if isinstance(aperture, MaskAperture):
        y, x, cells = aperture.area
        lines = (np.rint(axis * aperture.pitch_m / dbu_m).astype(np.int32) for axis in (x, y))
        return Shapes(rectangles(cells.view(np.uint8), *lines))
    points = np.rint(aperture.outlines_m(corners)[0] / dbu_m).astype(np.int32)
    if isinstance(aperture, RoundAperture):
        return Shapes(polygons=(points,))
    return Shapes(np.concatenate([points.min(axis=0), points.max(axis=0)])[None])
