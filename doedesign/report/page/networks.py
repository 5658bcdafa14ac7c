"""Captures through the plate, their reconstructions, trainings, and the tables of evaluation."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from doedesign.report.history import history_note
from doedesign.report.page.blocks import (
    ChartBlock,
    ChartSeries,
    DividerBlock,
    PageBlock,
    PageImage,
    PageSection,
    PictureBlock,
    TableBlock,
    TextBlock,
    section,
)
from doedesign.report.page.files import (
    RunFiles,
    history_of,
    listed_bytes,
    listed_csv,
    listed_json,
    listed_picture,
    picture_image,
    pixels_image,
    training_of,
)
from doedesign.report.page.numbers import label_of, number, rounded
from fab.errors import InputError
from fab.files import MANIFEST_NAME, read_bytes, read_json, sha256_bytes

_MOST_SCENES = 4
_MOST_POINTS = 1500
_WIDEST_PX = 640


def history_section(files: RunFiles) -> PageSection | None:
    """Loss of the optimisation over its steps.

    Args:
        files: the run.
    """
    return section("history", "Optimisation", [history_chart(history_of(files), history_note(files.spec))])


def history_chart(records: Sequence[Mapping[str, Any]], note: str = "") -> ChartBlock | None:
    """Loss and its terms over the steps; of an efficiency what is missing.

    Args:
        records: a record per step.
        note: why the loss is not smooth (`history_note`).
    """
    if not records:
        return None
    kept = records[:: -(-len(records) // _MOST_POINTS)]
    values = np.array([[one["loss"], *one.get("terms", [])] for one in kept], np.float64)
    names = ["loss", *(name.rpartition(":")[2] for name in kept[0].get("names", []))]
    if "efficiency" in names:
        at = names.index("efficiency")
        names[at], values[:, at] = "1 - efficiency", 1 - values[:, at]
    # A only term is the loss.
    columns = [k for k in range(len(names)) if k == 0 or not np.allclose(values[:, k], values[:, 0])]
    series = tuple(ChartSeries(names[k], tuple(rounded(v) for v in values[:, k].tolist())) for k in columns)
    steps = tuple(float(one["step"] + 1) for one in kept)
    spread = bool(values[:, 0].min() > 0 and values[:, 0].max() > 30 * values[:, 0].min())
    return ChartBlock("Loss and its terms, without weights", "step", "loss", steps, series, y_log=spread, note=note)


def captures_section(files: RunFiles) -> PageSection | None:
    """Captures with the plate and without, before and after reconstruction.

    Args:
        files: the run.
    """
    return section("captures", "Captures", [_divider(files), *_validation(files)])


def _divider(files: RunFiles) -> DividerBlock | None:
    """Simulated captures, each with what was reconstructed of it."""
    folder = files.folder / "simulated"
    if not (folder / MANIFEST_NAME).is_file():
        return None
    listed = read_json(folder / MANIFEST_NAME).get("results_sha256") or {}
    made = _reconstructions(files)
    scenes = []
    for key in [name for name in sorted(listed) if name.endswith(f"/{MANIFEST_NAME}")]:
        item = folder / key.removesuffix(f"/{MANIFEST_NAME}")
        if listed_bytes(folder, key) is None or len(scenes) == _MOST_SCENES:
            break
        digests = read_json(item / MANIFEST_NAME)["sha256"]
        images = read_json(item / MANIFEST_NAME)["images"]
        pictures = []
        for kind, label in (("conventional", "camera without the plate"), ("capture", "camera with the plate"),
                            ("clean", "scene")):  # fmt: skip
            file = images[kind]["file"]
            _require(item / file, digests[file])
            pictures.append((label, _display(item / file).source))
            if kind == "capture" and (result := made.get(digests[file])) is not None:
                _require(*result)
                pictures.append(("reconstruction", _display(result[0]).source))
        scenes.append((item.name.partition("_")[2].replace("_", " "), tuple(pictures)))
    if not scenes:
        return None
    note = "Choose two pictures and move the divider with the mouse, a finger or the arrow keys."
    return DividerBlock("Before and after", tuple(scenes), note)


def _require(path: Path, digest: str) -> None:
    if sha256_bytes(read_bytes(path)) != digest:
        cure = "Restore it, or simulate again."
        raise InputError(str(path), "must be the file that the manifest lists", "a changed file", cure)


def _reconstructions(files: RunFiles) -> dict[str, tuple[Path, str]]:
    """Reconstructions beside the run, of whatever run, with their digests, by the digest of their capture."""
    if files.reconstructed is None:
        return {}
    results = read_json(files.reconstructed / MANIFEST_NAME).get("results")
    found: dict[str, tuple[Path, str]] = {}
    for name, one in sorted(results.items()) if isinstance(results, dict) else ():
        # Of a picture without a digest the command was stopped.
        path = files.reconstructed / name
        if path.name == name and isinstance(one, dict) and "sha256" in one and path.is_file():
            # The first by name is the picture alone, before the one beside its capture.
            found.setdefault(str(one.get("capture_sha256")), (path, str(one["sha256"])))
    return found


def _display(path: Path) -> PageImage:
    """A picture in linear light, or of display values, for a page."""
    if path.suffix.lower() != ".exr":
        return picture_image(path, photo=True)
    from sim.light import srgb_from_linear  # loads jax
    from sim.store import read_picture

    channels, _ = read_picture(path)
    names = [name for name in "RGB" if name in channels] or sorted(channels)[:1]
    light = np.stack([channels[name] for name in (names if len(names) == 3 else names[:1] * 3)], axis=-1)
    factor = -(-light.shape[1] // _WIDEST_PX)
    ny, nx = (n // factor * factor for n in light.shape[:2])
    light = light[:ny, :nx].reshape(ny // factor, factor, nx // factor, factor, 3).mean(axis=(1, 3))
    shown = np.asarray(srgb_from_linear(np.clip(light, 0, 1).astype(np.float32)))
    return pixels_image(np.rint(255 * shown).astype(np.uint8), photo=True)


def _validation(files: RunFiles) -> Iterator[PictureBlock]:
    """The last sheet of scenes that a training was not shown, and the contact sheet of captures."""
    for name, title in (("trained", "After training"), ("finetuned", "After fine-tuning")):
        sheets = sorted((files.folder / name / "validation").glob("step_*.png"))
        if sheets:
            words = f"{title}: capture, reconstruction, scene"
            yield PictureBlock(words, words, picture_image(sheets[-1], photo=True), ink=False)


def training_section(files: RunFiles) -> PageSection | None:
    """Curves and scores of trainings.

    Args:
        files: the run.
    """
    blocks: list[PageBlock | None] = []
    for name, title in (("trained", "Training"), ("finetuned", "Fine-tuning")):
        blocks += [*_curves(training_of(files.folder / name), title), _scores(files.folder / name, title)]
    return section("training", "Training", blocks)


def _curves(records: Sequence[Mapping[str, Any]], title: str) -> Iterator[ChartBlock]:
    if not records:
        return
    kept = records[:: -(-len(records) // _MOST_POINTS)]
    steps = tuple(float(one["step"] + 1) for one in kept)
    series = [ChartSeries("loss", tuple(rounded(one["loss"]) for one in kept))]
    for part in sorted({part for one in kept for part in one.get("parts", {})}):
        values = tuple(rounded(one.get("parts", {}).get(part)) for one in kept)
        if any(values):
            series.append(ChartSeries(part, values))
    note = "Every step sees other scenes, so that the curve jumps."
    yield ChartBlock(f"{title}: loss", "step", "loss", steps, tuple(series), note=note)
    judged = [one for one in records if "validation" in one]
    if len(judged) > 1:
        lines = []
        for region in ("occluded", "full"):
            for which in ("reconstruction", "capture"):
                values = tuple(rounded(one["validation"][which][region]["psnr"]) for one in judged)
                lines.append(ChartSeries(f"{which}, {region}", values, dashed=which == "capture"))
        at = tuple(float(one["step"] + 1) for one in judged)
        label = "PSNR on held-out pictures (dB)"
        yield ChartBlock(f"{title}: validation", "step", label, at, tuple(lines), markers=True)


def _scores(folder: Path, title: str) -> TableBlock | None:
    """Scores of a finished training and of its baselines on held-out scenes."""
    found = listed_json(folder, "metrics.json")
    if found is None:
        return None
    methods = [name for name, one in found.items() if isinstance(one, Mapping) and "full" in one]
    kinds = sorted({kind for name in methods for region in found[name].values() for kind in region})
    columns = [(region, kind) for region in ("occluded", "full") for kind in kinds]
    rows = tuple(
        (label_of(name), *(number(found[name].get(region, {}).get(kind)) for region, kind in columns))
        for name in methods
    )
    head = ("picture", *(f"{kind.upper()}, {region}" for region, kind in columns))
    note = f"Means over {len(found.get('scenes', []))} scenes that were not trained on."
    return TableBlock(f"{title}: scores", head, rows, note)


def evaluation_section(files: RunFiles) -> PageSection | None:
    """Tables and figures of an evaluation.

    Args:
        files: the run.
    """
    home = files.folder / "evaluation"
    blocks: list[PageBlock | None] = []
    for path in sorted(home.glob("*/table.json")):
        blocks += _table(read_json(path), path.parent)
    for path in sorted(home.glob("*/figure.png")):
        picture = listed_picture(path.parent, "figure.png")
        if picture is not None:
            title = path.parent.name.replace("figure", "Figure ")
            blocks.append(PictureBlock(title, f"{title} of the evaluation", picture))
        for name in ("plates.csv", "depths.csv", "images.csv"):
            rows = listed_csv(path.parent, name)
            if rows:
                body = tuple(tuple(value or "" for value in row.values()) for row in rows)
                blocks.append(
                    TableBlock(f"{path.parent.name}, {name}", tuple(map(label_of, rows[0])), body, folded=True)
                )
    return section("evaluation", "Evaluation", blocks)


def _score_text(score: Mapping[str, Any] | None) -> str:
    """A mean and its interval, where there is one."""
    if not score:
        return "–"
    within = "" if score["low"] is None else f" ({score['low']:.3f} to {score['high']:.3f})"
    return f"{score['mean']:.3f}{within}"


def _table(table: Mapping[str, Any], folder: Path) -> Iterator[PageBlock]:
    """One table of scores, and its pictures."""
    columns = [(region, score) for region in ("occluded", "full") for score in ("psnr", "ssim", "lpips", "closeness")
               if any(((row["scores"].get(region) or {}).get(score)) for row in table["rows"])]  # fmt: skip
    rows, left = [], []
    for row in table["rows"]:
        if row["why_not"]:
            left.append(f"{row['label']}: {row['why_not']}")
            continue
        cells = [(row["scores"].get(region) or {}).get(score) for region, score in columns]
        shown = map(_score_text, cells)
        paper = row["paper"] or {}
        rows.append((row["label"], *shown, number(paper.get("psnr")), number(paper.get("full_psnr"))))
    head = ("row", *(f"{score.upper() if len(score) < 6 else score}, {region}" for region, score in columns),
            "paper, PSNR occluded", "paper, PSNR full")  # fmt: skip
    title = f"Table {table['table']}: {folder.name}"
    yield TableBlock(title, head, tuple(rows), f"{table['pairs']} pairs; in brackets the 95 % interval.")
    if left:
        yield TextBlock(tuple(left), title="Rows without scores")
    if (folder / "pictures.png").is_file():
        picture = picture_image(folder / "pictures.png", photo=True)
        yield PictureBlock(f"{title}: pictures", "Pairs as every row shows them", picture, ink=False)
