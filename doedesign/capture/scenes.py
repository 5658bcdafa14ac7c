"""Scenes for training: a stream of batches, seeded, resumable, and prepared ahead by threads.

Item i of epoch e is a pure function of the seed, e and i: the picture, the crop, its mirror image, the obstruction and
both depths are drawn from a generator of their own (`numpy.random.SeedSequence` with the spawn key (e, i)), and every
epoch goes through the pictures in an order of its own. So a stream that starts at step n gives what one from the
beginning gives there, whatever the number of threads. A picture that cannot be decoded is replaced by the next one in
the epoch's order, so that numbering does not depend on when the damage was found.

Threads are enough: decoding, and most of what numpy does, lets go of the interpreter. No more than `ahead` batches are
prepared at a time. Leaving the `with` block ends the threads; an error in one of them ends the stream, and says from
which item and picture it came.

    data = SceneData(Pictures(picture_files(folder)), Dirt(), View((512, 512), 3.7e-6, 8e-3), far_m=(5.0, 10.0))
    with data.batches(start=step) as batches:
        for batch in batches: ...
"""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.capture.images import Pictures, crop, linear_light
from fab.errors import InputError
from sim.obstruction import CameraView, ObstructionKind


class SceneItem(NamedTuple):
    """One scene.

    Attributes:
        background: `[c, y, x]` linear light, red, green and blue.
        mask: `[y, x]` share of each pixel's direction that is blocked.
        radiance: `[c, y, x]` linear light of the obstruction.
        depth_m: its distance.
        background_depth_m: distance of the background.
        name: name of the picture's file.
    """

    background: Float[np.ndarray, "c y x"]
    mask: Float[np.ndarray, "y x"]
    radiance: Float[np.ndarray, "c y x"]
    depth_m: float
    background_depth_m: float
    name: str


class SceneBatch(NamedTuple):
    """Several scenes; see `SceneItem`. The first axis counts them.

    Attributes:
        step: number of the batch since the beginning of the first epoch.
    """

    background: Float[np.ndarray, "b c y x"]
    mask: Float[np.ndarray, "b y x"]
    radiance: Float[np.ndarray, "b c y x"]
    depth_m: Float[np.ndarray, " b"]
    background_depth_m: Float[np.ndarray, " b"]
    names: tuple[str, ...]
    step: int


@dataclass(frozen=True)
class SceneData:
    """Where scenes come from. An epoch shows every picture once.

    Attributes:
        pictures: the pictures.
        kind: what stands before them.
        view: the frame.
        far_m: least and greatest distance of the background, drawn evenly in 1/z; `inf` allowed.
        seed: seed of everything.
        batch: scenes per batch.
        workers: threads.
        ahead: batches that are prepared before they are asked for.
        mirrored: whether pictures are exchanged left and right at random.
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

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            ValueError: counts below one, distances out of order, or no pictures.
        """
        for name in ("batch", "workers", "ahead"):
            if getattr(self, name) < 1:
                raise ValueError(f"`{name}` must be at least 1, but got {getattr(self, name)}")
        if not 0 < self.far_m[0] <= self.far_m[1]:
            raise ValueError(f"`far_m` must rise from above 0, but got {self.far_m}")
        if not len(self.pictures):
            raise ValueError("`pictures` must hold one, but got none")

    def item(self, epoch: int, index: int) -> SceneItem:
        """Make one scene.

        Args:
            epoch: which round through the pictures.
            index: which of its scenes, from 0 to the number of pictures.

        Raises:
            InputError: no picture is whole, or the obstruction cannot be drawn.
        """
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(epoch, index)))
        place, mirror = (rng.uniform(), rng.uniform()), bool(rng.integers(2)) and self.mirrored
        far = 1 / rng.uniform(1 / self.far_m[1], 1 / self.far_m[0]) if self.far_m[0] < self.far_m[1] else self.far_m[0]
        name, picture = self._picture(epoch, index)
        try:
            background = linear_light(crop(picture, self.view.shape, place, mirror))
            near = self.kind.draw(rng, self.view, background)
        except Exception as error:
            error.add_note(f"while preparing scene {index} of epoch {epoch} from {name}")
            raise
        mask, radiance = np.asarray(near.mask), np.asarray(near.radiance)
        return SceneItem(background, mask, radiance, float(near.depth_m), float(far), name)

    def _picture(self, epoch: int, index: int) -> tuple[str, np.ndarray]:
        turn = _order(self.seed, epoch, len(self.pictures))
        for step in range(len(turn)):
            chosen = int(turn[(index + step) % len(turn)])
            picture = self.pictures.get(chosen)
            if picture is not None:
                return self.pictures.files[chosen].name, picture
        raise InputError(
            str(self.pictures.files[0].parent), "at least one picture must be whole", "none", "Give other pictures."
        )

    @contextmanager
    def batches(self, start: int = 0, stop: int | None = None) -> Iterator[Iterator[SceneBatch]]:
        """Open the stream.

        Args:
            start: number of the first batch.
            stop: number of the batch before which it ends; never by default.

        Yields:
            an iterator over batches.
        """
        pool = ThreadPoolExecutor(self.workers, thread_name_prefix="scenes")
        try:
            yield self._stream(pool, start, stop)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _stream(self, pool: ThreadPoolExecutor, start: int, stop: int | None) -> Iterator[SceneBatch]:
        waiting: deque[tuple[int, list[Future[SceneItem]]]] = deque()
        asked = start
        while True:
            while len(waiting) <= self.ahead and (stop is None or asked < stop):
                first = asked * self.batch
                places = (divmod(first + k, len(self.pictures)) for k in range(self.batch))
                waiting.append((asked, [pool.submit(self.item, *place) for place in places]))
                asked += 1
            if not waiting:
                return
            step, futures = waiting.popleft()
            yield _joined([future.result() for future in futures], step)


@lru_cache(maxsize=4)
def _order(seed: int, epoch: int, count: int) -> np.ndarray:
    """The pictures of an epoch, in its order."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(epoch,))).permutation(count)


def _joined(items: list[SceneItem], step: int) -> SceneBatch:
    """Stack scenes."""
    arrays = [np.stack(values) for values in zip(*((i.background, i.mask, i.radiance) for i in items), strict=True)]
    depths = [np.array(values, np.float32) for values in zip(*((i[3], i[4]) for i in items), strict=True)]
    return SceneBatch(arrays[0], arrays[1], arrays[2], depths[0], depths[1], tuple(item.name for item in items), step)
