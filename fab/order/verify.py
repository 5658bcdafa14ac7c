"""The proof of a mask order from its files alone.

Two things are done, and nothing of the first is used for the second:

1. Every mask file is read by two readers that had no part in the writing, and the pixels that they find are compared
   with the bit planes of the level map (`fab.verification.files`). That proves what is drawn.
2. The order is drawn again from the level map and from what was asked for, as the manifest records it
   (`fab.order.request`): every entry of the manifest, every cell around the DOE, every number of the run sheet, every
   picture. What lies in the folder is compared with that, so that no file and no entry can vouch for itself, and
   whatever is changed disagrees with the rest, or with what was asked for. That proves that all belong together.

Whatever says nothing may differ: dates, the order of shapes and where each begins, how a program packs an OASIS file.
Of an order that another version of this package wrote, pixels, lengths, depths and solids are proved likewise; the rest
is compared with the manifest alone, to which its run sheet is tied by a digest, and the report says so.
"""

import logging
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.files import MANIFEST_NAME, opened, os_errors_explained, read_bytes, read_json, require_text
from fab.layout.geometry import pixel_edges
from fab.manifest.records import FileEntry, Manifest, read_manifest
from fab.order.drawing import DrawnOrder, draw, file_entries, manifest_of, tools
from fab.order.papers import papers, request_digest
from fab.order.request import order_from
from fab.solids.write import model_entries
from fab.verification.compare import Expected
from fab.verification.files import check_bytes, check_files, check_levels, reference_level
from fab.verification.papers import paper_problems, picture_of_digest
from fab.verification.report import Check, VerificationReport
from fab.verification.values import differences

if TYPE_CHECKING:
    from fab.order.write import WrittenOrder

log = logging.getLogger("doedesign")

# Endings of layouts, and of what packs them.
_LAYOUTS = {*[".gds", ".gds2", ".gdsii", ".gdz", ".sf", ".strm", ".oas", ".oasis", ".dxf", ".cif", ".ctb", ".lic"]}
_PACKED = {*[".gz", ".bz2", ".xz", ".zst", ".zip", ".7z", ".rar", ".tar", ".tgz", ".z"]}
# What every version says alike of an order, and of a mask.
_LASTING = ("name", "source", "request", "levels", "step_nm", "shape", "pitch_um", "aperture_mm", "level_map_sha256")
_LASTING_PARTS = {"mask", "bit", "layer", "depth_nm", "edge_move_nm", "plane_sha256", "makes", "field", "reading"}
_MAGIC = (b"\x00\x06\x00\x02", b"%SEMI-OASIS")


def verify(order: "str | Path | WrittenOrder") -> VerificationReport:
    """Read a mask order back, with two readers, and compare every file with what was asked for.

    Args:
        order: the folder that `write_order` wrote, or what it returned.

    Raises:
        InputError: the folder is not a mask order, or its manifest is corrupt.
        CheckFailed: no level map is left to compare with; differences alone raise in `VerificationReport.require`.
    """
    folder = order if isinstance(order, str | Path) else getattr(order, "folder", None)
    if folder is None:
        rule, cure = "must be a folder, or what write_order returned", 'For example "masks/lens".'
        raise InputError("order", rule, f"a {type(order).__name__}", cure)
    return verify_folder(Path(folder))


class FilesRead(NamedTuple):
    """Findings in the mask files and models of a folder, and the digests that they had then."""

    sha256: Mapping[str, str]
    checks: Sequence[Check]

    def of_same(self, files: Sequence[FileEntry], intact: Mapping[str, bool]) -> dict[str, list[Check]]:
        """Checks, by file, of the files that are still what they were."""
        same = {entry.file for entry in files if intact[entry.file] and self.sha256.get(entry.file) == entry.sha256}
        return {file: [check for check in self.checks if check.file == file] for file in same}


def read_files(folder: Path, drawing: DrawnOrder, written: Manifest) -> FilesRead:
    """Read the mask files and models of an order that is being written; `written` lists what is there already."""
    log.info("reading masks and solids back")
    level_map = drawing.order.level_map
    expected = Expected(written, level_map.planes(), pixel_edges(level_map.grid))
    intact = dict.fromkeys((entry.file for entry in written.files), True)
    checks = check_files(folder, expected, drawing.model, intact)
    return FilesRead({entry.file: entry.sha256 for entry in written.files}, checks)


def verify_folder(folder: Path, known: FilesRead | None = None) -> VerificationReport:
    """`verify`; what is `known` of the very same bytes is not read again."""
    require_text(folder)
    recorded, ours = read_manifest(folder), tools()
    with os_errors_explained(folder):
        level, map_check = reference_level(folder, recorded)
        drawing = _drawn_again(recorded, level, str(folder / MANIFEST_NAME))
        level_map = drawing.order.level_map
        wanted, notes = _wanted(drawing, recorded), []
        if recorded.tools.get("doedesign") == ours["doedesign"]:
            told = differences(asdict(recorded), asdict(wanted))
        else:
            told = differences(_lasting(recorded), _lasting(wanted))
            wanted = recorded
            notes.append(
                f"written by doedesign {recorded.tools.get('doedesign')}, and this is {ours['doedesign']}: marks, "
                "labels, names, words, pictures and the run sheet are not drawn again, but compared with the manifest"
            )
        byte_checks = {entry.file: check_bytes(folder, entry) for entry in wanted.files}
        intact = {file: check.passed for file, check in byte_checks.items()}
        checks = [
            Check(MANIFEST_NAME, "written as it is", tuple(_spelling_problems(folder, recorded))),
            Check(MANIFEST_NAME, "as was asked for", tuple(told)),
            *_others(folder, drawing.order.stem, intact.keys()),
            *byte_checks.values(),
            map_check,
        ]
        if not level_map.levels.is_full:  # otherwise any masks will do
            checks.append(check_levels(folder, recorded))
        expected = Expected(wanted, level_map.planes(), pixel_edges(level_map.grid))
        same = known.of_same(wanted.files, intact) if known else {}
        checks += check_files(folder, expected, drawing.model, intact, same)
        if notes:
            checks += _request_checks(folder, recorded)
        else:
            alike = recorded.tools.get("matplotlib") == ours["matplotlib"]
            checks += _paper_checks(folder, drawing, wanted, alike)
    return VerificationReport(tuple(checks), tuple(notes))


def _drawn_again(recorded: Manifest, level: NDArray[np.uint8], where: str) -> DrawnOrder:
    """Draw the order of a manifest and of level numbers ``[y, x]``; errors name the manifest."""
    asked = order_from(recorded.request, level, where)
    try:
        return draw(asked)
    except InputError as error:
        cure = "Fetch the manifest again, or write the order again."
        raise InputError(f"{where}: request: {error.where}", error.rule, error.got, cure) from error


def _lasting(manifest: Manifest) -> dict[str, Any]:
    """Return what stays the same whichever version writes an order: lengths, depths, layers and tones."""
    content = asdict(manifest)
    return {key: content[key] for key in _LASTING} | {
        part: [{key: entry[key] for key in entry.keys() & _LASTING_PARTS} for entry in content[part]]
        for part in ("masks", "plates")
    }


def _spelling_problems(folder: Path, recorded: Manifest) -> list[str]:
    path = folder / MANIFEST_NAME
    if path.is_symlink():
        return ["it is a link to elsewhere"]
    same = read_bytes(path) == recorded.to_json()
    return [] if same else ["its spaces, the order of its keys or the spelling of its numbers were changed"]


def _wanted(drawing: DrawnOrder, recorded: Manifest) -> Manifest:
    """Return the manifest that the order should have; sizes and digests of files are compared with the files alone."""
    models = model_entries(Path(), drawing.order.stem, drawing.model)
    stated = {entry.file: entry for entry in recorded.files}
    files = [
        replace(entry, bytes=stated[entry.file].bytes, sha256=stated[entry.file].sha256)
        if entry.file in stated
        else entry
        for entry in file_entries(drawing, models)
    ]
    return manifest_of(drawing, models, files, recorded.tools)


def _others(folder: Path, stem: str, listed: Collection[str]) -> Iterator[Check]:
    """Look at everything else in the folder, and name what somebody could take for a part of the order."""
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name not in listed and name != MANIFEST_NAME and (what := _taken_for(path, stem)):
            yield Check(name, "listed in the manifest", (f"{what} that the manifest does not know",))


def _taken_for(path: Path, stem: str) -> str:
    endings = {ending.lower() for ending in path.suffixes}
    if endings & _LAYOUTS:
        return "a mask file"
    if endings & _PACKED:
        return "an archive"
    if path.name.upper().startswith(stem):
        return "a file of its name"
    return "a mask file" if path.is_file() and _first_bytes(path).startswith(_MAGIC) else ""


def _first_bytes(path: Path) -> bytes:
    with opened(path) as stream:
        return stream.read(16)


def _request_checks(folder: Path, recorded: Manifest) -> Iterator[Check]:
    """Compare the digest by which a run sheet belongs to what was asked for, and to the version that wrote it."""
    for entry in recorded.files:
        if entry.file.endswith("_RUNSHEET.json") and (folder / entry.file).is_file():
            told = read_json(folder / entry.file).get("request_sha256")
            alike = told == request_digest(recorded.request, recorded.tools)
            yield Check(entry.file, "of this order", () if alike else ("it belongs to another request or version",))


def _paper_checks(folder: Path, drawing: DrawnOrder, wanted: Manifest, alike: bool) -> list[Check]:
    """Make every picture and page again, and compare; `alike` says that the same library draws them."""
    order = drawing.order
    plates = {entry.file: entry.sha256 for entry in wanted.files if entry.format == "GDSII"}
    psfs = None
    if order.light is not None:
        psfs = picture_of_digest(folder / f"{order.stem}_RUNSHEET.html", order.light.picture_sha256)
    checks = []
    for name, make in papers(drawing, plates, wanted.tools, psfs).items():
        if (folder / name).is_file():
            question = "drawn again" if name.endswith(".png") else "written again"
            checks.append(Check(name, question, tuple(paper_problems(folder / name, make(), alike))))
    return checks
