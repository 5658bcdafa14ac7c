"""Mask files read by gdstk, a library that had no part in writing them.

Everything here relies on gdstk and numpy alone and shares no code with the writer, the reader or the
painter of this package: a mistake in those cannot hide itself. Rectangles are counted into a winding
number per pixel by a difference array and two running sums; a sound plane has 0 and 1 only.

OASIS keeps repeated shapes folded. They are unfolded here by the library's own list of offsets; reading
the polygons alone would silently miss most of a mask.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any

import gdstk
import numpy as np
from numpy.typing import NDArray

from fab.layout.geometry import Cell, Layer, PixelEdges, Reference, Shapes
from fab.units import NM, UM

# The library's polygons take about 350 bytes each, so this many stay under a gigabyte.
_MOST_AT_ONCE = 2_200_000
_BATCH = 100_000


@dataclass(frozen=True, eq=False)
class LayerReading:
    """One layer as gdstk sees it.

    Attributes:
        cell: the cell of a DOE.
        layer: the layer.
        winding: ``[y, x]`` int32, how many rectangles cover each pixel.
        strays: four-point shapes that are no rectangle on the pixel raster; they are not counted in.
        polygons: shapes with any other number of points, ``(v, 2)`` int64 in database units.
        moved: the shapes as they are, instead of `winding`, of a layer whose edges lie off the pixel raster on purpose.
    """

    cell: str
    layer: Layer
    winding: NDArray[np.int32]
    strays: int
    polygons: list[NDArray[np.int64]]
    moved: Shapes | None = None


def _edge_numbers(values: NDArray[np.int64], edges: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    count = edges.size - 1
    guess = np.rint((values - edges[0]) * (count / (int(edges[-1]) - int(edges[0])))).astype(np.int64)
    numbers = np.clip(guess, 0, count)
    return numbers, edges[numbers] == values


class _Counter:
    """Collects the shapes of one layer of a cell."""

    def __init__(self, cell: str, layer: Layer, edges: PixelEdges) -> None:
        self.cell = cell
        self.layer = layer
        self.edges = edges
        self.steps = np.zeros(edges.y.size * edges.x.size, dtype=np.int32)
        self.strays = 0
        self.polygons: list[NDArray[np.int64]] = []

    def add(self, points_um: NDArray[np.float64]) -> None:
        """Take shapes of equal size, ``(n, v, 2)``."""
        points = np.rint(points_um * (UM / self.edges.dbu_m)).astype(np.int64)
        if points.shape[1] != 4:
            self.polygons.extend(points)
            return
        # The long axis last: numpy is slow along axes of four.
        x, y = np.ascontiguousarray(points.transpose(2, 1, 0))
        # Every side runs along one axis; with a box that is not flat, that leaves only rectangles.
        along = (np.roll(x, -1, axis=0) == x) != (np.roll(y, -1, axis=0) == y)
        (x0, x0_found), (x1, x1_found) = (_edge_numbers(v, self.edges.x) for v in (x.min(axis=0), x.max(axis=0)))
        (y0, y0_found), (y1, y1_found) = (_edge_numbers(v, self.edges.y) for v in (y.min(axis=0), y.max(axis=0)))
        sound = along.all(axis=0) & x0_found & x1_found & y0_found & y1_found & (x0 < x1) & (y0 < y1)
        self.strays += int(np.count_nonzero(~sound))
        x0, x1, y0, y1 = (numbers[sound] for numbers in (x0, x1, y0, y1))
        width = self.edges.x.size
        for rows, columns, step in ((y0, x0, 1), (y0, x1, -1), (y1, x0, -1), (y1, x1, 1)):
            np.add.at(self.steps, rows * width + columns, np.int32(step))

    def reading(self) -> LayerReading:
        """Sum the steps up, in place, and return the reading."""
        winding = self.steps.reshape(self.edges.y.size, self.edges.x.size)
        np.add.accumulate(winding, axis=0, out=winding)
        np.add.accumulate(winding, axis=1, out=winding)
        return LayerReading(self.cell, self.layer, winding[:-1, :-1], self.strays, self.polygons)


class _Collector(_Counter):
    """Collects the shapes of a layer as they are."""

    def __init__(self, cell: str, layer: Layer, edges: PixelEdges) -> None:
        super().__init__(cell, layer, edges)
        self.boxes: list[NDArray[np.int32]] = []

    def add(self, points_um: NDArray[np.float64]) -> None:
        """Take shapes of equal size, ``(n, v, 2)``."""
        boxes, others = _upright(np.rint(points_um * (UM / self.edges.dbu_m)).astype(np.int64))
        self.boxes.append(boxes)
        self.polygons.extend(others)

    def reading(self) -> LayerReading:
        """Return everything that was taken."""
        nothing = np.zeros((0, 0), dtype=np.int32)
        return LayerReading(self.cell, self.layer, nothing, 0, self.polygons, _shapes(self.boxes, self.polygons))


def _upright(points: NDArray[np.int64]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Separate the rectangles x0, y0, x1, y1 from all other polygons ``(n, v, 2)``."""
    low, high = points.min(axis=1), points.max(axis=1)
    sides = np.count_nonzero(points != np.roll(points, -1, axis=1), axis=2)
    upright = (points.shape[1] == 4) & (sides == 1).all(axis=1) & (low < high).all(axis=1)
    return np.concatenate([low, high], axis=1)[upright].astype(np.int32), points[~upright]


def _shapes(boxes: Iterable[NDArray[np.int32]], polygons: Iterable[NDArray[np.int64]]) -> Shapes:
    rects = np.concatenate([np.empty((0, 4), dtype=np.int32), *boxes])
    return Shapes(rects, tuple(polygon.astype(np.int32) for polygon in polygons))


def _runs(polygons: list[Any]) -> Iterator[tuple[Layer, int, list[Any]]]:
    """Cut a list of library polygons where layer or number of points changes, and into batches."""
    # Attributes are fetched without a loop in Python, which would take most of the time.
    layers, datatypes, sizes = (
        np.fromiter(map(attrgetter(name), polygons), dtype=np.int64, count=len(polygons))
        for name in ("layer", "datatype", "size")
    )
    changes = (np.diff(layers) != 0) | (np.diff(datatypes) != 0) | (np.diff(sizes) != 0)
    cuts = {0, len(polygons), *range(0, len(polygons), _BATCH)}
    cuts.update((np.flatnonzero(changes) + 1).tolist())
    bounds = sorted(cuts) if polygons else []
    for start, end in pairwise(bounds):
        first = polygons[start]
        yield Layer(first.layer, first.datatype), first.size, polygons[start:end]


def _joined(polygons: list[Any], size: int) -> NDArray[np.float64]:
    return np.frombuffer(b"".join([p.points for p in polygons]), dtype=np.float64).reshape(-1, size, 2)


def _unfolded(polygons: list[Any], size: int) -> Iterator[NDArray[np.float64]]:
    """Yield the points of polygons with one copy per repetition, in batches."""
    if not any(polygon.repetition.size for polygon in polygons):
        yield _joined(polygons, size)
        return
    origin = np.zeros((1, 2))
    offsets = [polygon.repetition.get_offsets() if polygon.repetition.size else origin for polygon in polygons]
    owners = np.repeat(np.arange(len(polygons)), [len(copies) for copies in offsets])
    shifts = np.concatenate(offsets)
    points_um = _joined(polygons, size)
    for start in range(0, len(owners), _BATCH):
        part = slice(start, start + _BATCH)
        yield points_um[owners[part]] + shifts[part, None, :]


class _Around:
    """Collects the cells around the DOE, layer by layer."""

    def __init__(self, dbu_m: float) -> None:
        self.dbu_m = dbu_m
        self.shapes: dict[str, dict[Layer, list[NDArray[np.int64]]]] = defaultdict(lambda: defaultdict(list))
        self.references: dict[str, tuple[Reference, ...]] = {}

    def add(self, cell: Any) -> None:
        """Take a cell, or a part of it; its references come with every part."""
        self.references[cell.name] = tuple(self._references(cell))
        for polygon in cell.polygons:
            layer = Layer(polygon.layer, polygon.datatype)
            offsets = polygon.repetition.get_offsets() if polygon.repetition.size else np.zeros((1, 2))
            for offset in offsets:
                self.shapes[cell.name][layer].append(self._units(polygon.points + offset))

    def _units(self, points_um: NDArray[np.float64]) -> NDArray[np.int64]:
        return np.rint(points_um * (UM / self.dbu_m)).astype(np.int64)

    def _references(self, cell: Any) -> Iterator[Reference]:
        for reference in cell.references:
            offsets = reference.repetition.get_offsets() if reference.repetition.size else np.zeros((1, 2))
            name = reference.cell_name
            if reference.rotation or reference.x_reflection or reference.magnification != 1:
                name += " (turned, mirrored or scaled)"
            for x, y in self._units(np.asarray(reference.origin) + offsets).tolist():
                yield Reference(name, x, y)

    def cells(self) -> list[Cell]:
        """Return everything."""
        return [
            Cell(name, {layer: _from_polygons(found) for layer, found in self.shapes[name].items()}, references)
            for name, references in self.references.items()
        ]


def _from_polygons(polygons: list[NDArray[np.int64]]) -> Shapes:
    fours = np.array([points for points in polygons if len(points) == 4], dtype=np.int64).reshape(-1, 4, 2)
    boxes, others = _upright(fours)
    return _shapes([boxes], [*others, *(points for points in polygons if len(points) != 4)])


class GdstkReader:
    """A mask file of some cells, read by gdstk.

    The stream must be sound: the library is not safe against broken ones, so this package's own reader goes first.

    Attributes:
        does: the cells of the DOE, each with its layers whose edges lie off the pixel raster on purpose.
        edges: the pixel raster.
        around: the other cells; complete once every reading was taken.
        problems: one sentence per thing that should not be in the file (labels, paths, other layers of the DOE).
    """

    def __init__(self, does: Mapping[str, Collection[Layer]], edges: PixelEdges) -> None:
        self.does, self.edges = does, edges
        self.problems: list[str] = []
        self._around = _Around(edges.dbu_m)

    @property
    def around(self) -> list[Cell]:
        """The cells around the DOE."""
        return self._around.cells()

    def gds(self, path: str | Path, layers: Mapping[Layer, int], others: Iterable[Layer]) -> Iterator[LayerReading]:
        """Read a GDSII file, few enough shapes at a time to bound the memory.

        Args:
            path: the file.
            layers: the layers of the DOE, with the number of shapes expected on each.
            others: all other layers.

        Yields:
            One reading per layer, in the order given, and cell of the DOE.
        """
        waiting = list(layers)
        rest = [(layer.number, layer.datatype) for layer in others if layer not in layers]
        while waiting or rest:
            group = [waiting.pop(0)] if waiting else []
            while waiting and sum(layers[layer] for layer in group) + layers[waiting[0]] <= _MOST_AT_ONCE:
                group.append(waiting.pop(0))
            wanted = {(layer.number, layer.datatype) for layer in group}
            wanted.update(rest)
            rest = []
            yield from self._taken(gdstk.read_gds(str(path), unit=UM, filter=wanted), group)

    def oasis(self, path: str | Path, layers: Iterable[Layer]) -> Iterator[LayerReading]:
        """Read an OASIS file, known to be whole, and unfold its repetitions; yield a reading per layer and cell."""
        yield from self._taken(gdstk.read_oas(str(path), unit=UM), list(layers))

    def _taken(self, library: Any, group: list[Layer]) -> Iterator[LayerReading]:
        if abs(library.precision / self.edges.dbu_m - 1) > 1e-6:
            units = [f"{value / NM:.9g} nm" for value in (library.precision, self.edges.dbu_m)]
            self.problems.append(f"the database unit is {units[0]} instead of {units[1]}")
        counters = {
            (name, layer): (_Collector if layer in moved else _Counter)(name, layer, self.edges)
            for layer in group
            for name, moved in self.does.items()
        }
        for cell in library.cells:
            if cell.labels or cell.paths:
                self.problems.append(f"cell {cell.name} holds labels or paths")
            if cell.name not in self.does:
                self._around.add(cell)
                continue
            if cell.references:
                self.problems.append(f"cell {cell.name} places others")
            for layer, size, polygons in _runs(cell.polygons):
                if layer not in group:
                    self.problems.append(f"layer {layer} of cell {cell.name} holds shapes that should not be there")
                    continue
                for points_um in _unfolded(polygons, size):
                    counters[cell.name, layer].add(points_um)
        for key in list(counters):
            yield counters.pop(key).reading()
