"""`doedesign reconstruct`: captures through a trained network.

    OUT/
        NAME.png            the reconstruction, of the capture's own kind unless another is asked for
        NAME_beside.png     the capture and the reconstruction side by side, on request
        manifest.json       for every file: capture, network, PSFs, depths, digests

A model is a folder with a network and the PSFs of its plate: RUN/trained, or a released one. Its PSFs can be replaced
by others, of the plate as fabricated or as measured, without training anew.

Files appear one by one, each whole. A later call adds to the folder and replaces what has the same name.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.commands.psf import Say
from doedesign.progress import meter
from doedesign.recon.network import Network
from doedesign.recon.photos import WRITTEN_FILES, Photo, read_capture, write_reconstruction
from doedesign.recon.tiles import OVERLAP, TILE, plan_tiles, reconstruct_tiled
from doedesign.recon.weights import BANK_NAME, NETWORK_NAME, read_network
from doedesign.runs import alone_in
from fab.errors import InputError
from fab.files import MANIFEST_NAME, canonical_json, read_json, sha256_file, write_atomic
from sim.formation import psf_at
from sim.light import srgb_from_linear
from sim.psf import PsfBank
from sim.store import read_bank

FORMAT = "doedesign reconstructions 1"

_PITCH_TOLERANCE = 1e-3  # a ring of 500 pixels is then off by half a pixel
_MEASURED = ("R", "G", "B")
# Luminance of linear sRGB (IEC 61966-2-1).
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


@dataclass(frozen=True)
class Request:
    """How to reconstruct.

    Attributes:
        psf: PSFs other than the model's: one bank, or two files, of the scene and of the obstruction. A file of another
            program (channels R, G, B, or one) is taken as measured, and scaled to the energy of the model's own PSF.
        pixel_m: pixel pitch of measured PSFs, metres.
        near_m: distance of the obstruction; the middle, in 1/z, of what the network was trained on if None.
        far_m: distance of the scene; the farthest of the bank if None.
        tile: the most pixels of a tile's side.
        overlap: pixels that tiles share.
        linear: whether PNG and TIFF hold linear light; by default what is usual for their kind.
        kind: ending of the results, such as ".exr"; that of the capture if None.
        beside: draw captures and reconstructions side by side, too.
    """

    psf: Sequence[Path] = ()
    pixel_m: float | None = None
    near_m: float | None = None
    far_m: float | None = None
    tile: int = TILE
    overlap: int = OVERLAP
    linear: bool | None = None
    kind: str | None = None
    beside: bool = False


class Model(NamedTuple):
    """A trained network with its camera.

    Attributes:
        folder: where it was read from.
        network: the network.
        colours: names of its channels.
        wavelengths_m: mean wavelength of each.
        pixel_m: pixel pitch, metres.
        near_m: depths of obstructions that it was trained on.
        bank: PSFs of its plate.
        digests: SHA-256 of its files.
    """

    folder: Path
    network: Network
    colours: tuple[str, ...]
    wavelengths_m: tuple[float, ...]
    pixel_m: float
    near_m: tuple[float, ...]
    bank: PsfBank
    digests: dict[str, str]

    @property
    def longest_first(self) -> list[int]:
        """Channels by wavelength: what is shown as red, green and blue."""
        return sorted(range(len(self.colours)), key=lambda c: -self.wavelengths_m[c])


class Psfs(NamedTuple):
    """What the network is told of the optics; `[c, y, x]`, and the depths in metres."""

    far: Float[np.ndarray, "c ky kx"]
    near: Float[np.ndarray, "c kv ku"]
    far_m: float
    near_m: float


def reconstruct(
    model_folder: Path,
    captures: Sequence[Path],
    out: Path | None = None,
    request: Request | None = None,
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
    request, folder = request or Request(), out or Path("reconstructed")
    names = _names(captures, request.kind)
    _require_own(folder, captures, names)
    model = open_model(model_folder)
    _require_tiles(request, model)
    psfs = psfs_of(model, request)
    say(f"obstruction at {100 * psfs.near_m:.3g} cm, scene at {_told(psfs.far_m)}")
    written: list[Path] = []
    with alone_in(folder):
        # From here on the folder says whose it is, whenever this ends.
        _note(folder, {})
        for capture, name in zip(captures, names, strict=True):
            photo = read_capture(capture, request.linear)
            light = _in_camera(photo, capture, model)
            display = _through(model, light, psfs, request, name)
            files = _write(folder, name, photo, _shown(light, model), _shown(display, model), request.beside)
            said = _said(capture, model, psfs, request)
            _note(folder, {each.name: {**said, "sha256": sha256_file(each)} for each in files})
            written += files
    return written


def open_model(folder: Path) -> Model:
    """Read a model.

    Args:
        folder: the folder with its files, or a run whose `trained` folder has them.

    Raises:
        InputError: files that are missing, broken, or do not belong together.
    """
    home = next((each for each in (folder / "trained", folder) if (each / NETWORK_NAME).is_file()), None)
    if home is None:
        cure = "Train one with doedesign train RUN --images DIR, or give the folder of a released model."
        raise InputError(str(folder), f"must hold a trained network ({NETWORK_NAME})", "none", cure)
    network, about = read_network(home / NETWORK_NAME)
    where = home / NETWORK_NAME
    try:
        colours = tuple(str(name) for name in about["colours"])
        waves, near = (tuple(float(value) for value in about[key]) for key in ("wavelengths_m", "near_m"))
        pixel = float(about["pixel_m"])
    except (KeyError, TypeError, ValueError) as error:
        rule = "must say colours, wavelengths_m, pixel_m and near_m of its camera"
        raise InputError(str(where), rule, f'"{error!r}"', "Write the network again with `camera_facts`.") from error
    if not len(colours) == len(waves) == network.layout.colours or not near or min(near) <= 0 or not pixel > 0:
        got = f"{len(colours)} names and {len(waves)} wavelengths for {network.layout.colours} channels"
        raise InputError(str(where), "what it says of its camera must fit its layout", got, "Write it again.")
    digests = {name: sha256_file(home / name) for name in (NETWORK_NAME, BANK_NAME)}
    bare = Model(home, network, colours, waves, pixel, near, read_bank(home / BANK_NAME), digests)
    return bare._replace(bank=_fitted(bare, bare.bank, home / BANK_NAME))


def psfs_of(model: Model, request: Request) -> Psfs:
    """PSFs of the scene and of the obstruction.

    Raises:
        InputError: files that cannot be used, or a depth beyond a bank's.
    """
    near_m = 2 / (1 / min(model.near_m) + 1 / max(model.near_m)) if request.near_m is None else request.near_m
    far_m = request.far_m
    if not request.psf:
        far_m = max(model.bank.depths_m) if far_m is None else far_m
        return _ordered(
            Psfs(_at(model.bank, far_m, "--far-depth"), _at(model.bank, near_m, "--near-depth"), far_m, near_m)
        )
    if len(request.psf) > 2:
        rule = "must be one bank, or one file of the scene and one of the obstruction"
        raise InputError("--psf", rule, f"{len(request.psf)} files", "Give one or two.")
    usual = max(model.bank.depths_m) if far_m is None else far_m
    banks = [
        _fitted(model, read_bank(path, request.pixel_m, depth), path, depth)
        for path, depth in zip(request.psf, (usual, near_m), strict=False)
    ]
    if len(banks) == 1 and len(banks[0].depths_m) == 1:
        rule = "PSFs of the scene and of the obstruction are needed"
        raise InputError(str(request.psf[0]), rule, "one depth", "Give two files: --psf FAR --psf NEAR.")
    far_m = max(banks[0].depths_m) if far_m is None else far_m
    return _ordered(Psfs(_at(banks[0], far_m, "--far-depth"), _at(banks[-1], near_m, "--near-depth"), far_m, near_m))


def _at(bank: PsfBank, depth_m: float, option: str) -> Float[np.ndarray, "c y x"]:
    if not depth_m > 0:
        raise InputError(option, "must be a positive distance", f"{depth_m:g} m", "Give metres, or inf.")
    try:
        return psf_at(bank, depth_m)
    except InputError as error:
        raise InputError(option, error.rule, error.got, error.cure) from error


def _ordered(psfs: Psfs) -> Psfs:
    if not psfs.near_m < psfs.far_m:
        rule, got = "the obstruction must be nearer than the scene", f"{psfs.near_m:g} m before {psfs.far_m:g} m"
        raise InputError("--near-depth", rule, got, "Exchange the two, or give --far-depth.")
    return psfs


def _fitted(model: Model, bank: PsfBank, path: Path, depth_m: float | None = None) -> PsfBank:
    """A bank in the order of the model's colours; measured ones with the energy of the model's own PSF at `depth_m`."""
    if abs(bank.pixel_m / model.pixel_m - 1) > _PITCH_TOLERANCE:
        rule = f"PSFs must have the {1e6 * model.pixel_m:.5g} um pixels that the network was trained with"
        cure = "Compute or bin them at that pitch, or train for this one."
        raise InputError(str(path), rule, f"{1e6 * bank.pixel_m:.5g} um", cure)
    if not all(side % 2 for side in bank.energy.shape[-2:]):
        rule = "PSFs must have an odd window, with the chief ray on its middle pixel"
        got = f"{bank.energy.shape[-1]} x {bank.energy.shape[-2]} pixels"
        raise InputError(str(path), rule, got, "Compute them with an odd sensor.window, or cut them so.")
    count = len(model.colours)
    if set(bank.colours) == set(model.colours) and len(bank.colours) == count:
        order = [bank.colours.index(name) for name in model.colours]
        return PsfBank(bank.energy[order], model.colours, bank.depths_m, bank.pixel_m, bank.field_rad)
    measured = depth_m is not None and len(bank.depths_m) == 1
    if not measured or len(bank.colours) != count or (count == 3 and bank.colours != _MEASURED):
        rule = f"PSFs must have the colours of the network, {', '.join(model.colours)}"
        got, cure = ", ".join(bank.colours), "Give PSFs of the camera that the network was trained for."
        raise InputError(str(path), rule, got, cure)
    assert depth_m is not None
    own = _at(model.bank, depth_m, str(path)).sum(axis=(1, 2), dtype=np.float64)
    energy = bank.energy[np.argsort(model.longest_first)]
    total = energy.sum(axis=(1, 2, 3), dtype=np.float64)
    if not (total > 0).all():
        raise InputError(str(path), "a PSF must hold light", f"a sum of {total.min():.3g}", "Check its background.")
    scaled = (energy * (own / total)[:, None, None, None]).astype(np.float32)
    return PsfBank(scaled, model.colours, bank.depths_m, bank.pixel_m, bank.field_rad)


def _in_camera(photo: Photo, path: Path, model: Model) -> Float[np.ndarray, "c y x"]:
    """A capture in the channels of the network."""
    count, given = len(model.colours), len(photo.light)
    if given == count:
        return photo.light[np.argsort(model.longest_first)]
    if count == 1:
        return np.tensordot(_LUMINANCE, photo.light, 1)[None].astype(np.float32)
    rule = f"a capture must have the {count} colours of the network"
    raise InputError(str(path), rule, f"{given}", "Give a capture in colour, or a network trained on one colour.")


def _shown(image: Float[np.ndarray, "c y x"], model: Model) -> Float[np.ndarray, "c y x"]:
    """A picture of the network's channels in red, green and blue."""
    return np.ascontiguousarray(image[model.longest_first])


def _through(
    model: Model, light: Float[np.ndarray, "c y x"], psfs: Psfs, request: Request, name: str
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


def _require_tiles(request: Request, model: Model) -> None:
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


def _said(capture: Path, model: Model, psfs: Psfs, request: Request) -> dict[str, Any]:
    """What a result was made from."""
    return {
        "capture": capture.name,
        "capture_sha256": sha256_file(capture),
        "model_sha256": model.digests,
        "psf_sha256": {each.name: sha256_file(each) for each in request.psf},
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
