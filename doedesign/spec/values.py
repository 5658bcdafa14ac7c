"""Types of the values in a spec, each with its range and the message for a value outside it.

In TOML a length is text with a unit ("1.85 um"); in Python and JSON it is a number of metres, and likewise for angles.
The validation context tells which of the two is read: `FROM_TOML`, or none for numbers.
"""

import json
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Annotated, Any, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, ValidationInfo
from pydantic_core import PydanticCustomError

from fab.units import MM, NM, UM, format_length, parse_angle, parse_length
from sim.material import MATERIALS

FROM_TOML = "toml"
HEIGHT_FILES = (".exr", ".npy", ".tif", ".tiff", ".png")


class ObjectiveTraits(NamedTuple):
    """Requirements of a built-in objective.

    Attributes:
        near: whether it needs a near depth in the scene.
    """

    near: bool = False


# The built-in objectives; each is a function of the same name in `doedesign.design.objectives`.
OBJECTIVES = {
    "far_spot": ObjectiveTraits(),
    "near_spread": ObjectiveTraits(near=True),
    "window_loss": ObjectiveTraits(),
    "handcrafted": ObjectiveTraits(near=True),
    "target_pattern": ObjectiveTraits(),
}

# The built-in starts with their options; each is a function of the same name in `doedesign.design.starts`.
STARTS = {
    "flat": (),
    "random": ("feature",),
    "fresnel": ("focal_length", "evaluations"),
    "ring": ("far_energy", "period", "roughness"),
}


def broken(rule: str, cure: str) -> PydanticCustomError:
    """Return the error of a broken rule, for a validator to raise.

    Args:
        rule: what must hold ("must be a power of two").
        cure: what to do about it, a full sentence.
    """
    return PydanticCustomError("spec", "{rule}", {"rule": rule, "cure": cure})


def nearest(name: object, choices: Collection[str]) -> str:
    """Return "Did you mean `x`?" for the choice most like `name`, or the whole list where none is."""
    close = get_close_matches(str(name), choices, n=1, cutoff=0.6)
    return f"Did you mean `{close[0]}`?" if close else f"Choose one of {', '.join(choices)}."


class _Unit(NamedTuple):
    name: str
    plural: str
    parse: Callable[[str], float]
    format: Callable[[float], str]

    def read(self, text: Any) -> float:
        value = self.parse(text)
        number, _, name = text.strip().partition(" ")
        # `parse` rounds to fifteen digits because of prefixes; without a prefix every digit counts.
        return float(number) if name.strip() == self.name else value


def angle_text(angle_rad: float) -> str:
    """Write an angle in degrees, a small one in microradians, to twelve digits, which `parse_angle` reads back."""
    return f"{angle_rad * 1e6:.12g} urad" if 0 < abs(angle_rad) < 1e-3 else f"{math.degrees(angle_rad):.12g} deg"


_LENGTH = _Unit("m", "metres", parse_length, format_length)
_ANGLE = _Unit("rad", "radians", parse_angle, angle_text)


def _range_rule(low: float, high: float, text: Callable[[float], str]) -> str:
    if math.isinf(high):
        return "must be finite" if math.isinf(low) else "must be finite and not negative"
    return f"must lie between {text(low)} and {text(high)}"


def _bounded(unit: _Unit, low: float, high: float, *, infinite: bool = False) -> BeforeValidator:
    def validate(value: Any, info: ValidationInfo) -> float:
        if infinite and value == "inf":
            return math.inf
        if info.context == FROM_TOML:
            try:
                number = unit.read(value)
            except ValueError as error:
                raise broken(str(error).partition(", but got")[0], "Write the unit inside the quotes.") from error
        elif isinstance(value, int | float) and not isinstance(value, bool):
            number = float(value)
        else:
            raise broken(f"must be a number of {unit.plural}", "Give a number.")
        slack = 1e-12  # a bound itself, rounded on its way from text, is inside
        inside = low - slack * abs(low) <= number <= high + slack * abs(high)
        if not (inside or (infinite and number == math.inf)):
            rule = _range_rule(low, high, unit.format) + (', or be "inf"' if infinite else "")
            raise broken(rule, "Check the unit.")
        return number

    return BeforeValidator(validate)


def length(low_m: float, high_m: float, *, infinite: bool = False) -> BeforeValidator:
    """Return the validator of a length between two bounds, metres; "inf" may be allowed."""
    return _bounded(_LENGTH, low_m, high_m, infinite=infinite)


def angle(low_rad: float, high_rad: float) -> BeforeValidator:
    """Return the validator of an angle between two bounds, radians."""
    return _bounded(_ANGLE, low_rad, high_rad)


def share(low: float, high: float) -> BeforeValidator:
    """Return the validator of a plain number between two bounds, such as a fraction."""

    def validate(value: Any) -> float:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and low <= value <= high):
            raise broken(_range_rule(low, high, "{:g}".format) if number else "must be a number", "Write 5 % as 0.05.")
        return float(value)

    return BeforeValidator(validate)


def known(what: str, names: Collection[str]) -> AfterValidator:
    """Return the validator of a name that must be one of `names`; `what` is what they are names of."""
    return _accepted(names.__contains__, f"must be a known {what}", names)


def _accepted(accept: Callable[[str], Any], rule: str, choices: Collection[str] = ()) -> AfterValidator:
    """Return the validator of text that `accept` takes."""

    def validate(text: str) -> str:
        if not accept(text):
            raise broken(rule, nearest(text, choices) if choices else "Choose a plainer name.")
        return text

    return AfterValidator(validate)


Wavelength = Annotated[float, length(200 * NM, 20 * UM)]
Pitch = Annotated[float, length(10 * NM, 1 * MM)]
Aperture = Annotated[float, length(1 * UM, 1.0)]
FocalLength = Annotated[float, length(10 * UM, 100.0)]
LevelStep = Annotated[float, length(0.1 * NM, 100 * UM)]
ChromeOverlap = Annotated[float, length(0.0, 1 * MM)]
Defocus = Annotated[float, length(-10 * MM, 10 * MM)]
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


def _level_count(count: int) -> int:
    if count not in (2, 4, 8, 16, 32, 64):
        raise broken("must be a power of two from 2 to 64, one bit per etch mask", "Choose 2, 4, 8, 16, 32 or 64.")
    return count


LevelCount = Annotated[int, Field(strict=True), AfterValidator(_level_count)]
SpecName = Annotated[
    str,
    _accepted(
        re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}").fullmatch,
        "must be a file name of at most 64 letters, digits, dots, dashes",
    ),
]
ColourName = Annotated[
    str,
    _accepted(
        re.compile(r"[A-Za-z0-9_-]{1,32}").fullmatch,
        "must be a name of at most 32 letters, digits, dashes, underscores",
    ),
]
Material = Annotated[str, known("material", MATERIALS)]
_FUNCTION = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")
ObjectiveName = Annotated[
    str,
    _accepted(
        lambda name: name in OBJECTIVES or _FUNCTION.fullmatch(name),
        'must be a known objective or a function as "module:function"',
        OBJECTIVES,
    ),
]
Start = Annotated[
    str,
    _accepted(
        lambda name: name in STARTS or name.lower().endswith(HEIGHT_FILES),
        f"must be a known start or a height map file ({', '.join(HEIGHT_FILES)})",
        STARTS,
    ),
]


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
    finite = not isinstance(value, float) or math.isfinite(value)
    if not (isinstance(value, str | bool | int | float) and finite):
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
