"""`doedesign train`: the reconstruction network of a run, and the heights of its DOE with it unless they are frozen."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from doedesign.runs.folder import open_run, spec_with
from doedesign.runs.level_maps import open_design
from doedesign.training.train import train as train_design

_FREE = ("scene", "sensor", "obstruction", "network", "train")


def train(
    run_folder: Path, images: Path | None = None, out: Path | None = None, *, overrides: Sequence[str] = (), **how: Any
) -> Path:
    """Train the network of a finished run into OUT, RUN/trained by default; return the folder.

    Args:
        run_folder: the run.
        images: folder of pictures.
        out: folder.
        overrides: changes to [scene], [sensor], [obstruction], [network] and [train] of the run's spec.
        how: see `doedesign.training.train.train`.
    """
    run, folder = open_run(run_folder), out or run_folder / "trained"
    # The run's own levels: a mask order of it may draw them otherwise.
    design = replace(open_design(run, levels=run.spec.process.levels), spec=spec_with(run, overrides, _FREE))
    train_design(design, images, folder, overrides=overrides, **how)
    return folder
