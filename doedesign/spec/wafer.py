"""Table of the wafer on which an order is laid out; a key that is left out is that of a usual wafer of 100 mm."""

from typing import Annotated, Literal

from pydantic import Field

from doedesign.spec.values import length
from doedesign.spec.values.table import SpecTable, optional
from fab.layout.wafer import Wafer
from fab.units import MM, UM

Size = Annotated[float, length(1 * MM, 500 * MM)]
Thickness = Annotated[float, length(0.01 * MM, 50 * MM)]
Rim = Annotated[float, length(0.0, 20 * MM)]
Move = Annotated[float, length(-100 * UM, 100 * UM)]
Dies = Annotated[int, Field(strict=True, ge=1, le=1000)]

_USUAL = Wafer()


class WaferSpec(SpecTable, frozen=True):
    """Wafer, mask blanks and dies; see `fab.layout.wafer.Wafer`.

    Attributes:
        diameter_m: diameter of the wafer, twice `process.wafer_radius`; one of them is enough.
        thickness_m: thickness of the wafer.
        blank_m: edge of the square mask blanks.
        dies: rows and columns of dies; as many as fit if none are given.
        pitch_m: distance of the dies; the next whole millimetre that a die and a saw lane need if none is given.
        lane_m: width of the saw lanes.
        edge_exclusion_m: width of the rim that holds nothing.
        chrome_to_edge: whether the chrome around the aperture reaches to the edges of the die.
        zero_layer: whether marks of chrome are made before the first etch.
        chrome: "liftoff" or "etch".
        compensate: whether masks are drawn against the mean line-width bias of the process.
        line_splits_m: for each entry some dies whose edges of etched areas are drawn so much further out.
        order_control: whether some dies draw the planes in the opposite order of depths.
        edge_moves_m: how far masks are drawn with the edges of etched areas further out, first mask first; in place of
            `compensate`.
    """

    diameter_m: Size = optional(_USUAL.diameter_m)
    thickness_m: Thickness = optional(_USUAL.thickness_m)
    blank_m: Size = optional(_USUAL.blank_m)
    dies: tuple[Dies, Dies] | None = optional(example="[3, 3]")
    pitch_m: Size | None = optional(example='"10 mm"')
    lane_m: Rim = optional(_USUAL.lane_m)
    edge_exclusion_m: Rim = optional(_USUAL.edge_exclusion_m)
    chrome_to_edge: Annotated[bool, Field(strict=True)] = optional(_USUAL.chrome_to_edge)
    zero_layer: Annotated[bool, Field(strict=True)] = optional(_USUAL.zero_layer)
    chrome: Literal["liftoff", "etch"] = optional(_USUAL.chrome)
    compensate: Annotated[bool, Field(strict=True)] = optional(_USUAL.compensate)
    line_splits_m: tuple[Move, ...] = optional(_USUAL.line_splits_m, example='["-0.2 um", "0.2 um"]')
    order_control: Annotated[bool, Field(strict=True)] = optional(_USUAL.order_control)
    edge_moves_m: tuple[Move, ...] = optional(_USUAL.edge_moves_m, example='["0.1 um", "0.1 um", "0.05 um", "0 um"]')


class WaferFile(SpecTable, frozen=True):
    """TOML file of a wafer."""

    wafer: WaferSpec
