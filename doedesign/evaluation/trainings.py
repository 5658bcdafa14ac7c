"""Networks that rows of a table need: found where they are finished, trained where that is asked for.

    OUT/trained/OCCLUSION/OBSTRUCTION/NAME_SEED/    a training as `doedesign train` writes it, or that of a rival

A finished training of the design's own run (`RUN/trained`, or a released model) with the same seed, occlusion model and
obstruction stands for "proposed". All are trained on the same pictures, with the steps, sizes and seeds of the
design's spec.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from doedesign.design.design import Design
from doedesign.evaluation.rivals.training import train_rival
from doedesign.evaluation.rows import FLAT, ROBUST, Training
from doedesign.recon.weights import NETWORK_NAME, read_network
from doedesign.runs.folder import RELEASED, TRAINING_TABLES, open_run
from doedesign.runs.level_maps import open_design
from doedesign.training.train import train
from fab.files import MANIFEST_NAME, read_json


@dataclass(frozen=True, eq=False)
class TrainingPlan:
    """Pictures and changes that networks are trained with, and where they are kept.

    Attributes:
        run: run folder of the design.
        out: folder of everything.
        occlusion: occlusion model.
        obstruction: kind of obstruction, or folder of masks.
        overrides: changes to the spec, "table.key=value".
        images: folder of pictures to train on; scikit-image's samples if None.
        validation: folder of pictures to judge by.
        licence: licence of the pictures, for the record.
        robust: run folder of a robust design, if there is one.
        lpips_weights: files with the weights of LPIPS.
    """

    run: Path
    out: Path
    occlusion: str
    obstruction: str
    overrides: tuple[str, ...] = ()
    images: Path | None = None
    validation: Path | None = None
    licence: str | None = None
    robust: Path | None = None
    lpips_weights: Sequence[Path] = ()

    def folder(self, training: Training, seed: int) -> Path:
        """Folder of a training, or the run's own where that is the same."""
        if training.name == "proposed" and not self.overrides:
            for own in (self.run / "trained", self.run):
                if self._is_same(own, seed):
                    return own
        return self.out / "trained" / self.occlusion / Path(self.obstruction).name / f"{training.name}_{seed}"

    def _is_same(self, folder: Path, seed: int) -> bool:
        if not _is_finished(folder):
            return False
        about = read_network(folder / NETWORK_NAME)[1]
        asked = {"occlusion": self.occlusion, "obstruction": self.obstruction, "camera": "doe"}
        if any(about.get(key) != value for key, value in asked.items()):
            return False
        return open_run(folder).spec.train.seed == seed

    def done(self, training: Training, seed: int) -> bool:
        """Whether a training is finished."""
        return _is_finished(self.folder(training, seed))

    def design(self, training: Training, seed: int) -> Design:
        """The design that a training begins with."""
        if training.plate not in (None, FLAT):
            source = self.folder(Training(training.plate), seed)
        else:
            source = self.robust if training.name == ROBUST else self.run
        assert source is not None  # rows of a robust design come with one
        return open_design(source, False, overrides=self.changes(training, seed), free=TRAINING_TABLES)

    def changes(self, training: Training, seed: int) -> tuple[str, ...]:
        """Changes to the spec of the design that a training makes."""
        return (*self.overrides, f"train.seed={seed}", *training.changes)


def _is_finished(folder: Path) -> bool:
    if not (folder / MANIFEST_NAME).is_file() or not (folder / NETWORK_NAME).is_file():
        return False
    found = read_json(folder / MANIFEST_NAME)
    return found.get("state") == "done" or found.get("format") == RELEASED


def train_missing(plan: TrainingPlan, trainings: Iterable[Training], seeds: Sequence[int]) -> None:
    """Train all that is not finished, seed by seed; a training that was stopped goes on.

    Raises:
        InputError: pictures or options that cannot be used.
        KeyboardInterrupt: it was stopped; the same call goes on from there.
    """
    for seed in seeds:
        for one in trainings:
            if not plan.done(one, seed):
                _train(plan, one, seed)


def _train(plan: TrainingPlan, one: Training, seed: int) -> None:
    design, folder = plan.design(one, seed), plan.folder(one, seed)
    how: dict[str, Any] = {
        "occlusion": plan.occlusion,
        "obstruction": plan.obstruction,
        "validation": plan.validation,
        "lpips_weights": plan.lpips_weights,
        "licence": plan.licence,
        "overrides": plan.changes(one, seed),
    }
    if one.rival is None:
        train(design, plan.images, folder, **how)
    else:
        train_rival(one.rival, design, plan.images, folder, **how)


def lacking(plan: TrainingPlan, trainings: Iterable[Training], seeds: Sequence[int]) -> dict[str, str]:
    """Why each training that is not finished for all seeds cannot be used, by name."""
    found = {}
    for one in trainings:
        open_ = [seed for seed in seeds if not plan.done(one, seed)]
        if open_:
            what = "seed" if len(open_) == 1 else "seeds"
            found[one.name] = f"not trained for {what} {', '.join(map(str, open_))}"
    return found
