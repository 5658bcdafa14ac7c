"""`doedesign psf`: what the continuous design, the quantised one, and the one drawn in the masks do with light."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from doedesign.build import camera_of
from doedesign.commands.heights import levels_of_run, read_any_height
from doedesign.evaluate import design_metrics
from doedesign.progress import meter
from doedesign.report.pictures import draw_encircled, draw_height, draw_mtf, draw_psfs
from doedesign.runs import Run, open_run
from fab.errors import CheckFailed, InputError
from fab.files import MANIFEST_NAME, atomic_folder, canonical_json, sha256_file
from fab.layout import pixel_edges
from fab.levels import height_of
from fab.manifest import read_manifest
from fab.verify import read_level_map
from sim.camera import Camera
from sim.hankel import radial_profile, ring_count
from sim.psf import PsfBank, psf_bank, radial_psf_bank
from sim.store import write_bank

Say = Callable[[str], None]


def drawn_in_masks(folder: Path, camera: Camera) -> np.ndarray:
    """Height map that the combined GDS file of a mask order draws, float32 metres `[y, x]`.

    Raises:
        InputError: no mask order, a broken file, or a drawing on another raster.
    """
    manifest = read_manifest(folder)
    levels, grid = manifest.staircase(), manifest.grid()
    if grid != camera.grid:
        raise InputError(
            str(folder),
            f"the masks must be drawn on the run's grid, {camera.grid.shape} at {camera.grid.pitch_m} m",
            f"{grid.shape} at {grid.pitch_m} m",
            "Give the masks of this run (--masks).",
        )
    level = read_level_map(folder / manifest.combined_gds, levels, pixel_edges(grid))
    return height_of(level, levels).astype(np.float32)


def designs_of(run: Run, masks: Path | None, say: Say = lambda _: None) -> dict[str, np.ndarray]:
    """Height maps by name: "continuous", "quantised", and "from_masks" if there is a mask order.

    The order is the one given, or the one in masks/NAME.

    Raises:
        InputError: a file that cannot be read.
        CheckFailed: the masks draw something else than the run's quantised map.
    """
    camera = camera_of(run.spec)
    drawing = levels_of_run(run)
    quantised = height_of(drawing.level, drawing.levels).astype(np.float32)
    designs = {"continuous": read_any_height(run.path("height_continuous.exr")).height_m, "quantised": quantised}
    folder = masks or Path("masks") / run.spec.name
    if masks is None and not (folder / MANIFEST_NAME).is_file():
        say(f"no mask order in {folder}; write one with: doedesign masks {run.folder}")
        return designs
    rebuilt = drawn_in_masks(folder, camera)
    inside = camera.grid.inside_circle(run.spec.doe.aperture_m)
    different = (rebuilt != quantised) & inside
    if different.any():
        y, x = (int(i) for i in np.argwhere(different)[0])
        where = f"{int(different.sum())} cells are not drawn as designed in {run.folder}, first row {y}, column {x}"
        raise CheckFailed([f"{folder}: {where}"])
    return designs | {"from_masks": rebuilt}


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
    radial = run.spec.optimize.parametrization == "radial"
    banks = {}
    with meter("PSFs", len(designs) * len(depths) * sum(len(c.wavelengths_m) for c in camera.colours)) as progress:
        done = iter(range(1, 1_000_000))
        for name, height in designs.items():
            profile = radial_profile(height, camera.grid) if radial and name == "continuous" else None
            count = lambda: progress.advance(next(done))  # noqa: E731
            if profile is not None and not any(field_rad):
                banks[name] = radial_psf_bank(camera, profile[: ring_count(camera)], depths, on_psf=count)
            else:
                banks[name] = psf_bank(
                    camera, height, depths, field_rad=field_rad, propagation=run.spec.optics.propagation, on_psf=count
                )
    if "from_masks" in banks and not np.array_equal(banks["from_masks"].energy, banks["quantised"].energy):
        raise CheckFailed([f"{run.folder}: the PSFs of the masks are not those of the quantised design"])
    say("writing banks and pictures")
    return _write(run, camera, designs, banks, near, far)


def _write(
    run: Run,
    camera: Camera,
    designs: dict[str, np.ndarray],
    banks: dict[str, PsfBank],
    near: tuple[float, ...],
    far: tuple[float, ...],
) -> Path:
    folder = run.path("psf")
    lens = psf_bank(camera, np.zeros(camera.grid.shape), (*near, *far), field_rad=banks["quantised"].field_rad)
    metrics: dict[str, Any] = {}
    with atomic_folder(folder) as fresh:
        for name, bank in banks.items():
            write_bank(fresh / f"{name}.exr", bank, {"design": run.spec.name})
            draw_psfs(fresh / f"{name}_psf.png", camera, bank, near, far)
            draw_mtf(fresh / f"{name}_mtf.png", camera, bank, near, far, lens)
            metrics[name] = design_metrics(camera, designs[name], bank, near)
        draw_height(
            fresh / "continuous_height.png", designs["continuous"], None, camera, f"{run.spec.name}, continuous"
        )
        draw_encircled(fresh / "quantised_encircled.png", camera, banks["quantised"], near, far, lens)
        (fresh / "metrics.json").write_bytes(canonical_json(metrics))
        digests = {path.name: sha256_file(path) for path in sorted(fresh.iterdir())}
        manifest = {"format": "doedesign psf 1", "run": run.spec.name, "results_sha256": digests}
        (fresh / MANIFEST_NAME).write_bytes(canonical_json(manifest))
    return folder
