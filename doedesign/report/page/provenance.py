"""Versions, digests and the commands that make a run again."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from doedesign import __version__
from doedesign.report.page.blocks import CommandBlock, PageBlock, PageSection, TableBlock, TextBlock, section
from doedesign.report.page.files import RunFiles, listed_json
from fab.files import MANIFEST_NAME, read_bytes, read_json
from fab.units import format_length

# Folders of results, in the order of the work.
_RESULTS = (
    "psf",
    "fabricated",
    "certificate",
    "tolerance",
    "simulated",
    "trained",
    "finetuned",
    "evaluation",
    "calibration",
    "explanations",
    "as-built",
)


def provenance_section(files: RunFiles) -> PageSection | None:
    """Where everything on the page comes from.

    Args:
        files: the run.
    """
    spec = files.folder / "spec.toml"
    text = read_bytes(spec).decode(errors="replace").splitlines() if spec.is_file() else []
    blocks: list[PageBlock | None] = [
        _versions(files),
        _commands(files),
        _digests(files),
        TextBlock(tuple(text), preformatted=True, title="Spec, defaults filled in but for optional keys"),
    ]
    return section("provenance", "Provenance", blocks)


def _versions(files: RunFiles) -> TableBlock:
    manifest = files.manifest
    rows = [
        ("design", files.name),
        ("state", str(manifest.get("state", ""))),
        ("run made by", f"doedesign {manifest.get('version', 'unknown')}"),
        ("report made by", f"doedesign {__version__}"),
        ("SHA-256 of the spec", str(manifest.get("spec_sha256", ""))),
        *((f"input {key}", str(value)) for key, value in sorted(_mapping(manifest.get("inputs_sha256")).items())),
    ]
    if files.order is not None:
        rows += [("level map of the order", files.order.level_map_sha256), ("order", files.order.name)]
        rows += [(f"order made with {key}", str(value)) for key, value in sorted(files.order.tools.items())]
    return TableBlock("Versions", ("", ""), tuple(rows))


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _commands(files: RunFiles) -> CommandBlock:
    """Commands from the spec to all that the page shows, as far as results tell what was asked."""
    overrides = files.manifest.get("overrides")
    study = listed_json(files.folder / "tolerance", "results.json")
    explained = listed_json(files.folder / "explanations", "explanations.json")
    targets = None if explained is None else explained["targets"]
    return CommandBlock(
        title="Commands to repeat it",
        run=shlex.quote(f"runs/{files.name}"),
        order=None if files.order is None else shlex.quote(f"masks/{files.name}"),
        changes=tuple(shlex.quote(str(one)) for one in (overrides if isinstance(overrides, list) else ())),
        results=tuple(name for name in _RESULTS if _is_there(files.folder / name)),
        draws=None if study is None else (study["plan"]["draws"], study["seed"]),
        ratio=None
        if targets is None
        else (
            f"{targets['ring_to_disc']:g}",
            shlex.quote(format_length(targets["wavelength_m"])),
            shlex.quote(format_length(targets["depth_m"])),
        ),
    )


def _is_there(folder: Path) -> bool:
    return folder.is_dir() and any(folder.iterdir())


def _digests(files: RunFiles) -> TableBlock | None:
    """Digests of all results, by folder."""
    rows = []
    for name in ("", *_RESULTS):
        path = files.folder / name / MANIFEST_NAME
        if path.is_file():
            listed = _mapping(read_json(path).get("results_sha256"))
            rows += [(f"{name}/{file}".removeprefix("/"), str(digest)) for file, digest in sorted(listed.items())]
    return TableBlock("Digests", ("file", "SHA-256"), tuple(rows), folded=True) if rows else None
