"""Frames of a camera: one exposure as its file holds it, with what the file says about its pixels.

OpenEXR (through `sim.store`), 16-bit or floating-point TIFF, 16-bit PNG, and camera RAW by way of rawpy (the extra
`raw`). Eight bits, two of a PSF's five decades, are refused unless asked for. Of a RAW mosaic the pixels of one colour
are taken as they lie, the others marked as not valid. Arrays have row 0 at the lowest y, a picture's last row.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Num

from fab.errors import InputError
from fab.files import opened
from fab.pictures import decoding, read_pixels, require_size

Channel = Literal["red", "green", "blue"]

FRAME_FILES = (".exr", ".tif", ".tiff", ".png")
RAW_FILES = (".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")

_CHANNELS = ("red", "green", "blue")
_CURE = "Write the file again from its source."


class CameraFrame(NamedTuple):
    """One exposure as its file holds it."""

    counts: Float[np.ndarray, "y x"]  # `[y, x]` values, row 0 at the lowest y
    valid: Bool[np.ndarray, "y x"]  # `[y, x]` pixels that carry the chosen colour
    clipped_at: float | None = None  # value at which the file says its pixels are full, or None
    black: float = 0.0  # value that the file gives to no light at all
    step: float = 0.0  # smallest difference of two values; 0 for floats


def read_frame(
    path: str | Path, *, channel: Channel | None = None, pixel_m: float | None = None, allow_8bit: bool = False
) -> CameraFrame:
    """Read one exposure.

    Args:
        path: the file, one of `FRAME_FILES` or `RAW_FILES`.
        channel: which colour to take of a picture in colour, or of a RAW mosaic.
        pixel_m: pixel pitch, metres; checked against an EXR file that knows its own.
        allow_8bit: take files of 8 bits per pixel.

    Raises:
        InputError: a file that cannot be read or measured from, colours without a channel named, or rawpy not
            installed.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in FRAME_FILES + RAW_FILES:
        kinds = ", ".join(FRAME_FILES + RAW_FILES)
        raise InputError(str(path), f"an image must be one of {kinds}", suffix or "no suffix", "Convert it first.")
    if suffix == ".exr":
        return _read_exr(path, channel, pixel_m)
    frame = _read_raw(path, channel) if suffix in RAW_FILES else _read_picture(path, channel, allow_8bit)
    if not np.isfinite(frame.counts).all():
        raise InputError(str(path), "every pixel must be finite", "NaN or infinity", _CURE)
    return frame


def _read_exr(path: Path, channel: Channel | None, pixel_m: float | None) -> CameraFrame:
    from sim.store import is_own_bank, read_bank

    # Of a foreign file only the values are wanted; its pitch is whatever was given. One of our own knows its own.
    bank = read_bank(path, pixel_m if pixel_m is not None or is_own_bank(path) else 1.0)
    if len(bank.depths_m) > 1:
        rule = "a measured PSF must hold one depth"
        raise InputError(str(path), rule, f"a bank of {len(bank.depths_m)}", "Give one file per depth.")
    counts = bank.energy[:, 0]
    if len(counts) > 1:
        first = [name[:1].lower() for name in bank.colours]
        if first != ["r", "g", "b"]:
            got = f"the colours {', '.join(bank.colours)}"
            raise InputError(str(path), "a measured PSF must have one colour, or red, green, blue", got, "Keep one.")
        counts = counts[[_CHANNELS.index(_named(path, channel))]]
    return _frame(counts[0], clipped_at=None)


def _read_picture(path: Path, channel: Channel | None, allow_8bit: bool) -> CameraFrame:
    values = read_pixels(path)
    if values.ndim == 3:
        if values.shape[2] != 3:
            raise InputError(str(path), "an image must be grey or RGB", f"shape {values.shape}", "Keep one channel.")
        values = values[:, :, _CHANNELS.index(_named(path, channel))]
    if values.dtype.kind not in "fu":
        raise InputError(str(path), "pixels must be counts or floats", values.dtype, "Save 16-bit counts.")
    if values.dtype.itemsize == 1 and not allow_8bit:
        cure = "Save 16 bits; or set allow_8bit = true and expect little."
        raise InputError(str(path), "a measured PSF needs 16 bits per pixel", "8 bits", cure)
    return _frame(values)


@contextmanager
def open_raw(path: Path) -> Iterator[Any]:
    """Open a camera's RAW file with rawpy; an InputError where that is missing, or the file missing or damaged."""
    try:
        import rawpy
    except ImportError as error:
        cure = "pip install 'doedesign[raw]', or convert the file to TIFF without any processing first."
        raise InputError(str(path), "camera RAW needs rawpy", "no such package", cure) from error
    with decoding(path):
        with opened(path) as stream:  # what cannot be read is told in the system's own words
            file_bytes = os.fstat(stream.fileno()).st_size
        with rawpy.imread(str(path)) as raw:
            require_size(path, (raw.sizes.raw_height, raw.sizes.raw_width), file_bytes, 2)
            yield raw


def _read_raw(path: Path, channel: Channel | None) -> CameraFrame:
    with open_raw(path) as raw:
        counts = np.array(raw.raw_image_visible)
        colours = np.array(raw.raw_colors_visible)
        names = raw.color_desc.decode()
        mosaic = len(set(names[: raw.num_colors])) > 1 and int(colours.max()) > 0
        black, white = float(np.mean(raw.black_level_per_channel)), float(raw.white_level)
    if counts.ndim != 2:
        raise InputError(str(path), "a RAW image must hold one value per pixel", counts.shape, "Give the sensor's own.")
    valid = np.ones(counts.shape, bool)
    if mosaic:
        letter = _named(path, channel)[0].upper()
        valid = np.isin(colours, [i for i, name in enumerate(names) if name == letter])
    return _frame(counts[::-1], valid[::-1], clipped_at=white, black=black)


def _named(path: Path, channel: Channel | None) -> Channel:
    if channel is None:
        rule = "of a picture in colour one channel must be chosen"
        raise InputError(str(path), rule, "none", 'Set channel = "green", the one that sees the probe.')
    return channel


def _frame(
    values: Num[np.ndarray, "y x"],
    valid: Bool[np.ndarray, "y x"] | None = None,
    clipped_at: float | None = None,
    black: float = 0.0,
) -> CameraFrame:
    step = 0.0
    if values.dtype.kind == "u":
        # Converters of 12 bits often fill the upper bits of 16.
        step = float(np.gcd.reduce(np.unique(values)) or 1)
        clipped_at = clipped_at or _implied_clip(values, valid)
    counts = np.ascontiguousarray(values, dtype=np.float32)
    return CameraFrame(counts, np.ones(counts.shape, bool) if valid is None else valid, clipped_at, black, step)


def _implied_clip(values: Num[np.ndarray, "y x"], valid: Bool[np.ndarray, "y x"] | None) -> float:
    """Value at which unsigned counts are full: their type's, or that of fewer bits if a dozen pixels reach it."""
    full = float(np.iinfo(values.dtype).max)
    highest = int(values.max())
    bits = highest >> ((highest & -highest).bit_length() - 1) if highest else 0
    if bits.bit_length() >= 8 and bits & (bits + 1) == 0:
        used = values if valid is None else values[valid]
        if np.count_nonzero(used == highest) >= 12:
            return float(highest)
    return full
