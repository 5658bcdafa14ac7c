"""Folders of results, inside a run or elsewhere: each appears whole, with a manifest of what is in it."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from doedesign.runs.folder import alone_in
from fab.errors import InputError
from fab.files import MANIFEST_NAME, atomic_folder, canonical_json, read_json, real_path, sha256_file


@contextlib.contextmanager
def results_folder(
    folder: str | Path | None, design: str, run: Path | None = None, **about: str
) -> Iterator[Path | None]:
    """Open a folder of results; its kind is its name. Nobody else may write into the run meanwhile.

    Args:
        folder: the folder, where an earlier result is replaced; None where nothing is to be written.
        design: name of the design.
        run: folder of its run, if it has one.
        about: further entries of the manifest.

    Yields:
        the folder to write to, if any; it takes its name when all is written.

    Raises:
        InputError: the folder holds something else, or another process works in the run.
    """
    if folder is None:
        yield None
        return
    folder = Path(folder)
    if (folder / MANIFEST_NAME).is_file():
        digests_before = read_json(folder / MANIFEST_NAME).get("results_sha256")
        listed = {MANIFEST_NAME, *(digests_before if isinstance(digests_before, dict) else ())}
        for path in sorted(folder.iterdir()):
            if path.name not in listed:
                rule = "a folder of results that is replaced must hold nothing else"
                raise InputError(str(folder), rule, f"also {path.name!r}", "Move that file.")
    inside = run is not None and real_path(folder).is_relative_to(real_path(run))
    with alone_in(run) if run and inside else contextlib.nullcontext(), atomic_folder(folder) as fresh:
        yield fresh
        digests = {path.name: sha256_file(path) for path in sorted(fresh.iterdir())}
        manifest = {"format": f"doedesign {folder.name} 1", "run": design, **about, "results_sha256": digests}
        (fresh / MANIFEST_NAME).write_bytes(canonical_json(manifest))
