"""Moves of a repair: rectangles of pixels that take another depth, and their effect on rules and light.

The energy of a map is the weighted sum of the pixels by which runs are too short and of the corners that touch, over
all bit planes at once, of the error of every pixel, and of the cost of every wall. A depth is a number whose bits are
the masks that etch. The functions look at no more than the surroundings of a rectangle, so moves far apart do not
influence each other.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray


class RepairTask(NamedTuple):
    """A level map in work, on maps that are padded by `pad` pixels of blank glass.

    By which masks each pixel is `etched` and `wanted` to be, which are `free` to change, what depth a costs where b is
    wanted (`error[a, b]`), the narrowest `line` and `space` in pixels, how many kissing corners one missing pixel
    of width is as bad as (`gravity`), and what a wall as long as a pixel costs between depths a and b (`wall[a ^ b]`;
    empty where walls cost nothing).
    """

    etched: NDArray[np.uint8]
    wanted: NDArray[np.uint8]
    free: NDArray[np.bool_]
    error: NDArray[np.float64]
    pad: int
    line: int
    space: int
    gravity: int
    wall: NDArray[np.float64]


@njit(cache=True, nogil=True, inline="always")
def _ones(value):  # pragma: no cover - compiled
    value = value - ((value >> 1) & 0x55)
    value = (value & 0x33) + ((value >> 2) & 0x33)
    return (value + (value >> 4)) & 0x0F


@njit(cache=True, nogil=True)
def _deficit(task, y, x, dy, dx, first, last):  # pragma: no cover - compiled
    # Missing pixels of the short runs, of all planes at once, that begin `first` to `last` pixels from (y, x) along
    # (dy, dx). A run begins where the depth's bits differ from those of the pixel before, and ends where they do again.
    total = 0
    for start in range(first, last + 1):
        here = np.int64(task.etched[y + start * dy, x + start * dx])
        begun = here ^ np.int64(task.etched[y + (start - 1) * dy, x + (start - 1) * dx])
        line, space = begun & here, begun & ~here
        before = here
        for length in range(1, max(task.line, task.space)):
            if not (line | space):
                break
            after = np.int64(task.etched[y + (start + length) * dy, x + (start + length) * dx])
            ended = before ^ after
            before = after
            if length < task.line:
                total += _ones(line & ended) * (task.line - length)
            if length < task.space:
                total += _ones(space & ended) * (task.space - length)
            line &= ~ended
            space &= ~ended
    return total


@njit(cache=True, nogil=True)
def _kissing(etched, y0, x0, y1, x1):  # pragma: no cover - compiled
    total = 0
    for y in range(y0 - 1, y1):
        for x in range(x0 - 1, x1):
            a, b, c, d = etched[y, x], etched[y, x + 1], etched[y + 1, x], etched[y + 1, x + 1]
            total += _ones(np.int64((a ^ b) & (c ^ d) & (a ^ c)))
    return total


@njit(cache=True, nogil=True)
def broken(task, y0, x0, y1, x1):  # pragma: no cover - compiled
    """Return how much is broken by and about the pixels of a rectangle: all that a change of them can change."""
    reach = max(task.line, task.space)
    missing = 0
    if reach > 1:
        for y in range(y0, y1):
            missing += _deficit(task, y, x0, 0, 1, -reach, x1 - x0)
        for x in range(x0, x1):
            missing += _deficit(task, y0, x, 1, 0, -reach, y1 - y0)
    return _kissing(task.etched, y0, x0, y1, x1) + task.gravity * missing


@njit(cache=True, nogil=True)
def _with_broken(task, weight, change, best, y0, x0, y1, x1):  # pragma: no cover - compiled
    # `change` and the weight of all that is broken about a rectangle, or infinity as soon as that is not below `best`:
    # what is looked at last can only add.
    reach = max(task.line, task.space)
    total = _kissing(task.etched, y0, x0, y1, x1)
    if reach > 1:
        for y in range(y0, y1):
            if change + weight * total >= best:
                return np.inf
            total += task.gravity * _deficit(task, y, x0, 0, 1, -reach, x1 - x0)
        for x in range(x0, x1):
            if change + weight * total >= best:
                return np.inf
            total += task.gravity * _deficit(task, y0, x, 1, 0, -reach, y1 - y0)
    return change + weight * total


@njit(cache=True, nogil=True)
def offends(task, y, x):  # pragma: no cover - compiled
    """Whether a pixel itself lies in a short run or at a kissing corner."""
    if _kissing(task.etched, y, x, y + 1, x + 1):
        return True
    own = np.int64(task.etched[y, x])
    for dy, dx in ((0, 1), (1, 0)):
        # Bits that have been the same as the pixel's own so far, and how many pixels they have been it.
        for need, wanted in ((task.line, own), (task.space, ~own)):
            for behind in range(need - 1):
                same = 0xFF & wanted
                for at in range(1, behind + 1):
                    same &= ~(own ^ np.int64(task.etched[y - at * dy, x - at * dx]))
                same &= own ^ np.int64(task.etched[y - (behind + 1) * dy, x - (behind + 1) * dx])
                for at in range(1, need - behind):
                    differs = own ^ np.int64(task.etched[y + at * dy, x + at * dx])
                    if same & differs:
                        return True
    return False


@njit(cache=True, nogil=True)
def loss(task, y0, x0, y1, x1):  # pragma: no cover - compiled
    """Return the summed error of the pixels of a rectangle, and the cost of the walls in and around it."""
    etched, wall = task.etched, task.wall
    total = 0.0
    for y in range(y0, y1):
        for x in range(x0, x1):
            total += task.error[etched[y, x], task.wanted[y, x]]
    if wall.size:
        for y in range(y0, y1):
            for x in range(x0, x1 + 1):
                total += wall[etched[y, x] ^ etched[y, x - 1]]
        for y in range(y0, y1 + 1):
            for x in range(x0, x1):
                total += wall[etched[y, x] ^ etched[y - 1, x]]
    return total


@njit(cache=True, nogil=True)
def _depths_near(task, y, x, reach, out):  # pragma: no cover - compiled
    # The depths that a pixel may take, each once: the one that is wanted and those of the pixels around it.
    out[0] = task.wanted[y, x]
    used, known = 1, np.uint64(1) << np.uint64(task.wanted[y, x])
    for far in (1, reach):
        for dy in range(-far, far + 1, far):
            for dx in range(-far, far + 1, far):
                depth = np.uint64(task.etched[y + dy, x + dx])
                if not known >> depth & np.uint64(1):
                    known |= np.uint64(1) << depth
                    out[used] = depth
                    used += 1
    return used


@njit(cache=True, nogil=True)
def _fill_losses(task, walls, y0, x0, y1, x1, losses):  # pragma: no cover - compiled
    # `loss` of a rectangle if all of it had one depth, for every depth: there are walls around it alone.
    etched, wanted, error = task.etched, task.wanted, task.error
    count = len(losses)
    for depth in range(count):
        losses[depth] = 0.0
    for y in range(y0, y1):
        for x in range(x0, x1):
            own = wanted[y, x]
            for depth in range(count):
                losses[depth] += error[own, depth]  # how far a is from b is how far b is from a
    if walls.size:
        for y in range(y0, y1):
            left, right = etched[y, x0 - 1], etched[y, x1]
            for depth in range(count):
                losses[depth] += walls[left, depth] + walls[right, depth]
        for x in range(x0, x1):
            below, above = etched[y0 - 1, x], etched[y1, x]
            for depth in range(count):
                losses[depth] += walls[below, depth] + walls[above, depth]


@njit(cache=True, nogil=True)
def _improve(task, walls, scratch, y, x, weight, sound):  # pragma: no cover - compiled
    # Take the best of the moves that cover a pixel; tell whether there was one.
    etched = task.etched
    reach = max(task.line, task.space, 2)
    depths, kept, losses = scratch
    many = _depths_near(task, y, x, reach, depths)
    best, best_depth = -1e-9, -1
    best_y = best_x = best_high = best_wide = 0
    # The pixel alone, and lines and a square with the pixel at one of their ends or corners.
    for kind in range(9):
        high = reach if kind in (1, 2, 5, 6, 7, 8) else 1
        wide = reach if kind in (3, 4, 5, 6, 7, 8) else 1
        y0 = y - (high - 1 if kind in (2, 6, 8) else 0)
        x0 = x - (wide - 1 if kind in (4, 7, 8) else 0)
        y1, x1 = y0 + high, x0 + wide
        allowed = True
        for v in range(max(y0, 0), min(y1, etched.shape[0])):
            for u in range(max(x0, 0), min(x1, etched.shape[1])):
                allowed &= task.free[v, u]
        if not allowed:
            continue
        before = loss(task, y0, x0, y1, x1)
        if not sound:
            before += weight * broken(task, y0, x0, y1, x1)
        if -before >= best:  # no move leaves less than nothing
            continue
        written = False
        _fill_losses(task, walls, y0, x0, y1, x1, losses)
        for i in range(many):
            change = losses[depths[i]] - before
            # A move that costs more light than it can repair is not checked against the rules.
            if change < best:
                for v in range(y0, y1):
                    for u in range(x0, x1):
                        if not written:
                            kept[v - y0, u - x0] = etched[v, u]
                        etched[v, u] = depths[i]
                written = True
                change = _with_broken(task, weight, change, best, y0, x0, y1, x1)
            if change < best:
                best, best_depth = change, depths[i]
                best_y, best_x, best_high, best_wide = y0, x0, high, wide
        if written:
            for v in range(y0, y1):
                for u in range(x0, x1):
                    etched[v, u] = kept[v - y0, u - x0]
    if best_depth < 0:
        return False
    etched[best_y : best_y + best_high, best_x : best_x + best_wide] = best_depth
    return True


@njit(cache=True, nogil=True)
def sweep(task, first, last, weight, changed_too, sound):  # pragma: no cover - compiled
    """Take the best move of every offending pixel of some rows; return how many were taken.

    With `changed_too` also of every pixel that is not as wanted, and of those at a wall where walls cost something. A
    map that breaks no rule is `sound`, and stays so if the weight of a broken rule is more than any light: nothing
    offends, and no move has anything to repair.
    """
    etched, count = task.etched, task.error.shape[0]
    reach = max(task.line, task.space, 2)
    scratch = np.empty(19, np.int64), np.empty((reach, reach), etched.dtype), np.empty(count)
    walls = np.empty((count, count) if task.wall.size else (0, 0))
    for a in range(walls.shape[0]):
        for b in range(count):
            walls[a, b] = task.wall[a ^ b]
    moved = 0
    for y in range(first, last):
        for x in range(task.pad, etched.shape[1] - task.pad):
            if not task.free[y, x]:
                continue
            own = etched[y, x]
            seen = changed_too and own != task.wanted[y, x]
            if changed_too and task.wall.size and not seen:
                seen = not own == etched[y, x - 1] == etched[y, x + 1] == etched[y - 1, x] == etched[y + 1, x]
            if seen and not sound:
                # One look at all that its moves may touch, where little is broken, spares one at every move.
                y0, x0, y1, x1 = max(y - reach + 1, task.pad), max(x - reach + 1, task.pad), y + reach, x + reach
                end_y, end_x = etched.shape[0] - task.pad, etched.shape[1] - task.pad
                whole = broken(task, y0, x0, min(y1, end_y), min(x1, end_x)) == 0
                moved += _improve(task, walls, scratch, y, x, weight, whole)
            elif seen or (not sound and offends(task, y, x)):
                moved += _improve(task, walls, scratch, y, x, weight, sound)
    return moved
