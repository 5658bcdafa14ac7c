"""Loops around the open cells of a raster whose lines may be uneven, and the parts that they bound."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Division(NamedTuple):
    """A plane divided by outlines into parts that are open and parts that are closed.

    A part is the number of the loop around it, None for what lies around everything, and those of the loops within it.
    """

    loops: list[NDArray[np.float64]]  # corners x, y ``(n, 2)``, counter-clockwise
    open: list[tuple[int | None, list[int]]]
    closed: list[tuple[int | None, list[int]]]

    @property
    def corners(self) -> int:
        """Number of corners of all loops."""
        return sum(map(len, self.loops))

    @property
    def touches(self) -> bool:
        """Whether loops meet at a corner."""
        return len(np.unique(np.concatenate(self.loops), axis=0)) < self.corners


def divided(loops: list[NDArray[np.float64]], y: NDArray[Any], x: NDArray[Any], cells: NDArray[np.bool_]) -> Division:
    """Divide the plane by the loops around open cells between lines.

    Open parts that touch at a corner are two, closed ones are one.
    """
    from scipy import ndimage

    label: Any = ndimage.label
    whole, around = np.pad(cells, 1), []
    numbered: list[Any] = [label(~whole, np.ones((3, 3)))[0], label(whole)[0]]
    parts: dict[tuple[bool, int], tuple[list[int], list[int]]] = {}
    for number, loop in enumerate(loops):
        # The lowest side of a loop runs toward +x where what is open lies above it.
        start = int(np.lexsort((loop[:, 0], loop[:, 1]))[0])
        row, column = np.searchsorted(y, loop[start, 1]), np.searchsorted(x, loop[start, 0])
        is_outer = bool(whole[row + 1, column + 1])
        above, below = (row + 1, column + 1), (row, column + 1)
        for is_open, at in ((True, above if is_outer else below), (False, below if is_outer else above)):
            part = parts.setdefault((is_open, int(numbered[is_open][at])), ([], []))
            part[is_open != is_outer].append(number)
        around.append(loop if is_outer else loop[::-1])
    found: dict[bool, list[tuple[int | None, list[int]]]] = {True: [], False: []}
    for (is_open, _), (outer, inner) in parts.items():
        found[is_open].append((outer[0] if outer else None, inner))
    return Division(around, found[True], found[False])


def loops_around(y: NDArray[Any], x: NDArray[Any], cells: NDArray[np.bool_]) -> list[NDArray[np.float64]]:
    """Return the outlines of the open cells between lines, as corners x, y ``(n, 2)`` each, what is open on the left.

    Parts that touch at a corner have outlines of their own.
    """
    if not cells.size:
        return []
    whole = np.pad(cells, 1).astype(np.int8)
    low_left, low_right, up_left, up_right = whole[:-1, :-1], whole[:-1, 1:], whole[1:, :-1], whole[1:, 1:]
    turns = low_left - low_right - up_left + up_right
    row, column = np.nonzero(turns)
    # Two parts that touch have a corner each: the first belongs to the side that comes first along x.
    twice = np.abs(turns[row, column])
    row, column = np.repeat(row, twice), np.repeat(column, twice)
    second = np.concatenate([[False], (row[1:] == row[:-1]) & (column[1:] == column[:-1])])
    # Along a line every side lies between two corners that follow each other, along x as they are found.
    along_x = np.arange(len(row)) ^ 1
    falling = turns[row, column] == -2
    order = np.lexsort((second ^ falling, row, column))
    along_y = np.empty_like(along_x)
    along_y[order] = order[np.arange(len(row)) ^ 1]
    loops, left = [], np.ones(len(row), np.bool_)
    for start in range(len(row)):
        if not left[start]:
            continue
        loop, at = [], start
        while left[at]:
            other = along_x[at]
            left[at] = left[other] = False
            loop += [at, other]
            at = along_y[other]
        # The first side runs toward +x from the lowest corner of the loop, unless what is open lies below it.
        if not up_right[row[start], column[start]]:
            loop.reverse()
        loops.append(np.stack([x[column[loop]], y[row[loop]]], axis=1).astype(np.float64))
    return loops
