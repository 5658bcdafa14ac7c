"""Crops of real pairs for fine-tuning: a stream of batches, seeded, resumable, and prepared ahead by threads.

Item i of epoch e is a pure function of the seed, e and i, as in `doedesign.capture.scenes`: its place, and whether it
is exchanged left and right. **A mirrored capture was seen through a mirrored plate**, so whoever takes such an item has
to mirror the PSFs, too. They have odd windows, so that is exact.
"""

import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from doedesign.recon.model import Model
from doedesign.training.pairs import CapturePair, PairFiles, read_pair
from fab.errors import InputError

_LEAST_PX = 16
_MOST_BYTES = 2 << 30  # of pictures that are kept
_THREADS, _AHEAD = 4, 8


class PairBatch(NamedTuple):
    """Crops of several pairs; the first axis counts them.

    Attributes:
        capture: `[b, c, y, x]` linear light.
        reference: `[b, c, y, x]` display values.
        mask: `[b, y, x]`; 0 where it is not known.
        mirrored: `[b]` whether left and right are exchanged.
        names: of the pairs.
        step: number of the batch since the beginning of the first epoch.
    """

    capture: Float[np.ndarray, "b c y x"]
    reference: Float[np.ndarray, "b c y x"]
    mask: Float[np.ndarray, "b y x"]
    mirrored: Bool[np.ndarray, " b"]
    names: tuple[str, ...]
    step: int


class Pairs:
    """Pairs by their number; those that are read first are kept, as long as there is room.

    Attributes:
        files: their files.
    """

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
        """One pair.

        Raises:
            InputError: see `read_pair`.
        """
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
        """Rows and columns that every pair has; all are read for it, and refused if they cannot be used.

        Raises:
            InputError: see `read_pair`.
        """
        with ThreadPoolExecutor(_THREADS) as pool:
            sizes = list(pool.map(lambda k: self.get(k).capture.shape[1:], range(len(self))))
        return min(y for y, _ in sizes), min(x for _, x in sizes)


class PairData(NamedTuple):
    """A stream of batches of crops. An epoch shows every pair once.

    Attributes:
        pairs: the pairs.
        shape: pixels (y, x) of a crop.
        seed: seed of everything.
        batch: crops per batch.
        mirrored: whether left and right are exchanged at random.
    """

    pairs: Pairs
    shape: tuple[int, int]
    seed: int
    batch: int
    mirrored: bool = True

    def at(self, step: int) -> PairBatch:
        """Make one batch.

        Args:
            step: its number.
        """
        places = [divmod(step * self.batch + k, len(self.pairs)) for k in range(self.batch)]
        crops, mirrored, names = zip(*(self._crop(*place) for place in places), strict=True)
        capture, reference, mask = (np.stack(images) for images in zip(*crops, strict=True))
        return PairBatch(capture, reference, mask, np.array(mirrored), names, step)

    def _crop(self, epoch: int, index: int) -> tuple[CapturePair, bool, str]:
        """One item: the crop, whether it is mirrored, and the name of its pair."""
        chosen = int(_turn(self.seed, epoch, len(self.pairs))[index])
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(epoch, index)))
        place, mirror = (float(rng.uniform()), float(rng.uniform())), bool(rng.integers(2)) and self.mirrored
        crop = cut(self.pairs.get(chosen), self.shape, place)
        if mirror:
            crop = CapturePair(*(image[..., ::-1] for image in crop))
        return crop, mirror, self.pairs.files[chosen].name

    @contextmanager
    def batches(self, start: int, stop: int) -> Iterator[Iterator[PairBatch]]:
        """Open the stream; a few batches are prepared ahead.

        Args:
            start: number of the first batch.
            stop: number of the batch before which it ends.

        Yields:
            an iterator over batches.
        """
        pool = ThreadPoolExecutor(_THREADS, thread_name_prefix="pairs")
        try:
            yield self._stream(pool, start, stop)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _stream(self, pool: ThreadPoolExecutor, start: int, stop: int) -> Iterator[PairBatch]:
        waiting: deque[Future[PairBatch]] = deque()
        for number in range(start, stop + _AHEAD):
            if number < stop:
                waiting.append(pool.submit(self.at, number))
            if number >= start + _AHEAD:
                yield waiting.popleft().result()


@lru_cache(maxsize=4)
def _turn(seed: int, epoch: int, count: int) -> np.ndarray:
    """The pairs of an epoch, in its order."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(epoch,))).permutation(count)


def cut(pair: CapturePair, shape: tuple[int, int], place: tuple[float, float] = (0.5, 0.5)) -> CapturePair:
    """The same crop of everything in a pair.

    Args:
        pair: the pair.
        shape: pixels (y, x) of the crop.
        place: where it lies, from 0 (lowest) to 1.
    """
    spare = [have - want for have, want in zip(pair.mask.shape, shape, strict=True)]
    y, x = (min(int(share * (most + 1)), most) for share, most in zip(place, spare, strict=True))
    return CapturePair(*(image[..., y : y + shape[0], x : x + shape[1]] for image in pair))


def crop_shape(least: tuple[int, int], size: int, multiple: int, where: str) -> tuple[int, int]:
    """Pixels (y, x) of crops: `size`, or the most that every pair has.

    Args:
        least: rows and columns that every pair has.
        size: pixels per side that are wanted.
        multiple: what both have to be multiples of (`Layout.multiple`).
        where: the folder, for messages.

    Raises:
        InputError: a pair that is too small.
    """
    y, x = (min(size, side) // multiple * multiple for side in least)
    # At the coarsest scale a border is reflected, which takes two pixels.
    needed = max(_LEAST_PX, 2 * multiple)
    if min(y, x) < needed:
        got = f"{least[1]} x {least[0]}" if min(least) < needed else f"crops of {size}"
        rule = f"pairs and crops must have at least {needed} x {needed} pixels for this network"
        raise InputError(where, rule, got, "Give larger pictures, or a larger --size.")
    return y, x
