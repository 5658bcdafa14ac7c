"""The proof of a mask order: read every file back and compare every pixel with the level map.

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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fab.errors import CheckFailed, InputError
from fab.figure import html_of
from fab.files import os_errors_explained, read_npy, sha256_file
from fab.gds.gdstk_reader import GdstkReader
from fab.gds.reader import read_gds
from fab.gds.writer import oasis_to_gds
from fab.layout.compensation import read_back
from fab.layout.geometry import Layer, PixelEdges, pixel_edges
from fab.layout.limits import MOST_AROUND
from fab.layout.polygons import paint
from fab.level_map import level_digest
from fab.levels import Levels
from fab.manifest.records import FileEntry, Manifest, plane_digest, read_manifest
from fab.solids.write import model_problems
from fab.verification.child import Child, ChildFailed, TooMuch, child_process, limited
from fab.verification.compare import Expected, cell_problems, layout_problems, reading_problems
from fab.verification.shop_checks import drawing_problems, number_problems

if TYPE_CHECKING:
    from fab.order.write import WrittenOrder

_GDS, _OASIS = "GDSII", "OASIS"


@dataclass(frozen=True)
class Check:
    """One question about a file, and its answer: a sentence per difference, none if it holds."""

    file: str
    question: str
    problems: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether nothing differs."""
        return not self.problems


@dataclass(frozen=True)
class VerificationReport:
    """All checks of a mask order, in the order they were made."""

    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether every check holds."""
        return all(check.passed for check in self.checks)

    @property
    def differences(self) -> tuple[str, ...]:
        """One sentence per difference, each naming its file first."""
        return tuple(f"{c.file}: {c.question}: {problem}" for c in self.checks for problem in c.problems)

    def _repr_html_(self) -> str:
        rows = {f"{c.file}: {c.question}": "; ".join(c.problems) or "passed" for c in self.checks}
        return html_of(f"{sum(check.passed for check in self.checks)} of {len(self.checks)} checks passed", rows)

    def require(self) -> None:
        """Raise `CheckFailed` with the differences, if there are any."""
        if not self.passed:
            raise CheckFailed(self.differences)


def _check_bytes(folder: Path, entry: FileEntry) -> Check:
    path, problems = folder / entry.file, ()
    if not path.is_file():
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


def _reference(folder: Path, manifest: Manifest, levels: Levels, edges: PixelEdges) -> tuple[NDArray[np.uint8], Check]:
    """Return the level numbers to compare with, and whether the stored ones are those of the manifest.

    A damaged copy must not put the blame on the masks: the map drawn in the combined file may be the right one.
    """
    stored = _stored_levels(folder, manifest)
    question = "the level map as in the manifest"
    if stored is not None and level_digest(stored) == manifest.level_map_sha256:
        return stored, Check(manifest.level_map_file, question, ())
    failed = Check(manifest.level_map_file, question, ("the level map is unreadable or its digest differs",))
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
    problems = layout_problems(layout, entry, expected) + drawing_problems(layout, entry, expected)
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


def verify(order: "str | Path | WrittenOrder") -> VerificationReport:
    """Read a mask order back, with two readers, and compare every pixel with its level map.

    Args:
        order: the folder that `write_order` wrote, or what it returned.

    Raises:
        InputError: the folder is not a mask order, or its manifest is corrupt.
        CheckFailed: no level map is left to compare with; differences alone raise in `VerificationReport.require`.
    """
    folder = Path(order) if isinstance(order, str | Path) else order.folder
    manifest = read_manifest(folder)
    levels = manifest.staircase()
    edges = pixel_edges(manifest.grid())
    with os_errors_explained(folder):
        byte_checks = {entry.file: _check_bytes(folder, entry) for entry in manifest.files}
        checks = [*byte_checks.values()]
        masks = {path.name for path in folder.iterdir() if path.suffix.lower() in (".gds", ".oas")}
        for name in sorted(masks - byte_checks.keys()):
            checks.append(Check(name, "listed in the manifest", ("a mask file that the manifest does not know",)))
        reference, map_check = _reference(folder, manifest, levels, edges)
        level_map = manifest.level_map(reference)
        expected = Expected(manifest, level_map, level_map.planes(), edges)
        checks.append(map_check)
        for mask in manifest.masks:
            if plane_digest(expected.planes[mask.bit]) != mask.plane_sha256:
                question = "digest of the plane in the manifest"
                checks.append(Check(mask.file, question, ("it is not that of the level map",)))
        for file, problems in number_problems(expected).items():
            checks.append(Check(file, "numbers of the order form", tuple(problems)))
        with tempfile.TemporaryDirectory(prefix="doedesign-verify-") as scratch, child_process() as child:
            begun = {
                entry.file: _check_oasis(
                    child, folder / entry.file, entry, byte_checks[entry.file].passed, expected, Path(scratch)
                )
                for entry in manifest.files
                if entry.format == _OASIS and (folder / entry.file).is_file()
            }
            for entry in manifest.files:
                if entry.format == _GDS:
                    checks += _check_mask_file(folder, entry, expected)
                elif entry.file in begun:
                    checks.append(begun[entry.file]())
        for model in manifest.models:
            # Libraries of solids and pictures are given whole files only.
            if byte_checks[model.file].passed:
                problems = model_problems(folder, model, level_map)
                checks.append(Check(model.file, "read back, volume or every height", tuple(problems)))
    return VerificationReport(tuple(checks))
