"""Bit planes with 64 pixels in a word: erosion, runs and corners at the speed of the memory.

Word w of a row holds the pixels 64 w to 64 w + 63, the first in its lowest bit; what a row lacks to
a whole word is clear. `outside` is the word that stands for all pixels beyond the sides of a plane: `NONE` for lines,
`ALL` for the complement of them. Axis 0 is y, axis 1 is x.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Words = NDArray[np.uint64]

NONE = np.uint64(0)
ALL = np.uint64(0xFFFFFFFFFFFFFFFF)
_EACH = np.uint64(0x0101010101010101)
_THREADS = 4
_ONE, _TOP = np.uint64(1), np.uint64(63)


@njit(cache=True, nogil=True, inline="always")
def _ones(word):  # pragma: no cover - compiled
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * _EACH) >> np.uint64(56))


@njit(cache=True, nogil=True, inline="always")
def _mirrored(word):  # pragma: no cover - compiled
    for by, mask in ((7, 0x00AA00AA00AA00AA), (14, 0x0000CCCC0000CCCC), (28, 0x00000000F0F0F0F0)):
        swapped = (word ^ (word >> np.uint64(by))) & np.uint64(mask)
        word ^= swapped ^ (swapped << np.uint64(by))
    return word


@njit(cache=True, nogil=True)
def _pack(levels, top, out):  # pragma: no cover - compiled
    # `levels` holds eight pixels per word; no byte borrows from the next, since none exceeds `top`.
    bits, ny, nw = out.shape
    for y in range(ny):
        for w in range(nw):
            first = 8 * w
            for bit in range(bits):
                # Bit g of byte i is pixel i of group g, until the square of 8 x 8 bits is mirrored.
                word = NONE
                for group in range(min(8, levels.shape[1] - first)):
                    etched = top * _EACH - levels[y, first + group]
                    word |= ((etched >> np.uint64(bit)) & _EACH) << np.uint64(group)
                out[bit, y, w] = _mirrored(word)


def pack(level_map: NDArray[np.uint8], levels: int) -> Words:
    """Split C-ordered levels ``[y, x]`` below `levels` into etch masks ``[bit, y, word]``, set where etched."""
    ny, nx = level_map.shape
    top = np.uint64(levels - 1)
    if nx % 8:
        level_map = np.pad(level_map, ((0, 0), (0, -nx % 8)), constant_values=int(top))
    groups = level_map.view(np.uint64)
    out = np.empty((int(top).bit_length(), ny, -(-nx // 64)), dtype=np.uint64)
    rows = [slice(ny * i // _THREADS, ny * (i + 1) // _THREADS) for i in range(_THREADS)]
    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda part: _pack(groups[part], top, out[:, part]), rows))
    return out


@njit(cache=True, nogil=True)
def count(words: Words) -> Any:  # pragma: no cover - compiled
    """Return the number of set pixels of a plane."""
    total = 0
    for y in range(words.shape[0]):
        for w in range(words.shape[1]):
            total += _ones(words[y, w])
    return total


@njit(cache=True, nogil=True)
def count_starts(words: Words, axis: int, outside: np.uint64) -> Any:  # pragma: no cover - compiled
    """Return how many runs along an axis begin inside the plane."""
    ny, nw = words.shape
    total = 0
    for y in range(ny):
        if axis == 1:
            total += _ones(words[y, 0] & ~((words[y, 0] << _ONE) | (outside & _ONE)))
            for w in range(1, nw):
                total += _ones(words[y, w] & ~((words[y, w] << _ONE) | (words[y, w - 1] >> _TOP)))
        elif y:
            for w in range(nw):
                total += _ones(words[y, w] & ~words[y - 1, w])
        else:
            for w in range(nw):
                total += _ones(words[y, w] & ~outside)
    return total


@njit(cache=True, nogil=True)
def _and_below(words, by, outside):  # pragma: no cover - compiled
    ny, nw = words.shape
    for y in range(ny):
        for w in range(nw):
            words[y, w] &= words[y + by, w] if y + by < ny else outside


@njit(cache=True, nogil=True)
def _and_beside(row, by, outside):  # pragma: no cover - compiled
    nw = row.size
    skip, low = by >> 6, np.uint64(by & 63)
    high = np.uint64(64) - low
    if by < 64:  # a loop that the compiler can run on several words at once
        for w in range(nw - 1):
            row[w] &= (row[w] >> low) | (row[w + 1] << high)
        row[nw - 1] &= (row[nw - 1] >> low) | (outside << high)
        return
    for w in range(nw):
        near = row[w + skip] if w + skip < nw else outside
        far = row[w + skip + 1] if w + skip + 1 < nw else outside
        row[w] &= (near >> low) | (far << high) if low else near


@njit(cache=True, nogil=True)
def erode(words: Words, axis: int, length: int, outside: np.uint64) -> None:  # pragma: no cover - compiled
    """Keep, in place, the pixels that begin `length` set ones along an axis: shorter runs vanish, others stay one."""
    if axis == 0:
        reach = 1
        while reach < length:
            by = min(reach, length - reach)
            _and_below(words, by, outside)
            reach += by
        return
    for row in words:
        reach = 1
        while reach < length:
            by = min(reach, length - reach)
            _and_beside(row, by, outside)
            reach += by


@njit(cache=True, nogil=True)
def split(words: Words, axis: int, outside: np.uint64, alone: Words) -> Any:  # pragma: no cover - compiled
    """Move the runs of one pixel from a plane into `alone`, and shorten others by one at their end; return how many."""
    ny, nw = words.shape
    total = 0
    if axis == 1:
        for y in range(ny):
            before = outside
            for w in range(nw):
                here = words[y, w]
                after = words[y, w + 1] if w + 1 < nw else outside
                follower = (here >> _ONE) | (after << _TOP)
                alone[y, w] = here & ~follower & ~((here << _ONE) | (before >> _TOP))
                total += _ones(alone[y, w])
                words[y, w] = here & follower
                before = here
        return total
    before_row = np.full(nw, outside)
    for y in range(ny):
        for w in range(nw):
            here = words[y, w]
            follower = words[y + 1, w] if y + 1 < ny else outside
            alone[y, w] = here & ~follower & ~before_row[w]
            total += _ones(alone[y, w])
            before_row[w] = here
            words[y, w] = here & follower
    return total


@njit(cache=True, nogil=True)
def corners(words: Words, found: Words) -> Any:  # pragma: no cover - compiled
    """Mark pixel (y, x) in `found` where (y, x) and (y + 1, x + 1) touch only at a corner; return how many."""
    ny, nw = words.shape
    total = 0
    found[ny - 1] = NONE
    for y in range(ny - 1):
        for w in range(nw):
            low, high = words[y, w], words[y + 1, w]
            low_next, high_next = low >> _ONE, high >> _ONE
            if w + 1 < nw:
                low_next |= words[y, w + 1] << _TOP
                high_next |= words[y + 1, w + 1] << _TOP
            found[y, w] = (low ^ high) & (low_next ^ high_next) & (low ^ low_next)
            total += _ones(found[y, w])
    return total


@njit(cache=True, nogil=True, inline="always")
def _is_set(words, y, x):  # pragma: no cover - compiled
    inside = y < words.shape[0] and x < 64 * words.shape[1]
    return inside and (words[y, x >> 6] >> np.uint64(x & 63)) & _ONE != NONE


@njit(cache=True, nogil=True)
def longest_runs(
    starting: Words, words: Words, axis: int, most: int, looks: int
) -> NDArray[np.int64]:  # pragma: no cover - compiled
    """List row, column and length ``(n, 3)`` of the longest runs of `words` that begin where those of `starting` do.

    Of at most `looks` of them, met from the middle row up and around, the `most` longest, longest first. The outside is
    clear.
    """
    ny, nw = words.shape
    out = np.empty((most + 1, 3), np.int64)
    used = seen = 0
    for i in range(ny):
        y = (i + ny // 2) % ny
        for w in range(nw):
            fresh = starting[y, w]
            if axis == 0 and y:
                fresh &= ~starting[y - 1, w]
            elif axis == 1:
                fresh &= ~((fresh << _ONE) | (starting[y, w - 1] >> _TOP if w else NONE))
            while fresh:
                first = 64 * w + _ones((fresh & (~fresh + _ONE)) - _ONE)
                fresh &= fresh - _ONE
                seen += 1
                # A run that ends before it is as long as the last one listed is not measured.
                least = out[most - 1, 2] if used == most else 0
                if _is_set(words, y + least * (1 - axis), first + least * axis):
                    length = 1
                    while _is_set(words, y + length * (1 - axis), first + length * axis):
                        length += 1
                    place = used
                    while place and out[place - 1, 2] < length:
                        out[place] = out[place - 1]
                        place -= 1
                    out[place, 0], out[place, 1], out[place, 2] = y, first, length
                    used = min(used + 1, most)
                if seen == looks:
                    return out[:used]
    return out[:used]


@njit(cache=True, nogil=True)
def windows(words: Words, nx: int, size: int) -> NDArray[np.int64]:  # pragma: no cover - compiled
    """Count the set pixels of all whole square windows that fit side by side into a plane of `nx` columns."""
    across = nx // size
    out = np.zeros((words.shape[0] // size, across), np.int64)
    before = np.empty(words.shape[1], np.int64)  # pixels of the row left of a word
    for y in range(out.shape[0] * size):
        total = 0
        for w in range(words.shape[1]):
            before[w] = total
            total += _ones(words[y, w])
        left = 0
        for i in range(across):
            edge = (i + 1) * size
            w, inside = edge >> 6, np.uint64(edge & 63)
            right = before[w] + _ones(words[y, w] & ((_ONE << inside) - _ONE)) if w < words.shape[1] else total
            out[y // size, i] += right - left
            left = right
    return out
