"""Every mask file and model of an order, read back and compared pixel by pixel with the level map.

Three questions are put to each mask file, and all of them are always asked, so that a report says not
only that a file changed but also what in the drawing is different:

1. Are its bytes those of the manifest (SHA-256)?
2. Read by this package's own reader, do its polygons give the stored level map, pixel by pixel, without
   an overlap, an edge off the raster, or a shape that does not belong there? Can every shape be written, and is all of
   it on the blank (`fab.verification.shop_checks`)?
3. Does a library that had no part in the writing (gdstk) see the same?

OASIS files have no reader of this package: KLayout reads them and hands them over as GDSII, then gdstk reads them, too.
Libraries are not safe against broken files. They work in a process of their own, with limits of time and memory
(`fab.verification.child`), and gdstk is given only what the own reader or KLayout accepts. That process reads beside
this one, so that an order takes two cores.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from fab.errors import CheckFailed, InputError
from fab.files import MANIFEST_NAME, read_npy, scratch_folder, sha256_file
from fab.gds.gdstk_reader import GdstkReader
from fab.gds.reader import read_gds
from fab.gds.writer import oasis_to_gds
from fab.layout.arrays import unfolded
from fab.layout.compensation import read_back
from fab.layout.geometry import Layer, PixelEdges, pixel_edges
from fab.layout.limits import MOST_AROUND
from fab.layout.polygons import paint
from fab.level_map import level_digest
from fab.levels import Levels, level_map_from_codes
from fab.manifest.records import FileEntry, Manifest
from fab.solids.model import DoeModel
from fab.solids.write import model_problems
from fab.units import MM
from fab.verification.child import Child, ChildFailed, child_process, limited
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
    paths: Sequence[str | Path], levels: Levels, edges: PixelEdges, cell: str, moves: Sequence[int] = ()
) -> NDArray[np.uint8]:
    """Rebuild the level numbers ``[y, x]`` that a cell draws in some GDSII files together, bit k on layer k + 1.

    Edges of the masks were moved outward by `moves`, database units (`Manifest.edge_moves`).

    Raises:
        InputError: a file is missing or corrupt, draws something else than planes of pixels, or a pixel has no level.
    """
    etched = np.zeros((edges.y.size - 1, edges.x.size - 1), dtype=np.uint8)
    for path in paths:
        _paint_cell(path, cell, edges, moves or (0,) * levels.bits, etched)
    return level_map_from_codes(etched, levels, " + ".join(map(str, paths)))


def check_levels(folder: Path, manifest: Manifest) -> Check:
    """Ask whether the masks of an order together give every pixel one of its levels."""
    edges, moves = pixel_edges(manifest.grid()), manifest.edge_moves()
    problems = ()
    try:
        read_drawn_levels(manifest.drawn_files(folder), manifest.staircase(), edges, manifest.doe_cell, moves)
    except InputError as error:
        problems = (f"they {error.rule}, but got {error.got}",)
    return Check(MANIFEST_NAME, "all masks together, a level for every pixel", problems)


def _paint_cell(
    path: str | Path, cell: str, edges: PixelEdges, moves: Sequence[int], etched: NDArray[np.uint8]
) -> None:
    """Set the bits ``[y, x]`` of the etch layers that a cell of a file holds."""
    # A rectangle covers a pixel at least, and one whose edges were moved a part of one in nine.
    drawn = unfolded(read_gds(path), [cell], 9 * len(moves) * etched.size).cell(cell)
    if drawn is None:
        raise InputError(str(path), f"must hold the cell {cell}", "none of that name", "Write the order again.")
    for bit, move in enumerate(moves):
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


def reference_level(folder: Path, manifest: Manifest) -> tuple[NDArray[np.uint8], Check]:
    """Return the level numbers ``[y, x]`` to compare with, and whether the stored ones are those of the manifest.

    A damaged copy must not put the blame on the masks: the map drawn in the masks may be the right one.

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
        drawn = read_drawn_levels(manifest.drawn_files(folder), levels, edges, manifest.doe_cell, moves)
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
        whole = unfolded(layout, expected.manifest.drawn(), _most_shapes(entry, expected))
    except InputError as error:
        problem = f"it cannot be read: {error.rule}, but got {error.got}"
        return Check(entry.file, question, (problem,)), False
    fit = abs(layout.dbu_m / expected.edges.dbu_m - 1) < 1e-9
    blank_m = expected.manifest.wafer.blank_mm * MM
    problems = layout_problems(whole, entry, expected) + drawing_problems(layout, blank_m)
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


def _klayout_check(path: Path, entry: FileEntry, expected: Expected, scratch: Path) -> tuple[Check, bool]:
    """Return what is found in an OASIS file through KLayout, and whether the file is whole."""
    question, gds = "KLayout and own reader, every pixel", scratch / f"{entry.file}.gds"
    try:
        oasis_to_gds(path, gds, _most_shapes(entry, expected))
    except InputError as error:
        problem = f"it cannot be read: {error.rule}, but got {error.got}"
        return Check(entry.file, question, (problem,)), False
    found, _ = _own_check(gds, entry, expected)
    gds.unlink()
    return replace(found, question=question), True


def _library_check(path: Path, entry: FileEntry, expected: Expected, scratch: Path) -> tuple[Check, bool]:
    """Return what gdstk finds, and whether it could read the file."""
    layers: Counter[Layer] = Counter()
    for drawn in expected.etch_layers(entry).values():
        layers.update({layer: mask.polygons for layer, mask in drawn.items()})
    chrome = expected.chrome_layer(entry)
    if chrome is not None:
        layers[chrome] = expected.manifest.chrome.polygons
    again = GdstkReader(expected.etch_layers(entry), expected.edges, scratch)
    numbers = [tuple(map(int, one.layer.split("/"))) for cell in entry.cells for one in cell.layers]
    others = dict.fromkeys(Layer(number, datatype) for number, datatype in numbers)
    if entry.format == _OASIS:
        readings = again.oasis(path, layers, _most_shapes(entry, expected))
    else:
        readings = again.gds(path, layers, others, _most_shapes(entry, expected))
    question = "gdstk, every pixel"
    try:
        problems = [problem for reading in readings for problem in reading_problems(reading, entry, expected)]
    except InputError as error:
        problem = f"it cannot be read: {error.rule}, but got {error.got}"
        return Check(entry.file, question, (problem,)), False
    problems += again.problems + cell_problems(again.around, entry, expected.edges.dbu_m)
    return Check(entry.file, question, tuple(problems)), True


_Work = Callable[[Path, FileEntry, Expected, Path], tuple[Check, bool]]


def _found_by(
    works: Sequence[_Work], child: Child, path: Path, entry: FileEntry, of: Expected, scratch: Path
) -> list[Check]:
    """Return what libraries find in a file, one after the other in a child process, until one cannot read it."""
    shapes, checks = _most_shapes(entry, of), []
    # The child may work in another folder.
    begun = ((work, child.begin(limited, shapes, work, path.absolute(), entry, of, scratch)) for work in works)
    for work, one in begun:
        try:
            found, fit = child.result(one, shapes)
        except ChildFailed as error:
            name = "KLayout" if work is _klayout_check else "gdstk"
            found, fit = Check(entry.file, f"{name}, every pixel", (f"it cannot be read: {error}",)), False
        checks.append(found)
        if not fit:
            break
    return checks


def check_files(
    folder: Path,
    expected: Expected,
    doe: DoeModel,
    intact: Mapping[str, bool],
    known: Mapping[str, Sequence[Check]] = MappingProxyType({}),
) -> list[Check]:
    """Read every mask file and every model of an order, and compare it with what it should hold.

    `doe` is what the models show; `intact` says of every file whether its bytes are those of the manifest; `known` has
    what was found before in the very same bytes.
    """
    files = [entry for entry in expected.manifest.files if (folder / entry.file).is_file()]
    unread = [entry for entry in files if entry.file not in known]
    with scratch_folder() as scratch, child_process() as child, ThreadPoolExecutor(1) as beside:

        def begin(entry: FileEntry, *works: _Work) -> Future[list[Check]]:
            return beside.submit(_found_by, works, child, folder / entry.file, entry, expected, scratch)

        # Libraries read in a process of their own, beside this one.
        found = {
            entry.file: [begin(entry, _klayout_check, _library_check)] for entry in unread if entry.format == _OASIS
        }
        own: dict[str, Check] = {}
        for entry in unread:
            if entry.format == _GDS:
                own[entry.file], fit = _own_check(folder / entry.file, entry, expected)
                found[entry.file] = [begin(entry, _library_check)] if fit else []
        models: list[Check] = []
        for model in expected.manifest.models:
            if model.file in known:
                models += known[model.file]
            elif intact[model.file]:  # libraries of solids and pictures are given whole files only
                problems = tuple(model_problems(folder, model, doe))
                models.append(Check(model.file, "read back, volume or every height", problems))
        solid = {model.file for model in expected.manifest.models}
        checks: list[Check] = []
        for entry in files:
            checks += [] if entry.file in solid else known.get(entry.file, [])
            checks += [own[entry.file]] if entry.file in own else []
            checks += [check for one in found.get(entry.file, []) for check in one.result()]
    return checks + models
