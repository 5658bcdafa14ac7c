"""Options that a start, an objective and an obstruction take: from the functions and classes that take them."""

import dataclasses
import inspect
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

from doedesign.reference.keys import about, attributes_of, first_sentence
from doedesign.spec import STARTS
from doedesign.spec.values import OBJECTIVES
from doedesign.spec.values.table import toml_key


class Choice(NamedTuple):
    """One of the names that a key may have, with its options.

    Attributes:
        name: the name.
        about: what it does, in a sentence.
        options: its options, each with its meaning or default; "" where neither is stated.
    """

    name: str
    about: str
    options: Mapping[str, str]


def choices_of(key: str) -> tuple[Choice, ...]:
    """Names with their options for a key that holds options, none for any other.

    Args:
        key: such as "optimize.start_options", "objective.options" or "obstruction.options".
    """
    match key:
        case "optimize.start_options":
            return _starts()
        case "objective.options":
            return _objectives()
        case "obstruction.options":
            return _obstructions()
        case _:
            return ()


def _starts() -> tuple[Choice, ...]:
    from doedesign.design.starts import BUILT_IN

    return tuple(Choice(name, _about(BUILT_IN[name]), dict.fromkeys(STARTS[name], "")) for name in STARTS)


def _objectives() -> tuple[Choice, ...]:
    from doedesign.design import objectives
    from doedesign.design.patterns import PATTERNS

    found = []
    for name in OBJECTIVES:
        function = getattr(objectives, name)
        given = (p for p in inspect.signature(function).parameters.values() if p.kind is p.KEYWORD_ONLY)
        options = {p.name: "must be given" if p.default is p.empty else f"{p.default} by default" for p in given}
        if name == "target_pattern":  # its target is made from these
            options = {
                "image": "picture beside the spec, in place of a pattern",
                "pattern": f"one of {', '.join(PATTERNS)}",
            }
            options |= {each: f"of {', '.join(p for p in PATTERNS if each in PATTERNS[p][1])}" for each in _OF_PATTERNS}
        found.append(Choice(name, _about(function), options))
    return tuple(found)


_OF_PATTERNS = ("count", "spacing", "width", "diameter", "offset")


def _obstructions() -> tuple[Choice, ...]:
    from sim.obstruction import OBSTRUCTIONS

    found = []
    for name, kind in OBSTRUCTIONS.items():
        texts, model = attributes_of(kind), cast("Any", kind)
        options = {toml_key(each.name): texts.get(each.name, "") for each in dataclasses.fields(model)}
        found.append(Choice(name, first_sentence(about(kind)), options))
    return tuple(found)


def _about(function: Any) -> str:
    return first_sentence(inspect.getdoc(function) or "")
