"""`doedesign reconstruct`: captures through a trained network.

    OUT/
        NAME.png            the reconstruction, of the capture's own kind unless another is asked for
        NAME_beside.png     the capture and the reconstruction side by side, on request
        manifest.json       for every file: capture, network, PSFs, depths, digests

The network and the PSFs of its plate are those of a model (`doedesign.recon.model`); other PSFs can be handed in.

Files appear one by one, each whole. A later call adds to the folder and replaces what has the same name.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from doedesign.commands.psf import Say
from doedesign.recon.model import Model, ModelPsfs, PsfChoice, in_camera, open_model, psfs_of, released_model, shown
from doedesign.recon.photos import PHOTO_FILES, WRITTEN_FILES, Photo, read_capture, write_reconstruction
from doedesign.recon.tiles import OVERLAP, TILE, plan_tiles, reconstruct_tiled
from doedesign.runs.folder import alone_in
from doedesign.runtime.progress import meter
from fab.errors import InputError
from fab.files import MANIFEST_NAME, canonical_json, read_json, sha256_file, write_atomic
from sim.light import srgb_from_linear

FORMAT = "doedesign reconstructions 1"


@dataclass(frozen=True)
class ReconstructionSettings:
    """How to reconstruct.

    Attributes:
        psf: which PSFs the network is told of.
        tile: the most pixels of a tile's side.
        overlap: pixels that tiles share.
        linear: whether PNG and TIFF hold linear light; by default what is usual for their kind.
        kind: ending of the results, such as ".exr"; that of the capture if None.
        beside: draw captures and reconstructions side by side, too.
    """

    psf: PsfChoice = field(default_factory=PsfChoice)
    tile: int = TILE
    overlap: int = OVERLAP
    linear: bool | None = None
    kind: str | None = None
    beside: bool = False


def model_and_captures(paths: Sequence[Path]) -> tuple[Path, list[Path]]:
    """Tell a model's folder from the captures after it; the released model if there are captures alone.

    Raises:
        InputError: there is no released model.
    """
    first = paths[0]
    if first.is_file() or (first.suffix.lower() in PHOTO_FILES and not first.is_dir()):
        return released_model(), list(paths)
    return first, list(paths[1:])


def reconstruct(
    model_folder: Path,
    captures: Sequence[Path],
    out: Path | None = None,
    request: ReconstructionSettings | None = None,
    *,
    say: Say = lambda _: None,
) -> list[Path]:
    """Reconstruct captures.

    Args:
        model_folder: a run with a training, RUN/trained, or a released model.
        captures: files, see `doedesign.recon.photos`.
        out: folder; "reconstructed" by default.
        request: how.
        say: told what is going on.

    Returns:
        the files written.

    Raises:
        InputError: a model, capture, PSF or number that cannot be used; PSFs of another pitch or other colours; a
            folder that holds something else.
    """
    request, folder = request or ReconstructionSettings(), out or Path("reconstructed")
    names = _names(captures, request.kind)
    _require_own(folder, captures, names)
    model = open_model(model_folder)
    _require_tiles(request, model)
    psfs = psfs_of(model, request.psf)
    if {"obstruction", "occlusion"} <= model.about.keys():
        say(f"{model.folder}: trained behind {model.about['obstruction']}, occlusion model {model.about['occlusion']}")
    say(f"obstruction at {100 * psfs.near_m:.3g} cm, scene at {_told(psfs.far_m)}")
    written: list[Path] = []
    with alone_in(folder):
        # From here on the folder says whose it is, whenever this ends.
        _note(folder, {})
        for capture, name in zip(captures, names, strict=True):
            photo = read_capture(capture, request.linear)
            light = in_camera(photo, capture, model)
            display = _through(model, light, psfs, request, name)
            files = _write(folder, name, photo, shown(light, model), shown(display, model), request.beside)
            said = _said(capture, model, psfs, request)
            _note(folder, {each.name: {**said, "sha256": sha256_file(each)} for each in files})
            written += files
    return written


def _through(
    model: Model, light: Float[np.ndarray, "c y x"], psfs: ModelPsfs, request: ReconstructionSettings, name: str
) -> Float[np.ndarray, "c y x"]:
    multiple = model.network.layout.multiple
    plan = plan_tiles((light.shape[1], light.shape[2]), request.tile, request.overlap, multiple)
    with meter(f"tiles of {name}", plan.total) as progress:
        return reconstruct_tiled(
            model.network,
            light,
            psfs.far,
            psfs.near,
            tile=request.tile,
            overlap=request.overlap,
            multiple=multiple,
            on_tile=progress.advance,
        )


def _require_tiles(request: ReconstructionSettings, model: Model) -> None:
    try:
        plan_tiles((1, 1), request.tile, request.overlap, model.network.layout.multiple)
    except ValueError as error:
        rule, _, got = str(error).partition(", but got ")
        raise InputError("--tile, --overlap", rule.replace("`", ""), got, "Leave them out, or correct them.") from error


def _names(captures: Sequence[Path], kind: str | None) -> list[str]:
    """A file name for every reconstruction; captures of one name are told apart by their folders."""
    if not captures:
        raise InputError("CAPTURE", "at least one capture must be given", "none", "Give a file.")
    if kind is not None and kind not in WRITTEN_FILES:
        rule = f"must be one of {', '.join(WRITTEN_FILES)}"
        raise InputError("--kind", rule, kind, "Choose one of them.")
    stems = [path.stem for path in captures]
    if len(set(stems)) < len(stems):
        stems = [f"{path.resolve().parent.name}_{path.stem}" for path in captures]
    if len(set(stems)) < len(stems):
        twice = next(stem for stem in stems if stems.count(stem) > 1)
        raise InputError("CAPTURE", "captures must differ in name or folder", f"{twice} twice", "Give them one by one.")
    endings = [kind or path.suffix.lower() for path in captures]
    return [
        f"{stem}{ending if ending in WRITTEN_FILES else '.png'}" for stem, ending in zip(stems, endings, strict=True)
    ]


def _require_own(folder: Path, captures: Sequence[Path], names: Sequence[str]) -> None:
    """Refuse a folder with anything else in it: nobody's picture is overwritten."""
    if not folder.is_dir():
        return  # `alone_in` makes it, or says why it cannot be made
    content = {path.name for path in folder.iterdir() if not path.name.startswith(".")}
    manifest = read_json(folder / MANIFEST_NAME) if MANIFEST_NAME in content else {}
    if content and manifest.get("format") != FORMAT:
        rule = "reconstructions need a folder of their own, new or empty"
        raise InputError(str(folder), rule, "one with other content", "Choose another --out.")
    given = {path.resolve() for path in captures}
    for name in names:
        if (folder / name).resolve() in given:
            raise InputError(str(folder / name), "a capture must not be overwritten", "its own name", "Choose --out.")


def _write(
    folder: Path,
    name: str,
    photo: Photo,
    light: Float[np.ndarray, "c y x"],
    display: Float[np.ndarray, "c y x"],
    beside: bool,
) -> list[Path]:
    """Write a reconstruction; return its files."""
    path = folder / name
    write_reconstruction(path, display, _bits(photo, path.suffix))
    if not beside:
        return [path]
    gap = np.ones((len(light), light.shape[1], max(2, light.shape[2] // 100)), np.float32)
    both = np.concatenate([srgb_from_linear(light), gap, display], axis=2)
    pair = path.with_name(f"{path.stem}_beside.png")
    write_reconstruction(pair, both.astype(np.float32), 8)
    return [path, pair]


def _bits(photo: Photo, ending: str) -> int | None:
    """Bits of a result: those of the capture; floats where there were floats and the kind can hold them."""
    if ending == ".exr" or (photo.bits is None and ending != ".png"):
        return None
    return photo.bits or 16


def _said(capture: Path, model: Model, psfs: ModelPsfs, request: ReconstructionSettings) -> dict[str, Any]:
    """What a result was made from."""
    return {
        "capture": capture.name,
        "capture_sha256": sha256_file(capture),
        "model_sha256": model.digests,
        "psf_sha256": {each.name: sha256_file(each) for each in request.psf.files},
        "near_m": psfs.near_m,
        "far_m": None if np.isinf(psfs.far_m) else psfs.far_m,
        "tile": request.tile,
        "overlap": request.overlap,
    }


def _note(folder: Path, results: Mapping[str, Any]) -> None:
    """Add results to the folder's manifest."""
    path = folder / MANIFEST_NAME
    known: Mapping[str, Any] = read_json(path).get("results", {}) if path.is_file() else {}
    units = "SI; EXR and TIFF of floats hold linear light, the rest display values; files have the top row first"
    write_atomic(path, canonical_json({"format": FORMAT, "units": units, "results": {**known, **results}}))


def _told(depth_m: float) -> str:
    return "infinity" if np.isinf(depth_m) else f"{depth_m:.3g} m"
