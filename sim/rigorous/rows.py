"""Rigorous diffraction by a row of cells: coupled waves (M. G. Moharam et al., J. Opt. Soc. Am. A 12, 1077 (1995)).

A relief that varies along x alone and repeats is cut into slabs between its heights. In each, Maxwell's equations
couple the plane waves of all orders; waves travel up and down through the slabs by the enhanced transmittance matrix,
which no thick slab makes unstable. TE has its electric field along the grooves, TM its magnetic field; TM takes the
inverse of the transform of 1 / permittivity where a product of two jumps is continuous (L. Li, J. Opt. Soc. Am. A 13,
1870 (1996); P. Lalanne and G. M. Morris, ibid. 779), without which it hardly converges.

Glass without loss makes every matrix Hermitian, so that a slab costs one eigenproblem of a Hermitian matrix.
Fields are exp(i k z - i omega t), z along the light; double precision throughout.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int
from scipy.linalg import eigh

Polarisation = Literal["TE", "TM"]
POLARISATIONS: tuple[Polarisation, ...] = ("TE", "TM")


class Slab(NamedTuple):
    """A slice in which the permittivity changes along x alone.

    Attributes:
        edges_m: where it jumps, from 0 to the period, increasing.
        permittivity: between them.
        thickness_m: along the light.
    """

    edges_m: Float[np.ndarray, " edge"]
    permittivity: Float[np.ndarray, " edge-1"]
    thickness_m: float


class Orders(NamedTuple):
    """Light that leaves a periodic relief.

    Attributes:
        number: of every order, increasing; sin(angle) is `number` wavelengths per period in air.
        amplitude: of the transmitted electric (TE) or magnetic field (TM) at the lower end of the last slab, over the
            incident one's at the upper end of the first.
        transmitted: share of the incident power in every transmitted order; 0 for those that do not travel.
        reflected: the same of the reflected ones.
    """

    number: Int[np.ndarray, " order"]
    amplitude: Complex[np.ndarray, " order"]
    transmitted: Float[np.ndarray, " order"]
    reflected: Float[np.ndarray, " order"]

    @property
    def energy(self) -> float:
        """Share of the incident power that is transmitted or reflected: 1 up to the precision of the arithmetic."""
        return float(self.transmitted.sum() + self.reflected.sum())

    def at(self, number: int) -> int:
        """Index of an order."""
        return int(number - self.number[0])


def row_slabs(height_m: Float[np.ndarray, " cell"], cell_m: float, index: float) -> list[Slab]:
    """Slabs of a row of cells of glass in air, the highest first.

    Args:
        height_m: height of every cell; the row repeats.
        cell_m: width of a cell.
        index: refractive index of the glass.
    """
    height_m = np.asarray(height_m, np.float64)
    edges = np.arange(len(height_m) + 1) * cell_m
    heights = np.unique(height_m)[::-1]
    return [Slab(edges, np.where(height_m > low, index**2, 1.0), float(high - low)) for high, low in pairwise(heights)]


def orders_of(
    slabs: Sequence[Slab],
    wavelength_m: float,
    index: float,
    polarisation: Polarisation,
    waves: int,
    *,
    incident: float = 1.0,
    sine: float = 0.0,
) -> Orders:
    """Solve Maxwell's equations for slabs between two half-spaces, up to a number of waves.

    Args:
        slabs: along the light; all of the same period. None but those of bare faces may be left out.
        wavelength_m: vacuum wavelength.
        index: refractive index behind the slabs.
        polarisation: "TE" or "TM".
        waves: orders to either side of the 0th that are kept. All that travel in the glass and as many again are
            enough for an error of about 1e-3 in TE and TM; compare two numbers to be sure.
        incident: refractive index before the slabs.
        sine: sine of the angle of incidence times `incident`.

    Raises:
        ValueError: no slab, slabs of different periods, or no thickness.
    """
    if not slabs or any(slab.edges_m[-1] != slabs[0].edges_m[-1] or slab.thickness_m <= 0 for slab in slabs):
        raise ValueError("`slabs` must be one or more of the same period, and have a thickness")
    number, wave_number = np.arange(-waves, waves + 1), 2 * np.pi / wavelength_m
    along_x = sine + number * wavelength_m / slabs[0].edges_m[-1]
    te = polarisation == "TE"
    before, behind = (_along_z(n, along_x) for n in (incident, index))
    # Tangential electric and magnetic field of the transmitted waves (or the other way round in TM), at the lower end.
    field = np.eye(len(number), dtype=complex)
    slope = np.diag(-1j * behind / (1.0 if te else index**2))
    passed = np.eye(len(number), dtype=complex)
    for slab in reversed(slabs):
        decay, modes, slopes = _modes(slab, along_x, te)
        through = np.exp(-wave_number * decay * slab.thickness_m)
        up, down = np.linalg.solve(modes, field), np.linalg.solve(slopes, slope)
        inverse = np.linalg.inv((up + down) / 2)
        back = through[:, None] * ((up - down) / 2 @ inverse) * through
        field, slope = modes + modes @ back, slopes - slopes @ back
        passed = passed @ inverse * through
    admittance = -1j * before / (1.0 if te else incident**2)
    light = np.zeros(len(number), complex)
    light[waves] = 1.0
    inner = np.linalg.solve(slope + admittance[:, None] * field, 2 * admittance * light)
    reflected, amplitude = field @ inner - light, passed @ inner
    unit = before[waves].real / (1.0 if te else incident**2)
    return Orders(
        number,
        amplitude,
        np.abs(amplitude) ** 2 * np.real(behind) / (1.0 if te else index**2) / unit,
        np.abs(reflected) ** 2 * np.real(before) / before[waves].real,
    )


def _along_z(index: float, along_x: Float[np.ndarray, " order"]) -> Complex[np.ndarray, " order"]:
    """Wave number along z, over that of vacuum: real for waves that travel, else with a positive imaginary part."""
    return np.asarray(np.emath.sqrt(index**2 - along_x**2 + 0j), np.complex128)


def _modes(
    slab: Slab, along_x: Float[np.ndarray, " order"], te: bool
) -> tuple[Complex[np.ndarray, " mode"], Complex[np.ndarray, "order mode"], Complex[np.ndarray, "order mode"]]:
    """Decay of the modes along z over the wave number of vacuum, their fields, and those of the other field."""
    permittivity, unit = _coupling(slab.edges_m, slab.permittivity, len(along_x)), np.eye(len(along_x))
    if te:
        square, modes = eigh(unit * along_x**2 - permittivity)
        other = modes
    else:
        inverse = _coupling(slab.edges_m, 1 / slab.permittivity, len(along_x))
        square, modes = eigh(_hermitian(along_x[:, None] * np.linalg.inv(permittivity) * along_x) - unit, inverse)
        other = inverse @ modes
    decay = np.conj(np.emath.sqrt(square + 0j))  # -i kz
    return decay, modes, other * decay


def _hermitian(matrix: Complex[np.ndarray, "n n"]) -> Complex[np.ndarray, "n n"]:
    return (matrix + matrix.conj().T) / 2


def _coupling(
    edges_m: Float[np.ndarray, " edge"], values: Float[np.ndarray, " edge-1"], size: int
) -> Complex[np.ndarray, "n n"]:
    """Toeplitz matrix of the Fourier coefficients of a function that is constant between edges."""
    number, places = np.arange(1 - size, size), edges_m / edges_m[-1]
    turns = np.exp(-2j * np.pi * number[:, None] * places)
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = np.diff(turns, axis=1) / (-2j * np.pi * number[:, None])
    shares[size - 1] = np.diff(places)
    coefficients, k = shares @ values, np.arange(size)
    return coefficients[k[:, None] - k + size - 1]
