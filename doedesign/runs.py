"""Run folders: one design from its spec to its results, named by what made it.

    runs/NAME/
        manifest.json           what this is: spec digest, inputs, version, and digests of all results when done
        spec.toml               the spec with every default and override filled in
        checkpoint.npz          parameters, Adam's moments and history; only while the run is unfinished
        height.exr              what is drawn, metres
        height_continuous.exr   the same before rounding to levels
        history.jsonl           one line per step
        metrics.json            the table of `doedesign.evaluate`
        *.png                   pictures

Every file is written under a temporary name and renamed. The manifest says "running" until everything else is on the
disk, so a run that was killed at any moment is resumed from its last checkpoint and ends with the same bytes.
"""

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from doedesign import __version__
from doedesign.spec import Spec, load_spec, spec_digest, spec_to_toml
from fab.errors import InputError
from fab.files import MANIFEST_NAME, canonical_json, explain_os_error, read_json, sha256_file, write_atomic

FORMAT = "doedesign run 1"
CHECKPOINT = "checkpoint.npz"


@dataclass(frozen=True)
class Run:
    """A run folder and the spec it belongs to."""

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


def begin_run(folder: Path, spec: Spec, inputs: Mapping[str, str], overrides: Sequence[str]) -> Run:
    """Open a folder for a spec: a new run, an unfinished one to resume, or a finished one.

    Args:
        folder: the run folder; made if missing.
        spec: the spec.
        inputs: digests of the files the spec names.
        overrides: `--set` overrides that led to the spec, for the record.

    Raises:
        InputError: the folder belongs to another spec, to other inputs, or to something else altogether.
    """
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir()) and not (folder / MANIFEST_NAME).is_file()):
        raise InputError(
            str(folder), "a run needs a new or empty folder, or its own", "other content", "Choose another --out."
        )
    if (folder / MANIFEST_NAME).is_file():
        found = read_json(folder / MANIFEST_NAME)
        _require_run(folder, found)
        wanted = _manifest(spec, inputs, overrides, "running")
        if any(found.get(key) != wanted[key] for key in ("spec_sha256", "inputs_sha256")):
            raise InputError(
                str(folder),
                f"the folder must belong to this spec (sha256 {wanted['spec_sha256'][:12]})",
                f"the run of another spec or other input files ({str(found.get('spec_sha256'))[:12]})",
                "Choose another --out, or remove that run.",
            )
        return Run(folder, spec, found["state"] == "done")
    write_atomic(folder / MANIFEST_NAME, canonical_json(_manifest(spec, inputs, overrides, "running")))
    comments = ["every default filled in", *(f"--set {override}" for override in overrides)]
    write_atomic(folder / "spec.toml", spec_to_toml(spec, comments).encode())
    return Run(folder, spec, done=False)


def finish_run(run: Run, inputs: Mapping[str, str], overrides: Sequence[str], results: Sequence[str]) -> None:
    """Record the digests of all results and mark the run done; the checkpoint is no longer needed."""
    manifest = _manifest(run.spec, inputs, overrides, "done")
    manifest["results_sha256"] = {name: sha256_file(run.path(name)) for name in sorted(results)}
    write_atomic(run.path(MANIFEST_NAME), canonical_json(manifest))
    run.path(CHECKPOINT).unlink(missing_ok=True)


def open_run(folder: Path) -> Run:
    """A finished run.

    Raises:
        InputError: no run, an unfinished one, or one whose spec or height map changed since it was made.
    """
    if not folder.is_dir():
        raise InputError(str(folder), "must be a run folder", "no folder", "Make one with: doedesign optimize SPEC")
    if not (folder / MANIFEST_NAME).is_file():
        raise InputError(str(folder), f"a run folder has a {MANIFEST_NAME}", "none", "Give the folder optimize wrote.")
    manifest = read_json(folder / MANIFEST_NAME)
    _require_run(folder, manifest)
    spec = load_spec(folder / "spec.toml")
    if spec_digest(spec) != manifest.get("spec_sha256"):
        raise InputError(
            str(folder / "spec.toml"),
            "must be the spec of this run",
            "a file that was changed since",
            "Restore it, or optimise the changed spec into a folder of its own.",
        )
    if manifest.get("state") != "done":
        raise InputError(
            str(folder), "the run must be finished", "an unfinished run", "Resume it with the same optimize command."
        )
    for name, digest in manifest.get("results_sha256", {}).items():
        if name.endswith(".exr") and sha256_file(folder / name) != digest:
            raise InputError(
                str(folder / name), "must be the file this run wrote", "a changed file", "Restore it or run it again."
            )
    return Run(folder, spec, done=True)


def _require_run(folder: Path, manifest: Mapping[str, Any]) -> None:
    if manifest.get("format") != FORMAT:
        raise InputError(
            str(folder / MANIFEST_NAME),
            f'must say format "{FORMAT}"',
            repr(manifest.get("format")),
            "Give a folder that optimize of this version wrote.",
        )


def save_checkpoint(run: Run, arrays: Sequence[np.ndarray], step: int, history: Sequence[Mapping[str, Any]]) -> None:
    """Store everything a run needs to go on: arrays in their order, the number of steps done, the history."""
    buffer = io.BytesIO()
    named: dict[str, Any] = {f"array{i}": array for i, array in enumerate(arrays)}
    text = np.frombuffer(json.dumps(list(history)).encode(), np.uint8)
    digest = np.frombuffer(spec_digest(run.spec).encode(), np.uint8)
    np.savez(buffer, step=np.int64(step), history=text, spec=digest, **named)
    write_atomic(run.path(CHECKPOINT), buffer.getvalue())


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
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = [stored[f"array{i}"] for i in range(len(shapes))]
            step, history = int(stored["step"]), json.loads(stored["history"].tobytes())
            digest = stored["spec"].tobytes().decode()
    except OSError as error:
        if error.errno is not None:
            raise explain_os_error(error, path) from error
        raise InputError(str(path), "must be a whole checkpoint", f'"{error}"', cure) from error
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, NotImplementedError) as error:
        raise InputError(str(path), "must be a whole checkpoint", f'"{error}"', cure) from error
    if digest != spec_digest(run.spec) or [a.shape for a in arrays] != list(shapes):
        raise InputError(str(path), "must belong to this run's spec", "a checkpoint of another spec", cure)
    return arrays, step, history


def write_history(run: Run, history: Sequence[Mapping[str, Any]]) -> None:
    """One JSON object per line and step."""
    lines = "".join(json.dumps(record, sort_keys=True) + "\n" for record in history)
    write_atomic(run.path("history.jsonl"), lines.encode())
