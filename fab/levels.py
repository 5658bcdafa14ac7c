"""Levels: the staircase that lithography can make, and the nearest step for every height.

Every level is a choice of masks: mask k opens where bit k of the code ``L - 1 - l`` is set and etches its depth there.
The blank glass is the top level ``L - 1``, and heights are counted from the deepest floor that a level has. By default
mask k etches ``2**k`` steps, and level l is l steps high. Any other depths will do; then the numbers of the levels are
still choices of masks, but no longer an order of height. Splitting a level map into its masks (`planes`) and joining
them are exact inverses, whatever the depths are.

L is any whole number. Where it is no power of two, a design has the codes 0 to ``L - 1`` alone, and masks that give a
pixel another are refused; in glass the others occur where errors of a process let openings overlap.
"""

import math
import operator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.height import refuse_where, require_heights
from fab.units import format_length, number_of

# Numbers of levels; the most take six masks.
FEWEST, MOST = 2, 64

# Rows that are handled at once, so that a 4400 x 4400 map needs no second copy in float64.
_ROWS = 256
# Depths that agree so closely with 2^k steps are meant to be 2^k steps.
_SAME = 1e-9
# No thin element is so high: a longer step or depth is in other units.
_LONGEST_M = 1e-3
# A map that reaches so high is not in metres: no staircase is so deep.
_UNLIKELY_M = 1e-4
# Heights of two levels must differ by this part of a step. No process tells less apart, and single precision keeps a
# height to 1e-5 of a step, so that a stored height always says which level it is.
_APART = 1e-3


@dataclass(frozen=True)
class Levels:
    """A staircase of `count` heights, made by as few etches as have so many sets.

    Attributes:
        count: number of levels L, a whole number from 2 to 64.
        step_m: height of one step, metres; `count` steps are the height of one wave of the design, after which heights
            repeat.
        depths_m: how deep each mask etches, metres, first mask first; ``2**k * step_m`` where none are given.

    Raises:
        InputError: a count that is not a whole number from 2 to 64, a step or a depth that is not a positive number of
            metres or longer than 1 mm, or depths that are not one per mask or leave two levels at one height.
    """

    count: int
    step_m: float
    depths_m: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        try:
            count = operator.index(self.count)
        except TypeError:
            count = 0
        if not FEWEST <= count <= MOST:
            cure = "For example 6 or 16; powers of two use every set of masks."
            raise InputError("levels", f"must be a whole number from {FEWEST} to {MOST}", self.count, cure)
        object.__setattr__(self, "count", count)
        _require_height("level step", self.step_m)
        if not isinstance(self.depths_m, tuple | list | np.ndarray):
            rule = "must be a depth for each mask"
            raise InputError("etch depths", rule, repr(self.depths_m), "For example (75e-9, 150e-9).")
        for depth in self.depths_m:
            _require_height("etch depths", depth)
        binary = tuple(2**bit * self.step_m for bit in range(self.bits))
        depths = tuple(float(depth) for depth in self.depths_m)
        if depths and len(depths) != self.bits:
            rule = f"{self.count} levels must have {self.bits} etches"
            raise InputError("etch depths", rule, f"{len(depths)} depths", "Give one depth per mask, first mask first.")
        even = all(math.isclose(depth, due, rel_tol=_SAME) for depth, due in zip(depths, binary, strict=False))
        object.__setattr__(self, "depths_m", binary if even else depths)
        if not even:
            self._require_different_heights()

    def _require_different_heights(self) -> None:
        order, heights = self.by_height()
        twins = np.flatnonzero(np.diff(heights) < _APART * self.step_m)
        if twins.size:
            # The shallowest pair is made by the fewest masks.
            pair = slice(twins[-1], twins[-1] + 2)
            lower, upper = (self._masks_in_words(int(level)) for level in order[pair])
            depth = format_length(float(f"{self.total_m - heights[pair][0]:.6g}"))
            got = f"{depth} deep both by {lower} and by {upper}"
            cure = "Change one of the depths; otherwise a level is made in two ways and another is missing."
            raise InputError("etch depths", "no two levels may have the same height", got, cure)

    def _masks_in_words(self, level: int) -> str:
        masks = [f"{bit + 1} (bit {bit})" for bit in range(self.bits) if self.count - 1 - level >> bit & 1]
        return f"mask{'s' * (len(masks) > 1)} {' + '.join(masks)}" if masks else "no mask"

    @property
    def bits(self) -> int:
        """Number of etch masks, log2 of the count, rounded up."""
        return (self.count - 1).bit_length()

    @property
    def is_full(self) -> bool:
        """Whether every set of masks makes a level: whether the count is a power of two."""
        return self.count == 1 << self.bits

    @property
    def is_binary(self) -> bool:
        """Whether mask k etches ``2**k`` steps, so that level l is l steps high."""
        return self.depths_m == tuple(2**bit * self.step_m for bit in range(self.bits))

    @property
    def period_m(self) -> float:
        """Height of one wave of the design, metres: heights are taken modulo this."""
        return self.count * self.step_m

    @property
    def total_m(self) -> float:
        """Height of the blank glass above the deepest floor, metres."""
        return float(self.heights_m()[-1])

    def __str__(self) -> str:
        """Return "16 levels of 75 nm", or "4 levels by etches of 80 nm and 150 nm"."""
        if self.is_binary:
            return f"{self.count} levels of {format_length(self.step_m)}"
        *most, last = (format_length(depth) for depth in self.depths_m)
        depths = f"{', '.join(most)} and {last}" if most else last
        return f"{self.count} levels by etches of {depths}" if most else f"{self.count} levels by an etch of {depths}"

    def heights_m(self) -> NDArray[np.float64]:
        """Return the height of every level above the deepest floor, metres, shape ``(count,)``."""
        if self.is_binary:
            return np.arange(self.count, dtype=np.float64) * np.float64(self.step_m)
        etched = [[-d for bit, d in enumerate(self.depths_m) if code >> bit & 1] for code in range(self.count)]
        deepest = [-d for d in min(etched, key=math.fsum)]
        return np.array([math.fsum(deepest + depths) for depths in reversed(etched)])

    def by_height(self) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """Return the levels from the lowest to the highest, and their heights, metres, both of shape ``(count,)``."""
        heights = self.heights_m()
        order = np.argsort(heights, kind="stable").astype(np.uint8)
        return order, heights[order]

    def etch_depth_m(self, bit: int) -> float:
        """Return how deep mask `bit` etches, ``depths_m[bit]``, metres; ValueError if there is no such mask."""
        if not 0 <= bit < self.bits:
            raise ValueError(f"`bit` must lie from 0 to {self.bits - 1}, but got {bit}")
        return self.depths_m[bit]


def _require_height(name: str, height_m: object) -> None:
    """Raise an InputError for a height that no staircase has, the value of `name`."""
    if not 0 < number_of(height_m) <= _LONGEST_M:
        rule, cure = "must be positive and at most 1 mm, in metres", 'Give 75e-9 for 75 nm; in a spec, "75 nm".'
        raise InputError(name, rule, repr(height_m), cure)


def require_levels(level_map: NDArray[np.integer], levels: Levels) -> NDArray[np.uint8]:
    """Check that integers ``[y, x]`` are a level map of this staircase; return them as a C-ordered uint8 array."""
    cure = "Quantise the height map with these levels first."
    if level_map.ndim != 2 or level_map.size == 0 or level_map.dtype.kind not in "iu":
        got = f"{level_map.dtype} of shape {level_map.shape}"
        raise InputError("level map", "must be a filled two-dimensional array of integers", got, cure)
    low, high = int(level_map.min()), int(level_map.max())
    if low < 0 or high >= levels.count:
        raise InputError("level map", f"levels must lie from 0 to {levels.count - 1}", f"{low} to {high}", cure)
    return np.ascontiguousarray(level_map, dtype=np.uint8)


def quantise(height_m: NDArray[np.floating], levels: Levels) -> NDArray[np.uint8]:
    """Give every pixel ``[y, x]`` (metres) the nearest level; halfway goes up, the top takes half a step above it.

    Raises:
        InputError: no heights, or heights more than half a step above the top level.
    """
    require_heights(height_m, "height map")
    top = (levels.count - 0.5) * levels.step_m if levels.is_binary else levels.total_m + 0.5 * levels.step_m
    cure = "Wrap the map to one wave of height (wrapped=True), or choose more levels or a larger step."
    if height_m.max() >= _UNLIKELY_M:
        cure = 'Heights are taken as metres; of a map in other units give the scale, such as "1 nm".'
    # One part in 1e6 of a step keeps a float32 height that means exactly half a step above the top.
    refuse_where(
        height_m,
        height_m > top + 1e-6 * levels.step_m,
        "height map",
        f"no height may lie more than half a step above the top level ({format_length(top)} for {levels})",
        cure,
    )
    order, heights = levels.by_height()
    halfway = (heights[1:] + heights[:-1]) / 2
    level_map = np.empty(height_m.shape, dtype=np.uint8)
    for start in range(0, height_m.shape[0], _ROWS):
        rows = height_m[start : start + _ROWS].astype(np.float64)
        if levels.is_binary:
            nearest = np.minimum(np.floor(rows / levels.step_m + 0.5), levels.count - 1)
        else:
            nearest = order[np.searchsorted(halfway, rows, side="right")]
        level_map[start : start + _ROWS] = nearest
    return level_map


def wrapped_cells(levels: Levels) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Divide one wave of height among the levels, each of which gets what is nearest to it, waves taken off.

    Returns ascending edges, metres, ``(count,)``, and the level below, between and above them, ``(count + 1,)``; the
    first and the last are the same, since the wave begins within that level's share.
    """
    return nearest_around(levels.heights_m(), levels.period_m)


def nearest_around(places: NDArray[np.float64], period: float) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Divide a circle of some period among places on it, each of which gets what is nearest to it.

    Returns ascending edges from 0 to the period, ``(count,)``, and the number of the place below, between and above
    them, ``(count + 1,)``.
    """
    period = np.float64(period)
    places = np.mod(places, period)
    order = np.argsort(places, kind="stable").astype(np.uint8)
    places = places[order]
    edges = np.append((places[1:] + places[:-1]) / 2, (places[-1] + places[0] + period) / 2)
    if edges[-1] < period:
        return edges, np.append(order, order[0])
    return np.roll(edges, 1) - np.append(period, np.zeros(edges.size - 1)), np.append(order[-1], order)


def quantise_wrapped(height_m: NDArray[np.floating], levels: Levels) -> NDArray[np.uint8]:
    """Give every pixel ``[y, x]`` (metres) the nearest level, heights repeating after one wave of the design."""
    if levels.is_binary:
        return np.mod(np.rint(height_m / levels.step_m), levels.count).astype(np.uint8)
    edges, cells = wrapped_cells(levels)
    return cells[np.searchsorted(edges, np.mod(height_m, levels.period_m), side="right")]


def height_of(level_map: NDArray[np.integer], levels: Levels) -> NDArray[np.float64]:
    """Return the height of every pixel of a level map ``[y, x]``, ``levels.heights_m()[level]``, metres."""
    return levels.heights_m()[require_levels(level_map, levels)]


def planes(level_map: NDArray[np.integer], levels: Levels) -> NDArray[np.uint8]:
    """Split a level map ``[y, x]`` into its etch masks ``[bit, y, x]``: 1 where mask `bit` is open (etched)."""
    etched = np.uint8(levels.count - 1) - require_levels(level_map, levels)
    return etched >> np.arange(levels.bits, dtype=np.uint8)[:, None, None] & np.uint8(1)


def level_map_from_planes(bit_planes: NDArray[np.integer] | NDArray[np.bool_], levels: Levels) -> NDArray[np.uint8]:
    """Join etch masks ``[bit, y, x]`` of 0 and 1, first mask first, into the level map ``[y, x]`` that they make."""
    if bit_planes.ndim != 3 or bit_planes.shape[0] != levels.bits:
        rule = f"{levels.count} levels need {levels.bits} planes [bit, y, x]"
        raise InputError("bit planes", rule, f"shape {bit_planes.shape}", "Give one plane per mask.")
    if bit_planes.size and (bit_planes.min() < 0 or bit_planes.max() > 1):
        raise InputError("bit planes", "every value must be 0 or 1", "another value", "Threshold the planes first.")
    shifted = bit_planes.astype(np.uint8) << np.arange(levels.bits, dtype=np.uint8)[:, None, None]
    return level_map_from_codes(np.bitwise_or.reduce(shifted, axis=0), levels)


def level_map_from_codes(etched: NDArray[np.uint8], levels: Levels, where: str = "masks") -> NDArray[np.uint8]:
    """Return the level map of the numbers ``[y, x]`` whose bit k says whether mask k etches.

    Raises:
        InputError: masks that `where` holds etch a pixel together and make no level.
    """
    top = np.uint8(levels.count - 1)
    if not levels.is_full and (wrong := etched > top).any():
        row, column = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
        rule = f"must give every pixel one of the {levels.count} levels"
        got = f"{np.count_nonzero(wrong)} with a set of masks of none, the first at row {row}, column {column}"
        raise InputError(where, rule, got, "Draw the masks again.")
    return top - etched
