"""Repair of a level map whose masks are too fine: new levels for the pixels that break a rule, few and near.

No mask is repaired by itself, since a pixel that is moved in one bit plane jumps by the depth of that etch. Here levels
change, and a level is judged by all its bits at once.

A move sets a small rectangle of pixels to the level of one of its neighbours. Moves are weighed by what they do to the
rules (pixels by which runs are too short, and kissing corners, of every mask) and to the light (1 - cos of the phase
error). Sweeps over the offending pixels take the best move of each, while the weight of a broken rule rises: cheap
repairs come first and expensive ones only where they are needed.

What is left is frozen: the plate is divided into squares as wide as the rules demand, and every square in which
something is broken becomes one level, or blank glass at the rim of the aperture. Frozen squares stay frozen, and a
plate of nothing but squares has no narrow line or space, so this ends; squares that touch only at a corner get another
level. Last, pixels go back to the level that was asked for, or nearer to it, where they may.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fab.errors import InputError
from fab.grid import fewest_pixels
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.process import Process
from fab.rules.check import Rules, RulesReport, check
from fab.rules.repair_moves import RepairTask, broken, loss, offends, sweep
from fab.units import number_of

# How much phase error (1 - cos) one pixel of deficit, or one kissing corner, is worth in each sweep.
_WEIGHTS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
# So much that no gain of light is worth a broken rule.
_HARD = 1e6
_GRAVITY = 1000
# How often corners that touch in spite of it all are frozen anew.
_ATTEMPTS = 4
WIDEST = 32
_NO_WALLS = np.zeros(0)


@dataclass(frozen=True)
class RepairCost:
    """Extent and cost of a repair, over the relief.

    `changed_share` is that of pixels with another level; `efficiency`, |mean exp(2 pi i dh waves_per_metre)|^2, of the
    light that still goes where it was meant to. Broken places are counted over all masks; afterwards they are corners
    at worst.
    """

    changed_share: float
    rms_height_m: float
    efficiency: float
    broken_before: int
    broken_after: int

    def __str__(self) -> str:
        """Return "1.2 % of the pixels changed, 0.3 % of the light goes astray"."""
        left = f", {self.broken_after} of {self.broken_before} broken places are left" if self.broken_after else ""
        return (
            f"{100 * self.changed_share:.3g} % of the pixels changed, {100 * (1 - self.efficiency):.2g} % of the light "
            f"goes astray{left}"
        )


@dataclass(frozen=True, eq=False)
class Repair:
    """A repaired level map.

    Attributes:
        level_map: the level map.
        cost: extent and cost of the repair.
        rules: the rules, checked on it.
    """

    level_map: LevelMap
    cost: RepairCost
    rules: RulesReport


@njit(cache=True, nogil=True)
def _mark(task, side, origin, frozen, active):  # pragma: no cover - compiled
    # Mark the loose squares that hold an offending pixel (1); return how many there are. Only active ones are seen.
    fresh = 0
    for j in range(frozen.shape[0]):
        for i in range(frozen.shape[1]):
            if not active[j, i] or frozen[j, i]:
                continue
            active[j, i] = False
            y0, x0 = origin + j * side, origin + i * side
            for y in range(y0, y0 + side):
                for x in range(x0, x0 + side):
                    if not frozen[j, i] and offends(task, y, x):
                        frozen[j, i] = 1
                        fresh += 1
    return fresh


@njit(cache=True, nogil=True)
def _wake(active, j, i):  # pragma: no cover - compiled
    active[max(j - 2, 0) : j + 3, max(i - 2, 0) : i + 3] = True


@njit(cache=True, nogil=True)
def _freeze(task, side, origin, frozen, active):  # pragma: no cover - compiled
    # Give every marked square the depth that costs least (2), or none where it is not wholly free (3).
    etched = task.etched
    for j in range(frozen.shape[0]):
        for i in range(frozen.shape[1]):
            if frozen[j, i] != 1:
                continue
            _wake(active, j, i)
            y0, x0 = origin + j * side, origin + i * side
            y1, x1 = y0 + side, x0 + side
            whole = np.all(task.free[y0:y1, x0:x1])
            frozen[j, i] = 2 if whole else 3
            best, chosen = np.inf, 0
            for depth in range(task.error.shape[0] if whole else 0):
                etched[y0:y1, x0:x1] = depth
                cost = loss(task, y0, x0, y1, x1)
                if cost < best:
                    cost += broken(task, y0, x0, y1, x1)
                if cost < best:
                    best, chosen = cost, depth
            etched[y0:y1, x0:x1] = chosen


@njit(cache=True, nogil=True)
def _part(task, side, origin, frozen, active):  # pragma: no cover - compiled
    # Frozen squares can only still touch at corners: give them another depth where that repairs more than it breaks.
    # Every move leaves less broken, so this ends.
    moved = 0
    for j in range(frozen.shape[0]):
        for i in range(frozen.shape[1]):
            y0, x0 = origin + j * side, origin + i * side
            y1, x1 = y0 + side, x0 + side
            before = broken(task, y0, x0, y1, x1) if frozen[j, i] == 2 else 0
            if not before:
                continue
            own = task.etched[y0, x0]
            best, chosen = _HARD * (before - 0.5), np.int64(own)
            for depth in range(task.error.shape[0]):
                task.etched[y0:y1, x0:x1] = depth
                cost = _HARD * broken(task, y0, x0, y1, x1) + loss(task, y0, x0, y1, x1)
                if cost < best:
                    best, chosen = cost, depth
            task.etched[y0:y1, x0:x1] = chosen
            if chosen != own:
                _wake(active, j, i)
                moved += 1
    return moved


def _sweep_all(task: RepairTask, weight: float, changed_too: bool, sound: bool = False) -> int:
    """Sweep over stripes, first even and then odd ones: however many run at once, the result is the same."""
    end = task.etched.shape[0] - task.pad
    # A move at the edge of a stripe reads two narrowest widths of the next one and writes less than one.
    height = 16 * max(task.line, task.space) + 32
    stripes = [(y, min(y + height, end)) for y in range(task.pad, end, height)]
    if len(stripes) > 1 and stripes[-1][1] - stripes[-1][0] < height:
        # No stripe may be so low that those beside it meet.
        stripes[-2:] = [(stripes[-2][0], end)]
    moved = 0
    with ThreadPoolExecutor() as pool:
        for half in (stripes[::2], stripes[1::2]):
            moved += sum(pool.map(lambda rows: sweep(task, rows[0], rows[1], weight, changed_too, sound), half))
    return moved


def _freeze_all(task: RepairTask, shift: int) -> bool:
    """Freeze squares, all shifted alike, until no line or space is too narrow; return whether anything was broken."""
    side = max(task.line, task.space)
    origin = task.pad - shift % side
    frozen = np.zeros([-(-(n - task.pad - origin) // side) for n in task.etched.shape], dtype=np.uint8)
    active = np.ones(frozen.shape, dtype=np.bool_)
    while True:
        fresh = _mark(task, side, origin, frozen, active)
        _freeze(task, side, origin, frozen, active)
        if not fresh and not _part(task, side, origin, frozen, active):
            return bool(frozen.any())


def _repair_in_place(task: RepairTask) -> None:
    for weight in _WEIGHTS:
        _sweep_all(task, weight, changed_too=False)
    # From here on no width is given up for a corner, so that what is frozen stays sound.
    task = task._replace(gravity=_GRAVITY)
    for attempt in range(_ATTEMPTS):
        if not _freeze_all(task, attempt) and attempt:
            break
        if not attempt:
            _sweep_all(task, _HARD, changed_too=True)
        # Every move lowers the energy, so this ends.
        while _sweep_all(task, _HARD, changed_too=False):
            pass


def _phases(levels: Levels, waves_per_metre: float) -> NDArray[np.float64]:
    """Return by how many radians the light of every level ``[a]`` is ahead of that of every other ``[b]``."""
    if levels.is_binary:
        number = np.arange(levels.count)
        return 2 * math.pi * waves_per_metre * levels.step_m * np.subtract.outer(number, number)
    return 2 * math.pi * waves_per_metre * np.subtract.outer(levels.heights_m(), levels.heights_m())


def _checked_waves(levels: Levels, waves_per_metre: float | None) -> float:
    waves = 1 / levels.period_m if waves_per_metre is None else waves_per_metre
    if not 0 < number_of(waves) < math.inf:
        rule = "must be a positive and finite number"
        raise InputError("waves per metre", rule, repr(waves), "Give (n - 1) / wavelength.")
    return waves


def _task_of(
    level_map: LevelMap, wanted: NDArray[np.uint8], rules: Rules, waves: float, wall: NDArray[np.float64]
) -> RepairTask:
    """A level map in work, and the levels that are wanted of it."""
    levels, grid = level_map.levels, level_map.grid
    line, space = (fewest_pixels(m, grid.pitch_m) for m in (rules.minimum_line_m, rules.minimum_space_m))
    if max(line, space) > WIDEST:
        rule = f"the narrowest line and space must not exceed {WIDEST} pixels"
        raise InputError("rules", rule, f"{max(line, space)} pixels", "Design on a coarser raster.")
    # Moves and the runs beside them reach no farther than this.
    pad, top = 2 * max(line, space) + 2, np.uint8(levels.count - 1)
    # By what is etched, the top level first.
    error = 1 - np.cos(_phases(levels, waves)[::-1, ::-1])
    etched, target = (np.pad(top - level, pad) for level in (level_map.level, wanted))
    free = np.pad(level_map.relief.inside(grid), pad)
    return RepairTask(etched, target, free, error, pad, line, space, 1, wall)


def _level_map_of(task: RepairTask, level_map: LevelMap) -> LevelMap:
    inner = slice(task.pad, -task.pad)
    return level_map.with_level(np.uint8(level_map.levels.count - 1) - task.etched[inner, inner])


def repair(level_map: LevelMap, process: Process | Rules | str, waves_per_metre: float | None = None) -> Repair:
    """Change as few levels as possible, as little as possible, until no mask breaks a rule.

    Args:
        level_map: the DOE; nothing changes outside its relief, where the glass stays blank.
        process: narrowest line and space, as for `check`. With neither there is nothing to repair.
        waves_per_metre: waves of light per metre of height, (n - 1) / wavelength, which says which levels are near each
            other; one wave over the period of the staircase by default.

    Raises:
        InputError: waves per metre that are not positive, or a minimum of more than 32 pixels.
    """
    return repaired(check(level_map, process), waves_per_metre)


def repaired(before: RulesReport, waves_per_metre: float | None = None) -> Repair:
    """Repair a level map that was checked; see `repair`."""
    level_map, rules = before.level_map, before.rules
    levels, wanted = level_map.levels, level_map.level
    waves = _checked_waves(levels, waves_per_metre)
    free, after = level_map.relief.inside(level_map.grid), before
    task = _task_of(level_map, wanted, rules, waves, _NO_WALLS)
    if not before.clean:
        _repair_in_place(task)
        after = check(_level_map_of(task, level_map), rules)
    # How often which level took the place of which.
    number = after.level_map.level[free].astype(np.int64) * levels.count + wanted[free]
    pairs = np.bincount(number, minlength=levels.count**2)
    shares = pairs.reshape(levels.count, levels.count) / max(pairs.sum(), 1)
    rises_m = np.subtract.outer(levels.heights_m(), levels.heights_m())
    cost = RepairCost(
        changed_share=1.0 - float(np.trace(shares)) if pairs.any() else 0.0,
        rms_height_m=math.sqrt(float(np.sum(shares * rises_m**2))),
        efficiency=float(abs(np.sum(shares * np.exp(1j * _phases(levels, waves)))) ** 2) if pairs.any() else 1.0,
        broken_before=sum(plane.breaks for plane in before.planes),
        broken_after=sum(plane.breaks for plane in after.planes),
    )
    return Repair(after.level_map, cost, after)


def follow(
    level_map: LevelMap,
    wanted: NDArray[np.uint8],
    rules: Rules,
    waves_per_metre: float | None = None,
    wall_costs: Sequence[float] = (),
) -> LevelMap:
    """Move a level map toward the levels that are wanted, as far as it then breaks no rule that it kept before.

    Every move sets a small rectangle to a level that is near it, and lowers the sum of the phase errors 1 - cos of all
    pixels and of the cost of all walls. What a sweep over the map does not reach stays for the next call.

    Args:
        level_map: the map before, best one that breaks no rule (`repair`).
        wanted: `[y, x]` levels that are wanted.
        rules: narrowest line and space, metres. Corners must not touch, whatever these are.
        waves_per_metre: as for `repair`.
        wall_costs: of every mask, the cost of a wall as long as a pixel, in units of 1 - cos; nothing where empty.
            Every mask has walls of its own: between levels 7 and 8 of 16 all four have one.

    Returns:
        the map after; nothing has changed outside its relief.

    Raises:
        InputError: waves per metre that are not positive, or a minimum of more than 32 pixels.
    """
    levels, bits = level_map.levels, np.arange(level_map.levels.bits)
    wall = _NO_WALLS
    if any(wall_costs):
        opened = (np.arange(2**levels.bits)[:, None] >> bits) & 1
        wall = np.asarray(opened @ np.array(wall_costs), np.float64)
    task = _task_of(level_map, wanted, rules, _checked_waves(levels, waves_per_metre), wall)._replace(gravity=_GRAVITY)
    # Where the rules ask for no width, touching corners break none of them, but count here.
    sound = not any(plane.breaks or plane.kissing for plane in check(level_map, rules).planes)
    _sweep_all(task, _HARD, changed_too=True, sound=sound)
    return _level_map_of(task, level_map)
