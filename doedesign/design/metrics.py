"""Table of a design's numbers, the same for every design, whatever it was optimised for."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from doedesign.design.objectives import Term
from doedesign.design.patterns import spot_centres_m
from doedesign.spec import Spec
from fab.units import parse_length
from sim.camera import Camera
from sim.metrics import (
    airy_radius_m,
    energy_budget,
    energy_within,
    mean_wavelength_m,
    participation,
    radius_map_m,
    ring_to_disc,
    spot_radius_m,
    zeroth_order,
)
from sim.psf_bank import PsfBank


def design_metrics(
    camera: Camera, height_m: Float[np.ndarray, "y x"], bank: PsfBank, near_m: tuple[float, ...], lens: PsfBank
) -> list[dict[str, Any]]:
    """Return one row per depth and colour of a bank.

    Args:
        camera: optics.
        height_m: `[y, x]` heights the bank was computed from, metres.
        bank: its PSFs on the axis.
        near_m: which of the bank's depths are obstructions.
        lens: PSFs of the plain lens at the same depths.

    Returns:
        rows with the energy budget; for far depths the far-spot energy; for near depths ring:disc, the
        concentration relative to the plain lens and its lower bound, the square of the far-spot energy (design.md §4).
    """
    far_m = [z for z in bank.depths_m if z not in near_m]
    plain = participation(jnp.asarray(lens.energy))
    wavelengths = [mean_wavelength_m(colour) for colour in camera.colours]
    spots = [spot_radius_m(camera, wavelength) for wavelength in wavelengths]
    far_spot = {
        (c, z): energy_within(bank.energy[c, bank.depths_m.index(z)], camera.pixel_m, spots[c])
        for c in range(len(camera.colours))
        for z in far_m
    }
    orders = [
        sum(w * zeroth_order(camera, height_m, line) for line, w in zip(c.wavelengths_m, c.weights, strict=True))
        for c in camera.colours
    ]
    rows = []
    for d, depth in enumerate(bank.depths_m):
        for c, colour in enumerate(camera.colours):
            psf = bank.energy[c, d]
            budget = energy_budget(camera, height_m, psf, depth, colour)._asdict()
            row: dict[str, Any] = {"colour": colour.name, "depth_m": None if np.isinf(depth) else depth}
            row |= {"in_window": float(psf.sum(dtype=np.float64)), "zeroth_order": orders[c], "budget": budget}
            if depth in near_m:
                ring = ring_to_disc(psf, camera, depth)
                row |= {"ring_to_disc": ring.ratio if np.isfinite(ring.ratio) else None}
                row |= {"disc_radius_m": ring.disc_radius_m}
                row |= {"concentration": float(participation(jnp.asarray(psf))) / float(plain[c, d])}
                row |= {"concentration_bound": max(far_spot[c, z] for z in far_m) ** 2 if far_m else None}
            else:
                row |= {"far_spot": far_spot[c, depth], "spot_radius_m": spots[c]}
            rows.append(row)
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
            inner = far[_eroded(area, airy_radius_m(camera, mean_wavelength_m(camera.colours[0])) / camera.pixel_m)]
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


def _eroded(area: Float[np.ndarray, "y x"] | np.ndarray, radius: float) -> np.ndarray:
    from scipy.ndimage import binary_erosion

    reach = int(np.ceil(radius))
    disc = radius_map_m((2 * reach + 1, 2 * reach + 1), 1.0) <= radius
    return binary_erosion(area, disc)
