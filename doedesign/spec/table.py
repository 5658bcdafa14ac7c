"""What all tables of a spec have in common: frozen, strict about keys, units in the names of attributes.

An attribute that holds a length ends in `_m` and is metres, one that holds an angle ends in `_rad`; its TOML key has no
suffix and is text with a unit. A number of electrons ends in `_e`, which its TOML key has not. What a table need not
say (`unsaid`) leaves no trace in JSON or TOML where it is not said, so a spec that knows nothing of a newer key keeps
its digest.
"""

from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["SpecTable", "toml_key", "unsaid"]

# Arrays of tables: one entry is one [[objective]].
_SINGULAR = {"objectives": "objective", "limits": "limit", "particles": "particle", "pinholes": "pinhole"}


def toml_key(attribute: str) -> str:
    """Return the TOML key of an attribute: the name without its unit."""
    return _SINGULAR.get(attribute, attribute.removesuffix("_m").removesuffix("_rad").removesuffix("_e"))


def unsaid(default: Any = None) -> Any:
    """Return a field that is written only where it differs from its default."""
    return Field(default=default, exclude_if=lambda value: value == default)


class SpecTable(BaseModel, frozen=True):
    """One table of a spec. Unknown keys are refused, values never change.

    Attributes:
        inline: whether it is written on one line, as `{ key = value }`.
    """

    inline: ClassVar[bool] = False

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        alias_generator=toml_key,
        validate_by_name=True,
        validate_by_alias=False,
    )

    def said(self) -> dict[str, Any]:
        """Return the attributes that are to be written: all but those left `unsaid`."""
        fields = type(self).model_fields.items()
        values = {name: (field, getattr(self, name)) for name, field in fields}
        return {name: value for name, (field, value) in values.items() if not (f := field.exclude_if) or not f(value)}
