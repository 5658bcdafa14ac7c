"""Versions, digests and the commands that make a run again."""

import math
import re
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from doedesign import __version__
from doedesign.capture.images import sample_files
from doedesign.report.page.blocks import CommandBlock, PageBlock, PageSection, TableBlock, TextBlock, section
from doedesign.report.page.files import RunFiles, listed_bytes, listed_json
from doedesign.spec import spec_digest
from fab.files import MANIFEST_NAME, read_bytes, read_json
from fab.units import format_length
from sim.store import read_stored_bank

Options = tuple[tuple[str, str], ...]  # names and values, quoted

_FIRST_DRAW = "normal/0"  # which a command takes where none is asked for
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
    there = [name for name in _RESULTS if _is_there(files.folder / name)]
    return CommandBlock(
        title="Commands to repeat it",
        run=shlex.quote(f"runs/{files.name}"),
        order=None if files.order is None else shlex.quote(f"masks/{files.name}"),
        changes=tuple(shlex.quote(str(one)) for one in (overrides if isinstance(overrides, list) else ())),
        results=tuple((name, options) for name in there for options in _calls(name, files)),
    )


def _calls(name: str, files: RunFiles) -> tuple[Options, ...]:
    """Options of every call of a command that a folder of results has to do with."""
    if name == "evaluation":
        return _of_evaluation(files)
    return (_OPTIONS[name](files) if name in _OPTIONS else (),)


def _of_psf(files: RunFiles) -> Options:
    """Depths other than those of the spec, and a field off the axis."""
    if listed_bytes(files.folder / "psf", "quantised.exr") is None:
        return ()
    bank, scene = read_stored_bank(files.folder / "psf" / "quantised.exr"), files.spec.scene
    usual = tuple(dict.fromkeys((*scene.near_m, *scene.far_m)))
    depths = () if set(bank.depths_m) == set(usual) else tuple(("depths", _length(z)) for z in bank.depths_m)
    angles = " ".join(f"{math.degrees(angle):.12g}" for angle in bank.field_rad)
    return (*depths, *((("field-deg", angles),) if any(bank.field_rad) else ()))


def _of_fabricated(files: RunFiles) -> Options:
    """Where the errors of the plate come from, as its manifest says it in words (`Design.plate_errors`)."""
    words = str(_manifest_of(files.folder / "fabricated").get("plate"))
    if drawn := re.match(r"draw (\S+) of seed (\d+) of the process ", words):
        return ("seed", drawn[2]), *((("draw", drawn[1]),) if drawn[1] != _FIRST_DRAW else ())
    given = words.removeprefix("errors of ")
    return () if given == words else (("variation", shlex.quote(given)),)


def _of_tolerance(files: RunFiles) -> Options:
    study = listed_json(files.folder / "tolerance", "results.json")
    if study is None:
        return ()
    plan, found = study["plan"], [("draws", str(study["plan"]["draws"])), ("seed", str(study["seed"]))]
    if plan.get("sensitivity") not in (None, "one_at_a_time"):
        found.append(("sensitivity", plan["sensitivity"]))
    if plan.get("sensitivity") == "sobol":
        found.append(("sobol", str(plan["sobol"])))
    if plan.get("corners"):
        found.append(("corners", ""))
    if plan.get("budget"):
        found += [("budget", shlex.quote(plan["budget"])), ("yield", f"{plan['wanted']:g}")]
    limits = (study["plates"].get("yield") or {}).get("limits", ())
    return *found, *(("limit", shlex.quote(one["limit"])) for one in limits)


def _of_simulated(files: RunFiles) -> Options:
    record = _manifest_of(files.folder / "simulated")
    found = [(key, shlex.quote(str(record[key]))) for key in ("occlusion", "seed") if key in record]
    return tuple([*found, *((("png", ""),) if "PNG" in str(record.get("image_files")) else ())])


def _of_trained(files: RunFiles) -> Options:
    """Options where it differs from the spec; the folder of the pictures and the files of LPIPS are not known."""
    folder = files.folder / "trained"
    record, own = _manifest_of(folder), files.spec
    usual = {"occlusion": own.scene.occlusion, "obstruction": own.obstruction.kind if own.obstruction else None}
    found = [(key, shlex.quote(str(record[key]))) for key, value in usual.items() if record.get(key, value) != value]
    if "folder" in (masks := _mapping(record.get("obstruction_parameters"))):
        found = [(key, shlex.quote(str(masks["folder"])) if key == "obstruction" else value) for key, value in found]
    pictures = read_json(folder / "pictures.json") if (folder / "pictures.json").is_file() else {}
    if not {*pictures.get("training", ())} <= {path.name for path in sample_files()}:
        found.append(("images", "PICTURES"))
    if str(record.get("perceptual")).startswith("lpips"):
        found.append(("lpips-weights", "WEIGHTS"))
    overrides = record.get("overrides")
    return *found, *(("set", shlex.quote(str(one))) for one in (overrides if isinstance(overrides, list) else ()))


def _of_evaluation(files: RunFiles) -> tuple[Options, ...]:
    """Every table and figure; which rows, pictures and changes of the spec are not known."""
    home, found, own = files.folder / "evaluation", [], spec_digest(files.spec)
    for path in sorted(home.glob("table*/table.json")):
        table = read_json(path)
        study = _mapping(table.get("study"))
        asked = [(key, shlex.quote(str(study[key]))) for key in ("obstruction", "occlusion", "seed") if key in study]
        asked += [("reflect", "")] if study.get("border") == "reflect" else []
        asked += [("lpips-weights", "WEIGHTS")] if str(study.get("perceptual")).startswith("lpips") else []
        if study.get("spec_sha256", own) != own:
            asked.append(("set", "CHANGES"))
        found.append((("table", str(table.get("table"))), *asked, ("pairs", str(table.get("pairs")))))
    for name, figure in {"figure4": "4", "figure8": "8", "bench": "bench"}.items():
        if (home / name).is_dir():
            found.append((("figure", figure),))
    return tuple(found)


def _of_explanations(files: RunFiles) -> Options:
    record = listed_json(files.folder / "explanations", "explanations.json")
    if record is None:
        return ()
    targets = record["targets"]
    found = [
        ("ring-to-disc", f"{targets['ring_to_disc']:g}"),
        ("probe", _length(targets["wavelength_m"])),
        ("depth", _length(targets["depth_m"])),
    ]
    if targets.get("throughput") is not None:
        found += [(key.replace("_", "-"), f"{targets[key]:g}") for key in ("throughput", "throughput_sigma")]
    return *found, ("reach", f"{record['reach']:g}")


def _manifest_of(folder: Path) -> Mapping[str, Any]:
    return read_json(folder / MANIFEST_NAME) if (folder / MANIFEST_NAME).is_file() else {}


def _length(value_m: float) -> str:
    return "inf" if math.isinf(value_m) else shlex.quote(format_length(value_m))


_OPTIONS: Mapping[str, Callable[[RunFiles], Options]] = {
    "psf": _of_psf,
    "fabricated": _of_fabricated,
    "tolerance": _of_tolerance,
    "simulated": _of_simulated,
    "trained": _of_trained,
    "explanations": _of_explanations,
}


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
