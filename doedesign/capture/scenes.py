"""Scenes from pictures and obstructions: one, or a stream of batches, seeded, resumable, and prepared ahead by threads.

Item i of epoch e is a pure function of the seed, e and i: the picture, the crop, its mirror image, the obstruction and
both depths are drawn from a generator of their own (`numpy.random.SeedSequence` with the spawn key (e, i)), and every
epoch goes through the pictures in an order of its own. So a stream that starts at step n gives what one from the
beginning gives there, whatever the number of threads. A picture that cannot be decoded is replaced by the next one in
the epoch's order, so that numbering does not depend on when the damage was found.

Threads are enough: decoding, and most of what numpy does, lets go of the interpreter. Leaving the `with` block ends
them; an error in one of them ends the stream, and says from which item and picture it came.

    data = SceneData(Pictures(picture_files(folder)), Dirt(), CameraView((512, 512), 3.7e-6, 8e-3), far_m=(5.0, 10.0))
    with data.batches(start=step) as batches:
        for batch in batches: ...
"""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from doedesign.capture.images import Picture, Pictures, crop, linear_light, zoomed
from fab.errors import InputError
from fab.units import is_whole
from sim.imaging.scene import Scene
from sim.obstruction import CameraView, ObstructionKind


def require_seed(seed: int) -> None:
    """Refuse a seed that scenes and their noise cannot be drawn by.

    Args:
        seed: the seed.

    Raises:
        InputError: it is no whole number, negative, or beyond 32 bits.
    """
    if not is_whole(seed, 0, (1 << 32) - 1):
        raise InputError("seed", "must be from 0 to 4294967295", seed, "For example 0.")


class NamedScene(NamedTuple):
    """One obstruction before the picture of this name; colours are red, green and blue, arrays float32."""

    name: str
    scene: Scene


class Batch(NamedTuple):
    """Scenes (`NamedScene`), or crops of real pairs, of one step, counted from the beginning of the first epoch."""

    step: int
    items: tuple[Any, ...]


@dataclass(frozen=True)
class SceneData:
    """Source of scenes: pictures behind a kind of obstruction within a frame. An epoch shows every picture once.

    Attributes:
        far_m: least and greatest distance of the background, drawn evenly in 1/z; `inf` allowed.
        seed: seed of everything.
        batch: scenes per batch.
        workers: threads.
        ahead: batches that are prepared before they are asked for.
        mirrored: whether pictures are exchanged left and right at random.
        zoom: least and greatest share of a picture that a scene shows, see `draw_scene`; None for pixels as they are.
    """

    pictures: Pictures
    kind: ObstructionKind
    view: CameraView
    far_m: tuple[float, float]
    seed: int = 0
    batch: int = 1
    workers: int = 2
    ahead: int = 4
    mirrored: bool = True
    zoom: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Raise ValueError for counts below one, distances out of order, or no pictures."""
        for name in ("batch", "workers", "ahead"):
            if getattr(self, name) < 1:
                raise ValueError(f"`{name}` must be at least 1, but got {getattr(self, name)}")
        if not 0 < self.far_m[0] <= self.far_m[1]:
            raise ValueError(f"`far_m` must rise from above 0, but got {self.far_m}")
        if self.zoom is not None and not 0 < self.zoom[0] <= self.zoom[1] <= 1:
            raise ValueError(f"`zoom` must rise from above 0 to at most 1, but got {self.zoom}")
        if not len(self.pictures):
            raise ValueError("`pictures` must hold one, but got none")

    def item(self, number: int) -> NamedScene:
        """Make the scene of a number; every epoch has as many as there are pictures.

        Raises:
            InputError: no picture is whole, or the obstruction cannot be drawn.
        """
        epoch, index = divmod(number, len(self.pictures))
        name, picture = self._picture(epoch, index)
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(epoch, index)))
        try:
            scene = draw_scene(picture, self.kind, self.view, self.far_m, rng, self.mirrored, self.zoom)
            return NamedScene(name, scene)
        except Exception as error:
            error.add_note(f"while preparing scene {index} of epoch {epoch} from {name}")
            raise

    def _picture(self, epoch: int, index: int) -> tuple[str, Picture]:
        order = epoch_order(self.seed, epoch, len(self.pictures))
        return self.pictures.first_whole(np.roll(order, -index).tolist())

    def batches(self, start: int = 0, stop: int | None = None) -> AbstractContextManager[Iterator[Batch]]:
        """Open the stream, from batch number `start` to the one before `stop`, without end by default."""
        return batches_ahead(self.item, self.batch, start, stop, self.workers, self.ahead)


def draw_scene(
    picture: Picture,
    kind: ObstructionKind,
    view: CameraView,
    far_m: tuple[float, float],
    rng: np.random.Generator,
    mirrored: bool = False,
    zoom: tuple[float, float] | None = None,
) -> Scene:
    """Put a crop of a picture behind an obstruction, at a place, at depths and of a shape that are drawn.

    A picture in which the frame does not fit is enlarged; the background's depth is drawn evenly in 1/z from `far_m`,
    and, if `mirrored`, left and right are exchanged at random. With a `zoom` the crop is not of the frame's pixels but
    of a share of the picture's shorter side, which is drawn evenly in its logarithm from this range and brought to the
    frame's pixels (`doedesign.capture.images.zoomed`): near and distant views of the same thing.
    """
    place, mirror = (rng.uniform(), rng.uniform()), bool(rng.integers(2)) and mirrored
    far = 1 / rng.uniform(1 / far_m[1], 1 / far_m[0]) if far_m[0] < far_m[1] else far_m[0]
    if zoom is None:
        shown = crop(picture, view.shape, place, mirror)
    else:
        share = float(zoom[0] * (zoom[1] / zoom[0]) ** rng.uniform())
        shown = zoomed(picture, view.shape, share, place, mirror)
    background = linear_light(shown)
    return Scene(background, float(far), (kind.draw(rng, view, background),))


@lru_cache(maxsize=4)
def epoch_order(seed: int, epoch: int, count: int) -> np.ndarray:
    """A permutation of `count` items, of each epoch its own."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(epoch,))).permutation(count)


@contextmanager
def batches_ahead(
    item: Callable[[int], Any], size: int, start: int, stop: int | None, workers: int, ahead: int
) -> Iterator[Iterator[Batch]]:
    """Make items by number in threads, some batches ahead, and hand out batches `start` to `stop` - 1 (or for ever).

    Batch n holds the items from n * size on.
    """
    pool = ThreadPoolExecutor(workers)

    def stream() -> Iterator[Batch]:
        waiting: deque[tuple[int, list[Future[Any]]]] = deque()
        asked = start
        while True:
            while len(waiting) <= ahead and (stop is None or asked < stop):
                waiting.append((asked, [pool.submit(item, asked * size + k) for k in range(size)]))
                asked += 1
            if not waiting:
                return
            step, futures = waiting.popleft()
            yield Batch(step, tuple(future.result() for future in futures))

    try:
        yield stream()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
