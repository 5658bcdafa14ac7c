"""Comparison of what was read from a mask file with what it should hold; every difference becomes a sentence.

Pure comparisons, no files. The sentences name the layer, how many pixels or shapes differ, and the first.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fab.aperture import Aperture, MaskAperture, RoundAperture, aperture_from
from fab.errors import InputError
from fab.gds.gdstk_reader import LayerReading
from fab.layout.compensation import read_back
from fab.layout.geometry import Cell, Layer, Layout, PixelEdges, Shapes, frame_half, opening_units
from fab.layout.polygons import covered, paint
from fab.manifest.cells import cell_entry, shapes_digest
from fab.manifest.records import CellEntry, DrawnEntry, FileEntry, Manifest, MaskEntry
from fab.units import MM, NM, UM

Drawn = MaskEntry | DrawnEntry


@dataclass(frozen=True, eq=False)
class Expected:
    """Content that the files of an order should have.

    What the manifest should say, the pixels that each etch mask should open ``[bit, y, x]``, and its pixel edges in the
    drawing.
    """

    manifest: Manifest
    planes: NDArray[np.uint8]
    edges: PixelEdges

    def etch_layers(self, entry: FileEntry) -> dict[str, dict[Layer, Drawn]]:
        """Return for every cell of the DOE the etch layers that a file should hold, each with what it draws."""
        return {
            cell: {
                Layer(one.layer, one.datatype): one
                for one in drawn
                if str(Layer(one.layer, one.datatype)) in entry.layers
            }
            for cell, drawn in self.manifest.drawn().items()
        }

    def chrome_layer(self, entry: FileEntry) -> Layer | None:
        """Return the chrome layer if a file should hold it."""
        layer = Layer(self.manifest.chrome.layer, self.manifest.chrome.datatype)
        return layer if str(layer) in entry.layers else None


def _pixel_problems(layer: Layer, differs: NDArray[np.bool_]) -> list[str]:
    count = int(np.count_nonzero(differs))
    if not count:
        return []
    row, column = np.unravel_index(int(np.argmax(differs)), differs.shape)
    noun = "pixel differs" if count == 1 else "pixels differ"
    return [f"layer {layer}: {count} {noun} from the level map, the first at row {row}, column {column}"]


def _count_problem(layer: Layer, count: int, what: str) -> list[str]:
    return [f"layer {layer}: {count} {what}"] if count else []


def _chrome_problems(layer: Layer, drawn: Shapes, expected: Expected) -> list[str]:
    """Check that shapes make the stated chrome: count, opening and outer circle, chords, area, and every vertex."""
    chrome, dbu_m, polygons = expected.manifest.chrome, expected.edges.dbu_m, drawn.polygons
    opening, outer = aperture_from(chrome.opening_diameter_mm, MM), chrome.outer_diameter_mm * MM / 2 / dbu_m
    if len(drawn) != chrome.polygons:
        return [f"layer {layer}: {len(drawn)} chrome polygons instead of {chrome.polygons}"]
    if not isinstance(opening, MaskAperture):
        problems = _count_problem(layer, len(drawn.rectangles), "rectangles in the chrome")
    else:
        problems = _mask_problems(layer, drawn.rectangles, opening, expected.edges)
    if not polygons:
        return [*problems, f"layer {layer}: no chrome polygons"]
    x, y = np.concatenate(polygons).astype(np.float64).T
    # A vertex is rounded by up to half a unit in x and in y.
    on_outer = np.abs(np.hypot(x, y) - outer) <= 1
    chord = chrome.chord_error_nm * NM / dbu_m + 1
    on_inner, inner_edge = _on_opening(opening, x, y, chord, dbu_m)
    outline = "circle" if isinstance(opening, RoundAperture) else "outline"
    stray = int(np.count_nonzero(~(on_inner | on_outer)))
    problems += _count_problem(layer, stray, f"chrome vertices lie on neither of the two {outline}s")
    for name, edge in (("opening", inner_edge), ("outer edge", _off_circle(outer, x[on_outer], y[on_outer], chord))):
        if edge:
            problems.append(f"layer {layer}: the {name} leaves its {outline} by {edge * dbu_m / NM:.3g} nm")
    area = drawn.doubled_area / 2
    off = abs(area - (math.pi * outer**2 - opening.area_in(dbu_m)))
    if off > 2 * math.pi * (outer + opening.reach_m / dbu_m) * chord:
        problems.append(f"layer {layer}: the chrome area is off by {off * (dbu_m / UM) ** 2:.6g} um^2")
    if shapes_digest(drawn) != chrome.shapes_sha256:
        problems.append(f"layer {layer}: the chrome has another vertex, or one elsewhere")
    return problems


def _mask_problems(layer: Layer, boxes: NDArray[np.int32], opening: MaskAperture, edges: PixelEdges) -> list[str]:
    """Check that rectangles fill, once, what is not open of the frame around a mask."""
    area, half = opening_units(opening, edges), frame_half(opening, edges.dbu_m)
    x, y = (np.concatenate([[-half], axis, [half]]) for axis in (area.x, area.y))
    found, open_ = covered(boxes, x, y), np.pad(area.cells, 1)
    counts = {
        "rectangles in the chrome are off the edges of the opening": found.strays,
        "cells of the opening are covered by chrome": np.count_nonzero(open_ & (found.cells > 0)),
        "cells around the opening are not covered": np.count_nonzero(~open_ & (found.cells == 0)),
        "cells of the chrome are covered again": found.overlaps,
    }
    return [problem for what, count in counts.items() for problem in _count_problem(layer, int(count), what)]


def _off_circle(radius: float, x: NDArray[np.float64], y: NDArray[np.float64], chord: float) -> float:
    """Return by how much the chords between vertices on a circle leave it, 0 if by no more than they may; units."""
    angle = np.sort(np.arctan2(y, x))
    widest = np.max(np.diff(angle, append=angle[:1] + 2 * math.pi), initial=0.0) if angle.size else 2 * math.pi
    sagitta = radius * (1 - math.cos(min(widest, 2 * math.pi) / 2))
    return sagitta if sagitta > chord else 0.0


def _on_opening(
    opening: Aperture, x: NDArray[np.float64], y: NDArray[np.float64], chord: float, dbu_m: float
) -> tuple[NDArray[np.bool_], float]:
    """Return which vertices lie on the rim of the opening or on its frame, and how far it leaves its outline; units."""
    if isinstance(opening, RoundAperture):
        radius = opening.diameter_m / 2 / dbu_m
        on_rim = np.abs(np.hypot(x, y) - radius) <= 1
        return on_rim, _off_circle(radius, x[on_rim], y[on_rim], chord)
    on_frame = np.maximum(np.abs(x), np.abs(y)) == frame_half(opening, dbu_m)
    if isinstance(opening, MaskAperture):  # its cells are rectangles
        return on_frame, 0.0
    # Its sides are whole units, but for the digits of the manifest.
    half_y, half_x = (side / 2 / dbu_m for side in opening.extent_m)
    on_rim = np.abs(np.maximum(np.abs(x) - half_x, np.abs(y) - half_y)) <= 0.1
    corners = [np.hypot(x[on_rim] - sx * half_x, y[on_rim] - sy * half_y) for sx in (-1, 1) for sy in (-1, 1)]
    farthest = max(float(corner.min(initial=math.inf)) for corner in corners)
    return on_rim | on_frame, farthest if farthest > 0.1 else 0.0


def _etch_problems(layer: Layer, shapes: Shapes, mask: Drawn, expected: Expected) -> list[str]:
    """Compare one etch layer, as the own reader found it, with its plane."""
    missing = abs(len(shapes) - mask.polygons)
    counted = _count_problem(layer, missing, f"polygons more or less than the {mask.polygons} of the manifest")
    if mask.edge_move_nm:
        return counted + _moved_problems(layer, shapes, mask, expected)
    canvas = np.zeros(expected.planes.shape[1:], dtype=np.uint8)
    painted = paint(shapes.rectangles, expected.edges.x, expected.edges.y, 0, canvas)
    return [
        *counted,
        *_count_problem(layer, len(shapes.polygons), "shapes are no rectangles"),
        *_count_problem(
            layer, painted.strays, f"rectangles are off the pixel raster, the first is number {painted.first_stray}"
        ),
        *_count_problem(layer, painted.overlaps, "pixels are covered more than once"),
        *_pixel_problems(layer, canvas != expected.planes[mask.bit]),
    ]


def _moved_problems(layer: Layer, shapes: Shapes, mask: Drawn, expected: Expected) -> list[str]:
    """Compare one etch layer whose edges were moved against the bias of the process: moved back, it is its plane."""
    try:
        plane = read_back(shapes, expected.edges, round(mask.edge_move_nm / expected.manifest.dbu_nm))
    except InputError as error:
        return [f"layer {layer}: {error.rule}, but got {error.got}"]
    return _pixel_problems(layer, plane != expected.planes[mask.bit])


def layout_problems(layout: Layout, entry: FileEntry, expected: Expected) -> list[str]:
    """Compare a file, as this package's own reader found it, with what it should hold; one sentence per difference."""
    problems = []
    if layout.top.name != entry.cell:
        problems.append(f"the top cell is named {layout.top.name!r} instead of {entry.cell!r}")
    if abs(layout.dbu_m / expected.edges.dbu_m - 1) > 1e-9:
        right = expected.edges.dbu_m
        problems.append(f"the database unit is {layout.dbu_m / NM:.9g} nm instead of {right / NM:.9g} nm")
    etch = expected.etch_layers(entry)
    others = (cell for cell in layout.cells if cell.name not in etch)
    problems += cell_problems(others, entry, expected.edges.dbu_m)
    for name, layers in etch.items():
        problems += _doe_problems(layout.cell(name), name, layers, expected.chrome_layer(entry), expected)
    return problems


def _doe_problems(
    doe: Cell | None, name: str, etch: Mapping[Layer, Drawn], chrome: Layer | None, expected: Expected
) -> list[str]:
    """Compare one cell of the DOE with what it should draw."""
    if doe is None:
        return [f"cell {name} is missing"]
    problems = [f"cell {name} places others"] if doe.references else []
    for layer, shapes in doe.shapes.items():
        if layer not in etch and layer != chrome:
            problems += _count_problem(layer, len(shapes), "shapes on a layer that should be empty")
    for layer, mask in etch.items():
        problems += _etch_problems(layer, doe.shapes.get(layer, Shapes()), mask, expected)
    if chrome is not None:
        problems += _chrome_problems(chrome, doe.shapes.get(chrome, Shapes()), expected)
    # A split has the layers of the DOE itself, so its problems need its name.
    return problems if name == expected.manifest.doe_cell else [f"cell {name}: {problem}" for problem in problems]


def cell_problems(cells: Iterable[Cell], entry: FileEntry, dbu_m: float) -> list[str]:
    """Compare the cells around the DOE (marks, labels, dies, photomask) with the manifest; a sentence each."""
    found = {cell.name: cell_entry(cell, dbu_m) for cell in cells}
    stated = {cell.cell: cell for cell in entry.cells}
    problems = [f"cell {name} should not be there" for name in sorted(set(found) - set(stated))]
    problems += [f"cell {name} is missing" for name in sorted(set(stated) - set(found))]
    for name in stated.keys() & found.keys():
        problems += _entry_problems(found[name], stated[name])
    return problems


def _entry_problems(found: CellEntry, stated: CellEntry) -> list[str]:
    where = f"cell {stated.cell}"
    problems = [] if found.places == stated.places else [f"{where}: it places other cells, or elsewhere"]
    here, wanted = ({layer.layer: layer for layer in one.layers} for one in (found, stated))
    for name in sorted(here.keys() | wanted.keys()):
        have, want = here.get(name), wanted.get(name)
        if have is None or want is None:
            problems.append(f"{where}: layer {name} {'is missing' if have is None else 'should be empty'}")
        elif have != want:
            count = f"{have.polygons} shapes of {have.area_um2:.6g} um^2"
            problems.append(
                f"{where}: layer {name}: {count} instead of {want.polygons} of {want.area_um2:.6g} um^2, or elsewhere"
            )
    return problems


def reading_problems(reading: LayerReading, entry: FileEntry, expected: Expected) -> list[str]:
    """Compare one layer, as the other library found it, with what it should hold; one sentence per difference."""
    problems = _reading_problems(reading, expected.etch_layers(entry)[reading.cell].get(reading.layer), expected)
    whole = reading.cell == expected.manifest.doe_cell
    return problems if whole else [f"cell {reading.cell}: {problem}" for problem in problems]


def _reading_problems(reading: LayerReading, mask: Drawn | None, expected: Expected) -> list[str]:
    layer = reading.layer
    if mask is not None and mask.edge_move_nm:
        return _moved_problems(layer, reading.shapes, mask, expected)
    if mask is None:
        return _chrome_problems(layer, reading.shapes, expected)
    winding = reading.winding
    problems = _count_problem(layer, reading.strays, "shapes are no rectangles on the pixel raster")
    problems += _count_problem(layer, len(reading.polygons), "shapes are no rectangles")
    problems += _count_problem(layer, int(np.count_nonzero(winding > 1)), "pixels are covered more than once")
    return problems + _pixel_problems(layer, (winding > 0) != expected.planes[mask.bit])
