"""Comparison of values with those that an order must have; every difference becomes a sentence that names its place."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

# By which of its values an entry of a list is called.
_NAMES = ("file", "mask", "cell", "plate", "layer", "name", "bar", "pad", "task")
_MOST = 5


def differences(found: Any, wanted: Any) -> list[str]:
    """Compare JSON values; a sentence for each of the first differences, and one for how many more there are."""
    told = list(_differences(found, wanted, ""))
    return told if len(told) <= _MOST else [*told[:_MOST], f"and {len(told) - _MOST} more differences"]


def _differences(found: Any, wanted: Any, at: str) -> Iterator[str]:
    if isinstance(found, Mapping) and isinstance(wanted, Mapping):
        for key in sorted(found.keys() | wanted.keys()):
            place = f"{at}.{key}" if at else str(key)
            if key not in found:
                yield f"{place} is missing"
            elif key not in wanted:
                yield f"{place} should not be there"
            else:
                yield from _differences(found[key], wanted[key], place)
    elif isinstance(found, list) and isinstance(wanted, list):
        here, there = (_named(values) for values in (found, wanted))
        if sorted(here) != sorted(there):
            yield from _listed(here, there, at)
        elif here != there:
            yield f"{at} stand in the order {', '.join(here)} instead of {', '.join(there)}"
        for name, one, other in zip(here, found, wanted, strict=False) if here == there else ():
            yield from _differences(one, other, f"{at}[{name}]")
    # 1 and 1.0 and true are not the same in a file.
    elif type(found) is not type(wanted) or found != wanted:
        yield f"{at} is {_short(found)} instead of {_short(wanted)}"


def _named(values: Sequence[Any]) -> list[str]:
    """Return what the entries of a list are called: by their own names, if all have one, else by number."""
    for key in _NAMES:
        if values and all(isinstance(value, Mapping) and isinstance(value.get(key), str | int) for value in values):
            return [str(value[key]) for value in values]
    return [str(number) for number in range(len(values))]


def _listed(here: Sequence[str], there: Sequence[str], at: str) -> Iterator[str]:
    for name in dict.fromkeys([*here, *there]):
        found, wanted = here.count(name), there.count(name)
        if found < wanted:
            yield f"{at}: {name} is missing"
        elif wanted == 0:
            yield f"{at}: {name} should not be there"
        elif found > wanted:
            yield f"{at}: {name} stands there {found} times"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
