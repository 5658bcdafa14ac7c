"""A trained network with the camera that it was trained for, and the PSFs that it is given.

    FOLDER/
        network.npz     the network, and which camera it was trained for (`doedesign.recon.weights`)
        psf.exr         PSFs of its DOE

A model is such a folder: RUN/trained, RUN/finetuned, or a released one. Its PSFs can be replaced by others, of the DOE
as fabricated or as measured, without training anew.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Num

import doedesign
from doedesign.capture.camera import middle_depth_m
from doedesign.capture.from_spec import LUMINANCE, longest_first
from doedesign.capture.simulate import SimulatedCapture
from doedesign.recon.network import Network
from doedesign.recon.photos import Photo, photo_from_array, read_capture
from doedesign.recon.reconstruction import Reconstruction
from doedesign.recon.tiles import OVERLAP, TILE, reconstruct_tiled
from doedesign.recon.weights import BANK_NAME, NETWORK_NAME, read_network
from fab.errors import InputError
from fab.files import path_of, paths_of, sha256_file
from fab.units import distance_from
from sim.metrics import mean_wavelength_m
from sim.psf_bank import PsfBank
from sim.store import is_own_bank, read_bank

RELEASED = Path("masks/released")

_PITCH_TOLERANCE = 1e-3  # a ring of 500 pixels is then off by half a pixel
_WAVELENGTH_TOLERANCE_M = 5e-9
_MEASURED = ("R", "G", "B")
_log = logging.getLogger("doedesign")


class PsfPair(NamedTuple):
    """The PSFs `[c, y, x]` of scene and obstruction that a network is given, energy per pixel, odd windows.

    Attributes:
        far: PSFs of the scene.
        near: PSFs of the obstruction.
        far_m: distance of the scene, metres.
        near_m: distance of the obstruction, metres.
        bank: PSFs at these depths and others; of two files, these two alone, in the larger window.
        digests: SHA-256 of the files that they were read from, if not the model's own, by name.
    """

    far: Float[np.ndarray, "c ky kx"]
    near: Float[np.ndarray, "c kv ku"]
    far_m: float
    near_m: float
    bank: PsfBank
    digests: Mapping[str, str] = {}


@dataclass(frozen=True, eq=False)
class Model:
    """A trained network with its camera.

    Attributes:
        network: the network.
        bank: PSFs of its DOE, colours in the order of `colours`, odd windows.
        colours: names of its channels.
        wavelengths_m: mean wavelength of each channel.
        pixel_m: pixel pitch, metres.
        near_m: depths of obstructions that it was trained on.
        far_m: distance of the scene that it was trained for; None for the farthest of the bank.
        about: all that the network's file says of it.
        folder: where it was read from; None for one that was not.
        digests: SHA-256 of its files.
    """

    network: Network
    bank: PsfBank
    colours: tuple[str, ...]
    wavelengths_m: tuple[float, ...]
    pixel_m: float
    near_m: tuple[float, ...]
    far_m: float | None = None
    about: Mapping[str, Any] = field(default_factory=dict)
    folder: Path | None = None
    digests: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def released(cls) -> "Model":
        """Open the model that comes with the project, below the current folder or in the checkout.

        Raises:
            InputError: there is none.
        """
        places = (RELEASED, Path(doedesign.__file__).parents[1] / RELEASED)
        found = next((place for place in places if (place / NETWORK_NAME).is_file()), None)
        if found is None:
            rule = "without a model the released one is taken, and must be there"
            got, cure = "no such folder here or in the checkout", "Give the folder of a model."
            raise InputError(str(RELEASED), rule, got, cure)
        return cls.open(found)

    @classmethod
    def open(cls, folder: str | Path) -> "Model":
        """Read a model from the folder with its files, or from a run whose `trained` folder has them.

        Raises:
            InputError: files that are missing, broken, or do not belong together.
        """
        places = (path_of(folder, "folder") / "trained", Path(folder))
        home = next((place for place in places if (place / NETWORK_NAME).is_file()), None)
        if home is None:
            cure = "Train one (`doedesign.train`), or give the folder of a released model."
            raise InputError(str(folder), f"must hold a trained network ({NETWORK_NAME})", "none", cure)
        where = home / NETWORK_NAME
        network, about = read_network(where)
        try:
            colours = tuple(str(name) for name in about["colours"])
            waves, near = (tuple(float(value) for value in about[key]) for key in ("wavelengths_m", "near_m"))
            pixel = float(about["pixel_m"])
            far = None if about.get("far_m") is None else float(about["far_m"])
        except (KeyError, TypeError, ValueError) as error:
            rule = "must say colours, wavelengths_m, pixel_m and near_m of its camera"
            cure = "Write the network again with `camera_facts`."
            raise InputError(str(where), rule, f'"{error!r}"', cure) from error
        if not len(colours) == len(waves) == network.layout.colours or not near or min(near) <= 0 or not pixel > 0:
            got = f"{len(colours)} names and {len(waves)} wavelengths for {network.layout.colours} channels"
            raise InputError(str(where), "what it says of its camera must fit its layout", got, "Write it again.")
        digests = {name: sha256_file(home / name) for name in (NETWORK_NAME, BANK_NAME)}
        bank = read_bank(home / BANK_NAME)
        model = cls(network, bank, colours, waves, pixel, near, far, about, home, digests)
        return replace(model, bank=model._fitted(bank, home / BANK_NAME))

    def channels(self, image: Float[np.ndarray, "k y x"], where: str = "capture") -> Float[np.ndarray, "c y x"]:
        """Bring red, green and blue, or one colour, into the channels of the network; luminance where it has one.

        Raises:
            InputError: a grey image for a network of several colours.
        """
        count, given = len(self.colours), len(image)
        if given == count:
            return image[np.argsort(longest_first(self.wavelengths_m))]
        if count == 1:
            return np.tensordot(LUMINANCE, image, 1)[None].astype(np.float32)
        rule = f"a capture must have the {count} colours of the network"
        raise InputError(where, rule, f"{given}", "Give a capture in colour, or a network trained on one colour.")

    def rgb(self, image: Float[np.ndarray, "c y x"]) -> Float[np.ndarray, "c y x"]:
        """Bring the network's channels into red, green and blue, or the one colour that it has."""
        return np.ascontiguousarray(image[longest_first(self.wavelengths_m)])

    def psfs(
        self,
        files: str | Path | Sequence[str | Path] = (),
        *,
        pixel_m: float | None = None,
        near_m: float | str | None = None,
        far_m: float | str | None = None,
    ) -> PsfPair:
        """PSFs of the scene and of the obstruction, the model's own or those of files.

        Args:
            files: one bank, or two files, of the scene and of the obstruction. A file of another program (channels R,
                G, B, or one) is taken as measured, and scaled to the energy of the model's own PSF.
            pixel_m: pixel pitch of measured PSFs, metres; only with files.
            near_m: distance of the obstruction, metres or with a unit; if None the middle, in 1/z, of what the network
                was trained on.
            far_m: the same of the scene; if None what the network was trained for, or the farthest of the PSFs where it
                does not say that or they have none of it.

        Raises:
            InputError: files that cannot be used, or a depth beyond a bank's.
        """
        if pixel_m is not None and not files:
            rule, cure = "goes with PSFs of another program", "Give their files, too, or leave it out."
            raise InputError("pixel_m", rule, "the model's own PSFs", cure)
        near_m = middle_depth_m(self.near_m) if near_m is None else distance_from(near_m, "near_m")
        far_m = far_m if far_m is None else distance_from(far_m, "far_m")
        paths = list(paths_of(files, "files"))
        if not paths:
            own_m = self._usual_far_m(self.bank) if far_m is None else far_m
            return _pair(self.bank, self.bank, own_m, near_m)
        if len(paths) > 2:
            rule = "must be one bank, or one file of the scene and one of the obstruction"
            raise InputError("psf", rule, f"{len(paths)} files", "Give one or two.")
        usual = self._usual_far_m(self.bank) if far_m is None else far_m
        banks = [
            self._fitted(read_bank(path, pixel_m, depth), path, depth)
            for path, depth in zip(paths, (usual, near_m), strict=False)
        ]
        if len(banks) == 1 and len(banks[0].depths_m) == 1:
            rule = "PSFs of the scene and of the obstruction are needed"
            raise InputError(str(paths[0]), rule, "one depth", "Give two files, first that of the scene.")
        far_m = self._usual_far_m(banks[0]) if far_m is None else far_m
        digests = {path.name: sha256_file(path) for path in paths}
        return _pair(banks[0], banks[-1], far_m, near_m)._replace(digests=digests)

    def _usual_far_m(self, bank: PsfBank) -> float:
        """Distance of the scene that the network is told of by a bank where nobody states one."""
        nearest, farthest = min(bank.depths_m), max(bank.depths_m)
        return farthest if self.far_m is None or not nearest <= self.far_m <= farthest else self.far_m

    def reconstruct(
        self,
        capture: str | Path | Num[np.ndarray, "..."] | Photo | SimulatedCapture,
        *,
        psfs: PsfPair | None = None,
        linear: bool | None = None,
        tile: int = TILE,
        overlap: int = OVERLAP,
        on_tile: Callable[[int], None] = lambda _: None,
    ) -> Reconstruction:
        """Reconstruct what a capture shows behind its obstruction.

        Args:
            capture: a file (`doedesign.recon.photos`), read or not; an array `[y, x, 3]` or `[y, x]`, row 0 at the
                lowest y; or what `doedesign.simulate` returns, whose own PSFs the network is then given.
            psfs: PSFs to give to the network instead.
            linear: whether values are linear light with white 1; by default floats and RAW are, and integers are
                display values (sRGB), white at their highest count.
            tile: the most pixels of a tile's side. Time and seams shrink as it grows, memory grows with its square.
            overlap: pixels that tiles share.
            on_tile: called after each tile with the number of tiles that are done.

        Raises:
            InputError: a capture that cannot be read or has other colours than the network.
            ValueError: see `doedesign.recon.tiles.plan_tiles`.
        """
        if isinstance(capture, SimulatedCapture):
            photo, psfs = Photo(capture.rgb(capture.doe), None, True, capture.name), psfs or self._psfs_of(capture)
        elif isinstance(capture, str | Path):
            photo = read_capture(capture, linear)
        else:
            photo = capture if isinstance(capture, Photo) else photo_from_array(capture, linear)
        light, psfs = self.channels(photo.light, photo.name), psfs or self.psfs()
        multiple = self.network.layout.multiple
        options: Any = {"tile": tile, "overlap": overlap, "multiple": multiple, "on_tile": on_tile}
        picture = reconstruct_tiled(self.network, light, psfs.far, psfs.near, **options)
        return Reconstruction(self.rgb(picture), self.rgb(light), psfs.near_m, psfs.far_m, photo.name)

    def _psfs_of(self, capture: SimulatedCapture) -> PsfPair:
        """The PSFs of a simulated capture's own DOE; warns where its camera is not that of the training."""
        camera = capture.camera
        waves = sorted((mean_wavelength_m(colour) for colour in camera.colours), reverse=True)
        off_m = np.subtract(sorted(self.wavelengths_m, reverse=True), waves) if len(waves) == len(self.colours) else inf
        if abs(camera.pixel_m / self.pixel_m - 1) > _PITCH_TOLERANCE or np.max(np.abs(off_m)) > _WAVELENGTH_TOLERANCE_M:
            _log.warning(
                "the network was trained for another camera (%s) than that of the capture (%s); it is given the "
                "PSFs of the capture, but one that is trained for this camera may do better",
                _words(self.pixel_m, self.wavelengths_m),
                _words(camera.pixel_m, waves),
            )
        far, near = (self.channels(capture.rgb(psf), capture.name) for psf in (capture.psf_far, capture.psf_near))
        depths_m = (capture.depth_near_m, capture.depth_far_m)
        bank = PsfBank(np.stack([near, far], axis=1), self.colours, depths_m, camera.pixel_m)
        return PsfPair(far, near, capture.depth_far_m, capture.depth_near_m, bank)

    def _fitted(self, bank: PsfBank, path: Path, depth_m: float | None = None) -> PsfBank:
        """A bank in the order of the model's colours; measured ones with the energy of the model's own at `depth_m`."""
        if abs(bank.pixel_m / self.pixel_m - 1) > _PITCH_TOLERANCE:
            rule = f"PSFs must have the {1e6 * self.pixel_m:.5g} um pixels that the network was trained with"
            cure = "Compute or bin them at that pitch, or train for this one."
            raise InputError(str(path), rule, f"{1e6 * bank.pixel_m:.5g} um", cure)
        sides = bank.energy.shape[-2:]
        if even := [side for side in sides if side % 2 == 0]:
            rule = "PSFs must have an odd window, for in an even one the chief ray hits a corner of four pixels"
            cure = (
                f"Compute them with an odd window, such as {even[0] + 1} pixels; cut measured ones to an odd number of "
                "pixels about the one that the chief ray hits."
            )
            raise InputError(str(path), rule, f"{sides[1]} x {sides[0]} pixels", cure)
        count = len(self.colours)
        # Colours may have the names that files of other programs give theirs: a CSV of responses may say R, G and B.
        foreign = depth_m is not None and len(bank.depths_m) == 1 and not is_own_bank(path)
        if set(bank.colours) == set(self.colours) and len(bank.colours) == count and not foreign:
            order = [bank.colours.index(name) for name in self.colours]
            return PsfBank(bank.energy[order], self.colours, bank.depths_m, bank.pixel_m, bank.field_rad)
        measured = depth_m is not None and len(bank.depths_m) == 1
        if not measured or len(bank.colours) != count or (count == 3 and bank.colours != _MEASURED):
            rule = f"PSFs must have the colours of the network, {', '.join(self.colours)}"
            got, cure = ", ".join(bank.colours), "Give PSFs of the camera that the network was trained for."
            raise InputError(str(path), rule, got, cure)
        assert depth_m is not None  # that of a measured one
        own = _at(self.bank, depth_m, str(path)).sum(axis=(1, 2), dtype=np.float64)
        energy = bank.energy[np.argsort(longest_first(self.wavelengths_m))]
        total = energy.sum(axis=(1, 2, 3), dtype=np.float64)
        if not (total > 0).all():
            raise InputError(str(path), "a PSF must hold light", f"a sum of {total.min():.3g}", "Check its background.")
        scaled = (energy * (own / total)[:, None, None, None]).astype(np.float32)
        return PsfBank(scaled, self.colours, bank.depths_m, bank.pixel_m, bank.field_rad)


def _words(pixel_m: float, wavelengths_m: Sequence[float]) -> str:
    return f"{1e6 * pixel_m:.4g} um pixels, {', '.join(f'{1e9 * w:.0f}' for w in wavelengths_m)} nm"


def _at(bank: PsfBank, depth_m: float, name: str) -> Float[np.ndarray, "c y x"]:
    if not depth_m > 0:
        raise InputError(name, "must be a positive distance", f"{depth_m:g} m", "Give metres, or inf.")
    try:
        return np.asarray(bank.at(depth_m))
    except InputError as error:
        raise InputError(name, error.rule, error.got, error.cure) from error


def _pair(of_scene: PsfBank, of_obstruction: PsfBank, far_m: float, near_m: float) -> PsfPair:
    """PSFs at two depths of one bank, or one of each of two."""
    far, near = _at(of_scene, far_m, "far_m"), _at(of_obstruction, near_m, "near_m")
    if not near_m < far_m:
        rule, got = "the obstruction must be nearer than the scene", f"{near_m:g} m before {far_m:g} m"
        raise InputError("near_m", rule, got, "Exchange the two, or give both.")
    if of_obstruction is of_scene:
        return PsfPair(far, near, far_m, near_m, of_scene)
    window = max(far.shape[1], near.shape[1]), max(far.shape[2], near.shape[2])
    far, near = _widened(far, window), _widened(near, window)
    energy, depths = np.stack([near, far], axis=1), (near_m, far_m)
    bank = PsfBank(energy, of_scene.colours, depths, of_scene.pixel_m, of_scene.field_rad)
    return PsfPair(far, near, far_m, near_m, bank)


def _widened(psf: Float[np.ndarray, "c y x"], window: tuple[int, int]) -> Float[np.ndarray, "c v u"]:
    """A PSF in a larger odd window, its middle pixel in the middle."""
    margins = [(large - small) // 2 for large, small in zip(window, psf.shape[1:], strict=True)]
    return np.pad(psf, ((0, 0), *((margin, margin) for margin in margins)))
