"""Pages of the reference in Markdown, from the tables of this folder and the lists of public names."""

import re
from collections.abc import Iterator
from importlib.resources import files

import doedesign.spec.left_out
from doedesign.reference.files import FOLDERS
from doedesign.reference.keys import KeyTable, SpecKey, key_tables, tables_of_files
from doedesign.reference.numbers import METRICS_GROUPS, NumberGroup, metrics_numbers
from doedesign.reference.options import choices_of
from doedesign.reference.other_numbers import OTHER_GROUPS

# Public names by subject; those of a module that is not listed here come last.
_SUBJECTS: dict[str, tuple[tuple[str, tuple[str, ...]], ...]] = {
    "doedesign": (
        ("Specs and designs", ("spec", "build", "design", "optimization", "refinement", "runs.level_maps")),
        ("Light", ("prediction", "runs.psfs", "runs.fabricated", "runs.certificate")),
        ("Spots, areas and foci", ("spots", "areas", "focus")),
        ("Orders and plates as made", ("lab", "precompensation")),
        ("Tolerances and calibration", ("tolerancing", "calibration")),
        ("Captures and reconstruction", ("capture", "recon", "training", "evaluation")),
        ("Reports", ("report",)),
    ),
    "sim": (
        ("Cameras, light and materials", ("camera", "illumination", "light", "material")),
        ("Optics", ("optic", "surface", "rigorous.edge_optic", "rigorous")),
        ("PSFs", ("psf_bank", "transfer", "store", "surface.leakage")),
        ("Numbers", ("metrics",)),
        ("Scenes and sensors", ("imaging", "obstruction", "sensor")),
    ),
    "fab": (
        ("The plate", ("grid", "aperture", "height", "levels", "level_map")),
        ("The process", ("process", "stock", "rules")),
        ("The order", ("order", "layout", "solids", "verification")),
        ("Units and errors", ("units", "errors")),
    ),
}
_NAMES = re.compile(r"^from \.([\w.]+) import (\w+) as \2$", re.MULTILINE)
# Names of other numbers in a definition, where their unit may be left out.
_PLAIN = sorted({name.removesuffix("_m") for name in metrics_numbers()}, key=len, reverse=True)
_NUMBER = re.compile(rf"(?<![`\w])({'|'.join(n for n in _PLAIN if '_' in n)})(?![`\w])")


def pages() -> dict[str, str]:
    """Every page by its path in the documentation."""
    api = {f"reference/api/{package}.md": api_page(package) for package in _SUBJECTS}
    return {
        "reference/spec.md": spec_page(),
        "reference/other-keys.md": other_keys_page(),
        "reference/metrics.md": metrics_page(),
        "reference/files.md": files_page(),
        **api,
    }


def public_names(package: str) -> dict[str, str]:
    """Public names of a package with the module that each is defined in."""
    text = (files(package) / "__init__.pyi").read_text(encoding="utf-8")
    return {name: module for module, name in _NAMES.findall(text)}


def spec_page() -> str:
    """Every key of a spec: kind, default, limits, meaning and an example."""
    tables = key_tables()
    _, task, listed = (doedesign.spec.left_out.__doc__ or "").split("\n\n", 2)
    rules = "\n".join(line.removeprefix("    ") for line in listed.rstrip().splitlines())
    parts = [
        "# Keys of a spec",
        "Every table and key of the TOML file that `doedesign optimize` reads, with kind, default and limits. "
        "`doedesign spec` prints the same on the terminal: `doedesign spec optimize`, `doedesign spec optimize.steps`.",
        'A length or an angle is text with its unit (`"1.85 um"`, `"2 deg"`). In Python, attributes have the SI unit '
        "in their name (`pitch` is `pitch_m`, metres).",
        "| table | what it is for |\n|---|---|\n"
        + "\n".join(
            f"| [`{table.header or 'name'}`](#{_anchor(table.key or 'name')}) | "
            f"{_cell(table.summary if table.key else table.keys[0].summary)} |"
            for table in tables
        ),
        "## What a spec may leave out",
        f"{_escaped(task)}\n\n```text\n{rules}\n```",
    ]
    for table in tables:
        parts += _table(table)
    return "\n\n".join(parts) + "\n"


_ABOUT_FILES = {
    "measurement": (
        "Measurement",
        "The TOML file that `doedesign calibrate RUN FILE` reads: images of a point source, and how they were taken. "
        "`examples/measurement/measurement.toml` is one, commented line by line. Files are found beside it.",
    ),
    "variation": (
        "Errors of one plate",
        "The TOML file that `doedesign psf RUN --fabricated --variation FILE` reads, and that `calibrate` writes as "
        "`plate.toml`. What is not said is zero.",
    ),
}


def other_keys_page() -> str:
    """Every key of the other TOML files that commands read."""
    parts = [
        "# Keys of other files",
        "What is not in a spec. Processes, wafers and terms of an order may also stand in files of their own, with the "
        "[tables of a spec](spec.md): `[process]`, `[wafer]`, `[order]`.",
    ]
    for name, tables in tables_of_files().items():
        title, about = _ABOUT_FILES[name]
        parts += [f"## {title} {{ #{name}-file }}", about]
        for table in tables:
            if table.key:
                parts += [f"### `{table.header}` {{ #{_anchor(table.key)} }}", _escaped(table.about)]
            for key in table.keys:
                parts += [f"#### `{key.key}` {{ #{_anchor(key.key)} }}", *_said(key, "must be given")]
    return "\n\n".join(parts) + "\n"


def _table(table: KeyTable) -> Iterator[str]:
    yield f"## `{table.header or 'name'}` {{ #{_anchor(table.key or 'name')} }}"
    if table.key:
        yield _escaped(table.about)
    for key in table.keys:
        if "." in key.key:
            yield f"### `{key.key}` {{ #{_anchor(key.key)} }}"
        yield from _said(key, "must be given, unless the task says it")


def _said(key: SpecKey, required: str) -> Iterator[str]:
    yield _escaped(key.description)
    default = f"`{key.default}`" if key.default else required if key.required else "none"
    facts = [("kind", key.kind), ("default", default), ("limits", key.limits)]
    facts.append(("one of", ", ".join(f"`{choice}`" for choice in key.choices)))
    facts.append(("example", f"`{key.example}`"))
    yield "\n".join(f"- {name}: {_escaped(text)}" for name, text in facts if text)
    if choices := choices_of(key.key):
        lines = ["Options of each:", ""]
        for choice in choices:
            told = any(choice.options.values())
            names = "" if told or not choice.options else f" ({', '.join(f'`{name}`' for name in choice.options)})"
            lines.append(f"- `{choice.name}`{names}: {_escaped(choice.about)}")
            lines += [f"    - `{name}`: {_escaped(text)}" for name, text in choice.options.items() if told]
        yield "\n".join(lines)


def metrics_page() -> str:
    """Every number of a result file: unit, range, definition and where it is computed."""
    parts = [
        "# Numbers of results",
        "One name means one number, in every `metrics.json`, in tables, pictures and limits. Shares are "
        "of the light on the clear aperture, or of the beam where there is one, and lie between 0 and 1.",
        "How the main ones hang together, for one colour and depth:",
        "```text\n"
        "throughput     = far_spot + window_beside_spot          light in the sensor window\n"
        "1              = blocked + reflected + throughput + uncollected + higher_orders\n"
        "zeroth_order   of the light that passes the glass: the share that goes on as if the DOE were flat\n"
        "strehl         compares a plate with its own design: 1 as drawn, however small far_spot is\n"
        "concentration  of near light beside concentration_bound, the least that keeps all light in the window\n"
        "```",
    ]
    for group in (*METRICS_GROUPS, *OTHER_GROUPS):
        parts += _group(group)
    return "\n\n".join(parts) + "\n"


def _group(group: NumberGroup) -> Iterator[str]:
    yield f"## {group.title}"
    yield f"In {group.files}."
    rows = [
        f"| `{name}` | {one.unit} | {_cell(one.range)} | {_cell(_with_names(one.definition))} |"
        for name, one in group.numbers.items()
    ]
    yield "| name | unit | range | definition |\n|---|---|---|---|\n" + "\n".join(rows)
    sources = {name: one.source for name, one in group.numbers.items()}
    if len(set(sources.values())) == 1:
        yield f"Computed by `{next(iter(sources.values()))}`."
    else:
        yield "Computed by " + ", ".join(f"`{source}` (`{name}`)" for name, source in sources.items()) + "."


def _with_names(text: str) -> str:
    """A definition with the names of other numbers as code."""
    return _NUMBER.sub(r"`\1`", text)


def files_page() -> str:
    """Every file that a command writes."""
    parts = [
        "# Files",
        "What commands write, folder by folder. Files appear whole or not at all, the same input gives the same bytes, "
        "and a `manifest.json` lists the SHA-256 of all results. Numbers are SI; arrays are `[y, x]` with row 0 at the "
        "lowest y.",
    ]
    for folder in FOLDERS:
        rows = "\n".join(f"| `{one.name}` | {_cell(one.content)} |" for one in folder.files)
        parts += [f"## `{folder.path}`", f"Written by `{folder.command}`. {_escaped(folder.about)}"]
        parts.append(f"| file | content |\n|---|---|\n{rows}")
    return "\n\n".join(parts) + "\n"


def api_page(package: str) -> str:
    """Every public name of a package, by subject."""
    names = public_names(package)
    parts = [f"# {package}", f"Public names of `import {package}`, each loaded when it is used first."]
    for subject, own in grouped(package).items():
        parts.append(f"## {subject}")
        for name in own:
            parts.append(
                f'::: {package}.{names[name]}.{name}\n    options:\n      heading_level: 3\n      filters: ["!^_"]'
            )
    return "\n\n".join(parts) + "\n"


def grouped(package: str) -> dict[str, list[str]]:
    """Public names of a package by subject."""
    names, out, done = public_names(package), dict[str, list[str]](), set[str]()
    for subject, modules in _SUBJECTS[package]:
        own = [n for n, where in names.items() if any(where == m or where.startswith(f"{m}.") for m in modules)]
        out[subject] = [name for name in own if name not in done]
        done |= set(own)
    rest = [name for name in names if name not in done]
    return out | ({"Others": rest} if rest else {})


def _anchor(key: str) -> str:
    return key.replace(".", "-")


def _escaped(text: str) -> str:
    """Text of a docstring as Markdown: what is no code keeps its characters."""
    parts = re.split(r"(`[^`]*`)", text)
    # Those of odd numbers are code.
    return "".join(part if i % 2 else re.sub(r"([*_<\[\]])", r"\\\1", part) for i, part in enumerate(parts))


def _cell(text: str) -> str:
    """Text in a cell of a table."""
    return _escaped(text).replace("|", "\\|").replace("\n", " ")
