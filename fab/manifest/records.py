"""The manifest of a mask order: what every file in the folder is, and how to prove it.

Lengths stand here in the units of the order form (nm, um, mm), with the unit in the key. Nothing in it
depends on the time or the place, so the same inputs give the same manifest.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from fab.aperture import Aperture, aperture_from
from fab.errors import InputError
from fab.files import MANIFEST_NAME, canonical_json, read_json, sha256_bytes
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.units import MM, NM, UM

FORMAT = "doedesign mask order 2"

_MOST_PIXELS = 1 << 28  # of a level map that is read
_FARTHEST_NM = 200_000  # that an edge is moved, by its mask and by a split

# Nothing is converted: a number in quotes is no number.
_STRICT = ConfigDict(strict=True, extra="forbid")

CHROME_MEANS = "polygon = chrome stays here"
_CONVENTIONS = {
    "chrome layer": CHROME_MEANS,
    "levels": "level l of L stands as high as the depths of the masks that stay closed there sum up to (l steps where "
    "mask k etches 2^k steps); the blank glass is level L-1",
    "masks": "bit k of (L-1-level) set = mask k opens and etches its depth_nm; bit k is layer k+1, datatype 0",
    "axes": "seen from the etched side, +x right, +y up, origin at the centre of the wafer; not mirrored",
    "datatypes": "0 the DOE, 1 alignment marks, 2 test structures, 3 lettering; one mask carries them all",
    "outlines": "layers 100 to 110 show the blank, the wafer, the relief and the die; they are on no mask",
    "level map": "uint8 [y, x], row 0 at the lowest y; its digest is the SHA-256 of these bytes row by row",
    "plane digests": "SHA-256 of the rows packed to bytes, first pixel in the highest bit, 1 = etched",
}
# Where some sets of masks make no level, the masks that stay closed do not say how high a level is.
_UNUSED_SETS = {
    "levels": "level l of L lies as deep below the blank glass, level L-1, as the depths of the masks that open there "
    "sum up to (L-1-l steps where mask k etches 2^k steps); the other sets of masks make no level"
}


def etch_means(tone: str) -> str:
    """Return in words what a polygon of an etch mask means whose polygons are "clear" or "dark" on the plate."""
    return f"polygon = etched here (digitised data {tone})"


def conventions_of(levels: Levels, tone: str) -> dict[str, str]:
    """Return in words how the numbers of an order are meant, by what they are; `tone` is that of its etch masks."""
    found = {"etch layers": etch_means(tone), **_CONVENTIONS}
    return found if levels.is_full else found | _UNUSED_SETS


@dataclass(frozen=True, config=_STRICT)
class LayerEntry:
    """Shapes on one layer of a cell; the digest is that of `fab.manifest.cells.shapes_digest`."""

    layer: str
    polygons: int
    area_um2: float
    box_um: list[float]
    sha256: str


@dataclass(frozen=True, config=_STRICT)
class CellEntry:
    """One cell of a mask file: its layers, and the cells it places as [name, x_um, y_um]."""

    cell: str
    layers: list[LayerEntry]
    places: list[list[Any]]


@dataclass(frozen=True, config=_STRICT)
class FileEntry:
    """One file of the folder; of a mask file also its top cell, the DOE's layers in it, and all other cells."""

    file: str
    format: str
    bytes: int
    sha256: str
    cell: str | None
    layers: list[str]
    cells: list[CellEntry]


@dataclass(frozen=True, config=_STRICT)
class MaskEntry:
    """One etch mask; box (x0, y0, x1, y1), width and space are None where there is none.

    Every edge of an etched area is drawn `edge_move_nm` outward, against the bias of the process; width, space and
    digest are those of the plane before the move.
    """

    mask: int
    bit: int
    layer: int
    datatype: int
    file: str
    cell: str
    depth_nm: float
    edge_move_nm: float
    polygon_means: str
    polygons: int
    area_um2: float
    box_um: list[float] | None
    smallest_width_um: float | None
    smallest_space_um: float | None
    plane_sha256: str


@dataclass(frozen=True, config=_STRICT)
class DrawnEntry:
    """One layer of a split: a plane (`bit`) of the level map, its edges moved."""

    layer: int
    datatype: int
    bit: int
    edge_move_nm: float
    polygons: int
    area_um2: float
    box_um: list[float] | None


@dataclass(frozen=True, config=_STRICT)
class SplitEntry:
    """Dies that draw the DOE differently on purpose: their cell, what is special, which dies, and what they draw."""

    cell: str
    words: str
    dies: list[int]
    layers: list[DrawnEntry]


@dataclass(frozen=True, config=_STRICT)
class PhotomaskEntry:
    """One mask as the shop makes it, in the order of use: what polygons are on the photomask, and how it is read."""

    mask: str
    makes: str
    layer: int
    bit: int | None
    depth_nm: float | None
    file: str
    polygons: str
    field: str
    reading: str


@dataclass(frozen=True, config=_STRICT)
class WaferEntry:
    """Layout of the wafer: sizes, the middles of the dies, and the places where people measure, x and y."""

    diameter_mm: float
    thickness_mm: float
    blank_mm: float
    edge_exclusion_mm: float
    flat_mm: float
    notch_mm: float
    die_mm: float
    die_pitch_mm: float
    dies_mm: list[list[float]]
    places_um: dict[str, Any]


@dataclass(frozen=True, config=_STRICT)
class ModelEntry:
    """A solid or a height map: content, volume (with its error) and centre by part, scale, pixels of its window."""

    file: str
    content: str
    volumes_mm3: dict[str, Any]
    centres_mm: dict[str, Any]
    relative_error: float
    metres_per_count: float | None
    window_px: list[int] | None


@dataclass(frozen=True, config=_STRICT)
class ChromeEntry:
    """The chrome aperture, a true circle drawn with the stated chord error; its digest as in `LayerEntry`.

    The diameter of an opening that is a rectangle stands for its [width, height], of any other for the record of its
    mask (`fab.aperture.mask`), in millimetres.
    """

    layer: int
    datatype: int
    file: str
    cell: str
    polygon_means: str
    opening_diameter_mm: float | list[float] | dict[str, Any]
    outer_diameter_mm: float
    overlap_um: float
    chord_error_nm: float
    polygons: int
    area_um2: float
    box_um: list[float]
    shapes_sha256: str


@dataclass(frozen=True, config=_STRICT)
class Manifest:
    """A whole mask order.

    `source` says where the level map came from, in the words of who asked. All but it and the versions of the tools
    follows from `request` (`fab.order.request`) and the level numbers. `geometry_sha256` is
    `fab.order.order.Order.geometry`. `aperture_mm` is the diameter of the relief, [width, height] of a
    rectangle, or the record of a mask.
    """

    format: str
    name: str
    geometry_sha256: str
    source: dict[str, Any]
    conventions: dict[str, Any]
    request: dict[str, Any]
    levels: int
    step_nm: float
    shape: list[int]
    pitch_um: float
    aperture_mm: float | list[float] | dict[str, Any]
    dbu_nm: float
    pixel_edges: str
    level_map_file: str
    level_map_sha256: str
    combined_gds: str | None
    combined_oasis: str
    preview: str
    doe_cell: str
    plates: list[PhotomaskEntry]
    wafer: WaferEntry
    rules: dict[str, Any]
    masks: list[MaskEntry]
    splits: list[SplitEntry]
    chrome: ChromeEntry
    models: list[ModelEntry]
    files: list[FileEntry]
    tools: dict[str, Any]

    def edge_moves(self) -> tuple[int, ...]:
        """Return how far the edges of every mask were moved outward, in database units."""
        return tuple(round(mask.edge_move_nm / self.dbu_nm) for mask in self.masks)

    def drawn_files(self, folder: Path) -> list[Path]:
        """Return the files of an order's folder that draw the DOE between them, a mask each."""
        return [folder / mask.file for mask in self.masks]

    def drawn(self) -> dict[str, Sequence[MaskEntry | DrawnEntry]]:
        """Return every cell of the DOE with what its etch layers draw."""
        return {self.doe_cell: self.masks, **{split.cell: split.layers for split in self.splits}}

    def level_map(self, level: NDArray[np.uint8]) -> LevelMap:
        """Return the level map of the order from its level numbers ``[y, x]``."""
        return LevelMap(level, self.staircase(), self.grid(), self.relief, self.name)

    def staircase(self) -> Levels:
        """Return the levels of the order, with the depth that stands at every mask."""
        depths = [round(mask.depth_nm * NM, 18) for mask in sorted(self.masks, key=lambda mask: mask.bit)]
        return Levels(self.levels, round(self.step_nm * NM, 18), tuple(depths))

    def grid(self) -> Grid:
        """Return the pixel raster of the order."""
        return Grid((self.shape[0], self.shape[1]), round(self.pitch_um * UM, 18))

    @property
    def relief(self) -> Aperture:
        """Outline of the relief; light passes the opening of the chrome, the clear aperture."""
        return aperture_from(self.aperture_mm, MM, 18)

    def to_json(self) -> bytes:
        """Return the bytes of the manifest file, with the digest of everything else in it under ``sha256``."""
        content = asdict(self)
        return canonical_json({**content, "sha256": sha256_bytes(canonical_json(content))})


def plane_digest(plane: NDArray[np.uint8]) -> str:
    """Return the SHA-256 of a bit plane with its rows packed to bytes."""
    return sha256_bytes(np.packbits(plane, axis=1).data)


@cache
def _adapter() -> TypeAdapter[Manifest]:
    return TypeAdapter(Manifest)


def _manifest_from(data: bytes, where: str) -> Manifest:
    """Read a manifest from JSON; the first thing that is wrong in it is named by its key."""
    try:
        return _adapter().validate_json(data)
    except ValidationError as errors:
        found = errors.errors(include_url=False)[0]
        odd = found["type"] in ("missing", "unexpected_keyword_argument")
        *parents, last = found["loc"]
        keys = parents if odd else [*parents, last]
        name = "".join(f"[{key}]" if isinstance(key, int) else f": {key}" for key in keys)
        rule = "must hold exactly the keys of a mask order" if odd else found["msg"].replace("Input should", "must")
        got = f"a key missing or too many: {last!r}" if odd else repr(found["input"])[:60]
        raise InputError(f"{where}{name}", rule, got, "Write the order again.") from errors


def read_manifest(folder: str | Path) -> Manifest:
    """Read the manifest of a mask order and check it; every file name in it is a plain name in the folder."""
    path = Path(folder) / MANIFEST_NAME
    if path.parent.is_file():
        raise InputError(str(folder), "must be the folder of a mask order", "a file", "Give the folder that it is in.")
    data = read_json(path)
    if data.get("format") != FORMAT:
        got = repr(data.get("format"))
        raise InputError(str(path), f'the format must be "{FORMAT}"', got, "Draw it again elsewhere.")
    digest = data.pop("sha256", None)
    content = canonical_json(data)
    if digest != sha256_bytes(content):
        rule = "its content must have the digest that it states"
        raise InputError(str(path), rule, "another one", "Fetch the manifest again, or write the order again.")
    manifest = _manifest_from(content, str(path))
    entries = [*manifest.files, *manifest.masks, manifest.chrome, *manifest.plates, *manifest.models]
    names = [entry.file for entry in entries]
    names += [manifest.level_map_file, manifest.combined_oasis, manifest.preview]
    names += [name for name in [manifest.combined_gds] if name is not None]
    for name in names:
        if Path(name).name != name or name not in {entry.file for entry in manifest.files}:
            raise InputError(
                str(path), "every file must be listed by its plain name", repr(name), "Write the order again."
            )
    etched = sorted(mask.bit for mask in manifest.masks)
    if len(manifest.shape) != 2 or etched != list(range(Levels(manifest.levels, NM).bits)):
        got = f"shape {manifest.shape} and {len(manifest.masks)} masks"
        raise InputError(str(path), "shape and masks must fit the levels", got, "Write the order again.")
    bits = range(len(manifest.masks))
    for cell, layers in manifest.drawn().items():
        if [one.layer for one in layers] != [bit + 1 for bit in bits] or sorted(one.bit for one in layers) != [*bits]:
            rule = "every cell of the DOE must draw every plane once, bit 0 of the plate on layer 1"
            raise InputError(str(path), rule, cell, "Write the order again.")
    if not 1e-6 <= manifest.dbu_nm <= 1e6:
        rule, cure = "the database unit must lie from 1e-6 to 1e6 nm", "Write the order again."
        raise InputError(str(path), rule, manifest.dbu_nm, cure)
    if max(manifest.shape) > _MOST_PIXELS or math.prod(manifest.shape) > _MOST_PIXELS:
        rule, cure = f"the grid must have at most {_MOST_PIXELS} pixels", "Write the order again."
        raise InputError(str(path), rule, f"shape {manifest.shape}", cure)
    for move_nm in (one.edge_move_nm for layers in manifest.drawn().values() for one in layers):
        if not abs(move_nm) <= _FARTHEST_NM:
            rule, cure = f"edges must be moved by at most {_FARTHEST_NM} nm", "Write the order again."
            raise InputError(str(path), rule, move_nm, cure)
    manifest.grid()
    manifest.staircase()
    for size in (manifest.aperture_mm, manifest.chrome.opening_diameter_mm):
        aperture_from(size, where=f"{path}: aperture", shape=manifest.grid().shape)
    return manifest
