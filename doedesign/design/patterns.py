"""Target images for DOEs that draw: beam splitters, diffusers, any picture. All hold unit energy."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from fab.errors import InputError
from fab.grid import Grid
from fab.pictures import TIFF_FILES, read_display, read_pixels
from fab.units import MILLIMETRES, parse_angle, parse_length
from sim.aperture import circle_coverage
from sim.camera import Camera
from sim.light import linear_from_srgb
from sim.metrics import airy_radius_m

Image = Float[np.ndarray, "y x"]


def positive_length(text: object, where: str) -> float:
    """Length in metres of an option such as "250 um"; `where` is its key, for messages."""
    cure = f'For example {where.rpartition(" ")[2].rpartition(".")[2]} = "250 um".'
    try:
        length = parse_length(str(text))
    except ValueError as error:
        raise InputError(where, "must be a length with a unit", repr(text), cure) from error
    if length <= 0:
        raise InputError(where, "must be positive", repr(text), cure)
    return length


def positive_place(text: object, camera: Camera, where: str, *, size: bool = False) -> float:
    """Place of an option on the sensor, metres, or an angle where there is none, as its sine; see `positive_length`.

    A `size` lies about the axis: it becomes twice the sine of half its angle.
    """
    if not camera.in_angles:
        return positive_length(text, where)
    cure = f'For example {where.rpartition(" ")[2]} = "2 deg".'
    try:
        angle = parse_angle(str(text))
    except ValueError as error:
        raise InputError(where, "must be an angle with a unit", repr(text), cure) from error
    if not 0 < angle <= np.pi / (1 if size else 2):
        raise InputError(where, "must be positive and not beyond the horizon", repr(text), cure)
    return float(2 * np.sin(angle / 2) if size else np.sin(angle))


def spot_centres_m(count: tuple[int, int], spacing_m: float) -> Float[np.ndarray, "spot 2"]:
    """Centres (y, x) of a centred grid of `count` = (columns, rows) spots, metres."""
    x, y = ((np.arange(n) - (n - 1) / 2) * spacing_m for n in count)
    return np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)


def offset_m(options: Mapping[str, Any], camera: Camera, where: str) -> tuple[float, float]:
    """Middle (y, x) of a pattern on the sensor, metres, of the option `offset = ["x", "y"]`; `where` as above.

    Without a sensor it is two angles, as their sines.
    """
    if "offset" not in options:
        return 0.0, 0.0
    texts, parse = options["offset"], parse_angle if camera.in_angles else parse_length
    rule, cure = "must be two lengths, [x, y]", 'For example offset = ["100 um", "0 um"].'
    if camera.in_angles:
        rule, cure = "must be two angles, [x, y]", 'For example offset = ["2 deg", "0 deg"].'
    if not (isinstance(texts, tuple) and len(texts) == 2):
        raise InputError(f"{where}: offset", rule, repr(texts), cure)
    try:
        x, y = (parse(str(text)) for text in texts)
    except ValueError as error:
        raise InputError(f"{where}: offset", rule, repr(texts), cure) from error
    return (float(np.sin(y)), float(np.sin(x))) if camera.in_angles else (y, x)


def _spots(camera: Camera, options: dict[str, Any], where: str) -> Image:
    """Ideal-lens images (Airy patterns) at the points of a grid."""
    from scipy.special import j1

    count = options.get("count")
    # True would count as 1.
    if not (isinstance(count, tuple) and len(count) == 2 and all(type(n) is int and n > 0 for n in count)):
        rule = "must be two positive whole numbers"
        raise InputError(f"{where}: count", rule, repr(count), "For example count = [5, 5].")
    centres = spot_centres_m(count, positive_place(options.get("spacing"), camera, f"{where}: spacing"))
    centres += offset_m(options, camera, where)
    axis, unit = camera.axis_m(), camera.told_in(MILLIMETRES)
    if np.abs(centres).max() > axis[-1]:
        wide, got = (f"{unit.size(2 * end):.4g} {unit.suffix}" for end in (axis[-1], np.abs(centres).max()))
        rule, cure = f"spots must lie within the window, {wide}", "Use fewer or closer spots, or a larger window."
        raise InputError(f"{where}: spacing", rule, got, cure)
    zero = airy_radius_m(camera, camera.colours[0].wavelengths_m[0])
    image = np.zeros((camera.window, camera.window))
    for y, x in centres:
        v = 3.8317 / zero * np.hypot(axis[:, None] - y, axis[None, :] - x)
        image += (2 * j1(np.maximum(v, 1e-9)) / np.maximum(v, 1e-9)) ** 2
    return image


def _square(camera: Camera, options: dict[str, Any], where: str) -> Image:
    half = positive_place(options.get("width"), camera, f"{where}: width", size=True) / 2
    y, x = (
        np.clip((half - np.abs(camera.axis_m() - middle)) / camera.pixel_m + 0.5, 0.0, 1.0)
        for middle in offset_m(options, camera, where)
    )
    return y[:, None] * x[None, :]


def _disc(camera: Camera, options: dict[str, Any], where: str) -> Image:
    radius = positive_place(options.get("diameter"), camera, f"{where}: diameter", size=True) / 2
    shape, centre = (camera.window, camera.window), offset_m(options, camera, where)
    return circle_coverage(Grid(shape, camera.pixel_m), 2 * radius, centre).astype(np.float64)


# Every pattern with its options.
PATTERNS: dict[str, tuple[Callable[[Camera, dict[str, Any], str], np.ndarray], set[str]]] = {
    "spots": (_spots, {"count", "spacing", "offset"}),
    "square": (_square, {"width", "offset"}),
    "disc": (_disc, {"diameter", "offset"}),
}


def picture_light(path: Path) -> Image:
    """A picture's luminance in linear light, from 0 to 1, top row at the highest y."""
    from skimage.color import rgb2gray

    exact = path.suffix.lower() in (".png", *TIFF_FILES)
    values = read_pixels(path, others="RGBA") if exact else read_display(path)
    light = linear_from_srgb(values / (np.iinfo(values.dtype).max if values.dtype.kind in "ui" else 1.0))
    if light.ndim == 3:
        light = rgb2gray(light[..., :3]) if light.shape[2] > 2 else light[..., 0]
    return np.asarray(light)


def _picture(camera: Camera, path: Path) -> Image:
    """A picture's light, its longer side as long as the window's, dark beside it."""
    from skimage.transform import resize

    light = picture_light(path)
    shape = [max(1, round(camera.window * side / max(light.shape))) for side in light.shape]
    room = [camera.window - side for side in shape]
    return np.pad(
        np.asarray(resize(light, shape, anti_aliasing=True)), [(side // 2, side - side // 2) for side in room]
    )


def target_image(camera: Camera, options: dict[str, Any], picture: Path | None, where: str) -> Image:
    """Target energies per pixel of the sensor window, summing to 1, float32: a picture, or a pattern of the options.

    A picture is as long as the window and keeps its proportions.
    `pattern` is "spots" (count, spacing), "square" (width) or "disc" (diameter), each with an `offset` [x, y] on the
    sensor; `where` is the key of the objective, for messages.
    """
    if picture is not None:
        if unknown := sorted(options.keys() - {"image"}):
            raise InputError(where, "an image has no other options", unknown[0], "Remove it.")
        target = _picture(camera, picture)
    else:
        name = options.get("pattern")
        if name not in PATTERNS:
            rule = f"must be one of {', '.join(PATTERNS)}, or an `image` must be given"
            cure = 'For example options = { pattern = "square", width = "1 mm" }.'
            raise InputError(f"{where}: pattern", rule, repr(name), cure)
        draw, known = PATTERNS[name]
        if unknown := sorted(options.keys() - known - {"pattern"}):
            rule = f'options of pattern "{name}" are: {", ".join(sorted(known))}'
            raise InputError(where, rule, unknown[0], "Remove or rename it.")
        target = draw(camera, options, where)
    total = float(target.sum())
    if not total > 0:
        raise InputError(where, "the target must hold some light inside the window", "none", "Choose another pattern.")
    return (target / total).astype(np.float32)
