"""`doedesign psf`: what the continuous design, the quantised one, and the one drawn in the masks do with light."""

import shutil
from collections.abc import Callable, Sequence
from itertools import count
from math import isclose
from pathlib import Path
from typing import Any

import numpy as np

from doedesign.build import camera_of
from doedesign.commands.heights import LevelMap, levels_of_run, read_any_height
from doedesign.evaluate import design_metrics
from doedesign.progress import meter
from doedesign.report.pictures import draw_encircled, draw_height, draw_mtf, draw_psfs
from doedesign.runs import Run, open_run
from fab.errors import CheckFailed, InputError
from fab.files import MANIFEST_NAME, atomic_folder, canonical_json, sha256_file
from fab.grid import Grid
from fab.layout import pixel_edges
from fab.levels import Levels, height_of
from fab.manifest import read_manifest
from fab.units import format_length
from fab.verify import read_level_map
from sim.camera import Camera
from sim.hankel import radial_profile, ring_count
from sim.psf import PsfBank, psf_bank, radial_psf_bank
from sim.store import write_bank
from sim.transfer import transfer_bank

Say = Callable[[str], None]


def drawn_in_masks(folder: Path, drawing: LevelMap) -> np.ndarray:
    """Level map that the combined GDS file of a mask order draws, `[y, x]`.

    Args:
        folder: the mask order.
        drawing: what it should draw.

    Raises:
        InputError: no mask order, a broken file, or a drawing on another raster or with other levels.
    """
    manifest = read_manifest(folder)
    levels, grid = manifest.staircase(), manifest.grid()
    alike = grid.shape == drawing.grid.shape and levels.count == drawing.levels.count
    # The manifest rounds lengths to its units' last digit.
    lengths = (grid.pitch_m, drawing.grid.pitch_m), (levels.step_m, drawing.levels.step_m)
    if not (alike and all(isclose(found, wanted, rel_tol=1e-6) for found, wanted in lengths)):
        raise InputError(
            str(folder),
            f"the masks must be those of this run, {_told(drawing.grid, drawing.levels)}",
            _told(grid, levels),
            "Give the masks of this run (--masks).",
        )
    return read_level_map(folder / manifest.combined_gds, levels, pixel_edges(grid))


def _told(grid: Grid, levels: Levels) -> str:
    pixels = f"{grid.shape[0]} x {grid.shape[1]} pixels of {format_length(grid.pitch_m)}"
    return f"{pixels} in {levels.count} levels of {format_length(levels.step_m)}"


def designs_of(run: Run, masks: Path | None, say: Say = lambda _: None) -> dict[str, np.ndarray]:
    """Height maps by name: "continuous", "quantised", and "from_masks" if there is a mask order.

    The order is the one given, or the one in masks/NAME.

    Raises:
        InputError: a file that cannot be read.
        CheckFailed: the masks draw something else than the run's quantised map.
    """
    drawing = levels_of_run(run)
    quantised = height_of(drawing.level, drawing.levels).astype(np.float32)
    designs = {"continuous": read_any_height(run.path("height_continuous.exr")).height_m, "quantised": quantised}
    folder = masks or Path("masks") / run.spec.name
    if masks is None and not (folder / MANIFEST_NAME).is_file():
        say(f"no mask order in {folder}; write one with: doedesign masks {run.folder}")
        return designs
    rebuilt = drawn_in_masks(folder, drawing)
    different = (rebuilt != drawing.level) & drawing.grid.inside_circle(drawing.aperture_m)
    if different.any():
        y, x = (int(i) for i in np.argwhere(different)[0])
        where = f"{int(different.sum())} cells are not drawn as designed in {run.folder}, first row {y}, column {x}"
        raise CheckFailed([f"{folder}: {where}"])
    return designs | {"from_masks": height_of(rebuilt, drawing.levels).astype(np.float32)}


def psf(
    run_folder: Path,
    masks: Path | None = None,
    depths_m: Sequence[float] = (),
    field_rad: tuple[float, float] = (0.0, 0.0),
    say: Say = lambda _: None,
) -> Path:
    """Write PSF banks, metrics and pictures of a run's designs into RUN/psf.

    Args:
        run_folder: a finished run.
        masks: its mask order; `masks/NAME` if there is one.
        depths_m: source depths; those of the spec by default.
        field_rad: field angles (y, x).
        say: told what is going on.

    Returns:
        the folder.

    Raises:
        InputError: a run or mask order that cannot be read.
        CheckFailed: the masks draw something else than the design, or light disagrees.
    """
    run = open_run(run_folder)
    camera = camera_of(run.spec)
    depths = tuple(depths_m) or (*run.spec.scene.near_m, *run.spec.scene.far_m)
    # A depth the spec does not name counts as near if it is no farther than the farthest obstruction.
    near = tuple(z for z in depths if run.spec.scene.near_m and z <= max(run.spec.scene.near_m))
    far = tuple(z for z in depths if z not in near)
    designs = designs_of(run, masks, say)
    total = len(designs) * len(depths) * sum(len(c.wavelengths_m) for c in camera.colours)
    with meter("PSFs", total) as progress:
        done = count(1)
        banks = {
            name: _bank(run, camera, name, height, depths, field_rad, lambda: progress.advance(next(done)))
            for name, height in designs.items()
        }
    if "from_masks" in banks and not np.array_equal(banks["from_masks"].energy, banks["quantised"].energy):
        raise CheckFailed([f"{run.folder}: the PSFs of the masks are not those of the quantised design"])
    say("writing banks and pictures")
    return _write(run, camera, designs, banks, near, far)


def _takes_hankel(run: Run, name: str, field_rad: tuple[float, float]) -> bool:
    """Rings before rounding, seen on the axis, are rings; what is drawn is a raster of cells."""
    return name == "continuous" and run.spec.optimize.parametrization == "radial" and not any(field_rad)


def _bank(
    run: Run,
    camera: Camera,
    name: str,
    height_m: np.ndarray,
    depths_m: tuple[float, ...],
    field_rad: tuple[float, float],
    on_psf: Callable[[], None],
) -> PsfBank:
    profile = radial_profile(height_m, camera.grid) if _takes_hankel(run, name, field_rad) else None
    if profile is not None:
        return radial_psf_bank(camera, profile[: ring_count(camera)], depths_m, on_psf=on_psf)
    propagation = run.spec.optics.propagation
    return psf_bank(camera, height_m, depths_m, field_rad=field_rad, propagation=propagation, on_psf=on_psf)


def _write(
    run: Run,
    camera: Camera,
    designs: dict[str, np.ndarray],
    banks: dict[str, PsfBank],
    near: tuple[float, ...],
    far: tuple[float, ...],
) -> Path:
    flat, depths, field = np.zeros(camera.grid.shape), (*near, *far), banks["quantised"].field_rad
    lens = psf_bank(camera, flat, depths, field_rad=field)
    lens_transfer = transfer_bank(camera, flat, depths)
    metrics: dict[str, Any] = {}
    with atomic_folder(run.path("psf")) as fresh:
        for name in ("continuous", "quantised"):
            bank, height = banks[name], designs[name]
            write_bank(fresh / f"{name}.exr", bank, {"design": run.spec.name})
            draw_psfs(fresh / f"{name}_psf.png", camera, bank, near, far)
            transfer = transfer_bank(camera, height, depths)
            draw_mtf(fresh / f"{name}_mtf.png", camera, transfer, near, far, lens_transfer)
            draw_encircled(fresh / f"{name}_encircled.png", camera, bank, near, far, lens)
            metrics[name] = design_metrics(camera, height, bank, near, lens)
        if _takes_hankel(run, "continuous", field):
            # The budget's band is that of a raster of cells, which rings are not.
            metrics["continuous"] = [{k: v for k, v in row.items() if k != "budget"} for row in metrics["continuous"]]
        if "from_masks" in banks:
            # Equal to the last bit (checked above), so its numbers and pictures are the same files.
            metrics["from_masks"] = metrics["quantised"]
            for path in sorted(fresh.glob("quantised*")):
                shutil.copyfile(path, fresh / path.name.replace("quantised", "from_masks"))
        title = f"{run.spec.name}, continuous"
        draw_height(fresh / "continuous_height.png", designs["continuous"], None, camera, title)
        (fresh / "metrics.json").write_bytes(canonical_json(metrics))
        digests = {path.name: sha256_file(path) for path in sorted(fresh.iterdir())}
        manifest = {"format": "doedesign psf 1", "run": run.spec.name, "results_sha256": digests}
        (fresh / MANIFEST_NAME).write_bytes(canonical_json(manifest))
    return run.path("psf")
