"""Judgement of a network on pictures that it is never trained on: their choice, their scores by region, and means.

Without a folder of their own they are the last of the training folder in an order shuffled by the seed; whatever has
the same bytes as one of them under another name is not trained on either. (Neighbouring frames of a film are almost the
same picture: hold out another film, in a folder of its own.) Their scenes are the same at every look: one crop, one
obstruction and one noise each. Another seed of the training deals the same obstructions out to other pictures.
"""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.capture.images import picture_files
from doedesign.report.sheet import ValidationRow
from doedesign.training.distance.perceptual import Lpips
from doedesign.training.scores import scores_of_one
from fab.errors import InputError
from fab.files import explain_os_error, sha256_file

_log = logging.getLogger("doedesign")

SCENE_SEED = 2 << 32  # beyond the seeds of trainings, whose obstructions are none of these

_ORDER = 1  # apart from the epochs' orders
_MOST_ROWS = 4


class Split(NamedTuple):
    """Files of pictures, or of pairs, to train on, and those that are held out, without a view in common."""

    training: tuple[Any, ...]
    held_out: tuple[Any, ...]
    left_out: tuple[Any, ...] = ()  # neither, since they share a file's content with one held out


def split_pictures(images: Path | None, validation: Path | None, count: int, seed: int) -> Split:
    """Find pictures to train on, and a number to hold out.

    Pictures are those of a folder, or scikit-image's samples, and the held-out ones come from a `validation` folder, if
    there is one, and are all of it if it has fewer. Otherwise at most half of the pictures are held out.

    Raises:
        InputError: a folder that cannot be used, or nothing left to train on or to hold out.
    """
    files = picture_files(images)
    pool = files if validation is None else picture_files(validation)
    where = str(images or "scikit-image's pictures")
    if validation is None and count > len(files) // 2:
        count = len(files) // 2
        if not count:
            cure = "Add pictures, or give those to hold out a folder of their own."
            raise InputError(where, "must hold one picture to train on and one to hold out", len(files), cure)
        _log.info("%d of the %d pictures are held out, as many as are trained on", count, len(files))
    order = np.random.default_rng((seed, _ORDER)).permutation(len(pool))[-count:]
    held_out = tuple(pool[k] for k in order)
    training = _without(files, held_out if validation is None else pool)
    if not training:
        cure = "Hold out other pictures than those to train on."
        raise InputError(where, "a picture must be left to train on", "only those held out", cure)
    return Split(training, held_out)


def _without(files: Sequence[Path], held_out: Sequence[Path]) -> tuple[Path, ...]:
    """Files whose content is not that of one held out."""
    try:
        sizes = {path.stat().st_size for path in held_out}
        digests = {sha256_file(path) for path in held_out}
        return tuple(p for p in files if p.stat().st_size not in sizes or sha256_file(p) not in digests)
    except OSError as error:
        raise explain_os_error(error, str(error.filename)) from error


class HeldOutScene(NamedTuple):
    """A scene that is never trained on: sharp mask of the obstruction, and display values in the camera's colours.

    Those are of the scene alone, and by name of what is `shown`, "capture" and "reconstruction" among them.
    """

    name: str
    shown: Mapping[str, Float[np.ndarray, "c y x"]]
    scene: Float[np.ndarray, "c y x"]
    mask: Float[np.ndarray, "y x"]


class EvaluationResult(NamedTuple):
    """Scores on held-out scenes.

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
    looks: Iterable[HeldOutScene],
    lpips: Lpips | None,
    to_rgb: Callable[[Float[np.ndarray, "c y x"]], Float[np.ndarray, "3 y x"]],
) -> EvaluationResult:
    """Judge scenes with their pictures; `to_rgb` turns the camera's colours into red, green and blue to look at."""
    scenes, found, rows = [], [], []
    for look in looks:
        judged = {name: scores_of_one(image, look.scene, look.mask, lpips) for name, image in look.shown.items()}
        found.append(judged)
        scenes.append({"name": look.name, "covered": float(look.mask.mean(dtype=np.float64)), **judged})
        if len(rows) < _MOST_ROWS:
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
