"""Target images for DOEs that draw: beam splitters, diffusers, any picture. All hold unit energy."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from fab.errors import InputError
from fab.units import parse_length
from sim.camera import Camera
from sim.metrics import airy_radius_m, disc_weights


def _length(options: dict[str, Any], key: str, where: str) -> float:
    text = options.get(key)
    try:
        length = parse_length(str(text))
    except ValueError as error:
        raise InputError(
            f"{where}: {key}", "must be a length with a unit", f"{text!r}", f'For example {key} = "250 um".'
        ) from error
    if length <= 0:
        raise InputError(f"{where}: {key}", "must be positive", f"{text!r}", f'For example {key} = "250 um".')
    return length


def spot_centres_m(count: tuple[int, int], spacing_m: float) -> Float[np.ndarray, "spot 2"]:
    """Centres (y, x) of a centred grid of `count` = (columns, rows) spots, metres."""
    x, y = ((np.arange(n) - (n - 1) / 2) * spacing_m for n in count)
    return np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)


def _spots(camera: Camera, options: dict[str, Any], where: str) -> Float[np.ndarray, "y x"]:
    """Ideal-lens images (Airy patterns) at the points of a grid."""
    from scipy.special import j1

    count = options.get("count")
    if not (isinstance(count, tuple) and len(count) == 2 and all(isinstance(n, int) and n > 0 for n in count)):
        raise InputError(
            f"{where}: count", "must be two positive whole numbers", repr(count), "For example count = [5, 5]."
        )
    centres = spot_centres_m(count, _length(options, "spacing", where))
    axis = camera.axis_m()
    if np.abs(centres).max() > axis[-1]:
        raise InputError(
            f"{where}: spacing",
            f"spots must lie within the window, {2 * axis[-1] * 1e3:.4g} mm",
            f"{2 * np.abs(centres).max() * 1e3:.4g} mm",
            "Use fewer or closer spots, or a larger sensor.window.",
        )
    zero = airy_radius_m(camera, camera.colours[0].wavelengths_m[0])
    image = np.zeros((camera.window, camera.window))
    for y, x in centres:
        v = 3.8317 / zero * np.hypot(axis[:, None] - y, axis[None, :] - x)
        image += (2 * j1(np.maximum(v, 1e-9)) / np.maximum(v, 1e-9)) ** 2
    return image


def _square(camera: Camera, options: dict[str, Any], where: str) -> Float[np.ndarray, "y x"]:
    half = _length(options, "width", where) / 2
    share = np.clip((half - np.abs(camera.axis_m())) / camera.pixel_m + 0.5, 0.0, 1.0)
    return share[:, None] * share[None, :]


def _disc(camera: Camera, options: dict[str, Any], where: str) -> Float[np.ndarray, "y x"]:
    radius = _length(options, "diameter", where) / 2
    return disc_weights((camera.window, camera.window), camera.pixel_m, radius).astype(np.float64)


_OPTIONS = {"spots": {"count", "spacing"}, "square": {"width"}, "disc": {"diameter"}}
_PATTERNS: dict[str, Callable[[Camera, dict[str, Any], str], np.ndarray]] = {
    "spots": _spots,
    "square": _square,
    "disc": _disc,
}


def _picture(camera: Camera, path: Path) -> Float[np.ndarray, "y x"]:
    """A picture's luminance in linear light, resized to the window, top row at the highest y."""
    from skimage.color import rgb2gray
    from skimage.io import imread
    from skimage.transform import resize

    try:
        image = np.asarray(imread(path))
    except (OSError, ValueError, SyntaxError) as error:
        raise InputError(
            str(path), "must be a picture (PNG, TIFF, JPEG)", f'"{error}"', "Save it again as PNG."
        ) from error
    if image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,), (4,)):
        raise InputError(str(path), "must be one grey or RGB picture", f"shape {image.shape}", "Save it again as PNG.")
    image = image.astype(np.float64) / (np.iinfo(image.dtype).max if image.dtype.kind in "ui" else 1.0)
    linear = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
    gray = rgb2gray(linear[..., :3]) if linear.ndim == 3 else linear
    return np.asarray(resize(gray, (camera.window, camera.window), anti_aliasing=True))[::-1]


def target_pattern_image(
    camera: Camera, options: dict[str, Any], image: Path | None, where: str
) -> Float[np.ndarray, "y x"]:
    """Target energies per pixel, summing to 1, float32.

    Args:
        camera: sensor window.
        options: `pattern` = "spots" (count, spacing), "square" (width) or "disc" (diameter).
        image: a picture to draw instead.
        where: key of the objective, for messages.

    Raises:
        InputError: an unknown pattern, a missing or impossible option, an unreadable or black picture.
    """
    if image is not None:
        target = _picture(camera, image)
    else:
        name = options.get("pattern")
        if name not in _PATTERNS:
            raise InputError(
                f"{where}: pattern",
                f"must be one of {', '.join(_PATTERNS)}, or an `image` must be given",
                repr(name),
                'For example options = { pattern = "square", width = "1 mm" }.',
            )
        unknown = sorted(options.keys() - _OPTIONS[name] - {"pattern"})
        if unknown:
            known = ", ".join(sorted(_OPTIONS[name]))
            raise InputError(where, f'options of pattern "{name}" are: {known}', unknown[0], "Remove or rename it.")
        target = _PATTERNS[name](camera, options, where)
    total = float(target.sum())
    if not total > 0:
        raise InputError(where, "the target must hold some light inside the window", "none", "Choose another pattern.")
    return (target / total).astype(np.float32)
