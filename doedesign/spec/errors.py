"""Mistakes of a spec in words a user can act on: file, key, rule, value, cure.

Pydantic finds the mistakes, this file words them. A mistake is an `InputError` whose `where` is the dotted key;
`spec_error` puts the file before the key, and joins several mistakes in one `SpecError`.
"""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import Any, TypeVar, get_args

from pydantic import ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from doedesign.spec.response import RESPONSE_KEYS
from doedesign.spec.values import FROM_TOML, IN_ANGLES, nearest
from doedesign.spec.values.table import SpecTable, toml_key
from fab.errors import InputError

Location = Sequence[int | str]
Table = TypeVar("Table", bound=SpecTable)

_SHORT_FORM = 'For example `wavelengths = ["656 nm", "589 nm", "486 nm"]`.'
_COLOURS_KEY = re.compile(r"optics\.colours(\[\d+\])?.*")
_SIGMA_KEY = re.compile(r"(process\.errors\.(\w+))\.sigma\b(.*)")
# How like a key an unknown one is that was meant to be it; more than to be proposed, for it hides another mistake.
_SLIP = 0.75
_UNKNOWN = "extra_forbidden"  # as pydantic calls a key that is not known
# What says the task of a spec, and the tables that may be left out then (`doedesign.spec.left_out`).
_TASKS = ("spots", "area", "focus", "illumination", "optimize", "optimize.start")
_SAID = ("scene", "sensor")
_RULES = {
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "float_type": "must be a number",
    "string_type": "must be text in quotes",
    "tuple_type": "must be a list in [ ]",
    "model_type": "must be a table",
    "finite_number": "must be finite",
    "greater_than": "must be greater than {gt}",
    "greater_than_equal": "must be at least {ge}",
    "less_than": "must be less than {lt}",
    "less_than_equal": "must be at most {le}",
    "too_short": "must not be empty",
    "too_long": "must have at most {max_length} entries",
}


class SpecError(InputError):
    """Several mistakes in one spec, each an error by itself; its text lists them, one per line."""

    def __init__(self, mistakes: Sequence[InputError]) -> None:
        """Join the mistakes; the parts of the first stand for the whole where only one can be shown."""
        first = mistakes[0]
        super().__init__(first.where, first.rule, first.got, first.cure)
        self.mistakes = tuple(mistakes)

    def __str__(self) -> str:
        """Return the messages, one per line."""
        return "\n".join(str(mistake) for mistake in self.mistakes)


def validated(
    model: type[Table], raw: Mapping[str, Any], source: str, overridden: Collection[str] = (), *, si: bool = False
) -> Table:
    """Return the tables of a file as a model.

    Args:
        model: the model of the whole file.
        raw: the tables as they were read.
        source: where they came from, for the message.
        overridden: dotted keys whose value was given beside the file.
        si: whether keys are attributes and lengths numbers in SI units, as in JSON, instead of those of TOML.
    """
    sensor = raw.get("sensor")
    context = IN_ANGLES if isinstance(sensor, Mapping) and "pixel_angle" in sensor else FROM_TOML
    try:
        return model.model_validate(raw, by_alias=not si, by_name=si, context=None if si else context)
    except ValidationError as error:
        found = error.errors(include_url=False)
    # Pydantic also calls a list with wrong entries too short, which would only repeat them.
    inner = {details["loc"][:length] for details in found for length in range(len(details["loc"]))}
    told = [d for d in found if not (d["type"] == "too_short" and d["loc"] in inner)]
    told.sort(key=lambda d: d["type"] != _UNKNOWN)  # what it misses may follow from a slip in a name
    mistakes = [_mistake(d, raw, model) for d in told]
    meant = {_meant(d["loc"], m.where, model) for d, m in zip(told, mistakes, strict=True) if d["type"] == _UNKNOWN}
    missing = [d["type"] == "missing" for d in told]
    mistakes = [m for m, lost in zip(mistakes, missing, strict=True) if not (lost and _follows(m.where, meant))]
    raise spec_error(source, mistakes, overridden)


def _meant(location: Location, key: str, root: type[SpecTable]) -> str:
    """Dotted key that an unknown one was probably meant to be; empty where none is like it."""
    parent = _table_at(location[:-1], root)
    close = get_close_matches(str(location[-1]), _keys(parent) if parent else [], n=1, cutoff=_SLIP)
    return f"{key.rpartition('.')[0]}.{close[0]}".removeprefix(".") if close else ""


def _follows(missing: str, meant: Collection[str]) -> bool:
    """Whether a key is missing only because of a slip in the name of one that was meant."""
    return missing in meant or (missing.partition(".")[0] in _SAID and bool({*meant} & {*_TASKS}))


def spec_error(source: str, mistakes: Sequence[InputError], overridden: Collection[str] = ()) -> InputError:
    """Return the error to raise for at least one mistake; see `validated` for the other arguments."""
    named = [
        InputError(f"{'overrides' if _covers(overridden, m.where) else source}: {m.where}", m.rule, m.got, m.cure)
        for m in mistakes
    ]
    return named[0] if len(named) == 1 else SpecError(named)


def _covers(overridden: Collection[str], key: str) -> bool:
    dotted = key.replace("[", ".").replace("]", "")
    return any(f"{dotted}.".startswith(f"{k}.") or k.startswith(f"{dotted}.") for k in overridden)


def _mistake(details: ErrorDetails, raw: Mapping[str, Any], root: type[SpecTable]) -> InputError:
    location, kind, context = details["loc"], details["type"], details.get("ctx", {})
    key = key_as_written("".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in location).removeprefix("."), raw)
    if kind == _UNKNOWN:
        return _unknown(key, location, root)
    got, example = _value_text(details["input"]), _example(location, root)
    if key == "optics.wavelengths":
        example = _SHORT_FORM
    if kind == "missing":
        if isinstance(location[-1], int):
            return InputError(key, "must be given", "a shorter list", example or "Add the entry.")
        return InputError(key, "must be given", "nothing", example or f"Add a table [{key}].")
    if kind == "spec":
        return InputError(key, context["rule"], got, context["cure"])
    if kind == "literal_error":
        choices = [choice.strip("' ") for choice in context["expected"].replace(" or ", ",").split(",")]
        return InputError(key, f"must be one of {', '.join(choices)}", got, nearest(details["input"], choices))
    if kind == "tuple_type" and key != "optics.wavelengths" and _table_at(location, root):
        example = f"Write [[{key}]] tables."
    rule = _RULES[kind].format(**context) if kind in _RULES else details["msg"]
    return InputError(key, rule, got, example or "Change the value.")


def key_as_written(key: str, raw: Mapping[str, Any]) -> str:
    """Return a dotted key of the full form ("optics.colours[1].wavelengths") as the file has it.

    A colour may have been made from `optics.wavelengths`, a sigma from `process.errors.overlay_x = "1 um"`, and the
    only area is no array.
    """
    if isinstance(raw.get("area"), Mapping):
        key = key.replace("area[0]", "area", 1) if key.startswith("area[0]") else key
    optics = raw.get("optics")
    if isinstance(optics, Mapping) and "colours" not in optics:
        key = _COLOURS_KEY.sub(r"optics.wavelengths\1", key)
    if not (found := _SIGMA_KEY.match(key)):
        return key
    spread: Any = raw
    for part in ("process", "errors", found[2]):
        spread = spread.get(part) if isinstance(spread, Mapping) else None
    return key if isinstance(spread, Mapping) else f"{found[1]}{found[3]}"


def _value_text(value: object) -> str:
    if isinstance(value, Mapping):
        return "a table"
    text = str(value).lower() if isinstance(value, bool) else str(value)
    text = text if len(text) <= 60 else f"{text[:57]}..."
    return f'"{text}"' if isinstance(value, str) else text


def _table_at(location: Location, root: type[SpecTable]) -> type[SpecTable] | None:
    """Return the model of the table a location leads into, None where it leads to a value."""
    table: type[SpecTable] | None = root
    for part in location:
        if isinstance(part, str):
            field = _field(table, part) if table else None
            table = _model(field) if field else None
    return table


def _field(table: type[SpecTable], key: str) -> FieldInfo | None:
    return next((f for name, f in table.model_fields.items() if key in (name, toml_key(name))), None)


def _model(field: FieldInfo) -> type[SpecTable] | None:
    candidates = (field.annotation, *get_args(field.annotation))
    return next((c for c in candidates if isinstance(c, type) and issubclass(c, SpecTable)), None)


def _keys(table: type[SpecTable]) -> list[str]:
    """Keys that a table takes; where colours are tables, there are short forms of them."""
    colours = table.model_fields.get("colours")
    short = ("wavelengths", *RESPONSE_KEYS) if colours and _model(colours) else ()
    return [*(toml_key(name) for name in table.model_fields), *short]


def _tables(root: type[SpecTable], path: str = "") -> Iterator[tuple[str, type[SpecTable]]]:
    """Yield every table below one with its dotted key, outer ones first."""
    inner = [(f"{path}.{toml_key(name)}".removeprefix("."), _model(f)) for name, f in root.model_fields.items()]
    found = [(key, model) for key, model in inner if model and not model.inline]
    yield from found
    for key, model in found:
        yield from _tables(model, key)


def _unknown(key: str, location: Location, root: type[SpecTable]) -> InputError:
    if key == "optics.wavelengths":
        rule, got = "the colours must be stated once", "`wavelengths` and `colours`"
        return InputError(key, rule, got, "Remove one of the two.")
    parent = _table_at(location[:-1], root)
    name, keys = str(location[-1]), _keys(parent) if parent else []
    cure = nearest(name, keys)
    homes = [home for home, model in _tables(root) if name in _keys(model)]
    if homes and not cure.startswith("Did"):
        cure = f"It belongs to [{homes[0]}]."
    where = f"[{key.rpartition('.')[0]}]" if "." in key else "the spec"
    return InputError(key, f"must be a known key of {where}", f"`{name}`", cure)


def _example(location: Location, root: type[SpecTable]) -> str:
    """Return a sentence with an example of the value at a location, empty where there is none."""
    names = [part for part in location if isinstance(part, str)]
    parent = _table_at(names[:-1], root) if names else None
    field = _field(parent, names[-1]) if parent else None
    return f"For example `{toml_key(names[-1])} = {field.examples[0]}`." if field and field.examples else ""
