"""Files of a simulated capture: OpenEXR, or 16-bit PNG with what a count means in the JSON beside it.

EXR holds the numbers as they are. PNG holds `count / 65535 * full_scale`, rounded and cut to what fits: light below 0
(noise below black) becomes 0. A depth is stored there as its inverse, so that infinity is 0.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from fab.pictures import read_pixels, write_pixels
from sim.store import read_picture, write_picture

_COUNTS = 65535


def write_image(
    folder: Path,
    name: str,
    image: Float[np.ndarray, "c y x"],
    channels: tuple[str, ...],
    what: str,
    *,
    png: bool = False,
    full_scale: float = 1.0,
    inverse: bool = False,
) -> dict[str, Any]:
    """Write one image of an item, and describe it for JSON.

    Values `[c, y, x]` with a name for each channel go into an EXR, or into a 16-bit PNG, which holds one channel or
    three. `full_scale` is the value (or with `inverse`, its inverse) of a PNG's highest count.

    Raises:
        InputError: the system refuses the path.
    """
    if not png:
        write_picture(folder / f"{name}.exr", dict(zip(channels, image, strict=True)), {"what": what})
        return {"file": f"{name}.exr", "what": what, "channels": list(channels)}
    values = 1 / image if inverse else image
    counts = np.rint(np.clip(values / full_scale, 0, 1) * _COUNTS).astype(np.uint16)
    write_pixels(folder / f"{name}.png", counts[0] if len(counts) == 1 else counts.transpose(1, 2, 0))
    about = {"file": f"{name}.png", "what": what, "channels": list(channels), "full_scale": full_scale}
    return {**about, "inverse": True} if inverse else about


def read_image(folder: Path, stored: Mapping[str, Any]) -> Float[np.ndarray, "c y x"]:
    """Read an image that `write_image` wrote into a folder, by the description that it returned.

    Raises:
        InputError: the file is missing, broken, or changed.
    """
    path = folder / stored["file"]
    if path.suffix == ".exr":
        channels, _ = read_picture(path)
        return np.stack([channels[name] for name in stored["channels"]])
    counts = read_pixels(path)
    planes = counts[None] if counts.ndim == 2 else counts.transpose(2, 0, 1)
    values = planes.astype(np.float32) * np.float32(stored["full_scale"] / _COUNTS)
    if stored.get("inverse"):
        with np.errstate(divide="ignore"):
            values = 1 / values
    return values
