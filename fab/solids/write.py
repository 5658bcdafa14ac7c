"""The solids and height maps of an order, for people and programs that read no masks.

    <JOB>_PLATE.step     one die of glass with its chrome and the place of the relief; with its rings
                            as exact circles if the map is radial
    <JOB>_WAFER.step     the wafer with the chrome and the place of the relief of every die
    <JOB>_RELIEF.3mf     the relief as a closed mesh, block-reduced where it is large; also .glb and _MM.stl
    <JOB>_PATCH.step     on request a window at full resolution, also as .3mf, .glb and _MM.stl
    <JOB>_HEIGHT.tif     heights in 16 bits; also .npy, in metres
    <JOB>_GREY.png       the picture for greyscale and two-photon writers
    <JOB>_SAG.DAT        grid sag for ray tracers: the middle of the relief

A new kind of file is a `ModelKind` in a module of its own and a place in `KINDS`.
"""

from pathlib import Path

from fab.errors import CheckFailed, InputError
from fab.manifest.records import ModelEntry
from fab.solids import direct_write, height_files, mesh_files, step_files
from fab.solids.model import DoeModel, ModelKind

KINDS: tuple[ModelKind, ...] = (
    step_files.DIE,
    step_files.WAFER,
    *mesh_files.RELIEFS,
    step_files.PATCH,
    *mesh_files.PATCHES,
    *height_files.KINDS,
    *direct_write.KINDS,
)


def model_entries(folder: Path, stem: str, model: DoeModel) -> list[ModelEntry]:
    """Return the entries of all files that a DOE has, names beginning with `stem`; nothing is written."""
    entries = (kind.entry(folder / f"{stem}{kind.ending}", model) for kind in KINDS)
    return [entry for entry in entries if entry is not None]


def write_models(folder: Path, stem: str, model: DoeModel) -> list[ModelEntry]:
    """Write every kind of file that a DOE has into a folder; return their entries (`model_entries`)."""
    entries = model_entries(folder, stem, model)
    for entry in entries:
        kind = _kind(entry)
        assert kind is not None  # the entries are made of the kinds there are
        kind.write(folder / entry.file, model)
    return entries


def model_problems(folder: Path, entry: ModelEntry, model: DoeModel) -> list[str]:
    """Read a file back and compare it with what its entry says and with the DOE; one sentence per difference."""
    kind = _kind(entry)
    if kind is None:
        return ["a kind of file that this version does not know: verify the order with the version that wrote it"]
    try:
        return kind.problems(folder / entry.file, entry, model)
    except (InputError, CheckFailed) as error:
        # A disk too full to draw the file again, elsewhere, says nothing about the file.
        if isinstance(error, InputError) and isinstance(error.__cause__, OSError) and str(folder) not in error.where:
            raise
        return [str(error)]


def _kind(entry: ModelEntry) -> ModelKind | None:
    """Return the kind of a file; None for one of a later version."""
    return next((kind for kind in KINDS if entry.file.endswith(kind.ending)), None)
