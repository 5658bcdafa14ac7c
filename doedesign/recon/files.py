"""Captures in files through a model, into a folder.

    OUT/
        NAME.png            the reconstruction, of the capture's own kind unless another is asked for
        NAME_beside.png     the capture and the reconstruction side by side, on request
        manifest.json       for every file: capture, network, PSFs, depths, digests

Files appear one by one, each whole. A later call adds to the folder and replaces what has the same name.
"""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from doedesign.recon.model import Model, PsfPair
from doedesign.recon.photos import WRITTEN_FILES, Photo, read_capture, require_capture, write_reconstruction
from doedesign.recon.tiles import OVERLAP, TILE, plan_tiles
from doedesign.runs.folder import alone_in
from doedesign.runtime.progress import meter
from fab.errors import InputError
from fab.figure import length_text
from fab.files import (
    MANIFEST_NAME,
    canonical_json,
    path_of,
    paths_of,
    read_json,
    real_path,
    sha256_file,
    write_atomic,
)
from fab.units import require_kind

FORMAT = "doedesign reconstructions 1"

_log = logging.getLogger("doedesign")


def reconstruct_files(
    model: Model,
    captures: str | Path | Sequence[str | Path],
    folder: str | Path,
    *,
    psfs: PsfPair | None = None,
    linear: bool | None = None,
    kind: str | None = None,
    beside: bool = False,
    tile: int = TILE,
    overlap: int = OVERLAP,
) -> list[Path]:
    """Reconstruct captures and write the results; return their paths.

    Args:
        model: the model.
        captures: one file or several (`doedesign.recon.photos`).
        folder: where to; a new or empty folder, or one of earlier reconstructions.
        psfs: PSFs to give to the network; the model's own if None.
        linear: whether PNG and TIFF hold linear light; by default what is usual for their kind.
        kind: ending of the results, such as ".exr"; that of the capture if None.
        beside: draw captures and reconstructions side by side, too.
        tile: the most pixels of a tile's side.
        overlap: pixels that tiles share.

    Raises:
        InputError: a capture or number that cannot be used, or a folder that holds something else.
    """
    require_kind("model", model, Model, 'Open one by dd.Model.open("runs/NAME/trained").')
    captures, folder = paths_of(captures, "captures"), path_of(folder, "folder")
    for capture in captures:  # said before a folder is made, and before those ahead of it take their time
        require_capture(capture)
    names = [_with_beside(name, beside) for name in _names(captures, kind)]
    _require_own_folder(folder, captures, [name for each in names for name in each])
    multiple = model.network.layout.multiple
    try:
        plan_tiles((1, 1), tile, overlap, multiple)
    except ValueError as error:
        rule, _, got = str(error).partition(", but got ")
        raise InputError("tile, overlap", rule.replace("`", ""), got, "Leave them out, or correct them.") from error
    psfs = psfs or model.psfs()
    if {"obstruction", "occlusion"} <= model.about.keys():
        behind, by = model.about["obstruction"], model.about["occlusion"]
        _log.info("%s: trained behind %s, occlusion model %s", model.folder, behind, by)
    _log.info("obstruction at %s, scene at %s", length_text(psfs.near_m), length_text(psfs.far_m))
    written: list[Path] = []
    with alone_in(folder):
        # From here on the folder says whose it is, whenever this ends.
        _note(folder, {})
        for capture, own in zip(captures, names, strict=True):
            photo = read_capture(capture, linear)
            count = plan_tiles((photo.light.shape[1], photo.light.shape[2]), tile, overlap, multiple).total
            with meter(f"tiles of {own[0]}", count) as progress:
                found = model.reconstruct(photo, psfs=psfs, tile=tile, overlap=overlap, on_tile=progress.advance)
            files = [folder / name for name in own]
            record = {
                "capture": capture.name,
                "capture_sha256": sha256_file(capture),
                "model_sha256": dict(model.digests),
                "psf_sha256": dict(psfs.digests),
                "near_m": psfs.near_m,
                "far_m": None if np.isinf(psfs.far_m) else psfs.far_m,
                "tile": tile,
                "overlap": overlap,
            }
            # Before they are there, too: what is listed may be replaced, whenever this ends.
            _note(folder, dict.fromkeys(own, record))
            found.save(files[0], _bits(photo, files[0].suffix))
            for path in files[1:]:
                write_reconstruction(path, found.beside(), 8)
            _note(folder, {each.name: {**record, "sha256": sha256_file(each)} for each in files})
            written += files
    return written


def _names(captures: Sequence[Path], kind: str | None) -> list[str]:
    """A file name for every reconstruction; captures of one name are told apart by their folders."""
    if not captures:
        raise InputError("captures", "at least one capture must be given", "none", "Give a file.")
    if kind is not None and kind not in WRITTEN_FILES:
        raise InputError("kind", f"must be one of {', '.join(WRITTEN_FILES)}", kind, "Choose one of them.")
    stems = [path.stem for path in captures]
    if len(set(stems)) < len(stems):
        stems = [f"{real_path(path).parent.name}_{path.stem}" for path in captures]
    if len(set(stems)) < len(stems):
        twice = next(stem for stem in stems if stems.count(stem) > 1)
        raise InputError("captures", "must differ in name or folder", f"{twice} twice", "Give them one by one.")
    endings = [kind or path.suffix.lower() for path in captures]
    return [stem + (ending if ending in WRITTEN_FILES else ".png") for stem, ending in zip(stems, endings, strict=True)]


def _with_beside(name: str, beside: bool) -> tuple[str, ...]:
    """Names of all files of a capture: its reconstruction and, if asked for, both side by side."""
    return (name, f"{Path(name).stem}_beside.png") if beside else (name,)


def _require_own_folder(folder: Path, captures: Sequence[Path], names: Sequence[str]) -> None:
    """Refuse names that two results have, and a folder with anything else in it or with one of the captures.

    No other picture is overwritten.
    """
    if twice := next((name for name in names if names.count(name) > 1), None):
        cure = "Reconstruct one of them into another output folder."
        raise InputError("captures", "must have results of different names", f"{twice} twice", cure)
    if not folder.is_dir():
        return  # `alone_in` makes it, or says why it cannot be made
    content = {path.name for path in folder.iterdir() if not path.name.startswith(".")}
    known = _results(folder)
    if content and known is None:
        rule = "reconstructions need a folder of their own, new or empty"
        raise InputError(str(folder), rule, "one with other content", "Choose another output folder.")
    given = {real_path(path) for path in captures}
    for name in names:
        if real_path(folder / name) in given:
            rule, cure = "a capture must not be overwritten", "Choose another output folder."
            raise InputError(str(folder / name), rule, "its own name", cure)
        if name in content and name not in (known or {}):
            rule, got = "a picture of another origin must not be overwritten", "a file that the manifest does not list"
            raise InputError(str(folder / name), rule, got, "Move it, or choose another output folder.")


def _results(folder: Path) -> dict[str, Any] | None:
    """Results in the manifest of a folder of reconstructions; None if it is not that of one."""
    path = folder / MANIFEST_NAME
    manifest = read_json(path) if path.is_file() else {}
    results = manifest.get("results")
    return results if manifest.get("format") == FORMAT and isinstance(results, dict) else None


def _bits(photo: Photo, ending: str) -> int | None:
    """Bits of a result: those of the capture; floats where there were floats and the kind can hold them."""
    if ending == ".exr" or (photo.bits is None and ending != ".png"):
        return None
    return photo.bits or 16


def _note(folder: Path, results: Mapping[str, Any]) -> None:
    """Add results to the folder's manifest."""
    path = folder / MANIFEST_NAME
    known = _results(folder) or {}
    units = "SI; EXR and TIFF of floats hold linear light, the rest display values; files have the top row first"
    write_atomic(path, canonical_json({"format": FORMAT, "units": units, "results": {**known, **results}}))
