"""The table [focus]: distances behind a DOE without a lens at which light should come to a focus, and how small."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from doedesign.spec.targets.beside import beside_problems
from doedesign.spec.values import Positive, length
from doedesign.spec.values.table import SpecTable, optional
from fab.errors import InputError
from fab.units import UM, format_length

if TYPE_CHECKING:
    from doedesign.spec.models import Spec

Distance = Annotated[float, length(10 * UM, 1000.0)]
Width = Annotated[float, length(0.1 * UM, 1.0)]
AIRY_WIDTH = 1.029  # full width at half maximum of an Airy disc, wavelength x distance / aperture


class FocusSpec(SpecTable, frozen=True):
    """One or more foci on the axis, instead of objectives. The DOE is made of rings.

    Attributes:
        distances_m: distances behind the DOE.
        through: whether light should be in focus all the way from the first to the last of two distances: an extended
            depth of focus. Otherwise each is a focus of its own: one is a lens, two are a bifocal lens.
        widths_m: for each distance the full width at half maximum that the focus should have at most; between two it
            grows as a power of the distance. By default 1.15 times those of an ideal lens, 1.03 wavelength x distance /
            aperture: too little for a beam that does not fill the aperture, which has foci of its own width.
        weights: how much each distance counts, if not all alike. The logarithm of the light on the axis is weighted, so
            that twice the weight is about twice the light.
        colours: names of the colours for which the distances are, one each, if not all colours for every distance.
    """

    distances_m: tuple[Distance, ...] = Field(min_length=1, examples=['["5 mm", "1200 mm"]'])
    through: bool = optional(False)
    widths_m: tuple[Width, ...] | None = optional(example='["6.6 um", "524 um"]')
    weights: tuple[Positive, ...] | None = optional(example="[1.0, 2.0]")
    colours: tuple[str, ...] | None = optional(example='["red", "green"]')


def focus_problems(spec: "Spec") -> Iterator[InputError]:
    """Return every rule that the foci of a spec break."""
    focus: Any = spec.focus
    if focus is None:
        return
    count = len(focus.distances_m)
    for name, values in (("widths", focus.widths_m), ("weights", focus.weights), ("colours", focus.colours)):
        if values is not None and len(values) != count:
            cure = f"Give {count}, or leave it out."
            yield InputError(f"focus.{name}", f"must be one for each of the {count} distances", f"{len(values)}", cure)
    if focus.through and (count != 2 or focus.distances_m[0] >= focus.distances_m[1]):
        rule, got = "a focus all the way has two distances, the nearer first", f"{count}"
        yield InputError("focus.distances", rule, got, 'Give two, such as ["5 mm", "1200 mm"].')
    for name in ("weights", "colours"):
        if focus.through and getattr(focus, name) is not None:
            rule = "a focus all the way is for all distances and colours alike"
            yield InputError(f"focus.{name}", rule, name, "Remove it, or through.")
    if not isinstance(spec.doe.aperture_m, float):
        rule, cure = "foci are made by rings, which fill a round aperture", 'Give its diameter, such as "2 mm".'
        yield InputError("doe.aperture", rule, str(spec.doe.relief), cure)
        return
    known = [colour.name for colour in spec.optics.colours]
    for index, name in enumerate(focus.colours or ()):
        if name not in known:
            cure = f"Choose one of {', '.join(known)}."
            yield InputError(f"focus.colours[{index}]", "must be a colour of the spec", f'"{name}"', cure)
    for table, given in (("spots", spec.spots is not None), ("area", bool(spec.areas))):
        if given:
            yield InputError("focus", f"takes the place of {table}", "both", f"Remove [focus] or [{table}].")
    if spec.sensor.distance_m is None:
        other, got = ("sensor.pixel_angle", "angles") if spec.sensor.in_angles else ("optics.focal_length", "a lens")
        cure = f"Give sensor.distance and sensor.pitch instead of {other}."
        yield InputError("sensor.distance", "foci lie behind a DOE without a lens", got, cure)
    yield from _alike(focus)
    yield from beside_problems(spec, "focus")
    yield from _beam(spec)
    yield from _reach(spec)


def _alike(focus: FocusSpec) -> Iterator[InputError]:
    """The rule that no focus is given twice: each would count the light of both as its own."""
    if focus.through:
        return
    colours = focus.colours or ("",) * len(focus.distances_m)
    foci = list(zip(focus.distances_m, colours, strict=False))
    for index, (distance, colour) in enumerate(foci):
        if (distance, colour) in foci[:index]:
            rule = "foci of one colour must differ: each would count the other's light as its own"
            cure = "Remove one; for more light in it, raise its number in focus.weights."
            yield InputError(f"focus.distances[{index}]", rule, f"{format_length(distance)} twice", cure)


def _beam(spec: "Spec") -> Iterator[InputError]:
    """The rule that the beam is a single wave along the axis: light of any other has no focus there."""
    beam = spec.illumination
    if beam is None:
        return
    if any(value != 1.0 for value in beam.m_squared):
        cure = "Leave it out, and look at the finished design in the real beam."
        yield InputError("illumination.m_squared", "foci are designed for a single mode", f"{beam.m_squared}", cure)
    for name, places in (("centre", beam.centre_m), ("angle", beam.angles_rad), ("tilt", beam.tilt_rad)):
        if any(places):
            yield InputError(f"illumination.{name}", "foci lie on the axis of the beam", "beside it", "Leave it out.")


def _reach(spec: "Spec") -> Iterator[InputError]:
    """The rule that the rings can send light to a focus as small as is wanted."""
    focus: Any = spec.focus
    shortest = min(wavelength for colour in spec.optics.colours for wavelength in colour.wavelengths_m)
    least = AIRY_WIDTH * 2 * spec.doe.pitch_m  # of sines up to wavelength / (2 pitch)
    for index, width in enumerate(focus.widths_m or ()):
        if width < least:
            rule = f"rings of {format_length(spec.doe.pitch_m)} focus light to {least / UM:.3g} um at least"
            cure = f"Choose a wider one, or a pitch of at most {width / 2 / AIRY_WIDTH / UM:.3g} um."
            yield InputError(f"focus.widths[{index}]", rule, format_length(width), cure)
        # An aperture of which only a ring is lit has a focus of 0.7 of an Airy disc's width, and much light beside it.
        if index < len(focus.distances_m):
            distance = focus.distances_m[index]
            thinnest = 0.7 * AIRY_WIDTH * shortest * distance / spec.doe.relief.widest_m
            if width < thinnest:
                rule = f"this aperture focuses light to {thinnest / UM:.3g} um at least at {format_length(distance)}"
                cure = "Choose a wider one, or a larger aperture."
                yield InputError(f"focus.widths[{index}]", rule, format_length(width), cure)
