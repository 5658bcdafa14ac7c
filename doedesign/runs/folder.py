"""Run folders: one design from its spec to its results, named by what made it.

    runs/NAME/
        manifest.json           what this is: spec digest, inputs, version, digests of all results when done, and the
                                depths of the etches if the run was to choose them
        spec.toml               the spec with every default and override filled in
        checkpoint.npz          parameters, Adam's moments and history; only while the run is unfinished
        level_map.npz           the design: level of every cell, staircase, grid and aperture (`fab.level_map`)
        height.exr              the heights that follow from it, metres (the heights before rounding where the run is
                                not quantised), for other programs
        height_continuous.exr   the heights before rounding to levels
        history.jsonl           one line per step
        metrics.json            the table of `doedesign.design.metrics`
        *.png                   pictures
        psf/, fabricated/, simulated/, trained/, tolerance/, calibrate/     what later commands found

Every file is written under a temporary name and renamed. The manifest says "running" until everything else is on the
disk, so a run that was killed at any moment is resumed from its last checkpoint and ends with the same bytes. Only one
process at a time works in a run folder.
"""

import contextlib
import fcntl
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from doedesign import __version__
from fab.archive import read_archive, write_archive
from doedesign.spec import Spec, load_spec, spec_digest, spec_from_json, spec_to_json, spec_to_toml
from fab.errors import InputError
from fab.files import MANIFEST_NAME, canonical_json, explain_os_error, read_json, sha256_file, write_atomic

FORMAT = "doedesign run 1"
TRAINING = "doedesign training 1"  # a folder that `train` wrote, with a plate of its own
CHECKPOINT = "checkpoint.npz"
LEVEL_MAP, HEIGHT, CONTINUOUS = "level_map.npz", "height.exr", "height_continuous.exr"
_DEPTHS = "etch_depths_m"
# Of the sensor, what a plate is designed for.
_FIXED_SENSOR = ("pitch_m", "resolution", "binning", "window", "fill_factor", "defocus_m")

# Temporary names of `write_atomic` and `atomic_folder`, which stay behind where a process is killed while it writes.
_UNFINISHED = re.compile(
    r"\.([\w-]+\.(json|toml|npz|exr|jsonl|png)|(psf|fabricated|calibration|explanations|as-built)\.new)\.[a-z0-9_]{8}"
)


@dataclass(frozen=True)
class Run:
    """A run folder and the spec it belongs to.

    Attributes:
        folder: the folder.
        spec: what was asked for; of a finished run, with the depths of the etches that it chose.
        done: whether the run is finished.
    """

    folder: Path
    spec: Spec
    done: bool

    def path(self, name: str) -> Path:
        """A file of the run."""
        return self.folder / name


def _manifest(spec: Spec, inputs: Mapping[str, str], overrides: Sequence[str], state: str) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "name": spec.name,
        "version": __version__,
        "state": state,
        "spec_sha256": spec_digest(spec),
        "inputs_sha256": dict(inputs),
        "overrides": list(overrides),
        "units": "SI; arrays [y, x], row 0 at the lowest y",
    }


def input_digests(files: Mapping[str, Path]) -> dict[str, str]:
    """SHA-256 of every input file by its key in the spec."""
    return {key: sha256_file(path) for key, path in files.items()}


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keep other processes out of a run folder, and clear away what a killed one was writing there.

    The system lets go of the folder when this process ends, however it ends.

    Args:
        folder: the run folder; made if missing.

    Raises:
        InputError: another process works in the folder, or the system refuses it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise explain_os_error(error, folder) from error
    try:
        with contextlib.suppress(OSError):  # a file system without locks
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise InputError(
                    str(folder), "only one process may work in a run folder", "a second one", "Wait for the first."
                ) from error
        for path in folder.iterdir():
            if _UNFINISHED.fullmatch(path.name):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        yield
    finally:
        os.close(handle)


@contextlib.contextmanager
def claim_run(folder: Path, spec: Spec, inputs: Mapping[str, str]) -> Iterator[Run]:
    """Keep a folder for a spec: one for a new run, an unfinished run to resume, or a finished one.

    Args:
        folder: the run folder; made if missing.
        spec: the spec.
        inputs: digests of the files the spec names.

    Yields:
        the run. Nothing is written before `begin_run`.

    Raises:
        InputError: the folder belongs to another spec, to other inputs, or to something else altogether; its
            results changed since; or another process works in it.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(str(folder), "a run needs a folder", "a file", "Choose another --out.")
    with alone_in(folder):
        if (folder / MANIFEST_NAME).is_file():
            yield Run(folder, spec, _is_done(folder, spec, inputs))
        elif any(folder.iterdir()):
            raise InputError(
                str(folder), "a run needs a new or empty folder, or its own", "other content", "Choose another --out."
            )
        else:
            yield Run(folder, spec, done=False)


def _is_done(folder: Path, spec: Spec, inputs: Mapping[str, str]) -> bool:
    """Whether a run is finished; refuse it if it is not that of a spec and its inputs."""
    found = _read_manifest(folder)
    if found["state"] != "done" and {path.name for path in folder.iterdir()} <= {MANIFEST_NAME, "spec.toml"}:
        return False  # begun and nothing more: there is nothing to lose, whatever the spec was
    if found["spec_sha256"] != spec_digest(spec) or found["inputs_sha256"] != dict(inputs):
        raise InputError(
            str(folder),
            f"the folder must belong to this spec (sha256 {spec_digest(spec)[:12]})",
            f"the run of another spec or other input files ({found['spec_sha256'][:12]})",
            "Choose another --out, or remove that run.",
        )
    return found["state"] == "done" and open_run(folder).done


def begin_run(run: Run, inputs: Mapping[str, str], overrides: Sequence[str]) -> None:
    """Record what is running here, and the spec.

    Args:
        run: a claimed run.
        inputs: digests of the files the spec names.
        overrides: `--set` overrides that led to the spec, for the record.
    """
    write_atomic(run.path(MANIFEST_NAME), canonical_json(_manifest(run.spec, inputs, overrides, "running")))
    comments = ["every default filled in", *(f"--set {override}" for override in overrides)]
    write_atomic(run.path("spec.toml"), spec_to_toml(run.spec, comments).encode())


def finish_run(
    run: Run,
    inputs: Mapping[str, str],
    overrides: Sequence[str],
    results: Sequence[str],
    depths_m: Sequence[float] = (),
) -> None:
    """Record the digests of all results and mark the run done; the checkpoint is no longer needed.

    Args:
        run: a claimed run.
        inputs: digests of the files the spec names.
        overrides: `--set` overrides that led to the spec.
        results: names of all files.
        depths_m: depths of the etches, mask 0 first, where the run was to choose them.
    """
    manifest = _manifest(run.spec, inputs, overrides, "done")
    if run.spec.process.chooses_depths:
        manifest[_DEPTHS] = list(depths_m)
    manifest["results_sha256"] = {name: sha256_file(run.path(name)) for name in sorted(results)}
    write_atomic(run.path(MANIFEST_NAME), canonical_json(manifest))
    run.path(CHECKPOINT).unlink(missing_ok=True)


def open_run(folder: Path) -> Run:
    """A finished run, or a finished training, whose plate has learnt beside its network.

    Raises:
        InputError: no run, an unfinished one, one without a plate, or one whose spec or height map changed since it was
            made.
    """
    if not folder.is_dir():
        raise InputError(str(folder), "must be a run folder", "no folder", "Make one with: doedesign optimize SPEC")
    if not (folder / MANIFEST_NAME).is_file():
        raise InputError(str(folder), f"a run folder has a {MANIFEST_NAME}", "none", "Give the folder optimize wrote.")
    manifest = _read_manifest(folder, (FORMAT, TRAINING))
    spec = load_spec(folder / "spec.toml")
    if spec_digest(spec) != manifest["spec_sha256"]:
        raise InputError(
            str(folder / "spec.toml"),
            "must be the spec of this run",
            "a file that was changed since",
            "Restore it, or optimise the changed spec into a folder of its own.",
        )
    if manifest["state"] != "done":
        raise InputError(
            str(folder), "the run must be finished", "an unfinished run", "Resume it with the same command."
        )
    if manifest["format"] == TRAINING and LEVEL_MAP not in manifest["results_sha256"]:  # trained behind a plain lens
        cure = "Give the run, or a training behind its plate."
        raise InputError(str(folder), f"must hold a plate, {LEVEL_MAP}", "none", cure)
    for name, digest in manifest["results_sha256"].items():
        if name.endswith((".exr", LEVEL_MAP)) and sha256_file(folder / name) != digest:
            raise InputError(
                str(folder / name),
                "must be the file this run wrote",
                "a changed file",
                f"Restore it, or remove {folder} and optimise again.",
            )
    return Run(folder, _with_depths(spec, manifest, folder / MANIFEST_NAME), done=True)


def spec_with(run: Run, overrides: Sequence[str], free: Sequence[str]) -> Spec:
    """The spec of a finished run with overrides of what its plate does not depend on.

    Args:
        run: a finished run.
        overrides: changes, "table.key=value".
        free: tables that may be changed; of the sensor, only what it does with light.

    Raises:
        InputError: an override that breaks a rule, or of something else.
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
        raise InputError("--set", rule, f"another {changed[0]}", "Optimise the changed spec into a run of its own.")
    # The other tables stay those of the run, which knows the depths that it chose.
    return run.spec.model_copy(update={table: getattr(spec, table) for table in free})


def _with_depths(spec: Spec, manifest: Mapping[str, Any], path: Path) -> Spec:
    """The spec of a finished run as if the depths that it chose had been given."""
    if not spec.process.chooses_depths:
        return spec
    process = spec_to_json(spec)["process"] | {_DEPTHS: manifest.get(_DEPTHS)}
    return spec_from_json(spec_to_json(spec) | {"process": process}, str(path))


def _read_manifest(folder: Path, formats: Sequence[str] = (FORMAT,)) -> dict[str, Any]:
    """The manifest of a run, with everything in it that is relied upon."""
    path = folder / MANIFEST_NAME
    manifest = read_json(path)
    if manifest.get("format") not in formats:
        raise InputError(
            str(path),
            "must say format " + " or ".join(f'"{name}"' for name in formats),
            repr(manifest.get("format")),
            "Give a folder that this version wrote.",
        )
    kinds: dict[str, type] = {"state": str, "spec_sha256": str}
    if manifest["format"] == FORMAT:
        kinds["inputs_sha256"] = dict
    if manifest.get("state") == "done":
        kinds["results_sha256"] = dict
    for key, kind in kinds.items():
        if not isinstance(manifest.get(key), kind):
            raise InputError(
                str(path), f"must hold {key}", repr(manifest.get(key)), f"Remove {folder} and optimise again."
            )
    return manifest


def save_checkpoint(run: Run, arrays: Sequence[np.ndarray], step: int, history: Sequence[Mapping[str, Any]]) -> None:
    """Store everything a run needs to go on: arrays in their order, the number of steps done, the history."""
    header = {"spec": spec_digest(run.spec), "step": step, "history": list(history)}
    write_archive(run.path(CHECKPOINT), header, {f"array{i}": array for i, array in enumerate(arrays)})


def load_checkpoint(
    run: Run, shapes: Sequence[tuple[int, ...]]
) -> tuple[list[np.ndarray], int, list[dict[str, Any]]] | None:
    """What `save_checkpoint` stored, or None if there is no checkpoint yet.

    Raises:
        InputError: the file is cut off, corrupt, or of another spec.
    """
    path = run.path(CHECKPOINT)
    if not path.exists():
        return None
    cure = f"Remove {path.name} to start this run again from the beginning."
    header, arrays = read_archive(path, "checkpoint", cure)
    if header.get("spec") != spec_digest(run.spec) or [a.shape for a in arrays.values()] != list(shapes):
        raise InputError(str(path), "must belong to this run's spec", "a checkpoint of another spec", cure)
    return list(arrays.values()), header["step"], header["history"]


def write_history(run: Run, history: Sequence[Mapping[str, Any]]) -> None:
    """One JSON object per line and step."""
    lines = "".join(json.dumps(record, sort_keys=True) + "\n" for record in history)
    write_atomic(run.path("history.jsonl"), lines.encode())
