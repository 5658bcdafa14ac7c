"""Loops around the open cells of a raster whose lines may be uneven."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


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
