"""The plate as a solid, for mechanics: STEP files in millimetres.

The origin is the centre of the clear aperture, z = 0 the blank surface (the datum, on which the relief is etched and
the chrome lies), and the z axis the light axis. The glass lies below, the relief faces +z. A file holds named parts:
SUBSTRATE and CHROME are solids, DATUM_RELIEF is the relief's outline, filled and without thickness, in the plane z = 0,
to be referred to.

A radial design is exact: its rings are the faces of one revolved profile, flat tops and cylindrical walls, set into the
top of the substrate. Any other map belongs in a mesh; a small window of one can be STEP (`fab.solids.patch`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fab.aperture import Aperture, MaskAperture, RoundAperture, diameter_of
from fab.aperture.loops import Division, divided
from fab.errors import InputError
from fab.solids.step import (
    Body,
    Copies,
    disc,
    filled,
    framed,
    holed,
    marked_plate,
    opened,
    outline,
    plate,
    raised,
    revolved,
    slab,
    write_step,
)
from fab.units import NM, format_length

# The kernel takes points 1e-7 mm apart for one; edges must be clearly longer.
_SHORTEST_M = 0.3 * NM
_SAME_M = 1e-3 * NM


@dataclass(frozen=True)
class Substrate:
    """The glass, metres: a square "die", or a "wafer", a disc with a flat (0 for none) at -y.

    Raises:
        InputError: a length is not positive, or the flat does not fit the outline.
    """

    outline: Literal["die", "wafer"]
    width_m: float
    thickness_m: float
    flat_m: float = 0.0

    def __post_init__(self) -> None:
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

    def holds(self, x_m: float, y_m: float, chrome: "ChromeFilm") -> bool:
        """Whether the chrome of a die about x, y lies on the surface of a wafer."""
        half = chrome.half_m
        corner, side = math.hypot(abs(x_m) + half, abs(y_m) + half), math.hypot(x_m, y_m) + half
        farthest = corner if chrome.edge_m else side
        return farthest <= self.width_m / 2 * (1 + 1e-12) and half - y_m <= self.inside_m * (1 + 1e-12)

    @property
    def area_m2(self) -> float:
        """Area of the surface, square metres."""
        if self.outline == "die":
            return self.width_m**2
        radius = self.width_m / 2
        half_angle = math.asin(self.flat_m / self.width_m)
        return math.pi * radius**2 - radius**2 * (half_angle - math.sin(half_angle) * math.cos(half_angle))

    @property
    def body(self) -> Body:
        """The glass without relief; what the flat takes from a disc at -y moves its centre to +y."""
        y_m = (self.flat_m / 2) ** 3 * 2 / 3 / self.area_m2
        return Body(self.area_m2 * self.thickness_m, (0.0, y_m, -self.thickness_m / 2))


@dataclass(frozen=True)
class ChromeFilm:
    """Chrome around the clear aperture, metres: a ring, or all of a square die.

    Attributes:
        opening: its opening.
        outer_m: radius that it reaches to, also where a square goes on from there.
        thickness_m: thickness of the film.
        edge_m: edge of the square that it fills; 0 for a ring.
        bare_m: boxes x0, y0, x1, y1 of the square, beyond the radius, that have no chrome.

    Raises:
        InputError: the opening does not lie inside, or a length is not positive.
    """

    opening: Aperture
    outer_m: float
    thickness_m: float = 100 * NM
    edge_m: float = 0.0
    bare_m: tuple[tuple[float, float, float, float], ...] = ()

    def __post_init__(self) -> None:
        inside = self.opening.narrowest_m > 0 and self.opening.reach_m < self.outer_m < math.inf
        if not (inside and _SHORTEST_M <= self.thickness_m < math.inf):
            got = f"{self.opening}, {format_length(self.outer_m)}, {format_length(self.thickness_m)}"
            rule = "opening, outer radius and thickness must be positive and make a ring"
            raise InputError("chrome", rule, got, "Check the lengths.")

    @property
    def half_m(self) -> float:
        """Half the width of the film."""
        return self.edge_m / 2 or self.outer_m

    @property
    def body(self) -> Body:
        """The film around the opening, on z = 0."""
        y_m, x_m = self.opening.centroid_m
        gone = [(self.opening.area_m2, x_m, y_m)]
        gone += [((x1 - x0) * (y1 - y0), (x0 + x1) / 2, (y0 + y1) / 2) for x0, y0, x1, y1 in self.bare_m]
        area = self.edge_m**2 or math.pi * self.outer_m**2
        area -= math.fsum(part for part, _, _ in gone)
        if isinstance(self.opening, RoundAperture) and not self.edge_m:
            area = math.pi * (self.outer_m + self.opening.reach_m) * (self.outer_m - self.opening.reach_m)
        # What is taken from the film moves its centre away.
        x, y = ((0.0 - math.fsum(part[0] * part[axis] for part in gone)) / area for axis in (1, 2))
        return Body(area * self.thickness_m, (x, y, self.thickness_m / 2))

    def solid(self) -> Any:
        """The same as a shape of the kernel."""
        low, high = 0.0, self.thickness_m
        if self.edge_m:
            windows = [filled([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]) for x0, y0, x1, y1 in self.bare_m]
            surface = holed(outline(self.edge_m, None), windows)
            if isinstance(self.opening, RoundAperture):
                return raised(holed(surface, [outline(2 * self.opening.reach_m, 0.0)]), high)
            return framed(surface, division_of(self.opening), high)
        if not isinstance(self.opening, RoundAperture):
            return framed(outline(2 * self.outer_m, 0.0), division_of(self.opening), high)
        inner_m = self.opening.reach_m
        corners = [(inner_m, low), (self.outer_m, low), (self.outer_m, high), (inner_m, high)]
        return revolved(corners, closed=True)


@dataclass(frozen=True, eq=False)
class Rings:
    """A radial relief: flat rings around the axis, the first one a disc; metres.

    Outer radii increase; heights, and that of the blank surface, are above the deepest floor.

    Raises:
        InputError: other shapes, radii that do not increase, heights off the glass, or a ring or a step too small for
            STEP's numbers (0.3 nm).
    """

    outer_m: NDArray[np.floating]
    height_m: NDArray[np.floating]
    blank_m: float

    def __post_init__(self) -> None:
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
    def removed(self) -> Body:
        """The glass that is etched away."""
        inner = np.append(0.0, self.outer_m[:-1])
        depths = self.blank_m - self.height_m
        volumes = math.pi * (self.outer_m - inner) * (self.outer_m + inner) * depths
        volume = math.fsum(volumes)
        return Body(volume, (0.0, 0.0, -math.fsum(volumes * depths) / 2 / volume if volume else 0.0))

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


def _require_fit(substrate: Substrate, relief: Aperture, chrome: ChromeFilm | None, rings: Rings | None) -> None:
    # Chrome may reach the edge of the glass; the rim of the relief must leave some surface around it.
    most = {"relief": (relief.reach_m, 1 - 1e-6)}
    if chrome is not None:
        most["chrome"] = (chrome.half_m, 1 + 1e-12)
    for name, (radius, share) in most.items():
        if not 0 < radius <= share * substrate.inside_m:
            got = f"a diameter of {format_length(2 * radius)}"
            rule = f"must lie inside the substrate's surface, a circle of {format_length(2 * substrate.inside_m)}"
            raise InputError(name, rule, got, "Choose a larger die or a smaller circle.")
    if rings is not None and not rings.outer_m[-1] <= diameter_of(relief) / 2 * (1 + 1e-9):
        got = f"{format_length(float(rings.outer_m[-1]))} of {format_length(relief.reach_m)}"
        raise InputError("rings", "must lie inside the relief", got, "Cut them at its edge.")
    if rings is not None and not rings.blank_m < substrate.thickness_m:
        got = f"{format_length(rings.blank_m)} into {format_length(substrate.thickness_m)}"
        raise InputError("rings", "must be less deep than the substrate is thick", got, "Check the two lengths.")


def substrate_bodies(
    substrate: Substrate, chrome: ChromeFilm | None = None, rings: Rings | None = None
) -> dict[str, Body]:
    """Return volume and centre of every solid that `substrate_step` writes, by closed form and name."""
    glass = substrate.body
    if rings is not None:
        gone = rings.removed
        volume = glass.volume_m3 - gone.volume_m3
        x, y, z = (
            (whole * glass.volume_m3 - part * gone.volume_m3) / volume
            for whole, part in zip(glass.centre_m, gone.centre_m, strict=True)
        )
        glass = Body(volume, (x, y, z))
    return {"SUBSTRATE": glass, **({"CHROME": chrome.body} if chrome is not None else {})}


def substrate_step(
    path: str | Path,
    substrate: Substrate,
    relief: Aperture,
    chrome: ChromeFilm | None = None,
    rings: Rings | None = None,
) -> None:
    """Write the plate as STEP: glass, chrome and the place of the relief in the datum plane.

    Without rings the surface is flat, with the relief as a face of its own. The chrome lies flat at z = 0, also where
    it reaches over etched rings.
    """
    _require_fit(substrate, relief, chrome, rings)
    surface = outline(substrate.width_m, None if substrate.outline == "die" else substrate.flat_m)
    if isinstance(relief, RoundAperture):
        profile = rings.profile_m() if rings is not None else [(0.0, 0.0), (relief.reach_m, 0.0)]
        glass = plate(surface, substrate.thickness_m, profile)
    else:
        glass = marked_plate(surface, substrate.thickness_m, division_of(relief))
    parts = {"SUBSTRATE": glass, "DATUM_RELIEF": _face(relief)}
    if chrome is not None:
        parts["CHROME"] = chrome.solid()
    write_step(path, "DOE", parts)


def _face(relief: Aperture) -> Any:
    """The outline of a relief, filled, as a shape of the kernel."""
    return disc(relief.reach_m) if isinstance(relief, RoundAperture) else opened(division_of(relief))


def division_of(aperture: Aperture) -> Division:
    """Return the parts into which an aperture that is not round divides a plane, metres."""
    if isinstance(aperture, MaskAperture):
        y, x, cells = aperture.area
        return divided(aperture.outlines_m(0), y * aperture.pitch_m, x * aperture.pitch_m, cells)
    return Division(aperture.outlines_m(0), [(0, [])], [(None, [0])])


def wafer_bodies(wafer: Substrate, chrome: ChromeFilm, places_m: Sequence[tuple[float, float]]) -> dict[str, Body]:
    """Return volume and centre of every solid that `wafer_step` writes, by closed form and name."""
    x, y = (math.fsum(axis) / len(places_m) for axis in zip(*places_m, strict=True))
    one = chrome.body
    centre = (x + one.centre_m[0], y + one.centre_m[1], one.centre_m[2])
    return {"SUBSTRATE": wafer.body, "CHROME": Body(len(places_m) * one.volume_m3, centre)}


def wafer_step(
    path: str | Path, wafer: Substrate, relief: Aperture, chrome: ChromeFilm, places_m: Sequence[tuple[float, float]]
) -> None:
    """Write a wafer as STEP: flat glass; chrome and place of the relief of every die about its middle x, y, metres."""
    for x, y in places_m:
        if not wafer.holds(x, y, chrome):
            got = f"a chrome of {format_length(2 * chrome.half_m)} at {format_length(x)}, {format_length(y)}"
            raise InputError("wafer", "the dies must lie on it", got, "Take fewer dies, or a larger wafer.")
    parts = {
        "SUBSTRATE": slab(outline(wafer.width_m, wafer.flat_m), wafer.thickness_m),
        "DATUM_RELIEF": Copies(_face(relief), places_m),
        "CHROME": Copies(chrome.solid(), places_m),
    }
    write_step(path, "WAFER", parts)
