"""Predictions on a run sheet: the light of the DOE, the test gratings, and which measured number matters most.

The ranking is the tolerance analysis of one error at a time, on a patch of the design: Strehl ratio and 0th order are
means over the DOE, and a patch half way to the rim has them about as the whole DOE does. What of it is open counts;
where that is less than half of it, the patch lies where most is open. Errors of the chrome are not in it.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from doedesign.build import with_edge_moves
from doedesign.design.design import Design
from doedesign.prediction import Prediction, plate_rows, predict
from doedesign.tolerancing.analysis import sample_of
from doedesign.tolerancing.sensitivity import one_at_a_time
from fab.aperture import MaskAperture, RoundAperture
from fab.draws import EXPECTED, one_at_a_time_keys, variation_at, varying
from fab.errors import InputError
from fab.figure import png_bytes
from fab.grid import Grid
from fab.process import Normal, Process, Variation, deviation_of
from fab.runsheet.tables import Grating, Importance, PredictedMetrics, Predictions, SheetPrediction
from sim.aperture import open_cells
from sim.camera import Camera
from sim.material import full_wave_wavelength_m, refractive_index
from sim.metrics import strehl, zeroth_order
from sim.plots.psfs import plot_psfs
from sim.psf_bank import psf
from sim.surface import as_fabricated, drawn_alike

# A laser of the kind that most optics labs have, and that of the published prototype.
PROBE_M = 520e-9
_DEPTH_ERRORS = (-0.05, -0.02, 0.0, 0.02, 0.05)
_PATCH = 128  # shares of variance are within 0.04 of those on 512 cells, as they are on 256


def predicted_metrics(rows: Sequence[dict[str, Any]]) -> tuple[PredictedMetrics, ...]:
    """Rows of a prediction as a run sheet has them; a ratio without any light in the disc is left out."""
    metrics = []
    for row in rows:
        ratio = row.get("ring_to_disc")
        ratio = ratio if ratio is not None and math.isfinite(ratio) else None
        shared = {name: row[name] for name in ("colour", "depth_m", "strehl", "zeroth_order", "throughput")}
        metrics.append(PredictedMetrics(**shared, ring_to_disc=ratio, far_spot=row.get("far_spot")))
    return tuple(metrics)


def grating_orders(
    depths_m: Sequence[float] | NDArray[np.floating], material: str, wavelength_m: float
) -> tuple[float, float]:
    """Shares of the light through an empty window that the binary and the blazed test grating send straight on.

    The deepest etch opens half of the binary grating: cos^2(phi / 2), where phi is an etch's phase at the vacuum
    wavelength (metres). All combinations of masks share the blazed one alike: the product of cos^2(phi / 2) over all
    etches. `depths_m` is the depth of every mask's etch, metres.
    """
    waves = np.asarray(depths_m) * (refractive_index(material, wavelength_m) - 1) / wavelength_m
    orders = np.cos(np.pi * waves) ** 2
    return float(orders[np.argmax(depths_m)]), float(np.prod(orders))


def _place_of_patch(coverage: NDArray[np.float32], side: int) -> tuple[int, int]:
    """First row and column of a patch: the middle of the right half, or where most is open if half of that is not."""
    ny, nx = coverage.shape
    usual = (ny - side) // 2, min(nx - side, 3 * nx // 4 - side // 2)
    step = max(1, side // 2)
    rows, columns = ([*range(0, n - side, step), n - side] for n in (ny, nx))
    sums = np.pad(coverage, ((1, 0), (1, 0))).cumsum(0, np.float64).cumsum(1)

    def opened(y0: int, x0: int) -> float:
        y1, x1 = y0 + side, x0 + side
        return sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0]

    if opened(*usual) >= side**2 / 2:
        return usual
    return max(((y0, x0) for y0 in rows for x0 in columns), key=lambda place: opened(*place))


def _patch(design: Design, process: Process) -> tuple[NDArray[np.uint8], Camera, Process]:
    """A patch of a design, its camera, and the process with the place where it lies."""
    camera, pitch_m = design.camera, design.camera.grid.pitch_m
    coverage = open_cells(camera.grid, camera.opening)
    ny, nx = coverage.shape
    side = min(_PATCH, ny, nx // 2)
    y0, x0 = _place_of_patch(coverage, side)
    off = ((y0 + (side - ny) / 2) * pitch_m, (x0 + (side - nx) / 2) * pitch_m)
    die_m = (process.die_m[0] + off[0], process.die_m[1] + off[1])
    opened = coverage[y0 : y0 + side, x0 : x0 + side] >= 0.5
    # Where all of it is open, an opening beyond the corners is the same and takes less time.
    aperture = RoundAperture(2 * side * pitch_m) if opened.all() else MaskAperture.of(opened, pitch_m)
    small = replace(camera, grid=Grid((side, side), pitch_m), aperture=aperture)
    level = np.ascontiguousarray(design.level_map.level[y0 : y0 + side, x0 : x0 + side])
    on_wafer = max(process.wafer_radius_m, math.hypot(*die_m))
    return level, small, replace(process, die_m=die_m, wafer_radius_m=on_wafer)


def rank_importance(design: Design, process: Process, wavelength_m: float) -> tuple[Importance, ...]:
    """Rank the numbers that a lab measures by how much of the differences between the DOEs of a process they explain.

    Strehl ratio and 0th order are those at one wavelength (metres). The largest share of the Strehl ratio's variance
    comes first; there is none if nothing varies.

    Raises:
        InputError: errors beyond what the model describes.
    """
    known = [name for name in varying(process) if deviation_of(name).measured]
    kept = replace(process, spreads={n: s if n in known else Normal(s.mean) for n, s in process.spreads.items()})
    if not known:
        return ()
    level, small, there = _patch(design, kept)
    side_m = max(small.grid.extent_m)
    keys = [EXPECTED, *one_at_a_time_keys(kept)]
    made = partial(as_fabricated, level, small, wavelengths_m=(wavelength_m,))
    nominal = made(Process((design.aim or design.level_map).levels), Variation())  # the plate that should come out
    draws = {}
    for key in keys:
        surface = made(there, variation_at(there, 0, side_m, key))
        found = {"strehl": float(strehl(surface, nominal)[0]), "zeroth_order": float(zeroth_order(surface)[0])}
        draws[key] = [{"colour": "", "depth_m": None, **found}]
    variances: dict[str, dict[str, float]] = {"strehl": {}, "zeroth_order": {}}
    for effect in one_at_a_time(kept, sample_of(draws)):
        if effect.colour is None:
            of, name = variances[effect.quantity], _measured(effect.error)
            of[name] = of.get(name, 0.0) + effect.variance
    totals = {quantity: sum(of.values()) or 1.0 for quantity, of in variances.items()}
    found = [
        Importance(name, variance / totals["strehl"], variances["zeroth_order"][name] / totals["zeroth_order"])
        for name, variance in variances["strehl"].items()
    ]
    return tuple(sorted(found, key=lambda one: (-one.strehl, one.measured)))


def _measured(error: str) -> str:
    """The number that is measured to find an error: "overlay of mask 3", "depth of every mask"."""
    key, bracket, mask = error.partition("[")
    name = deviation_of(error).measured
    if bracket:
        return f"{name} of mask {int(mask.removesuffix(']')) + 1}"
    return f"{name} of every mask" if key.startswith("common_") else name


def _predictions(design: Design, process: Process) -> tuple[Sequence[dict[str, Any]], Prediction]:
    """Predict the DOE as drawn (its rows) and the one with mean errors."""
    variation, camera = process.expected(), design.camera
    if variation.nominal:
        expected = predict(design, process, variation)
        return expected.rows, expected
    asked = (design.level_map.level, camera, process, variation)
    with ThreadPoolExecutor(1) as beside:
        made = beside.submit(as_fabricated, *asked, depths_m=design.depths_m)
        # In cells and views like the other's, whose propagation is compiled by the time that it is there.
        alike = drawn_alike(*asked, depths_m=design.depths_m)
        rows_as_drawn = plate_rows(design, alike, psf(alike, depths=design.depths_m))
        surface = made.result()
    bank = psf(surface, depths=design.depths_m)
    return rows_as_drawn, Prediction(surface, bank, plate_rows(design, surface, bank))


def predict_sheet(
    design: Design,
    process: Process,
    design_m: float,
    probe_m: float = PROBE_M,
    edge_moves_m: Sequence[float] = (),
) -> SheetPrediction:
    """Predict what a lab should see at one depth: the middle one of the near depths, or else the farthest.

    Args:
        design: the design.
        process: the lab's process.
        design_m: design wavelength, metres.
        probe_m: wavelength of the lab's test laser, metres.
        edge_moves_m: how far the edges of each mask were moved outward to make up for the process, metres.

    Raises:
        InputError: a probe wavelength at which the glass is not known, or errors beyond what the model describes.
    """
    levels, material = design.levels, design.camera.material
    waves_per_m = (refractive_index(material, probe_m) - 1) / probe_m
    try:
        full_wave_m = full_wave_wavelength_m(material, levels.period_m)
    except InputError:
        full_wave_m = None  # the sheet says so
    moved = with_edge_moves(process, edge_moves_m)
    middle = len(design.near_m) // 2
    # All depths would take most of the time of a whole order, and say the same.
    near_m = tuple(sorted(design.near_m)[middle : middle + 1])
    design = replace(design, near_m=near_m, far_m=() if near_m else (max(design.far_m),))
    with ThreadPoolExecutor(1) as pool:
        ranked = pool.submit(rank_importance, design, moved, design_m)
        as_drawn, expected = _predictions(design, moved)
        ranking = ranked.result()
    depths = np.array([levels.etch_depth_m(bit) for bit in range(levels.bits)])
    predictions = Predictions(
        drawn=predicted_metrics(as_drawn),
        expected=predicted_metrics(expected.rows),
        design_m=design_m,
        full_wave_m=full_wave_m,
        probe_m=probe_m,
        probe_waves=levels.period_m * waves_per_m,
        gratings=tuple(
            Grating(error, *grating_orders(depths * (1 + error), material, probe_m)) for error in _DEPTH_ERRORS
        ),
        ranking=ranking,
        index=refractive_index(material, design_m),
    )

    def picture() -> bytes:
        return png_bytes(
            plot_psfs(expected.bank, design.camera, design.near_m, design.far_m, title=f"{design.name}, expected")
        )

    return SheetPrediction(predictions, picture)
