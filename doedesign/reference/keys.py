"""Every key of a spec and of other files, from the model that reads it: kind, unit, default, limits, meaning, example.

A key is described where it is defined: by the `Attributes` of its table's docstring, or in `fab.process.DEVIATIONS` if
it is an error of the process.
"""

import inspect
import math
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic.fields import FieldInfo

from doedesign.spec import Spec
from doedesign.spec.process import SpreadSpec
from doedesign.spec.response import LINES, MOST_LINES
from doedesign.spec.text import toml_value
from doedesign.spec.values import InWords, Named, OneOrList, Options, Within, nearest
from doedesign.spec.values.table import SpecTable, toml_key
from doedesign.spec.variation import VariationFile, VariationSpec
from fab.errors import InputError
from fab.process import DEVIATIONS
from fab.units import format_length

_ATTRIBUTE = re.compile(r"    (\w+): (.*)")
_SUFFIXES = {"_m": "m", "_rad": "rad", "_e": "electrons"}


class SpecKey(NamedTuple):
    """A key of a spec.

    Attributes:
        key: dotted key, as in "optimize.steps".
        kind: kind of value, as in "length" or "list of numbers".
        unit: SI unit of its attribute, "m", "rad" or "electrons"; "" for others. In TOML lengths and angles are text
            with any unit of their kind.
        required: whether it must be given, unless the task of a spec says it.
        default: value that holds where it is left out, as TOML; "" where that is none.
        limits: its smallest and largest value, or another rule, in words.
        choices: values it may have, if only these.
        description: its meaning.
        example: a line of TOML.
    """

    key: str
    kind: str
    unit: str
    required: bool
    default: str
    limits: str
    choices: tuple[str, ...]
    description: str
    example: str

    @property
    def name(self) -> str:
        """The last part of the key."""
        return self.key.rpartition(".")[2]

    @property
    def summary(self) -> str:
        """First sentence of the description."""
        return first_sentence(self.description)


class KeyTable(NamedTuple):
    """A table of a spec with its keys.

    Attributes:
        key: dotted key, "" for what stands above all tables.
        header: its first line in TOML, as in "[optimize]" or "[[objective]]".
        about: what it is for.
        keys: its keys, in the order in which a spec is written.
    """

    key: str
    header: str
    about: str
    keys: tuple[SpecKey, ...]

    @property
    def summary(self) -> str:
        """First sentence of what it is for."""
        return first_sentence(self.about)


def first_sentence(text: str) -> str:
    """The first sentence of a text, which ends with a full stop before a capital, or its first clause."""
    joined = " ".join(text.partition("\n\n")[0].split())
    return re.split(r"(?<=[^A-Z\d]\.) (?=[A-Z`\"\[(])", joined)[0]


@cache
def key_tables() -> tuple[KeyTable, ...]:
    """Every table of a spec with its keys, in the order of the model; tables that are written on one line are keys."""
    return tuple(_tables(Spec, "", ""))


@cache
def tables_of_files() -> dict[str, tuple[KeyTable, ...]]:
    """Tables with their keys of the other files that commands read, by the kind of file."""
    from doedesign.calibration.measurement import MeasurementSpec  # needs jax, which keys of a spec do not

    kinds: dict[str, type[SpecTable]] = {"measurement": MeasurementSpec, "variation": VariationFile}
    return {name: tuple(_tables(model, "", "")) for name, model in kinds.items()}


def every_key() -> dict[str, SpecKey]:
    """Every key of a spec by its dotted name."""
    return {one.key: one for table in key_tables() for one in table.keys}


def found(name: str) -> KeyTable | SpecKey:
    """The table or the key of a name, as in "optimize", "optimize.steps" or "objective[0].weight".

    Raises:
        InputError: there is none; the message has the nearest one.
    """
    plain = re.sub(r"\[\d*\]|\.\d+(?=\.|$)", "", name.strip().strip("[]"))
    tables = {table.key: table for table in key_tables() if table.key}
    keys = every_key()
    parent = plain.rpartition(".")[0]
    if plain in tables:
        return tables[plain]
    if plain in keys:
        return keys[plain]
    if plain.rpartition(".")[2] in SpreadSpec.model_fields and parent in keys:
        return keys[parent]  # of an error: { mean, sigma }
    known = [*tables, *keys]
    last = [one for one in keys if one.rpartition(".")[2] == plain.rpartition(".")[2]]
    cure = f"Did you mean {' or '.join(f'`{one}`' for one in last)}?" if last else nearest(plain, known)
    if cure.startswith("Choose"):
        cure = "doedesign spec lists all tables."
    raise InputError("key", "must be a table or a key of a spec", f"`{name}`", cure)


def attributes_of(model: type) -> dict[str, str]:
    """Meaning of each attribute by the docstring of a class, or else of the classes it is made from."""
    texts: dict[str, str] = {}
    for each in reversed(model.__mro__):
        section = re.split(r"^Attributes\b.*:$", inspect.cleandoc(each.__dict__.get("__doc__") or ""), flags=re.M)
        name = ""
        for line in section[1].splitlines() if len(section) > 1 else ():
            if start := _ATTRIBUTE.fullmatch(line):
                name, texts[start[1]] = start[1], start[2]
            elif name and line.startswith("        "):
                texts[name] += f" {line.strip()}"
            elif line.strip():
                break
    return texts


def about(model: type) -> str:
    """Docstring of a class as far as its attributes."""
    return re.split(r"^Attributes\b.*:$", inspect.cleandoc(model.__doc__ or ""), flags=re.M)[0].strip()


def _tables(model: type[SpecTable], key: str, header: str) -> Iterator[KeyTable]:
    """A table and the tables in it."""
    own, inner = list[SpecKey](), list[tuple[str, type[SpecTable], bool]]()
    for name, field in model.model_fields.items():
        dotted = f"{key}.{toml_key(name)}".removeprefix(".")
        kind, many = _table_in(field.annotation)
        if kind is not None and not kind.inline:
            inner.append((dotted, kind, many))
            continue
        own.append(_key(dotted, name, field, model))
        if kind is not None and not issubclass(kind, SpreadSpec):
            own += [_key(f"{dotted}.{toml_key(part)}", part, f, kind) for part, f in kind.model_fields.items()]
    if key == "optics":
        own += _SHORT
    yield KeyTable(key, header, about(model), tuple(own))
    for dotted, kind, many in inner:
        one = "[area] or [[area]]" if dotted == "area" else f"[[{dotted}]]"
        yield from _tables(kind, dotted, one if many else f"[{dotted}]")


def _table_in(annotation: Any) -> tuple[type[SpecTable] | None, bool]:
    """The model of a table that a value is or holds, and whether it is a list of them."""
    for part in (annotation, *get_args(annotation)):
        if isinstance(part, type) and issubclass(part, SpecTable):
            return part, get_origin(annotation) is tuple
    return None, False


def _key(dotted: str, name: str, field: FieldInfo, model: type[SpecTable]) -> SpecKey:
    unit = next((unit for suffix, unit in _SUFFIXES.items() if name.endswith(suffix)), "")
    if _is_spread(field):
        return _error_key(dotted, name, unit)
    if issubclass(model, VariationSpec) and name in DEVIATIONS:
        return _value_key(dotted, name, unit)
    taken = _taken(field.annotation, field.metadata, unit)
    default = "" if field.is_required() or field.default in (None, ()) else _text(name, field.default)
    example = field.examples[0] if field.examples else default or _first(taken)
    text = attributes_of(model).get(name, "")
    line = f"{toml_key(name)} = {example}" if example else ""
    required = field.is_required()
    return SpecKey(
        dotted, taken.kind, unit, required, default, taken.limits, taken.choices, text[:1].upper() + text[1:], line
    )


def _is_spread(field: FieldInfo) -> bool:
    """Whether a field is the mean and standard deviation of an error."""
    kind, _ = _table_in(field.annotation)
    return kind is not None and issubclass(kind, SpreadSpec)


def _error_key(dotted: str, name: str, unit: str) -> SpecKey:
    """The key of an error of the process."""
    error = DEVIATIONS[name]
    one, write, example = _ERRORS[error.unit]
    kind = f"{one}, or list of {one}s, one per mask" if error.per_mask else one
    low = "0 to" if error.one_sided else "-/+"
    limits = f"mean {low} {write(error.largest)}, standard deviation 0 to {write(error.largest)}"
    text = f"{error.meaning[:1].upper()}{error.meaning[1:]}."
    return SpecKey(
        dotted, f"{kind}; or {{ mean, sigma }}", unit, False, "", limits, (), text, f"{toml_key(name)} = {example}"
    )


def _value_key(dotted: str, name: str, unit: str) -> SpecKey:
    """The key of an error of one plate: its value."""
    error = DEVIATIONS[name]
    kind, _, example = _ERRORS[error.unit]
    if error.per_mask:
        kind, example = f"list of {kind}s, one per mask", f"[{', '.join([example] * 4)}]"
    text = f"{error.meaning[:1].upper()}{error.meaning[1:]}."
    limits = "0 or more" if error.one_sided else ""
    return SpecKey(dotted, kind, unit, False, "", limits, (), text, f"{toml_key(name)} = {example}")


def _text(name: str, value: Any) -> str:
    """A default as TOML, with twelve digits at most."""
    if name.endswith("_rad") and isinstance(value, float):
        return f'"{math.degrees(value):.12g} deg"'
    return toml_value(name, float(f"{value:.12g}") if isinstance(value, float) else value)


def _first(taken: "_Taken") -> str:
    """The first name of a choice, as TOML."""
    first = taken.choices[0] if taken.choices else ""
    return f'"{first}"' if isinstance(first, str) and first else str(first)


class _Taken(NamedTuple):
    """Kinds of value that a key takes: in words, their limits, and the only ones there are."""

    kind: str
    limits: str = ""
    choices: tuple[str, ...] = ()


def _taken(annotation: Any, metadata: Any = (), unit: str = "") -> _Taken:
    """Kinds of value that an annotation takes."""
    metadata = [part for one in metadata for part in (one.metadata if isinstance(one, FieldInfo) else (one,))]
    if said := next((one for one in metadata if isinstance(one, InWords)), None):
        return _Taken(said.kind, said.limits)
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _taken(parts[0], (*parts[1:], *metadata), unit)
    if origin is Literal:
        return _Taken("name" if isinstance(parts[0], str) else "whole number", "", parts)
    if origin in (Union, UnionType):
        return _taken(next(part for part in parts if part is not type(None)), metadata, unit)
    if origin is tuple:
        return _listed(parts, metadata, unit)
    if annotation is Options:
        return _Taken("table of options")
    if isinstance(annotation, type) and issubclass(annotation, SpecTable):
        return _Taken("table")
    if named := next((one for one in metadata if isinstance(one, Named)), None):
        exclusive = named.rule.startswith("must be a known") and " or " not in named.rule
        return _Taken("name" if named.choices else "text", "" if exclusive else named.rule, named.choices)
    kind = {bool: "true or false", int: "whole number", str: "text"}.get(annotation)
    return _Taken(kind or {"m": "length", "rad": "angle"}.get(unit, "number"), _limits(metadata))


def _listed(parts: tuple[Any, ...], metadata: Any, unit: str) -> _Taken:
    """The same of a list."""
    one = _taken(parts[0], (), unit)
    several = "places [x, y]" if one.kind.startswith("list of 2") else _PLURALS.get(one.kind, f"{one.kind}s")
    several = "lists of whole numbers" if one.kind == "list of whole numbers" else several
    kind = f"list of {several}" if parts[-1] is Ellipsis else f"list of {len(parts)} {several}"
    if any(isinstance(each, OneOrList) for each in metadata):
        kind = f"{one.kind}, or {kind}"
    least = next((each.min_length for each in metadata if isinstance(each, MinLen)), 0)
    each = one.limits if not one.limits or one.limits.endswith("each") else f"{one.limits} each"
    return _Taken(kind, "; ".join(filter(None, (each, f"at least {least}" if least else ""))), one.choices)


_PLURALS = {"text": "texts", "length": "lengths", "table": "tables"}


def _limits(metadata: Any) -> str:
    """Bounds that validators know, in words."""
    words, low, high = list[str](), "", ""
    for one in metadata:
        if isinstance(one, Within):
            words += _bounds(one)
        elif isinstance(one, Ge | Gt):
            low = f"above {one.gt}" if isinstance(one, Gt) else f"{one.ge}"
        elif isinstance(one, Le | Lt):
            high = f"{one.le}" if isinstance(one, Le) else f"below {one.lt}"
    if low:
        words.append(f"{low} to {high}" if high else low if low.startswith("above") else f"{low} or more")
    return ", ".join(words)


def _bounds(one: Within) -> Iterator[str]:
    write = _ERRORS[one.unit][1]
    if not math.isinf(one.high):
        yield f"{write(one.low)} to {write(one.high)}"
    elif not math.isinf(one.low):
        yield f"{write(one.low)} or more"
    if one.infinite:
        yield 'or "inf"'
    if one.widest_rad is not None:
        yield f"or an angle up to {_degrees(one.widest_rad)} where there is no sensor"


def _metres(length_m: float) -> str:
    return f"{length_m:g} m" if abs(length_m) >= 1 else format_length(length_m) if length_m else "0"


def _degrees(angle_rad: float) -> str:
    degrees = math.degrees(angle_rad)
    return f"{degrees:.4g} deg" if abs(degrees) > 1e-3 or not angle_rad else f"{angle_rad:g} rad"


# Of a value by its unit: its kind, how a bound is written, and an example of an error.
_ERRORS: Mapping[str, tuple[str, Callable[[float], str], str]] = {
    "m": ("length", _metres, '"0.1 um"'),
    "rad": ("angle", _degrees, '"0.01 deg"'),
    "1": ("number", "{:g}".format, "0.001"),
}
# Short ways to say the colours, which are read before the model.
_SHORT = (
    SpecKey(
        "optics.wavelengths", "list of lengths", "m", False, "", "200 nm to 20 um each", (),
        "Short for one colour channel per wavelength, named after it (\"656nm\"), in place of `colours`.",
        'wavelengths = ["656 nm", "589 nm", "486 nm"]',
    ),
    SpecKey(
        "optics.spectral_response", "text", "", False, "", "", (),
        "CSV file beside the spec with the spectral response of a camera, in place of `colours`: a column of "
        "wavelengths in nm, then one per colour (`doedesign.spec.response`).",
        'spectral_response = "camera.csv"',
    ),
    SpecKey(
        "optics.lines_per_colour", "whole number", "", False, str(LINES), f"1 to {MOST_LINES}", (),
        "Wavelengths that stand for each colour of `spectral_response`, the nodes of Gauss' quadrature.",
        f"lines_per_colour = {LINES}",
    ),
)  # fmt: skip
