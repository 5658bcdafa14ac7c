"""Widths of edges: what the wall between two heights adds to the light of a thin element.

A thin element delays light by the height of the glass under it and knows nothing of walls. Solved rigorously, a wall
between two heights adds a line of light to the transmission exp(i k (n h + H - h)), H the highest level:

    t += w(h_high - h_low) exp(i k (n h_low + H - h_high)) delta(x - x_wall)

with a complex width w of a few nanometres to a third of a micrometre. It is taken from one isolated pair of walls: a
ridge as high as the wall and half as wide as its period, of which the rigorous 0th order, over what a bare face lets
through, differs from the thin element's by 2 w / period.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Complex, Float
from numpy.polynomial.chebyshev import chebvander
from scipy.linalg import eigh
from scipy.sparse.linalg import LinearOperator, gmres

from sim.rigorous.rows import Polarisation

_PERIOD, _WAVES = 48.0, 3.0  # period in wavelengths; orders to either side over those that travel in glass
_FEWEST_TERMS, _MORE_TERMS, _GOOD_M = 12, 4, 2e-9


@lru_cache(maxsize=256)
def edge_widths(
    heights_m: tuple[float, ...],
    wavelength_m: float,
    index: float,
    polarisation: Polarisation,
    *,
    period: float = _PERIOD,
    waves: float = _WAVES,
) -> Complex[np.ndarray, " height"]:
    """Widths, metres, of walls of some heights in glass under air, lit from the air at normal incidence.

    Args:
        heights_m: from one side of the wall to the other, not negative.
        wavelength_m: vacuum wavelength.
        index: refractive index of the glass.
        polarisation: "TE" where the electric field is along the wall, "TM" where it is across.
        period: of the ridges, in wavelengths.
        waves: orders to either side that are kept, over those that travel in the glass.

    Returns:
        widths for light exp(i k z - i omega t); their complex conjugates for the other sign.
    """
    size = int(np.ceil(waves * period * index)) + 1
    along_x, te = np.arange(size) / period, polarisation == "TE"
    cosines = _even(index**2, 1.0, size)
    if te:
        square, modes = eigh(np.diag(along_x**2) - cosines)
        other = modes
    else:
        # The field across the wall is a series of sines, for the derivative of an even one is odd.
        inner = along_x[1:, None] * np.linalg.inv(_odd(index**2, 1.0, size)) * along_x[1:]
        across = np.zeros((size, size))
        across[1:, 1:] = (inner + inner.T) / 2
        inverse = _even(index**-2, 1.0, size)
        square, modes = eigh(across - np.eye(size), inverse)
        other = inverse @ modes
    decay = np.conj(np.emath.sqrt(square + 0j))  # -i kz
    before, behind = (np.conj(np.emath.sqrt(along_x**2 - n**2 + 0j)) for n in (1.0, index))
    behind = behind if te else behind / index**2
    up, down = np.linalg.inv(modes), np.linalg.solve(other * decay, np.diag(behind))
    inverse_sum = np.linalg.inv((up + down) / 2)
    returned = (up - down) / 2 @ inverse_sum
    light = np.zeros(size, complex)
    light[0] = 2 * before[0]
    onward, backward = before[:, None] * modes + other * decay, before[:, None] * modes - other * decay
    entered, turned = np.linalg.solve(onward, light), np.linalg.solve(onward, backward)
    face = 2 / (1 + index) * (1.0 if te else index)
    found = []
    for height in heights_m:
        waves_of_it = height / wavelength_m
        through = np.exp(-2 * np.pi * decay * waves_of_it)
        excited = _with_echoes(entered, lambda modes, t=through: turned @ (t * (returned @ (t * modes))))
        amplitude = inverse_sum[0] @ (through * excited)
        thin = (np.exp(2j * np.pi * index * waves_of_it) + np.exp(2j * np.pi * waves_of_it)) / 2
        found.append((amplitude / face - thin) * period * wavelength_m / 2)
    return np.array(found)


def relative_widths(
    heights_m: Float[np.ndarray, " height"], wavelength_m: float, index: float, polarisation: str, axis: str
) -> Complex[np.ndarray, " height"]:
    """Light of walls across an axis ("x" or "y") over that of the glass on their lower side, metres.

    Args:
        heights_m: of the walls.
        wavelength_m: vacuum wavelength.
        index: refractive index of the glass.
        polarisation: "x" or "y", the axis along which the electric field lies, or "unpolarised": the mean of both.
        axis: across which the walls stand.
    """
    ways: dict[str, tuple[Polarisation, ...]] = {"unpolarised": ("TE", "TM"), axis: ("TM",)}
    heights = tuple(np.asarray(heights_m, float).tolist())
    widths = [edge_widths(heights, wavelength_m, index, way) for way in ways.get(polarisation, ("TE",))]
    # The lower side's light is delayed by its own glass; all of the wall's height is air to it.
    return np.mean(widths, axis=0) * np.exp(-2j * np.pi * heights_m / wavelength_m)


def computed_series(
    highest_m: float, wavelength_m: float, index: float, polarisation: str, axis: str
) -> Complex[np.ndarray, " term"]:
    """`relative_widths` of all heights up to a highest as a short series.

    The width of a wall of height h is h / highest times the series (`series_at`) at 2 h / highest - 1. As many terms as
    leave 2 nm; up to two waves in glass, twenty do. Light that goes up and down between the heights, a nanometre
    every quarter of a wave, takes many more.

    Args:
        highest_m: metres, positive.
        wavelength_m: vacuum wavelength.
        index: refractive index of the glass.
        polarisation: of `relative_widths`.
        axis: across which the walls stand.

    Returns:
        coefficients of Chebyshev polynomials, metres.
    """
    terms = _FEWEST_TERMS
    while True:
        # Even steps, and ever smaller ones towards both ends, where polynomials stray.
        ends = (1 - np.cos(np.linspace(0, np.pi, 3 * terms))) / 2
        height = highest_m * np.union1d(np.linspace(0, 1, 4 * terms), ends)
        wanted = relative_widths(height, wavelength_m, index, polarisation, axis)
        share = height / highest_m
        matrix = share[:, None] * chebvander(2 * share - 1, terms - 1)
        series = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
        if np.abs(matrix @ series - wanted).max() <= _GOOD_M:
            return series
        terms += _MORE_TERMS


def series_at(series: Any, place: Any) -> Any:
    """Sum of Chebyshev polynomials at places from -1 to 1; coefficients of all along the first axis."""
    last, now = 0.0, series[len(series) - 1]
    for term in range(len(series) - 2, 0, -1):
        last, now = now, series[term] - last + 2 * place * now
    return series[0] - last + place * now


def _with_echoes(
    entered: Complex[np.ndarray, " mode"], echo: Callable[[Complex[np.ndarray, " mode"]], Complex[np.ndarray, " mode"]]
) -> Complex[np.ndarray, " mode"]:
    """Modes with all that comes back after one, two ... ways down and up, to twelve digits."""
    size = (len(entered), len(entered))
    # The stubs take the type for a second one.
    operator = LinearOperator(size, lambda modes: modes + echo(modes.ravel()), dtype=complex)  # pyright: ignore[reportCallIssue]
    excited, left = gmres(operator, entered, entered, rtol=1e-12, restart=60, maxiter=5)
    if left:
        raise ValueError(f"light between the faces of a ridge does not settle: {left} iterations were not enough")
    return excited


def _coefficients(ridge: float, groove: float, count: int) -> Float[np.ndarray, " order"]:
    """Fourier coefficients 0 ... of a ridge that fills the middle half of a period about the origin."""
    return np.where(np.arange(count) == 0, groove, 0.0) + (ridge - groove) * np.sinc(np.arange(count) / 2) / 2


def _even(ridge: float, groove: float, size: int) -> Float[np.ndarray, "n n"]:
    """Product with that function on 1, sqrt(2) cos x, sqrt(2) cos 2x ..."""
    of, k = _coefficients(ridge, groove, 2 * size), np.arange(size)
    scale = np.where(k == 0, np.sqrt(0.5), 1.0)
    return (of[np.abs(k[:, None] - k)] + of[k[:, None] + k]) * scale[:, None] * scale


def _odd(ridge: float, groove: float, size: int) -> Float[np.ndarray, "n n"]:
    """Product with that function on sin x, sin 2x ..."""
    of, k = _coefficients(ridge, groove, 2 * size), np.arange(1, size)
    return of[np.abs(k[:, None] - k)] - of[k[:, None] + k]
