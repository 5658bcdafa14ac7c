"""What a camera's files hold, read as they are; what cannot be a measurement is refused by name."""

import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from fab.errors import InputError
from sim.frames import read_frame
from sim.psf_bank import PsfBank
from sim.store import write_bank

MEASURED = (
    Path(__file__).parents[3] / "shared" / "data" / "optics_reference" / "measured_psf" / "diffusercam_psf_sample.tif"
)


def counts(seed: int = 1, most: int = 60000, shape: tuple[int, int] = (20, 30)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, most, shape).astype(np.uint16)


def write_dng(path: Path, mosaic: np.ndarray) -> None:
    """A raw photograph of a camera with red, green, green, blue behind 2 x 2 pixels, 12 bits and black at 64."""
    matrix = (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1)
    tags = [
        (50706, "B", 4, bytes([1, 4, 0, 0]), True),
        (50707, "B", 4, bytes([1, 1, 0, 0]), True),
        (50708, "s", 0, "Test Camera", True),
        (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, bytes([0, 1, 1, 2]), True),
        (50714, "H", 1, 64, True),
        (50717, "H", 1, 4095, True),
        (50721, 10, 9, matrix, True),
        (271, "s", 0, "Test", True),
        (272, "s", 0, "Camera", True),
    ]
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=tags, metadata=None)


def test_sixteen_bits_come_back_with_the_top_row_last(tmp_path: Path):
    image = counts()
    tifffile.imwrite(tmp_path / "a.tiff", image)
    Image.fromarray(image).save(tmp_path / "a.png")
    for name in ("a.tiff", "a.png"):
        frame = read_frame(tmp_path / name)
        np.testing.assert_array_equal(frame.counts, image[::-1])
        assert frame.valid.all()
        assert (frame.clipped_at, frame.black, frame.step) == (65535, 0, 1)


def test_a_converter_of_twelve_bits_in_the_upper_bits_is_noticed(tmp_path: Path):
    image = counts(most=4095) * np.uint16(16)
    image[:3, :5] = 4095 * 16
    tifffile.imwrite(tmp_path / "a.tiff", image)
    frame = read_frame(tmp_path / "a.tiff")
    assert (frame.clipped_at, frame.step) == (4095 * 16, 16)


def test_floats_say_nothing_of_full_pixels(tmp_path: Path):
    image = counts().astype(np.float32) / 7
    tifffile.imwrite(tmp_path / "a.tif", image)
    frame = read_frame(tmp_path / "a.tif")
    np.testing.assert_array_equal(frame.counts, image[::-1])
    assert (frame.clipped_at, frame.step) == (None, 0)


def test_a_picture_in_colour_gives_the_channel_that_is_named(tmp_path: Path):
    image = np.stack([counts(seed) for seed in range(3)], axis=-1)
    tifffile.imwrite(tmp_path / "a.tiff", image, photometric="rgb")
    np.testing.assert_array_equal(read_frame(tmp_path / "a.tiff", channel="green").counts, image[::-1, :, 1])
    with pytest.raises(InputError, match=r"a\.tiff: of a picture in colour one channel must be chosen"):
        read_frame(tmp_path / "a.tiff")


def test_an_exr_of_one_psf_keeps_its_values(tmp_path: Path):
    image = counts().astype(np.float32)[None, None] - 5
    write_bank(tmp_path / "one.exr", PsfBank(image, ("green",), (0.1,), 3.7e-6))
    np.testing.assert_array_equal(read_frame(tmp_path / "one.exr", pixel_m=3.7e-6).counts, image[0, 0])
    with pytest.raises(InputError, match="the pixel pitch given must be that of the file"):
        read_frame(tmp_path / "one.exr", pixel_m=1.85e-6)
    write_bank(tmp_path / "two.exr", PsfBank(np.repeat(image, 2, 1), ("green",), (0.1, 0.2), 3.7e-6))
    with pytest.raises(InputError, match="must hold one depth, but got a bank of 2"):
        read_frame(tmp_path / "two.exr", pixel_m=3.7e-6)


def test_an_exr_in_colour_gives_the_channel_that_is_named(tmp_path: Path):
    image = np.stack([counts(seed) for seed in range(3)]).astype(np.float32)[:, None]
    write_bank(tmp_path / "rgb.exr", PsfBank(image, ("R", "G", "B"), (0.1,), 3.7e-6))
    for number, channel in enumerate(("red", "green", "blue")):
        frame = read_frame(tmp_path / "rgb.exr", channel=channel, pixel_m=3.7e-6)
        np.testing.assert_array_equal(frame.counts, image[number, 0])
    write_bank(tmp_path / "own.exr", PsfBank(image, ("red", "green", "blue"), (0.1,), 3.7e-6))
    np.testing.assert_array_equal(read_frame(tmp_path / "own.exr", channel="green").counts, image[1, 0])
    write_bank(tmp_path / "ab.exr", PsfBank(image[:2], ("A", "B"), (0.1,), 3.7e-6))
    with pytest.raises(InputError, match="must have one colour, or red, green, blue, but got the colours A, B"):
        read_frame(tmp_path / "ab.exr", channel="red", pixel_m=3.7e-6)


def test_a_raw_mosaic_keeps_the_pixels_of_one_colour(tmp_path: Path):
    pytest.importorskip("rawpy", reason="rawpy (the extra raw) is not installed")
    mosaic = counts(most=4000, shape=(64, 96))  # much less is no RAW file to the library
    write_dng(tmp_path / "a.dng", mosaic)
    frame = read_frame(tmp_path / "a.dng", channel="green")
    np.testing.assert_array_equal(frame.counts, mosaic[::-1])
    assert (frame.clipped_at, frame.black) == (4095, 64)
    green = np.add.outer(np.arange(64), np.arange(96)) % 2 == 1  # the second and third of red, green, green, blue
    np.testing.assert_array_equal(frame.valid, green[::-1])
    assert read_frame(tmp_path / "a.dng", channel="red").valid.sum() == mosaic.size / 4
    with pytest.raises(InputError, match="one channel must be chosen"):
        read_frame(tmp_path / "a.dng")
    (tmp_path / "b.dng").write_bytes((tmp_path / "a.dng").read_bytes()[:300])
    with pytest.raises(InputError, match=r"b\.dng: the file must be whole"):
        read_frame(tmp_path / "b.dng")


def test_raw_without_rawpy_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(InputError, match=r"needs rawpy.*pip install 'doedesign\[raw\]'"):
        read_frame(tmp_path / "a.dng")


def test_what_is_no_measurement_is_refused_by_name(tmp_path: Path):
    image = counts()
    tifffile.imwrite(tmp_path / "8.tiff", image.astype(np.uint8))
    with pytest.raises(InputError, match=r"8\.tiff: a measured PSF needs 16 bits per pixel, but got 8 bits"):
        read_frame(tmp_path / "8.tiff")
    assert read_frame(tmp_path / "8.tiff", allow_8bit=True).clipped_at == 255
    broken = image.astype(np.float32)
    broken[3, 4] = np.nan
    tifffile.imwrite(tmp_path / "nan.tiff", broken)
    with pytest.raises(InputError, match=r"nan\.tiff: every pixel must be finite"):
        read_frame(tmp_path / "nan.tiff")
    tifffile.imwrite(tmp_path / "signed.tiff", image.astype(np.int16))
    with pytest.raises(InputError, match="counts or floats"):
        read_frame(tmp_path / "signed.tiff")
    tifffile.imwrite(tmp_path / "stack.tiff", np.stack([image, image]), photometric="minisblack")
    with pytest.raises(InputError, match="one grey or colour picture, but got 2 pages"):
        read_frame(tmp_path / "stack.tiff")
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "colour.png")
    with pytest.raises(InputError, match=r"colour\.png: a measured PSF needs 16 bits per pixel, but got 8 bits"):
        read_frame(tmp_path / "colour.png", channel="green")
    (tmp_path / "text.tiff").write_text("no picture")
    with pytest.raises(InputError, match=r"text\.tiff: the file must be whole"):
        read_frame(tmp_path / "text.tiff")
    for name in ("missing.tiff", "missing.png", "missing.exr"):
        with pytest.raises(InputError, match=rf"{name}: the file must exist"):
            read_frame(tmp_path / name)
    with pytest.raises(InputError, match=r"an image must be one of .*but got \.jpg"):
        read_frame(tmp_path / "a.jpg")


def test_a_png_in_colour_keeps_sixteen_bits_of_each(tmp_path: Path):
    """Pillow writes none, so the file is made by the format's own rules."""
    values = np.random.default_rng(0).integers(0, 65536, (5, 7, 3), np.uint16)
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    chunks = {b"IHDR": struct.pack(">IIBBBBB", 7, 5, 16, 2, 0, 0, 0), b"IDAT": zlib.compress(rows), b"IEND": b""}
    parts = (struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks.items())
    (tmp_path / "colour.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    assert np.array_equal(read_frame(tmp_path / "colour.png", channel="green").counts, values[::-1, :, 1])


def test_a_measured_psf_of_another_lab():
    """The 12 bits of that camera fill the upper bits of 16, some are means of two, and the brightest are full."""
    if not MEASURED.is_file():
        pytest.skip("the measured PSF is not beside this checkout")
    frame = read_frame(MEASURED)
    assert frame.counts.shape == (1200, 1600)
    assert (frame.step, frame.clipped_at) == (2, 65520)
