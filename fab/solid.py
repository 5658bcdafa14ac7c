"""The plate as a solid, for mechanics: STEP files in millimetres.

The origin is the centre of the clear aperture, the plane z = 0 the blank surface (the datum, on which the
relief is etched and the chrome lies), and the z axis the light axis. The glass lies below, the relief faces
+z. A file holds named parts: SUBSTRATE and CHROME are solids, DATUM_CLEAR_APERTURE is a disc without thickness
in the plane z = 0, to be referred to.

A radial design is exact: its rings are the faces of one revolved profile, flat tops and cylindrical walls, set into
the top of the substrate. Any other map belongs in a mesh; only a small window of one can be written here, as boxes.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fab.cells import Window, require_map
from fab.errors import InputError
from fab.grid import Grid
from fab.levels import Levels
from fab.polygons import rectangles
from fab.step import boxes, disc, outline, plate, revolved, write_step
from fab.units import NM, format_length

__all__ = [
    "ChromeRing",
    "Rings",
    "Substrate",
    "patch_step",
    "patch_volume_m3",
    "substrate_step",
    "substrate_volumes_m3",
]

_MOST_BOXES = 2000
_NO_MORE_BOXES = 20_000
# The kernel takes points 1e-7 mm apart for one; edges must be clearly longer.
_SHORTEST_M = 0.3 * NM
_SAME_M = 1e-3 * NM


@dataclass(frozen=True)
class Substrate:
    """The glass.

    Attributes:
        outline: ``"die"`` is a square, ``"wafer"`` a disc with a flat at -y.
        width_m: side of the square or diameter of the disc, metres.
        thickness_m: thickness, metres.
        flat_m: length of the wafer's flat, metres; 0 for none.
    """

    outline: Literal["die", "wafer"]
    width_m: float
    thickness_m: float
    flat_m: float = 0.0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            InputError: a length is not positive, or the flat does not fit the outline.
        """
        for name, value in (("width", self.width_m), ("thickness", self.thickness_m)):
            if not 0 < value < math.inf:
                raise InputError(
                    f"substrate {name}", "must be positive and finite", value, 'Give one such as "0.5 mm".'
                )
        most = self.width_m if self.outline == "wafer" else 0.0
        if self.flat_m and not 0 < self.flat_m < most:
            rule = "a flat must be shorter than the diameter of a wafer, and a die has none"
            raise InputError("substrate flat", rule, format_length(self.flat_m), "Choose 0 or a shorter one.")

    @property
    def inside_m(self) -> float:
        """Radius of the largest centred circle on the surface, metres."""
        return math.sqrt((self.width_m / 2) ** 2 - (self.flat_m / 2) ** 2)

    @property
    def area_m2(self) -> float:
        """Area of the surface, square metres."""
        if self.outline == "die":
            return self.width_m**2
        radius = self.width_m / 2
        half_angle = math.asin(self.flat_m / self.width_m)
        return math.pi * radius**2 - radius**2 * (half_angle - math.sin(half_angle) * math.cos(half_angle))


@dataclass(frozen=True)
class ChromeRing:
    """The chrome around the clear aperture.

    Attributes:
        inner_m: radius of the opening, metres.
        outer_m: outer radius, metres.
        thickness_m: thickness of the film, metres.
    """

    inner_m: float
    outer_m: float
    thickness_m: float = 100 * NM

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            InputError: the radii leave no ring, or the film has no thickness.
        """
        if not (0 < self.inner_m < self.outer_m < math.inf and _SHORTEST_M <= self.thickness_m < math.inf):
            got = ", ".join(format_length(v) for v in (self.inner_m, self.outer_m, self.thickness_m))
            rule = "inner radius, outer radius and thickness must be positive and make a ring"
            raise InputError("chrome", rule, got, "Check the three lengths.")

    @property
    def volume_m3(self) -> float:
        """Volume, cubic metres."""
        return math.pi * (self.outer_m + self.inner_m) * (self.outer_m - self.inner_m) * self.thickness_m


@dataclass(frozen=True, eq=False)
class Rings:
    """A radial relief: flat rings around the axis, the first one a disc.

    Attributes:
        outer_m: outer radius of every ring, metres, increasing, ``(n,)``.
        height_m: height of every ring above the deepest floor, metres, ``(n,)``.
        blank_m: height of the blank surface above the deepest floor, metres.
    """

    outer_m: NDArray[np.floating]
    height_m: NDArray[np.floating]
    blank_m: float

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            InputError: other shapes, radii that do not increase, heights off the glass, or a ring or a step
                too small for STEP's numbers (0.3 nm).
        """
        radii, heights = self.outer_m, self.height_m
        if radii.ndim != 1 or radii.shape != heights.shape or not radii.size:
            got = f"{radii.shape} and {heights.shape}"
            raise InputError("rings", "radii and heights must be two lists of one length", got, "Give both per ring.")
        if not np.all(np.diff(radii, prepend=0.0) >= _SHORTEST_M):
            cure = "Give increasing outer radii."
            raise InputError("rings", "every ring must be at least 0.3 nm wide", f"{radii.size} radii", cure)
        if not np.all((heights >= 0) & (heights <= self.blank_m + _SAME_M)):
            got = f"{heights.min():g} to {heights.max():g} m"
            rule = f"heights must lie from 0 to that of the blank surface, {format_length(self.blank_m)}"
            raise InputError("rings", rule, got, "Give heights above the deepest floor.")
        steps = np.abs(np.diff(heights, append=self.blank_m))
        if np.any((steps > _SAME_M) & (steps < _SHORTEST_M)):
            cure = "Quantise the heights first."
            raise InputError("rings", "every step must be 0 or at least 0.3 nm high", "a lower one", cure)

    @property
    def removed_m3(self) -> float:
        """Volume of the glass that is etched away, cubic metres."""
        inner = np.append(0.0, self.outer_m[:-1])
        areas = math.pi * (self.outer_m - inner) * (self.outer_m + inner)
        return math.fsum(areas * (self.blank_m - self.height_m))

    def profile_m(self) -> list[tuple[float, float]]:
        """Return the corners r, z of the relief's profile from the axis to its rim at z = 0, metres."""
        z = self.height_m - self.blank_m
        z = np.where(np.abs(z) <= _SAME_M, 0.0, z)
        corners = [(0.0, float(z[0]))]
        for radius, beyond in zip(self.outer_m, np.append(z[1:], 0.0), strict=True):
            if abs(beyond - corners[-1][1]) > _SAME_M:
                corners += [(float(radius), corners[-1][1]), (float(radius), float(beyond))]
        rim = float(self.outer_m[-1])
        return corners if corners[-1][0] == rim else [*corners, (rim, 0.0)]


def _require_fit(substrate: Substrate, aperture_m: float, chrome: ChromeRing | None, rings: Rings | None) -> None:
    # Chrome may reach the edge of the glass; the rim of the relief must leave some surface around it.
    most = {"clear aperture": (aperture_m / 2, 1 - 1e-6)}
    if chrome is not None:
        most["chrome"] = (chrome.outer_m, 1 + 1e-12)
    for name, (radius, share) in most.items():
        if not 0 < radius <= share * substrate.inside_m:
            got = f"a diameter of {format_length(2 * radius)}"
            rule = f"must lie inside the substrate's surface, a circle of {format_length(2 * substrate.inside_m)}"
            raise InputError(name, rule, got, "Choose a larger die or a smaller circle.")
    if rings is not None and not rings.outer_m[-1] <= aperture_m / 2 * (1 + 1e-9):
        got = f"{format_length(float(rings.outer_m[-1]))} of {format_length(aperture_m / 2)}"
        raise InputError("rings", "must lie inside the clear aperture", got, "Cut them at the aperture.")
    if rings is not None and not rings.blank_m < substrate.thickness_m:
        got = f"{format_length(rings.blank_m)} into {format_length(substrate.thickness_m)}"
        raise InputError("rings", "must be less deep than the substrate is thick", got, "Check the two lengths.")


def substrate_volumes_m3(
    substrate: Substrate, chrome: ChromeRing | None = None, rings: Rings | None = None
) -> dict[str, float]:
    """Return the volume of every solid that `substrate_step` writes, by closed form, cubic metres by name."""
    removed = rings.removed_m3 if rings is not None else 0.0
    volumes = {"SUBSTRATE": substrate.area_m2 * substrate.thickness_m - removed}
    return volumes | ({"CHROME": chrome.volume_m3} if chrome is not None else {})


def substrate_step(
    path: str | Path,
    substrate: Substrate,
    aperture_m: float,
    chrome: ChromeRing | None = None,
    rings: Rings | None = None,
) -> None:
    """Write the plate as STEP: glass, chrome and the clear aperture in the datum plane.

    Without rings the surface is flat, with the clear aperture as a face of its own.

    Args:
        path: the file.
        substrate: the glass.
        aperture_m: diameter of the clear aperture, metres.
        chrome: the chrome on it, if any. It lies flat at z = 0, also where it reaches over etched rings.
        rings: the relief, if it is radial.

    Raises:
        InputError: something does not fit, or the file cannot be written.
    """
    _require_fit(substrate, aperture_m, chrome, rings)
    profile = rings.profile_m() if rings is not None else [(0.0, 0.0), (aperture_m / 2, 0.0)]
    surface = outline(substrate.width_m, None if substrate.outline == "die" else substrate.flat_m)
    parts = {
        "SUBSTRATE": plate(surface, substrate.thickness_m, profile),
        "DATUM_CLEAR_APERTURE": disc(aperture_m / 2),
    }
    if chrome is not None:
        low, high = 0.0, chrome.thickness_m
        ring = [(chrome.inner_m, low), (chrome.outer_m, low), (chrome.outer_m, high), (chrome.inner_m, high)]
        parts["CHROME"] = revolved(ring, closed=True)
    write_step(path, "DOE", parts)


def patch_volume_m3(
    level_map: NDArray[np.integer], levels: Levels, grid: Grid, window: Window, base_m: float = 10e-6
) -> float:
    """Return the volume of the boxes that `patch_step` writes, cubic metres."""
    cut = window.cut(require_map(level_map, levels, grid))
    counts = np.bincount(cut.ravel(), minlength=levels.count)
    return math.fsum(counts * (levels.heights_m() + base_m)) * grid.pitch_m**2


def patch_step(
    path: str | Path,
    level_map: NDArray[np.integer],
    levels: Levels,
    grid: Grid,
    window: Window,
    base_m: float = 10e-6,
    most_boxes: int = _MOST_BOXES,
) -> None:
    """Write a window of a map as STEP: boxes side by side, one per rectangle of equal height.

    The part is named PATCH and lies where the window does. Its boxes touch and are not united: uniting takes
    minutes at the size that is allowed here, and a mesh is the better file for anything larger.

    Args:
        path: the file.
        level_map: level numbers ``[y, x]``.
        levels: the staircase.
        grid: the raster of the map.
        window: the pixels to write.
        base_m: glass below the deepest floor, metres.
        most_boxes: refuse windows that need more; at most 20000, which make a file of about 140 MB.

    Raises:
        InputError: too many boxes, a window off the map, or a file that cannot be written.
    """
    checked = require_map(level_map, levels, grid)
    window.require(grid)
    if not 0 < base_m < math.inf:
        raise InputError("patch base", "must be positive and finite", base_m, "Give the glass below the relief.")
    if not 1 <= most_boxes <= _NO_MORE_BOXES:
        rule = f"a STEP patch may be allowed 1 to {_NO_MORE_BOXES} boxes"
        raise InputError("patch", rule, most_boxes, "Write a mesh (3MF, STL) of a larger window.")
    cut = window.cut(checked)
    tops = {int(level): rectangles((cut == level).astype(np.uint8)) for level in np.unique(cut)}
    count = sum(len(found) for found in tops.values())
    if count > most_boxes:
        rule = f"a STEP patch may have at most {most_boxes} boxes (a file of about 7 kB each)"
        cure = "Choose a smaller window, allow more boxes, or write a mesh."
        raise InputError("patch", rule, f"{count} in {window.rows} x {window.columns} pixels", cure)
    x_m, y_m = window.edges_m(grid)
    z_m = levels.heights_m() - levels.heights_m().max()
    bottom = float(z_m.min()) - base_m
    corners = (
        (float(x_m[x0]), float(y_m[y0]), bottom, float(x_m[x1]), float(y_m[y1]), float(z_m[level]))
        for level, found in tops.items()
        for x0, y0, x1, y1 in found
    )
    write_step(path, "DOE_PATCH", {"PATCH": boxes(corners)})
