"""Narrow runs in packed planes: how many, how long, and where.

A run shorter than n pixels does not survive an erosion by n, so a few shifts and bit counts find all of them.
"""

from typing import NamedTuple

import numpy as np

from fab.rules import bitplanes as bits

_MOST_PLACES = 5
# Runs that are measured to find long ones, so that a map of millions costs no more than one of thousands.
_LOOKS = 20_000


class NarrowRuns(NamedTuple):
    """Narrow runs of one kind along one axis, in pixels; `places` holds row, column, width, length of a few."""

    smallest: int | None
    runs: int
    narrow: int
    slivers: int
    places: list[tuple[int, int, int, int]]


def _places(alone: bits.Words, slivers: bits.Words, axis: int, width: int) -> list[tuple[int, int, int, int]]:
    """List a few long places of one width; slivers first, since there are fewer of them to measure."""
    for starting in (slivers, alone):
        found = bits.longest_runs(starting, alone, axis, _MOST_PLACES, _LOOKS).tolist()
        if found:
            return [(y, x, width, length) for y, x, length in found]
    return []


def narrow_runs(words: bits.Words, axis: int, outside: np.uint64, fewest: int, sliver: int) -> NarrowRuns:
    """Find the runs along an axis that have fewer than `fewest` pixels."""
    left, alone, long = words.copy(), np.empty_like(words), np.empty_like(words)
    smallest, runs, narrow, slivers = None, 0, 0, 0
    places: list[tuple[int, int, int, int]] = []
    for width in range(1, fewest):
        found = bits.split(left, axis, outside, alone)
        if not found:
            continue
        runs += found
        narrow += bits.count_starts(alone, 1 - axis, bits.NONE)
        long[:] = alone
        bits.erode(long, 1 - axis, sliver, bits.NONE)
        slivers += bits.count_starts(long, 1 - axis, bits.NONE)
        if smallest is None:
            smallest, places = width, _places(alone, long, 1 - axis, width)
    return NarrowRuns(smallest, runs, narrow, slivers, places)


def shortest(words: bits.Words, outside: np.uint64, known: int) -> int:
    """Return the shortest run, which has `known` pixels or more and one of which is bounded, by bisection."""
    whole = [bits.count_starts(words, axis, outside) for axis in (0, 1)]
    left = np.empty_like(words)

    def has_shorter(length: int) -> bool:
        for axis in (0, 1):
            left[:] = words
            bits.erode(left, axis, length, outside)
            if bits.count_starts(left, axis, outside) < whole[axis]:
                return True
        return False

    low, high = known, known + 1
    while not has_shorter(high):
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if has_shorter(middle) else (middle, high)
    return low


def count_bounded(words: bits.Words, axis: int) -> tuple[int, int]:
    """Return the number of runs of lines along an axis, and of spaces between two of them."""
    lines = bits.count_starts(words, axis, bits.NONE)
    filled = np.bitwise_or.reduce(words, axis=axis)
    rows = int(np.count_nonzero(filled)) if axis == 1 else int(bits.count(filled[None]))
    return lines, lines - rows
