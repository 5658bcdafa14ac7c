"""Specs to begin with, one for each task that designers ask for, and the examples; `doedesign new` writes them.

Each is a TOML file whose first comment says in a sentence what it makes. Those of tasks lie beside this file. Those of
the examples lie in `examples/` of the repository; pyproject.toml puts them beside this file in a wheel.
"""

from pathlib import Path

from doedesign.spec.values import nearest
from fab.errors import InputError

EXAMPLES = ("automotive", "automotive_cpu", "beam_splitter", "cell", "dslr", "quick", "snapshot_hdr", "wide_aperture")

_HERE = Path(__file__).parent


def template_names() -> list[str]:
    """Names of all templates, in order."""
    return sorted({*(path.stem for path in _HERE.glob("*.toml")), *EXAMPLES})


def template_text(name: str) -> str:
    """Text of a template.

    Raises:
        InputError: no template has that name.
    """
    names = template_names()
    if name not in names:
        raise InputError("template", f"must be one of {', '.join(names)}", repr(name), nearest(name, names))
    beside = _HERE / f"{name}.toml"
    path = beside if beside.is_file() else _HERE.parents[1] / "examples" / beside.name
    return path.read_text(encoding="utf-8")


def template_summary(name: str) -> str:
    """The sentence at the head of a template."""
    comment = []
    for line in template_text(name).splitlines():
        if not line.startswith("#"):
            break
        comment.append(line.removeprefix("#").strip())
    return " ".join(comment).partition(". ")[0].rstrip(".") + "."
