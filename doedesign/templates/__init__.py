"""Specs to begin with, one for each task that designers ask for; `doedesign new` writes them.

Each is a TOML file beside this one whose first comment says in a sentence what it makes.
"""

from importlib.resources import files

from doedesign.spec.values import nearest
from fab.errors import InputError


def template_names() -> list[str]:
    """Names of all templates, in order."""
    found = (entry.name for entry in files(__name__).iterdir())
    return sorted(name.removesuffix(".toml") for name in found if name.endswith(".toml"))


def template_text(name: str) -> str:
    """Text of a template.

    Raises:
        InputError: no template has that name.
    """
    names = template_names()
    if name not in names:
        raise InputError("template", f"must be one of {', '.join(names)}", repr(name), nearest(name, names))
    return (files(__name__) / f"{name}.toml").read_text(encoding="utf-8")


def template_summary(name: str) -> str:
    """The sentence at the head of a template."""
    comment = []
    for line in template_text(name).splitlines():
        if not line.startswith("#"):
            break
        comment.append(line.removeprefix("#").strip())
    return " ".join(comment).partition(". ")[0].rstrip(".") + "."
