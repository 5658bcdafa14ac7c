"""The plan of a wafer: two alignment sites, five process monitors, and dies in all the rest.

The monitors lie in the middle and toward the four quarters, where a process differs most. On a wafer with room for many
dies they take the places of dies; on one with room for few, or with as many dies as somebody asked for, they go where
the dies leave room.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from fab.errors import InputError
from fab.layout.wafer import Wafer
from fab.units import MM, UM, format_length

Point = tuple[float, float]

GAP_M = 200 * UM
# Of the radius that can be used, how far out the outer monitors lie.
_OUTER = 0.7
# Fewer dies than that beside five monitors, and the dies have precedence.
_FEW_DIES = 12
_STEP_M = 0.5 * MM
_REPLICATES = 5


class Floorplan(NamedTuple):
    """Middles of the dies (row by row from the lowest y), how each is drawn, and middles of the sites; metres.

    `splits` has a number for every die, 0 for the DOE as ordered. The alignment sites lie at -`site_m` and +`site_m` on
    the x axis; `monitors` are x, y by name.
    """

    dies: tuple[Point, ...]
    splits: tuple[int, ...]
    site_m: float
    monitors: dict[str, Point]


class _Box(NamedTuple):
    """A box about x, y; metres."""

    x: float
    y: float
    width: float
    height: float

    def lies_on(self, wafer: Wafer) -> bool:
        """Whether all of it can be used on a wafer: inside the edge exclusion, and away from the flat or the notch."""
        reach, low = math.hypot(abs(self.x) + self.width / 2, abs(self.y) + self.height / 2), self.y - self.height / 2
        radius, rim, notch = wafer.diameter_m / 2, wafer.edge_exclusion_m, wafer.notch_m
        # A notch is as wide to either side as it is deep, and mostly less deep than the rim.
        over_notch = abs(self.x) - self.width / 2 < notch and low < notch - radius
        return reach <= radius - rim + 1e-12 and low >= -wafer.flat_y_m + rim - 1e-12 and not over_notch

    def meets(self, other: "_Box") -> bool:
        """Whether two boxes are closer than the gap that they need."""
        x, y = abs(self.x - other.x), abs(self.y - other.y)
        return x < (self.width + other.width) / 2 + GAP_M and y < (self.height + other.height) / 2 + GAP_M


def floorplan(wafer: Wafer, pitch_m: float, die_m: float, site: Point, monitor: Point, splits: int) -> Floorplan:
    """Place everything on a wafer.

    Args:
        wafer: what is filled, and with how many dies.
        pitch_m: distance of the dies, metres.
        die_m: edge of a die without the saw lanes, metres.
        site: width and height of an alignment site, metres.
        monitor: width and height of a process monitor, metres.
        splits: in how many ways dies are drawn, the DOE as ordered among them.

    Raises:
        InputError: the wafer has no room for what is asked.
    """
    sites = _sites(wafer, site)
    if wafer.dies is not None:
        dies = _raster(wafer.dies, pitch_m)
        boxes = [_Box(*die, die_m, die_m) for die in dies]
        fits = all(box.lies_on(wafer) for box in boxes) and not any(b.meets(s) for b in boxes for s in sites)
        monitors = _monitors(wafer, monitor, [*boxes, *sites]) if fits else {}
    else:
        dies, monitors = _filled(wafer, pitch_m, die_m, sites, monitor)
    if not dies or not monitors:
        asked = "as many dies as fit" if wafer.dies is None else "{} x {} dies".format(*wafer.dies)
        rule = f"must hold dies of {format_length(pitch_m)}, two alignment sites and the test structures"
        cure = "Take a larger wafer." if wafer.dies in (None, (1, 1)) else "Take fewer dies, or a larger wafer."
        raise InputError("wafer", rule, f"{asked} on a wafer of {format_length(wafer.diameter_m)}", cure)
    wafer.require_room(len(dies))
    return Floorplan(dies, _split(dies, splits), sites[1].x, monitors)


def _sites(wafer: Wafer, site: Point) -> tuple[_Box, _Box]:
    """Place the alignment sites as far apart as they can be, though no farther than the usual pair of microscopes."""
    width, height = site
    usable = wafer.diameter_m / 2 - wafer.edge_exclusion_m
    x = min(0.7 * wafer.diameter_m / 2, math.sqrt(max(usable**2 - (height / 2) ** 2, 0)) - width / 2)
    x = math.floor(x / (0.1 * MM) + 1e-6) * 0.1 * MM
    sites = _Box(-x, 0.0, width, height), _Box(x, 0.0, width, height)
    if not sites[1].lies_on(wafer) or sites[0].meets(sites[1]):
        rule = "must hold two alignment sites and the test structures"
        raise InputError("wafer", rule, format_length(wafer.diameter_m), "Take a larger wafer.")
    return sites


def _raster(shape: tuple[int, int], pitch_m: float) -> tuple[Point, ...]:
    rows, columns = shape
    return tuple(
        ((column - (columns - 1) / 2) * pitch_m, (line - (rows - 1) / 2) * pitch_m)
        for line in range(rows)
        for column in range(columns)
    )


def _filled(
    wafer: Wafer, pitch_m: float, die_m: float, sites: Sequence[_Box], monitor: Point
) -> tuple[tuple[Point, ...], dict[str, Point]]:
    """Return the most dies that fit, and the monitors."""
    monitors = {name: _on_raster(wafer, pitch_m, monitor, at) for name, at in _targets(wafer)}
    taken = [*sites, *(_Box(*at, *monitor) for at in monitors.values())]
    dies = _free(wafer, pitch_m, die_m, taken, (0, 0))
    if len(dies) >= _FEW_DIES and len({*monitors.values()}) == len(monitors):
        return dies, monitors
    # A die in the middle, or a crossing of lanes: whatever leaves more of them.
    offsets = ((0, 0), (0, 1), (1, 0), (1, 1))
    dies = max((_free(wafer, pitch_m, die_m, sites, offset) for offset in offsets), key=len)
    return dies, _monitors(wafer, monitor, [*sites, *(_Box(*die, die_m, die_m) for die in dies)])


def _free(
    wafer: Wafer, pitch_m: float, die_m: float, taken: Sequence[_Box], offset: tuple[int, int]
) -> tuple[Point, ...]:
    """List the dies of a raster that fit, `offset` by half a die in x and y."""
    most = math.ceil(wafer.diameter_m / pitch_m)
    boxes = (
        _Box((column + offset[0] / 2) * pitch_m, (line + offset[1] / 2) * pitch_m, die_m, die_m)
        for line in range(-most, most + 1)
        for column in range(-most, most + 1)
    )
    fit = (box for box in boxes if box.lies_on(wafer) and not any(box.meets(other) for other in taken))
    return tuple((box.x, box.y) for box in fit)


def _targets(wafer: Wafer) -> Iterator[tuple[str, Point]]:
    """Yield where the monitors should lie."""
    yield "centre monitor", (0.0, 0.0)
    out = _OUTER * (wafer.diameter_m / 2 - wafer.edge_exclusion_m) / math.sqrt(2)
    for name, x, y in (("upper right", 1, 1), ("upper left", -1, 1), ("lower left", -1, -1), ("lower right", 1, -1)):
        yield f"{name} monitor", (x * out, y * out)


def _on_raster(wafer: Wafer, pitch_m: float, monitor: Point, target: Point) -> Point:
    """Return the place of a raster that is nearest to a target and on the wafer."""
    x, y = (round(value / pitch_m) for value in target)
    while (x or y) and not _Box(x * pitch_m, y * pitch_m, *monitor).lies_on(wafer):
        x, y = (value - (value > 0) + (value < 0) for value in (x, y))
    return x * pitch_m, y * pitch_m


def _monitors(wafer: Wafer, monitor: Point, taken: list[_Box]) -> dict[str, Point]:
    """Place up to five monitors where nothing else is, each as near to its target as can be."""
    most = math.floor(wafer.diameter_m / 2 / _STEP_M)
    steps = range(-most, most + 1)
    places = [_Box(x * _STEP_M, y * _STEP_M, *monitor) for y in steps for x in steps]
    free = [box for box in places if box.lies_on(wafer) and not any(box.meets(other) for other in taken)]
    found: dict[str, Point] = {}
    for name, target in _targets(wafer):
        if free:
            box = min(free, key=lambda one, to=target: (round(math.dist(to, one[:2]), 9), one.y, one.x))
            found[name] = (box.x, box.y)
            free = [one for one in free if not one.meets(box)]
    return found


def _split(dies: Sequence[Point], splits: int) -> tuple[int, ...]:
    """Return how each die is drawn: each split up to five times all over the wafer, the most dies as ordered."""
    drawn = [0] * len(dies)
    if splits > 1:
        times = max(1, min(_REPLICATES, (len(dies) - 1) // 2 // (splits - 1)))
        slots = times * (splits - 1)
        # The die in the middle is as ordered.
        middle = middle_of(dies)
        others = [number for number in range(len(dies)) if number != middle]
        for slot in range(slots):
            drawn[others[int((slot + 0.5) * len(others) / slots)]] = 1 + slot % (splits - 1)
    return tuple(drawn)


def middle_of(dies: Iterable[Point]) -> int:
    """Return the number of the die next to the middle of the wafer."""
    return min(enumerate(dies), key=lambda pair: (round(math.hypot(*pair[1]), 9), pair[0]))[0]
