"""Pictures from files and back: the way up, every bit, and what is refused before it is decoded."""

import struct
import zlib
from pathlib import Path

import numpy as np
import png
import pytest
import tifffile
from PIL import Image

from fab.errors import InputError
from fab.pictures import read_display, read_pixels, write_pixels


def save(path: Path, values: np.ndarray, **options) -> Path:
    Image.fromarray(values).save(path, **options)
    return path


def noise(shape: tuple[int, ...], kind: type = np.uint8) -> np.ndarray:
    return np.random.default_rng(0).integers(0, np.iinfo(kind).max + 1, shape).astype(kind)


# --- values as they are ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3)])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("ending", ["png", "tif"])
def test_what_is_written_is_read(tmp_path: Path, ending: str, kind: type, shape: tuple[int, ...]):
    if (ending, kind) == ("png", np.float32):
        return
    values = noise(shape, np.uint16).astype(kind)
    path = tmp_path / f"a.{ending}"
    write_pixels(path, values)
    found = read_pixels(path)
    assert found.dtype == kind
    np.testing.assert_array_equal(found, values)
    whole = path.read_bytes()
    write_pixels(path, values)
    assert path.read_bytes() == whole
    path.write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(InputError, match=f"a.{ending}: the file must be whole"):
        read_pixels(path)


def test_the_first_row_of_a_file_is_the_highest(tmp_path: Path):
    values = noise((5, 7, 3))
    write_pixels(tmp_path / "a.png", values)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), values[::-1])


def test_sixteen_bits_of_another_program_keep_all_their_bits(tmp_path: Path):
    """Filtered rows, which pypng does not write, and every count for both bytes."""
    values = np.stack([np.arange(65536).reshape(256, 256)] * 3, axis=2).astype(np.uint16)
    rows = values.astype(">u2").view(np.uint8).reshape(256, -1)
    up = np.vstack([rows[:1], rows[1:] - rows[:-1]])  # modulo 256
    data = b"".join(b"\x02" + row.tobytes() for row in up)
    (tmp_path / "a.png").write_bytes(png_file(256, 256, 16, zlib.compress(data)))
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png")[::-1], values)
    assert png.Reader(bytes=(tmp_path / "a.png").read_bytes()).read()[3]["bitdepth"] == 16  # and that it is one


def png_file(width: int, height: int, bits: int, data: bytes) -> bytes:
    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    head = struct.pack(">IIBBBBB", width, height, bits, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def test_large_pictures_are_refused_before_they_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "a.png").write_bytes(png_file(60000, 60000, 8, zlib.compress(bytes(100))))
    with pytest.raises(InputError, match=r"a\.png"):
        read_pixels(tmp_path / "a.png")
    monkeypatch.setattr("fab.pictures.MOST_PIXELS", 100)
    for name in ("b.png", "b.tif"):
        write_pixels(tmp_path / name, np.zeros((100, 300), np.uint8), about="packed")
        with pytest.raises(InputError, match=rf"{name}: a picture must have from 1 to \d+ pixels"):
            read_pixels(tmp_path / name)
        assert read_pixels(tmp_path / name, most_px=30_000).shape == (100, 300)


def test_palettes_are_looked_up_on_request(tmp_path: Path):
    picture = Image.fromarray(noise((6, 8, 3))).quantize(8)
    for name in ("a.png", "a.tif"):
        picture.save(tmp_path / name)
        with pytest.raises(InputError, match=rf"{name}: the file must hold one grey or colour picture"):
            read_pixels(tmp_path / name)
        found = read_pixels(tmp_path / name, others="RGBA")
        np.testing.assert_array_equal(found[::-1, :, :3], np.asarray(picture.convert("RGB")))


def test_one_picture_per_file(tmp_path: Path):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((2, 5, 6), np.uint8), photometric="minisblack")
    with pytest.raises(InputError, match="2 pages"):
        read_pixels(tmp_path / "a.tif")
    with pytest.raises(InputError, match=r"none\.png: the file must exist"):
        read_pixels(tmp_path / "none.png")


# --- as a display shows them -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("suffix", "exact"), [("png", True), ("tif", True), ("bmp", True), ("webp", False)])
def test_the_lowest_row_comes_first(tmp_path: Path, suffix: str, exact: bool):
    values = np.repeat(np.arange(0, 240, 10).astype(np.uint8)[:, None, None], 3, 2) * np.ones((1, 20, 1), np.uint8)
    picture = read_display(save(tmp_path / f"ramp.{suffix}", values))
    assert picture.shape == values.shape
    assert np.abs(picture[::-1].astype(int) - values).max() <= (0 if exact else 8)  # WebP loses a little


def test_a_turned_camera(tmp_path: Path):
    values = noise((6, 4, 3))
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned a quarter clockwise
    picture = read_display(save(tmp_path / "turned.png", values, exif=exif))
    assert np.array_equal(picture[::-1], np.rot90(values, -1))


def test_sixteen_bits_grey_palette_and_transparency(tmp_path: Path):
    deep = np.array([[0, 128, 65535], [257 * 7, 257 * 200, 40000]], np.uint16)
    assert read_display(save(tmp_path / "deep.png", deep))[::-1, :, 1].tolist() == [[0, 0, 255], [7, 200, 156]]
    grey = noise((5, 7))
    assert np.array_equal(read_display(save(tmp_path / "grey.png", grey))[::-1, :, 2], grey)
    clear = noise((5, 7, 4))
    assert np.array_equal(read_display(save(tmp_path / "clear.png", clear))[::-1], clear[..., :3])
    Image.fromarray(grey).convert("P").save(tmp_path / "palette.gif")
    assert read_display(tmp_path / "palette.gif").shape == (5, 7, 3)
    Image.fromarray(noise((5, 7)).astype(np.float32)).save(tmp_path / "float.tif")
    with pytest.raises(InputError, match="no display values"):
        read_display(tmp_path / "float.tif")


def test_large_pictures_are_shrunk_by_averaging(tmp_path: Path):
    values = np.zeros((64, 96, 3), np.uint8)
    values[:, ::2] = 200  # columns that picking every other one would lose
    small = read_display(save(tmp_path / "stripes.png", values), 32)
    assert small.shape == (32, 48, 3)
    assert np.all(small == 100)
    assert read_display(tmp_path / "stripes.png", 200).shape == (64, 96, 3)
