"""Widths of edges: what the wall between two heights adds to the light of a thin element.

A thin element delays light by the height of the glass under it and knows nothing of walls. Solved rigorously, a wall
between two heights adds a line of light to the transmission exp(i k (n h + H - h)), H the highest level:

    t += w(h_high - h_low) exp(i k (n h_low + H - h_high)) delta(x - x_wall)

with a complex width w of a few nanometres to a third of a micrometre. It is taken from one isolated pair of walls: a
ridge as high as the wall and half as wide as its period, of which the rigorous 0th order, over what a bare face lets
through, differs from the thin element's by 2 w / period.

Relief has a depth, too. The step of the light at a wall spreads on its way down through the glass under it, the more
the higher it stands: h of glass turn a wave number q by exp(-i q² h / (2 k n)). To first order that adds a pair of
lines of opposite sign, a dipole, to every wall, p delta'(x - x_wall), where

    p = i / (2 k n) (h_middle - h_plane) (t_behind - t_before) + the wall's own

with h_middle halfway up the wall, h_plane any plane that all walls share (it is where the light is told, and changes no
intensity), and t the light of the glass on either side. The wall's own part is half as strong; it comes from the odd
orders of the same ridge.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Inexact
from numpy.polynomial.chebyshev import chebvander
from scipy.linalg import eigh
from scipy.sparse.linalg import LinearOperator, gmres

from sim.rigorous.rows import Polarisation

_PERIOD, _WAVES = 48.0, 3.0  # period in wavelengths; orders to either side over those that travel in glass
_BAND = 0.17  # sine of the highest angle of light, in air, that dipoles are fitted to
_FEWEST_TERMS, _MORE_TERMS, _GOOD_M = 12, 4, 2e-9


class WallLight(NamedTuple):
    """Light of walls, besides that of thin cells.

    Attributes:
        line_m: amplitude of the line of light on every wall, metres.
        dipole_m2: of the dipole: far fields are those of line_m + 2 pi i q dipole_m2 on the wall, q in waves per metre.
    """

    line_m: Complex[np.ndarray, "*walls"]
    dipole_m2: Complex[np.ndarray, "*walls"]


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
    return _ridge_orders(heights_m, wavelength_m, index, polarisation, period, waves)[:, 0] * period * wavelength_m / 2


def edge_dipoles(
    heights_m: tuple[float, ...],
    wavelength_m: float,
    index: float,
    polarisation: Polarisation,
    *,
    period: float = _PERIOD,
    waves: float = _WAVES,
) -> Complex[np.ndarray, " height"]:
    """Dipoles, square metres, of walls that rise along the axis, told at the plane of their foot.

    They include the half of a wall's height that its middle is above its foot, and are those that fit light up to 10
    degrees in air best.

    Args:
        heights_m: from one side of the wall to the other, not negative.
        wavelength_m: vacuum wavelength.
        index: refractive index of the glass.
        polarisation: "TE" where the electric field is along the wall, "TM" where it is across.
        period: of the ridges from which they are taken, in wavelengths.
        waves: orders to either side that are kept, over those that travel in the glass.

    Returns:
        dipoles for light exp(i k z - i omega t); their complex conjugates for the other sign.
    """
    found = _ridge_orders(heights_m, wavelength_m, index, polarisation, period, waves)
    order = np.arange(1, int(_BAND * period) + 1, 2)
    sine, turn = order / period, 2j * np.where(order % 4 == 1, 1, -1)
    odd = found[:, order] / turn * period * wavelength_m
    return (odd @ sine) / (sine @ sine) * wavelength_m / (2j * np.pi)


def light_of_walls(
    before_m: Float[np.ndarray, "*walls"],
    behind_m: Float[np.ndarray, "*walls"],
    wavelength_m: float,
    index: float,
    polarisation: Polarisation,
    *,
    plane_m: float,
    top_m: float,
) -> WallLight:
    """Light of walls between the cells before and behind them along an axis, over that through a bare face.

    Args:
        before_m: height of the cells before the walls.
        behind_m: of those behind.
        wavelength_m: vacuum wavelength.
        index: refractive index of the glass.
        polarisation: "TE" or "TM".
        plane_m: height at which light is told: the middle of the relief, say.
        top_m: height at which light enters.
    """
    waves = 2 * np.pi / wavelength_m
    low, high = np.minimum(before_m, behind_m), np.maximum(before_m, behind_m)
    walls, which = np.unique(np.round(high - low, 13), return_inverse=True)
    given = tuple(walls.tolist()), wavelength_m, index, polarisation
    line, dipole = (solved(*given)[which].reshape(low.shape) for solved in (edge_widths, edge_dipoles))
    lower = np.exp(1j * waves * (index * low + top_m - high))
    light = [np.exp(1j * waves * (index * height + top_m - height)) for height in (before_m, behind_m)]
    foot = 1j / (2 * waves * index) * (low - plane_m) * (light[1] - light[0])
    return WallLight(line * lower, foot + np.sign(behind_m - before_m) * dipole * lower)


@lru_cache(maxsize=256)
def _ridge_orders(
    heights_m: tuple[float, ...],
    wavelength_m: float,
    index: float,
    polarisation: Polarisation,
    period: float,
    waves: float,
) -> Complex[np.ndarray, "height order"]:
    """Orders 0 ... of ridges about the origin, less those of a thin element, over what a bare face lets through."""
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
    # Orders that the band holds: their power is that of their amplitude times this.
    kept = int(_BAND * period) + 1
    oblique = np.sqrt(np.abs(behind[:kept]) / index) / np.where(np.arange(kept) == 0, 1.0, np.sqrt(2))
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
        amplitude = inverse_sum[:kept] @ (through * excited) * oblique / face
        ridge, groove = np.exp(2j * np.pi * index * waves_of_it), np.exp(2j * np.pi * waves_of_it)
        found.append(amplitude - _coefficients(ridge, groove, kept))
    return np.array(found)


class EdgeTable(NamedTuple):
    """Light of walls of all heights up to a highest, over that of the glass on their lower side.

    Attributes:
        width_m: the width of a wall of height h is h / highest times the series (`series_at`) at 2 h / highest - 1: its
            coefficients of Chebyshev polynomials, metres.
        dipole: a, b, c, d of a dipole h (a + b h + (c + d h) t) of a rising wall, told at its foot, where t is the
            light of the higher side over that of the lower: a and c in metres, b and d without unit.
    """

    width_m: Complex[np.ndarray, " term"]
    dipole: Complex[np.ndarray, "4"]


def computed_table(highest_m: float, wavelength_m: float, index: float, polarisation: str, axis: str) -> EdgeTable:
    """Light of walls of all heights up to a highest, from rigorous solutions.

    As many terms of the series as leave 2 nm; up to two waves in glass, twenty do. Light that goes up and down between
    the heights, a nanometre every quarter of a wave, takes many more. The four numbers of the dipoles leave 1 % of
    them, 3 % where the highest wall is two waves.

    Args:
        highest_m: metres, positive.
        wavelength_m: vacuum wavelength.
        index: refractive index of the glass.
        polarisation: "x" or "y", the axis along which the electric field lies, or "unpolarised": the mean of both.
        axis: across which the walls stand.
    """
    ways: dict[str, tuple[Polarisation, ...]] = {"unpolarised": ("TE", "TM"), axis: ("TM",)}
    terms = _FEWEST_TERMS
    while True:
        # Even steps, and ever smaller ones towards both ends, where polynomials stray.
        ends = (1 - np.cos(np.linspace(0, np.pi, 3 * terms))) / 2
        share = np.union1d(np.linspace(0, 1, 4 * terms), ends)
        height = highest_m * share
        solved = tuple(height.tolist()), wavelength_m, index
        # The lower side's light is delayed by its own glass; all of the wall's height is air to it.
        air = np.exp(-2j * np.pi * height / wavelength_m)
        width, dipole = (
            air * np.mean([of(*solved, way) for way in ways.get(polarisation, ("TE",))], axis=0)
            for of in (edge_widths, edge_dipoles)
        )
        matrix = share[:, None] * chebvander(2 * share - 1, terms - 1)
        series = np.linalg.lstsq(matrix, width, rcond=None)[0]
        if np.abs(matrix @ series - width).max() <= _GOOD_M:
            break
        terms += _MORE_TERMS
    higher = np.exp(2j * np.pi * (index - 1) * height / wavelength_m)
    parts = np.stack([share, share**2, share * higher, share**2 * higher], 1)
    units = np.array([highest_m, highest_m**2] * 2)
    return EdgeTable(series, np.linalg.lstsq(parts, dipole, rcond=None)[0] / units)


def series_at(series: Any, place: Any) -> Any:
    """Sum of Chebyshev polynomials at places from -1 to 1; coefficients of all along the first axis.

    By Clenshaw's recurrence over T_4j, whose coefficients are sums over 1, T_1, T_2 and T_3: of products,
    T_(4j + i) = 2 T_4j T_i - T_(4j - i), so that it takes half of the operations of that over all of T_i, and is as
    well conditioned.
    """
    terms = list(series)
    for term in range(len(terms) - 1, 4, -1):
        if term % 4:
            mirrored = term - 2 * (term % 4)
            terms[mirrored] = terms[mirrored] - terms[term]
            terms[term] = 2 * terms[term]
    second = 2 * place * place - 1
    factors = place, second, 2 * place * second - place
    sums = [
        sum((term * factor for term, factor in zip(terms[first + 1 : first + 4], factors, strict=False)), terms[first])
        for first in range(0, len(terms), 4)
    ]
    fourth, last, now = 2 * second * second - 1, 0.0, 0.0
    for one in sums[:0:-1]:
        last, now = now, one - last + 2 * fourth * now
    return sums[0] - last + fourth * now


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


def _coefficients(ridge: complex, groove: complex, count: int) -> Inexact[np.ndarray, " order"]:
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
