"""Height maps, PSF banks and pictures as OpenEXR files; the only importer of OpenEXR.

* The first scan line is the highest y, so a viewer shows +y up; arrays here have row 0 at the lowest y.
* Channels are float32: `height` in metres; for a bank one channel per depth and colour, `z50mm.red`, in energy per
  pixel per unit power incident on the clear aperture, or in the beam. Pixels of a bank have a pitch, `pixel_m`, or
  where there is no sensor a direction sine, `pixel_sine`.
* Lengths, angles and sines are text attributes with all the digits of a float64 (`pitch_m = "1.85e-06"`), because
  EXR's own number attributes are float32.
* A digest of pixels and lengths rides along as the text `sha256` and is checked on reading (EXR itself leaves
  incompressible blocks unguarded). Files without one are taken as they are.
* The same values give the same bytes. A file appears whole or not at all (`fab.files.write_atomic`);
  a path that the system refuses is an InputError.

A PSF measured elsewhere (channels R, G, B, or one channel of any name; half, float or integer) is read as a bank of one
depth with the values its author wrote: as a rule counts, perhaps negative where a background was taken off.
"""

import contextlib
import hashlib
import io
import json
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from fab.aperture import Aperture, MaskAperture, aperture_from
from fab.errors import InputError
from fab.files import canonical_json, path_of, read_bytes, write_atomic
from fab.height import as_array
from fab.pictures import MOST_PER_BYTE
from fab.units import number_of, require_kind

if TYPE_CHECKING:
    import sim.psf_bank

_BANK = "psf_bank"
_DIGEST = "sha256"
_GUARDED = ("aperture_m", "pitch_m", _BANK)
# What OpenEXR writes itself: a text of that name fails, or is lost.
_OPENEXR = (
    "channels", "chunkCount", "compression", "dataWindow", "displayWindow", "lineOrder", "pixelAspectRatio",
    "screenWindowCenter", "screenWindowWidth", "tiles", "type", "version",
)  # fmt: skip
# A file of a few kilobytes can stand for gigabytes of zeros; one that is large itself may hold more.
_MOST_VALUES, _MOST_CHANNELS = 1 << 27, 4096
_SILENT = threading.Lock()


class StoredHeight(NamedTuple):
    """A height map as its file holds it."""

    height_m: Float[np.ndarray, "y x"]  # `[y, x]` heights, metres, row 0 at the lowest y
    pitch_m: float | None  # cell pitch, metres, or None
    aperture: Aperture | None  # the clear aperture, or None
    metadata: dict[str, str]  # the other text attributes


class StoredBank(NamedTuple):
    """A PSF bank as its file holds it, plain arrays."""

    energy: Float[np.ndarray, "colour depth y x"]  # energy per pixel, row 0 at the lowest y
    colours: tuple[str, ...]  # names of the colours
    depths_m: tuple[float, ...]  # depths of the sources, metres
    pixel: float  # pitch of a pixel, metres, or its direction sine
    field_rad: tuple[float, float]  # field angle y, x, radians
    sines: bool  # whether pixels have a sine


def write_height(
    path: str | Path,
    height_m: Float[np.ndarray, "y x"],
    pitch_m: float,
    aperture: Aperture | float,
    extra: Mapping[str, str] | None = None,
) -> None:
    """Write a height map.

    Args:
        path: the file; its folder is made if missing.
        height_m: `[y, x]` heights, metres, rounded to float32.
        pitch_m: cell pitch, metres.
        aperture: the clear aperture; a number is the diameter of a round one, metres.
        extra: further text attributes; a ValueError for a name that is taken.

    Raises:
        InputError: heights that are no map, a pitch or an aperture that is no positive length, or no path.
    """
    outline, heights = aperture_from(aperture), as_array(height_m, "height_m")
    if heights.ndim != 2:
        raise InputError("height_m", "must be a map [y, x]", f"the shape {heights.shape}", "Give heights in metres.")
    if not outline.narrowest_m > 0:
        raise InputError("aperture", "must be positive", str(outline), "Give the diameter in metres.")
    if not 0 < number_of(pitch_m) < np.inf:
        raise InputError("pitch_m", "must be a positive number of metres", repr(pitch_m), "For example 2e-6 for 2 um.")
    sizes = " x ".join(map(repr, map(float, outline.sizes_m)))
    text = canonical_json(outline.record()).decode() if isinstance(outline, MaskAperture) else sizes
    texts = {"pitch_m": repr(float(pitch_m)), "aperture_m": text}
    _write(path_of(path), {"height": heights}, texts, extra)


def read_height(path: str | Path) -> StoredHeight:
    """Read a height map, `[y, x]` in metres.

    Args:
        path: an EXR file with a channel `height`.

    Raises:
        InputError: no such file, or heights that are not finite and at least 0.
    """
    path = path_of(path)
    channels, texts = _read(path)
    if "height" not in channels:
        rule = "a height map must have a channel named height, in metres"
        got = f"the channels {', '.join(sorted(channels))}"
        raise InputError(str(path), rule, got, "Give a height map, or rename its channel.")
    height = channels["height"]
    if not (np.isfinite(height).all() and height.min() >= 0):
        bad = np.argwhere(~(np.isfinite(height) & (height >= 0)))
        y, x = (int(i) for i in bad[0])
        rule = "heights must be finite and at least 0"
        cure = "Measure heights from the deepest floor upward, or write the file again."
        raise InputError(str(path), rule, f"{height[y, x]:.6g} m at row {y}, column {x} ({len(bad)} such pixels)", cure)
    pitch = _length(path, "pitch_m", texts.pop("pitch_m")) if "pitch_m" in texts else None
    aperture = None
    if "aperture_m" in texts:
        aperture = _aperture(path, texts.pop("aperture_m"))
    return StoredHeight(height, pitch, aperture, texts)


def _aperture(path: str | Path, text: str) -> Aperture:
    """Read an aperture as `write_height` writes it: lengths, or the record of a mask."""
    where = f"{path}: aperture_m"
    if not text.startswith("{"):
        return aperture_from([_length(path, "aperture_m", size) for size in text.split(" x ")], where=where)
    try:
        record = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(
            where, "must be the record of a mask", "text that is no JSON", "Write the file again."
        ) from error
    return aperture_from(record, where=where)


def write_bank(path: str | Path, bank: "sim.psf_bank.PsfBank", extra: Mapping[str, str] | None = None) -> None:
    """Write a PSF bank, one channel per depth and colour, rounded to float32.

    Args:
        path: the file; its folder is made if missing.
        bank: PSFs.
        extra: further text attributes.

    Raises:
        InputError: no PSF bank, or no path.
        ValueError: two depths or colours have the same name, or the name of an attribute is taken.
    """
    from sim.psf_bank import PsfBank

    require_kind("bank", bank, PsfBank, "For example sim.psf(design).")
    path = path_of(path)
    channels = {
        _channel_name(depth, colour): bank.energy[c, d]
        for c, colour in enumerate(bank.colours)
        for d, depth in enumerate(bank.depths_m)
    }
    if len(channels) != len(bank.colours) * len(bank.depths_m):
        raise ValueError(f"depths and colours must differ, but got {bank.depths_m} and {bank.colours}")
    description = {
        "colours": list(bank.colours),
        "depths_m": [repr(float(depth)) for depth in bank.depths_m],
        _pixel_key(bank): repr(float(bank.pixel_m)),
        "field_rad": [repr(float(angle)) for angle in bank.field_rad],
    }
    _write(path, channels, {_BANK: canonical_json(description).decode()}, extra)


def _pixel_key(bank: "sim.psf_bank.PsfBank") -> str:
    """Name of the pitch of a bank's pixels: they have a length, or only a direction."""
    return "pixel_sine" if bank.in_angles else "pixel_m"


def read_bank(path: str | Path, pixel_m: float | None = None, depth_m: float = np.inf) -> "sim.psf_bank.PsfBank":
    """Read a PSF bank, or a measured PSF written by another program.

    Args:
        path: the file.
        pixel_m: pixel pitch of a measured PSF, metres. A bank of our own knows its pitch.
        depth_m: source depth of a measured PSF, metres.

    Returns:
        the bank; a measured PSF has the colours R, G, B or the name of its one channel, and its own scale.

    Raises:
        InputError: no whole EXR file with finite values, a pixel pitch that is missing or contradicts the file, or a
            depth that is no positive length.
    """
    from sim.psf_bank import PsfBank

    if not number_of(depth_m) > 0:
        raise InputError("depth_m", "must be a positive number of metres", repr(depth_m), "For example 0.05, or inf.")
    if pixel_m is not None and not 0 < number_of(pixel_m) < np.inf:
        raise InputError("pixel_m", "must be a positive number of metres", repr(pixel_m), "For example 2e-6 for 2 um.")
    channels, texts = _read_psfs(path_of(path))
    if _BANK not in texts:
        colours = _measured_colours(path, channels)
        if pixel_m is None:
            rule = "the pixel pitch of a PSF from another program must be given"
            raise InputError(str(path), rule, "none", "Give the pixel pitch (after binning).")
        stored = _length(path, "pixel pitch", pixel_m)
        energy = np.stack([channels[c] for c in colours])[:, None]
        return PsfBank(energy, colours, (float(depth_m),), stored)
    energy, colours, depths, stored, field, sines = _stored_bank(path, channels, texts)
    if pixel_m is not None and sines:
        rule = "pixels of a bank of directions have a sine in place of a pitch"
        raise InputError(str(path), rule, f"a pitch of {pixel_m:.9g} m", "Give PSFs on a sensor, or leave it out.")
    if pixel_m is not None and not np.isclose(pixel_m, stored, rtol=1e-6, atol=0):
        rule = "the pixel pitch given must be that of the file"
        raise InputError(str(path), rule, f"{pixel_m:.9g} m against {stored:.9g} m", "Leave it out: the file knows it.")
    return PsfBank(energy, colours, depths, stored, field, sines=sines)


def is_own_bank(path: str | Path) -> bool:
    """Whether an EXR file holds a PSF bank of this package; an InputError for no whole EXR file."""
    return _BANK in _read_psfs(path)[1]


def read_stored_bank(path: str | Path) -> StoredBank:
    """Read the PSF bank of our own at a path as plain arrays, without jax; an InputError for anything else."""
    channels, texts = _read_psfs(path)
    if _BANK not in texts:
        raise InputError(str(path), "must be a PSF bank of this package", "another picture", "Give the bank of a run.")
    return _stored_bank(path, channels, texts)


def _read_psfs(path: str | Path) -> tuple[dict[str, Float[np.ndarray, "y x"]], dict[str, str]]:
    """Channels with finite values, and text attributes."""
    channels, texts = _read(Path(path))
    for name, pixels in channels.items():
        if not np.isfinite(pixels).all():
            rule = "a PSF must be finite"
            raise InputError(f"{path}: channel {name}", rule, "NaN or infinity", "Write the file again.")
    return channels, texts


def _stored_bank(path: str | Path, channels: Mapping[str, Any], texts: Mapping[str, str]) -> StoredBank:
    colours, depths, stored, field, sines = _bank_description(path, texts[_BANK])
    names = [[_channel_name(depth, colour) for depth in depths] for colour in colours]
    missing = [name for row in names for name in row if name not in channels]
    if missing:
        rule = "every PSF of the bank must be there"
        raise InputError(str(path), rule, f"no channel {missing[0]}", "Write the file again.")
    energy = np.stack([np.stack([channels[name] for name in row]) for row in names])
    return StoredBank(energy, colours, depths, stored, field, sines)


def write_picture(path: str | Path, channels: Mapping[str, Any], extra: Mapping[str, str] | None = None) -> None:
    """Write a picture in linear light, or any other maps `[y, x]` of one shape, rounded to float32.

    Args:
        path: the file; its folder is made if missing.
        channels: maps by name, such as R, G and B; infinity allowed.
        extra: text attributes; a ValueError for a name that is taken.
    """
    shapes = {np.shape(values) for values in channels.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        raise ValueError(f"`channels` must be maps [y, x] of one shape, but got {sorted(shapes)}")
    _write(Path(path), channels, {}, extra)


def read_picture(path: str | Path) -> tuple[dict[str, Float[np.ndarray, "y x"]], dict[str, str]]:
    """Read the channels `[y, x]` of a picture by name, and its text attributes; see `read_height` for errors."""
    return _read(Path(path))


def _channel_name(depth_m: float, colour: str) -> str:
    """`z50mm.red`. A dot separates layers in EXR, so a depth of 0.5 mm is z0p5mm; infinity is zinf."""
    depth = "inf" if np.isinf(depth_m) else f"{depth_m * 1e3:.12g}mm".replace(".", "p")
    return f"z{depth}.{colour}"


def _bank_description(
    path: str | Path, text: str
) -> tuple[tuple[str, ...], tuple[float, ...], float, tuple[float, float], bool]:
    """Colours, depths, pitch and field angles of a bank, and whether the pitch is a sine."""
    try:
        described = json.loads(text)
        colours = tuple(str(colour) for colour in described["colours"])
        depths = tuple(float(depth) for depth in described["depths_m"])
        y, x = (float(angle) for angle in described["field_rad"])
        sines = "pixel_sine" in described
        key = "pixel_sine" if sines else "pixel_m"
        pixel = described[key]
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        rule = "must list colours, depths_m, pixel_m or pixel_sine, and field_rad"
        raise InputError(f"{path}: {_BANK}", rule, f'"{error!r}"', "Write the file again.") from error
    if not np.isfinite((y, x)).all():
        rule = "must have a field_rad of two finite angles"
        raise InputError(f"{path}: {_BANK}", rule, f"{y} and {x}", "Write the file again.")
    if not colours or not all(depth > 0 for depth in depths) or not depths:
        rule = "needs at least one colour and depths above 0"
        raise InputError(f"{path}: {_BANK}", rule, f"{colours} and {depths}", "Write the file again.")
    return colours, depths, _length(path, f"{_BANK}.{key}", pixel), (y, x), sines


def _measured_colours(path: str | Path, channels: Mapping[str, Any]) -> tuple[str, ...]:
    names = set(channels)
    if {"R", "G", "B"} <= names:
        return ("R", "G", "B")
    without_alpha = sorted(names - {"A"})
    if len(without_alpha) == 1:
        return (without_alpha[0],)
    rule = "a measured PSF must have the channels R, G, B or a single one"
    raise InputError(str(path), rule, f"the channels {', '.join(sorted(names))}", "Keep one layer of the picture.")


def _length(path: str | Path, key: str, text: object) -> float:
    """A positive, finite length in metres."""
    try:
        value = float(text)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, OverflowError):
        value = np.nan
    if not 0 < value < np.inf:
        raise InputError(f"{path}: {key}", "must be a positive length in metres", repr(text), "Correct it.")
    return value


def _write(path: Path, channels: Mapping[str, Any], texts: Mapping[str, str], extra: Mapping[str, str] | None) -> None:
    import OpenEXR

    taken = {_DIGEST, *_GUARDED, *_OPENEXR} & (extra or {}).keys()
    if taken:
        raise ValueError(f"extra attributes must have names of their own, but got {sorted(taken)}")
    # OpenEXR takes the memory as it lies, without a look at strides, and refuses float64: hand it contiguous float32
    # copies. It also replaces the values in the dictionaries it is given, so both are made here.
    pixels = {name: np.array(np.asarray(values)[::-1], np.float32, order="C") for name, values in channels.items()}
    header: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header |= {**texts, **(extra or {}), _DIGEST: _digest(pixels, texts)}
    stream = io.BytesIO()
    OpenEXR.File(header, pixels).write(stream)
    write_atomic(path, stream.getvalue())


def _digest(pixels: Mapping[str, np.ndarray], texts: Mapping[str, str]) -> str:
    """SHA-256 over the lengths and the pixels as they lie in the file, rows from the top."""
    shapes = {name: list(values.shape) for name, values in pixels.items()}
    guarded = {key: texts[key] for key in _GUARDED if key in texts}
    digest = hashlib.sha256(canonical_json([shapes, guarded]))
    for name in sorted(pixels):
        digest.update(pixels[name].data)
    return digest.hexdigest()


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Channels `[y, x]` (row 0 at the lowest y) and text attributes of an EXR file."""
    import OpenEXR

    data = read_bytes(path)
    try:
        with _silence() as said:
            _require_size(path, OpenEXR.File(io.BytesIO(data), header_only=True).parts, len(data))
            file = OpenEXR.File(io.BytesIO(data), separate_channels=True)
            parts = [(dict(part.header), dict(part.channels)) for part in file.parts]
    except InputError:
        raise
    except Exception as error:  # the binding raises RuntimeError, ValueError, MemoryError ... for broken content
        raise _broken(path, str(error)) from error
    if not parts:
        raise _broken(path, said() or "no picture in it")
    header, channels = parts[0]
    shape = _window_shape(path, header)
    pictures = {name: np.ascontiguousarray(channel.pixels) for name, channel in channels.items()}
    del file, parts, channels  # each picture is turned over below, and not all of them kept twice
    for name, pixels in pictures.items():
        if pixels.shape != shape or pixels.dtype.kind not in "fu":
            raise _broken(path, f"channel {name} with {pixels.dtype} pixels of shape {pixels.shape} for {shape}")
    texts = {key: value for key, value in header.items() if isinstance(value, str)}
    if _DIGEST in texts and texts.pop(_DIGEST) != _digest(pictures, texts):
        rule = "pixels and lengths must match the digest written with them"
        cure = f"Restore the file; if it was edited on purpose, remove its attribute {_DIGEST}."
        raise InputError(str(path), rule, "a file that has changed since", cure)
    return {name: np.ascontiguousarray(pictures.pop(name)[::-1], np.float32) for name in list(pictures)}, texts


def _require_size(path: Path, parts: Sequence[Any], file_bytes: int) -> None:
    """Refuse by its header what would take gigabytes to decode, and what is no plain picture."""
    if len(parts) > 1:
        raise InputError(str(path), "the file must have one part", f"{len(parts)} parts", "Save one part alone.")
    for part in parts:
        (x0, y0), (x1, y1) = np.asarray(part.header["dataWindow"], np.int64).tolist()
        channels = len(part.header["channels"])
        most = max(_MOST_VALUES, MOST_PER_BYTE * file_bytes)
        if channels > _MOST_CHANNELS or (y1 - y0 + 1) * (x1 - x0 + 1) * channels > most:
            rule = f"a picture may have at most {_MOST_CHANNELS} channels and {most} values in all"
            got = f"{channels} channels of {x1 - x0 + 1} x {y1 - y0 + 1}"
            raise InputError(str(path), rule, got, "Save fewer or smaller channels.")


def _window_shape(path: Path, header: dict[str, Any]) -> tuple[int, int]:
    """Rows and columns of the picture; a cropped one has lost its centre and is refused."""
    data, display = (np.asarray(header[key]) for key in ("dataWindow", "displayWindow"))
    if not np.array_equal(data, display):
        rule = "the picture must fill its display window, whose centre is the optical axis"
        raise InputError(str(path), rule, f"data window {data.tolist()} in {display.tolist()}", "Save it uncropped.")
    (x0, y0), (x1, y1) = data.tolist()
    return y1 - y0 + 1, x1 - x0 + 1


def _broken(path: Path, what: str) -> InputError:
    return InputError(
        str(path),
        "the file must be a whole OpenEXR picture",
        " ".join(what.replace("'<python_buffer>'", "it").split()),
        "Write it again from its source.",
    )


@contextlib.contextmanager
def _silence() -> Iterator[Callable[[], str]]:
    """Keep what OpenEXR prints about broken files off the terminal; yields a function that returns it.

    It prints through Python's stdout, which must carry data only, and straight to stderr. Both are the whole process's:
    of two threads at once, the second would put back what the first had put there.
    """
    printed = io.StringIO()
    with _SILENT, contextlib.redirect_stdout(printed), contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # the caller closed it
            saved = os.dup(2)
            stack.callback(os.close, saved)
            stack.callback(os.dup2, saved, 2)
            os.dup2(stack.enter_context(open(os.devnull, "wb")).fileno(), 2)
        yield lambda: printed.getvalue().removeprefix("Warning: ")
