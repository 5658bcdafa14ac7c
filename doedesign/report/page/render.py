"""Content of a page -> HTML. Text is escaped by the templates; data goes into scripts as JSON that cannot end them."""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from doedesign import __version__
from doedesign.report.page.blocks import (
    ChartBlock,
    DividerBlock,
    MapBlock,
    ModelBlock,
    PageBlock,
    PageContent,
    PsfBlock,
)
from doedesign.report.page.files import packed, safe_json
from fab.runsheet.page import html_page

_HERE = Path(__file__).parent
_VENDORED, _TEMPLATES = _HERE / "vendored", _HERE / "templates"
_LIBRARIES = {
    "uPlot.min.css": "uPlot",
    "uPlot.iife.min.js": "uPlot",
    "openseadragon.min.js": "OpenSeadragon",
    "model-viewer.min.js": "model-viewer",
}
_LICENCES = {
    "uPlot": ("uPlot",),
    "OpenSeadragon": ("openseadragon",),
    "model-viewer": ("model-viewer", "three", "fflate", "lit"),
}


def render(content: PageContent) -> bytes:
    """Return the page of some content.

    Args:
        content: what it shows.
    """
    blocks = [(f"{part.name}-{k}", block) for part in content.sections for k, block in enumerate(part.blocks, 1)]
    kinds = {block.kind for _, block in blocks}
    needed = ["uPlot.min.css"]
    needed += ["uPlot.iife.min.js"] if "chart" in kinds else []
    needed += ["openseadragon.min.js"] if "map" in kinds else []
    scripts = [name for name in needed if name.endswith(".js")]
    used = [*needed, *(["model-viewer.min.js"] if "model" in kinds else [])]
    inside = list(dict.fromkeys(_LIBRARIES[name] for name in used))
    data = [(name, safe_json(data)) for name, block in blocks for data in _data(block)]
    if "model" in kinds:  # large, and unpacked only when somebody wants to turn the model
        data.append(("model-viewer", safe_json(packed(_library("model-viewer.min.js").encode()))))
    values: dict[str, Any] = {
        "content": content,
        "version": __version__,
        "style": _text(_TEMPLATES / "report.css"),
        "script": _text(_TEMPLATES / "report.js"),
        "libraries": {name: _library(name) for name in needed},
        "scripts": scripts,
        "inside": inside,
        "licences": [(name, _text(_VENDORED / f"{name}.LICENSE.txt")) for one in inside for name in _LICENCES[one]],
        "data": data,
    }
    return html_page("report.html.j2", folder=_TEMPLATES, **values)


def _text(path: Path) -> str:
    return path.read_text("utf-8")


def _library(name: str) -> str:
    """A vendored file; the address of its source map, which is not here, is left out."""
    lines = _text(_VENDORED / name).splitlines()
    return "\n".join(line for line in lines if not line.startswith("//# sourceMappingURL"))


def _data(block: PageBlock) -> Iterator[Any]:
    """Data of a block for its script; none for blocks that need none."""
    if isinstance(block, ChartBlock):
        yield {**asdict(block), "series": [one._asdict() for one in block.series]}
    elif isinstance(block, DividerBlock):
        yield {"scenes": block.scenes}
    elif isinstance(block, MapBlock):
        yield block.data
    elif isinstance(block, PsfBlock):
        yield {**block.data, "depths": block.depths, "colours": block.colours}
    elif isinstance(block, ModelBlock):
        yield {"file": block.file, "data": block.data, "higher": block.higher}
