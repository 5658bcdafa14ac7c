"""Real pairs for fine-tuning: captures through a DOE with their references; found, split, read, and cut into crops.

    DIR/NAME_capture.png     DIR/capture/NAME.png       through the DOE and the obstruction
    DIR/NAME_reference.png   DIR/reference/NAME.png     the same frame without either, pixel for pixel
    DIR/NAME_mask.png        DIR/mask/NAME.png          where it was covered, white for wholly; where it is known

Either way of naming, any kind of file that `doedesign.recon.photos` reads. Pairs may differ in size.

Pairs that are never trained on are the last in an order shuffled by the seed. Whatever has the capture or the reference
of one of them under another name is not trained on either: the same view behind other dirt is the same view.

Crop i of epoch e is a pure function of the seed, e and i, as scenes are (`doedesign.capture.scenes`): its place, and
whether it is exchanged left and right. **A mirrored capture was taken through a mirrored DOE**, so whoever takes such a
crop has to mirror the PSFs, too. They have odd windows, so that is exact.
"""

import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.capture.scenes import Batch, batches_ahead, epoch_order
from doedesign.recon.model import Model
from doedesign.recon.photos import PHOTO_FILES, Photo, finite, read_capture
from doedesign.training.validation import Split
from fab.errors import InputError
from fab.files import canonical_json, explain_os_error, sha256_bytes, sha256_file
from sim.light import srgb_from_linear
from sim.store import read_picture

_PARTS = ("capture", "reference", "mask")
_ORDER = 2  # apart from the epochs' orders
_LEAST_PX = 16
_MOST_BYTES = 2 << 30  # of pictures that are kept
_THREADS, _AHEAD = 4, 8


class PairFiles(NamedTuple):
    """Files of one pair, and the name that they share; the mask where it is known."""

    name: str
    capture: Path
    reference: Path
    mask: Path | None


class CapturePair(NamedTuple):
    """One pair, in the network's colours.

    Attributes:
        capture: `[c, y, x]` linear light, white 1.
        reference: `[c, y, x]` display values of the scene alone.
        mask: `[y, x]` share of each pixel that was covered; 0 where it is not known.
    """

    capture: Float[np.ndarray, "c y x"]
    reference: Float[np.ndarray, "c y x"]
    mask: Float[np.ndarray, "y x"]


def find_pairs(folder: Path) -> tuple[PairFiles, ...]:
    """Find all pairs of a folder, in the order of their names.

    Raises:
        InputError: no folder, no pair, a pair without one of its parts, or with two files for one.
    """
    cure = "Name pairs NAME_capture.png and NAME_reference.png, or put them into the folders capture and reference."
    found: dict[str, dict[str, Path]] = {}
    for part, name, path in _parts(folder):
        parts = found.setdefault(name, {})
        if part in parts:
            got = f"{parts[part].name} and {path.name}"
            raise InputError(str(folder), f"a pair must have one {part}", got, "Remove one of them.")
        parts[part] = path
    if not found:
        raise InputError(str(folder), "must hold pairs of capture and reference", "none", cure)
    for name, parts in sorted(found.items()):
        if lacking := [part for part in _PARTS[:2] if part not in parts]:
            present = next(iter(parts.values()))
            rule = f'the pair "{name}" must have a {lacking[0]}'
            raise InputError(str(folder), rule, f"{present.name} alone", f"Add it, or remove {present.name}. {cure}")
    return tuple(PairFiles(name, p["capture"], p["reference"], p.get("mask")) for name, p in sorted(found.items()))


def _parts(folder: Path) -> Iterator[tuple[str, str, Path]]:
    """Every picture as a part of a named pair."""
    try:
        inside = any((folder / part).is_dir() for part in _PARTS[:2])
        for part in _PARTS:
            home = folder / part if inside else folder
            for path in sorted(home.iterdir()) if home.is_dir() or not inside else ():
                if path.suffix.lower() not in PHOTO_FILES or path.name.startswith("."):
                    continue
                name = path.stem if inside else path.stem.removesuffix(f"_{part}")
                if name and (inside or name != path.stem):
                    yield part, name, path
    except OSError as error:
        raise explain_os_error(error, str(error.filename or folder)) from error


def split_pairs(pairs: Sequence[PairFiles], count: int | None, seed: int, where: str) -> Split:
    """Hold out a number of pairs, a fifth and at most eight if None; messages name the folder (`where`).

    Raises:
        InputError: nothing left to train on.
    """
    count = max(1, min(8, len(pairs) // 5)) if count is None else count
    if not 1 <= count < len(pairs):
        rule = f"must be from 1 to {len(pairs) - 1}, fewer than the pairs in {where}"
        cure = "Give more pairs, or hold out fewer."
        raise InputError("validation", rule, count, cure)
    order = np.random.default_rng((seed, _ORDER)).permutation(len(pairs))[-count:]
    chosen = {int(k) for k in order}
    seen = {digest for k in chosen for digest in _digests(pairs[k])[:2]}
    rest = [pair for k, pair in enumerate(pairs) if k not in chosen]
    left_out = tuple(pair for pair in rest if seen & {*_digests(pair)[:2]})
    training = tuple(pair for pair in rest if pair not in left_out)
    if not training:
        rule = "a pair must be left to train on, none of whose pictures is held out"
        raise InputError(where, rule, f"{len(pairs)} pairs that share theirs", "Give pairs of other views.")
    return Split(training, tuple(pairs[int(k)] for k in order), left_out)


def _digests(pair: PairFiles) -> list[str]:
    try:
        return [sha256_file(path) for path in (pair.capture, pair.reference, pair.mask) if path is not None]
    except OSError as error:
        raise explain_os_error(error, str(error.filename)) from error


def pairs_digest(pairs: Sequence[PairFiles]) -> str:
    """SHA-256 of the content of all files, in their order."""
    return sha256_bytes(canonical_json([_digests(pair) for pair in pairs]))


def read_pair(files: PairFiles, model: Model, linear: bool | None = None) -> CapturePair:
    """Read one pair in the colours of a model; `linear` as in `doedesign.recon.photos.read_capture`.

    Raises:
        InputError: a file that cannot be used, or files of different sizes.
    """
    named = (files.capture, files.reference)
    capture, reference = (model.channels(read_capture(path, linear).light, str(path)) for path in named)
    mask = np.broadcast_to(np.float32(0), capture.shape[1:])
    if files.mask is not None:
        mask = np.clip(_covered(files.mask), 0, 1)
    wanted, *found = (f"{image.shape[-1]} x {image.shape[-2]}" for image in (capture, reference, mask))
    for path, size in zip((files.reference, files.mask), found, strict=True):
        if size != wanted:
            rule = f"must have the {wanted} pixels of {files.capture.name}"
            raise InputError(str(path), rule, size, "Cut both to the same frame.")
    return CapturePair(capture, srgb_from_linear(reference).astype(np.float32), mask)


def _covered(path: Path) -> Float[np.ndarray, "y x"]:
    """Share of each pixel that was covered, from a grey picture or from the channel M of what `simulate` writes."""
    if path.suffix.lower() == ".exr":
        channels, _ = read_picture(path)
        if set(channels) == {"M"}:
            return finite(Photo(channels["M"][None], None, True, str(path))).light[0]
    # A share of a pixel follows no curve. Colours of a mask are all the same.
    return read_capture(path, linear=True).light.mean(axis=0)


class Pairs:
    """Pairs by their number; those that are read first are kept, as long as there is room."""

    def __init__(
        self, files: Sequence[PairFiles], model: Model, linear: bool | None = None, most_bytes: int = _MOST_BYTES
    ) -> None:
        self.files = tuple(files)
        self._model, self._linear = model, linear
        self._kept: dict[int, CapturePair] = {}
        self._room, self._lock = most_bytes, threading.Lock()

    def __len__(self) -> int:
        return len(self.files)

    def get(self, index: int) -> CapturePair:
        """One pair; see `read_pair`."""
        with self._lock:
            if index in self._kept:
                return self._kept[index]
        pair = read_pair(self.files[index], self._model, self._linear)
        size = sum(image.nbytes for image in pair)
        with self._lock:
            if index not in self._kept and size <= self._room:
                self._kept[index] = pair
                self._room -= size
        return pair

    def least_size(self) -> tuple[int, int]:
        """Rows and columns that every pair has; all are read for it, and refused if they cannot be used."""
        with ThreadPoolExecutor(_THREADS) as pool:
            sizes = list(pool.map(lambda k: self.get(k).capture.shape[1:], range(len(self))))
        return min(y for y, _ in sizes), min(x for _, x in sizes)


class PairCrop(NamedTuple):
    """A crop of the pair of this name, and whether left and right are exchanged."""

    name: str
    pair: CapturePair
    mirrored: bool


@dataclass(frozen=True)
class PairData:
    """A stream of batches of crops of `shape` (y, x), exchanged left and right at random if `mirrored`.

    An epoch shows every pair once.
    """

    pairs: Pairs
    shape: tuple[int, int]
    seed: int
    batch: int
    mirrored: bool = True

    def item(self, number: int) -> PairCrop:
        """Make one crop; every epoch has as many as there are pairs."""
        epoch, index = divmod(number, len(self.pairs))
        chosen = int(epoch_order(self.seed, epoch, len(self.pairs))[index])
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(epoch, index)))
        place, mirror = (float(rng.uniform()), float(rng.uniform())), bool(rng.integers(2)) and self.mirrored
        crop = cut(self.pairs.get(chosen), self.shape, place)
        if mirror:
            crop = CapturePair(*(image[..., ::-1] for image in crop))
        return PairCrop(self.pairs.files[chosen].name, crop, mirror)

    def batches(self, start: int, stop: int) -> AbstractContextManager[Iterator[Batch]]:
        """Open the stream, from batch number `start` to the one before `stop`; some are prepared ahead."""
        return batches_ahead(self.item, self.batch, start, stop, _THREADS, _AHEAD)


def cut(pair: CapturePair, shape: tuple[int, int], place: tuple[float, float] = (0.5, 0.5)) -> CapturePair:
    """The same crop of everything in a pair: `shape` pixels (y, x) at a `place` from 0 (lowest) to 1."""
    spare = [have - want for have, want in zip(pair.mask.shape, shape, strict=True)]
    y, x = (min(int(share * (most + 1)), most) for share, most in zip(place, spare, strict=True))
    return CapturePair(*(image[..., y : y + shape[0], x : x + shape[1]] for image in pair))


def crop_shape(least: tuple[int, int], size: int, multiple: int, where: str) -> tuple[int, int]:
    """Pixels (y, x) of crops: `size`, or the `least` that every pair has, as multiples of `NetworkShape.multiple`.

    Raises:
        InputError: a pair that is too small.
    """
    y, x = (min(size, side) // multiple * multiple for side in least)
    # At the coarsest scale a border is reflected, which takes two pixels.
    needed = max(_LEAST_PX, 2 * multiple)
    if min(y, x) < needed:
        got = f"{least[1]} x {least[0]}" if min(least) < needed else f"crops of {size}"
        rule = f"pairs and crops must have at least {needed} x {needed} pixels for this network"
        raise InputError(where, rule, got, "Give larger pictures, or a larger `size`.")
    return y, x
