"""Captures from files of every kind, the same way up and of the same light; what is none is refused."""

import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import png
import pytest
import tifffile
from PIL import Image

from doedesign.capture.image_files import write_image
from doedesign.recon.photos import read_capture, write_reconstruction
from fab.errors import InputError
from fab.files import canonical_json, read_json, sha256_file
from sim.light import linear_from_srgb, srgb_from_linear
from sim.store import read_picture, write_picture
from tests.sim.test_frames import write_dng

# Light is stored in single precision.
SINGLE = 2e-7


def counts(kind: type = np.uint16, colours: int = 3, shape: tuple[int, int] = (9, 14)) -> np.ndarray:
    """Rows from the top, colours side by side, as a file has them."""
    most = np.iinfo(kind).max
    values = np.random.default_rng(0).integers(0, most + 1, (*shape, colours)).astype(kind)
    values[0, 0], values[-1, -1] = 0, most
    return values[:, :, 0] if colours == 1 else values


def light_of(values: np.ndarray, linear: bool = False) -> np.ndarray:
    """What those counts mean, as arrays have it."""
    planes = (values[:, :, None] if values.ndim == 2 else values).transpose(2, 0, 1)[:, ::-1]
    share = planes / np.iinfo(values.dtype).max
    return share if linear else linear_from_srgb(share)


def save(path: Path, values: np.ndarray) -> Path:
    if path.suffix != ".png":
        tifffile.imwrite(path, values, photometric="rgb" if values.ndim == 3 else "minisblack")
    elif values.dtype == np.uint16 and values.ndim == 3:
        height, width, _ = values.shape
        with path.open("wb") as stream:
            writer = png.Writer(width, height, greyscale=False, bitdepth=16)  # pyright: ignore[reportArgumentType]
            writer.write(stream, values.reshape(height, -1).tolist())
    else:
        Image.fromarray(values).save(path)
    return path


@pytest.mark.parametrize("colours", [1, 3])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("ending", [".png", ".tif", ".TIFF"])
def test_counts_are_display_values(tmp_path: Path, ending: str, kind: type, colours: int):
    values = counts(kind, colours)
    path = save(tmp_path / f"a{ending}", values)
    photo = read_capture(path)
    assert (photo.bits, photo.linear) == (8 * np.dtype(kind).itemsize, False)
    assert photo.light.dtype == np.float32
    np.testing.assert_allclose(photo.light, light_of(values), atol=SINGLE)
    told = read_capture(path, linear=True)
    assert told.linear
    np.testing.assert_allclose(told.light, light_of(values, linear=True), atol=SINGLE)


def test_all_sixteen_bits_of_a_colour_count(tmp_path: Path):
    """Every count there is, for upper and lower byte alike."""
    values = np.stack([np.arange(65536).reshape(256, 256)] * 3, axis=2).astype(np.uint16)
    found = read_capture(save(tmp_path / "a.png", values), linear=True).light
    np.testing.assert_array_equal(np.rint(found[0, ::-1].astype(np.float64) * 65535), values[:, :, 0])


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
def test_floats_are_light(tmp_path: Path, kind: type):
    values = np.random.default_rng(0).uniform(-0.1, 2, (5, 8, 3)).astype(kind)
    photo = read_capture(save(tmp_path / "a.tif", values))
    assert (photo.bits, photo.linear) == (None, True)
    np.testing.assert_array_equal(photo.light, values.transpose(2, 0, 1)[:, ::-1].astype(np.float32))
    display = read_capture(tmp_path / "a.tif", linear=False)
    np.testing.assert_allclose(display.light, linear_from_srgb(photo.light), rtol=1e-6, atol=SINGLE)


def test_a_tiff_may_hold_its_colours_one_after_the_other(tmp_path: Path):
    values = counts()
    tifffile.imwrite(tmp_path / "a.tif", values.transpose(2, 0, 1), photometric="rgb", planarconfig="separate")
    np.testing.assert_allclose(read_capture(tmp_path / "a.tif").light, light_of(values), atol=SINGLE)


@pytest.mark.parametrize("names", ["RGB", "Y", "RGBA"])
def test_exr_is_light(tmp_path: Path, names: str):
    light = np.random.default_rng(0).uniform(-0.1, 3, (len(names), 6, 7)).astype(np.float32)
    write_picture(tmp_path / "a.exr", dict(zip(names, light, strict=True)))
    photo = read_capture(tmp_path / "a.exr")
    assert (photo.bits, photo.linear) == (None, True)
    np.testing.assert_array_equal(photo.light, light[:3])


def simulated(folder: Path, *, png_files: bool = True) -> dict[str, Path]:
    """A folder as `simulate` leaves it: the manifest says what counts mean."""
    rng = np.random.default_rng(0)
    stored = {
        name: write_image(folder, name, rng.uniform(0, 1.2, (len(c), 6, 8)), c, name, png=png_files, full_scale=1.25)
        for name, c in {"capture": ("R", "G", "B"), "mask": ("M",), "alpha": ("R", "G", "B")}.items()
    }
    described = {
        "format": "doedesign simulation 1",
        "images": stored,
        "sha256": {one["file"]: sha256_file(folder / one["file"]) for one in stored.values()},
    }
    (folder / "manifest.json").write_bytes(canonical_json(described))
    return {name: folder / one["file"] for name, one in stored.items()}


def test_simulated_counts_mean_what_their_manifest_says(tmp_path: Path):
    path = simulated(tmp_path)["capture"]
    expected = np.random.default_rng(0).uniform(0, 1.2, (3, 6, 8))
    photo = read_capture(path)
    assert (photo.bits, photo.linear) == (16, True)
    np.testing.assert_allclose(photo.light, expected, atol=0.51 * 1.25 / 65535)  # half a count, and single precision
    # Said to be linear, counts mean the same; said to be display values, they are.
    np.testing.assert_array_equal(read_capture(path, linear=True).light, photo.light)
    assert not read_capture(path, linear=False).linear
    copied = tmp_path / "elsewhere" / "capture.png"
    copied.parent.mkdir()
    copied.write_bytes(path.read_bytes())
    assert not read_capture(copied).linear  # nothing says so there
    # Another program's manifest is nobody's business.
    (copied.parent / "manifest.json").write_text('{"format": "theirs", "images": {}}')
    assert not read_capture(copied).linear


@pytest.mark.parametrize("png_files", [True, False])
def test_of_a_simulation_only_light_is_taken(tmp_path: Path, png_files: bool):
    paths = simulated(tmp_path, png_files=png_files)
    assert read_capture(paths["capture"]).light.shape == (3, 6, 8)
    with pytest.raises(InputError, match="a capture must be a picture of light, but got mask"):
        read_capture(paths["mask"])
    with pytest.raises(InputError, match="a capture must be a picture of light, but got alpha"):
        read_capture(paths["alpha"])
    paths["capture"].write_bytes(paths["mask"].read_bytes())
    with pytest.raises(InputError, match="must be what its manifest describes"):
        read_capture(paths["capture"])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"images": [1]}, ""),  # nobody's business
        ({"images": {"capture": 1}}, ""),
        ({"sha256": ["a"]}, "must be what its manifest describes"),
        ({"images": {"capture": {"file": "capture.png"}}}, "must say what capture.png shows"),
        ({"images": {"capture": {"file": "capture.png", "what": "light"}}}, "must say what capture.png shows"),
        ({"images": {"capture": {"file": "capture.png", "what": "light", "full_scale": "2"}}}, "what its counts mean"),
    ],
)
def test_a_manifest_that_describes_nothing_is_refused(tmp_path: Path, change: dict, words: str):
    path = simulated(tmp_path)["capture"]
    manifest = tmp_path / "manifest.json"
    manifest.write_bytes(canonical_json({**read_json(manifest), **change}))
    if words:
        with pytest.raises(InputError, match=words):
            read_capture(path)
    else:
        assert not read_capture(path).linear


def test_raw_is_demosaiced_and_left_linear(tmp_path: Path):
    pytest.importorskip("rawpy", reason="rawpy (the extra raw) is not installed")
    black, white = 64, 4095
    mosaic = np.full((40, 60), black, np.uint16)
    mosaic[:20] += (white - black) // 2  # the upper half is half bright
    write_dng(tmp_path / "a.dng", mosaic)
    photo = read_capture(tmp_path / "a.dng")
    assert (photo.light.shape, photo.bits, photo.linear) == ((3, 40, 60), 16, True)
    # Even light is not changed by filling in colours; one count in four thousand.
    np.testing.assert_allclose(photo.light[:, 25:, :], 0.5, atol=5e-4)
    np.testing.assert_allclose(photo.light[:, :15, :], 0.0, atol=5e-4)
    (tmp_path / "b.dng").write_bytes((tmp_path / "a.dng").read_bytes()[:300])
    with pytest.raises(InputError, match=r"b\.dng: the file must be whole"):
        read_capture(tmp_path / "b.dng")


def test_raw_without_rawpy_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    (tmp_path / "a.nef").write_bytes(b"")
    with pytest.raises(InputError, match=r"pip install 'doedesign\[raw\]'"):
        read_capture(tmp_path / "a.nef")


def animated(path: Path) -> None:
    frames = [Image.fromarray(counts(np.uint8)), Image.fromarray(counts(np.uint8)[::-1].copy())]
    frames[0].save(path, save_all=True, append_images=frames[1:])


def with_nan(path: Path) -> None:
    values = np.ones((4, 5, 3), np.float32)
    values[1, 2, 0] = np.nan
    save(path, values)


REFUSED = {
    "palette.png": (lambda p: Image.fromarray(counts(np.uint8)).quantize(8).save(p), "pixels of the kind P"),
    "alpha.png": (lambda p: Image.fromarray(counts(np.uint8, 4)).save(p), r"pixels of shape \(9, 14, 4\)"),
    "bits.png": (lambda p: Image.fromarray(counts(np.uint8, 1)).convert("1").save(p), "pixels of the kind 1"),
    "animated.png": (animated, "an animation of 2 pictures"),
    "text.png": (lambda p: p.write_text("no picture"), "must be whole and of its kind"),
    "jpeg.png": (lambda p: Image.fromarray(counts(np.uint8)).save(p, "JPEG"), "must be whole and of its kind"),
    "empty.tif": (lambda p: p.write_bytes(b""), "must be whole and of its kind"),
    "pages.tif": (lambda p: tifffile.imwrite(p, np.zeros((2, 5, 6), np.uint8), photometric="minisblack"), "2 pages"),
    "four.tif": (
        lambda p: tifffile.imwrite(p, counts(np.uint8, 4), photometric="rgb", extrasamples=["unassalpha"]),
        r"pixels of shape \(9, 14, 4\)",
    ),
    "signed.tif": (lambda p: tifffile.imwrite(p, np.zeros((5, 6), np.int16)), "8 or 16 bits, or floats"),
    "wide.tif": (lambda p: tifffile.imwrite(p, np.zeros((5, 6), np.uint32)), "8 or 16 bits, or floats"),
    "inverted.tif": (lambda p: tifffile.imwrite(p, counts(np.uint8, 1), photometric="miniswhite"), "miniswhite"),
    "nan.tif": (with_nan, "NaN or infinity at row 2 from below, column 2"),
    "inf.exr": (lambda p: write_picture(p, {"Y": np.full((3, 4), np.inf)}), "NaN or infinity"),
    "depth.exr": (lambda p: write_picture(p, {"Z": np.ones((3, 4))}), "the channels Z"),
    "four.exr": (lambda p: write_picture(p, {c: np.ones((3, 4)) for c in "RGBZ"}), "the channels B, G, R, Z"),
    "a.jpg": (lambda p: Image.fromarray(counts(np.uint8)).save(p), "a capture must be one of"),
    "none.png": (lambda p: None, "must exist"),
    "none.tif": (lambda p: None, "must exist"),
    "none.dng": (lambda p: None, "must exist"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_capture_is_refused_by_name(tmp_path: Path, name: str):
    make, message = REFUSED[name]
    make(tmp_path / name)
    with pytest.raises(InputError, match=message) as error:
        read_capture(tmp_path / name)
    assert name in str(error.value)


@pytest.mark.parametrize("ending", [".png", ".tif", ".exr"])
def test_damaged_files_are_refused(tmp_path: Path, ending: str):
    """Cut off anywhere; of PNG and EXR, which carry checksums, flipped anywhere among the pixels."""
    path, rng = tmp_path / f"a{ending}", np.random.default_rng(0)
    write_reconstruction(path, rng.uniform(0, 1, (3, 30, 40)).astype(np.float32), 16)
    whole = path.read_bytes()
    for share in (0.1, 0.5, 0.95):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match=path.name):
            read_capture(path)
    if ending == ".tif":
        return
    for place in rng.integers(len(whole) // 2, int(0.95 * len(whole)), 10):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 16]) + whole[place + 1 :])
        with pytest.raises(InputError, match=path.name):
            read_capture(path)


def test_a_picture_that_promises_too_much_is_not_begun(tmp_path: Path):
    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0)
    parts = [chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(bytes(100))), chunk(b"IEND", b"")]
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    with pytest.raises(InputError, match=r"a\.png"):
        read_capture(tmp_path / "a.png")


@pytest.mark.parametrize("colours", [1, 3])
@pytest.mark.parametrize(
    ("ending", "bits", "step"), [(".png", 8, 1 / 255), (".png", 16, 1 / 65535), (".tif", 8, 1 / 255)]
)
def test_display_values_are_written_to_the_nearest_count(
    tmp_path: Path, ending: str, bits: int, step: float, colours: int
):
    display = np.random.default_rng(0).uniform(-0.2, 1.2, (colours, 11, 7)).astype(np.float32)
    path = tmp_path / f"a{ending}"
    write_reconstruction(path, display, bits)
    photo = read_capture(path)
    assert (photo.bits, photo.linear) == (bits, False)
    # Half a step, and single precision through the curve and back.
    np.testing.assert_allclose(srgb_from_linear(photo.light), np.clip(display, 0, 1), atol=0.5 * step + 1e-6)
    first = path.read_bytes()
    write_reconstruction(path, display, bits)
    assert path.read_bytes() == first


@pytest.mark.parametrize("ending", [".tif", ".exr"])
def test_floats_are_written_as_light(tmp_path: Path, ending: str):
    display = np.random.default_rng(0).uniform(-0.2, 1.2, (3, 11, 7)).astype(np.float32)
    write_reconstruction(tmp_path / f"a{ending}", display, None)
    photo = read_capture(tmp_path / f"a{ending}")
    assert photo.linear
    np.testing.assert_allclose(photo.light, np.maximum(linear_from_srgb(display), 0), rtol=1e-6)


def test_the_top_row_of_a_file_is_the_last_of_an_array(tmp_path: Path):
    display = np.zeros((1, 4, 6), np.float32)
    display[0, -1] = 1
    write_reconstruction(tmp_path / "a.png", display, 8)
    assert np.asarray(Image.open(tmp_path / "a.png"))[0].min() == 255
    write_reconstruction(tmp_path / "a.exr", display)
    assert read_picture(tmp_path / "a.exr")[0]["Y"][-1].min() == 1


def test_what_cannot_be_written_is_refused(tmp_path: Path):
    image = np.zeros((3, 4, 5), np.float32)
    with pytest.raises(InputError, match="a picture must be one of"):
        write_reconstruction(tmp_path / "a.jpg", image)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file"):
        write_reconstruction(tmp_path / "file" / "a.png", image)
    for bits, name in ((12, "a.png"), (None, "a.png"), (12, "a.tif")):
        with pytest.raises(ValueError, match="`bits` must be"):
            write_reconstruction(tmp_path / name, image, bits)
    assert not list(tmp_path.glob("a.*"))
