"""The table [area]: a part of the sensor that a DOE should light, and the rules for it."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from doedesign.spec.targets.beside import beside_problems
from doedesign.spec.values import PLACE, SIZE, ColourName, NotNegative, length, nearest, place
from doedesign.spec.values.table import SpecTable, optional, toml_key
from fab.errors import InputError
from fab.units import DEGREES, MICROMETRES, UM, format_length
from sim.lens import sines_at

if TYPE_CHECKING:
    from doedesign.spec.models import Spec

Place = Annotated[float, place(-1.0, 1.0)]
Size = Annotated[float, place(0.1 * UM, 1.0, SIZE)]
FLAT_PHASE = "flat"
WITHIN_THE_AREA = "within the area"  # said of a 0th order that is wanted
Shape = Literal["rectangle", "ellipse", "ring", "line", "picture"]


class AreaSpec(SpecTable, frozen=True):
    """An area to be lit, instead of objectives. There may be several, as [[area]].

    Places and sizes are lengths on the sensor; without one, with `sensor.pixel_angle`, they are angles, and held as
    direction sines: `width_m`, `height_m` and `inner_m` as twice the sine of half the angle, the others as its sine.

    Attributes:
        shape: "rectangle" and "ellipse" (`width` and `height`), "ring" (`width`, `inner`), "line" (`width` along x, or
            `height` along y; as thin as light can be) or "picture" (`picture` and `width`).
        width_m: size along x on the sensor, where the light should have half its value inside.
        height_m: size along y; of rectangles and ellipses the width if left out.
        inner_m: inner diameter of a ring.
        edge_m: distance over which light should fall from 90 to 13.5 % of its value inside; by default the radius of
            the focus of a Gaussian beam, as wide as it is on the DOE, 2 wavelength x focal length / aperture for other
            light.
        picture: a file with the light to be drawn, relative to the spec file: PNG, TIFF or JPEG, in the usual sRGB.
        phase: of the light of the area, free if left out: "flat", or a file with a grey picture of it over the area,
            black for 0 and white for one turn less a step of its greys, relative to the spec file: PNG or TIFF. It is
            that of the plane waves which draw the area, in the middle of the DOE and but for a common phase; a lens
            whose front focal plane is the DOE shows it on the area.
        offset_m: [x, y] by which the area is moved on the sensor.
        dark_m: width of a frame around the area in which light counts against evenness, too.
        uniformity: how much of the efficiency evenness is worth: the share of light on the area less so many times
            its contrast, standard deviation over mean, is made as large as it can be. 0 is for light alone.
        start: "transport" carries the beam to the area as rays would: without speckle, for the beam that is described
            and where it is aimed at the DOE. "random" mixes the light of all its parts: with speckle, for any beam.
            Areas in several planes keep their shapes better from "random". A given phase tells the first one, unless
            "random" is asked for.
        colour: the colour channel that should light it, by name; the first if left out.
        distance_m: where it lies, from the lens, or from the DOE without one; on the sensor if left out.
    """

    angles: ClassVar = {
        **dict.fromkeys(("width_m", "height_m", "inner_m"), SIZE),
        **dict.fromkeys(("edge_m", "offset_m", "dark_m"), PLACE),
    }

    shape: Shape = Field(examples=['"rectangle"'])
    width_m: Size | None = optional(example='"330 um"')
    height_m: Size | None = optional(example='"120 um"')
    inner_m: Size | None = optional(example='"200 um"')
    edge_m: Annotated[float, place(0.1 * UM, 1.0)] | None = optional(example='"20 um"')
    picture: str | None = optional(example='"logo.png"')
    phase: Annotated[str, Field(min_length=1)] | None = optional(example='"flat"')
    offset_m: tuple[Place, Place] = optional((0.0, 0.0))
    dark_m: Annotated[float, place(0.0, 1.0)] = optional(0.0)
    uniformity: NotNegative = optional(1.0)
    start: Literal["transport", "random"] = optional("transport")
    colour: ColourName | None = optional(example='"green"')
    distance_m: Annotated[float, length(10 * UM, 100.0)] | None = optional(example='"50 mm"')

    @property
    def size_m(self) -> tuple[float, float]:
        """Size (y, x) on the sensor, 0 across a line."""
        width, height = self.width_m or 0.0, self.height_m or 0.0
        if self.shape == "line":
            return height, width
        return height or width, width

    @property
    def phase_picture(self) -> str | None:
        """The file with the phase; None without one."""
        return None if self.phase in (None, FLAT_PHASE) else self.phase


_SHAPING = ("width_m", "height_m", "inner_m", "picture")
# Keys that each shape needs, and those that it may have besides.
_KEYS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "rectangle": (("width_m",), ("height_m",)),
    "ellipse": (("width_m",), ("height_m",)),
    "ring": (("width_m", "inner_m"), ()),
    "line": ((), ("width_m", "height_m")),
    "picture": (("picture", "width_m"), ()),
}
_ROOM = 1.15  # how much farther than its area light is looked at


def area_problems(spec: "Spec") -> Iterator[InputError]:
    """Return every rule that the areas of a spec break."""
    if not spec.areas:
        return
    if spec.spots is not None:
        yield InputError("area", "takes the place of spots", "both", "Remove [area] or [spots].")
    yield from beside_problems(spec, "area")
    for index, area in enumerate(spec.areas):
        yield from _problems(spec, area, spec.area_key(index))
    starts = {area.start for area in spec.areas}
    if len(starts) > 1:
        yield InputError("area[0].start", "all areas have one start", "several", "Write the same in each.")


def _problems(spec: "Spec", area: Any, key: str) -> Iterator[InputError]:
    """Rules that one area breaks."""
    needed, allowed = _KEYS[area.shape]
    complete = True
    for name in needed:
        if getattr(area, name) is None:
            complete = False
            cure = f"Add `{toml_key(name)}`, or choose another shape."
            yield InputError(f"{key}.{toml_key(name)}", f'shape "{area.shape}" needs it', "nothing", cure)
    for name in _SHAPING:
        if getattr(area, name) is not None and name not in (*needed, *allowed):
            rule = f'shape "{area.shape}" takes: {", ".join(map(toml_key, (*needed, *allowed)))}'
            yield InputError(f"{key}.{toml_key(name)}", rule, toml_key(name), "Remove it.")
    if area.shape == "line" and (area.width_m is None) == (area.height_m is None):
        complete = False
        yield InputError(key, "a line has a width or a height", "both or none", "Give one of them.")
    if area.shape == "ring" and complete and area.inner_m >= area.width_m:
        width, inner = (_size_text(spec, size) for size in (area.width_m, area.inner_m))
        rule = f"must be smaller than the width, {width}"
        yield InputError(f"{key}.inner", rule, inner, "Choose a smaller one.")
    colours = {colour.name: colour.wavelengths_m[0] for colour in spec.optics.colours}
    if area.colour is not None and area.colour not in colours:
        rule, cure = "must be a colour channel of the spec", nearest(area.colour, colours)
        yield InputError(f"{key}.colour", rule, f'"{area.colour}"', cure)
    elif complete:
        first = spec.optics.colours[0].name
        yield from _reach(spec, area, key, colours[area.colour or first])
    if area.phase is not None and spec.illumination is not None and any(m != 1 for m in spec.illumination.m_squared):
        rule, cure = "light of several modes has no phase", "Leave it out, or leave out illumination.m_squared."
        yield InputError(f"{key}.phase", rule, f'"{area.phase}"', cure)
    focal = spec.optics.focal_length_m
    if area.distance_m is not None and spec.sensor.in_angles:
        rule, cure = "light by its direction lies in no plane", "Leave it out, or give a lens or sensor.distance."
        yield InputError(f"{key}.distance", rule, format_length(area.distance_m), cure)
    if area.distance_m is not None and focal is not None and area.distance_m <= focal / 2:
        rule = f"must be beyond half the focal length, {format_length(focal)}"
        yield InputError(f"{key}.distance", rule, format_length(area.distance_m), "Choose a larger one.")


def _reach(spec: "Spec", area: Any, key: str, wavelength: float) -> Iterator[InputError]:
    """The rule that the DOE's cells can send light to every corner of an area."""
    optics, pitch, distance = spec.optics, spec.doe.pitch_m, area.distance_m or spec.image_distance_m
    most = wavelength / (2 * pitch)
    half = [size / 2 + area.dark_m for size in area.size_m]
    y, x = (abs(at) + reach for at, reach in zip(area.offset_m[::-1], half, strict=True))
    sines = sines_at(optics.mapping, optics.distortion, y / distance, x / distance)
    sine = max(abs(at) + abs(moved) for at, moved in zip(sines, spec.moved_sines, strict=True))
    if sine * _ROOM > most:
        unit = spec.told_in(MICROMETRES)
        end, got = (f"{unit.of(at):.4g} {unit.suffix}" for at in (most * distance / _ROOM, max(y, x)))
        rule = f"cells of {format_length(pitch)} light places up to {end} from the axis"
        finer = format_length(float(f"{wavelength / (2 * sine * _ROOM):.4g}"))
        cure = f"Choose a smaller area, or a pitch of at most {finer}."
        yield InputError(key, rule, got, cure)


def _size_text(spec: "Spec", size_m: float) -> str:
    return f"{DEGREES.size(size_m):.12g} deg" if spec.sensor.in_angles else format_length(size_m)
