"""Where the light on a DOE goes: its energy budget."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.fft import fft

from fab.units import distance_from, require_kind
from sim.camera import Colour
from sim.metrics.measures import far_spot
from sim.metrics.transmission import cell_optic_of, opening
from sim.source import source_path_m
from sim.tracing import total


class EnergyBudget(NamedTuple):
    """Where the power incident on the clear aperture goes, or that of the beam; the six parts sum to 1."""

    blocked: float  # by the chrome: of a beam, or of what should pass; below 0 where the opening is too wide
    reflected: float  # by the two faces of the substrate
    far_spot: float  # inside the far-spot radius of the window, at every depth
    window_beside_spot: float  # elsewhere in the sensor window: throughput less far_spot
    uncollected: float  # within the DOE grid's band, but outside the window or between light-sensitive squares
    higher_orders: float  # at angles beyond lambda / (2 pitch), scattered by the square cells and the aperture's edge


_ALIKE = 0.005  # waves per cell on either side of the axis


def _band_energy(field: Complex[np.ndarray, "y x"], slope: float, band: float = 0.5) -> float:
    """Energy of square cells within a band, lit from a direction of `slope` waves per cell and cell.

    The band reaches to `band` waves per cell on either side of the axis; at most to that of the cells' grid, 1/2.
    The factor sinc(nu - slope x) of a cell is interpolated between three directions, exact to 1e-3 up to a sixth of the
    band, along each axis for itself: three transforms of all rows and three of all columns take the place of one sum
    per cell. Of directions that differ by less than a hundredth of a wave per cell over the aperture one does, to 1e-4.
    """
    reach = slope * max(field.shape) / 2
    nodes = reach * np.cos(np.pi * np.array([1, 3, 5]) / 6) if abs(reach) > _ALIKE else np.zeros(1)
    # Columns first: those that lie beyond the band need no transform along y.
    for axis in (1, 0):
        cells = field.shape[axis]
        lit, nu = slope * (np.arange(cells) - (cells - 1) / 2), np.fft.fftfreq(cells)
        inside = (nu >= -band) & (nu < band)
        along: tuple[int, int] = (-1, 1) if axis == 0 else (1, -1)
        summed = np.zeros(field.shape, np.complex64)
        for a in nodes:
            share = np.prod([(lit - b) / (a - b) for b in nodes if b != a], axis=0) * np.ones(cells)
            weighted = field * share.astype(np.float32).reshape(along)
            part = np.asarray(fft(weighted, axis=axis, workers=-1, overwrite_x=True))
            part *= np.sinc(nu - a).astype(np.float32).reshape(along)
            summed += part
        field = summed if inside.all() else summed.compress(inside, axis)
    return float(np.sum(np.square(np.abs(field)), dtype=np.float64))


def energy_budget(
    optic: Any,
    psf: Float[np.ndarray, "v u"],
    depth_m: float | str,
    colour: Colour,
    *,
    pitch_m: float | None = None,
) -> EnergyBudget:
    """Energy budget of one PSF of one colour.

    Args:
        optic: the DOE that made the PSF, on the axis: a design, or an optic of cells.
        psf: `[y, x]` PSF on the sensor, Fresnel loss included.
        depth_m: source depth, metres or with a unit.
        colour: colour of this PSF.
        pitch_m: pitch of the DOE's grid, metres, where the optic's cells are parts of its cells.

    The band's share comes from a transform of its own (Parseval on the bare DOE grid, with the cells' sinc), so
    `uncollected` near zero or below it would show a fault in either.

    Raises:
        InputError: something other than a DOE or a colour, or a depth that is not positive.
    """
    optic = cell_optic_of("optic", optic)
    require_kind("colour", colour, Colour, "A camera has them: camera.colours[0].")
    depth_m = distance_from(depth_m, "depth_m")
    camera = optic.camera
    cells = camera.grid.shape[0] * camera.grid.shape[1]
    scale = camera.opening.area_in(camera.grid.pitch_m, cells)
    reach = camera.grid.pitch_m / (pitch_m or camera.grid.pitch_m) / 2
    entered = passed = band = 0.0
    curvature = camera.curvature_per_m(1 / depth_m) if camera.distance_m is None else 1 / depth_m
    for line in replace(camera, colours=(colour,)).lines:
        field = np.asarray(optic.field(line, depth_m))
        wavelength = line.wavelength_m
        open_ = float(opening(optic, wavelength))
        if camera.beam is None and abs(open_ - 1) < 1e-5:
            open_ = 1.0  # to rounding
        if camera.distance_m is not None:  # the band is one of directions behind the DOE, not of places
            field = field * np.exp(-2j * np.pi * source_path_m(camera, np.inf) / wavelength).astype(np.complex64)
        slope = (curvature + camera.beam_curvature_per_m(wavelength)) * camera.grid.pitch_m**2 / wavelength
        entered += line.factor / camera.transmission(wavelength) * open_
        passed += line.factor * open_
        band += line.factor * _band_energy(field, slope, reach) / scale
    energy, spot = float(total(psf)), float(far_spot(psf, camera, colour))
    return EnergyBudget(1 - entered, entered - passed, spot, energy - spot, band - energy, passed - band)
