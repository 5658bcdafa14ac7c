"""`doedesign spec`: the reference of spec keys on the terminal."""

import json
import textwrap
from typing import Any

from doedesign.cli.console import print_text, say
from doedesign.cli.options import AsJson

_WIDE = 100


def spec(key: str | None = None, *, json_: AsJson = False) -> None:
    """Explain the keys of a spec: all tables, the keys of one, or one key with kind, default, limits and an example.

    Args:
        key: Table or key, such as optimize or optimize.steps; without one all tables are listed.
    """
    from doedesign.reference.keys import KeyTable, found, key_tables

    if key is None:
        tables = key_tables()
        if json_:
            print_text(json.dumps([_table_record(table) for table in tables]))
            return
        print_text(_listed([(table.header or "name", _about(table)) for table in tables]))
        say("\nThe keys of one: doedesign spec optimize")
        return
    one = found(key)
    if json_:
        print_text(json.dumps(_table_record(one) if isinstance(one, KeyTable) else _key_record(one)))
    elif isinstance(one, KeyTable):
        rows = [(f"{each.name} = {each.default}" if each.default else each.name, each.summary) for each in one.keys]
        print_text(f"{one.header}\n\n{_wrapped(one.about)}\n\n{_listed(rows)}")
        say(f"\nMore of a key: doedesign spec {one.keys[0].key}")
    else:
        print_text(_in_detail(one))


def _about(table: Any) -> str:
    return table.summary if table.key else table.keys[0].summary


def _table_record(table: Any) -> dict[str, Any]:
    return {
        "table": table.key,
        "header": table.header,
        "about": table.about,
        "keys": [_key_record(each) for each in table.keys],
    }


def _key_record(key: Any) -> dict[str, Any]:
    from doedesign.reference.options import choices_of

    options = {choice.name: dict(choice.options) for choice in choices_of(key.key)}
    return key._asdict() | ({"options": options} if options else {})


def _in_detail(key: Any) -> str:
    """A key with all there is to say."""
    from doedesign.reference.options import choices_of

    unit = {"m": "text with a unit of length: nm, um, mm, cm, m", "rad": "text with a unit of angle: deg, mrad, rad"}
    default = key.default or ("must be given, unless the task says it" if key.required else "none")
    rows = [
        ("kind", key.kind),
        ("unit", unit.get(key.unit, key.unit)),
        ("default", default),
        ("limits", key.limits),
        ("one of", ", ".join(map(str, key.choices))),
        ("example", key.example),
    ]
    parts = [key.key, _wrapped(key.description), _listed([row for row in rows if row[1]])]
    for choice in choices_of(key.key):
        told = any(choice.options.values())
        options = [(f"  {name}", text) for name, text in choice.options.items()] if told else []
        if choice.options and not told:
            options = [(f"  options: {', '.join(choice.options)}", "")]
        parts.append("\n".join(filter(None, (_wrapped(f"{choice.name}: {choice.about}"), _listed(options)))))
    return "\n\n".join(parts)


def _wrapped(text: str) -> str:
    return "\n\n".join(textwrap.fill(" ".join(part.split()), _WIDE) for part in text.split("\n\n"))


def _listed(rows: list[tuple[str, str]]) -> str:
    """Two columns; a long first one has its text on the next line."""
    wide = min(36, max((len(name) for name, _ in rows), default=0)) + 2
    lines = []
    for name, text in rows:
        filled = textwrap.wrap(text, _WIDE - wide) or [""]
        first = name
        if len(name) + 2 > wide:
            lines.append(name)
            first = ""
        lines += [f"{first:{wide}}{filled[0]}".rstrip(), *(f"{'':{wide}}{line}" for line in filled[1:])]
    return "\n".join(lines)
