"""Spoiled orders whose manifest was mended to hide it, and what verify says of them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from fab.files import sha256_file
from fab.gds.reader import read_gds
from fab.manifest.cells import cell_entry
from fab.manifest.records import FileEntry, Manifest, read_manifest
from fab.order.verify import verify


def restate(folder: Path, change: Callable[[Manifest], Manifest]) -> None:
    """Change what the manifest says; its own digest is put right, too."""
    (folder / "manifest.json").write_bytes(change(read_manifest(folder)).to_json())


def mend(folder: Path, *files: str, cells: bool = False) -> None:
    """State the bytes of spoiled files in the manifest as they are now, on request also the cells around the DOE."""

    def change(manifest: Manifest) -> Manifest:
        return replace(manifest, files=[stated(manifest, e) if e.file in files else e for e in manifest.files])

    def stated(manifest: Manifest, entry: FileEntry) -> FileEntry:
        path = folder / entry.file
        whole = replace(entry, bytes=path.stat().st_size, sha256=sha256_file(path))
        if not cells:
            return whole
        layout = read_gds(path)
        around = [cell for cell in layout.cells if cell.name not in manifest.drawn()]
        return replace(whole, cells=[cell_entry(cell, layout.dbu_m) for cell in around])

    restate(folder, change)


def told(folder: Path, file: str) -> str:
    """What verify says of a file whose bytes are those of the manifest."""
    problems = [d for d in verify(folder).differences if d.startswith(f"{file}:")]
    assert not any("bytes as in the manifest" in problem for problem in problems), problems
    return "\n".join(problems)
