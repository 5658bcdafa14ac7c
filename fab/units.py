"""The border between human units and SI: text such as "75 nm" in, metres out, and back.

Inside the packages every number is SI and carries its unit in its name; only specs, the command line,
pictures and file metadata speak of nanometres. Text is parsed by pint, which is slow to import and is
therefore loaded on the first use.
"""

import math
import re
from functools import cache
from numbers import Integral, Real
from typing import Any, NamedTuple, cast

import numpy as np

from fab.errors import InputError

NM = 1e-9
UM = 1e-6
MM = 1e-3

_LENGTH_STEPS = ((1.0, "m"), (MM, "mm"), (UM, "um"), (NM, "nm"))

# One number and one unit, so that no text is ever evaluated as an expression.
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([^\W\d_]+|\N{DEGREE SIGN})\s*")


@cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry(cache_folder=None)


def _parse(text: object, unit: str, example: str) -> float:
    found = _QUANTITY.fullmatch(text) if isinstance(text, str) else None
    problem = f'must be a number with a unit such as "{example}", but got {text!r}'
    if found is None:
        raise ValueError(problem)
    import pint

    registry = _registry()
    try:
        quantity = registry.Quantity(float(found[1]), registry.parse_units(found[2]))
        # By base unit, not by dimension: pint calls percent and steradian dimensionless, like the radian.
        if quantity.to_base_units().units != registry.Unit(unit):
            raise ValueError(problem)
        value: Any = quantity.m_as(unit)
    except (pint.errors.PintError, AttributeError) as error:
        raise ValueError(problem) from error
    if not math.isfinite(value):
        raise ValueError(f'must be finite, such as "{example}", but got {text!r}')
    # 75 * 1e-9 is 7.500000000000001e-08; fifteen digits give back the number that was meant.
    return float(f"{value:.15g}")


def parse_length(text: str) -> float:
    """Return a length given as text with its unit (``"75 nm"``, ``"1.85um"``, ``"0.4 m"``) in metres.

    The text of a ValueError names no key, says what is wrong and gives an example.
    """
    return _parse(text, "m", "75 nm")


def parse_angle(text: str) -> float:
    """Return an angle given as text with its unit (``"2 deg"``, ``"5 mrad"``) in radians; see `parse_length`."""
    return _parse(text, "rad", "2 deg")


def metres(value: float | str, name: str = "length", *, infinite: bool = False) -> float:
    """Return `value`, a length as an SI number or as text with a unit, in metres.

    It is the length of `name`, for messages. If `infinite`, infinity will do, as a number or as ``"inf"``.

    Raises:
        InputError: anything else: text without a unit, a number that is not finite, another type.
    """
    if infinite and (number_of(value) == math.inf or (isinstance(value, str) and value == "inf")):
        return math.inf
    rule = f'must be metres or text with a unit such as "75 nm"{", or infinite" if infinite else ""}'
    cure = 'Give a number of metres, 75e-9, or text, "75 nm".'
    if isinstance(value, str):
        try:
            return parse_length(value)
        except ValueError as error:
            raise InputError(name, rule, repr(value), cure) from error
    number = number_of(value)
    if not math.isfinite(number):
        raise InputError(name, rule, repr(value), cure)
    return number


def number_of(value: object) -> float:
    """Return a real number as a float, infinite if it is beyond all floats; NaN for anything else, such as text."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return math.nan
    try:
        return float(value)
    except OverflowError:  # an integer beyond all floats
        return math.inf


def is_whole(value: object, least: int, most: float = math.inf) -> bool:
    """Whether a value is a whole number, perhaps of numpy, from `least` to `most`; True and False are none."""
    return isinstance(value, Integral) and not isinstance(value, bool) and least <= int(value) <= most


def numbers_of(value: object) -> tuple[float, ...]:
    """Return the numbers of a tuple, a list or an array ``[n]`` as floats (`number_of`); one NaN for anything else."""
    several = isinstance(value, tuple | list) or (isinstance(value, np.ndarray) and value.ndim == 1)
    return tuple(map(number_of, cast(Any, value))) if several else (math.nan,)


def distance_from(value: float | str, name: str) -> float:
    """Return `value`, a positive distance in metres or text with a unit ("5 cm", "inf"), in metres; see `metres`."""
    distance = metres(value, name, infinite=True)
    if not distance > 0:
        raise InputError(name, "must be a positive distance", format_length(distance), 'For example "5 cm", or inf.')
    return distance


def distances_from(value: object, name: str) -> tuple[float, ...]:
    """Return several positive distances, metres, infinity among them, as floats.

    Args:
        value: a tuple, a list or an array ``[n]`` of them, perhaps empty.
        name: what names it in messages.

    Raises:
        InputError: anything else.
    """
    distances = numbers_of(value)
    if not all(distance > 0 for distance in distances):
        raise InputError(name, "must be several distances, positive metres", repr(value), "For example (0.05,).")
    return distances


def told_length(value: object) -> str:
    """Return what was given for a length as messages show it: "75 nm", or what is no number as Python writes it."""
    number = number_of(value)
    return repr(value) if math.isnan(number) else format_length(number)


def require_kind(name: str, value: object, kind: type, cure: str) -> None:
    """Raise an `InputError` unless a value is of a kind, the value of `name`; `cure` says how to get one."""
    if not isinstance(value, kind):
        raise InputError(name, f"must be {named_kind(kind)}", named_kind(type(value)), cure)


def named_kind(kind: type) -> str:
    """Return the name of a kind of value with its article: "an int"."""
    return f"{'an' if kind.__name__[0] in 'aeiouAEIO' else 'a'} {kind.__name__}"


def format_angle(angle_rad: float) -> str:
    """Return an angle as ASCII in degrees ("0.05 deg"), a small one in microradians, to twelve digits."""
    return f"{angle_rad * 1e6:.12g} urad" if 0 < abs(angle_rad) < 1e-3 else f"{math.degrees(angle_rad):.12g} deg"


class PlaceUnit(NamedTuple):
    """How places in the light of a DOE are told: as lengths on a sensor, or as angles where there is no sensor.

    A place without a sensor is a direction sine, as a length at a distance of one metre.

    Attributes:
        name: the unit as pictures write it.
        suffix: the unit at the end of a key or of a column's name.
        scale: of an axis on which pixels are equally wide: metres per unit, or 1 for sines.
        in_degrees: whether places are sines, told in degrees.
    """

    name: str
    suffix: str
    scale: float
    in_degrees: bool = False

    def of(self, place_m: Any) -> Any:
        """Distance of places from the axis, in the unit."""
        return np.degrees(np.arcsin(np.clip(place_m, -1, 1))) if self.in_degrees else place_m / self.scale

    def size(self, size_m: Any) -> Any:
        """Size of what lies about the axis, in the unit."""
        return 2 * self.of(np.divide(size_m, 2)) if self.in_degrees else size_m / self.scale


MICROMETRES = PlaceUnit("µm", "um", UM)
MILLIMETRES = PlaceUnit("mm", "mm", MM)
DEGREES = PlaceUnit("°", "deg", 1.0, in_degrees=True)


def format_length(length_m: float) -> str:
    """Return a length as ASCII ("75 nm") in the largest unit of m, mm, um, nm of which it has one, to twelve digits.

    An infinite one, such as the depth of a collimated beam, is "inf", as `metres` reads it.
    """
    if math.isinf(length_m):
        return f"{length_m:g}"
    size = abs(length_m)
    for unit_m, name in _LENGTH_STEPS:
        if size >= unit_m * (1 - 1e-12):
            return f"{length_m / unit_m:.12g} {name}"
    return f"{length_m / NM:.12g} nm"
