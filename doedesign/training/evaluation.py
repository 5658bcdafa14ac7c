"""How well a network does on what it was never trained on: scores by region, their means, and pictures to look at."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.report.sheet import ValidationRow
from doedesign.training.perceptual import Lpips
from doedesign.training.scores import Scores, scores
from doedesign.training.validation import ValidationSample


class EvaluationResult(NamedTuple):
    """What a look at held-out scenes found.

    Attributes:
        means: scores by kind of picture ("capture", "reconstruction", others), region and name, averaged over the
            scenes.
        scenes: the same of every scene, with its "name" and how much of it is "covered".
        rows: the first scenes, for a picture.
    """

    means: dict[str, Any]
    scenes: list[dict[str, Any]]
    rows: list[ValidationRow]


def judge(
    looks: Iterable[ValidationSample],
    lpips: Lpips | None,
    to_rgb: Callable[[Float[np.ndarray, "c y x"]], Float[np.ndarray, "3 y x"]],
    most_rows: int = 4,
) -> EvaluationResult:
    """Judge the pictures of scenes.

    Args:
        looks: the scenes with their pictures, "capture" and "reconstruction" among them.
        lpips: weights of LPIPS, if at hand.
        to_rgb: the camera's colours -> red, green and blue, for a picture.
        most_rows: scenes to keep for a picture.
    """
    scenes, found, rows = [], [], []
    for look in looks:
        judged = {
            name: _told(scores(image[None], look.scene[None], look.mask[None], lpips))
            for name, image in look.shown.items()
        }
        found.append(judged)
        scenes.append({"name": look.name, "covered": float(look.mask.mean(dtype=np.float64)), **judged})
        if len(rows) < most_rows:
            shown = (to_rgb(image) for image in (look.shown["capture"], look.shown["reconstruction"], look.scene))
            rows.append(ValidationRow(_label(look.name, judged), *shown))
    means = {
        kind: {
            region: {name: _mean([each[kind][region][name] for each in found]) for name in values}
            for region, values in of_kind.items()
        }
        for kind, of_kind in found[0].items()
    }
    return EvaluationResult(means, scenes, rows)


def _told(found: Scores) -> dict[str, dict[str, float | None]]:
    """Scores of one scene for JSON; None where there is none."""
    return {
        region: {
            name: float(values[0]) if np.isfinite(values[0]) else None
            for name, values in of_region._asdict().items()
            if values is not None
        }
        for region, of_region in found._asdict().items()
    }


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _label(name: str, judged: Mapping[str, Any]) -> str:
    """Name and PSNR of a scene, before and after; in brackets where it is covered."""

    def decibels(kind: str) -> str:
        full, hidden = (judged[kind][region]["psnr"] for region in ("full", "occluded"))
        text = "?" if full is None else f"{full:.1f} dB"
        return text if hidden is None else f"{text} ({hidden:.1f})"

    return f"{name}: {decibels('capture')} to {decibels('reconstruction')}"
