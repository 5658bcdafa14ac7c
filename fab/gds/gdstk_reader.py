"""Mask files read by gdstk, a library that had no part in writing them.

Everything here relies on gdstk and numpy alone and shares no code with the writer, the reader or the painter of this
package: a mistake in those cannot hide itself. Rectangles are counted into a winding number per pixel by a difference
array and two running sums; a sound plane has 0 and 1 only.

The library hands out shapes slowly, a million in seconds. It is made to write what it read as a plain stream instead,
repetitions of OASIS unfolded (`fab.gds.plain`).
"""

import gzip
import shutil
import struct
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import gdstk
import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.files import scratch_folder
from fab.gds.plain import PlainCell, plain_cells
from fab.layout.arrays import cell_name
from fab.layout.geometry import Cell, Layer, PixelEdges, Reference, Shapes
from fab.layout.limits import Tally
from fab.units import NM, UM

# The library's polygons take about 200 bytes each, so this many stay under half a gigabyte.
_MOST_AT_ONCE = 2_200_000
_BATCH = 100_000

# Rectangles and other polygons of one layer of a cell, batch by batch.
_Taken = tuple[list[NDArray[np.int32]], list[NDArray[np.int32]]]


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


def _separated(points: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Separate the rectangles x0, y0, x1, y1 from all other polygons ``(n, v, 2)``."""
    # The long axis last: numpy is slow along axes of four.
    x, y = np.ascontiguousarray(points.transpose(2, 1, 0))
    x0, y0, x1, y1 = x.min(axis=0), y.min(axis=0), x.max(axis=0), y.max(axis=0)
    # Every side runs along one axis; with a box that is not flat, that leaves only rectangles.
    along = (np.roll(x, -1, axis=0) == x) != (np.roll(y, -1, axis=0) == y)
    upright = (len(x) == 4) & along.all(axis=0) & (x0 < x1) & (y0 < y1)
    return np.stack([x0, y0, x1, y1], axis=1)[upright], points[~upright]


def _shapes(taken: _Taken) -> Shapes:
    boxes, polygons = taken
    rects = np.concatenate([np.empty((0, 4), dtype=np.int32), *boxes])
    return Shapes(rects, tuple(polygons))


def _unfold_to(folded: Iterable[Any]) -> int:
    """Count shapes or references with their repetitions."""
    return sum(one.repetition.size or 1 for one in folded)


@contextmanager
def _unpacked(path: str | Path, scratch: Path | None) -> Iterator[Path]:
    """Provide a file that may be packed by gzip, unpacked."""
    if Path(path).suffix != ".gz":
        yield Path(path)
        return
    with scratch_folder(scratch) as folder:
        plain = folder / "unpacked.gds"
        with gzip.open(path) as packed, plain.open("wb") as stream:
            shutil.copyfileobj(packed, stream, 1 << 20)
        yield plain


def _cells(library: Any, scratch: Path | None) -> list[PlainCell]:
    """Return what a library holds, unfolded."""
    with scratch_folder(scratch) as folder:
        path = folder / "unfolded.gds"
        library.write_gds(str(path), max_points=0)
        try:
            return list(plain_cells(path))
        except (ValueError, struct.error) as error:
            # The library does not say so where a disk is full.
            rule = "must have room for the file unfolded"
            raise InputError(str(folder), rule, str(error), "Free some space there.") from error


class GdstkReader:
    """A mask file of some cells of the DOE on a pixel raster, read by gdstk.

    The stream must be sound: the library is not safe against broken ones, so this package's own reader goes first.
    `problems` has a sentence per thing that should not be in the file (labels, paths, other layers of the DOE).
    Files are unpacked and unfolded in `scratch`, a folder; by default in that of the system.
    """

    def __init__(self, does: Collection[str], edges: PixelEdges, scratch: Path | None = None) -> None:
        self.does, self.edges, self.scratch = does, edges, scratch
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

    def gds(
        self, path: str | Path, layers: Mapping[Layer, int], others: Iterable[Layer], most: int = 10**8
    ) -> Iterator[LayerReading]:
        """Read a GDSII file, few enough shapes at a time to bound the memory; unpack it first if it ends in .gz.

        `layers` are those of the DOE with the number of shapes expected on each, `others` all other ones. Yields one
        reading per layer, in the order given, and cell of the DOE.

        Raises:
            InputError: copies of one cell in those of the DOE stand for more than `most` shapes.
        """
        waiting = list(layers)
        rest = [(layer.number, layer.datatype) for layer in others if layer not in layers]
        with _unpacked(path, self.scratch) as plain:
            while waiting or rest:
                group = [waiting.pop(0)] if waiting else []
                while waiting and sum(layers[layer] for layer in group) + layers[waiting[0]] <= _MOST_AT_ONCE:
                    group.append(waiting.pop(0))
                wanted = {(layer.number, layer.datatype) for layer in group}
                wanted.update(rest)
                rest = []
                yield from self._read(
                    gdstk.read_gds(str(plain), unit=UM, filter=wanted), group, Tally(str(path), {"shapes": most})
                )

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
        yield from self._read(library, list(layers), tally)

    def _unfold(self, library: Any, tally: Tally) -> None:
        """Have the library draw into the cells of the DOE what they repeat (`fab.layout.arrays`)."""
        for doe in [cell for cell in library.cells if cell.name in self.does and cell.references]:
            one, *others = {reference.cell_name: reference.cell for reference in doe.references}.values()
            if others or one.name != cell_name(doe.name) or one.references:
                continue
            tally.add("shapes", _unfold_to(doe.references) * _unfold_to(one.polygons))
            doe.flatten()
            library.remove(one)

    def _read(self, library: Any, group: list[Layer], tally: Tally) -> Iterator[LayerReading]:
        if abs(library.precision / self.edges.dbu_m - 1) > 1e-6:
            units = [f"{value / NM:.9g} nm" for value in (library.precision, self.edges.dbu_m)]
            self.problems.append(f"the database unit is {units[0]} instead of {units[1]}")
        # What a coordinate means is compared, whatever the unit it was written in.
        library.precision = self.edges.dbu_m
        odd = {cell.name for cell in library.cells if cell.labels or cell.paths}
        self._unfold(library, tally)
        found: dict[tuple[str, Layer], _Taken] = {(name, layer): ([], []) for layer in group for name in self.does}
        for cell in _cells(library, self.scratch):
            if cell.name in odd or cell.others:
                self.problems.append(f"cell {cell.name} holds labels or paths")
            around = cell.name not in self.does
            if around:
                self._references[cell.name] = cell.references
            elif cell.references:
                self.problems.append(f"cell {cell.name} places others")
            for layer, parts in cell.polygons.items():
                taken = self._around[cell.name][layer] if around else found.get((cell.name, layer))
                if taken is None:
                    self.problems.append(f"layer {layer} of cell {cell.name} holds shapes that should not be there")
                    continue
                for points in parts:
                    for start in range(0, len(points), _BATCH):
                        boxes, others = _separated(points[start : start + _BATCH])
                        taken[0].append(boxes)
                        taken[1].extend(others)
        for cell, layer in list(found):
            yield LayerReading(cell, layer, _shapes(found.pop((cell, layer))), self.edges)
