"""Pictures as scenes: what is found, decoded, skipped and kept, and which way up it comes."""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from doedesign.capture.images import (
    SAMPLES,
    Pictures,
    crop,
    linear_light,
    picture_files,
    sample_files,
    zoomed,
)
from fab.errors import InputError
from fab.pictures import read_display


def save(path: Path, values: np.ndarray, **options) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path, **options)
    return path


def noise(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three good pictures, three files that are none, and one that is no picture file."""
    for k, name in enumerate(("a.png", "b.jpg", "inner/c.webp")):
        save(tmp_path / name, noise((20, 30, 3), k))
    (tmp_path / "d.png").write_bytes((tmp_path / "a.png").read_bytes()[:300])
    (tmp_path / "e.jpg").write_bytes(b"no picture at all")
    (tmp_path / "f.tif").write_bytes(b"")
    (tmp_path / "notes.txt").write_text("see b.jpg")
    return tmp_path


def test_the_samples_are_there_without_a_download():
    files = picture_files(None)
    assert [path.name for path in files] == list(SAMPLES)
    picture = read_display(sample_files()[0], 64)
    assert min(picture.shape[:2]) == 64
    assert picture.std() > 20  # a photograph, not a blank


def test_display_values_become_linear_light():
    picture = np.array([[[0, 255, 128]]], np.uint8)
    light = linear_light(picture)
    assert light.dtype == np.float32
    # ((128/255 + 0.055) / 1.055)^2.4, IEC 61966-2-1
    assert light.ravel() == pytest.approx([0, 1, 0.21586], abs=1e-5)


def test_windows_of_a_picture():
    picture = noise((10, 8, 3))
    assert np.array_equal(crop(picture, (4, 4), (0.0, 0.0)), picture[:4, :4])
    assert np.array_equal(crop(picture, (4, 4), (1.0, 1.0)), picture[6:, 4:])
    assert np.array_equal(crop(picture, (4, 4), (1.0, 0.0), mirror=True), picture[6:, :4][:, ::-1])
    large = crop(np.full((4, 8, 3), 50, np.uint8), (12, 12), (0.5, 0.5))
    assert large.shape == (12, 12, 3)
    assert np.all(large == 50)


def test_of_a_strip_the_window_alone_is_enlarged(monkeypatch: pytest.MonkeyPatch):
    """Two pixels by three thousand would take gigabytes as high as a frame; what is seen is the same."""
    strip = noise((2, 3000, 3))
    assert crop(strip, (512, 512), (0.5, 0.5)).shape == (512, 512, 3)
    short = strip[:, :600]
    whole = crop(short, (64, 64), (0.5, 0.25), True)
    monkeypatch.setattr("doedesign.capture.images.MOST_PIXELS", 64 * 600)
    # The place of the window is rounded to pixels of the large picture, or not: a 32nd of a pixel of the strip.
    assert np.abs(crop(short, (64, 64), (0.5, 0.25), True).astype(int) - whole).mean() < 255 / 32


def test_a_share_of_a_picture():
    y, x = np.mgrid[:60, :90]
    picture = np.stack([4 * y, 2 * x, 0 * x], axis=-1).astype(np.uint8)
    # All of the shorter side in half as many pixels: a pixel is the mean of two by two, inside the edges.
    whole = zoomed(picture, (30, 30), 1.0, (0.0, 1.0)).astype(int)
    rows, columns = 4 * (2 * np.arange(30) + 0.5), 2 * (30 + 2 * np.arange(30) + 0.5)
    assert np.abs(whole[2:-2, 5, 0] - rows[2:-2]).max() <= 1
    assert np.abs(whole[5, 2:-2, 1] - columns[2:-2]).max() <= 1
    # The share that has as many pixels as the frame is cut as it is, and a mirror image is one.
    np.testing.assert_array_equal(zoomed(picture, (30, 30), 0.5, (1.0, 1.0)), picture[30:, 60:])
    mirrored = zoomed(picture, (30, 30), 0.5, (1.0, 1.0), True)
    np.testing.assert_array_equal(mirrored, picture[30:, 60:][:, ::-1])
    # A frame that is not square takes the largest window of its shape; a small share is enlarged.
    assert zoomed(picture, (20, 60), 1.0, (0.5, 0.5)).shape == (20, 60, 3)
    small = zoomed(picture, (32, 32), 0.1, (0.0, 0.0))
    assert small[..., 0].max() <= 4 * 7


def test_files_that_are_no_pictures_are_skipped_by_name(folder: Path, caplog: pytest.LogCaptureFixture):
    pictures = Pictures(picture_files(folder))
    for _ in range(2):
        got = [pictures.get(k) for k in range(len(pictures))]
        assert [picture is not None for picture in got] == [True, True, False, False, False, True]
    assert [path.name for path in pictures.skipped] == ["d.png", "e.jpg", "f.tif"]
    # Once each.
    said = [record.getMessage() for record in caplog.records]
    assert all(name in text for name, text in zip(("d.png", "e.jpg", "f.tif"), said, strict=True))
    assert pictures.skips() == "3 of 6 pictures skipped: d.png, e.jpg, f.tif"
    assert Pictures(()).skips() == ""


def test_only_broken_files_are_an_error(tmp_path: Path):
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(b"broken")
    pictures = Pictures(picture_files(tmp_path))
    assert pictures.get(0) is None
    for _ in range(2):
        with pytest.raises(InputError, match=r"at least one picture must be whole.*a\.png, b\.png"):
            pictures.following(3)


def test_a_picture_that_cannot_be_read_is_followed_by_the_next(folder: Path):
    pictures = Pictures(picture_files(folder))
    names = [pictures.following(number)[0] for number in range(7)]
    assert names == ["a.png", "b.jpg", *["c.webp"] * 4, "a.png"]


def test_folders_without_pictures(tmp_path: Path):
    for path, words in ((tmp_path / "none", "no folder"), (tmp_path, "must hold pictures"), (Path(__file__), "a file")):
        with pytest.raises(InputError, match=words) as caught:
            picture_files(path)
        assert str(path) in str(caught.value)


def test_what_fits_is_decoded_once(folder: Path):
    files = tuple(path for path in picture_files(folder) if path.name[0] in "abc")
    pictures = Pictures(files)
    for _ in range(3):
        assert all(pictures.get(k) is not None for k in range(3))
    assert pictures.decodings == 3
    one = 20 * 30 * 3
    tight = Pictures(files, budget_bytes=2 * one)
    for _ in range(3):
        assert all(tight.get(k) is not None for k in range(3))
    assert tight.decodings == 2 + 3  # two are kept, the third is decoded every time


def test_threads_share_one_decoding(folder: Path):
    pictures, gate = Pictures(picture_files(folder)[:1]), threading.Barrier(4)

    def ask(_: int) -> int:
        gate.wait()
        picture = pictures.get(0)
        return 0 if picture is None else int(picture.sum())

    with ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(ask, range(4)))) == 1
    assert pictures.decodings == 1


def test_the_digest_is_that_of_the_folder(folder: Path):
    digest = Pictures(picture_files(folder)).digest()
    assert Pictures(picture_files(folder)).digest() == digest
    (folder / "a.png").write_bytes((folder / "a.png").read_bytes()[:-1] + b"x")  # as long as before
    assert Pictures(picture_files(folder)).digest() != digest
