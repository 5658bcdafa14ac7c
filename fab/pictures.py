"""Pictures in files: the one place that decodes and encodes PNG, TIFF, JPEG, WebP and BMP (OpenEXR: `sim.store`).

Arrays are `[y, x]`, or `[y, x, plane]` for colours and transparency, with row 0 at the lowest y; files have the top row
first. TIFF and all writing go through imageio. Pillow, on which imageio reads the rest, is called itself for what
imageio leaves out: checksums of a PNG, the lower byte of a PNG with 16 bits in each colour (imageio 2.38 drops it), and
decoding a large JPEG at a fraction of its size. Such a PNG is written by pypng, since neither can.
"""

import io
import re
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.files import explain_os_error, read_bytes, write_atomic

TIFF_FILES = (".tif", ".tiff")
# A file of a few kilobytes can stand for gigabytes of black; one that is large itself may hold more.
MOST_PIXELS, MOST_PER_BYTE = 1 << 26, 8
_BYTES_PER_PIXEL = 4
# Ways to pack a TIFF that cannot unfold to more than its size says, or are looked at before: none, LZW, Deflate (both
# numbers), PackBits.
_PACKED, _DEFLATE = (1, 5, 8, 32773, 32946), (8, 32946)
_SMALL_STRIP = 1 << 18
# Others of Pillow start programs (EPS) or are hardly ever tested.
_DISPLAYED = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "GIF")

_CURE = "Save it again from its source."


@contextmanager
def decoding(
    path: str | Path, rule: str = "the file must be whole and of its kind", cure: str = _CURE
) -> Iterator[None]:
    """Turn every error of a decoder within this block into an `InputError` that names the file."""
    try:
        yield
    except InputError:
        raise
    # What the libraries raise on a damaged file depends on where the damage is.
    except Exception as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise explain_os_error(error, path) from error
        named = rf"'{re.escape(str(path))}'|<_io\.\w+ object at \w+>"
        text = re.sub(named, lambda _: Path(path).name, str(error))
        got = " ".join(text.split()) or type(error).__name__
        raise InputError(str(path), rule, f'"{got}"', cure) from error


def _require(fits: bool, path: Path, got: str, rule: str = "the file must hold one grey or colour picture") -> None:
    if not fits:
        raise InputError(str(path), rule, got, _CURE)


def require_size(
    path: Path, shape: Sequence[int], file_bytes: int, itemsize: int = 1, most_px: int | None = None
) -> None:
    """Refuse a picture of more pixels than memory should be given for, before it is decoded.

    Args:
        path: its file, for the message.
        shape: rows, columns and, if any, planes.
        file_bytes: size of the file.
        itemsize: bytes of a value.
        most_px: pixels that any file may stand for, `MOST_PIXELS` by default; a large one for more.
    """
    most = max(most_px or MOST_PIXELS, MOST_PER_BYTE * file_bytes)
    fits = 0 < shape[0] * shape[1] <= most and prod(shape) * itemsize <= _BYTES_PER_PIXEL * most
    rule = f"a picture must have from 1 to {most} pixels, of {_BYTES_PER_PIXEL} bytes at the most"
    _require(fits, path, f"values of shape {tuple(shape)}, {itemsize} bytes each", rule)


def read_pixels(path: str | Path, *, others: str | None = None, most_px: int | None = None) -> NDArray[Any]:
    """Read the values of a PNG or TIFF, which its ending says it is, as they are; its orientation is left alone.

    Args:
        path: the file.
        others: mode of Pillow, such as "RGBA", into which pixels that are not plain counts (a palette, single bits) are
            converted; they are refused if None.
        most_px: pixels that a small file may stand for, `MOST_PIXELS` by default.

    Returns:
        uint8, uint16 or what else a TIFF holds: `[y, x]`, or `[y, x, plane]` with 2 planes (grey and opacity), 3 or 4.

    Raises:
        InputError: the file is missing, damaged, of another kind, too large, or not a single picture.
    """
    path = Path(path)
    data = read_bytes(path)
    with decoding(path), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # libraries warn of what is refused, or does not matter
        if path.suffix.lower() in TIFF_FILES:
            return _tiff_pixels(path, data, others, most_px)[::-1]
        return _png_pixels(path, data, others, most_px)[::-1]


def _tiff_pixels(path: Path, data: bytes, others: str | None, most_px: int | None) -> NDArray[Any]:
    import tifffile

    with tifffile.TiffFile(io.BytesIO(data)) as file:
        _require(len(file.pages) == 1, path, f"{len(file.pages)} pages")
        page: Any = file.pages[0]
        _require(len(page.shape) in (2, 3), path, f"pixels of shape {page.shape}")
        separate = page.planarconfig == 2 and len(page.shape) == 3
        shape = (*page.shape[1:], page.shape[0]) if separate else page.shape
        require_size(path, shape, len(data), page.dtype.itemsize, most_px)
        kind = getattr(page.photometric, "name", str(page.photometric)).lower()
        plain = kind in ("minisblack", "rgb")
        _require(plain or others is not None, path, f"{kind} pixels of shape {page.shape}")
        if plain:
            _require_bounded(path, page, data)
            values = page.asarray()
            return values.transpose(1, 2, 0) if separate else values
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=["TIFF"]) as image:
        return np.asarray(image.convert(others))


def _require_bounded(path: Path, page: Any, data: bytes) -> None:
    """Refuse packed strips or tiles that unfold to more than their size says: tifffile would unfold them whole."""
    if page.compression not in _PACKED:
        how = getattr(page.compression, "name", str(page.compression))
        _require(False, path, f"compression {how}", "a TIFF must be packed by LZW, Deflate, PackBits or not at all")
    most = prod(page.chunks) * page.dtype.itemsize
    for start, count in zip(page.dataoffsets, page.databytecounts, strict=True):
        if page.compression in _DEFLATE and count > _SMALL_STRIP:
            found = len(zlib.decompressobj().decompress(data[start : start + count], most + 1))
            _require(found <= most, path, f"more than {most} bytes", "a strip must unfold to its size")


def _png_pixels(path: Path, data: bytes, others: str | None, most_px: int | None) -> NDArray[Any]:
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        image.verify()  # reading the pixels skips their checksum
    with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        count = getattr(image, "n_frames", 1)
        _require(count == 1, path, f"an animation of {count} pictures")
        plain = image.mode in ("L", "LA", "RGB", "RGBA") or image.mode.startswith("I")
        _require(plain or others is not None, path, f"pixels of the kind {image.mode}")
        deep = image.mode == "RGB" and any(tile.args == "RGB;16B" for tile in image.tile)
        planes = len(image.getbands())
        itemsize = 1 + (deep or planes == 1)
        require_size(path, (image.height, image.width, planes), len(data), itemsize, most_px)
        values = np.asarray(image if plain else image.convert(others))
    if deep:
        # Pillow keeps the upper byte of a colour's two. Told that the lower one comes first, it keeps the other.
        with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
            image.tile = [tile._replace(args="RGB;16L") for tile in image.tile]
            return values.astype(np.uint16) << 8 | np.asarray(image)
    return values if values.dtype == np.uint8 else values.astype(np.uint16, copy=False)


def read_display(path: str | Path, most_px: int | None = None) -> NDArray[np.uint8]:
    """Read any picture as a display shows it: upright as its orientation says, `[y, x, 3]` in 8 bits (sRGB).

    Sixteen bits are rounded to eight, colour profiles are not looked at, transparent pixels count as they are painted.
    If the shorter side has more than `most_px` pixels, it is shrunk to them by averaging display values.

    Raises:
        InputError: the file is missing, damaged, too large, or holds no display values.
    """
    from PIL import Image, ImageOps

    data, path = read_bytes(path), Path(path)
    with (
        decoding(path, "must be a whole picture", "Replace or remove the file."),
        Image.open(io.BytesIO(data), formats=_DISPLAYED) as image,
    ):
        require_size(path, (image.height, image.width), len(data))
        if image.mode in ("F", "LAB", "HSV"):
            raise ValueError(f"pixels of the kind {image.mode}, which are no display values")
        if most_px is not None:
            # A JPEG can be decoded at an eighth of its size and up in much less time.
            shrink = most_px / min(image.size)
            image.draft("RGB", (round(image.width * shrink), round(image.height * shrink)))
        ImageOps.exif_transpose(image, in_place=True)
        upright = image if image.mode == "RGB" else _eight_bits(image).convert("RGB")
        shorter = min(upright.size)
        if most_px is not None and shorter > most_px:
            width, height = (max(1, round(n * most_px / shorter)) for n in upright.size)
            upright = upright.resize((width, height), Image.Resampling.BOX)
        return np.ascontiguousarray(np.asarray(upright, np.uint8)[::-1])


def _eight_bits(image: Any) -> Any:
    """Round sixteen bits of grey to eight; other pictures stay."""
    if not image.mode.startswith("I"):
        return image
    from PIL import Image

    counts = np.asarray(image).clip(0, 65535).astype(np.uint32)
    counts *= 255
    counts += 32767
    counts //= 65535
    return Image.fromarray(counts.astype(np.uint8))


def write_pixels(
    path: str | Path,
    values: NDArray[Any],
    compression: int | None = None,
    *,
    about: str = "",
    pitch_m: float | None = None,
) -> None:
    """Write a PNG or TIFF, which its ending says, whole or not at all; the same values give the same bytes.

    Args:
        path: the file.
        values: uint8 or uint16, for a TIFF floats too, `[y, x]` or `[y, x, 3]`.
        compression: zlib's level for a PNG of 16 bits, 0 to 9; its usual one if None.
        about: a description that goes into the file; a TIFF with one is compressed.
        pitch_m: edge of a pixel, metres, for the resolution tags of a TIFF.
    """
    import imageio.v3 as imageio

    rows = np.ascontiguousarray(values[::-1])
    options: dict[str, Any] = {}
    if Path(path).suffix.lower() in TIFF_FILES:
        options = {"photometric": "rgb" if rows.ndim == 3 else "minisblack", "metadata": None, "software": "doedesign"}
        if about:
            options |= {"compression": "zlib", "description": about}
        if pitch_m is not None:
            options |= {"resolution": (0.01 / pitch_m, 0.01 / pitch_m), "resolutionunit": "CENTIMETER"}
        write_atomic(path, imageio.imwrite("<bytes>", rows, extension=".tif", **options))
    elif rows.dtype == np.uint8 or about:
        if about:
            from PIL.PngImagePlugin import PngInfo

            options["pnginfo"] = PngInfo()
            options["pnginfo"].add_text("Description", about)
        write_atomic(path, imageio.imwrite("<bytes>", rows, extension=".png", **options))
    else:
        import png

        stream = io.BytesIO()
        grey: Any = rows.ndim == 2
        writer = png.Writer(rows.shape[1], rows.shape[0], greyscale=grey, bitdepth=16, compression=compression)
        writer.write_packed(stream, (row.tobytes() for row in rows.astype(">u2")))
        write_atomic(path, stream.getvalue())


def webp_bytes(values: NDArray[np.uint8], quality: int | None = None, *, most_px: int | None = None) -> bytes:
    """Return a picture as a WebP file for a page; the same values give the same bytes.

    Args:
        values: `[y, x]` or `[y, x, 3]`, row 0 at the lowest y.
        quality: 0 to 100, losing what eyes hardly see; None loses nothing.
        most_px: its longer side is shrunk to so many pixels by averaging; None leaves it.
    """
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(values[::-1]))
    if most_px is not None and max(image.size) > most_px:
        width, height = (max(1, round(n * most_px / max(image.size))) for n in image.size)
        image = image.resize((width, height), Image.Resampling.BOX)
    stream = io.BytesIO()
    given: dict[str, Any] = {"lossless": True, "quality": 20} if quality is None else {"quality": quality}
    image.save(stream, "WEBP", method=1, **given)
    return stream.getvalue()
