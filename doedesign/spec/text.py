"""A spec as text: canonical JSON with SI numbers for machines, TOML with units for people."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from doedesign.spec.models import Spec, Table, toml_key
from fab.files import canonical_json, sha256_bytes
from fab.units import format_length, parse_length

__all__ = ["spec_digest", "spec_to_json", "spec_to_toml"]


def spec_to_json(spec: Spec) -> dict[str, Any]:
    """Return a spec as plain dictionaries, lists, text and numbers in SI units, every default filled in."""
    return spec.model_dump(mode="json")


def spec_digest(spec: Spec) -> str:
    """Return the SHA-256 of a spec's canonical JSON; equal specs have equal digests, however they were written."""
    return sha256_bytes(canonical_json(spec_to_json(spec)))


def spec_to_toml(spec: Spec, comments: Sequence[str] = ()) -> str:
    """Write a spec with every default and override filled in, as TOML that reads back to the same spec.

    Args:
        spec: the spec.
        comments: lines for the head of the file, for example the overrides that led to it.
    """
    lines = [f"# {line}" for comment in comments for line in comment.splitlines()]
    lines += _table_lines(spec, "")
    return "\n".join(lines).strip() + "\n"


def _table_lines(table: Table, path: str) -> list[str]:
    values, tables = [], []
    for name in type(table).model_fields:
        value, key = getattr(table, name), toml_key(name)
        inner = f"{path}.{key}".removeprefix(".")
        if isinstance(value, Table):
            tables += ["", f"[{inner}]", *_table_lines(value, inner)]
        elif isinstance(value, tuple) and value and isinstance(value[0], Table):
            for item in value:
                tables += ["", f"[[{inner}]]", *_table_lines(item, inner)]
        elif name == "objectives":
            continue  # an array of tables that is empty is said by saying nothing
        else:
            values.append(f"{key} = {_length_text(value) if name.endswith('_m') else _value_text(value)}")
    return values + tables


def _length_text(length_m: float | tuple[float, ...]) -> str:
    if isinstance(length_m, tuple):
        return f"[{', '.join(_length_text(item) for item in length_m)}]"
    if length_m == float("inf"):
        return '"inf"'
    text = format_length(length_m)
    # Twelve digits are for people; a length with more of them is written in full.
    return f'"{text}"' if parse_length(text) == length_m else f'"{length_m!r} m"'


def _value_text(value: Any) -> str:
    if isinstance(value, Mapping):
        entries = ", ".join(f"{_value_text(key)} = {_value_text(item)}" for key, item in value.items())
        return f"{{ {entries} }}" if entries else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_value_text(item) for item in value)}]"
    if isinstance(value, str):
        # A JSON string is a TOML string, except that TOML wants DEL escaped as well.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value)
