"""Aperture: the outline of what is open, or of what has relief, about the centre of a raster; round, rectangular, any.

The relief of a DOE fills one, and light passes another, the opening of the chrome, which is smaller by the overlap.
Whoever needs cells, areas or outlines asks an aperture for them, whatever its kind. In files and texts a round one is
its diameter, a rectangular one [width, height], along x and along y, and any other one the rows of cells that are open.

    outline     what every aperture can do; discs and rectangles
    mask        any open cells of a raster
    loops       the outlines of open cells
    picture     a mask from a file
"""

import math
from typing import Any

from fab.aperture.mask import MaskAperture
from fab.aperture.outline import Aperture, RectangularAperture, RoundAperture
from fab.errors import InputError
from fab.units import number_of

__all__ = ["Aperture", "MaskAperture", "RectangularAperture", "RoundAperture", "aperture_from", "diameter_of"]


def aperture_from(
    value: Any,
    unit_m: float = 1.0,
    digits: int | None = None,
    where: str = "aperture",
    shape: tuple[int, int] | None = None,
) -> Aperture:
    """Return an aperture from itself, a diameter, [width, height], or the record of a mask.

    Args:
        value: what it is made from; lengths are numbers of a unit.
        unit_m: the unit, metres.
        digits: decimals of a metre to which lengths are rounded; None leaves them.
        where: what names it in messages, such as the file that it came from.
        shape: cells ``(ny, nx)`` that the record of a mask must have, before it is unfolded; None for any.

    Raises:
        InputError: anything else.
    """
    if isinstance(value, Aperture):
        return value
    if isinstance(value, dict):
        return MaskAperture.from_record(value, unit_m, digits, where, shape)
    given = value if isinstance(value, list | tuple) else [value]
    numbers = [number_of(size) for size in given]
    # What is no number, such as text, or beyond all floats is no length.
    unlike = any(math.isnan(number) or number != size for number, size in zip(numbers, given, strict=True))
    sizes = numbers if unit_m == 1.0 else [number * unit_m for number in numbers]
    sizes = sizes if digits is None else [round(size, digits) for size in sizes]
    if len(sizes) not in (1, 2) or unlike:
        got = " ".join(repr(value).split())
        rule, got = "must be a diameter or [width, height]", got if len(got) < 60 else f"{got[:57]}..."
        raise InputError(where, rule, got, "Give one or two lengths.")
    return RoundAperture(sizes[0]) if len(sizes) == 1 else RectangularAperture((sizes[1], sizes[0]))


def diameter_of(aperture: Aperture) -> float:
    """Return the diameter of a round `aperture`, metres, for what can do with no other.

    Raises:
        InputError: it has another shape.
    """
    if isinstance(aperture, RoundAperture):
        return aperture.diameter_m
    cure = "Give a diameter as the aperture, or leave out what needs a round one."
    raise InputError("aperture", "must be round here", str(aperture), cure)
