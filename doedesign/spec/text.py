"""Specs, processes and variations as text: canonical JSON with SI numbers for machines, TOML with units for people."""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from doedesign.spec.models import Spec
from doedesign.spec.process import ProcessSpec, SpreadSpec
from doedesign.spec.values import UNITS, HeldAngle
from doedesign.spec.values.table import SpecTable, toml_key
from doedesign.spec.variation import ProcessFile, variation_file
from fab.errors import printable
from fab.files import canonical_json, sha256_bytes
from fab.process import Variation
from fab.units import parse_angle

_FILLED_IN = "defaults are filled in; optional keys that are not here have their usual values"


def spec_to_json(spec: Spec) -> dict[str, Any]:
    """Return a spec as plain values in SI units, with the defaults filled in except those of optional keys."""
    return spec.model_dump(mode="json")


def spec_digest(spec: Spec) -> str:
    """Return the SHA-256 of a spec's canonical JSON; equal specs have equal digests, however they were written."""
    return sha256_bytes(canonical_json(spec_to_json(spec)))


def spec_to_toml(spec: SpecTable, comments: Sequence[str] = ()) -> str:
    """Write a spec as TOML that reads back to the same spec, `comments` first.

    Defaults are filled in, except those of optional keys, which are left out as long as they have their usual value.
    """
    # TOML has no control characters, not even in comments.
    lines = [f"# {printable(line)}" for comment in comments for line in comment.splitlines()]
    in_angles = isinstance(spec, Spec) and spec.sensor.in_angles
    return "\n".join(lines + _table_lines(spec, "", in_angles)).strip() + "\n"


def spec_to_resolved_toml(spec: Spec, overrides: Sequence[str]) -> str:
    """Write the spec of a run; the head of the file tells the overrides, "table.key=value", that led to it."""
    return spec_to_toml(spec, [_FILLED_IN, *(f"--set {override}" for override in overrides)])


def process_to_toml(process: ProcessSpec, comments: Sequence[str] = ()) -> str:
    """Write a process as a TOML file of its own, which `load_process` reads back to the same process."""
    return spec_to_toml(ProcessFile(process=process), comments)


def variation_to_toml(variation: Variation, comments: Sequence[str] = ()) -> str:
    """Write the errors of one DOE as TOML, which `load_variation` reads back to the last bit; zeros are left out."""
    return spec_to_toml(variation_file(variation), comments)


def _table_lines(table: SpecTable, path: str, in_angles: bool = False) -> list[str]:
    values, tables = [], []
    for name, given in table.given().items():
        value = given[0] if name == "areas" and len(given) == 1 else given  # the only one is no array
        key = toml_key(name)
        inner = f"{path}.{key}".removeprefix(".")
        if isinstance(value, SpecTable) and not value.inline:
            tables += ["", f"[{inner}]", *_table_lines(value, inner, in_angles)]
        elif isinstance(value, tuple) and value and isinstance(value[0], SpecTable) and not value[0].inline:
            for item in value:
                tables += ["", f"[[{inner}]]", *_table_lines(item, inner, in_angles)]
        elif name != "objectives":  # an empty array of tables is written as none
            kind = table.angles.get(name) if in_angles else None
            values.append(f"{key} = {toml_value(name, value) if kind is None else _angle_text(value, kind)}")
    return values + tables


def _angle_text(value: Any, kind: HeldAngle) -> str:
    """Write places that are held as sines as angles, with as few digits as are read back to them."""
    if isinstance(value, tuple):
        return f"[{', '.join(_angle_text(item, kind) for item in value)}]"
    angle_rad = kind.angle(value)
    texts = (f"{math.degrees(angle_rad):.{digits}g} deg" for digits in range(4, 16))
    # An angle that was given in other units may be none of these; in radians every digit counts.
    return f'"{next((text for text in texts if kind.held(parse_angle(text)) == value), f"{angle_rad!r} rad")}"'


def toml_value(name: str, value: Any) -> str:
    """Write a value in the unit that an attribute's name ends in."""
    if isinstance(value, tuple):
        return f"[{', '.join(toml_value(name, item) for item in value)}]"
    if isinstance(value, SpreadSpec):
        # Its parts have the unit of the error they belong to.
        parts = [f"{key} = {toml_value(name, part)}" for key, part in value.given().items()]
        return f"{{ {', '.join(parts)} }}" if "mean" in value.given() else toml_value(name, value.sigma)
    if isinstance(value, SpecTable):
        return f"{{ {', '.join(f'{toml_key(key)} = {toml_value(key, part)}' for key, part in value.given().items())} }}"
    if isinstance(value, str):
        return _value_text(value)
    if value == math.inf:
        return '"inf"'
    for unit, (_, parse, write) in UNITS.items():
        if name.endswith(f"_{unit}"):
            text = write(value)
            # Twelve digits are for people; a number with more of them is written in full.
            return f'"{text}"' if parse(text) == value else f'"{value!r} {unit}"'
    return _value_text(value)


def _value_text(value: Any) -> str:
    if isinstance(value, Mapping):
        entries = ", ".join(f"{_value_text(key)} = {_value_text(item)}" for key, item in value.items())
        return f"{{ {entries} }}" if entries else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_value_text(item) for item in value)}]"
    if isinstance(value, str):
        # A JSON string is a TOML string, except that TOML wants DEL escaped as well.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return str(value).lower() if isinstance(value, bool) else repr(value)
