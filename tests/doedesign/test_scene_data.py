"""The stream of scenes: what each item depends on, where a stream may start, and how it ends."""

import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

from doedesign.capture.images import Pictures, picture_files
from doedesign.capture.scenes import Batch, SceneData
from fab.errors import InputError
from sim.imaging.scene import Obstruction
from sim.light import srgb_from_linear
from sim.obstruction import CameraView, Dirt

VIEW = CameraView((24, 32), 3.7e-6, 8e-3)


@dataclass(frozen=True)
class Bar:
    """An obstruction that needs no time to draw; may fail, and may wait."""

    fails: bool = False
    wait_s: float = 0.0

    def draw(self, rng: np.random.Generator, view: CameraView, background: np.ndarray) -> Obstruction:
        if self.fails:
            raise InputError("bar: width", "must be drawn", "none", "Draw it.")
        time.sleep(self.wait_s)
        mask = np.zeros(view.shape, np.float32)
        mask[:, rng.integers(view.shape[1])] = 1
        return Obstruction(mask, np.full_like(background, 0.1), rng.uniform(0.05, 0.12))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    for k in range(5):
        Image.fromarray(rng.integers(0, 256, (40, 50, 3), np.uint8)).save(tmp_path / f"{k}.png")
    return tmp_path


@pytest.fixture
def data(folder: Path) -> SceneData:
    return SceneData(Pictures(picture_files(folder)), Bar(), VIEW, (5.0, 10.0), seed=3, batch=2)


def take(data: SceneData, count: int, start: int = 0) -> list[Batch]:
    with data.batches(start, start + count) as batches:
        return list(batches)


def same(a: Batch, b: Batch) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_a_stream_may_start_anywhere(data: SceneData, folder: Path):
    whole = take(data, 8)  # three epochs of five pictures, in pairs
    fresh = replace(data, pictures=Pictures(picture_files(folder)), workers=1, ahead=1)
    for start in (1, 2, 5):
        assert all(same(a, b) for a, b in zip(whole[start:], take(fresh, 8 - start, start), strict=True))
    assert [batch.step for batch in whole] == list(range(8))
    assert not same(whole[0], take(replace(data, seed=4), 1)[0])


def test_a_zoomed_stream_may_start_anywhere_and_shows_shares_of_pictures(folder: Path):
    ramp = np.arange(100) + 50  # of display values, one per column of a picture of 60 x 100 pixels
    for path in folder.iterdir():
        Image.fromarray(np.broadcast_to(ramp[None, :, None], (60, 100, 3)).astype(np.uint8)).save(path)
    pictures = Pictures(picture_files(folder))
    data = SceneData(pictures, Bar(), CameraView((24, 24), 3.7e-6, 8e-3), (5.0, 10.0), seed=3, batch=4, zoom=(0.4, 1.0))
    whole = take(data, 10)
    fresh = replace(data, pictures=Pictures(picture_files(folder)), workers=1, ahead=1)
    for start in (1, 3):
        assert all(same(a, b) for a, b in zip(whole[start:], take(fresh, 10 - start, start), strict=True))
    shown = [255 * srgb_from_linear(item.scene.background[0, 12]) for batch in whole for item in batch.items]
    slopes = np.array([abs(row[20] - row[3]) / 17 for row in shown])  # columns of the picture per pixel
    # From 0.4 to all of 60 rows in 24 pixels, each e-fold as often; bytes round to half of 1 at either end.
    assert slopes.min() > 0.4 * 60 / 24 - 1 / 17
    assert slopes.max() < 60 / 24 + 1 / 17
    inner = np.log(slopes / (0.4 * 60 / 24)) / np.log(1 / 0.4)
    assert np.mean(inner) == pytest.approx(0.5, abs=3 / np.sqrt(12 * len(inner)))  # three sigma of a mean of shares
    with pytest.raises(ValueError, match="`zoom` must rise"):
        replace(data, zoom=(0.5, 0.4))


def test_an_epoch_shows_every_picture_once(data: SceneData):
    names = [item.name for batch in take(data, 5) for item in batch.items]
    assert sorted(names[:5]) == sorted(names[5:]) == [f"{k}.png" for k in range(5)]
    assert names[:5] != names[5:]


def test_what_a_batch_holds(data: SceneData):
    (batch,) = take(data, 1)
    assert len(batch.items) == 2
    for _, scene in batch.items:
        (near,) = scene.obstructions
        arrays = [np.asarray(array) for array in (scene.background, near.radiance, near.mask)]
        assert [array.shape for array in arrays] == [(3, 24, 32), (3, 24, 32), (24, 32)]
        assert {array.dtype for array in arrays} == {np.dtype(np.float32)}
        assert 0.05 <= near.depth_m <= 0.12
        assert 5 <= scene.background_depth_m <= 10
    far = replace(data, far_m=(5.0, np.inf))
    assert far.item(0).scene.background_depth_m > 5


def test_depths_of_the_background_are_even_in_curvature(folder: Path):
    data = SceneData(Pictures(picture_files(folder)), Bar(), VIEW, (5.0, 10.0))
    curvatures = np.array([1 / data.item(5 * epoch).scene.background_depth_m for epoch in range(300)])
    # Mean of a uniform variable: five standard errors of 0.1 / sqrt(12) / sqrt(300).
    assert abs(curvatures.mean() - 0.15) < 5 * 0.1 / np.sqrt(12 * 300)


def test_broken_pictures_are_replaced_by_the_next_of_the_epoch(
    data: SceneData, folder: Path, caplog: pytest.LogCaptureFixture
):
    (folder / "2.png").write_bytes(b"broken")
    files = picture_files(folder)
    first = take(replace(data, pictures=Pictures(files)), 10)
    again = take(replace(data, pictures=Pictures(files), workers=4), 10)
    assert all(same(a, b) for a, b in zip(first, again, strict=True))
    assert ["2.png" in record.getMessage() for record in caplog.records] == [True, True]  # once for each of them
    assert all(item.name != "2.png" for batch in first for item in batch.items)


def test_only_broken_pictures_end_the_stream(data: SceneData, folder: Path):
    for path in folder.iterdir():
        path.write_bytes(b"broken")
    with pytest.raises(InputError, match="at least one picture must be whole"):
        take(replace(data, pictures=Pictures(picture_files(folder))), 3)


def test_an_error_names_the_item_and_the_picture(data: SceneData):
    with pytest.raises(InputError, match="bar: width") as caught:
        take(replace(data, kind=Bar(fails=True)), 1)
    assert any(".png" in note and "epoch 0" in note for note in caught.value.__notes__)


def test_leaving_the_stream_ends_its_threads(data: SceneData):
    before = threading.active_count()
    with replace(data, kind=Bar(wait_s=0.01)).batches() as batches:
        next(batches)
        assert threading.active_count() > before
    assert threading.active_count() == before


def test_no_more_is_prepared_than_asked_for(data: SceneData):
    counted = replace(data, ahead=2)
    asked: list[int] = []

    class Counting(Bar):
        def draw(self, rng, view, background):
            asked.append(1)
            return Bar.draw(self, rng, view, background)

    with replace(counted, kind=Counting()).batches() as batches:
        next(batches)
        time.sleep(0.2)
        assert len(asked) == 2 * 3  # the batch that was taken, and two ahead


def test_dirt_comes_with_the_scene(data: SceneData):
    masks = [np.asarray(replace(data, kind=Dirt()).item(0).scene.obstructions[0].mask) for _ in range(2)]
    assert 0 < masks[0].mean() < 1
    assert np.array_equal(masks[0], masks[1])


@pytest.mark.parametrize("wrong", [{"batch": 0}, {"workers": 0}, {"ahead": 0}, {"far_m": (5.0, 1.0)}])
def test_what_cannot_be_a_stream(data: SceneData, wrong: dict):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        replace(data, **wrong)
    with pytest.raises(ValueError, match="pictures"):
        replace(data, pictures=Pictures(()))
