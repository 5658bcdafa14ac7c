"""Types of the values in a spec, each with its range and the message for a value outside it.

In TOML a length is text with a unit ("1.85 um"); in Python and JSON it is a number of metres, and likewise for angles.
The validation context tells which of the two is read: `FROM_TOML`, or none for numbers.
"""

import json
import math
import re
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Annotated, Any, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, ValidationInfo
from pydantic_core import PydanticCustomError

from fab.units import MM, NM, UM, format_angle, format_length, parse_angle, parse_length

# Contexts of validation: of TOML files, and of those whose places are angles.
FROM_TOML, IN_ANGLES = "toml", "toml in angles"
HEIGHT_FILES = (".exr", ".npy", ".tif", ".tiff", ".png")
BEAM_FILES = (".png", ".tif", ".tiff")


# The built-in objectives, each a function of the same name in `doedesign.design.objectives`, and those of them that
# need a near depth in the scene.
OBJECTIVES = (
    "far_spot",
    "near_spread",
    "ring_to_disc",
    "window_loss",
    "spot_energy",
    "equal_colours",
    "window_share",
    "handcrafted",
    "target_pattern",
    "filtered_error",
)
# The ways to round in the loop (`doedesign.design.levels.quantisation`) that draw levels at random.
RANDOM_QUANTISATIONS = ("gumbel", "stochastic")
NEAR_OBJECTIVES = ("near_spread", "ring_to_disc", "handcrafted")
# Those that have one answer for all depths, and look at all of them in every step.
DEPTHS_OBJECTIVES = ("filtered_error",)

# The built-in starts with their options; each is a function of the same name in `doedesign.design.starts`.
STARTS = {
    "flat": (),
    "random": ("feature",),
    "fresnel": ("focal_length", "evaluations"),
    "ring": ("far_energy", "height", "duty", "period", "roughness"),
    "nlopt": ("algorithm", "evaluations", "roughness"),
    "axicon": ("angle",),
    "vortex": ("charge",),
    "blazed": ("period", "azimuth"),
    "lens_array": ("pitch", "focal_length"),
    "cubic": ("waves",),
    "quartic": ("waves",),
    "axilens": ("near", "far"),
    "logarithmic_asphere": ("near", "far"),
}


def is_start(name: str) -> bool:
    """Whether a start has this name: a built-in one, or a file of heights."""
    return name in STARTS or name.lower().endswith(HEIGHT_FILES)


def broken(rule: str, cure: str) -> PydanticCustomError:
    """Return the error of a broken rule ("must be ...", and a sentence on what to do), for a validator to raise."""
    return PydanticCustomError("spec", "{rule}", {"rule": rule, "cure": cure})


def nearest(name: object, choices: Collection[str]) -> str:
    """Return "Did you mean `x`?" for the choice most like `name`, or the whole list where none is."""
    close = get_close_matches(str(name), choices, n=1, cutoff=0.6)
    return f"Did you mean `{close[0]}`?" if close else f"Choose one of {', '.join(choices)}."


# Name, reader and writer of the quantities of a spec by their SI unit.
UNITS = {"m": ("metres", parse_length, format_length), "rad": ("radians", parse_angle, format_angle)}
_CURES = {"m": "Use a unit of length: nm, um, mm or m.", "rad": "Use a unit of angle: deg, mrad or rad."}


def _range_rule(low: float, high: float, text: Callable[[float], str]) -> str:
    if math.isinf(high):
        return "must be finite" if math.isinf(low) else "must be finite and not negative"
    return f"must lie between {text(low)} and {text(high)}"


def unit_cure(unit: str, value: Any) -> str:
    """Cure for a value that is no text with a unit of length ("m") or angle ("rad")."""
    has_unit = isinstance(value, str) and any(letter.isalpha() for letter in value)
    return _CURES[unit] if has_unit else "Write it as text, number and unit in quotes."


def _read(unit: str, value: Any, context: Any) -> float:
    """A quantity as text with a unit in TOML, as a number in SI units otherwise."""
    plural, parse, _ = UNITS[unit]
    if not from_toml(context):
        if _is_number(value):
            return float(value)
        raise broken(f"must be a number of {plural}", "Give a number.")
    try:
        parsed = parse(value)
    except ValueError as error:
        raise broken(str(error).partition(", but got")[0], unit_cure(unit, value)) from error
    number, _, name = value.strip().partition(" ")
    # `parse` rounds to fifteen digits because of prefixes; without a prefix every digit counts.
    return float(number) if name.strip() == unit else parsed


def _is_number(value: Any) -> bool:
    """Whether a value is a number that a float holds, finite or not: TOML has whole numbers of any length."""
    if isinstance(value, int):
        return not isinstance(value, bool) and abs(value) <= sys.float_info.max
    return isinstance(value, float)


def from_toml(context: Any) -> bool:
    """Whether a validation reads TOML, and not numbers in SI units."""
    return context in (FROM_TOML, IN_ANGLES)


def _within(unit: str, low: float, high: float, value: Any, context: Any, also: str = "") -> float:
    """A quantity, or the error of one outside its bounds, whose rule says what is allowed, `also`."""
    number = _read(unit, value, context)
    slack = 1e-12  # a bound itself, rounded on its way from text, is inside
    if not low - slack * abs(low) <= number <= high + slack * abs(high):
        raise broken(_range_rule(low, high, UNITS[unit][2]) + also, "Check the unit.")
    return number


@dataclass(frozen=True)
class Within(BeforeValidator):
    """Validator of a number that has bounds, which it tells to the reference of keys.

    Attributes:
        low: smallest number.
        high: largest number.
        unit: "m", "rad", or "1" for a plain number.
        infinite: whether "inf" is allowed, too.
        widest_rad: of a place on the sensor, the largest angle where there is none; None for other numbers.
    """

    low: float = -math.inf
    high: float = math.inf
    unit: str = "1"
    infinite: bool = False
    widest_rad: float | None = None


@dataclass(frozen=True)
class Named(AfterValidator):
    """Validator of text, which tells the reference of keys what it takes.

    Attributes:
        rule: what the text must be.
        choices: names that are known.
    """

    rule: str = ""
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class OneOrList(BeforeValidator):
    """Takes one value for a list of it, as `Within` tells of bounds."""


@dataclass(frozen=True)
class InWords:
    """Beside the validator of a value of several kinds: what it takes, for the reference of keys.

    Attributes:
        kind: kinds of value.
        limits: their limits.
    """

    kind: str
    limits: str = ""


def bounded(unit: str, low: float, high: float, *, infinite: bool = False) -> Within:
    """Return the validator of a quantity between two bounds in its SI unit, "m" or "rad"; "inf" may be allowed."""

    def validate(value: Any, info: ValidationInfo) -> float:
        if infinite and value in ("inf", math.inf):  # the latter is TOML, too, and what an override without quotes says
            return math.inf
        return _within(unit, low, high, value, info.context, ', or be "inf"' if infinite else "")

    return Within(validate, low=low, high=high, unit=unit, infinite=infinite)


def length(low_m: float, high_m: float, *, infinite: bool = False) -> Within:
    """Return the validator of a length between two bounds, metres; "inf" may be allowed."""
    return bounded("m", low_m, high_m, infinite=infinite)


_NO_SENSOR = "Write a length; angles take sensor.pixel_angle in place of a lens, or of sensor.distance and pitch."


def _is(parse: Callable[[str], float], value: Any) -> bool:
    """Whether text is a quantity of a kind."""
    try:
        parse(value)
    except ValueError:
        return False
    return True


class HeldAngle(NamedTuple):
    """How an angle is held as a direction sine, in a spec without a sensor.

    Attributes:
        held: the number for an angle, radians; to twelve digits, so that the angle written for it is read as the same.
        angle: the angle of such a number.
        widest_rad: the largest angle.
    """

    held: Callable[[float], float]
    angle: Callable[[float], float]
    widest_rad: float


# A place, or the distance of two near the axis, is held as its sine; a size about the axis as that of both its halves.
PLACE = HeldAngle(
    lambda angle_rad: float(f"{math.sin(angle_rad):.12g}"),
    lambda sine: math.asin(min(1.0, max(-1.0, sine))),
    math.pi / 2,
)
SIZE = HeldAngle(
    lambda angle_rad: float(f"{2 * math.sin(angle_rad / 2):.12g}"),
    lambda size: 2 * math.asin(min(1.0, size / 2)),
    math.pi,
)

ANGLE = HeldAngle(float, float, math.pi)  # held as it is


def place(low_m: float, high_m: float, kind: HeldAngle = PLACE) -> Within:
    """Return the validator of a place on the sensor or of a size there: a length between two bounds, metres.

    In a spec without a sensor it is an angle, held as a direction sine, a length at a distance of one metre.
    """

    def validate(value: Any, info: ValidationInfo) -> float:
        if info.context == FROM_TOML:
            if _is(parse_angle, value):
                raise broken('must be a length on the sensor such as "1 mm"', _NO_SENSOR)
            return _within("m", low_m, high_m, value, info.context)
        if info.context != IN_ANGLES:  # a number of metres or a sine, which has been looked at before
            return _within("m", min(low_m, 0.0), max(high_m, 2.0), value, info.context)
        if _is(parse_length, value):
            cure = "Write an angle; for a length give optics.focal_length, or sensor.distance and sensor.pitch."
            raise broken('must be an angle such as "2 deg", for there is no sensor', cure)
        least = -kind.widest_rad if low_m < 0 else 0.0
        sine = kind.held(_within("rad", least, kind.widest_rad, value, info.context))
        if low_m > 0 and not sine > 0:
            raise broken("must be greater than 0", "Choose a larger angle.")
        return sine

    return Within(validate, low=low_m, high=high_m, unit="m", widest_rad=kind.widest_rad)


def share(low: float, high: float) -> Within:
    """Return the validator of a plain number between two bounds, such as a fraction."""

    def validate(value: Any) -> float:
        number = _is_number(value)
        if not (number and low <= value <= high):
            raise broken(_range_rule(low, high, "{:g}".format) if number else "must be a number", "Write 5 % as 0.05.")
        return float(value)

    return Within(validate, low=low, high=high)


def known(what: str, names: Collection[str]) -> Named:
    """Return the validator of a name that must be one of `names`; `what` is what they are names of."""
    return accepted(names.__contains__, f"must be a known {what}", names)


def accepted(accept: Callable[[str], Any], rule: str, choices: Collection[str] = ()) -> Named:
    """Return the validator of text that `accept` takes."""

    def validate(text: str) -> str:
        if not accept(text):
            raise broken(rule, nearest(text, choices) if choices else "Choose a plainer name.")
        return text

    return Named(validate, rule=rule, choices=tuple(choices))


Wavelength = Annotated[float, length(200 * NM, 20 * UM)]
Pitch = Annotated[float, length(10 * NM, 1 * MM)]
NearDepth = Annotated[float, length(10 * UM, 1e6)]
FarDepth = Annotated[
    float,
    Field(allow_inf_nan=True),
    length(10 * UM, 1e12, infinite=True),
    # JSON has no infinity.
    PlainSerializer(lambda depth_m: "inf" if math.isinf(depth_m) else depth_m, when_used="json"),
]

Count = Annotated[int, Field(strict=True, ge=1)]
Positive = Annotated[float, Field(strict=True, gt=0)]
NotNegative = Annotated[float, Field(strict=True, ge=0)]
Seed = Annotated[int, Field(strict=True, ge=0, lt=2**32)]
MOST_STEPS = 10_000_000
"""Steps of an optimisation or a training, at most."""
Steps = Annotated[int, Field(strict=True, ge=0, le=MOST_STEPS)]

_COLOUR_NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")
_COLOUR_RULE = "must be a name of at most 32 letters, digits, dashes, underscores"
ColourName = Annotated[str, accepted(_COLOUR_NAME.fullmatch, _COLOUR_RULE)]


@dataclass(frozen=True)
class Options(Mapping[str, Any]):
    """Free table of options: immutable and hashable, used like a dictionary (`**spec.optimize.start_options`).

    Values are text, numbers, booleans, and lists of these (held as tuples).
    """

    entries: tuple[tuple[str, Any], ...] = ()

    def __getitem__(self, key: str) -> Any:
        return dict(self.entries)[key]

    def __iter__(self) -> Iterator[str]:
        return iter(dict(self.entries))

    def __len__(self) -> int:
        return len(self.entries)


def _frozen_option(key: str, value: Any) -> Any:
    if isinstance(value, list | tuple):
        return tuple(_frozen_option(key, item) for item in value)
    if not (isinstance(value, str | bool) or (_is_number(value) and math.isfinite(value))):
        rule = "must hold text, finite numbers, true, false, or lists of these"
        raise broken(rule, f"Change `{key} = {value}`.")
    return value


def _options(value: Any) -> Options:
    if not isinstance(value, Mapping):
        raise broken("must be a table of options", "Write { key = value, ... }.")
    return Options(tuple(sorted((key, _frozen_option(key, item)) for key, item in value.items())))


OptionsTable = Annotated[
    Options,
    BeforeValidator(_options),
    # Through JSON, so that tuples at any depth become the lists they were read from.
    PlainSerializer(lambda options: json.loads(json.dumps(dict(options)))),
]
