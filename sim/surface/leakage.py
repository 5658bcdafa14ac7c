"""How much light passes a plate as if it were flat, and where it goes.

The mean of a plate's transmission over the clear aperture, c0 = <t>, is its 0th order: the field c0 behind the whole
aperture images like the bare lens. What is left, t - c0, is diffracted; the two are orthogonal over the aperture, so
their powers add to that of the plate, though in any one pixel they interfere.
"""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fab.units import require_kind
from sim.camera import Colour
from sim.metrics import mean_transmission
from sim.psf_bank import psf
from sim.surface.plate import FabricatedDoe


class SplitPsf(NamedTuple):
    """One PSF by origin, energies per pixel.

    Attributes:
        total: of the DOE.
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
        """How far interference exceeds its bound 2 sqrt(leaked diffracted), per brightest pixel; rounding, if right."""
        most = 2 * np.sqrt(np.maximum(self.leaked, 0) * np.maximum(self.diffracted, 0))
        return float(np.max(np.abs(self.interference) - most) / np.max(self.total))


def split_psf(doe: FabricatedDoe, depth_m: float, colour: Colour, *, sampling: float | None = None) -> SplitPsf:
    """Split the PSF of one colour and depth (metres) of a `doe` into the light that leaked and that was diffracted.

    Args:
        doe: the DOE, with the wavelengths of `colour`.
        depth_m: source depth, metres.
        colour: colour channel.
        sampling: intensity samples per lambda d / D; see `sim.propagation.farfield.plan_far_field`.

    Energies per unit power incident on the clear aperture, Fresnel loss included, by three independent transforms: that
    they fit (`SplitPsf.excess`) is a check, not an assumption.

    Raises:
        InputError: something other than a DOE as fabricated or a colour.
    """
    require_kind("doe", doe, FabricatedDoe, 'For example design.fabricated("contact_aligner", seed=0).')
    require_kind("colour", colour, Colour, "A camera has them: camera.colours[0].")
    chosen = np.array([doe.wavelengths_m.index(wavelength) for wavelength in colour.wavelengths_m])
    seen = [doe.view(wavelength, depth_m) for wavelength in colour.wavelengths_m]
    whole = doe.transmission[np.array(seen)]
    even = doe.coverage * jnp.asarray(mean_transmission(doe)[chosen], jnp.complex64)[:, None, None]
    one = replace(doe, camera=replace(doe.camera, colours=(colour,)))
    other = {
        "views": tuple(doe.views[k] for k in seen),
        "means": doe.means[chosen],
        "wavelengths_m": colour.wavelengths_m,
        "height_m": None,
    }
    parts = (replace(one, transmission=part, **other) for part in (even, whole - even))
    return SplitPsf(*(psf(part, depths=depth_m, sampling=sampling).energy[0, 0] for part in (one, *parts)))
