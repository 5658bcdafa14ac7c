"""PSFs of a finished run: of the continuous design, the quantised one, and the one drawn in the masks."""

import logging
import shutil
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from doedesign.build import camera_from_spec
from doedesign.design.metrics import design_metrics
from doedesign.runs.curve_tables import encircled_csv, mtf_csv
from doedesign.runs.folder import CONTINUOUS, Run, run_of
from doedesign.runs.level_maps import drawn_in_masks, level_map_of_run, read_any_height
from doedesign.runs.orders import own_order
from doedesign.runs.results import results_folder
from doedesign.runs.verdict import certified_orders, verdict_in_words, with_verdict
from doedesign.runtime.progress import meter
from doedesign.spec import Spec, spec_from_json, spec_to_json
from fab.errors import CheckFailed
from fab.figure import drawn_beside
from fab.files import canonical_json, path_of
from fab.height import HeightMap
from fab.plots.height import plot_height
from fab.runsheet.tables import CertifiedOrder
from sim.optic import HeightOptic, RingOptic
from sim.plots.curves import encircled_curves, plot_encircled, plot_mtf
from sim.plots.psfs import plot_psfs
from sim.propagation.hankel import radial_profile, ring_count
from sim.psf_bank import PsfBank, depths_from, field_from, psf
from sim.rigorous.edge_optic import EdgeOptic, optic_as_drawn
from sim.store import write_bank
from sim.transfer import mtf

log = logging.getLogger("doedesign")


def psfs(
    run: Run | str | Path,
    masks: str | Path | None = None,
    depths_m: str | float | Sequence[str | float] = (),
    field_rad: tuple[float, float] = (0.0, 0.0),
    out: str | Path | None = None,
) -> dict[str, PsfBank]:
    """Compute the PSFs of a run's heights before rounding, of its level map, and of what its masks draw.

    Args:
        run: a finished run, or its folder.
        masks: its mask order; `masks/NAME` if there is one.
        depths_m: source depths, in metres or with a unit ("5 m", "inf"); those of the spec by default.
        field_rad: field angles (y, x), radians, within 60 degrees.
        out: folder for the banks, their metrics (SI units) and pictures; with 0th orders of the run's certificate.

    Returns:
        PSF banks by name: "continuous" if the run has heights before rounding, "quantised", and "from_masks" if there
        is a mask order.

    Raises:
        InputError: a run, a mask order, depths or field angles that cannot be used.
        CheckFailed: the masks draw something else than the design.
    """
    field_rad = field_from(field_rad)
    depths = depths_from(depths_m) if np.size(depths_m) else ()
    run = run_of(run)
    camera = camera_from_spec(run.spec)
    near, far = _near_and_far(run.spec, depths)
    designs = _heights_of(run, masks)
    digest = level_map_of_run(run).digest
    certified = certified_orders(run.folder, digest)
    # What masks draw was just found equal to the level map in every cell, so its light is the same.
    different = [name for name in designs if name != "from_masks"]
    total = len(different) * len((*near, *far)) * sum(len(c.wavelengths_m) for c in camera.colours)
    optics: dict[str, Any] = {name: optic_as_drawn(camera, designs[name], depths_m=(*near, *far)) for name in different}
    about = {"level_map_sha256": digest, "light": camera.light}
    with results_folder(out, run.spec.name, run.folder, **about) as fresh:
        with meter("PSFs", total) as progress:
            done = count(1)

            def bank(name: str) -> PsfBank:
                optic, propagation = optics[name], run.spec.propagation
                profile = radial_profile(designs[name], camera.grid) if _takes_hankel(run, name, field_rad) else None
                if profile is not None:
                    optic, propagation = RingOptic(camera, jnp.asarray(profile[: ring_count(camera)])), "far_field"
                given: Any = {"field_rad": field_rad, "propagation": propagation}
                return psf(optic, depths=(*near, *far), on_psf=lambda: progress.advance(next(done)), **given)

            banks = {name: bank(name) for name in different}
        if "from_masks" in designs:
            banks["from_masks"] = banks["quantised"]
        if fresh is not None:
            log.info("writing banks and pictures")
            _write(fresh, run, optics, banks, near, far, certified)
    for words in verdict_in_words(certified):
        log.info(words)
    return banks


def _heights_of(run: Run, masks: str | Path | None) -> dict[str, np.ndarray]:
    """Height maps by name; see `psfs`."""
    level_map, file = level_map_of_run(run), run.path(CONTINUOUS)
    # A training that left the DOE as it was has only the heights after rounding.
    before = {"continuous": read_any_height(file).height_m} if file.is_file() else {}
    designs = {**before, "quantised": level_map.height_m}
    folder = own_order(run.spec.name, run.folder, level_map) if masks is None else path_of(masks, "masks")
    if folder is None:
        log.info(f"no mask order of this run; write one with: doedesign masks {run.folder}")
        return designs
    rebuilt = level_map.with_level(drawn_in_masks(folder, level_map))
    different = rebuilt.level != level_map.level
    if different.any():
        y, x = (int(i) for i in np.argwhere(different)[0])
        where = f"{int(different.sum())} cells are not drawn as designed in {run.folder}, first row {y}, column {x}"
        raise CheckFailed([f"{folder}: {where}"])
    return designs | {"from_masks": rebuilt.height_m}


def _near_and_far(spec: Spec, depths_m: Sequence[float]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Near and far depths to look at; the rules of a spec hold for depths that are given, too."""
    depths = tuple(dict.fromkeys(depths_m or (*spec.scene.near_m, *spec.scene.far_m)))
    # A depth the spec does not name counts as near if it is no farther than the farthest obstruction.
    near = tuple(z for z in depths if z <= max(spec.scene.near_m, default=0.0))
    far = tuple(z for z in depths if z not in near)
    scene = {"near_m": near or spec.scene.near_m, "far_m": far or spec.scene.far_m}
    spec_from_json(spec_to_json(spec) | {"scene": scene}, "depths_m")
    return near, far


def _takes_hankel(run: Run, name: str, field_rad: tuple[float, float]) -> bool:
    """Rings before rounding, seen on the axis, are rings; what is drawn is a raster of cells."""
    return name == "continuous" and run.spec.optimize.parametrization == "radial" and not any(field_rad)


def _write(
    folder: Path,
    run: Run,
    optics: dict[str, HeightOptic | EdgeOptic],
    banks: dict[str, PsfBank],
    near: tuple[float, ...],
    far: tuple[float, ...],
    certified: tuple[CertifiedOrder, ...],
) -> None:
    camera = camera_from_spec(run.spec)
    flat, depths, field = HeightOptic.of(camera), (*near, *far), banks["quantised"].field_rad
    lens = psf(flat, depths=depths, field_rad=field)
    lens_transfer = mtf(flat, depths=depths, field_rad=field)
    metrics: dict[str, Any] = {"lens": camera.lens_text, "light": camera.light}
    within = encircled_curves([*(banks[name] for name in optics), lens])
    with drawn_beside() as draw:
        for (name, optic), inside in zip(optics.items(), within[:-1], strict=True):
            bank, curves = banks[name], [inside, within[-1]]
            write_bank(folder / f"{name}.exr", bank, {"design": run.spec.name, "lens": camera.lens_text})
            whose = f"{run.spec.name}, {name.replace('_', ' ')}"
            draw(folder / f"{name}_psf.png", plot_psfs, bank, camera, near, far, title=whose)
            transfer = mtf(optic, depths=depths, field_rad=field)
            draw(folder / f"{name}_mtf.png", plot_mtf, transfer, camera, near, far, lens_transfer, title=whose)
            picture = folder / f"{name}_encircled.png"
            draw(picture, plot_encircled, bank, camera, near, far, lens, title=whose, curves=curves)
            (folder / f"{name}_mtf.csv").write_bytes(mtf_csv(transfer, lens_transfer).encode())
            (folder / f"{name}_encircled.csv").write_bytes(encircled_csv(bank, curves, camera).encode())
            metrics[name] = design_metrics(optic, bank, near, lens)
        if "continuous" in optics:
            height_map = HeightMap(np.asarray(optics["continuous"].height_m), camera.grid, run.spec.doe.relief)
            draw(folder / "continuous_height.png", plot_height, height_map, None, f"{run.spec.name}, continuous")
    # Of the map itself; the heights before rounding have other walls.
    metrics["quantised"] = with_verdict(metrics["quantised"], certified)
    if _takes_hankel(run, "continuous", field):
        # The budget's band is that of a raster of cells, which rings are not.
        metrics["continuous"] = [{k: v for k, v in row.items() if k != "budget"} for row in metrics["continuous"]]
    if "from_masks" in banks:
        # Its numbers and pictures are the same files.
        metrics["from_masks"] = metrics["quantised"]
        for path in sorted(folder.glob("quantised*")):
            shutil.copyfile(path, folder / path.name.replace("quantised", "from_masks"))
    (folder / "metrics.json").write_bytes(canonical_json(metrics))
