"""Table of a design's numbers, the same for every design, whatever it was optimised for."""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import binary_erosion

from doedesign.design.objectives import Term
from doedesign.design.patterns import spot_centres_m
from doedesign.spec import Spec
from fab.units import parse_length
from sim.camera import Camera
from sim.metrics import (
    airy_radius_m,
    energy_budget,
    mean_wavelength_m,
    metric_rows,
    radius_map_m,
    spot_radius_m,
    without_infinities,
)
from sim.optic import CellOptic
from sim.psf_bank import PsfBank


def design_metrics(optic: CellOptic, bank: PsfBank, near_m: tuple[float, ...], lens: PsfBank) -> list[dict[str, Any]]:
    """Return one row per depth and colour of a bank on the axis: metrics (`sim.metrics`) and energy budget.

    `near_m` are those of its depths, metres, that are obstructions; `lens` has the plain lens at the same depths, and
    the DOE's grid: with light of walls, the optic's cells may be parts of its cells.
    """
    pitch = lens.metric_inputs().camera.grid.pitch_m
    rows = without_infinities(metric_rows(bank.metric_inputs(near_m, optic, lens=lens), "design"))
    places = ((d, c) for d in range(len(bank.depths_m)) for c in range(len(bank.colours)))
    for row, (d, c) in zip(rows, places, strict=True):
        colour = optic.camera.colours[c]
        row["budget"] = energy_budget(optic, bank.energy[c, d], bank.depths_m[d], colour, pitch_m=pitch)._asdict()
    return rows


def pattern_metrics(spec: Spec, camera: Camera, bank: PsfBank, terms: tuple[Term, ...]) -> list[dict[str, float]]:
    """Efficiency and uniformity of every `target_pattern` objective, for the first colour and far depth.

    efficiency: energy on the target per incident energy (inside the spots of a spot pattern; where the target is
        above half its peak otherwise). uniformity: 1 - (max - min) / (max + min) over spots, or 1 - standard
        deviation / mean over the pixels of an area that are a full Airy radius inside it.
    """
    far = bank.energy[0, bank.depths_m.index(spec.scene.far_m[0])]
    rows = []
    for objective, term in zip(spec.objectives, terms, strict=True):
        if (target := term.target) is None:
            continue
        if objective.options.get("pattern") == "spots":
            shares = _spot_energies(camera, far, objective.options)
            efficiency = shares.sum()
            uniformity = 1 - (shares.max() - shares.min()) / (shares.max() + shares.min())
        else:
            area = target > target.max() / 2
            efficiency = far[area].sum(dtype=np.float64)
            radius = airy_radius_m(camera, mean_wavelength_m(camera.colours[0])) / camera.pixel_m
            reach = int(np.ceil(radius))
            disc = radius_map_m((2 * reach + 1, 2 * reach + 1), 1.0) <= radius
            inner = far[binary_erosion(area, disc)]
            uniformity = 1 - inner.std() / inner.mean() if inner.size and inner.mean() > 0 else 0.0
        rows.append({"efficiency": float(efficiency), "uniformity": float(uniformity)})
    return rows


def _spot_energies(camera: Camera, psf: Float[np.ndarray, "y x"], options: Any) -> Float[np.ndarray, " spot"]:
    radius = spot_radius_m(camera, mean_wavelength_m(camera.colours[0]))
    axis = camera.axis_m()
    centres = spot_centres_m(tuple(options["count"]), parse_length(str(options["spacing"])))
    return np.array(
        [psf[np.hypot(axis[:, None] - y, axis[None, :] - x) <= radius].sum(dtype=np.float64) for y, x in centres]
    )
