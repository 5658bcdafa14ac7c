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

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Num

from doedesign.capture.image_files import read_image
from fab.errors import InputError
from fab.files import MANIFEST_NAME, opened, path_of, read_json, sha256_file
from fab.pictures import read_pixels, write_pixels
from sim.frames import RAW_FILES, open_raw
from sim.light import linear_from_srgb
from sim.store import read_picture, write_picture

WRITTEN_FILES = (".png", ".tif", ".tiff", ".exr")
PHOTO_FILES = (*WRITTEN_FILES, *RAW_FILES)

_LIGHT = ("clean", "conventional", "capture")  # of the pictures of `simulate`

_CURE = "Save it again from its source as one picture, grey or in red, green and blue."


class Photo(NamedTuple):
    """A capture of three colours or one as linear light, white 1; bits per value in its file (None for floats).

    `linear` says whether the file held linear light; messages begin with the name.
    """

    light: Float[np.ndarray, "c y x"]
    bits: int | None
    linear: bool
    name: str = "capture"


def read_capture(path: str | Path, linear: bool | None = None) -> Photo:
    """Read a capture.

    Args:
        path: one of `PHOTO_FILES`.
        linear: whether PNG and TIFF hold linear light; by default what is usual for their kind (see above). In a PNG of
            `simulate` a count of linear light is what its manifest says.

    Raises:
        InputError: the file is missing, of another kind, broken, no single picture of one or three colours, or holds
            values that are not finite; or rawpy is not installed.
    """
    path = Path(path)
    require_capture(path)
    suffix = path.suffix.lower()
    stored = _described(path) if suffix in (".png", ".exr") else None
    if suffix == ".exr":
        return finite(Photo(_exr_light(path), None, True, str(path)))
    if stored is not None and linear is not False:  # linear it is; what a count is, the manifest says
        return finite(Photo(read_image(path.parent, stored), 16, True, str(path)))
    if suffix in RAW_FILES:
        return finite(Photo(_raw_light(path), 16, True, str(path)))
    return photo_from_array(read_pixels(path), linear, str(path))


def require_capture(path: Path) -> None:
    """Raise an `InputError` for a file that is missing or, by its ending, no capture, before any is worked on."""
    suffix = path.suffix.lower()
    if suffix not in PHOTO_FILES:
        rule, cure = f"a capture must be one of {', '.join(PHOTO_FILES)}", "Convert it without loss first."
        raise InputError(str(path), rule, suffix or "no suffix", cure)
    with opened(path):
        pass


def finite(photo: Photo) -> Photo:
    """Return a photo as it is; an InputError where it holds values that are not finite."""
    whole = np.isfinite(photo.light)
    if not whole.all():
        row, column = (int(i) for i in np.argwhere(~whole.all(axis=0))[0])
        got = f"NaN or infinity at row {row} from below, column {column} ({int((~whole).sum())} such values)"
        raise InputError(photo.name, "every pixel must be finite", got, "Repair those pixels, or save it again.")
    return photo


def write_reconstruction(path: str | Path, display: Float[np.ndarray, "c y x"], bits: int | None = 16) -> None:
    """Write a picture of three colours or one, given in display values; the file appears whole or not at all.

    PNG and TIFF get display values of 8 or 16 bits, clipped; EXR, and TIFF where `bits` is None, linear floats.

    Raises:
        InputError: another ending, or the system refuses the path.
        ValueError: PNG cannot hold floats, or another number of bits.
    """
    path = path_of(path)
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
    if bits is None:
        values = np.maximum(linear_from_srgb(display), 0).astype(np.float32)
    else:
        values = np.rint(np.clip(display, 0, 1) * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    write_pixels(path, values[0] if len(values) == 1 else values.transpose(1, 2, 0), compression=3)


def _described(path: Path) -> dict[str, Any] | None:
    """Entry of the manifest of `simulate` beside a file, which must be a picture of light; None without a manifest."""
    if not (path.parent / MANIFEST_NAME).is_file():
        return None
    manifest = read_json(path.parent / MANIFEST_NAME)
    images = manifest.get("images")
    if not str(manifest.get("format", "")).startswith("doedesign simulation") or not isinstance(images, dict):
        return None
    described = ((name, one) for name, one in images.items() if isinstance(one, dict))
    name, stored = next((each for each in described if each[1].get("file") == path.name), ("", None))
    if stored is None:
        return None
    # OpenEXR holds the numbers as they are.
    scale = 1.0 if path.suffix.lower() == ".exr" else stored.get("full_scale")
    digests = manifest.get("sha256")
    if not (isinstance(scale, float | int) and scale > 0 and isinstance(stored.get("what"), str)):
        rule, got = f"must say what {path.name} shows, and what its counts mean", f"{stored}"
        raise InputError(str(path.parent / MANIFEST_NAME), rule, got, "Simulate it again.")
    if name not in _LIGHT:  # a share of light may have its channels, too
        rule = "a capture must be a picture of light"
        raise InputError(str(path), rule, stored["what"], "Give `capture` or `conventional` of that folder.")
    if path.is_file() and (digests if isinstance(digests, dict) else {}).get(path.name) != sha256_file(path):
        raise InputError(str(path), "must be what its manifest describes", "a changed file", "Simulate it again.")
    return stored


def _exr_light(path: Path) -> Float[np.ndarray, "c y x"]:
    channels, _ = read_picture(path)
    for names in (("R", "G", "B"), ("Y",)):
        if set(channels) - {"A"} == set(names):
            return np.stack([channels[name] for name in names])
    rule = "a capture must have the channels R, G, B, or Y alone"
    raise InputError(str(path), rule, f"the channels {', '.join(sorted(channels))}", "Keep these alone.")


def photo_from_array(values: Num[np.ndarray, "..."], linear: bool | None = None, name: str = "capture") -> Photo:
    """Take uint8, uint16 or floats `[y, x]`, or `[y, x, 3]` for red, green and blue, row 0 at the lowest y, for light.

    By default floats are `linear` light, white 1, and integers are display values (sRGB), white at the highest count.

    Raises:
        InputError: another shape or another type, or values that are not finite.
    """
    values = np.asarray(values)
    if values.ndim not in (2, 3) or (values.ndim == 3 and values.shape[2] not in (1, 3)):
        rule, got = "must be one picture, grey or in red, green and blue", f"pixels of shape {values.shape}"
        raise InputError(name, rule, got, _CURE)
    if values.dtype.kind not in "fu" or (values.dtype.kind == "u" and values.dtype.itemsize > 2):
        raise InputError(name, "pixels must be 8 or 16 bits, or floats", values.dtype, _CURE)
    planes = values[None] if values.ndim == 2 else values.transpose(2, 0, 1)
    if values.dtype.kind == "f":
        light = planes.astype(np.float32)
        stays = linear is not False
        return finite(Photo(np.ascontiguousarray(light if stays else linear_from_srgb(light)), None, stays, name))
    bits = 8 * values.dtype.itemsize
    # A table of what every count means is shorter than any picture.
    table = np.arange(2**bits) / (2**bits - 1)
    meaning = (table if linear else linear_from_srgb(table)).astype(np.float32)
    return Photo(np.ascontiguousarray(meaning[planes]), bits, bool(linear), name)


def _raw_light(path: Path) -> Float[np.ndarray, "c y x"]:
    with open_raw(path) as raw:
        import rawpy

        # The camera's own colours, balanced for its white; no curve, no turning, nothing made brighter.
        options = {"gamma": (1, 1), "no_auto_bright": True, "output_bps": 16, "user_flip": 0, "use_camera_wb": True}
        counts = raw.postprocess(**options, output_color=rawpy.ColorSpace.raw)
    return np.ascontiguousarray(counts[::-1].transpose(2, 0, 1).astype(np.float32) / np.float32(65535))
