"""Common ground of all tables of a spec: frozen, strict about keys, units in the names of attributes.

An attribute that holds a length ends in `_m` and is metres, one that holds an angle ends in `_rad`; its TOML key has no
suffix and is text with a unit. A number of electrons ends in `_e`, which its TOML key has not. An optional key
(`optional`) that is not given leaves no trace in JSON or TOML, so that newer keys leave the digests of older specs
as they are.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field

# Arrays of tables: one entry is one [[objective]].
_SINGULAR = {"objectives": "objective", "limits": "limit", "particles": "particle", "pinholes": "pinhole"}
_SINGULAR |= {"areas": "area"}
# Of quantities for both axes, which may be one number for both.
_SINGULAR |= {"diameters_m": "diameter", "angles_rad": "angle"}


def toml_key(attribute: str) -> str:
    """Return the TOML key of an attribute: the name without its unit."""
    return _SINGULAR.get(attribute, attribute.removesuffix("_m").removesuffix("_rad").removesuffix("_e"))


def optional(default: Any = None, example: str | None = None) -> Any:
    """Return a field that is written only where it differs from its default; an `example` is TOML of a value."""
    examples = None if example is None else [example]
    return Field(default=default, exclude_if=lambda value: value == default, examples=examples)


class SpecTable(BaseModel, frozen=True):
    """Table of a spec. Unknown keys are refused, values never change."""

    inline: ClassVar[bool] = False  # whether it is written on one line, as `{ key = value }`
    # Attributes that are angles in a spec without a sensor, and how they are held (`doedesign.spec.values.HeldAngle`).
    angles: ClassVar[Mapping[str, Any]] = {}

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        alias_generator=toml_key,
        validate_by_name=True,
        validate_by_alias=False,
    )

    def given(self) -> dict[str, Any]:
        """Return the attributes to be written, by name: all but the `optional` ones at their default."""
        fields = {name: field.exclude_if for name, field in type(self).model_fields.items()}
        values = {name: getattr(self, name) for name in fields}
        return {name: value for name, value in values.items() if not ((left_out := fields[name]) and left_out(value))}
