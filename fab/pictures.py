"""Pictures in files: the one place that decodes and encodes PNG, TIFF, JPEG, WebP and BMP (OpenEXR: `sim.store`).

Arrays are `[y, x]`, or `[y, x, plane]` for colours and transparency, with row 0 at the lowest y; files have the top row
first. TIFF and all writing go through imageio. Pillow, on which imageio reads the rest, is called itself for what
imageio leaves out: checksums of a PNG, the lower byte of a PNG with 16 bits in each colour (imageio 2.38 drops it), and
decoding a large JPEG at a fraction of its size. Such a PNG is written by pypng, since neither can.
"""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.files import explain_os_error, read_bytes, write_atomic

TIFF_FILES = (".tif", ".tiff")
MOST_PIXELS = 1 << 28

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
        got = " ".join(str(error).replace(f"'{path}'", "it").split()) or type(error).__name__
        raise InputError(str(path), rule, f'"{got}"', cure) from error


def _require(fits: bool, path: Path, got: str, rule: str = "the file must hold one grey or colour picture") -> None:
    if not fits:
        raise InputError(str(path), rule, got, _CURE)


def _size(most_pixels: int) -> str:
    return f"a picture must have from 1 to {most_pixels} pixels"


def read_pixels(path: str | Path, *, most_pixels: int = MOST_PIXELS, others: str | None = None) -> NDArray[Any]:
    """Read the values of a PNG or TIFF, which its ending says it is, as they are; its orientation is left alone.

    Args:
        path: the file.
        most_pixels: number above which a picture is refused before anything is decoded.
        others: mode of Pillow, such as "RGBA", into which pixels that are not plain counts (a palette, single bits) are
            converted; they are refused if None.

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
            return _tiff_pixels(path, data, most_pixels, others)[::-1]
        return _png_pixels(path, data, most_pixels, others)[::-1]


def _tiff_pixels(path: Path, data: bytes, most_pixels: int, others: str | None) -> NDArray[Any]:
    import imageio.v3 as imageio

    opened: Any = imageio.imopen(data, "r", plugin="tifffile")  # its stubs lack `page`
    with opened as file:
        pages, *shape = file.properties(index=..., page=...).shape
        _require(pages == 1, path, f"{pages} pages")
        _require(len(shape) in (2, 3), path, f"pixels of shape {(*shape,)}")
        _require(0 < prod(shape) <= 4 * most_pixels, path, f"values of shape {(*shape,)}", _size(most_pixels))
        tags = file.metadata(index=0)
        kind = getattr(tags["PhotometricInterpretation"], "name", str(tags["PhotometricInterpretation"])).lower()
        plain = kind in ("minisblack", "rgb")
        _require(plain or others is not None, path, f"{kind} pixels of shape {(*shape,)}")
        if plain:
            values = file.read(index=0)
            planes_first = getattr(tags["planar_configuration"], "name", "") == "SEPARATE" and values.ndim == 3
            return values.transpose(1, 2, 0) if planes_first else values
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=["TIFF"]) as image:
        return np.asarray(image.convert(others))


def _png_pixels(path: Path, data: bytes, most_pixels: int, others: str | None) -> NDArray[Any]:
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        image.verify()  # reading the pixels skips their checksum
    with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        count = getattr(image, "n_frames", 1)
        _require(count == 1, path, f"an animation of {count} pictures")
        _require(
            0 < image.width * image.height <= most_pixels, path, f"{image.width} x {image.height}", _size(most_pixels)
        )
        plain = image.mode in ("L", "LA", "RGB", "RGBA") or image.mode.startswith("I")
        _require(plain or others is not None, path, f"pixels of the kind {image.mode}")
        deep = image.mode == "RGB" and any(tile.args == "RGB;16B" for tile in image.tile)
        values = np.asarray(image if plain else image.convert(others))
    if deep:
        # Pillow keeps the upper byte of a colour's two. Told that the lower one comes first, it keeps the other.
        with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
            image.tile = [tile._replace(args="RGB;16L") for tile in image.tile]
            return values.astype(np.uint16) << 8 | np.asarray(image)
    return values if values.dtype == np.uint8 else values.astype(np.uint16)


def read_display(path: str | Path, most_px: int | None = None) -> NDArray[np.uint8]:
    """Read any picture as a display shows it: upright as its orientation says, `[y, x, 3]` in 8 bits (sRGB).

    Sixteen bits are rounded to eight, colour profiles are not looked at, transparent pixels count as they are painted.
    If the shorter side has more than `most_px` pixels, it is shrunk to them by averaging display values.

    Raises:
        InputError: the file is missing, damaged, too large, or holds no display values.
    """
    from PIL import Image, ImageOps

    with decoding(path, "must be a whole picture", "Replace or remove the file."), Image.open(path) as image:
        if not 0 < image.width * image.height <= MOST_PIXELS:
            raise ValueError(f"{image.width} x {image.height} pixels, more than {MOST_PIXELS}")
        if image.mode in ("F", "LAB", "HSV"):
            raise ValueError(f"pixels of the kind {image.mode}, which are no display values")
        if most_px is not None:
            # A JPEG can be decoded at an eighth of its size and up in much less time.
            shrink = most_px / min(image.size)
            image.draft("RGB", (round(image.width * shrink), round(image.height * shrink)))
        if image.mode.startswith("I"):  # sixteen bits of grey
            counts = (np.asarray(image).astype(np.int64) * 255 + 32767) // 65535
            rgb = Image.fromarray(counts.clip(0, 255).astype(np.uint8)).convert("RGB")
        else:
            rgb = image.convert("RGB")
        upright = ImageOps.exif_transpose(rgb)
        shorter = min(upright.size)
        if most_px is not None and shorter > most_px:
            width, height = (max(1, round(n * most_px / shorter)) for n in upright.size)
            upright = upright.resize((width, height), Image.Resampling.BOX)
        return np.ascontiguousarray(np.asarray(upright, np.uint8)[::-1])


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
