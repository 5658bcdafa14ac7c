"""The wafer in a spec: what the masks of an order are filled with. What is left out is usual for a wafer of 100 mm."""

from typing import Annotated, Literal

from pydantic import Field

from doedesign.spec.table import SpecTable, unsaid
from doedesign.spec.values import length
from fab.layout.wafer import Wafer
from fab.units import MM, UM

__all__ = ["WaferFile", "WaferSpec"]

Size = Annotated[float, length(1 * MM, 0.5)]
Thickness = Annotated[float, length(0.01 * MM, 50 * MM)]
Move = Annotated[float, length(-100 * UM, 100 * UM)]
Dies = Annotated[int, Field(strict=True, ge=1, le=1000)]

_USUAL = Wafer()


class WaferSpec(SpecTable, frozen=True):
    """The wafer, its mask blanks, and how it is filled; see `fab.layout.wafer.Wafer`.

    Attributes:
        diameter_m: diameter of the wafer.
        thickness_m: its thickness.
        blank_m: edge of the square mask blanks.
        dies: rows and columns of dies; the most that fit, up to 3 x 3, if none are given.
        pitch_m: distance of the dies; the next whole millimetre that a die needs if none is given.
        zero_layer: whether marks of chrome are made before the first etch.
        chrome: "liftoff" or "etch".
        compensate: whether masks are drawn against the mean line-width bias of the process.
        line_splits_m: for each entry one die whose edges of etched areas are drawn so much further out.
        order_control: whether one die draws the planes in the opposite order of depths.
    """

    diameter_m: Size = unsaid(_USUAL.diameter_m)
    thickness_m: Thickness = unsaid(_USUAL.thickness_m)
    blank_m: Size = unsaid(_USUAL.blank_m)
    dies: tuple[Dies, Dies] | None = unsaid()
    pitch_m: Size | None = unsaid()
    zero_layer: Annotated[bool, Field(strict=True)] = unsaid(_USUAL.zero_layer)
    chrome: Literal["liftoff", "etch"] = unsaid(_USUAL.chrome)
    compensate: Annotated[bool, Field(strict=True)] = unsaid(_USUAL.compensate)
    line_splits_m: tuple[Move, ...] = unsaid(_USUAL.line_splits_m)
    order_control: Annotated[bool, Field(strict=True)] = unsaid(_USUAL.order_control)


class WaferFile(SpecTable, frozen=True):
    """A file that holds a wafer.

    Attributes:
        wafer: the wafer.
    """

    wafer: WaferSpec
