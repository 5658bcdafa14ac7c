"""A table of the paper from a design, on one set of pairs, for one obstruction and one occlusion model.

    OUT/
        trained/...                         networks (`doedesign.evaluation.trainings`)
        pictures/                           scikit-image's samples, shared out, where no folders are given
        table2-dirt-paper/
            study.json, scores.jsonl        what is asked, and every score as soon as there is one
            pairs.csv                       the pairs: photograph, distances, share that is covered
            table.json, table.csv, table.tex
            pictures.png                    some pairs as every row shows them
            external/NAME/in, out           what other programs see, and what they make of it

The same call goes on where it was stopped. A row that cannot be computed stands in the table with the reason.
"""

import logging
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from doedesign.capture.from_spec import plain_parameters
from doedesign.capture.images import PICTURE_FILES, picture_files, sample_files
from doedesign.capture.scenes import require_seed
from doedesign.design.design import Design
from doedesign.evaluation.candidates import Candidate, Unscored, candidates_of
from doedesign.evaluation.external import GIVEN, ExternalMethod, file_of, read_pair, run_program, write_pair
from doedesign.evaluation.pairs import PairSet
from doedesign.evaluation.plates import PlateBanks, plates_of
from doedesign.evaluation.rows import FLAT, MethodRow, rows_of, trainings_of
from doedesign.evaluation.scoring import PairWork, RowScores, ScoreLines
from doedesign.evaluation.tables import EvaluationTable, PairFacts, folder_name, table_of, write_table
from doedesign.evaluation.trainings import TrainingPlan, lacking, require_asked, train_missing
from doedesign.runs.folder import TRAINING_TABLES
from doedesign.runs.journal import Journal
from doedesign.runs.level_maps import open_design
from doedesign.runtime.cluster import evaluate_there
from doedesign.runtime.pool import default_workers, evaluate_here
from doedesign.runtime.progress import meter
from doedesign.runtime.stopping import stoppable
from doedesign.spec import spec_digest
from doedesign.training.distance.perceptual import Lpips, read_lpips
from fab.errors import InputError
from fab.files import canonical_json, path_of, read_bytes, sha256_bytes, sha256_file, write_atomic
from fab.process import Process
from sim.camera import Camera
from sim.imaging.convolve import Border

PAIRS, DRAWS = 200, 4
_FORMAT = "doedesign evaluation 1"
_PAIR_BYTES = 1 << 30  # an estimate: networks and one pair at the peak of a worker
_log = logging.getLogger("doedesign")


class Sources(NamedTuple):
    """Folders of pictures to train on and to judge by, and the licence of the first where it is known."""

    images: Path
    test: Path
    licence: str | None


def evaluate(
    source: str | Path,
    out: str | Path | None = None,
    *,
    table: int = 2,
    rows: Sequence[str] = (),
    occlusion: str | None = None,
    obstruction: str | None = None,
    pairs: int = PAIRS,
    images: str | Path | None = None,
    test: str | Path | None = None,
    licence: str | None = None,
    train: bool = False,
    seeds: Sequence[int] = (0,),
    seed: int = 0,
    border: Border = "own",
    robust: str | Path | None = None,
    process: Process | str | Path | None = None,
    draws: int = DRAWS,
    methods: Sequence[str] = (),
    lpips_weights: Sequence[Path] = (),
    overrides: Sequence[str] = (),
    workers: int | None = None,
    scheduler: str | None = None,
) -> EvaluationTable:
    """Score the rows of one of the paper's tables.

    Args:
        source: run folder of the design, or the folder of a released model.
        out: folder of everything; RUN/evaluation if None.
        table: 1 (networks and deconvolution behind a plate) or 2 (against other cameras and single-image methods).
        rows: names of the rows to compute, as in the table's files; all of them if empty.
        occlusion: occlusion model (`sim.imaging.occlusion`); that of the spec if None.
        obstruction: kind, or folder of masks; that of the spec if None.
        pairs: number of test pairs.
        images: folder of pictures to train on; some of scikit-image's samples if None.
        test: folder of pictures to judge by, with no name of a picture to train on; the others of them if None.
        licence: licence of the pictures to train on, for the record.
        train: train what is missing; otherwise such rows are left out.
        seeds: seeds of the trainings.
        seed: seed of the pairs.
        border: "own" where scenes go on beyond a capture, or "reflect" where they are mirrored, as in training.
        robust: run folder of a robust design of the same camera, whose rows are added to Table 2.
        process: process of the plates as fabricated; that of the design's spec if None.
        draws: plates as fabricated, over which the pairs are shared out.
        methods: programs of other people (`ExternalMethod.parse`).
        lpips_weights: files with the weights of LPIPS; without them the tables have no such column.
        overrides: changes to the spec, "table.key=value".
        workers: worker processes; as many as cores and memory allow if None, 0 for this process.
        scheduler: address of a Dask scheduler, whose workers are taken instead.

    Raises:
        InputError: something that cannot be used.
        KeyboardInterrupt: it was stopped; the same call goes on from there.
    """
    for name, value in (("pairs", pairs), ("draws", draws), ("seeds", len(seeds))):
        if value < 1:
            raise InputError(name, "must be at least 1", value, "Give one or more.")
    if len(set(seeds)) < len(seeds):
        got = ", ".join(map(str, seeds))
        raise InputError("seeds", "must differ: a training named twice is one", got, "Name it once.")
    if robust is not None and table == 1:
        raise InputError("robust", "has rows in table 2 alone", robust, "Leave it out, or choose table 2.")
    require_seed(seed)
    run, programs = path_of(source, "source"), [ExternalMethod.parse(text) for text in methods]
    folder = run / "evaluation" if out is None else path_of(out, "out")
    with stoppable():
        design = open_design(run, False, overrides=overrides, free=TRAINING_TABLES)
        assert design.spec is not None  # every run has one
        if robust is not None:  # said before hours of training
            robust = path_of(robust, "robust")
            _require_same_camera(design, open_design(robust, False), robust)
        given = _sources(folder, images, test, licence)
        if train:  # said before hours of it
            _require_apart(given.images, given.test)
        lpips = read_lpips(lpips_weights) if lpips_weights else None
        how: Any = {"occlusion": occlusion, "obstruction": obstruction, "seed": seed, "border": border}
        asked = PairSet.of(design.spec, str(run / "spec.toml"), picture_files(given.test), **how)
        _require_names_apart(asked.files, given.test)
        own = design.spec.obstruction
        kind = obstruction or (own.kind if own else "")  # without either no pairs are made
        _require_names(programs, rows_of(table, kind, robust=robust is not None))
        chosen = rows_of(table, kind, robust=robust is not None, names=rows)
        if process is not None and not any(row.fabricated for row in chosen):
            rule, cure = "is that of plates as fabricated", "Leave it out, or ask for such a row of table 2."
            raise InputError("process", rule, "no row with such a plate", cure)
        plan = TrainingPlan(
            run,
            folder,
            asked.model.occlusion,
            kind,
            overrides=tuple(overrides),
            images=given.images,
            validation=given.test,
            licence=given.licence,
            robust=robust if robust is None else Path(robust),
            lpips_weights=tuple(lpips_weights),
        )
        looked_at = (*chosen, *_looked_through(programs))
        needed = trainings_of(looked_at)
        require_asked(plan, needed, seeds, pictures=train or images is not None, loss=train)
        if train:
            train_missing(plan, needed, seeds, workers)
        missing = lacking(plan, needed, seeds)
        plates = plates_of(looked_at, plan, asked, seeds, missing, process, draws)
        ready, left = candidates_of(chosen, plan, seeds, missing, plates, asked.files)
        study = _study(design, asked, kind, lpips)
        home = folder / folder_name(table, kind, asked.model.occlusion)
        journal, work, numbers = Journal(home, study, ScoreLines()), PairWork(asked, plates, ready, lpips), range(pairs)
        with journal.open():
            for one in programs:
                plate = _plate_seen(one, plates)
                if plate not in (None, *plates):
                    left += (Unscored(MethodRow(one.name, one.name, "external"), "there is no proposed plate yet"),)
                    continue
                shown = _shown_to(one, plate, work, home / "external" / one.name, numbers, study)
                work = replace(work, candidates=(*work.candidates, shown))
            work = replace(work, known=frozenset(journal.finished))
            _score(work, journal, numbers, workers, scheduler)
            scored = {one.key: {n: journal.finished[f"{one.key}/{n}"] for n in numbers} for one in work.candidates}
            found = table_of(table, kind, work.candidates, scored, _facts(asked, numbers), left, study)
            write_table(home, found, work)
    return found


def _require_names(programs: Sequence[ExternalMethod], rows: Sequence[MethodRow]) -> None:
    """Refuse a program with the name of a row or of another program: their scores would be taken for each other's."""
    names = [row.name for row in rows]
    for one in programs:
        if one.name in names:
            raise InputError("method", "must have a name of its own", f'"{one.name}"', "Choose another name.")
        names.append(one.name)


def _require_same_camera(design: Design, robust: Design, folder: Path) -> None:
    """Refuse a robust design for another camera, whose plate would be looked through with this one's cells and lens."""
    for one in fields(Camera):
        wanted, got = getattr(design.camera, one.name), getattr(robust.camera, one.name)
        if wanted != got:
            cure = "Give a robust design that was made from the same spec."
            if one.name in ("light", "polarisation"):  # a robust design is made in scalar light
                cure = 'Evaluate a run of the same spec with optics.light = "scalar".'
            raise InputError(str(folder), f"a robust design must have this camera's {one.name}, {wanted}", got, cure)


def _study(design: Design, pairs: PairSet, kind: str, lpips: Lpips | None) -> dict[str, Any]:
    """All that scores depend on besides rows and the number of a pair."""
    assert design.spec is not None  # every run has one
    return {
        "format": _FORMAT,
        "design": design.name,
        "spec_sha256": spec_digest(design.spec),
        "occlusion": pairs.model.occlusion,
        "obstruction": kind,
        "obstruction_parameters": plain_parameters(pairs.kind),
        "pictures": [path.name for path in pairs.files],
        "pictures_sha256": sha256_bytes(canonical_json([sha256_file(path) for path in pairs.files])),
        "size": pairs.size,
        "seed": pairs.seed,
        "border": pairs.model.border,
        "perceptual": "none" if lpips is None else lpips.name,
        "perceptual_sha256": "" if lpips is None else lpips.digest,
    }


def _sources(folder: Path, images: str | Path | None, test: str | Path | None, licence: str | None) -> Sources:
    """The user's folders; or scikit-image's samples in two folders, a third of them to judge by."""
    if images is not None and test is None:
        rule = "pictures to judge by must come from a folder of their own"
        raise InputError("test", rule, "none", "Give a folder of pictures that are not trained on.")
    if images is not None and test is not None:
        found = Sources(path_of(images, "images"), path_of(test, "test"), licence)
        _require_apart(found.images, found.test)
        return found
    homes = folder / "pictures" / "trained_on", folder / "pictures" / "judged_by"
    samples = sample_files()
    for home, files in zip(homes, ([p for k, p in enumerate(samples) if k % 3], samples[::3]), strict=True):
        for path in files:
            if path.suffix.lower() in PICTURE_FILES and not (home / path.name).is_file():
                write_atomic(home / path.name, read_bytes(path))
    return Sources(homes[0], homes[1] if test is None else Path(test), licence)


def _require_names_apart(files: Sequence[Path], test: Path) -> None:
    """Refuse pictures of one name, as in folders of several films: a photograph is known by its name."""
    known: dict[str, Path] = {}
    for path in files:
        if (other := known.setdefault(path.name, path)) != path:
            got = f"{path.relative_to(test)} and {other.relative_to(test)}"
            rule, cure = "pictures to judge by must have names of their own", "Rename them, film by film for example."
            raise InputError(str(test), rule, got, cure)


def _require_apart(images: Path, test: Path) -> None:
    """Refuse pictures of one name in both folders, before any training: networks that saw them would have no score."""
    known = {path.name for path in picture_files(images)}
    if twice := [path.name for path in picture_files(test) if path.name in known]:
        more = f" and {len(twice) - 1} more" if len(twice) > 1 else ""
        got = f"{twice[0]}{more} in {images}, too"
        cure = "Take out of one folder what is in both, or rename what is another picture."
        raise InputError(str(test), "pictures to judge by must not be trained on", got, cure)


def _looked_through(programs: Sequence[ExternalMethod]) -> list[MethodRow]:
    """Captures through the proposed plate for programs that see them, whichever rows are asked for."""
    return [MethodRow(one.name, one.name, "external", plate="proposed") for one in programs if one.sees == "plate"]


def _plate_seen(method: ExternalMethod, plates: Mapping[str, PlateBanks]) -> str | None:
    """Key of the plate that a program's captures are made through: the proposed one of the first seed, or flat."""
    if method.sees == "plate":
        return next((key for key in plates if key.startswith("proposed@")), "proposed")
    return FLAT if method.sees == "conventional" else None


def _shown_to(
    method: ExternalMethod, plate: str | None, work: PairWork, folder: Path, numbers: range, study: Mapping[str, Any]
) -> Candidate:
    """Show pairs to a program, unless it has seen the very same, and return its row.

    Raises:
        InputError: the program cannot be run, or does not do what it should (`doedesign.evaluation.external`).
    """
    given, found, mark = folder / "in", folder / "out", folder / "command.json"
    seen = "" if plate is None else work.plates[plate].digest(fabricated=False)
    asked = {"command": list(method.command), "sees": method.sees, "pairs": len(numbers), "psfs_sha256": seen}
    asked = canonical_json({**asked, "study": dict(study)})
    files = [found / file_of(number) for number in numbers]
    if not mark.is_file() or read_bytes(mark) != asked or not all(path.is_file() for path in files):
        shutil.rmtree(folder, ignore_errors=True)  # nothing of another command is to be taken for its own
        with meter(f"pairs for {method.name}", len(numbers)) as progress:
            for number in numbers:
                picture, mask = work.seen_by_program(number, plate)
                write_pair(given, number, picture, mask >= 0.5)
                progress.advance(number + 1)
        _log.info("running %s", method.name)
        run_program(method, given, found)
        for number in numbers:
            read_pair(method.name, found, number, (work.pairs.size, work.pairs.size))
        write_atomic(mark, asked)
    row = MethodRow(method.name, f"{method.name}, given {GIVEN[method.sees]}", "external")
    return Candidate(row, 0, FLAT, None, found, sha256_bytes(canonical_json([sha256_file(path) for path in files])))


def _score(work: PairWork, journal: Journal, numbers: range, workers: int | None, scheduler: str | None) -> None:
    """Score what the journal lacks."""
    open_ = {
        str(number): number
        for number in numbers
        if any(f"{one.key}/{number}" not in work.known for one in work.candidates)
    }
    if not open_:
        return
    there: Callable[..., Iterator[tuple[str, dict[str, RowScores]]]]
    if scheduler is not None:
        there = partial(evaluate_there, address=scheduler)
    else:
        there = partial(evaluate_here, workers=default_workers(_PAIR_BYTES) if workers is None else workers)
    with meter("scoring pairs", len(numbers), len(numbers) - len(open_)) as progress:
        for count, (key, found) in enumerate(there(work, open_), 1 + len(numbers) - len(open_)):
            for name, values in found.items():
                journal.add(f"{name}/{key}", values)
            progress.advance(count)


def _facts(pairs: PairSet, numbers: range) -> tuple[PairFacts, ...]:
    """The pairs for the record."""
    found = []
    for number in numbers:
        scene, depths = pairs.scene(number), pairs.depths(number)
        _, mask = pairs.shown(scene)
        found.append(PairFacts(number, scene.name, depths.far_m, depths.near_m, float(np.mean(mask >= 0.5))))
    return tuple(found)
