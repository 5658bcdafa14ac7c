"""`doedesign reconstruct`: captures through a trained network (`doedesign.recon.files`)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from doedesign.recon.files import reconstruct_files
from doedesign.recon.model import Model
from doedesign.recon.photos import PHOTO_FILES


def model_and_captures(paths: Sequence[Path]) -> tuple[Path | None, list[Path]]:
    """Tell a model's folder from the captures after it; None where there are captures alone."""
    first = paths[0]
    if first.is_file() or (first.suffix.lower() in PHOTO_FILES and not first.is_dir()):
        return None, list(paths)
    return first, list(paths[1:])


def reconstruct(
    model: Path | None,
    captures: Sequence[Path],
    out: Path | None = None,
    *,
    psf: Sequence[Path] = (),
    pixel_m: float | None = None,
    near_m: float | None = None,
    far_m: float | None = None,
    **how: Any,
) -> list[Path]:
    """Reconstruct captures with a model, the released one if None, into OUT, "reconstructed" by default.

    See `doedesign.recon.model.Model.psfs` and `doedesign.recon.files.reconstruct_files` for the rest.
    """
    opened = Model.released() if model is None else Model.open(model)
    psfs = opened.psfs(psf, pixel_m=pixel_m, near_m=near_m, far_m=far_m)
    return reconstruct_files(opened, captures, out or Path("reconstructed"), psfs=psfs, **how)
