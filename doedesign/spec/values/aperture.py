"""The aperture of a DOE in a spec: a diameter, [width, height], or a picture, of which the spec keeps the open cells.

    [doe]
    aperture = "mask.png"            # beside the spec

becomes `aperture = { rows = [...] }` as the spec is read (`fab.aperture.picture` says how), the rows of cells from the
lowest y: [how many alike, start, stop, start, stop, ...], each run of open cells from `start` up to `stop`, which count
from the lowest x. So a run does not depend on the picture.
"""

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator

from doedesign.spec.values import InWords, broken, length
from doedesign.spec.values.table import SpecTable
from fab.aperture import MaskAperture
from fab.aperture.mask import plane_of, rows_of
from fab.aperture.picture import MASK_FILES, read_mask
from fab.errors import InputError
from fab.units import UM

_SIZE: Any = length(1 * UM, 1.0).func
_MOST = 20_000
_PICTURE = 'For example "mask.png", of which the spec keeps the open cells.'


class MaskRows(SpecTable, frozen=True):
    """Open cells of a DOE, row by row from the lowest y.

    Attributes:
        rows: of every row, how many follow that are like it, itself included, then where each run of open cells
            starts and stops.
    """

    inline: ClassVar[bool] = True

    rows: tuple[tuple[int, ...], ...] = Field(examples=["[[2, 0, 2], [2, 1, 2]]"])

    @field_validator("rows", mode="before")
    @classmethod
    def _whole(cls, rows: Any) -> Any:
        if not isinstance(rows, list | tuple) or not all(
            isinstance(row, list | tuple) and row and all(type(n) is int for n in row) for row in rows
        ):
            raise broken("must be rows of whole numbers", _PICTURE)
        return tuple(map(tuple, rows))

    def problem(self, shape: tuple[int, int]) -> str | None:
        """Say why these are no rows of so many cells (ny, nx); None if they are."""
        try:
            plane_of(self.rows, shape)
        except ValueError as error:
            return str(error)
        return None

    def aperture(self, shape: tuple[int, int], pitch_m: float) -> MaskAperture:
        """Return the aperture on so many cells (ny, nx) of a pitch, metres."""
        return _mask(self.rows, shape, pitch_m)


@lru_cache(maxsize=4)
def _mask(rows: tuple[tuple[int, ...], ...], shape: tuple[int, int], pitch_m: float) -> MaskAperture:
    return MaskAperture.of(plane_of(rows, shape), pitch_m)


def _aperture(value: Any, info: ValidationInfo) -> Any:
    """One length, two of them, or the rows of a mask."""
    if isinstance(value, dict | MaskRows):
        return value
    if not isinstance(value, list | tuple):
        return _SIZE(value, info)
    if len(value) != 2:
        raise broken("must be a diameter, or [width, height]", 'For example "2 mm", or ["2 mm", "1 mm"].')
    return tuple(_SIZE(size, info) for size in value)


ApertureSizes = Annotated[
    float | tuple[float, float] | MaskRows,
    BeforeValidator(_aperture),
    InWords("length, list [width, height] of two, or file name of a picture", "1 um to 1 m each"),
]


def _cell_counts(value: Any) -> Any:
    """One whole number, or two of them."""
    counts = value if isinstance(value, list | tuple) else [value]
    example = "For example 2400, or [2400, 1200]."
    if any(not isinstance(n, int) or isinstance(n, bool) for n in counts) or len(counts) != (1 + (counts is value)):
        raise broken("must be a whole number, or two of them, [along x, along y]", example)
    for rule, broke in (("must be at least 2", min(counts) < 2), (f"must be at most {_MOST}", max(counts) > _MOST)):
        if broke:
            raise broken(rule, example)
    return tuple(counts) if counts is value else value


Samples = Annotated[
    int | tuple[int, int],
    BeforeValidator(_cell_counts),
    InWords("whole number, or list [along x, along y] of two", f"2 to {_MOST} each"),
]


def shape_of(samples: int | tuple[int, int]) -> tuple[int, int]:
    """Return cells (ny, nx) of the number per side, or of the two along x and along y."""
    nx, ny = (samples, samples) if isinstance(samples, int) else samples
    return ny, nx


def with_mask(raw: Mapping[str, Any], source: Path) -> dict[str, Any]:
    """Put the open cells of a picture that is the aperture, beside the spec file `source`, into the tables of the spec.

    Raises:
        InputError: a picture that is no mask of the DOE's cells.
    """
    doe = raw.get("doe")
    name = doe.get("aperture") if isinstance(doe, Mapping) else None
    if not isinstance(doe, Mapping) or not isinstance(name, str) or not name.lower().endswith(MASK_FILES):
        return dict(raw)
    try:
        shape = shape_of(_cell_counts(doe.get("samples")))
    except (TypeError, ValueError):  # which is told with the other mistakes
        rows = [[1, 0, 1]]
    else:
        path = source.parent / name
        if not path.is_file():
            where, cure = f"{source}: doe.aperture", f"Put it at {path} or change the path."
            raise InputError(where, "the file must exist", f'"{name}"', cure)
        rows = rows_of(read_mask(path, shape))
    return {**raw, "doe": {**doe, "aperture": {"rows": rows}}}
