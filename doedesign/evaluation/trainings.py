"""Networks that rows of a table need: found where they are finished, trained where that is asked for.

    OUT/trained/OCCLUSION/OBSTRUCTION/NAME_SEED/    a training as `doedesign train` writes it, or that of a rival

A finished training of the design's own run (`RUN/trained`, or a released model) with the same seed, occlusion model and
kind of obstruction, or masks, stands for "proposed". All are trained on the same pictures, with the steps, sizes and
seeds of the design's spec; others in OUT are refused. On a processor several are trained side by side, each by a
process with one thread: a training keeps little more than one core busy, however many there are.
"""

import json
import logging
import os
import threading
import uuid
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import jax

from doedesign.capture.from_spec import obstruction_from_spec, plain_parameters
from doedesign.design.design import Design
from doedesign.evaluation.rivals.files import rival_named
from doedesign.evaluation.rivals.training import rival_options, train_rival
from doedesign.evaluation.rows import ROBUST, Training
from doedesign.recon.weights import NETWORK_NAME, read_network
from doedesign.runs.folder import RELEASED, TRAINING_TABLES, open_run
from doedesign.runs.level_maps import open_design
from doedesign.runtime.pool import default_workers, evaluate_here
from doedesign.runtime.progress import meter
from doedesign.training.history import HISTORY_NAME
from doedesign.training.train import prepared, train
from fab.errors import InputError
from fab.files import MANIFEST_NAME, canonical_json, read_json
from sim.obstruction import OBSTRUCTIONS, MaskFolder

_TRAINING_BYTES = 4 << 30  # an estimate: a training at its peak, crops of 256 pixels
_log = logging.getLogger("doedesign")


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
        about, kind = read_network(folder / NETWORK_NAME)[1], self.obstruction
        kind = kind if kind in OBSTRUCTIONS else MaskFolder.name
        asked = {"occlusion": self.occlusion, "obstruction": kind, "camera": "doe"}
        if any(about.get(key) != value for key, value in asked.items()):
            return False
        if kind != self.obstruction and not self._has_masks(about.get("obstruction_parameters")):
            return False
        return open_run(folder).spec.train.seed == seed

    def _has_masks(self, told: Any) -> bool:
        """Whether parameters of an obstruction, as a training tells them, are of the masks in the plan's folder."""
        masks = obstruction_from_spec(open_run(self.run).spec, str(self.run / "spec.toml"), self.obstruction)
        wanted = plain_parameters(masks)["files_sha256"]
        return isinstance(told, dict) and told.get("files_sha256") == wanted

    def done(self, training: Training, seed: int) -> bool:
        """Whether a training is finished."""
        return _is_finished(self.folder(training, seed))

    def design(self, training: Training, seed: int) -> Design:
        """The design that a training begins with."""
        if training.after is not None:
            source = self.folder(Training(training.after), seed)
        else:
            source = self.robust if training.name == ROBUST else self.run
        assert source is not None  # rows of a robust design come with one
        found = open_design(source, False, overrides=self.changes(training, seed), free=TRAINING_TABLES)
        return self._as_the_others(found, training, seed) if training.name == ROBUST else found

    def _as_the_others(self, robust: Design, training: Training, seed: int) -> Design:
        """A robust design with scenes, sensor and training of the run, for both are rows of one table."""
        own = open_design(self.run, False, overrides=self.changes(training, seed), free=TRAINING_TABLES).spec
        assert own is not None  # every run has one
        assert robust.spec is not None
        tables = {name: getattr(own, name) for name in TRAINING_TABLES}
        return replace(robust, spec=robust.spec.model_copy(update=tables))

    def design_after(self, training: Training, seed: int) -> Design:
        """The design that a training leaves; it must be finished, unless it keeps its plate."""
        if training.keeps_plate:
            return self.design(training, seed)
        return open_design(self.folder(training, seed), False)

    def changes(self, training: Training, seed: int) -> tuple[str, ...]:
        """Changes to the spec of the design that a training makes."""
        return (*self.overrides, f"train.seed={seed}", *training.changes)


def require_asked(
    plan: TrainingPlan, trainings: Iterable[Training], seeds: Sequence[int], *, pictures: bool, loss: bool
) -> None:
    """Refuse finished trainings that were made of something else than what is asked for, which their names do not say.

    Of one in the run's own folder that is said, not refused: it was made for itself.

    Args:
        plan: what they have in common.
        trainings: the trainings.
        seeds: seeds of each.
        pictures: whether pictures to train on are given, so that they matter.
        loss: whether weights of LPIPS are for training, too.

    Raises:
        InputError: a training of another spec, plate, obstruction, loss or other pictures.
    """
    keys = ["spec_sha256", "obstruction_parameters"]
    keys += ["pictures_sha256", "held_out_sha256"] if pictures else []
    keys += ["perceptual_sha256"] if loss else []
    for one, seed in ((one, seed) for one in trainings for seed in seeds):
        if not plan.done(one, seed) or (one.after and not plan.done(Training(one.after), seed)):
            continue
        rival = None if one.rival is None else rival_named(one.rival)
        made = prepared(
            plan.design(one, seed),
            plan.images,
            plan.validation,
            plan.occlusion,
            plan.obstruction,
            plan.lpips_weights if loss else (),
            plan.licence,
            {} if rival is None else rival_options(rival),
        )
        folder = plan.folder(one, seed)
        found, wanted = read_json(folder / MANIFEST_NAME), json.loads(canonical_json(made.settings))
        looked_at = keys if rival is not None else [*keys, "height_sha256"]
        if not (different := [key for key in looked_at if found.get(key, wanted[key]) != wanted[key]]):
            continue
        what = ", ".join(map(_in_words, different))
        if not folder.is_relative_to(plan.out / "trained"):
            _log.warning("%s stands for %s; what is asked for differs from it in its %s", folder, one.name, what)
            continue
        rule = f"must be the training {one.name} that is asked for"
        cure = "Choose another folder for all, or remove this training."
        raise InputError(str(folder), rule, f"one that differs in its {what}", cure)


def _in_words(key: str) -> str:
    return {"height_sha256": "plate", "obstruction_parameters": "obstruction"}.get(
        key, key.removesuffix("_sha256").replace("_", " ")
    )


def _is_finished(folder: Path) -> bool:
    if not (folder / MANIFEST_NAME).is_file() or not (folder / NETWORK_NAME).is_file():
        return False
    found = read_json(folder / MANIFEST_NAME)
    return found.get("state") == "done" or found.get("format") == RELEASED


def train_missing(
    plan: TrainingPlan, trainings: Iterable[Training], seeds: Sequence[int], workers: int | None = None
) -> None:
    """Train all that is not finished; a training that was stopped goes on.

    Args:
        plan: what they have in common.
        trainings: the trainings.
        seeds: seeds of each.
        workers: how many to train side by side on a processor; as many as cores and memory allow if None, 0 or 1 for
            one after the other in this process. Another device has one after the other.

    Raises:
        InputError: pictures or options that cannot be used.
        KeyboardInterrupt: it was stopped; the same call goes on from the last checkpoints.
    """
    missing = [(one, seed) for seed in seeds for one in trainings if not plan.done(one, seed)]
    most = default_workers(_TRAINING_BYTES) if workers is None else workers
    if min(most, len(missing)) < 2 or jax.default_backend() != "cpu":
        for one, seed in missing:
            _train(plan, one, seed)
        return
    with _steps_shown(plan, missing):
        for later in (False, True):
            part = {f"{one.name}_{seed}": (one, seed) for one, seed in missing if (one.after is not None) == later}
            for name, _ in evaluate_here(TrainingWork(plan), part, most):
                _log.info("trained %s", name)


@dataclass(frozen=True, eq=False)
class TrainingWork:
    """Trainings of a plan as work for processes of their own; called with a training and its seed."""

    plan: TrainingPlan
    noun: ClassVar[str] = "training"
    token: str = field(default_factory=lambda: uuid.uuid4().hex)

    def __call__(self, item: tuple[Training, int]) -> None:
        """Train one."""
        with open(os.devnull, "w") as nowhere, redirect_stderr(nowhere):  # the progress of all is shown together
            _train(self.plan, *item)


@contextmanager
def _steps_shown(plan: TrainingPlan, missing: Sequence[tuple[Training, int]]) -> Iterator[None]:
    """Show how many steps the trainings of other processes have taken, by the lines of their histories."""
    spec = open_design(plan.run, False, overrides=plan.overrides, free=TRAINING_TABLES).spec
    assert spec is not None  # every run has one
    files, ended = [plan.folder(*each) / HISTORY_NAME for each in missing], threading.Event()

    def done() -> int:
        return sum(path.read_bytes().count(b"\n") for path in files if path.is_file())

    with meter(f"steps of {len(missing)} trainings", spec.train.steps * len(missing), done()) as progress:

        def watch() -> None:
            seen, going = -1, True
            while going:  # and once more when all has ended
                going = not ended.wait(1.0)
                if (count := done()) != seen:
                    progress.advance(seen := count)

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            ended.set()
            watcher.join()


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
