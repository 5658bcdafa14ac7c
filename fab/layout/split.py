"""Splits: dies of a wafer that draw the same DOE differently on purpose.

A line-width split moves every edge of every etched area a little further out, or in. Where a process strays from the
line width that the masks were drawn for, one of these dies comes nearer to the design than the plate as ordered.

The control of the etch order gives the plane of the deepest etch to the mask of the shallowest, the plane of the next
to the mask of the next, and so on. If the lab took the depths in the opposite order, this die holds the plate as
designed and all others do not.
"""

from dataclasses import dataclass

from fab.errors import InputError
from fab.layout.wafer import Wafer
from fab.levels import Levels
from fab.units import format_length


@dataclass(frozen=True)
class DieSplit:
    """One way to draw a DOE.

    Its cells' names end with `code`, `words` say what is special (nothing for the DOE as ordered), `lettering` says it
    on the die. Mask k draws plane `bits[k]`, the edges of etched areas moved outward by `moves[k]` database units.
    """

    code: str
    words: str
    lettering: str
    bits: tuple[int, ...]
    moves: tuple[int, ...]


def splits_of(wafer: Wafer, levels: Levels, moves: tuple[int, ...], dbu_m: float) -> tuple[DieSplit, ...]:
    """List the ways to draw a wafer's dies: as ordered (edges moved by `moves`), line-width splits, order control.

    Raises:
        InputError: a control of the order in which a single depth is etched.
    """
    bits = tuple(range(levels.bits))
    splits = [DieSplit("DOE", "", "", bits, moves)]
    for number, move_m in enumerate(wafer.line_splits_m, 1):
        units = round(move_m / dbu_m)
        length, out = format_length(abs(units) * dbu_m), units > 0
        words = f"edges of etched areas drawn {length} further {'out' if out else 'in'} on every etch mask"
        lettering = f"EDGES {'+' if out else '-'}{length}".upper()
        splits.append(DieSplit(f"CD{number}", words, lettering, bits, tuple(m + units for m in moves)))
    if wafer.order_control:
        if levels.bits == 1:
            cure = "Leave order_control out."
            raise InputError("wafer: order_control", "needs two masks or more, for their order", "one mask", cure)
        words = "planes in the opposite order: right only if the depths were etched in the opposite order"
        by_depth = sorted(bits, key=levels.etch_depth_m)
        planes = dict(zip(by_depth, reversed(by_depth), strict=True))
        splits.append(DieSplit("ORDER", words, "DEPTHS REVERSED", tuple(planes[bit] for bit in bits), moves))
    return tuple(splits)
