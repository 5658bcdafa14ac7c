"""`doedesign psf --fabricated`: the PSFs of one plate as the process makes it, and where its light goes."""

from pathlib import Path
from typing import Any

import numpy as np

from doedesign.commands.psf import Say
from doedesign.design.design import Design
from doedesign.prediction import plate_rows
from doedesign.runs.folder import alone_in, open_run
from doedesign.runs.level_maps import open_design
from doedesign.runs.results import require_own
from doedesign.runtime.progress import meter
from doedesign.spec import load_variation, variation_to_toml
from fab.draws import EXPECTED, variation_at
from fab.errors import CheckFailed, InputError
from fab.figure import save
from fab.files import MANIFEST_NAME, atomic_folder, canonical_json, sha256_file
from fab.process import Process, Variation
from sim.leakage import SplitPsf, split_psf
from sim.metrics import without_infinities
from sim.plots.leakage import plot_split
from sim.plots.psfs import plot_psfs
from sim.psf_bank import PsfBank, psf
from sim.store import write_bank
from sim.surface import as_fabricated

# Interference beyond what two fields can do is rounding of single precision, far below one part in a thousand.
_MOST_EXCESS = 1e-3


def fabricated(
    run_folder: Path,
    masks: Path | None = None,
    *,
    process: Path | None = None,
    variation: Path | None = None,
    seed: int | None = None,
    draw: str = "normal/0",
    say: Say = lambda _: None,
) -> Path:
    """Write the PSF bank, the metrics and pictures of one plate as fabricated into RUN/fabricated.

    Args:
        run_folder: a finished run.
        masks: its mask order, whose files are read; `masks/NAME` if there is one, else the run's own map.
        process: TOML file with a [process] table; the run's own process by default.
        variation: TOML file with the errors of the plate.
        seed: take the errors from this seed of the process instead.
        draw: which draw of the seed, as in a tolerance study.
        say: told what is going on.

    Returns:
        the folder. With neither a variation nor a seed the plate has every error at the process's mean.

    Raises:
        InputError: something that cannot be read, or errors beyond the model.
        CheckFailed: leaked and diffracted light do not make up the plate's.
    """
    run = open_run(run_folder)
    design = open_design(run, masks)
    made_by = design.process(process)
    plate, source = errors_of_plate(design, made_by, variation, seed, draw)
    say(f"plate: {source}")
    folder = run.path("fabricated")
    require_own(folder)
    with alone_in(run.folder), atomic_folder(folder) as fresh:
        _write(fresh, design, made_by, plate, source, say)
    return folder


def errors_of_plate(
    design: Design, process: Process, file: Path | None, seed: int | None, draw: str
) -> tuple[Variation, str]:
    """Errors of one plate, and a few words on where they come from.

    Args:
        design: the design.
        process: what makes it.
        file: TOML file with the errors.
        seed: take them from this seed of the process instead.
        draw: which draw of the seed.

    Returns:
        with neither a file nor a seed, every error at the process's mean.

    Raises:
        InputError: both a file and a seed, or a file that cannot be read.
    """
    if file is not None and seed is not None:
        raise InputError("--seed", "a plate has one source of errors", "also --variation", "Leave one of them out.")
    if file is not None:
        return load_variation(file), f"errors of {file.name}"
    key = EXPECTED if seed is None else draw
    errors = variation_at(process, seed or 0, max(design.camera.grid.extent_m), key)
    if seed is not None:
        return errors, f"draw {key} of seed {seed} of the process {process.name}"
    return errors, f"every error of the process {process.name} at its mean"


def _write(folder: Path, design: Design, process: Process, plate: Variation, source: str, say: Say) -> None:
    camera = design.camera
    surface = as_fabricated(design.level_map.level, camera, process, plate)
    total = len(design.depths_m) * len(camera.colours)
    splits: dict[tuple[int, int], SplitPsf] = {}
    with meter("PSFs", total) as progress:
        for d, depth in enumerate(design.depths_m):
            for c, colour in enumerate(camera.colours):
                splits[c, d] = split_psf(surface, depth, colour)
                progress.advance(len(splits))
    excess = max(split.excess() for split in splits.values())
    if excess > _MOST_EXCESS:
        raise CheckFailed([f"leaked and diffracted light miss the plate's by {excess:.1e} of its brightest pixel"])
    meant = as_fabricated(design.level_map.level, camera, process, Variation())
    nominal = psf(meant, depths=design.depths_m)
    bank = _bank(design, splits)
    say("writing bank and pictures")
    rows = {"nominal": plate_rows(design, meant, nominal), "fabricated": plate_rows(design, surface, bank)}
    rows = {name: without_infinities(found) for name, found in rows.items()}
    for row in rows["fabricated"]:
        d = bank.depths_m.index(float("inf") if row["depth_m"] is None else row["depth_m"])
        row["split"] = _sums(splits[bank.colours.index(row["colour"]), d])
    write_bank(folder / "fabricated.exr", bank, {"design": design.name, "plate": source})
    (folder / "variation.toml").write_text(variation_to_toml(plate, [source]), encoding="utf-8")
    (folder / "metrics.json").write_bytes(canonical_json(rows))
    save(plot_psfs(bank, camera, design.near_m, design.far_m), folder / "fabricated_psf.png")
    orders = [
        tuple(
            next(r["zeroth_order"] for r in rows[name] if r["colour"] == colour) for name in ("nominal", "fabricated")
        )
        for colour in bank.colours
    ]
    save(plot_split(nominal, splits, camera, 0, orders), folder / "leakage.png")
    digests = {path.name: sha256_file(path) for path in sorted(folder.iterdir())}
    manifest = {
        "format": "doedesign fabricated 1",
        "run": design.name,
        "level_map_sha256": design.level_map.digest,
        "plate": source,
        "results_sha256": digests,
    }
    (folder / MANIFEST_NAME).write_bytes(canonical_json(manifest))


def _bank(design: Design, splits: dict[tuple[int, int], SplitPsf]) -> PsfBank:
    camera = design.camera
    energy = np.stack(
        [np.stack([splits[c, d].total for d in range(len(design.depths_m))]) for c in range(len(camera.colours))]
    )
    return PsfBank(energy, tuple(c.name for c in camera.colours), design.depths_m, camera.pixel_m)


def _sums(split: SplitPsf) -> dict[str, Any]:
    """Energy in the window by origin; the three sum to the throughput."""
    parts = {"leaked": split.leaked, "diffracted": split.diffracted, "interference": split.interference}
    return {name: float(part.sum(dtype=np.float64)) for name, part in parts.items()}
