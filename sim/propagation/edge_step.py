"""The share of a sample that lies beyond a pixel's edge: a smooth step, so that edges may lie anywhere.

`sim.propagation.pixel` finds the best weights for pixels whose places are known beforehand and form a grid. Where they
follow a map, a weight must be a cheap formula of two places: a sample at x counts step(x - low) - step(x - high) for a
pixel from `low` to `high`. The step is 0 and 1 beyond `REACH` samples, and a sum of odd Chebyshev polynomials between.
Neighbours share their edge, so that no light is lost or counted twice whatever the places are.

The coefficients minimise the same expectation as those weights: the squared error over developed speckle behind the
aperture, a strong term for the mean energy, pixels at all fractions of a sample and a few per cent wider or
narrower than on the axis.
"""

from functools import lru_cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim.propagation.pixel import MEAN_WEIGHT, speckle_spectrum

REACH = 6.0  # samples on both sides of an edge
_TERMS = 13  # more lower the error by less than a tenth
_OFFSETS = 16  # places of a pixel between two samples
_WIDTHS = (0.97, 1.0, 1.03)  # of the nominal width


class EdgeStep(NamedTuple):
    """Coefficients of the odd Chebyshev polynomials, and the relative L2 error of integrals along one axis."""

    coefficients: Float[np.ndarray, " term"]
    expected_error: float


@lru_cache(maxsize=32)
def fit_edge_step(width: float, cutoff: float, is_round: bool = True) -> EdgeStep:
    """The best step for pixels `width` samples wide on an intensity of highest frequency `cutoff` per sample."""
    nu, spectrum = speckle_spectrum(cutoff, width, is_round)
    half = slice(len(nu) // 2, None, 4)  # responses at -nu are conjugates
    nu, spectrum = nu[half], np.where(nu[half] > 0, 2.0, 1.0) * spectrum[half]
    spectrum = spectrum / spectrum.sum()
    weight = np.sqrt(spectrum + MEAN_WEIGHT * (nu == 0))
    left: list[np.ndarray] = []
    right: list[np.ndarray] = []
    power: list[float] = []
    for share in _WIDTHS:
        wide = share * width
        reach = int(np.ceil(wide / 2 + REACH)) + 1
        for offset in (np.arange(_OFFSETS) + 0.5) / _OFFSETS:
            at = np.arange(-reach, reach + 1) - offset
            response = np.exp(2j * np.pi * np.outer(nu, at)) @ (_terms(at + wide / 2) - _terms(at - wide / 2))
            target = wide * np.sinc(wide * nu)
            # All polynomials are 1 at 1, where the step must be 1/2 above its middle: the last coefficient follows.
            fixed, free = response[:, -1] / 2, response[:, :-1] - response[:, -1:]
            left += [np.real(free), np.imag(free)]
            right += [target - np.real(fixed), -np.imag(fixed)]
            power += [float(spectrum @ target**2)]
    rows = np.tile(weight, len(left))
    matrix, wanted = np.concatenate(left), np.concatenate(right)
    found = np.linalg.lstsq(matrix * rows[:, None], wanted * rows, rcond=1e-10)[0]
    missed = (matrix @ found - wanted) ** 2 @ np.tile(spectrum, len(left)) / len(power)
    return EdgeStep(np.append(found, 0.5 - found.sum()), float(np.sqrt(missed / np.mean(power))))


def _terms(x: Float[np.ndarray, " x"]) -> Float[np.ndarray, "x term"]:
    """Odd Chebyshev polynomials over the reach, constant beyond."""
    angle = np.arccos(np.clip(x / REACH, -1.0, 1.0))
    return np.cos((2 * np.arange(_TERMS) + 1) * angle[:, None])


def edge_step(coefficients: Float[Array, " term"], x: Float[Array, "*x"]) -> Float[Array, "*x"]:
    """The step less 1/2 at `x` samples beyond an edge, by Clenshaw's recurrence."""
    z = jnp.clip(x * (1 / REACH), -1.0, 1.0)
    twice = 4.0 * z * z - 2.0  # T(n+2) = twice T(n) - T(n-2)
    last, before = coefficients[-1], jnp.float32(0.0)
    for k in range(len(coefficients) - 2, 0, -1):
        last, before = coefficients[k] + twice * last - before, last
    return z * (coefficients[0] + (twice - 1.0) * last - before)
