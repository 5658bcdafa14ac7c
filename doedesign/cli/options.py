"""Options that several commands share, and how their values are read."""

from typing import Annotated

from cyclopts import Parameter

from fab.errors import InputError

Overrides = Annotated[
    tuple[str, ...], Parameter(name="--set", negative="", help="Change one value of the spec, KEY=VALUE.")
]
AsJson = Annotated[bool, Parameter(name="--json", negative="", help="Print JSON instead of paths.")]


def length_of(option: str, text: str | None) -> float | None:
    """A length in metres, or None where none was given.

    Raises:
        InputError: it cannot be read.
    """
    if text is None:
        return None
    from fab.units import parse_length

    try:
        return parse_length(text)
    except ValueError as error:
        raise InputError(option, "must be a length with a unit", f'"{text}"', 'For example "75 nm".') from error
