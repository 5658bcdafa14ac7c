"""Mask files read by gdstk, a library that had no part in writing them.

Everything here relies on gdstk and numpy alone and shares no code with the writer, the reader or the painter of this
package: a mistake in those cannot hide itself. Rectangles are counted into a winding number per pixel by a difference
array and two running sums; a sound plane has 0 and 1 only.

OASIS keeps repeated shapes folded. They are unfolded here by the library's own list of offsets; reading the polygons
alone would silently miss most of a mask.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any

import gdstk
import numpy as np
from numpy.typing import NDArray

from fab.layout.geometry import Cell, Layer, PixelEdges, Reference, Shapes
from fab.layout.limits import Tally
from fab.units import NM, UM

# The library's polygons take about 350 bytes each, so this many stay under a gigabyte.
_MOST_AT_ONCE = 2_200_000
_BATCH = 100_000

# Rectangles and other polygons of one layer of a cell, batch by batch.
_Taken = tuple[list[NDArray[np.int32]], list[NDArray[np.int64]]]


@dataclass(frozen=True, eq=False)
class LayerReading:
    """One layer of a cell of a DOE as gdstk sees it; `edges` is the pixel raster."""

    cell: str
    layer: Layer
    shapes: Shapes
    edges: PixelEdges

    @property
    def polygons(self) -> list[NDArray[np.int32]]:
        """Shapes with any other number of points than four."""
        return [polygon for polygon in self.shapes.polygons if len(polygon) != 4]

    @property
    def strays(self) -> int:
        """Number of four-point shapes that are no rectangle on the pixel raster; `winding` leaves them out."""
        return self._counted[1] + len(self.shapes.polygons) - len(self.polygons)

    @property
    def winding(self) -> NDArray[np.int32]:
        """``[y, x]`` how many rectangles cover each pixel."""
        return self._counted[0]

    @cached_property
    def _counted(self) -> tuple[NDArray[np.int32], int]:
        """Windings, and the number of rectangles off the raster."""
        xs, ys = self.edges.x, self.edges.y
        steps, strays = np.zeros(ys.size * xs.size, dtype=np.int32), 0
        for start in range(0, len(self.shapes.rectangles), _BATCH):
            boxes = self.shapes.rectangles[start : start + _BATCH].astype(np.int64)
            numbers, found = zip(*map(_edge_numbers, boxes.T, (xs, ys, xs, ys)), strict=True)
            sound = np.logical_and.reduce(found)
            strays += int(np.count_nonzero(~sound))
            x0, y0, x1, y1 = (number[sound] for number in numbers)
            for rows, columns, step in ((y0, x0, 1), (y0, x1, -1), (y1, x0, -1), (y1, x1, 1)):
                np.add.at(steps, rows * xs.size + columns, np.int32(step))
        winding = steps.reshape(ys.size, xs.size)
        np.add.accumulate(winding, axis=0, out=winding)
        np.add.accumulate(winding, axis=1, out=winding)
        return winding[:-1, :-1], strays


def _edge_numbers(values: NDArray[np.int64], edges: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    count = edges.size - 1
    guess = np.rint((values - edges[0]) * (count / (int(edges[-1]) - int(edges[0])))).astype(np.int64)
    numbers = np.clip(guess, 0, count)
    return numbers, edges[numbers] == values


def _separated(points: NDArray[np.int64]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Separate the rectangles x0, y0, x1, y1 from all other polygons ``(n, v, 2)``."""
    # The long axis last: numpy is slow along axes of four.
    x, y = np.ascontiguousarray(points.transpose(2, 1, 0))
    x0, y0, x1, y1 = x.min(axis=0), y.min(axis=0), x.max(axis=0), y.max(axis=0)
    # Every side runs along one axis; with a box that is not flat, that leaves only rectangles.
    along = (np.roll(x, -1, axis=0) == x) != (np.roll(y, -1, axis=0) == y)
    upright = (len(x) == 4) & along.all(axis=0) & (x0 < x1) & (y0 < y1)
    return np.stack([x0, y0, x1, y1], axis=1)[upright].astype(np.int32), points[~upright]


def _shapes(taken: _Taken) -> Shapes:
    boxes, polygons = taken
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


def _unfold_to(folded: Iterable[Any]) -> int:
    """Count shapes or references with their repetitions."""
    return sum(one.repetition.size or 1 for one in folded)


def _offsets(one: Any) -> NDArray[np.float64]:
    return one.repetition.get_offsets() if one.repetition.size else np.zeros((1, 2))


def _unfolded(polygons: list[Any], size: int) -> Iterator[NDArray[np.float64]]:
    """Yield the points of polygons with one copy per repetition, in batches."""
    points_um = np.frombuffer(b"".join([p.points for p in polygons]), dtype=np.float64).reshape(-1, size, 2)
    if not any(polygon.repetition.size for polygon in polygons):
        yield points_um
        return
    offsets = [_offsets(polygon) for polygon in polygons]
    owners = np.repeat(np.arange(len(polygons)), [len(copies) for copies in offsets])
    shifts = np.concatenate(offsets)
    for start in range(0, len(owners), _BATCH):
        part = slice(start, start + _BATCH)
        yield points_um[owners[part]] + shifts[part, None, :]


class GdstkReader:
    """A mask file of some cells of the DOE on a pixel raster, read by gdstk.

    The stream must be sound: the library is not safe against broken ones, so this package's own reader goes first.
    `problems` has a sentence per thing that should not be in the file (labels, paths, other layers of the DOE).
    """

    def __init__(self, does: Collection[str], edges: PixelEdges) -> None:
        self.does, self.edges = does, edges
        self.problems: list[str] = []
        self._around: dict[str, dict[Layer, _Taken]] = defaultdict(lambda: defaultdict(lambda: ([], [])))
        self._references: dict[str, tuple[Reference, ...]] = {}

    @property
    def around(self) -> list[Cell]:
        """The cells around the DOE; complete once every reading was taken."""
        return [
            Cell(name, {layer: _shapes(taken) for layer, taken in self._around[name].items()}, references)
            for name, references in self._references.items()
        ]

    def gds(self, path: str | Path, layers: Mapping[Layer, int], others: Iterable[Layer]) -> Iterator[LayerReading]:
        """Read a GDSII file, few enough shapes at a time to bound the memory.

        `layers` are those of the DOE with the number of shapes expected on each, `others` all other ones. Yields one
        reading per layer, in the order given, and cell of the DOE.
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
            yield from self._read(gdstk.read_gds(str(path), unit=UM, filter=wanted), group)

    def oasis(self, path: str | Path, layers: Iterable[Layer], most: int = 10**8) -> Iterator[LayerReading]:
        """Read an OASIS file, known to be whole, and unfold its repetitions; yield a reading per layer and cell.

        Raises:
            InputError: it stands for more than `most` shapes, or more than `fab.layout.limits` allows.
        """
        library = gdstk.read_oas(str(path), unit=UM)
        tally = Tally(str(path), {"shapes": most})
        cells: list[Any] = library.cells
        tally.add("cells", len(cells))
        for cell in cells:
            tally.add("placed copies", _unfold_to(cell.references))
            tally.add("shapes", _unfold_to(cell.polygons))
            tally.add("polygons that are no rectangles", _unfold_to(one for one in cell.polygons if one.size != 4))
        yield from self._read(library, list(layers))

    def _read(self, library: Any, group: list[Layer]) -> Iterator[LayerReading]:
        if abs(library.precision / self.edges.dbu_m - 1) > 1e-6:
            units = [f"{value / NM:.9g} nm" for value in (library.precision, self.edges.dbu_m)]
            self.problems.append(f"the database unit is {units[0]} instead of {units[1]}")
        found: dict[tuple[str, Layer], _Taken] = {(name, layer): ([], []) for layer in group for name in self.does}
        for cell in library.cells:
            if cell.labels or cell.paths:
                self.problems.append(f"cell {cell.name} holds labels or paths")
            around = cell.name not in self.does
            if around:
                self._references[cell.name] = tuple(self._placed(cell))
            elif cell.references:
                self.problems.append(f"cell {cell.name} places others")
            for layer, size, polygons in _runs(cell.polygons):
                taken = self._around[cell.name][layer] if around else found.get((cell.name, layer))
                if taken is None:
                    self.problems.append(f"layer {layer} of cell {cell.name} holds shapes that should not be there")
                    continue
                for points_um in _unfolded(polygons, size):
                    boxes, others = _separated(self._units(points_um))
                    taken[0].append(boxes)
                    taken[1].extend(others)
        for cell, layer in list(found):
            yield LayerReading(cell, layer, _shapes(found.pop((cell, layer))), self.edges)

    def _units(self, points_um: NDArray[np.float64]) -> NDArray[np.int64]:
        return np.rint(points_um * (UM / self.edges.dbu_m)).astype(np.int64)

    def _placed(self, cell: Any) -> Iterator[Reference]:
        """Yield the references of a cell, one per copy."""
        for reference in cell.references:
            name = reference.cell_name
            if reference.rotation or reference.x_reflection or reference.magnification != 1:
                name += " (turned, mirrored or scaled)"
            for x, y in self._units(np.asarray(reference.origin) + _offsets(reference)).tolist():
                yield Reference(name, x, y)
