"""A mask from a picture: white is open.

The picture covers the raster of a DOE, and has its proportions: every cell takes the pixel that its centre lies in. It
is open where that is brighter than half of white, the greatest count of the file; colours count by their mean, and what
is transparent is black. The numbers of an array (.npy) are open above 0.5, row 0 at the lowest y; a picture is stored
from the top row down and turned, so that up in the picture is +y.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.files import read_npy
from fab.pictures import TIFF_FILES, read_pixels

MASK_FILES = (".png", *TIFF_FILES, ".npy")


def read_mask(path: str | Path, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the cells ``[y, x]`` of a raster of a shape that are open by a picture.

    Raises:
        InputError: the file is missing, damaged, of another kind or too large, holds no plain values, has other
            proportions than the raster, or is open nowhere.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in MASK_FILES:
        got = path.suffix or "no suffix"
        raise InputError(
            str(path), f"a mask must be a file of {', '.join(MASK_FILES)}", got, "Save it as one of these."
        )
    values = read_npy(path) if suffix == ".npy" else read_pixels(path, others="RGBA")
    light = _brightness(path, values, 1 if suffix == ".npy" or values.dtype.kind not in "ui" else None)
    ny, nx = light.shape
    if ny * shape[1] != nx * shape[0]:
        rule = f"must have the proportions of the DOE's {shape[1]} x {shape[0]} cells"
        raise InputError(str(path), rule, f"{nx} x {ny} pixels", "Draw a pixel per cell, or as many cells per pixel.")
    rows, columns = (((2 * np.arange(n) + 1) * pixels) // (2 * n) for n, pixels in zip(shape, light.shape, strict=True))
    plane = (light > 0.5)[np.ix_(rows, columns)]
    if not plane.any():
        got = f"{light.max():.3g} of white at the most"
        raise InputError(str(path), "must be open, brighter than half of white, somewhere", got, "Draw it in white.")
    return plane


def _brightness(path: Path, values: NDArray[Any], white: int | None) -> NDArray[np.floating]:
    """Return the light ``[y, x]`` of pixels over that of white, by default the greatest count of their type."""
    if values.dtype.kind not in "buif" or values.ndim not in (2, 3) or (values.ndim == 3 and values.shape[2] > 4):
        got = f"{values.dtype} of shape {values.shape}"
        raise InputError(str(path), "a mask must hold grey values or colours", got, "Save one picture.")
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise InputError(str(path), "a mask must hold finite values", "some that are not", "Fill its holes.")
    white = np.iinfo(values.dtype).max if white is None else white
    if values.ndim == 2:
        return values.astype(np.float32) / np.float32(white)
    colours = values.shape[2] - 1 if values.shape[2] in (2, 4) else values.shape[2]
    light = values[..., :colours].mean(axis=2, dtype=np.float32) / np.float32(white)
    return light if colours == values.shape[2] else light * (values[..., -1] / np.float32(white))
