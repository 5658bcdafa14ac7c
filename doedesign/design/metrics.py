"""Table of a design's numbers, the same for every design, whatever it was optimised for."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.ndimage import binary_erosion

from doedesign.design.objectives import PsfSet, Term, disc_radii_m
from doedesign.design.patterns import offset_m, positive_place, spot_centres_m
from doedesign.spec import Spec
from sim.camera import Camera
from sim.metrics import (
    EnergyBudget,
    airy_radius_m,
    energy_budget,
    mean_wavelength_m,
    metric_rows,
    participation,
    radius_map_m,
    spot_radius_m,
    without_infinities,
)
from sim.optic import CellOptic
from sim.psf_bank import PsfBank
from sim.threads import at_once


def design_metrics(optic: CellOptic, bank: PsfBank, near_m: tuple[float, ...], lens: PsfBank) -> list[dict[str, Any]]:
    """Return one row per depth and colour of a bank: metrics (`sim.metrics`) and, on the axis, the energy budget.

    Off the axis what is of the DOE and not of its PSFs, as the 0th order, is left out: it is known on the axis.
    `near_m` are those of its depths, metres, that are obstructions; `lens` has the plain lens at the same depths, and
    the DOE's grid: with light of walls, the optic's cells may be parts of its cells.
    """
    pitch = lens.metric_inputs().camera.grid.pitch_m
    on_axis = not any(bank.field_rad)
    inputs = bank.metric_inputs(near_m, optic if on_axis else None, lens=lens)
    rows = without_infinities(metric_rows(inputs, "design"))
    if not on_axis:
        return rows
    places = list(product(range(len(bank.depths_m)), range(len(bank.colours))))

    def budget(place: tuple[int, int]) -> EnergyBudget:
        d, c = place
        return energy_budget(optic, bank.energy[c, d], bank.depths_m[d], optic.camera.colours[c], pitch_m=pitch)

    return [row | {"budget": one._asdict()} for row, one in zip(rows, at_once(budget, places), strict=True)]


def all_of(bank: PsfBank, lens: PsfBank, near: int) -> PsfSet:
    """All PSFs of a bank as objectives take them: a loss of these misses nothing, where a step looks at some.

    Args:
        bank: PSFs on the axis, near depths first.
        lens: those of the plain lens at the same depths.
        near: how many of the depths are near.

    Raises:
        ValueError: the bank's camera is not known.
    """
    if bank.camera is None:
        raise ValueError("`bank.camera` must be known for objectives, but it is None; give it by `bank.with_camera`")
    energy = jnp.asarray(bank.energy)
    disc_radius_m = jnp.asarray(disc_radii_m(bank.camera, bank.depths_m[:near]))
    blur = participation(jnp.asarray(lens.energy))[:, :near]
    return PsfSet(energy[:, :near], energy[:, near:], blur, disc_radius_m, bank.camera)


class DrawnPattern(NamedTuple):
    """The light that should equal a target.

    Attributes:
        target: light wanted per pixel, summing to 1.
        light: shares of the incident light per pixel.
        efficiency: energy on the target per incident energy, Fresnel loss left out (inside the spots of a spot pattern;
            where the target is above half its peak otherwise).
        uniformity: 1 - (max - min) / (max + min) over spots, or 1 - standard deviation / mean over the pixels of an
            area that are a full Airy radius inside it.
        colour: name of the colour channel, where the objective names colours or depths.
        depth_m: depth of the source, metres, likewise.
    """

    target: Float[np.ndarray, "y x"]
    light: Float[np.ndarray, "y x"]
    efficiency: float
    uniformity: float
    colour: str | None = None
    depth_m: float | None = None

    def summary(self) -> dict[str, Any]:
        """Its numbers, for metrics."""
        named = {} if self.colour is None else {"colour": self.colour, "depth_m": self.depth_m}
        return {"on_target": self.efficiency, "uniformity": self.uniformity, **named}


def drawn_patterns(spec: Spec, camera: Camera, bank: PsfBank, terms: tuple[Term, ...]) -> list[DrawnPattern]:
    """The light that a design draws for every `target_pattern` objective, for the colours and depths that it names.

    Where it names none, it is judged for the first colour and far depth.
    """
    drawn = []
    for objective, term in zip(spec.objectives, terms, strict=True):
        if (target := term.target) is None:
            continue
        named = bool(objective.colours or objective.depths_m)
        colours = term.cases.colours or range(len(camera.colours) if named else 1)
        depths = (objective.depths_m or spec.scene.far_m)[: None if named else 1]
        for c, depth_m in product(colours, depths):
            one = replace(camera, colours=(camera.colours[c],))
            light = bank.energy[c, bank.depths_m.index(depth_m)]
            place = (camera.colours[c].name, depth_m) if named else (None, None)
            drawn.append(DrawnPattern(target, light, *_pattern_numbers(one, light, target, objective.options), *place))
    return drawn


def _pattern_numbers(
    camera: Camera, light: Float[np.ndarray, "y x"], target: Float[np.ndarray, "y x"], options: Mapping[str, Any]
) -> tuple[float, float]:
    """Efficiency and uniformity of a pattern in the one colour of a camera."""
    colour = camera.colours[0]
    # As of spots, areas and foci: what the glass faces reflect is told apart.
    passed = float(np.dot(colour.weights, [camera.transmission(one) for one in colour.wavelengths_m]))
    if options.get("pattern") == "spots":
        shares = _spot_energies(camera, light, options)
        return float(shares.sum()) / passed, float(1 - (shares.max() - shares.min()) / (shares.max() + shares.min()))
    area = target > target.max() / 2
    efficiency = light[area].sum(dtype=np.float64) / passed
    radius = airy_radius_m(camera, mean_wavelength_m(colour)) / camera.pixel_m
    reach = int(np.ceil(radius))
    disc = radius_map_m((2 * reach + 1, 2 * reach + 1), 1.0) <= radius
    inside: Any = binary_erosion(area, disc)
    inner = light[inside]
    uniformity = 1 - inner.std() / inner.mean() if inner.size and inner.mean() > 0 else 0.0
    return float(efficiency), float(uniformity)


def _spot_energies(camera: Camera, psf: Float[np.ndarray, "y x"], options: Any) -> Float[np.ndarray, " spot"]:
    radius = spot_radius_m(camera, mean_wavelength_m(camera.colours[0]))
    axis = camera.axis_m()
    centres = spot_centres_m(tuple(options["count"]), positive_place(options["spacing"], camera, "spacing"))
    centres += offset_m(options, camera, "objective")
    # Light where discs overlap is that of the nearest spot, and counts once.
    least, nearest = np.full(psf.shape, np.inf), np.zeros(psf.shape, np.int64)
    for spot, (y, x) in enumerate(centres):
        apart = np.hypot(axis[:, None] - y, axis[None, :] - x)
        nearest[apart < least] = spot
        np.minimum(apart, least, out=least)
    inside = least <= radius
    return np.bincount(nearest[inside], psf[inside].astype(np.float64), minlength=len(centres))
