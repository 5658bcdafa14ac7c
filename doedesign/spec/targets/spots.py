"""The table [spots]: where a DOE should send its light, spot by spot; its rules, and what may stand beside it."""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field, field_validator

from doedesign.spec.targets.arrangements import grid_orders, hexagonal_places, ring_places
from doedesign.spec.targets.beside import beside_problems, in_focus
from doedesign.spec.values import (
    PLACE,
    ColourName,
    Count,
    NotNegative,
    Positive,
    bounded,
    broken,
    length,
    nearest,
    place,
)
from doedesign.spec.values.table import SpecTable, optional, toml_key
from fab.aperture import MaskAperture, RoundAperture
from fab.errors import InputError
from fab.grid import Grid
from fab.units import MICROMETRES, MM, NM, UM, format_length
from sim.illumination import GaussianBeam
from sim.lens import sines_at

if TYPE_CHECKING:
    from doedesign.spec.models import Spec

Place = Annotated[float, place(-1.0, 1.0)]
Separation = Annotated[float, place(0.1 * UM, 1.0)]
Arrangement = Literal["grid", "hexagonal", "ring", "list"]


class SpotsSpec(SpecTable, frozen=True):
    """Spots to be drawn with light, instead of objectives.

    Places are lengths on the sensor; without one, with `sensor.pixel_angle`, they are angles, and held as direction
    sines: a `spacing` of an angle is a step of its sine, and spots of a grid are such steps apart.

    Attributes:
        arrangement: "grid" (`count` and `spacing`, or `count` and `period`), "hexagonal" (`rings` around a middle spot,
            `spacing`), "ring" (`number` on a circle of `radius`) or "list" (`places`).
        count: spots along x and along y. The orders of an even count are the odd ones.
        rings: hexagonal rings around the middle spot.
        number: spots on the circle.
        spacing_m: distance of neighbouring spots on the sensor, at least two spot widths, which are wavelength x focal
            length / aperture each; nearer ones would count each other's light as their own.
        radius_m: radius of the circle on the sensor.
        places_m: [x, y] of every spot on the sensor.
        period_m: side of a unit cell that is repeated over the DOE, a whole number of DOE cells; the spots are its
            diffraction orders, wavelength / period apart in direction sine.
        offset_m: [x, y] by which all spots are moved on the sensor, as far as they are not orders of a unit cell.
        weights: light of every spot over that of the others, equal if left out; a grid goes row by row from the lowest.
        phases_rad: phase of every spot's plane wave in the middle of the DOE, but for a common one; free if left out. A
            lens whose front focal plane is the DOE shows them in the spots.
        uniformity: how much of the efficiency a uniformity error (max - min) / (max + min) is worth; 0 is for light
            alone.
        uniformity_as_fabricated: the same of plates with the errors of the process, for a unit cell: cells are
            exchanged for spots that stay equal on these, in every colour (`doedesign.spots.plates`). 0 looks at the
            plate as drawn.
        starts: random starts of the search for the spots' phases, where these are free.
        colours: names of the colour channels that should get these spots, all alike; the first if left out. A relief of
            several waves parts colours better. Orders of a unit cell are the same for all, and so lie wavelength /
            period apart; other spots lie in the same places.
    """

    angles: ClassVar = dict.fromkeys(("spacing_m", "radius_m", "places_m", "offset_m"), PLACE)

    arrangement: Arrangement = "grid"
    count: tuple[Count, Count] | None = optional(example="[7, 7]")
    rings: Annotated[int, Field(strict=True, ge=1, le=50)] | None = optional(example="2")
    number: Annotated[int, Field(strict=True, ge=2, le=10_000)] | None = optional(example="8")
    spacing_m: Separation | None = optional(example='"250 um"')
    radius_m: Separation | None = optional(example='"1 mm"')
    places_m: tuple[tuple[Place, Place], ...] = optional((), example='[["0 mm", "1 mm"], ["0.5 mm", "-0.2 mm"]]')
    period_m: Annotated[float, length(0.02 * UM, 100 * MM)] | None = optional(example='"192 um"')
    offset_m: tuple[Place, Place] = optional((0.0, 0.0))
    weights: tuple[Positive, ...] = optional((), example="[1.0, 2.0, 1.0]")
    phases_rad: tuple[Annotated[float, bounded("rad", -2 * math.pi, 2 * math.pi)], ...] = optional(
        (), example='["0 deg", "90 deg", "0 deg"]'
    )
    uniformity: NotNegative = optional(1.0)
    uniformity_as_fabricated: NotNegative = optional(0.0)
    starts: Annotated[int, Field(strict=True, ge=1, le=100_000)] = optional(200)
    colours: tuple[ColourName, ...] = optional((), example='["638nm", "520nm"]')

    @field_validator("count")
    @classmethod
    def _few(cls, count: tuple[int, int] | None) -> tuple[int, int] | None:
        if count is not None and not 2 <= count[0] * count[1] <= 10_000:
            raise broken("must be 2 to 10000 spots together", "For example count = [5, 5].")
        return count

    @property
    def needed(self) -> tuple[str, ...]:
        """Attributes that the arrangement needs."""
        step = "spacing_m" if self.period_m is None else "period_m"
        return {
            "grid": ("count", step),
            "hexagonal": ("rings", "spacing_m"),
            "ring": ("number", "radius_m"),
            "list": ("places_m",),
        }[self.arrangement]

    @property
    def spot_count(self) -> int:
        """Number of spots, of a table whose needed attributes are there."""
        if self.arrangement == "grid":
            assert self.count is not None
            return self.count[0] * self.count[1]
        if self.arrangement == "hexagonal":
            assert self.rings is not None
            return 1 + 3 * self.rings * (self.rings + 1)
        return self.number or len(self.places_m)


_PLACING = ("count", "rings", "number", "spacing_m", "radius_m", "places_m", "period_m")
_FEWEST_CELLS = 4  # of a unit cell
MOST_CELLS = 2**16  # of a unit cell whose cells are exchanged one by one
_BEAM = "where the tilted beam goes straight on"
ONE_OF_THE_SPOTS = "one of the spots"  # said of a 0th order that is wanted
# Distance of spots in spot widths, wavelength / aperture in direction sine. The efficiency of a spot is the light in
# the plane wave that goes there, and two such waves share light on the aperture: sinc² of their distance if it is
# square, (2 J1(pi u) / (pi u))² if it is round. Half a width apart they share half of it, and designs reach totals of
# several times all light; one width apart it is 3 % for every neighbour, and totals reach 119 %. From two widths on it
# is 0.4 % at most, 1.7 % if square: designs of 2 to 81 spots stayed below all light, 99.8 % at most.
LEAST_WIDTHS = 2.0
# Where spots of an arrangement that are too close are mended.
_STEPS = {"grid": "spacing", "hexagonal": "spacing", "ring": "radius", "list": "places"}


def spot_problems(spec: "Spec") -> Iterator[InputError]:
    """Return every rule that the spots of a spec break."""
    if spec.spots is None:
        return
    complete = True
    for problem in _keys(spec):
        complete = False
        yield problem
    for problem in _colours(spec):
        complete = False
        yield problem
    yield from _as_fabricated(spec)
    yield from beside_problems(spec, "spots")
    yield from in_focus(spec)
    if complete:
        yield from _reach(spec)


def _keys(spec: "Spec") -> Iterator[InputError]:
    spots: Any = spec.spots
    for name in spots.needed:
        if not getattr(spots, name):
            cure = f"Add `{toml_key(name)}`, or choose another arrangement."
            yield InputError(f"spots.{toml_key(name)}", f'arrangement "{spots.arrangement}" needs it', "nothing", cure)
    for name in _PLACING:
        if getattr(spots, name) and name not in spots.needed:
            rule = f'arrangement "{spots.arrangement}" takes: {", ".join(map(toml_key, spots.needed))}'
            yield InputError(f"spots.{toml_key(name)}", rule, toml_key(name), "Remove it.")
    if spots.period_m is not None and any(spots.offset_m):
        yield InputError("spots.offset", "orders of a unit cell cannot be moved", "an offset", "Remove it.")


def _colours(spec: "Spec") -> Iterator[InputError]:
    """Rules of the colours that should get spots."""
    spots: Any = spec.spots
    known = [colour.name for colour in spec.optics.colours]
    for name in spots.colours:
        if name not in known:
            rule, cure = "must be colour channels of the spec", nearest(name, known)
            yield InputError("spots.colours", rule, f'"{name}"', cure)
    if len(set(spots.colours)) < len(spots.colours):
        yield InputError("spots.colours", "each colour is named once", "one twice", "Remove the second.")
    if len(spots.colours) > 1 and spots.phases_rad:
        rule, cure = "phases of spots of several colours must be free", "Leave it out, or name one colour."
        yield InputError("spots.phases", rule, "phases", cure)


def _wavelengths_m(spec: "Spec") -> list[float]:
    """Wavelengths that spots are designed for."""
    assert spec.spots is not None
    first = {colour.name: colour.wavelengths_m[0] for colour in spec.optics.colours}
    return [first[name] for name in spec.spots.colours] or [next(iter(first.values()))]


def _as_fabricated(spec: "Spec") -> Iterator[InputError]:
    """Rules of spots that stay equal on plates as fabricated."""
    spots: Any = spec.spots
    if not spots.uniformity_as_fabricated:
        return
    key = "spots.uniformity_as_fabricated"
    if spots.period_m is None or spots.count is None:
        yield InputError(key, "cells of a unit cell are exchanged", "no period", "Give spots.period, or leave it out.")
        return
    if spots.phases_rad:
        yield InputError(key, "phases of spots must be free", "spots.phases", "Leave one of them out.")
    side = round(spots.period_m / spec.doe.pitch_m)
    cells = side ** sum(count > 1 for count in spots.count)
    if cells > MOST_CELLS:
        rule = f"a unit cell must have at most {MOST_CELLS} cells"
        yield InputError(key, rule, f"{cells}", "Choose coarser cells or a shorter period, or leave it out.")


def _reach(spec: "Spec") -> Iterator[InputError]:
    """Rules of sizes, where all that places the spots is there."""
    spots: Any = spec.spots
    weights, count = len(spots.weights), spots.spot_count
    if weights not in (0, count):
        yield InputError("spots.weights", f"must be one per spot, {count}", f"{weights}", "Add or remove weights.")
    if len(spots.phases_rad) not in (0, count):
        got = f"{len(spots.phases_rad)}"
        yield InputError("spots.phases", f"must be one per spot, {count}", got, "Add or remove phases.")
    # The shortest wavelength is steered least.
    wavelength, pitch = min(_wavelengths_m(spec)), spec.doe.pitch_m
    most = wavelength / (2 * pitch)  # the direction sine at which a grating of two cells sends light
    if spots.period_m is not None:
        cells = spots.period_m / pitch
        if abs(cells - round(cells)) > 1e-6 or not _FEWEST_CELLS <= round(cells) <= min(spec.doe.shape):
            rule = f"must be a whole number of cells of {format_length(pitch)}, from {_FEWEST_CELLS} to doe.samples"
            cure = f'For example period = "{format_length(max(_FEWEST_CELLS, round(cells)) * pitch)}".'
            yield InputError("spots.period", rule, format_length(spots.period_m), cure)
        highest = max((n - 1) // 2 if n % 2 else n - 1 for n in spots.count)
        least = highest * wavelength / most
        if highest * wavelength / spots.period_m > most:
            rule = (
                f"cells of {format_length(pitch)} steer light to the order {int(spots.period_m / (2 * pitch))} at most"
            )
            cure = f"Choose a period of at least {least / UM:.4g} um, or finer cells."
            yield InputError("spots.period", rule, f"order {highest}", cure)
        yield from _whole_period(spec)
        return
    yield from _apart(spec)
    optics = spec.optics
    farthest, sine = 0.0, 0.0
    for y, x in corners(spots):
        share = (y / spec.image_distance_m, x / spec.image_distance_m)
        sines = sines_at(optics.mapping, optics.distortion, *share)
        sines = [at - moved for at, moved in zip(sines, spec.moved_sines, strict=True)]
        if max(map(abs, sines)) > sine:
            farthest, sine = max(abs(y), abs(x)), max(map(abs, sines))
    if sine > most:
        unit = spec.told_in(MICROMETRES)
        # Of a tilted beam, light goes as far from where the beam itself goes.
        axis, farthest = ("the axis", farthest) if not any(spec.moved_sines) else (_BEAM, sine * spec.image_distance_m)
        end, got = (f"{unit.of(at):.4g} {unit.suffix}" for at in (most * spec.image_distance_m, farthest))
        rule = f"cells of {format_length(pitch)} steer light {end} far at most"
        finer = format_length(math.floor(wavelength / (2 * sine) / NM) * NM)  # rounded up it would be too coarse
        cure = f"Bring the spots nearer to {axis}, or choose a pitch of at most {finer}."
        yield InputError("spots", rule, f"a spot {got} from {axis}", cure)


def _whole_period(spec: "Spec") -> Iterator[InputError]:
    """The rule that light passes one whole unit cell: of less than one, orders are too close to be told apart."""
    spots: Any = spec.spots
    opening = spec.doe.relief.shrunk(spec.process.chrome_overlap_m)
    sides = [side for side, count in zip(opening.extent_m, reversed(spots.count), strict=True) if count > 1]
    room, where = min(sides), "this aperture"
    if isinstance(opening, RoundAperture):
        room, where = room / math.sqrt(2), "the largest square in this aperture"
    if isinstance(opening, MaskAperture):
        side = round(spots.period_m / spec.doe.pitch_m)
        height, width = (side if count > 1 else 1 for count in reversed(spots.count))
        if not open_periods(opening.inside(Grid(spec.doe.shape, spec.doe.pitch_m)), (height, width)).any():
            rule = "the aperture must be open over one whole period at least, or orders count each other's light"
            cure = "Choose a shorter period or a wider opening. Check the unit."
            yield InputError("spots.period", rule, format_length(spots.period_m), cure)
        return
    # A cell of the DOE more or less is of no account.
    if spots.period_m >= room + spec.doe.pitch_m:
        rule = f"one period at least must fit into {where}, {room / UM:.4g} um, or orders count each other's light"
        cure = "Choose a shorter period or a larger aperture. Check the unit."
        yield InputError("spots.period", rule, format_length(spots.period_m), cure)


def open_periods(cells: Bool[np.ndarray, "y x"], period: tuple[int, int]) -> Bool[np.ndarray, "y x"]:
    """Which open cells lie in whole periods that are open; of all places that periods may begin at, the best one.

    Args:
        cells: which are open.
        period: cells (y, x) of one period.
    """
    (ny, nx), (height, width) = cells.shape, period
    if not (1 <= height <= ny and 1 <= width <= nx):
        return np.zeros((ny, nx), bool)
    sums = np.pad(cells.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    within = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    whole = np.zeros((-(-ny // height) * height, -(-nx // width) * width), bool)  # periods that begin at a cell
    whole[: ny - height + 1, : nx - width + 1] = within == height * width
    counts = whole.reshape(-1, height, whole.shape[1] // width, width).sum(axis=(0, 2))
    y, x = np.unravel_index(np.argmax(counts), counts.shape)
    found = np.zeros((whole.shape[0] + height, whole.shape[1] + width), bool)
    found[y : y + whole.shape[0], x : x + whole.shape[1]] = np.kron(whole[y::height, x::width], np.ones(period, bool))
    return found[:ny, :nx]


def _apart(spec: "Spec") -> Iterator[InputError]:
    """The rule that spots lie apart far enough for their efficiencies to be shares of the light (`LEAST_WIDTHS`).

    A grating sends every wavelength so many spot widths far; where places are given, the longest has the widest spots.
    """
    from scipy.spatial import KDTree  # not needed to read a spec without spots

    spots: Any = spec.spots
    wavelength, distance = max(_wavelengths_m(spec)), spec.image_distance_m
    places = places_of(spots) + np.array(spots.offset_m[::-1])
    sines = np.stack(sines_at(spec.optics.mapping, spec.optics.distortion, *(places / distance).T), axis=1)
    if not np.isfinite(sines).all():
        return  # without a lens, or beyond what it images, which is refused for itself
    widths = wavelength / np.array(_lit_m(spec, wavelength))
    apart, found = map(np.asarray, KDTree(sines / widths).query(sines / widths, k=2))
    one = int(np.argmin(apart[:, 1]))
    if apart[one, 1] >= LEAST_WIDTHS * (1 - 1e-6):
        return
    other = int(found[one, 1] if found[one, 1] != one else found[one, 0])
    between = float(np.hypot(*(places[one] - places[other])))
    # In their own direction, as far as they have one.
    least = LEAST_WIDTHS * (between / apart[one, 1] if between else float(widths.max()) * distance)
    key, unit = _STEPS[spots.arrangement], spec.told_in(MICROMETRES)
    size = "wavelength / aperture" if spec.sensor.in_angles else "wavelength x focal length / aperture"
    if spec.illumination is not None and spec.illumination.diameters_m:
        size = size.replace("aperture", "lit aperture")
    rule = (
        f"spots must be at least {_rounded_up(float(unit.of(least)))} {unit.suffix} apart, two spot widths ({size}): "
        "nearer ones count each other's light as their own"
    )
    got = f"{float(unit.of(between)):.4g} {unit.suffix}"
    if spots.arrangement == "list":
        got += f" between the places {min(one, other)} and {max(one, other)}"
    elif spots.arrangement == "ring":
        got += " between neighbours"
    cure = {"places": "Move or remove one of them", "radius": "Choose a larger radius, fewer spots"}
    cure = f"{cure.get(key, 'Choose a larger spacing')} or a larger aperture. Check the unit."
    yield InputError(f"spots.{key}", rule, got, cure)


def _rounded_up(value: float) -> str:
    """Three digits that are no less than a positive number."""
    step = 10.0 ** (math.floor(math.log10(value)) - 2)
    return f"{math.ceil(value / step - 1e-6) * step:.3g}"


def _lit_m(spec: "Spec", wavelength_m: float) -> tuple[float, float]:
    """Size (y, x) of what shapes a spot: the opening of the chrome, or a Gaussian beam that is smaller."""
    # An opening that is none is refused elsewhere.
    overlap, finest = spec.process.chrome_overlap_m, spec.doe.pitch_m
    y, x = (max(side, finest) for side in spec.doe.relief.shrunk(overlap).extent_m)
    light = spec.illumination
    if light is None or light.kind != "gaussian" or not light.diameters_m:
        return y, x
    radii = (light.diameters_m[-1] / 2, light.diameters_m[0] / 2)
    quality = (light.m_squared[-1], light.m_squared[0])
    beam_y, beam_x = GaussianBeam(radii, light.waist_distance_m, quality).diameters_m(wavelength_m)
    return min(y, beam_y), min(x, beam_x)


def places_of(spots: SpotsSpec) -> Float[np.ndarray, "m 2"]:
    """Places (y, x) of spots on the sensor about the middle of their arrangement, metres, or sines where there is none.

    Args:
        spots: a table that has what its arrangement needs, and no period.
    """
    if spots.arrangement == "list":
        return np.array([place[::-1] for place in spots.places_m])
    if spots.arrangement == "hexagonal":
        return hexagonal_places(spots.rings or 0, spots.spacing_m or 0.0)
    if spots.arrangement == "ring":
        return ring_places(spots.number or 0, spots.radius_m or 0.0)
    assert spots.count is not None
    # Orders of an even count are the odd ones.
    steps = [(spots.spacing_m or 0.0) / (1 if n % 2 else 2) for n in reversed(spots.count)]
    return grid_orders(spots.count) * np.array(steps)


def corners(spots: Any) -> Iterator[tuple[float, float]]:
    """Places (y, x), metres, that are as far out as any spot is."""
    across, up = spots.offset_m
    if spots.arrangement == "list":
        yield from ((y + up, x + across) for x, y in spots.places_m)
        return
    if spots.arrangement == "grid":
        half_x, half_y = ((n - 1) / 2 * spots.spacing_m for n in spots.count)
    else:
        half_x = half_y = spots.radius_m or spots.rings * spots.spacing_m
    yield from ((up + y, across + x) for y in (-half_y, half_y) for x in (-half_x, half_x))
