"""Real pairs for fine-tuning: captures through a plate, and what was to be seen.

    DIR/NAME_capture.png     DIR/capture/NAME.png       through the plate and the obstruction
    DIR/NAME_reference.png   DIR/reference/NAME.png     the same frame without either, pixel for pixel
    DIR/NAME_mask.png        DIR/mask/NAME.png          where it was covered, white for wholly; where it is known

Either way of naming, any kind of file that `doedesign.recon.photos` reads. Pairs may differ in size.

Pairs that are never trained on are the last in an order shuffled by the seed. Whatever has the capture or the reference
of one of them under another name is not trained on either: the same view behind other dirt is the same view.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.recon.model import Model
from doedesign.recon.photos import PHOTO_FILES, read_capture
from fab.errors import InputError
from fab.files import canonical_json, explain_os_error, sha256_bytes, sha256_file
from sim.light import srgb_from_linear

_PARTS = ("capture", "reference", "mask")
_ORDER = 2  # apart from the epochs' orders


class PairFiles(NamedTuple):
    """Files of one pair.

    Attributes:
        name: what both are called.
        capture: the capture.
        reference: what was to be seen.
        mask: where it was covered, if known.
    """

    name: str
    capture: Path
    reference: Path
    mask: Path | None


class CapturePair(NamedTuple):
    """One pair, in the network's colours.

    Attributes:
        capture: `[c, y, x]` linear light, white 1.
        reference: `[c, y, x]` display values of what was to be seen.
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
    """Which part of which pair every picture is."""
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


class PairSplit(NamedTuple):
    """Two sets of pairs without a view in common.

    Attributes:
        training: pairs to train on.
        held_out: pairs that are never trained on.
        left_out: pairs that are neither, since they share a file's content with one held out.
    """

    training: tuple[PairFiles, ...]
    held_out: tuple[PairFiles, ...]
    left_out: tuple[PairFiles, ...]


def split_pairs(pairs: Sequence[PairFiles], count: int | None, seed: int, where: str) -> PairSplit:
    """Keep some pairs away from training.

    Args:
        pairs: all of them.
        count: number to hold out; a fifth of them, and at most eight, if None.
        seed: seed of the order that they are the last of.
        where: the folder, for messages.

    Raises:
        InputError: nothing left to train on.
    """
    count = max(1, min(8, len(pairs) // 5)) if count is None else count
    if not 1 <= count < len(pairs):
        rule = f"must be from 1 to {len(pairs) - 1}, fewer than the pairs in {where}"
        cure = "Give more pairs, or hold out fewer."
        raise InputError("--validation", rule, count, cure)
    order = np.random.default_rng((seed, _ORDER)).permutation(len(pairs))[-count:]
    chosen = {int(k) for k in order}
    seen = {digest for k in chosen for digest in _digests(pairs[k])[:2]}
    rest = [pair for k, pair in enumerate(pairs) if k not in chosen]
    left_out = tuple(pair for pair in rest if seen & {*_digests(pair)[:2]})
    training = tuple(pair for pair in rest if pair not in left_out)
    if not training:
        rule = "a pair must be left to train on, none of whose pictures is held out"
        raise InputError(where, rule, f"{len(pairs)} pairs that share theirs", "Give pairs of other views.")
    return PairSplit(training, tuple(pairs[int(k)] for k in order), left_out)


def _digests(pair: PairFiles) -> list[str]:
    try:
        return [sha256_file(path) for path in (pair.capture, pair.reference, pair.mask) if path is not None]
    except OSError as error:
        raise explain_os_error(error, str(error.filename)) from error


def pairs_digest(pairs: Sequence[PairFiles]) -> str:
    """SHA-256 of the content of all files, in their order."""
    return sha256_bytes(canonical_json([_digests(pair) for pair in pairs]))


def read_pair(files: PairFiles, model: Model, linear: bool | None = None) -> CapturePair:
    """Read one pair.

    Args:
        files: its files.
        model: the model, for its colours.
        linear: whether PNG and TIFF hold linear light; by default what is usual for their kind.

    Raises:
        InputError: a file that cannot be used, or files of different sizes.
    """
    named = (files.capture, files.reference)
    capture, reference = (model.channels(read_capture(path, linear).light, str(path)) for path in named)
    mask = np.broadcast_to(np.float32(0), capture.shape[1:])
    if files.mask is not None:
        # A share of a pixel follows no curve. Colours of a mask are all the same.
        mask = np.clip(read_capture(files.mask, linear=True).light.mean(axis=0), 0, 1)
    for path, image in ((files.reference, reference), (files.mask, mask)):
        if image.shape[-2:] != capture.shape[1:]:
            rule = f"must have the {_size(capture)} pixels of {files.capture.name}"
            raise InputError(str(path), rule, _size(image), "Cut both to the same frame.")
    return CapturePair(capture, srgb_from_linear(reference).astype(np.float32), mask)


def _size(image: np.ndarray) -> str:
    return f"{image.shape[-1]} x {image.shape[-2]}"
