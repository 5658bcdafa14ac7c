"""Masks from a user's folder: PNG or TIFF pictures of what covers the view, with the size of the real thing.

Covered is what is white, or what is opaque in a picture with transparency; the colours of the latter are the
obstruction's own. A picture's size comes from a file of the same name ending in `.json`, either key:

    {"pitch_um": 50}     width of one pixel of the picture on the obstruction
    {"width_m": 0.3}     width of the whole picture

or from the parameter `width_m`. The first row of a picture is its top; it is turned over on reading.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from fab.errors import InputError
from fab.files import canonical_json, explain_os_error, read_json, sha256_bytes, sha256_file
from fab.pictures import TIFF_FILES, read_pixels
from fab.units import UM
from sim.imaging.scene import Obstruction
from sim.light import linear_from_srgb
from sim.obstruction.parameters import DEPTHS_M, Range, WithLimits, draw_from, is_number
from sim.obstruction.view import CameraView

MASK_FILES = (".png", *TIFF_FILES)


class MaskPicture(NamedTuple):
    """One mask as its file holds it."""

    # `[y, x]` 0 where the view is free, 1 where it is covered, float32; row 0 at the lowest y
    mask: Float[np.ndarray, "y x"]
    colour: Float[np.ndarray, "c y x"] | None  # `[c, y, x]` linear light of what covers, or None
    pitch_m: float | None  # width of one pixel on the obstruction, metres, or None


@dataclass(frozen=True)
class MaskFolder(WithLimits):
    """Obstructions out of a folder, one of its masks at each draw, mirrored and shifted at random.

    Every file is read once when the folder is named, so that a bad one is known before the work begins.

    Attributes:
        folder: where the pictures lie; other files, and folders within, are not looked at.
        width_m: width of the whole picture on the obstruction, metres, for pictures that do not say.
        depth_m: distance; 5 to 12 cm unless said otherwise.
        colour: display colour (sRGB, 0 to 1) of masks that have none.
        light: light on the camera's side, over that on a white of the scene.
        on_skip: called with every file that cannot be used, and why; without it the first one is an error.
        files: the pictures found, by name.
    """

    folder: str | Path
    width_m: float | None = None
    depth_m: Range = (0.05, 0.12)
    colour: tuple[float, float, float] = (0.3, 0.25, 0.2)
    light: Range = (0.3, 1.0)
    on_skip: Callable[[Path, InputError], object] | None = field(default=None, compare=False)
    files: tuple[Path, ...] = field(init=False)

    name: ClassVar[str] = "folder"
    limits: ClassVar[Mapping[str, Range]] = {"depth_m": DEPTHS_M, "light": (0.0, 1.0), "width_m": (1e-5, 1e3)}

    def __post_init__(self) -> None:
        """Check the parameters and read every picture once.

        An InputError for a parameter out of bounds, no usable picture, or one that is not usable without `on_skip`.
        """
        super().__post_init__()
        three = isinstance(self.colour, tuple | list) and len(self.colour) == 3
        if not three or not all(is_number(value) and 0 <= value <= 1 for value in self.colour):
            rule, cure = "must be three numbers from 0 to 1", "Give red, green and blue."
            raise InputError(f"{self.name}: colour", rule, self.colour, cure)
        object.__setattr__(self, "files", tuple(self._usable()))

    def _usable(self) -> list[Path]:
        try:
            found = sorted(p for p in Path(self.folder).iterdir() if p.suffix.lower() in MASK_FILES and p.is_file())
        except OSError as error:
            raise explain_os_error(error, self.folder) from error
        good = []
        for path in found:
            try:
                self._pitch_m(path, read_mask(path))
            except InputError as error:
                if self.on_skip is None:
                    raise
                self.on_skip(path, error)
            else:
                good.append(path)
        if not good:
            rule = f"the folder must hold a mask ({', '.join(MASK_FILES)}) that can be used"
            raise InputError(str(self.folder), rule, f"{len(found)} files, none of use", "Put masks there.")
        return good

    def digest(self) -> str:
        """SHA-256 of the pictures' names and contents, and of the files beside them that give sizes."""
        files = [file for path in self.files for file in (path, path.with_suffix(".json")) if file.exists()]
        return sha256_bytes(canonical_json([[file.name, sha256_file(file)] for file in files]))

    def _pitch_m(self, path: Path, picture: MaskPicture) -> float:
        if picture.pitch_m is not None:
            return picture.pitch_m
        if self.width_m is None:
            rule = "the size of the real thing must be known"
            cure = f'Give width_m, or write {{"pitch_um": ...}} into {path.with_suffix(".json").name}.'
            raise InputError(str(path), rule, "no width", cure)
        return self.width_m / picture.mask.shape[1]

    def draw(self, rng: np.random.Generator, view: CameraView, background: Float[np.ndarray, "c y x"]) -> Obstruction:
        """Draw one obstruction, or raise an InputError where its picture can no longer be read.

        A picture wider than the frame is shifted within itself, a smaller one within the frame; beyond it all is free.
        """
        view.require(background)
        path = self.files[rng.integers(len(self.files))]
        picture = read_mask(path)
        depth_m, light = draw_from(rng, self.depth_m), draw_from(rng, self.light)
        scale = view.pixels(self._pitch_m(path, picture), depth_m)
        mirrored, places = bool(rng.integers(2)), rng.uniform(0, 1, 2)
        at = [place * (n - m / scale) for n, m, place in zip(picture.mask.shape, view.shape, places, strict=True)]
        flip = slice(None, None, -1 if mirrored else 1)

        def framed(values: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "y x"]:
            return resized(values[:, flip], view.shape, scale, (at[0], at[1]))

        mask = framed(picture.mask)
        if picture.colour is None:
            colour = linear_from_srgb(np.array(self.colour, np.float32)) * np.float32(light)
            return Obstruction(mask, np.tile(colour[:, None, None], (1, *view.shape)), depth_m)
        # Averages are over what covers, so that transparent pixels lend no colour to an edge.
        radiance = np.stack([framed(c * picture.mask) for c in picture.colour]) / np.maximum(mask, np.float32(1e-6))
        return Obstruction(mask, np.clip(radiance * np.float32(light), 0, 1), depth_m)


def resized(
    picture: Float[np.ndarray, "n m"], shape: tuple[int, int], scale: float, corner: tuple[float, float]
) -> Float[np.ndarray, "y x"]:
    """Cut a frame out of a picture whose pixel is `scale` pixels wide; `corner` (y, x) is in pixels of the picture.

    Area averages where it shrinks, so that areas are kept; linear between the middles of the picture's pixels where it
    grows; zero beyond the picture.
    """
    down = _averages(picture, shape[0], 1 / scale, corner[0])
    return _averages(down.T, shape[1], 1 / scale, corner[1]).T.astype(np.float32)


def _averages(rows: Float[np.ndarray, "n m"], count: int, step: float, start: float) -> Float[np.ndarray, "k m"]:
    """Means of rows over `count` windows, each a step on; no window is narrower than a row."""
    middle, half = start + (np.arange(count) + 0.5) * step, max(step, 1.0) / 2
    total = np.concatenate([np.zeros((1, rows.shape[1])), np.cumsum(rows, axis=0, dtype=np.float64)])

    def below(at: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k m"]:
        at = np.clip(at, 0, len(rows))
        row = np.minimum(at.astype(int), len(rows) - 1)
        return total[row] + (at - row)[:, None] * rows[row]

    return (below(middle + half) - below(middle - half)) / (2 * half)


def read_mask(path: Path) -> MaskPicture:
    """Read a mask and its size; an InputError for no picture, one that covers nothing, or a size that is no length."""
    values = read_pixels(path, others="RGBA")
    if values.dtype.kind not in "bfui":
        raise InputError(str(path), "a mask must hold numbers", str(values.dtype), "Save it as grey values.")
    values = values.astype(np.uint8) * np.uint8(255) if values.dtype.kind == "b" else values
    full = 1.0 if values.dtype.kind == "f" else float(np.iinfo(values.dtype).max)
    values = np.clip(np.nan_to_num(values.astype(np.float32)) / np.float32(full), 0, 1)
    mask, colour = _parted(values.reshape(*values.shape[:2], -1))
    if not mask.any():
        raise InputError(str(path), "a mask must cover something", "black", "White, or opaque, is what covers.")
    return MaskPicture(mask, colour, _sidecar_pitch_m(path.with_suffix(".json"), mask.shape[1]))


def _parted(values: Float[np.ndarray, "y x k"]) -> tuple[Float[np.ndarray, "y x"], Float[np.ndarray, "c y x"] | None]:
    """Take mask and colours apart: by transparency if any pixel has some, else by brightness."""
    if values.shape[2] in (2, 4) and values[:, :, -1].min() < 1:
        display = np.broadcast_to(values[:, :, :-1], (*values.shape[:2], 3))
        return values[:, :, -1].copy(), linear_from_srgb(np.moveaxis(display, 2, 0).copy())
    plain = values[:, :, :-1] if values.shape[2] in (2, 4) else values
    return plain.mean(2, dtype=np.float32), None


def _sidecar_pitch_m(path: Path, columns: int) -> float | None:
    """Width of a pixel that the file beside a mask gives; None without such a file."""
    if not path.exists():
        return None
    given, ways = read_json(path), {"pitch_um": UM, "width_m": 1 / columns}
    cure = 'Write {"pitch_um": ...} or {"width_m": ...}.'
    if len(given.keys() & ways) != 1:
        raise InputError(str(path), "must hold either pitch_um or width_m", ", ".join(given) or "nothing", cure)
    key = next(iter(given.keys() & ways))
    value = given[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
        raise InputError(f"{path}: {key}", "must be a positive number", value, cure)
    return value * ways[key]
