"""A trained network with the camera that it was trained for, and the PSFs that it is told of.

    FOLDER/
        network.npz     the network, and which camera it was trained for (`doedesign.recon.weights`)
        psf.exr         PSFs of its plate

A model is such a folder: RUN/trained, RUN/finetuned, or a released one. Its PSFs can be replaced by others, of the
plate as fabricated or as measured, without training anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

import doedesign
from doedesign.recon.network import Network
from doedesign.recon.photos import Photo
from doedesign.recon.weights import BANK_NAME, NETWORK_NAME, read_network
from fab.errors import InputError
from fab.files import sha256_file
from sim.imaging.formation import psf_at
from sim.psf_bank import PsfBank
from sim.store import read_bank

__all__ = ["Model", "ModelPsfs", "PsfChoice", "in_camera", "open_model", "psfs_of", "released_model", "shown"]

RELEASED = Path("masks/released")

_PITCH_TOLERANCE = 1e-3  # a ring of 500 pixels is then off by half a pixel
_MEASURED = ("R", "G", "B")
# Luminance of linear sRGB (IEC 61966-2-1).
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


@dataclass(frozen=True)
class PsfChoice:
    """Which PSFs a network is told of.

    Attributes:
        files: PSFs other than the model's: one bank, or two files, of the scene and of the obstruction. A file of
            another program (channels R, G, B, or one) is taken as measured, and scaled to the energy of the model's own
            PSF.
        pixel_m: pixel pitch of measured PSFs, metres.
        near_m: distance of the obstruction; the middle, in 1/z, of what the network was trained on if None.
        far_m: distance of the scene; what the network was trained for, or the farthest of other PSFs if None.
    """

    files: Sequence[Path] = ()
    pixel_m: float | None = None
    near_m: float | None = None
    far_m: float | None = None


class Model(NamedTuple):
    """A trained network with its camera.

    Attributes:
        folder: where it was read from.
        network: the network.
        colours: names of its channels.
        wavelengths_m: mean wavelength of each.
        pixel_m: pixel pitch, metres.
        near_m: depths of obstructions that it was trained on.
        far_m: distance of the scene that it was trained for; None for the farthest of the bank.
        bank: PSFs of its plate.
        digests: SHA-256 of its files.
        about: all that the network's file says of it.
    """

    folder: Path
    network: Network
    colours: tuple[str, ...]
    wavelengths_m: tuple[float, ...]
    pixel_m: float
    near_m: tuple[float, ...]
    far_m: float | None
    bank: PsfBank
    digests: dict[str, str]
    about: dict[str, Any]

    @property
    def longest_first(self) -> list[int]:
        """Channels by wavelength: what is shown as red, green and blue."""
        return sorted(range(len(self.colours)), key=lambda c: -self.wavelengths_m[c])


class ModelPsfs(NamedTuple):
    """What the network is told of the optics.

    Attributes:
        far: `[c, y, x]` of the scene, energy per pixel.
        near: `[c, y, x]` of the obstruction.
        far_m: distance of the scene, metres.
        near_m: distance of the obstruction, metres.
        bank: where both are from, at these depths and others; of two files, these two alone, in the larger window.
    """

    far: Float[np.ndarray, "c ky kx"]
    near: Float[np.ndarray, "c ky kx"]
    far_m: float
    near_m: float
    bank: PsfBank


def released_model() -> Path:
    """Folder of the model that comes with the project: below the current folder, or the checkout.

    Raises:
        InputError: there is none.
    """
    places = (RELEASED, Path(doedesign.__file__).parents[1] / RELEASED)
    found = next((place for place in places if (place / NETWORK_NAME).is_file()), None)
    if found is None:
        rule = "without a model the released one is taken, and must be there"
        cure = "Give a model before the captures: doedesign reconstruct RUN CAPTURE."
        raise InputError(str(RELEASED), rule, "no such folder here or in the checkout", cure)
    return found


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
        far = None if about.get("far_m") is None else float(about["far_m"])
    except (KeyError, TypeError, ValueError) as error:
        rule = "must say colours, wavelengths_m, pixel_m and near_m of its camera"
        raise InputError(str(where), rule, f'"{error!r}"', "Write the network again with `camera_facts`.") from error
    if not len(colours) == len(waves) == network.layout.colours or not near or min(near) <= 0 or not pixel > 0:
        got = f"{len(colours)} names and {len(waves)} wavelengths for {network.layout.colours} channels"
        raise InputError(str(where), "what it says of its camera must fit its layout", got, "Write it again.")
    digests = {name: sha256_file(home / name) for name in (NETWORK_NAME, BANK_NAME)}
    bare = Model(home, network, colours, waves, pixel, near, far, read_bank(home / BANK_NAME), digests, about)
    return bare._replace(bank=_fitted(bare, bare.bank, home / BANK_NAME))


def psfs_of(model: Model, choice: PsfChoice) -> ModelPsfs:
    """PSFs of the scene and of the obstruction.

    Raises:
        InputError: files that cannot be used, or a depth beyond a bank's.
    """
    near_m = 2 / (1 / min(model.near_m) + 1 / max(model.near_m)) if choice.near_m is None else choice.near_m
    if not choice.files:
        far_m = next((z for z in (choice.far_m, model.far_m) if z is not None), max(model.bank.depths_m))
        return _ordered(model.bank, model.bank, far_m, near_m)
    if len(choice.files) > 2:
        rule = "must be one bank, or one file of the scene and one of the obstruction"
        raise InputError("--psf", rule, f"{len(choice.files)} files", "Give one or two.")
    usual = max(model.bank.depths_m) if choice.far_m is None else choice.far_m
    banks = [
        _fitted(model, read_bank(path, choice.pixel_m, depth), path, depth)
        for path, depth in zip(choice.files, (usual, near_m), strict=False)
    ]
    if len(banks) == 1 and len(banks[0].depths_m) == 1:
        rule = "PSFs of the scene and of the obstruction are needed"
        raise InputError(str(choice.files[0]), rule, "one depth", "Give two files: --psf FAR --psf NEAR.")
    far_m = max(banks[0].depths_m) if choice.far_m is None else choice.far_m
    return _ordered(banks[0], banks[-1], far_m, near_m)


def in_camera(photo: Photo, path: Path, model: Model) -> Float[np.ndarray, "c y x"]:
    """A capture in the channels of the network; luminance where it has one.

    Raises:
        InputError: a grey capture for a network of several colours.
    """
    count, given = len(model.colours), len(photo.light)
    if given == count:
        return photo.light[np.argsort(model.longest_first)]
    if count == 1:
        return np.tensordot(_LUMINANCE, photo.light, 1)[None].astype(np.float32)
    rule = f"a capture must have the {count} colours of the network"
    raise InputError(str(path), rule, f"{given}", "Give a capture in colour, or a network trained on one colour.")


def shown(image: Float[np.ndarray, "c y x"], model: Model) -> Float[np.ndarray, "c y x"]:
    """A picture of the network's channels in red, green and blue, or the one that it has."""
    return np.ascontiguousarray(image[model.longest_first])


def _at(bank: PsfBank, depth_m: float, option: str) -> Float[np.ndarray, "c y x"]:
    if not depth_m > 0:
        raise InputError(option, "must be a positive distance", f"{depth_m:g} m", "Give metres, or inf.")
    try:
        return psf_at(bank, depth_m)
    except InputError as error:
        raise InputError(option, error.rule, error.got, error.cure) from error


def _ordered(of_scene: PsfBank, of_obstruction: PsfBank, far_m: float, near_m: float) -> ModelPsfs:
    """The PSFs of two depths, the obstruction's before the scene's."""
    far, near = _at(of_scene, far_m, "--far-depth"), _at(of_obstruction, near_m, "--near-depth")
    if not near_m < far_m:
        rule, got = "the obstruction must be nearer than the scene", f"{near_m:g} m before {far_m:g} m"
        raise InputError("--near-depth", rule, got, "Exchange the two, or give --far-depth.")
    if of_obstruction is of_scene:
        return ModelPsfs(far, near, far_m, near_m, of_scene)
    window = max(far.shape[1], near.shape[1]), max(far.shape[2], near.shape[2])
    far, near = _widened(far, window), _widened(near, window)
    energy, depths = np.stack([near, far], axis=1), (near_m, far_m)
    bank = PsfBank(energy, of_scene.colours, depths, of_scene.pixel_m, of_scene.field_rad)
    return ModelPsfs(far, near, far_m, near_m, bank)


def _widened(psf: Float[np.ndarray, "c y x"], window: tuple[int, int]) -> Float[np.ndarray, "c v u"]:
    """A PSF in a larger odd window, its middle pixel in the middle."""
    (y, x), (v, u) = psf.shape[1:], window
    margins = ((0, 0), ((v - y) // 2,) * 2, ((u - x) // 2,) * 2)
    return np.pad(psf, margins)


def _fitted(model: Model, bank: PsfBank, path: Path, depth_m: float | None = None) -> PsfBank:
    """A bank in the order of the model's colours; measured ones with the energy of the model's own PSF at `depth_m`."""
    if abs(bank.pixel_m / model.pixel_m - 1) > _PITCH_TOLERANCE:
        rule = f"PSFs must have the {1e6 * model.pixel_m:.5g} um pixels that the network was trained with"
        cure = "Compute or bin them at that pitch, or train for this one."
        raise InputError(str(path), rule, f"{1e6 * bank.pixel_m:.5g} um", cure)
    sides = bank.energy.shape[-2:]
    if even := [side for side in sides if side % 2 == 0]:
        rule = "PSFs must have an odd window, for in an even one the chief ray hits a corner of four pixels"
        cure = (
            f"Compute them from a spec with an odd sensor.window, such as {even[0] + 1}; cut measured ones to an odd "
            "number of pixels about the one that the chief ray hits."
        )
        raise InputError(str(path), rule, f"{sides[1]} x {sides[0]} pixels", cure)
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
