"""The picture of a folder to look at first, and all that can be shown of it."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from doedesign.overview.kinds import Record

# The first of these that is there; orders name theirs with the design.
_FIRST = {
    "run": ("orders.png", "area.png", "focus.png", "psf.png", "height.png"),
    "PSFs": ("quantised_psf.png", "continuous_psf.png"),
    "fabricated": ("fabricated_psf.png", "leakage.png"),
    "tolerance": ("yield.png", "histograms.png"),
    "certificate": ("certificate.png",),
    "calibration": ("check.png", "psfs.png"),
    "explanations": ("explanations.png",),
    "training": ("curves.png",),
    "fine-tuning": ("curves.png",),
    "evaluation": ("pictures.png", "table.png"),
    "simulation": ("contact.png",),
    "released model": ("capture.png",),
    "order": ("*_RULES.png", "*_PREVIEW.png", "*_MARKS.png"),
}
_LAYOUTS = ("*_ALL.oas", "*_ALL.gds", "*_ALL.gds.gz")
_LAYERS = "*_LAYERS.lyp"


class Shown(NamedTuple):
    """Files of a folder that can be shown.

    Attributes:
        pictures: PNG files, the most telling first.
        pages: HTML files.
        layout: files for a layout viewer: the layout of all layers and, if there is one, its colours.
    """

    pictures: tuple[Path, ...]
    pages: tuple[Path, ...]
    layout: tuple[Path, ...]


def shown_of(folder: Path, record: Record) -> Shown:
    """Files of a folder that can be shown.

    Args:
        folder: the folder.
        record: what it says of itself.
    """
    wanted = _FIRST.get(record.kind, ())
    first = [path for pattern in wanted for path in sorted(folder.glob(pattern))]
    # Validations are drawn while a training works; the last one is the finished network's.
    late = sorted((folder / "validation").glob("step_*.png"))[-1:]
    pictures = dict.fromkeys([*late, *first, *sorted(folder.glob("*.png"))])
    layout = _found(folder, _LAYOUTS)[:1]
    return Shown(
        tuple(path for path in pictures if not path.name.endswith("_GREY.png")),
        tuple(sorted(folder.glob("*.html"))),
        (*layout, *(_found(folder, (_LAYERS,))[:1] if layout else ())),
    )


def _found(folder: Path, patterns: Sequence[str]) -> tuple[Path, ...]:
    return tuple(path for pattern in patterns for path in sorted(folder.glob(pattern)))
