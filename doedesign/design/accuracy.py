"""How far PSFs may be off, by cause: the error budget of a prediction.

Every entry is a relative difference, root sum of squares over that of the light, and says how it was found:

    numerics    of pixel energies, predicted by the transform's own weights (`sim.propagation.farfield`)
    rim         of intensities at 256 directions of the window, measured: cells on the aperture's rim pass the mean of
                their open part instead of the part itself
    walls       of pixel energies, measured: what the light of walls changes; None where PSFs have it already, of which
                `doedesign certify` proves what is left
    lens_mapping   of pixel energies, measured: what a lens that images tangents changes where sines are in force, or
                one that images sines where tangents are
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fab.aperture import RoundAperture
from sim.camera import Camera, SpectralLine
from sim.lens import Mapping
from sim.metrics import mean_wavelength_m
from sim.optic import HeightOptic
from sim.propagation.farfield import FarField
from sim.psf_bank import PsfBank, psf
from sim.rigorous.edge_optic import EdgeOptic, optic_as_drawn
from sim.source import path_at_m
from sim.threads import at_once

_SIDE = 16  # directions per axis, one in each part of the window
_PARTS = 8  # of a cell on the rim, per axis
_SEED = 0
_LEAST_TOLD = 0.01  # per cent; what is less is of no account, and its digits would be powers of ten
_OTHER: dict[str, Mapping] = {"sine": "tangent", "tangent": "sine"}


class Accuracy(NamedTuple):
    """Relative differences of one PSF, by cause; None for what does not apply."""

    colour: str
    depth_m: float
    numerics: float | None
    rim: float
    walls: float | None
    lens_mapping: float | None


def accuracies(optic: HeightOptic | EdgeOptic, bank: PsfBank, depths_m: Sequence[float]) -> list[Accuracy]:
    """Error budget of a bank in the middle one of its colours, at some of its depths.

    Args:
        optic: the DOE as drawn that the bank is of.
        bank: its PSFs on the axis, by the far field.
        depths_m: depths of the bank to look at, metres.
    """
    camera = optic.camera
    middle = len(camera.colours) // 2
    line = next(line for line in camera.lines if line.colour == middle)
    one = replace(camera, colours=(camera.colours[middle],))
    walls: dict[float, float] = {}
    if camera.light == "scalar":
        lit = optic_as_drawn(replace(one, light="edges"), optic.height_m, depths_m=depths_m)
        seen = psf(lit, depths=depths_m).energy[0]
        walls = {
            depth: relative_difference(bank.energy[middle, bank.depths_m.index(depth)], image)
            for depth, image in zip(depths_m, seen, strict=True)
        }
    mapped: dict[float, float] = {}
    if camera.distance_m is None:
        other = psf(optic, replace(one, mapping=_OTHER[camera.mapping]), depths_m).energy[0]
        mapped = {
            depth: relative_difference(bank.energy[middle, bank.depths_m.index(depth)], image)
            for depth, image in zip(depths_m, other, strict=True)
        }
    found = []
    rims = at_once(lambda depth: rim_error(optic, line, depth), depths_m)
    for depth, rim in zip(depths_m, rims, strict=True):
        plan = optic.plan(line, depth)
        numerics = plan.expected_error if isinstance(plan, FarField) else None
        found.append(Accuracy(camera.colours[middle].name, depth, numerics, rim, walls.get(depth), mapped.get(depth)))
    return found


def relative_difference(found: Float[np.ndarray, "y x"], better: Float[np.ndarray, "y x"]) -> float:
    """Root sum of squares of a difference over that of the better one."""
    found, better = (np.asarray(image, np.float64) for image in (found, better))
    return float(np.linalg.norm(found - better) / np.linalg.norm(better))


def rim_error(optic: HeightOptic | EdgeOptic, line: SpectralLine, depth_m: float) -> float:
    """Relative difference of intensities within the window, of grey cells on the rim from a true circle.

    The field of all cells is summed directly, in double precision, at one direction in each part of the window, and so
    is what a true circle adds to it: on cells of the rim its open parts less their mean.
    """
    camera = optic.camera
    pitch, wavelength = camera.grid.pitch_m, line.wavelength_m
    rng = np.random.default_rng(_SEED)
    extent = camera.window * camera.pixel_m / camera.sensor_distance_m / wavelength  # waves per metre
    waves = [((np.arange(_SIDE) + rng.random(_SIDE)) / _SIDE - 0.5) * extent for _ in "yx"]
    waves = [one - moved / wavelength for one, moved in zip(waves, camera.moved_sines(), strict=True)]
    axis_y, axis_x = camera.grid.axis_m("y"), camera.grid.axis_m("x")
    beam = camera.beam_curvature_per_m(wavelength)
    bend = 1 / depth_m + camera.curvature_per_m() + beam

    def kernel(seen: np.ndarray, axis: np.ndarray) -> np.ndarray:
        """Far field of the cells of a row in some directions; cells farther from the axis are lit more obliquely."""
        oblique = np.sinc(pitch * (seen - bend * axis[:, None] / wavelength))
        return np.exp(-2j * np.pi * axis[:, None] * seen) * oblique

    coverage = np.asarray(optic.coverage, np.float64)
    field = np.asarray(optic.field(line, depth_m), np.complex128)
    whole = kernel(waves[0], axis_y).T @ field @ kernel(waves[1], axis_x)
    y, x = np.nonzero((coverage > 0) & (coverage < 1))
    inside = (np.arange(_PARTS) + 0.5) / _PARTS - 0.5
    at_y = np.broadcast_to(axis_y[y][:, None, None] + inside[:, None] * pitch, (len(y), _PARTS, _PARTS))
    at_x = np.broadcast_to(axis_x[x][:, None, None] + inside[None, :] * pitch, at_y.shape)
    open_ = camera.opening.contains(at_y, at_x)
    path = path_at_m(camera, at_y, at_x, depth_m) - path_at_m(camera, axis_y[y], axis_x[x], depth_m)[:, None, None]
    path += beam / 2 * (at_y**2 + at_x**2 - (axis_y[y] ** 2 + axis_x[x] ** 2)[:, None, None])
    # Within a cell the field has its source's phase.
    passed = (field[y, x] / coverage[y, x])[:, None, None] * np.exp(2j * np.pi * path / wavelength)
    more = (open_ - coverage[y, x][:, None, None]) * passed / _PARTS**2
    turns = [np.exp(-2j * np.pi * at.reshape(-1, 1) * seen) for at, seen in zip((at_y, at_x), waves, strict=True)]
    added = (turns[0] * more.reshape(-1, 1)).T @ turns[1]
    return relative_difference(np.abs(whole) ** 2, np.abs(whole + added) ** 2)


def in_words(found: Sequence[Accuracy], camera: Camera) -> str:
    """The largest of every cause, on one line."""

    def largest(values: list[float]) -> str:
        percent = 100 * max(values)
        if percent < _LEAST_TOLD:
            return f"below {_LEAST_TOLD:g} %"
        return f"{float(f'{percent:.2g}'):g} %"

    parts = []
    if numerics := [one.numerics for one in found if one.numerics is not None]:
        parts.append(f"numerics {largest(numerics)}")
    rim = "the round rim" if isinstance(camera.opening, RoundAperture) else "the rim"
    parts.append(f"square cells on {rim} {largest([one.rim for one in found])}")
    if walls := [one.walls for one in found if one.walls is not None]:
        parts.append(f"light of walls left out {largest(walls)}")
    if lens := [one.lens_mapping for one in found if one.lens_mapping is not None]:
        parts.append(f"lens mapping ({camera.mapping}, not {_OTHER[camera.mapping]}) {largest(lens)}")
    nanometres = mean_wavelength_m(camera.colours[len(camera.colours) // 2]) * 1e9
    return f"PSFs at {nanometres:.0f} nm may be off by (relative RMS): " + ", ".join(parts)
