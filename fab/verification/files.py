"""Every mask file and model of an order, read back and compared pixel by pixel with the level map.

Three questions are put to each mask file, and all of them are always asked, so that a report says not
only that a file changed but also what in the drawing is different:

1. Are its bytes those of the manifest (SHA-256)?
2. Read by this package's own reader, do its polygons give the stored level map, pixel by pixel, without
   an overlap, an edge off the raster, or a shape that does not belong there? Can every shape be written, and is all of
   it on the blank (`fab.verification.shop_checks`)?
3. Does a library that had no part in the writing (gdstk) see the same?

gdstk is not safe against broken streams. It is therefore given only GDSII files that the own reader
accepts, and OASIS files whose bytes are those of the manifest, and those in a process of its own with limits
of time and memory (`fab.verification.child`). An altered OASIS file, or one that gdstk cannot take, goes
through KLayout, which refuses what is broken, and then through the own reader, in such a process, too.
"""

import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fab.errors import CheckFailed, InputError
from fab.files import read_npy, sha256_file
from fab.gds.gdstk_reader import GdstkReader
from fab.gds.reader import read_gds
from fab.gds.writer import oasis_to_gds
from fab.layout.compensation import read_back
from fab.layout.geometry import Layer, PixelEdges, pixel_edges
from fab.layout.limits import MOST_AROUND
from fab.layout.polygons import paint
from fab.level_map import level_digest
from fab.levels import Levels
from fab.manifest.records import FileEntry, Manifest
from fab.solids.model import DoeModel
from fab.solids.write import model_problems
from fab.units import MM
from fab.verification.child import Child, ChildFailed, TooMuch, child_process, limited
from fab.verification.compare import Expected, cell_problems, layout_problems, reading_problems
from fab.verification.report import Check
from fab.verification.shop_checks import drawing_problems

_GDS, _OASIS = "GDSII", "OASIS"


def check_bytes(folder: Path, entry: FileEntry) -> Check:
    """Compare size and digest of a file with the manifest."""
    path, problems = folder / entry.file, ()
    if path.is_symlink():
        problems = ("it is a link to elsewhere",)
    elif not path.is_file():
        problems = ("the file is missing",)
    elif path.stat().st_size != entry.bytes:
        problems = (f"{path.stat().st_size} bytes instead of {entry.bytes}",)
    elif sha256_file(path) != entry.sha256:
        problems = ("the SHA-256 differs",)
    return Check(entry.file, "bytes as in the manifest", problems)


def _stored_levels(folder: Path, manifest: Manifest) -> NDArray[np.uint8] | None:
    """Return the stored level numbers if they can be those of this order, whatever their digest."""
    try:
        stored = read_npy(folder / manifest.level_map_file)
    except InputError:
        return None
    fits = stored.dtype == np.uint8 and list(stored.shape) == manifest.shape
    return stored if fits and stored.max() < manifest.levels else None


def read_drawn_levels(
    path: str | Path, levels: Levels, edges: PixelEdges, cell: str, moves: Sequence[int] = ()
) -> NDArray[np.uint8]:
    """Rebuild the level numbers ``[y, x]`` that a cell of a combined GDSII file draws, bit k on layer k + 1.

    Edges of the masks were moved outward by `moves`, database units (`Manifest.edge_moves`).

    Raises:
        InputError: the file is missing or corrupt, or draws something else than a plane of pixels.
    """
    etched = np.zeros((edges.y.size - 1, edges.x.size - 1), dtype=np.uint8)
    drawn = read_gds(path).cell(cell)
    if drawn is None:
        raise InputError(str(path), f"must hold the cell {cell}", "none of that name", "Write the order again.")
    for bit, move in zip(range(levels.bits), moves or (0,) * levels.bits, strict=True):
        shapes = drawn.shapes.get(Layer(bit + 1))
        if shapes is None:
            continue
        if move:
            etched |= read_back(shapes, edges, move) << np.uint8(bit)
            continue
        painted = paint(shapes.rectangles, edges.x, edges.y, bit, etched)
        if shapes.polygons or painted.strays or painted.overlaps:
            rule = f"layer {bit + 1}/0 must hold separate rectangles on the pixel raster"
            got = f"{len(shapes.polygons) + painted.strays} other shapes and {painted.overlaps} pixels covered twice"
            raise InputError(str(path), rule, got, "Write the order again.")
    return np.uint8(levels.count - 1) - etched


def reference_level(folder: Path, manifest: Manifest) -> tuple[NDArray[np.uint8], Check]:
    """Return the level numbers ``[y, x]`` to compare with, and whether the stored ones are those of the manifest.

    A damaged copy must not put the blame on the masks: the map drawn in the combined file may be the right one.

    Raises:
        CheckFailed: neither holds the map of the manifest.
    """
    stored = _stored_levels(folder, manifest)
    question = "the level map as in the manifest"
    if stored is not None and level_digest(stored) == manifest.level_map_sha256:
        return stored, Check(manifest.level_map_file, question, ())
    failed = Check(manifest.level_map_file, question, ("the level map is unreadable or its digest differs",))
    levels, edges = manifest.staircase(), pixel_edges(manifest.grid())
    try:
        moves = manifest.edge_moves()
        drawn = read_drawn_levels(folder / manifest.combined_gds, levels, edges, manifest.doe_cell, moves)
    except InputError:
        drawn = None
    if drawn is not None and level_digest(drawn) == manifest.level_map_sha256:
        return drawn, failed
    if stored is not None:
        return stored, failed
    raise CheckFailed([f"{failed.file}: {problem}; no other file holds that map" for problem in failed.problems])


def _own_check(path: Path, entry: FileEntry, expected: Expected) -> tuple[Check, bool]:
    """Return what the own reader finds, and whether the file is fit for a library that trusts it."""
    question = "own reader, every pixel"
    try:
        layout = read_gds(path)
    except InputError as error:
        problem = f"it cannot be read: {error.rule}, but got {error.got}"
        return Check(entry.file, question, (problem,)), False
    fit = abs(layout.dbu_m / expected.edges.dbu_m - 1) < 1e-9
    blank_m = expected.manifest.wafer.blank_mm * MM
    problems = layout_problems(layout, entry, expected) + drawing_problems(layout, blank_m)
    return Check(entry.file, question, tuple(problems)), fit


def _most_shapes(entry: FileEntry, expected: Expected) -> int:
    """Twice the shapes that the manifest states for a file: more are not unfolded to see how they differ.

    A manifest that states more than a rectangle per pixel and what the other cells may hold is not believed.
    """
    around = sum(one.polygons for cell in entry.cells for one in cell.layers)
    does = expected.manifest.drawn().values()
    etched = sum(one.polygons for drawn in does for one in drawn)
    stated = etched + len(does) * expected.manifest.chrome.polygons + around
    return 2 * min(stated, len(does) * expected.planes.size + MOST_AROUND)


def _altered_oasis(path: Path, entry: FileEntry, expected: Expected, scratch: Path) -> Check:
    gds = scratch / f"{entry.file}.gds"
    try:
        oasis_to_gds(path, gds, _most_shapes(entry, expected))
    except InputError as error:
        return Check(entry.file, "KLayout and own reader", (f"it cannot be read: {error.rule}, but got {error.got}",))
    return _own_check(gds, entry, expected)[0]


def _library_check(path: Path, entry: FileEntry, expected: Expected) -> Check:
    layers: Counter[Layer] = Counter()
    for drawn in expected.etch_layers(entry).values():
        layers.update({layer: mask.polygons for layer, mask in drawn.items()})
    chrome = expected.chrome_layer(entry)
    if chrome is not None:
        layers[chrome] = expected.manifest.chrome.polygons
    again = GdstkReader(expected.etch_layers(entry), expected.edges)
    numbers = [tuple(map(int, one.layer.split("/"))) for cell in entry.cells for one in cell.layers]
    others = dict.fromkeys(Layer(number, datatype) for number, datatype in numbers)
    if entry.format == _OASIS:
        readings = again.oasis(path, layers, _most_shapes(entry, expected))
    else:
        readings = again.gds(path, layers, others)
    try:
        problems = [problem for reading in readings for problem in reading_problems(reading, entry, expected)]
    except InputError as error:
        problems = [f"it cannot be read: {error.rule}, but got {error.got}"]
    else:
        problems += again.problems + cell_problems(again.around, entry, expected.edges.dbu_m)
    return Check(entry.file, "gdstk, every pixel", tuple(problems))


def _check_oasis(
    child: Child, path: Path, entry: FileEntry, intact: bool, expected: Expected, scratch: Path
) -> Callable[[], Check]:
    """Begin to check an OASIS file in a child process; return what waits for the result."""
    shapes = _most_shapes(entry, expected)
    path = path.absolute()  # the child may work in another folder
    works = [(_library_check, path, entry, expected), (_altered_oasis, path, entry, expected, scratch)]
    first, *others = works if intact else works[1:]
    begun = child.begin(limited, shapes, *first)

    def wait() -> Check:
        try:
            return child.result(begun, shapes)
        except TooMuch as error:
            return Check(entry.file, "OASIS", (f"it cannot be read: {error}",))
        except ChildFailed as error:
            problems = [f"it cannot be read: {error}"]
        for other in others:
            try:
                found = child.result(child.begin(limited, shapes, *other), shapes)
                return replace(found, problems=(*problems, *found.problems))
            except ChildFailed as error:
                problems.append(f"nor by KLayout: {error}")
        return Check(entry.file, "OASIS", tuple(problems))

    return wait


def _check_mask_file(folder: Path, entry: FileEntry, expected: Expected) -> list[Check]:
    path = folder / entry.file
    if not path.is_file():
        return []
    own, fit = _own_check(path, entry, expected)
    return [own, _library_check(path, entry, expected)] if fit else [own]


def check_files(folder: Path, expected: Expected, doe: DoeModel, intact: Mapping[str, bool]) -> list[Check]:
    """Read every mask file and every model of an order, and compare it with what it should hold.

    `doe` is what the models show; `intact` says of every file whether its bytes are those of the manifest.
    """
    checks = []
    files = [entry for entry in expected.manifest.files if (folder / entry.file).is_file()]
    with tempfile.TemporaryDirectory(prefix="doedesign-verify-") as scratch, child_process() as child:
        begun = {
            entry.file: _check_oasis(child, folder / entry.file, entry, intact[entry.file], expected, Path(scratch))
            for entry in files
            if entry.format == _OASIS
        }
        for entry in files:
            if entry.format == _GDS:
                checks += _check_mask_file(folder, entry, expected)
            elif entry.file in begun:
                checks.append(begun[entry.file]())
    for model in expected.manifest.models:
        # Libraries of solids and pictures are given whole files only.
        if intact[model.file]:
            problems = model_problems(folder, model, doe)
            checks.append(Check(model.file, "read back, volume or every height", tuple(problems)))
    return checks
