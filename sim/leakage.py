"""How much light passes a plate as if it were flat, and where it goes.

The mean of a plate's transmission over the clear aperture, c0 = <t>, is its 0th order: the field c0 behind the whole
aperture images like the bare lens. What is left, t - c0, is diffracted; the two are orthogonal over the aperture, so
their powers add to that of the plate, though in any one pixel they interfere.
"""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from sim.camera import Camera, Colour, source_path_m, wrapped_waves
from sim.propagation.pupil import SurfaceRows, surface_pupil
from sim.psf_bank import pixel_energy, plan_propagation, surface_energy
from sim.surface import FabricatedDoe


def mean_transmission(surface: FabricatedDoe) -> Complex[np.ndarray, " w"]:
    """Mean transmission c0 over the open aperture, weighted by every cell's open share, per wavelength."""
    coverage = np.asarray(surface.coverage, np.float64)
    return _over(np.asarray(surface.means), coverage) / coverage.sum()


def _over(values: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    return np.einsum("wyx,yx->w", values, coverage, dtype=np.complex128)


def zeroth_order(surface: FabricatedDoe) -> Float[np.ndarray, " w"]:
    """Fraction |<t>|^2 of the light that passes as if the plate were flat, per wavelength."""
    return np.abs(mean_transmission(surface)) ** 2


def strehl(surface: FabricatedDoe, nominal: FabricatedDoe) -> Float[np.ndarray, " w"]:
    """Overlap |<t conj(t_nominal)>|^2 with the field the design means to make, per wavelength.

    Args:
        surface: the plate.
        nominal: the plate exactly as drawn, on the DOE's own grid; where the plate is finer, its cells are repeated.
    """
    parts = surface.grid.shape[0] // nominal.grid.shape[0]
    meant = np.repeat(np.repeat(np.conj(np.asarray(nominal.means)), parts, axis=1), parts, axis=2)
    coverage = np.asarray(surface.coverage, np.float64)
    return np.abs(_over(np.asarray(surface.means) * meant, coverage) / coverage.sum()) ** 2


class SplitPsf(NamedTuple):
    """One PSF by origin, energies per pixel.

    Attributes:
        total: of the plate.
        leaked: of the 0th order alone: |c0|^2 times the PSF of the bare lens.
        diffracted: of everything else.
    """

    total: Float[np.ndarray, "y x"]
    leaked: Float[np.ndarray, "y x"]
    diffracted: Float[np.ndarray, "y x"]

    @property
    def interference(self) -> Float[np.ndarray, "y x"]:
        """Twice the real part of one field times the other's conjugate; over an unbounded sensor it sums to zero."""
        return self.total - self.leaked - self.diffracted

    def excess(self) -> float:
        """How far interference goes beyond what two fields can do, 2 sqrt(leaked diffracted), per brightest pixel.

        Zero up to rounding, or the three do not belong together.
        """
        most = 2 * np.sqrt(np.maximum(self.leaked, 0) * np.maximum(self.diffracted, 0))
        return float(np.max(np.abs(self.interference) - most) / np.max(self.total))


def split_psf(camera: Camera, surface: FabricatedDoe, colour: Colour, depth_m: float) -> SplitPsf:
    """Split the PSF of one colour and depth into the light that leaked and the light that was diffracted.

    Args:
        camera: lens, sensor and substrate.
        surface: the plate, with the colour's wavelengths.
        colour: colour channel.
        depth_m: source depth, metres.

    Returns:
        energies per unit power incident on the clear aperture, Fresnel loss included. The three transforms are taken
        independently of each other: that they fit (`SplitPsf.excess`) is a check, not an assumption.
    """
    own = replace(camera, grid=surface.grid)
    path = source_path_m(own, depth_m)
    means = mean_transmission(surface)
    parts = np.zeros((3, camera.window, camera.window), np.float32)
    for wavelength, weight in zip(colour.wavelengths_m, colour.weights, strict=True):
        plan = plan_propagation(own, wavelength, depth_m)
        source = jnp.asarray(wrapped_waves(path, wavelength))
        mean = jnp.complex64(means[surface.wavelengths_m.index(wavelength)])
        whole = surface.at(wavelength)
        factor = weight * camera.transmission(wavelength)
        parts[0] += factor * surface_energy(plan, camera, surface, wavelength, source)
        for i, field in ((1, jnp.full_like(whole, mean)), (2, whole - mean)):
            rows = SurfaceRows(field, source, surface.coverage)
            parts[i] += factor * np.asarray(pixel_energy(plan, surface_pupil, rows, None))
    return SplitPsf(*parts)
