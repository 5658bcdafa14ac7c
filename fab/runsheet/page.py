"""Pages of HTML that need nothing else, for A4 and for the screen."""

from functools import cache
from pathlib import Path
from typing import Any

from fab.units import format_length

_TEMPLATES = Path(__file__).parent / "templates"


def html_page(template: str, *, folder: Path = _TEMPLATES, **values: Any) -> bytes:
    """Fill a template with values; what it asks for and does not get is an error, no blank.

    Args:
        template: its file.
        folder: its folder; that of this package by default.
        values: what it asks for.
    """
    return _templates(folder).get_template(template).render(**values).encode()


@cache
def _templates(folder: Path) -> Any:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: f"{value:.10g}" if isinstance(value, float) else value,  # 75.0 as 75
    )
    environment.filters["clock"] = lambda seconds: "{}:{:02d}".format(*divmod(round(seconds), 60))
    environment.filters["distance"] = format_length
    return environment
