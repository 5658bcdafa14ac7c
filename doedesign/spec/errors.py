"""What was wrong with a spec, in words a user can act on: file, key, rule, value, cure.

Pydantic finds the mistakes; this file says them. Several mistakes are told at once, as one `SpecError`.
"""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, get_args

from pydantic import ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from doedesign.spec.models import Spec
from doedesign.spec.response import RESPONSE_KEYS
from doedesign.spec.table import SpecTable, toml_key
from doedesign.spec.values import nearest
from fab.errors import InputError

__all__ = ["SpecError", "SpecMistake", "explain", "key_as_written", "spec_error"]

_SHORT_FORM = 'For example `wavelengths = ["656 nm", "589 nm", "486 nm"]`.'
_COLOURS_KEY = re.compile(r"optics\.colours(\[\d+\])?.*")
_SIGMA_KEY = re.compile(r"(process\.errors\.(\w+))\.sigma\b(.*)")
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


class SpecMistake(NamedTuple):
    """One broken rule of a spec.

    Attributes:
        key: dotted TOML key, such as "doe.aperture".
        rule: what must hold.
        got: what came instead.
        cure: what to do, a full sentence.
    """

    key: str
    rule: str
    got: str
    cure: str


class SpecError(InputError):
    """Several mistakes in one spec; its text lists them, one per line.

    Attributes:
        mistakes: the single errors.
    """

    def __init__(self, mistakes: Sequence[InputError]) -> None:
        """Join the mistakes; the parts of the first stand for the whole where only one can be shown."""
        first = mistakes[0]
        super().__init__(first.where, first.rule, first.got, first.cure)
        self.mistakes = tuple(mistakes)

    def __str__(self) -> str:
        """Return the messages, one per line."""
        return "\n".join(str(mistake) for mistake in self.mistakes)


def spec_error(source: str, problems: Sequence[SpecMistake], overridden: Collection[str] = ()) -> InputError:
    """Make the error to raise for a list of problems.

    Args:
        source: the spec file, as the user named it.
        problems: at least one.
        overridden: dotted keys whose value came from the command line, not from the file.
    """
    mistakes = [
        InputError(f"{'--set' if _covered(p.key, overridden) else source}: {p.key}", p.rule, p.got, p.cure)
        for p in problems
    ]
    return mistakes[0] if len(mistakes) == 1 else SpecError(mistakes)


def _covered(key: str, overridden: Collection[str]) -> bool:
    dotted = key.replace("[", ".").replace("]", "")
    return any(f"{dotted}.".startswith(f"{k}.") or k.startswith(f"{dotted}.") for k in overridden)


def explain(error: ValidationError, raw: Mapping[str, Any], root: type[SpecTable] = Spec) -> list[SpecMistake]:
    """Translate what pydantic found.

    Args:
        error: the failed validation.
        raw: the tables as they were read.
        root: the model of the whole file.
    """
    found = error.errors(include_url=False)
    # A list whose entries are wrong is also called too short by pydantic; that says nothing new.
    inner = {details["loc"][:length] for details in found for length in range(len(details["loc"]))}
    return [_problem(d, raw, root) for d in found if not (d["type"] == "too_short" and d["loc"] in inner)]


def _problem(details: ErrorDetails, raw: Mapping[str, Any], root: type[SpecTable]) -> SpecMistake:
    location, kind, context = details["loc"], details["type"], details.get("ctx", {})
    key = key_as_written(_dotted(location), raw)
    if kind == "extra_forbidden":
        return _unknown(key, location, root)
    if kind == "missing":
        return _missing(key, location, root)
    got = _shown(details["input"])
    if kind == "spec":
        return SpecMistake(key, context["rule"], got, context["cure"])
    if kind == "literal_error":
        choices = [choice.strip("' ") for choice in context["expected"].replace(" or ", ",").split(",")]
        return SpecMistake(key, f"must be one of {', '.join(choices)}", got, nearest(details["input"], choices))
    rule = _RULES[kind].format(**context) if kind in _RULES else details["msg"]
    cure = _example(location, root) or "Change the value."
    if key == "optics.wavelengths":
        cure = _SHORT_FORM
    elif kind == "tuple_type" and _table_at(location, root):
        cure = f"Write [[{key}]] tables."
    return SpecMistake(key, rule, got, cure)


def _dotted(location: Sequence[int | str]) -> str:
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    return text.removeprefix(".")


def key_as_written(key: str, raw: Mapping[str, Any]) -> str:
    """Return a key as the file has it, which may use a short form.

    A colour may have been made from `optics.wavelengths`, a sigma from `process.errors.overlay_x = "1 um"`.

    Args:
        key: dotted key of the full form, such as "optics.colours[1].wavelengths".
        raw: the tables as they were read.
    """
    optics = raw.get("optics")
    if isinstance(optics, Mapping) and "colours" not in optics:
        key = _COLOURS_KEY.sub(r"optics.wavelengths\1", key)
    return _SIGMA_KEY.sub(lambda found: found[1] + found[3] if _said_as_sigma_alone(found, raw) else found[0], key)


def _said_as_sigma_alone(found: re.Match[str], raw: Mapping[str, Any]) -> bool:
    value: Any = raw
    for part in ("process", "errors", found[2]):
        value = value.get(part) if isinstance(value, Mapping) else None
    return not isinstance(value, Mapping)


def _shown(value: object) -> str:
    if isinstance(value, str):
        return f'"{value}"' if len(value) <= 60 else f'"{value[:57]}..."'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "a table"
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _table_at(location: Sequence[int | str], root: type[SpecTable]) -> type[SpecTable] | None:
    """Return the model of the table a location leads into, None where it leads to a value."""
    table: type[SpecTable] | None = root
    for part in location:
        if isinstance(part, int):
            continue
        field = _field(table, part) if table else None
        table = _model_of(field) if field else None
    return table


def _field(table: type[SpecTable], key: str) -> FieldInfo | None:
    return next((f for name, f in table.model_fields.items() if key in (name, toml_key(name))), None)


def _model_of(field: FieldInfo) -> type[SpecTable] | None:
    candidates = (field.annotation, *get_args(field.annotation))
    return next((c for c in candidates if isinstance(c, type) and issubclass(c, SpecTable)), None)


def _keys(table: type[SpecTable]) -> list[str]:
    keys = [toml_key(name) for name in table.model_fields]
    return [*keys, "wavelengths", *RESPONSE_KEYS] if "colours" in keys else keys


def _tables(root: type[SpecTable], path: str = "") -> Iterator[tuple[str, type[SpecTable]]]:
    """Yield every table below one with its dotted key, outer ones first."""
    inner = [(f"{path}.{toml_key(name)}".removeprefix("."), _model_of(f)) for name, f in root.model_fields.items()]
    found = [(key, model) for key, model in inner if model and not model.inline]
    yield from found
    for key, model in found:
        yield from _tables(model, key)


def _unknown(key: str, location: Sequence[int | str], root: type[SpecTable]) -> SpecMistake:
    parent = _table_at(location[:-1], root)
    name, keys = str(location[-1]), _keys(parent) if parent else []
    if key == "optics.wavelengths":
        return SpecMistake(
            key, "the colours must be stated once", "`wavelengths` and `colours`", "Remove one of the two."
        )
    homes = [home for home, model in _tables(root) if name in _keys(model)]
    cure = nearest(name, keys)
    if homes and not cure.startswith("Did"):
        cure = f"It belongs to [{homes[0]}]."
    where = f"[{key.rpartition('.')[0]}]" if "." in key else "the spec"
    return SpecMistake(key, f"must be a known key of {where}", f"`{name}`", cure)


def _missing(key: str, location: Sequence[int | str], root: type[SpecTable]) -> SpecMistake:
    if isinstance(location[-1], int):
        return SpecMistake(key, "must be given", "a shorter list", _example(location, root) or "Add the entry.")
    cure = _SHORT_FORM if key == "optics.wavelengths" else _example(location, root) or f"Add a table [{key}]."
    return SpecMistake(key, "must be given", "nothing", cure)


def _example(location: Sequence[int | str], root: type[SpecTable]) -> str:
    """Return a sentence with an example of the value at a location, empty where there is none."""
    names = [part for part in location if isinstance(part, str)]
    parent = _table_at(names[:-1], root) if names else None
    field = _field(parent, names[-1]) if parent else None
    return f"For example `{toml_key(names[-1])} = {field.examples[0]}`." if field and field.examples else ""
