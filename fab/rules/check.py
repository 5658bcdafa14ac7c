"""The rules of lithography: what on a mask is too fine for the process, how often, and where.

What is etched is a line, what is not is a space, on every mask by itself and as drawn, before any compensation. Outside
the relief nothing is etched, so the staircase of its edge is an edge like any other.

* Width. The length of a run of pixels of one kind along x or along y. A space has a line at either end; the blank glass
  around the plate is none. This is what KLayout's `width` and `space` checks measure with projection metrics.
* Place. Neighbouring rows (or columns) with the very same narrow run are one place: the pair of facing edges that
  KLayout reports. A speck that is too narrow both ways is two. The narrow share counts rows and columns instead, so
  that a long line weighs more than a short one.
* Sliver. A narrow place at least three times the minimum long: a ribbon of resist, or of opening, that bends, breaks
  or lifts off, where a shorter one is merely lost.
* Kissing corner. Two pixels of one kind that touch only at a corner, which a process joins or parts as it likes.
* Density. The etched share of the relief, and of the emptiest and the fullest square window inside it, because
  etch rates follow it.
* Off grid. A pixel edge that is no whole multiple of the address unit of the mask writer, which will round it.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fab.aperture import Aperture, MaskAperture
from fab.errors import InputError
from fab.figure import html_of
from fab.grid import Grid, fewest_pixels
from fab.layout.geometry import pixel_edges
from fab.layout.polygons import run_lengths
from fab.level_map import LevelMap
from fab.process import Process
from fab.rules import bitplanes as bits
from fab.rules.widths import count_bounded, narrow_runs, shortest
from fab.stock import process_from
from fab.units import UM, format_length, number_of, require_kind

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

Kind = Literal["line", "space", "kissing corner"]

_MOST_PLACES = 20
_MOST_PER_KIND = 5
_SLIVER_LENGTH = 3
_FEMTO = 10**15
_LONGEST_RUN = 255


@dataclass(frozen=True)
class Rules:
    """Limits of what a mask may hold, metres.

    Attributes:
        minimum_line_m: narrowest etched line; 0 for any.
        minimum_space_m: narrowest gap between etched lines; 0 for any.
        address_m: address unit of the mask writer; None for the database unit of the drawing.
        window_m: side of the square windows in which the density is compared.

    Raises:
        InputError: a length that is negative or not finite, or an address unit or window of no size.
    """

    minimum_line_m: float = 0.0
    minimum_space_m: float = 0.0
    address_m: float | None = None
    window_m: float = 100 * UM

    def __post_init__(self) -> None:
        cure = "Give a length such as 1e-6."
        for name in ("minimum_line_m", "minimum_space_m"):
            if not 0 <= number_of(value := getattr(self, name)) < math.inf:
                raise InputError(f"rules: {name}", "must be finite and not negative, in metres", repr(value), cure)
        for name, needed in (("address_m", self.address_m is not None), ("window_m", True)):
            if needed and not 1e-15 <= number_of(value := getattr(self, name)) < math.inf:
                raise InputError(f"rules: {name}", "must be positive and finite, in metres", repr(value), cure)

    @classmethod
    def from_process(cls, process: Process, address_m: float | None = None) -> "Rules":
        """Return the rules of a process, the narrowest line and space that it prints, and of a mask writer's grid."""
        return cls(process.minimum_line_m, process.minimum_space_m, address_m)

    def codes(self, plane: NDArray[np.uint8], pitch_m: float) -> NDArray[np.uint8]:
        """Say of every pixel of a mask if it is space (0), line (1), or in a narrow space (2) or line (3); `[y, x]`."""
        codes = plane.copy()
        for value, minimum_m in ((0, self.minimum_space_m), (1, self.minimum_line_m)):
            fewest = min(fewest_pixels(minimum_m, pitch_m), _LONGEST_RUN)
            # A frame of blank glass: a space that reaches it lies between no two lines.
            kind = (np.pad(plane, fewest) == value).view(np.uint8)
            for runs in (run_lengths(kind), run_lengths(kind.T).T):
                narrow = (runs > 0) & (runs < fewest)
                codes[narrow[fewest:-fewest, fewest:-fewest]] = 2 + value
        return codes


class Violation(NamedTuple):
    """One place where a rule is broken: its middle from the aperture's centre, width and length (0 for a corner)."""

    what: Kind
    y_m: float
    x_m: float
    size_m: float
    length_m: float


@dataclass(frozen=True)
class Widths:
    """The lines, or the spaces, of one plane.

    The minimum is what the process prints; `smallest_m` is None if there is none; `narrow` places are below the
    minimum, some of them slivers; `narrow_share` is that of all cross-sections along x and y that are narrower.
    """

    minimum_m: float
    smallest_m: float | None
    narrow: int
    narrow_share: float
    slivers: int


@dataclass(frozen=True)
class PlaneRules:
    """One etch mask: lines (etched), spaces between them, and how many corners kiss.

    The densities are the etched share of the relief, and of its emptiest and fullest window. `places` are some
    of the worst, narrowest first and then longest.
    """

    bit: int
    line: Widths
    space: Widths
    kissing: int
    density: float
    emptiest: float
    fullest: float
    places: tuple[Violation, ...]

    @property
    def breaks(self) -> int:
        """Number of places that break a rule of the process; a process that prints everything has no rules."""
        fine = self.line.minimum_m == self.space.minimum_m == 0
        return 0 if fine else self.line.narrow + self.space.narrow + self.kissing

    @property
    def headline(self) -> str:
        """One sentence about what the process cannot print, saying why; empty if it can."""
        if not self.breaks:
            return ""
        said = []
        for widths, what in ((self.line, "lines"), (self.space, "spaces")):
            if widths.narrow and widths.smallest_m is not None:
                share, smallest = 100 * widths.narrow_share, format_length(float(f"{widths.smallest_m:.6g}"))
                ribbons = f", {widths.slivers} of them slivers" if widths.slivers else ""
                said.append(
                    f"{share:.2g} % of its {what} are narrower than the {format_length(widths.minimum_m)} that the "
                    f"process prints (down to {smallest}, in {widths.narrow} places{ribbons})"
                )
        if self.kissing:
            said.append(f"{self.kissing} pairs of pixels touch only at a corner")
        return f"mask {self.bit + 1} (bit {self.bit}): {'; '.join(said)}"


@dataclass(frozen=True)
class OffGrid:
    """Pixel edges off the address grid of the mask writer: how many of all, and the farthest that one has to move."""

    address_m: float
    edges: int
    of: int
    worst_m: float


@dataclass(frozen=True, eq=False)
class RulesReport:
    """Rules checked on every etch mask of a level map and on its raster; lengths in metres.

    Attributes:
        level_map: the level map.
        rules: the rules of the process.
        planes: what every mask breaks, first mask first.
        off_grid: what lies off the grid of the mask writer.
    """

    level_map: LevelMap
    rules: Rules
    planes: tuple[PlaneRules, ...]
    off_grid: OffGrid

    @property
    def clean(self) -> bool:
        """Whether no mask breaks a rule of the process."""
        return not any(plane.breaks for plane in self.planes)

    @property
    def printable(self) -> bool:
        """Whether no line and no space is too narrow. Touching corners print, but nobody knows as what."""
        return not any(plane.line.narrow or plane.space.narrow for plane in self.planes)

    def plot(self, ax: "Axes | None" = None, title: str = "") -> "FigureBase":
        """Draw where every mask breaks a rule (`fab.plots.rules.plot_rules`)."""
        from fab.plots.rules import plot_rules

        return plot_rules(self, title or f"{self.level_map.name}: where the masks break the rules", ax)

    def _repr_html_(self) -> str:
        rows = {f"mask {plane.bit + 1}": plane.headline or "breaks no rule" for plane in self.planes}
        return html_of(f"Rules of {self.level_map.name}", rows, self.plot())

    def headlines(self) -> tuple[str, ...]:
        """Return one sentence per mask that the process cannot print, saying why."""
        return tuple(plane.headline for plane in self.planes if plane.breaks)

    def as_record(self) -> dict[str, Any]:
        """Return everything as plain JSON values; lengths in metres."""
        planes = [{"mask": plane.bit + 1, **asdict(plane)} for plane in self.planes]
        for plane in planes:
            plane["places"] = [place._asdict() for place in plane["places"]]
        return {
            "rules": asdict(self.rules),
            "clean": self.clean,
            "headlines": list(self.headlines()),
            "planes": planes,
            "off_grid": asdict(self.off_grid),
        }


def _metres(length_m: float) -> float:
    """A length as the decimal number that was meant, to a femtometre."""
    return round(length_m, 15)


def _off_grid(grid: Grid, rules: Rules) -> OffGrid:
    address_m = pixel_edges(grid).dbu_m if rules.address_m is None else rules.address_m
    doubled = 2 * round(address_m * _FEMTO)
    lines = [np.arange(-n, n + 1, 2) * round(grid.pitch_m * _FEMTO) for n in grid.shape]
    rest = np.concatenate(lines) % doubled
    worst = int(np.minimum(rest, doubled - rest).max())
    return OffGrid(address_m, int(np.count_nonzero(rest)), rest.size, worst / 2 / _FEMTO)


def _window_pixels(grid: Grid, rules: Rules) -> int:
    return max(1, round(rules.window_m / grid.pitch_m))


def _whole_windows(grid: Grid, relief: Aperture, rules: Rules) -> NDArray[np.bool_]:
    """Return which of the windows that fit side by side into the raster ``[row, column]`` lie in the relief."""
    size = _window_pixels(grid, rules)
    rows, columns = (n // size for n in grid.shape)
    if isinstance(relief, MaskAperture):
        inside = relief.inside(grid)[: rows * size, : columns * size]
        return np.logical_and.reduce(inside.reshape(rows, size, columns, size), axis=(1, 3))
    # Of a disc or a rectangle every quadrant is alike, and holds a window whose farthest corner it holds.
    y, x = (
        np.maximum(abs(axis[: n * size : size]), abs(axis[size - 1 : n * size : size]))
        for axis, n in zip((grid.axis_m("y"), grid.axis_m("x")), (rows, columns), strict=True)
    )
    return relief.contains(y[:, None], x[None, :])


def _densities(
    words: bits.Words, grid: Grid, whole: NDArray[np.bool_], rules: Rules, area: int
) -> tuple[float, float, float]:
    """Return the density of the aperture and of its emptiest and fullest window."""
    overall = bits.count(words) / area if area else 0.0
    size = _window_pixels(grid, rules)
    inside = bits.windows(words, grid.shape[1], size)[whole] / size**2
    return (overall, float(inside.min()), float(inside.max())) if inside.size else (overall, overall, overall)


def _check_plane(
    words: bits.Words, bit: int, rules: Rules, grid: Grid, whole: NDArray[np.bool_], area: int
) -> PlaneRules:
    pitch, (ny, nx) = grid.pitch_m, grid.shape
    corner = (nx / 2, ny / 2)
    places: list[Violation] = []

    def place(what: Kind, x: float, y: float, size: float, length: float) -> Violation:
        lengths = ((y - corner[1]) * pitch, (x - corner[0]) * pitch, size * pitch, length * pitch)
        return Violation(what, *map(_metres, lengths))

    bounded = [count_bounded(words, axis) for axis in (0, 1)]
    widths = []
    kinds: tuple[tuple[Kind, float, np.uint64], ...] = (
        ("line", rules.minimum_line_m, bits.NONE),
        ("space", rules.minimum_space_m, bits.ALL),
    )
    for index, (what, minimum_m, outside) in enumerate(kinds):
        plane = words if what == "line" else ~words
        fewest = fewest_pixels(minimum_m, pitch)
        sliver = fewest_pixels(_SLIVER_LENGTH * minimum_m, pitch)
        found = x_found, y_found = [narrow_runs(plane, axis, outside, fewest, sliver) for axis in (1, 0)]
        places += [place(what, x + w / 2, y + n / 2, w, n) for y, x, w, n in x_found.places]
        places += [place(what, x + n / 2, y + w / 2, w, n) for y, x, w, n in y_found.places]
        runs = sum(pair[index] for pair in bounded)
        smallest = min((f.smallest for f in found if f.smallest is not None), default=None)
        if smallest is None and runs:
            smallest = shortest(plane, outside, fewest)
        widths.append(
            Widths(
                minimum_m,
                None if smallest is None else _metres(smallest * pitch),
                sum(f.narrow for f in found),
                sum(f.runs for f in found) / max(runs, 1),
                sum(f.slivers for f in found),
            )
        )
    kissing = np.empty_like(words)
    kisses = bits.corners(words, kissing)
    if kisses and (rules.minimum_line_m or rules.minimum_space_m):
        listed = bits.longest_runs(kissing, kissing, 1, _MOST_PER_KIND, _MOST_PER_KIND).tolist()
        places += [place("kissing corner", x + 1, y + 1, 0, 0) for y, x, _ in listed]
    places.sort(key=lambda p: (p.size_m, -p.length_m, p.y_m, p.x_m))
    line, space = widths
    density = _densities(words, grid, whole, rules, area)
    return PlaneRules(bit, line, space, int(kisses), *density, tuple(places[:_MOST_PLACES]))


def check(level_map: LevelMap, process: Process | Rules | str) -> RulesReport:
    """Check every etch mask of a level map.

    Args:
        level_map: the DOE; outside its relief nothing is etched.
        process: rules; or a process, or the name of a stock process, whose narrowest line and space are the rules.

    Raises:
        InputError: no level map, a process of another staircase, or one of an unknown name.
    """
    require_kind("level_map", level_map, LevelMap, "A design has one: design.level_map.")
    levels = level_map.levels
    rules = process if isinstance(process, Rules) else Rules.from_process(process_from(process, levels))
    grid, relief = level_map.grid, level_map.relief
    area, whole = relief.count_inside(grid), _whole_windows(grid, relief, rules)
    words = bits.pack(level_map.level, levels.count)
    with ThreadPoolExecutor() as pool:
        tasks = [pool.submit(_check_plane, w, k, rules, grid, whole, area) for k, w in enumerate(words)]
        planes = tuple(task.result() for task in tasks)
    return RulesReport(level_map, rules, planes, _off_grid(grid, rules))
