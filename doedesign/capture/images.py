"""Pictures from a folder: found, decoded (`fab.pictures`), kept in memory where they fit, and turned into linear light.

Any folder of JPEG, PNG, TIFF, WebP or BMP files will do, folders within it included. A file that cannot be decoded is
skipped, with a warning, as long as another one is left. Without a folder the photographs that scikit-image brings along
are taken; nothing is ever downloaded.

A picture is `[y, x, colour]` of 8-bit display values (sRGB) with row 0 at the lowest y. One that is larger than needed
is shrunk once, on reading, so that its shorter side has `most_px` pixels.
"""

import logging
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from fab.errors import InputError
from fab.files import canonical_json, os_errors_explained, sha256_bytes, sha256_file
from fab.pictures import MOST_PIXELS, read_display

PICTURE_FILES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
SAMPLES = ("motorcycle_left.png", "rocket.jpg", "coffee.png", "astronaut.png", "chelsea.png", "camera.png")
_BUDGET_BYTES = 1 << 30
_SHOWN = 5  # names of files in one message
_log = logging.getLogger("doedesign")

Picture = UInt8[np.ndarray, "y x 3"]


def sample_files() -> tuple[Path, ...]:
    """The photographs inside the installed scikit-image, in a fixed order; InputError where it came without them."""
    spec = find_spec("skimage")
    folder = Path(spec.origin).parent / "data" if spec and spec.origin else Path("skimage/data")
    found = tuple(folder / name for name in SAMPLES if (folder / name).is_file())
    if not found:
        cure = "Give a folder of your own pictures."
        raise InputError(str(folder), "scikit-image must bring its sample pictures", "none of them", cure)
    return found


def picture_files(folder: Path | None) -> tuple[Path, ...]:
    """Every picture file below a folder, in the order of names; scikit-image's samples where no folder is given.

    Raises:
        InputError: the folder is missing or holds no picture file.
    """
    if folder is None:
        return sample_files()
    if not folder.is_dir():
        got = "a file" if folder.exists() else "no folder"
        raise InputError(str(folder), "must be a folder of pictures", got, "Check the path.")
    with os_errors_explained(folder):
        found = tuple(sorted(p for p in folder.rglob("*") if p.suffix.lower() in PICTURE_FILES and p.is_file()))
    if not found:
        rule = f"must hold pictures ({', '.join(PICTURE_FILES)})"
        raise InputError(str(folder), rule, "none", "Put pictures there, or leave `images` out for a first look.")
    return found


@dataclass
class Pictures:
    """Pictures of a folder, decoded when they are needed and kept while they fit. Safe to use from many threads.

    What is decoded first is kept until `budget_bytes` are full, and nothing is given up for another picture: training
    goes round the folder, and whatever was thrown away would be needed again. A folder that fits is decoded once.

    Attributes:
        files: the picture files.
        most_px: pixels that the shorter side of a picture may keep.
        budget_bytes: memory that decoded pictures may take.
        skipped: why each file was skipped that cannot be used.
        decodings: number of decodings.
    """

    files: tuple[Path, ...]
    most_px: int | None = None
    budget_bytes: int = _BUDGET_BYTES
    skipped: dict[Path, str] = field(default_factory=dict)
    decodings: int = 0
    _kept: dict[Path, Picture] = field(default_factory=dict, repr=False)
    _bytes: int = field(default=0, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)
    _busy: dict[Path, threading.Lock] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.files)

    def get(self, index: int) -> Picture | None:
        """One picture, or None if its file has to be skipped."""
        path = self.files[index]
        with self._lock:
            alone = self._busy.setdefault(path, threading.Lock())
        with alone:  # two threads that want the same picture decode it once
            if path in self.skipped:
                return None
            if path in self._kept:
                return self._kept[path]
            try:
                picture = read_display(path, self.most_px)
            except InputError as error:
                self._skip(path, error)
                return None
            with self._lock:
                self.decodings += 1
                if self._bytes + picture.nbytes <= self.budget_bytes:
                    self._kept[path] = picture
                    self._bytes += picture.nbytes
            return picture

    def first_whole(self, indices: Iterable[int]) -> tuple[str, Picture]:
        """File name and pixels of the first of some pictures whose file can be used.

        Raises:
            InputError: none of them can.
        """
        indices = tuple(indices)
        for index in indices:
            if (picture := self.get(index)) is not None:
                return self.files[index].name, picture
        broken = [self.files[index] for index in sorted(indices)]
        rule, got = "at least one picture must be whole", f"only broken ones: {_names(broken)}"
        raise InputError(str(broken[0].parent), rule, got, "Give other pictures.")

    def following(self, number: int) -> tuple[str, Picture]:
        """The picture of a number, which goes round the folder, or the first after it whose file can be used.

        Raises:
            InputError: no file can be used.
        """
        return self.first_whole((number + step) % len(self) for step in range(len(self)))

    def _skip(self, path: Path, error: InputError) -> None:
        with self._lock:
            self.skipped[path] = f"{error.rule}, but got {error.got}"
        _log.warning("skipped %s: %s", path, self.skipped[path])

    def skips(self) -> str:
        """One sentence on the files that were skipped; empty if none was."""
        if not self.skipped:
            return ""
        return f"{len(self.skipped)} of {len(self)} pictures skipped: {_names(sorted(self.skipped))}"

    def digest(self) -> str:
        """SHA-256 of the files' names and contents: equal for equal folders, whatever was decoded yet."""
        return sha256_bytes(canonical_json([[path.name, sha256_file(path)] for path in self.files]))


def _names(paths: Sequence[Path]) -> str:
    more = f" and {len(paths) - _SHOWN} more" if len(paths) > _SHOWN else ""
    return ", ".join(path.name for path in paths[:_SHOWN]) + more


def crop(
    picture: Picture, shape: tuple[int, int], place: tuple[float, float], mirror: bool = False
) -> UInt8[np.ndarray, "v u 3"]:
    """Cut a window of `shape` (y, x) out of a picture, which is enlarged first if the window does not fit.

    Its `place` between the lowest and highest row, and the first and last column, is 0 to 1 each. Of a strip that would
    be enlarged to gigabytes the window alone is.
    """
    scale = max(n / m for n, m in zip(shape, picture.shape[:2], strict=True))
    if scale > 1:
        from PIL import Image

        size = tuple(max(n, round(m * scale)) for n, m in zip(shape, picture.shape[:2], strict=True))
        if size[0] * size[1] > MOST_PIXELS:  # a narrow strip, of which little is seen
            return zoomed(picture, shape, 1.0, place, mirror)
        large = Image.fromarray(picture).resize((size[1], size[0]), Image.Resampling.BICUBIC)
        picture = np.asarray(large, np.uint8)
    y, x = (round(at * (m - n)) for at, n, m in zip(place, shape, picture.shape[:2], strict=True))
    window = picture[y : y + shape[0], x : x + shape[1]]
    return np.ascontiguousarray(window[:, ::-1] if mirror else window)


def zoomed(
    picture: Picture, shape: tuple[int, int], share: float, place: tuple[float, float], mirror: bool = False
) -> UInt8[np.ndarray, "v u 3"]:
    """Cut a window of a share of the picture out of it, and bring it to `shape` (y, x) pixels.

    A share of 1 is the largest window of this shape that fits, so of a square one the picture's shorter side. The
    bicubic kernel grows with the step, so that what is shrunk does not alias; `place` is that of `crop`.
    """
    from PIL import Image

    step = share * min(m / n for n, m in zip(shape, picture.shape[:2], strict=True))
    sides = [step * n for n in shape]
    y, x = (at * (m - side) for at, side, m in zip(place, sides, picture.shape[:2], strict=True))
    box = (x, y, min(x + sides[1], picture.shape[1]), min(y + sides[0], picture.shape[0]))
    shown = Image.fromarray(picture).resize((shape[1], shape[0]), Image.Resampling.BICUBIC, box=box)
    window = np.asarray(shown, np.uint8)
    return np.ascontiguousarray(window[:, ::-1] if mirror else window)


def display_values(picture: np.ndarray) -> Picture:
    """An array `[y, x, 3]` of display values, uint8 or floats from 0 to 1, as a picture.

    Raises:
        InputError: another shape or another type, or values beyond 0 to 1.
    """
    if not isinstance(picture, np.ndarray):
        got = f"a {type(picture).__name__}"
        raise InputError("picture", "must be a file, or an array [y, x, 3]", got, "Give np.asarray of it.")
    if picture.ndim != 3 or picture.shape[2] != 3 or not picture.size:
        raise InputError("picture", "must be an array [y, x, 3]", f"shape {picture.shape}", "Give red, green and blue.")
    if picture.dtype == np.uint8:
        return picture
    if picture.dtype.kind != "f" or not (picture.min() >= 0 and picture.max() <= 1):
        got = f"{picture.dtype} from {picture.min():g} to {picture.max():g}"
        raise InputError("picture", "must be uint8, or floats from 0 to 1", got, "Scale it.")
    return np.rint(255 * picture).astype(np.uint8)


def linear_light(picture: Picture) -> Float[np.ndarray, "3 y x"]:
    """Linear light of a picture, 1 for its white, float32."""
    return np.ascontiguousarray(_linear_table()[picture.transpose(2, 0, 1)])


@cache
def _linear_table() -> Float[np.ndarray, "256"]:
    from sim.light import linear_from_srgb

    return linear_from_srgb(np.arange(256) / 255).astype(np.float32)
