"""Run folders: one design from its spec to its results.

    runs/NAME/
        manifest.json           spec digest, inputs, version, digests of all results when done, and the depths of the
                                etches if the run was to choose them, or that its plate should come out with
        spec.toml               the spec with overrides and defaults; optional keys where they differ
        checkpoint.npz          parameters, Adam's moments and history; only while the run is unfinished
        level_map.npz           the design: level of every cell, staircase, grid and aperture (`fab.level_map`)
        height.exr              the heights that follow from it, metres (the heights before rounding where the run is
                                not quantised), for other programs
        height_continuous.exr   the heights before rounding to levels
        history.jsonl           one line per step
        metrics.json            the table of `doedesign.design.metrics`
        *.png                   pictures
        cost.jsonl              time and memory of the commands that worked on the run; no result (`runs.costs`)
        psf/, fabricated/, certificate/, simulated/, trained/, tolerance/, calibration/   results of later commands

Every file is written under a temporary name and renamed. The manifest says "running" until everything else is on the
disk, so a run that was killed at any moment is resumed from its last checkpoint and ends with the same bytes. Only one
process at a time works in a run folder.
"""

import contextlib
import json
import os
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from doedesign import __version__
from doedesign.runs.aside import ASIDE, replace_aside, restored_unless_replaced, set_aside, waits
from doedesign.spec import (
    HEIGHT_FILES,
    Spec,
    input_files,
    kept_pictures,
    load_spec,
    spec_digest,
    spec_from_json,
    spec_to_json,
    spec_to_resolved_toml,
)
from doedesign.spec.values.table import toml_key
from fab.archive import read_archive, write_archive
from fab.errors import InputError
from fab.files import (
    MANIFEST_NAME,
    canonical_json,
    clear_killed,
    explain_os_error,
    lock,
    read_bytes,
    read_json,
    sha256_file,
    write_atomic,
)
from fab.manifest.records import FORMAT as ORDER

FORMAT = "doedesign run 1"
TRAINING = "doedesign training 1"  # a folder that `train` wrote, with a DOE of its own
RELEASED = "doedesign released model 1"  # a training that is given away, with its DOE
CHECKPOINT = "checkpoint.npz"
COST_NAME = "cost.jsonl"  # no result: `doedesign.runs.costs`
LEVEL_MAP, HEIGHT, CONTINUOUS = "level_map.npz", "height.exr", "height_continuous.exr"
_DEPTHS, AIM_DEPTHS = "etch_depths_m", "aim_depths_m"
# Tables of a spec that may be changed for a finished DOE, where it is looked through and where a network is trained.
CAPTURE_TABLES = ("scene", "sensor", "obstruction")
TRAINING_TABLES = (*CAPTURE_TABLES, "network", "train")
# The part of the sensor that a DOE is designed for.
_FIXED_SENSOR = ("pitch_m", "resolution", "binning", "window", "fill_factor", "defocus_m")

# What is written in the folder of a run.
_WRITTEN = re.compile(
    r"[\w-]+\.(json|toml|npz|exr|jsonl|csv|png|html)|psf|fabricated|certificate|calibration|explanations|as-built"
)


@dataclass(frozen=True)
class Run:
    """Run folder and the spec it belongs to.

    Attributes:
        folder: the folder.
        spec: the spec; of a finished run, with the depths of the etches that it chose.
        done: whether the run is finished.
        inputs: of a claimed run, the digests of the files that the spec names, by key.
        overrides: of a claimed run, the changes that led to the spec, "table.key=value".
        aim_depths_m: depths of the etches that the plate should come out with, metres, where those of the spec are
            commanded otherwise; empty where they are the same.
    """

    folder: Path
    spec: Spec
    done: bool
    inputs: Mapping[str, str] = field(default_factory=dict, compare=False)
    overrides: Sequence[str] = field(default=(), compare=False)
    aim_depths_m: tuple[float, ...] = ()

    def path(self, name: str) -> Path:
        """Path of a file of the run."""
        return self.folder / name


class _Manifest(BaseModel):
    """Keys of a manifest that are relied upon."""

    format: str
    state: str
    spec_sha256: str
    inputs_sha256: dict[str, str] = {}
    etch_depths_m: Any = None
    aim_depths_m: tuple[float, ...] = ()
    results_sha256: dict[str, str] = {}


def _write_manifest(run: Run, state: str, results: Mapping[str, Any]) -> None:
    manifest = {
        "format": FORMAT,
        "name": run.spec.name,
        "version": __version__,
        "state": state,
        "spec_sha256": spec_digest(run.spec),
        "inputs_sha256": dict(run.inputs),
        "overrides": list(run.overrides),
        "units": "SI; arrays [y, x], row 0 at the lowest y",
    }
    write_atomic(run.path(MANIFEST_NAME), canonical_json({**manifest, **results}))


def _read_manifest(folder: Path, formats: Sequence[str] = (FORMAT,)) -> _Manifest:
    path = folder / MANIFEST_NAME
    raw = read_json(path)
    if raw.get("format") not in formats:
        rule = "must say format " + " or ".join(f'"{name}"' for name in formats)
        raise InputError(str(path), rule, repr(raw.get("format")), "Give a folder that this version wrote.")
    try:
        if raw.get("state") == "done":
            raw.setdefault("results_sha256", None)  # which only a run that is not finished may lack
        return _Manifest.model_validate(raw)
    except ValidationError as error:
        key = str(error.errors()[0]["loc"][0])
        cure = f"Remove {folder} and optimise again."
        raise InputError(str(path), f"must hold {key}", repr(raw.get(key)), cure) from error


def input_digests(files: Mapping[str, Path]) -> dict[str, str]:
    """Return the SHA-256 of every input file by its key in the spec."""
    return {key: sha256_file(path) for key, path in files.items()}


def _is_alone(handle: int) -> bool:
    """Lock a folder, unless another process works there; one that only looks whether it is so is gone at once."""
    for pause_s in (0.05, 0.2, 0.0):
        if lock(handle) is not False:
            return True
        time.sleep(pause_s)
    return False


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keep other processes out of a run folder (made if missing), and remove the temporary files of a killed one.

    The system unlocks the folder when this process ends, however it ends.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise explain_os_error(error, folder) from error
    try:
        if not _is_alone(handle):
            rule = "only one process may work in a run folder"
            raise InputError(str(folder), rule, "a second one", "Wait for the first.")
        clear_killed(folder, _WRITTEN.fullmatch)
        yield
    finally:
        os.close(handle)


def is_worked_in(folder: Path) -> bool:
    """Whether a process is at work in a run folder; also where the file system has no locks and cannot tell.

    Args:
        folder: the run folder.
    """
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return False
    try:
        return lock(handle, shared=True) is not True
    finally:
        os.close(handle)


@contextlib.contextmanager
def claim_run(
    folder: Path, spec: Spec, inputs: Mapping[str, str], overrides: Sequence[str] = (), *, overwrite: bool = False
) -> Iterator[Run]:
    """Lock the folder of a run: one for a new run, an unfinished run to resume, or a finished one.

    Args:
        folder: the run folder; made if missing.
        spec: the spec.
        inputs: digests of the files that the spec names, by key.
        overrides: changes that led to the spec, "table.key=value", for the record.
        overwrite: remove the run of another spec, with all that was made of it, instead of refusing the folder.

    Yields:
        the run. Nothing is written before `begin_run`.

    Raises:
        InputError: the folder belongs to another spec, to other inputs, or to something else altogether; its
            results changed since; or another process works in it.
    """
    _require_no_file(folder)
    with _none_left_empty(folder), alone_in(folder), restored_unless_replaced(folder):
        known = _is_known(folder)
        if known and overwrite and not _belongs(_read_manifest(folder), spec, inputs):
            set_aside(folder)
            known = False
        run = Run(folder, spec, known and _is_done(folder, spec, inputs), inputs, overrides)
        if run.done:  # perhaps stopped before the last line of `finish_run`
            run.path(CHECKPOINT).unlink(missing_ok=True)
        yield run


@contextlib.contextmanager
def _none_left_empty(folder: Path) -> Iterator[None]:
    """Remove a folder that the block made if it fails before it has written anything."""
    made = not folder.exists()
    try:
        yield
    except BaseException:
        if made:
            with contextlib.suppress(OSError):  # such as one that is not empty
                folder.rmdir()
        raise


def require_room(folder: Path) -> None:
    """Refuse a folder in which no run can be, before anything takes time; `claim_run` looks again.

    Args:
        folder: the folder for a run, which may be missing.

    Raises:
        InputError: it holds something else, or is a file, or another process works in it.
    """
    _require_no_file(folder)
    if folder.is_dir() and not waits(folder):
        with alone_in(folder):
            _is_known(folder)


def _require_no_file(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError(str(folder), "a run needs a folder", "a file", "Choose another output folder.")


def _is_known(folder: Path) -> bool:
    """Whether there is a run in a folder, or nothing; an InputError for other content."""
    known = (folder / MANIFEST_NAME).is_file()
    if not known and any(folder.iterdir()):
        rule, cure = "a run needs a new or empty folder, or its own", "Choose another output folder."
        raise InputError(str(folder), rule, "other content", cure)
    return known


def _belongs(found: "_Manifest", spec: Spec, inputs: Mapping[str, str]) -> bool:
    """Whether a run is that of a spec and its inputs."""
    return (found.spec_sha256, found.inputs_sha256) == (spec_digest(spec), inputs)


def _is_done(folder: Path, spec: Spec, inputs: Mapping[str, str]) -> bool:
    """Whether a run is finished; refuse it if it is not that of a spec and its inputs."""
    found = _read_manifest(folder)
    if found.state != "done" and {path.name for path in folder.iterdir()} <= {MANIFEST_NAME, "spec.toml", COST_NAME}:
        return False  # begun and nothing more: there is nothing to lose, whatever the spec was
    if not _belongs(found, spec, inputs):
        own = folder / "spec.toml"
        keys = _changed_keys(own, spec)
        got = "the run of another spec or other input files" + (f": {own} has another {keys}" if keys else "")
        cure = "Choose another output folder, or give `overwrite` to remove that run and all that was made of it."
        raise InputError(str(folder), "the folder must belong to this spec", got, cure)
    return found.state == "done" and open_run(folder).done


def _changed_keys(path: Path, spec: Spec) -> str:
    """The first keys in which the spec of a run differs from another; nothing where its file cannot be read."""

    def differing(before: Any, after: Any, key: str) -> Iterator[str]:
        if isinstance(before, dict) and isinstance(after, dict):
            for name in sorted({*before, *after}):
                yield from differing(before.get(name), after.get(name), f"{key}.{toml_key(name)}".removeprefix("."))
        elif before != after:
            yield key

    try:
        keys = list(differing(spec_to_json(load_spec(path)), spec_to_json(spec), ""))
    except InputError:
        return ""
    return ", ".join(keys[:3]) + (f" and {len(keys) - 3} more" if len(keys) > 3 else "")


def with_steps(spec: Spec, steps: int) -> Spec:
    """The same spec with another number of steps."""
    return spec.model_copy(update={"optimize": spec.optimize.model_copy(update={"steps": steps})})


def steps_of_run(folder: Path, spec: Spec) -> int | None:
    """Number of steps of the run in a folder if it has the spec but for that number; None for any other folder."""
    try:
        steps = load_spec(folder / "spec.toml").optimize.steps
        same = _read_manifest(folder).spec_sha256 == spec_digest(with_steps(spec, steps))
    except InputError:
        return None
    return steps if same else None


def inputs_of_run(folder: Path) -> Mapping[str, str] | None:
    """Digests of the input files of the run in a folder, by key; None for any other folder."""
    return _read_manifest(folder).inputs_sha256 if (folder / MANIFEST_NAME).is_file() else None


def is_finished(folder: Path) -> bool:
    """Whether the run in a folder is done, whole or not."""
    return _read_manifest(folder).state == "done"


def begin_run(run: Run) -> None:
    """Write the manifest of a claimed run that begins, its spec, and its pictures.

    The manifest comes first, so that what a kill leaves is known as a run of this spec, which goes on; a run that waits
    to be replaced comes back instead, until all is written.
    """
    lacking = {key: name for key, name in kept_pictures(run.spec).items() if not run.path(name).is_file()}
    pictures = {name: read_bytes(input_files(run.spec, key)[key]) for key, name in lacking.items()}
    _write_manifest(run, "running", {})
    write_atomic(run.path("spec.toml"), spec_to_resolved_toml(run.spec, run.overrides).encode())
    for name, content in pictures.items():
        write_atomic(run.path(name), content)
    replace_aside(run.folder)


def finish_run(
    run: Run, results: Sequence[str], depths_m: Sequence[float] = (), about: Mapping[str, Any] | None = None
) -> None:
    """Mark a claimed run done.

    Args:
        run: the run.
        results: names of its files.
        depths_m: depths of the etches, metres, which it keeps where it was to choose them.
        about: further entries of the manifest.
    """
    chosen = {_DEPTHS: list(depths_m)} if run.spec.process.chooses_depths else {}
    kept = kept_pictures(run.spec).values()
    digests = {name: sha256_file(run.path(name)) for name in sorted([*results, *kept])}
    _write_manifest(run, "done", {**chosen, **(about or {}), "results_sha256": digests})
    run.path(CHECKPOINT).unlink(missing_ok=True)


def run_of(source: Run | str | Path) -> Run:
    """Return a run, or open the finished one in a folder or of a design; an InputError else, and as `open_run`."""
    if isinstance(source, Run):
        return source
    source = getattr(source, "folder", None) or source
    if not isinstance(source, str | Path):
        rule, cure = "must be a run or its folder", 'A design has one that was optimised with out="runs/NAME".'
        raise InputError("run", rule, f"a {type(source).__name__}", cure)
    return open_run(Path(source))


def open_run(folder: Path) -> Run:
    """Open a finished run, or a finished or released training, whose DOE was trained beside its network.

    Raises:
        InputError: no run, an unfinished one, one without a DOE, or one whose spec or height map changed since it was
            made.
    """
    require_folder(folder)
    if not (folder / MANIFEST_NAME).is_file():
        cure = "Give the folder optimize wrote."
        if waits(folder):
            cure = f"A run waits in {ASIDE}; the next optimize with its spec brings it back."
        raise InputError(str(folder), f"a run folder has a {MANIFEST_NAME}", "none", cure)
    _require_no_order(folder)
    manifest = _read_manifest(folder, (FORMAT, TRAINING, RELEASED))
    path = folder / "spec.toml"
    spec = load_spec(path)
    if spec_digest(spec) != manifest.spec_sha256:
        cure = "Restore it, or optimise the changed spec into a folder of its own."
        raise InputError(str(path), "must be the spec of this run", "a file that was changed since", cure)
    if manifest.state != "done":
        cure = "Resume it with the same command."
        raise InputError(str(folder), "the run must be finished", "an unfinished run", cure)
    if manifest.format != FORMAT and LEVEL_MAP not in manifest.results_sha256:  # trained behind a plain lens
        cure = "Give the run, or a training behind its plate."
        raise InputError(str(folder), f"must hold a plate, {LEVEL_MAP}", "none", cure)
    for name, digest in manifest.results_sha256.items():
        relied = name.endswith((".exr", LEVEL_MAP)) or name in kept_pictures(spec).values()
        if relied and sha256_file(folder / name) != digest:
            cure = f"Restore it, or remove {folder} and optimise again."
            raise InputError(str(folder / name), "must be the file this run wrote", "a changed file", cure)
    if spec.process.chooses_depths:  # from now on as if the depths that it chose had been given
        process = spec_to_json(spec)["process"] | {_DEPTHS: manifest.etch_depths_m}
        spec = spec_from_json(spec_to_json(spec) | {"process": process}, str(folder / MANIFEST_NAME), path)
    return Run(folder, spec, done=True, aim_depths_m=manifest.aim_depths_m)


def require_folder(run: Path) -> None:
    """Refuse what cannot be a run, for it is no folder.

    Args:
        run: what should be the folder of a run.

    Raises:
        InputError: there is no such folder.
    """
    if not run.is_dir():
        got = "a file" if run.exists() else "no folder"
        raise InputError(str(run), "must be a run folder", got, "Make one with: doedesign optimize SPEC")


def require_relief(source: Path) -> None:
    """Refuse what cannot have a relief to draw: nothing, or a spec.

    Args:
        source: what should be the folder of a run or a height map.

    Raises:
        InputError: there is nothing of that name, or it is a spec.
    """
    rule = f"must be a run folder or a height map ({', '.join(HEIGHT_FILES)})"
    if not source.exists():
        raise InputError(str(source), rule, "nothing of that name", "Check the path.")
    if source.suffix.lower() == ".toml":
        cure = f"Optimise it first, and give its run: doedesign optimize {source}."
        raise InputError(str(source), rule, "a spec", cure)


def _require_no_order(folder: Path) -> None:
    """Refuse a mask order where a run is wanted, and propose its run."""
    found = read_json(folder / MANIFEST_NAME)
    if found.get("format") != ORDER:
        return
    source = found.get("source")
    of_run = isinstance(source, dict) and source.get("kind") == "run"
    cure = f"Give its run, such as {Path('runs') / str(found.get('name'))}." if of_run else "Give the folder of a run."
    raise InputError(str(folder), "must be a run folder", "a mask order", cure)


def named(spec: Spec, name: str) -> Spec:
    """The spec of a run under the name of one that is made from it."""
    if len(name) > 64:
        cure = "Give the run a shorter name."
        raise InputError(spec.name, "the name of a run made from another must have 64 letters at most", name, cure)
    return spec.model_copy(update={"name": name})


def spec_with(run: Run, overrides: Sequence[str], free: Sequence[str]) -> Spec:
    """Return the spec of a finished run with overrides, "table.key=value", that its DOE does not depend on.

    Those of the `free` tables may be changed; of the sensor, only its response to light.
    """
    if not overrides:
        return run.spec
    path = run.path("spec.toml")
    spec = load_spec(path, overrides)
    before, after = spec_to_json(load_spec(path)), spec_to_json(spec)
    changed = [key for key in sorted({*before, *after} - {*free}) if before.get(key) != after.get(key)]
    changed += [f"sensor.{key}" for key in _FIXED_SENSOR if before["sensor"].get(key) != after["sensor"].get(key)]
    if changed:
        tables = ", ".join(f"[{table}]" for table in free if table != "sensor")
        rule = f"only {tables} and what the sensor does with light can be changed for a finished plate"
        cure = "Optimise the changed spec into a run of its own."
        raise InputError("overrides", rule, f"another {changed[0]}", cure)
    # The other tables stay those of the run, which hold the depths that it chose.
    return run.spec.model_copy(update={table: getattr(spec, table) for table in free})


def save_checkpoint(run: Run, arrays: Sequence[np.ndarray], step: int, history: Sequence[Mapping[str, Any]]) -> None:
    """Store all that a run needs to go on: arrays in their order, the number of steps done, the history."""
    header = {"spec": spec_digest(run.spec), "step": step, "history": list(history)}
    write_archive(run.path(CHECKPOINT), header, {f"array{i}": array for i, array in enumerate(arrays)})


def load_checkpoint(run: Run, like: Sequence[Any]) -> tuple[list[np.ndarray], int, list[dict[str, Any]]] | None:
    """Return what `save_checkpoint` stored, or None if there is no checkpoint yet.

    Raises:
        InputError: the file is damaged, or its arrays have other shapes or kinds of number than those of `like`.
    """
    path = run.path(CHECKPOINT)
    if not path.exists():
        return None
    cure = f"Remove {path.name} to start this run again from the beginning."
    header, arrays = read_archive(path, "checkpoint", cure)
    kinds, wanted = ([(tuple(a.shape), str(a.dtype)) for a in each] for each in (arrays.values(), like))
    if header.get("spec") != spec_digest(run.spec) or kinds != wanted:
        raise InputError(str(path), "must belong to this run's spec", "a checkpoint of another spec", cure)
    step, history = header.get("step"), header.get("history")
    if type(step) is not int or not (isinstance(history, list) and all(map(_is_record, history))):
        raise InputError(str(path), "must hold a number of steps and a record of each", "others", cure)
    return list(arrays.values()), step, history


def _is_record(value: Any) -> bool:
    """Whether a value is the record of a step: its number, its loss, the terms and their names, as far as there are."""
    if not isinstance(value, dict):
        return False
    terms, names = value.get("terms", []), value.get("names", [])
    numbers = [value.get("step"), value.get("loss"), *(terms if isinstance(terms, list) else [None])]
    texts = names if isinstance(names, list) else [None]
    return all(type(n) in (int, float) for n in numbers) and all(isinstance(name, str) for name in texts)


def write_history(run: Run, history: Sequence[Mapping[str, Any]]) -> None:
    """Write the history, one JSON object per line and step."""
    lines = "".join(json.dumps(record, sort_keys=True) + "\n" for record in history)
    write_atomic(run.path("history.jsonl"), lines.encode())
