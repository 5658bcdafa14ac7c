"""`doedesign finetune`: a trained network on real captures, each with a picture of what was to be seen."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from doedesign.recon.model import Model
from doedesign.training.finetune import finetune as finetune_model


def finetune(
    model_folder: Path,
    pairs: Path,
    out: Path | None = None,
    *,
    psf: Sequence[Path] = (),
    pixel_m: float | None = None,
    near_m: float | None = None,
    far_m: float | None = None,
    **how: Any,
) -> Path:
    """Fine-tune a model on a folder of pairs into OUT, RUN/finetuned by default; return the folder.

    See `doedesign.recon.model.Model.psfs` and `doedesign.training.finetune.finetune` for the rest.
    """
    folder, model = out or model_folder / "finetuned", Model.open(model_folder)
    psfs = model.psfs(psf, pixel_m=pixel_m, near_m=near_m, far_m=far_m)
    finetune_model(model, pairs, folder, psfs=psfs, **how)
    return folder
