"""Captures from files, and reconstructions into files.

A file holds either **linear light**, as a sensor counts it, or **display values**, which follow sRGB's curve. Which one
is known from its kind, unless the caller knows better:

    OpenEXR; TIFF of floats         linear, white 1
    camera RAW                      linear, white where the sensor is full, demosaiced but nothing else (extra `raw`)
    PNG and TIFF of 8 or 16 bits    display values, white where the bits are full
    PNG of `doedesign simulate`     linear; the manifest beside it says what a count is

Whatever a file says about its orientation is left alone: PSFs lie on the sensor as it is. The top row of a file is the
last of an array, which has row 0 at the lowest y. Colours are red, green and blue, or one.
"""

import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt

from doedesign.capture.image_files import read_image
from fab.errors import InputError
from fab.files import MANIFEST_NAME, explain_os_error, read_json, sha256_file, write_atomic
from sim.frames import RAW_FILES
from sim.light import linear_from_srgb
from sim.store import read_picture, write_picture

__all__ = ["PHOTO_FILES", "WRITTEN_FILES", "Photo", "read_capture", "write_reconstruction"]

WRITTEN_FILES = (".png", ".tif", ".tiff", ".exr")
PHOTO_FILES = (*WRITTEN_FILES, *RAW_FILES)

_MOST_PIXELS = 1 << 27
_CURE = "Save it again from its source as one picture, grey or in red, green and blue."


class Photo(NamedTuple):
    """A capture as its file holds it.

    Attributes:
        light: `[c, y, x]` linear light, white 1; three colours or one.
        bits: bits per value in the file; None for floats.
        linear: whether the file held linear light.
    """

    light: Float[np.ndarray, "c y x"]
    bits: int | None
    linear: bool


def read_capture(path: str | Path, linear: bool | None = None) -> Photo:
    """Read a capture.

    Args:
        path: one of `PHOTO_FILES`.
        linear: whether PNG and TIFF hold linear light; by default what is usual for their kind (see above).

    Raises:
        InputError: the file is missing, of another kind, broken, no single picture of one or three colours, or holds
            values that are not finite; or rawpy is not installed.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in PHOTO_FILES:
        rule, cure = f"a capture must be one of {', '.join(PHOTO_FILES)}", "Convert it without loss first."
        raise InputError(str(path), rule, suffix or "no suffix", cure)
    stored = _described(path) if suffix in (".png", ".exr") else None
    if suffix == ".exr":
        photo = Photo(_exr_light(path), None, True)
    elif stored is not None and linear is None:
        photo = Photo(read_image(path.parent, stored), 16, True)
    elif suffix in RAW_FILES:
        photo = Photo(_guarded(path, _raw_light), 16, True)
    else:
        photo = _as_light(_guarded(path, _png_values if suffix == ".png" else _tiff_values), linear)
    finite = np.isfinite(photo.light)
    if not finite.all():
        row, column = (int(i) for i in np.argwhere(~finite.all(axis=0))[0])
        got = f"NaN or infinity at row {row} from below, column {column} ({int((~finite).sum())} such values)"
        raise InputError(str(path), "every pixel must be finite", got, "Repair those pixels, or save it again.")
    return photo


def write_reconstruction(path: str | Path, display: Float[np.ndarray, "c y x"], bits: int | None = 16) -> None:
    """Write a picture of display values; the file appears whole or not at all.

    Args:
        path: the file. EXR, and TIFF where `bits` is None, get linear light; the rest gets display values, clipped.
        display: `[c, y, x]` display values, 0 to 1; three colours or one.
        bits: 8 or 16, for PNG and TIFF; None for floats.

    Raises:
        InputError: another ending, or the system refuses the path.
        ValueError: PNG cannot hold floats, or another number of bits.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in WRITTEN_FILES:
        rule = f"a picture must be one of {', '.join(WRITTEN_FILES)}"
        raise InputError(str(path), rule, suffix or "no suffix", "Choose another ending.")
    if bits not in (8, 16, None) or (bits is None and suffix == ".png"):
        raise ValueError(f"`bits` must be 8 or 16, or None where floats fit, but got {bits} for {suffix}")
    if suffix == ".exr":
        light = np.maximum(linear_from_srgb(display), 0)
        write_picture(path, dict(zip("RGB" if len(light) == 3 else "Y", light, strict=True)))
        return
    # Files have the top row first, and colours side by side.
    if bits is None:
        values = np.maximum(linear_from_srgb(display), 0).astype(np.float32)
    else:
        values = np.rint(np.clip(display, 0, 1) * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    rows = np.ascontiguousarray(values[:, ::-1].transpose(1, 2, 0))
    write_atomic(path, _png_bytes(rows) if suffix == ".png" else _tiff_bytes(rows))


def _described(path: Path) -> dict[str, Any] | None:
    """What the manifest of `simulate` beside a file says of it, or None; another program's manifest says nothing.

    Raises:
        InputError: the file is no picture of light, or changed since.
    """
    if not (path.parent / MANIFEST_NAME).is_file():
        return None
    manifest = read_json(path.parent / MANIFEST_NAME)
    if not str(manifest.get("format", "")).startswith("doedesign simulation") or "images" not in manifest:
        return None
    stored = next((one for one in manifest["images"].values() if one.get("file") == path.name), None)
    if stored is None:
        return None
    if stored["channels"] not in (["R", "G", "B"], ["Y"]):
        rule = "a capture must be a picture of light"
        raise InputError(str(path), rule, stored["what"], "Give `capture` or `conventional` of that folder.")
    if path.is_file() and manifest.get("sha256", {}).get(path.name) != sha256_file(path):
        raise InputError(str(path), "must be what its manifest describes", "a changed file", "Simulate it again.")
    return stored


def _exr_light(path: Path) -> Float[np.ndarray, "c y x"]:
    channels, _ = read_picture(path)
    for names in (("R", "G", "B"), ("Y",)):
        if set(channels) - {"A"} == set(names):
            return np.stack([channels[name] for name in names])
    rule = "a capture must have the channels R, G, B, or Y alone"
    raise InputError(str(path), rule, f"the channels {', '.join(sorted(channels))}", "Keep these alone.")


def _guarded(path: Path, read: Callable[[Path], Any]) -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # libraries warn of what is refused, or does not matter
            return read(path)
    except InputError:
        raise
    except OSError as error:
        if error.errno is not None:
            raise explain_os_error(error, path) from error
        raise _broken(path, error) from error
    # What the libraries raise on a damaged file depends on where the damage is.
    except Exception as error:
        raise _broken(path, error) from error


def _broken(path: Path, error: Exception) -> InputError:
    got = " ".join(str(error).replace(f"'{path}'", "it").split()) or type(error).__name__
    return InputError(str(path), "the file must be whole and of its kind", f'"{got}"', _CURE)


def _one_picture(path: Path, got: str) -> InputError:
    return InputError(str(path), "must be one picture, grey or in red, green and blue", got, _CURE)


def _as_light(values: np.ndarray, linear: bool | None) -> Photo:
    """Light of the values `[y, x]` or `[y, x, colour]` of a file."""
    planes = values[None] if values.ndim == 2 else values.transpose(2, 0, 1)
    planes = planes[:, ::-1]
    if values.dtype.kind == "f":
        light = planes.astype(np.float32)
        stays = linear is not False
        return Photo(np.ascontiguousarray(light if stays else linear_from_srgb(light)), None, stays)
    bits = 8 * values.dtype.itemsize
    # A table of what every count means is shorter than any picture.
    table = np.arange(2**bits) / (2**bits - 1)
    meaning = (table if linear else linear_from_srgb(table)).astype(np.float32)
    return Photo(np.ascontiguousarray(meaning[planes]), bits, bool(linear))


def _png_values(path: Path) -> UInt[np.ndarray, "..."]:
    from PIL import Image

    data = path.read_bytes()
    with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        image.verify()  # reading the pixels skips their checksum
    with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        if getattr(image, "n_frames", 1) > 1:
            raise _one_picture(path, f"an animation of {getattr(image, 'n_frames', 0)} pictures")
        if not 0 < image.width * image.height <= _MOST_PIXELS:
            raise _one_picture(path, f"{image.width} x {image.height} pixels")
        if image.mode not in ("L", "RGB", "I;16", "I;16B", "I"):
            raise _one_picture(path, f"pixels of the kind {image.mode}")
        deep = image.mode == "RGB" and any(tile.args == "RGB;16B" for tile in image.tile)
        values = np.asarray(image)
    if deep:
        # Pillow keeps the upper byte of a colour's two. Told that the lower one comes first, it keeps the other.
        with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
            image.tile = [tile._replace(args="RGB;16L") for tile in image.tile]
            return values.astype(np.uint16) << 8 | np.asarray(image)
    return values if values.dtype == np.uint8 else values.astype(np.uint16)


def _tiff_values(path: Path) -> np.ndarray:
    import tifffile

    with tifffile.TiffFile(path) as file:
        if len(file.pages) != 1:
            raise _one_picture(path, f"{len(file.pages)} pages")
        page: Any = file.pages[0]
        kind = getattr(page.photometric, "name", str(page.photometric))
        if kind not in ("MINISBLACK", "RGB") or not 0 < np.prod(page.shape) <= 3 * _MOST_PIXELS:
            raise _one_picture(path, f"{kind.lower()} pixels of shape {page.shape}")
        values = page.asarray()
        planes_first = getattr(page.planarconfig, "name", "") == "SEPARATE" and values.ndim == 3
    if planes_first:
        values = values.transpose(1, 2, 0)
    if values.ndim not in (2, 3) or (values.ndim == 3 and values.shape[2] not in (1, 3)):
        raise _one_picture(path, f"pixels of shape {values.shape}")
    if values.dtype.kind not in "fu" or (values.dtype.kind == "u" and values.dtype.itemsize > 2):
        raise InputError(str(path), "pixels must be 8 or 16 bits, or floats", values.dtype, _CURE)
    return values


def _raw_light(path: Path) -> Float[np.ndarray, "c y x"]:
    try:
        import rawpy
    except ImportError as error:
        cure = "pip install 'doedesign[raw]', or develop the file to a linear TIFF of floats first."
        raise InputError(str(path), "camera RAW needs rawpy", "no such package", cure) from error
    path.stat()  # a missing file in the system's own words
    with rawpy.imread(str(path)) as raw:
        # The camera's own colours, balanced for its white; no curve, no turning, nothing made brighter.
        options = {"gamma": (1, 1), "no_auto_bright": True, "output_bps": 16, "user_flip": 0, "use_camera_wb": True}
        counts = raw.postprocess(**options, output_color=rawpy.ColorSpace.raw)
    return np.ascontiguousarray(counts[::-1].transpose(2, 0, 1).astype(np.float32) / np.float32(65535))


def _png_bytes(rows: np.ndarray) -> bytes:
    """A PNG of `[y, x, colour]` counts."""
    stream = io.BytesIO()
    if rows.dtype == np.uint8:
        from PIL import Image

        Image.fromarray(rows if rows.shape[2] == 3 else rows[:, :, 0]).save(stream, "PNG")
        return stream.getvalue()
    import png

    height, width, colours = rows.shape
    writer = png.Writer(width, height, greyscale=colours == 1, bitdepth=16, compression=3)
    writer.write_packed(stream, (row.tobytes() for row in rows.astype(">u2")))
    return stream.getvalue()


def _tiff_bytes(rows: np.ndarray) -> bytes:
    import tifffile

    stream = io.BytesIO()
    colours = rows.shape[2] == 3
    values = rows if colours else rows[:, :, 0]
    tifffile.imwrite(
        stream, values, photometric="rgb" if colours else "minisblack", metadata=None, software="doedesign"
    )
    return stream.getvalue()
