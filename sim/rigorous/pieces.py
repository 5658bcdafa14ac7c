"""A square of cells, three ways: as a thin element, as one with edges, and by Maxwell's equations.

Edges are the light of walls and that of the corners where walls meet (`sim.rigorous.corner_light`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Shaped

from sim.rigorous.corner_light import CornerCell, corner_light, corner_unit
from sim.rigorous.crossed import CROSSED_POLARISATIONS, crossed_orders
from sim.rigorous.edge_widths import light_of_walls
from sim.rigorous.mirrored_squares import is_mirrored, mirrored_orders
from sim.rigorous.rows import Polarisation


class PieceComparison(NamedTuple):
    """Orders of a square that repeats, as shares of the light that a bare face lets through.

    They are those that a DOE's band holds, half a wave per cell to either side; the 0th is in the middle.

    Attributes:
        scalar: `[y, x]` thin element, the same for both polarisations.
        edges: `[x and y, y, x]` thin element with edges, for light polarised along x and along y.
        rigorous: `[x and y, y, x]` Maxwell's equations.
        energy: `[x and y]` reflected and transmitted light of the rigorous solution over the incident.
    """

    scalar: Float[np.ndarray, "y x"]
    edges: Float[np.ndarray, "2 y x"]
    rigorous: Float[np.ndarray, "2 y x"]
    energy: Float[np.ndarray, "2"]

    def error(self, orders: Float[np.ndarray, "y x"] | Float[np.ndarray, "2 y x"]) -> Float[np.ndarray, "2"]:
        """How far some orders are from the rigorous ones: root sum of squares over theirs, for light along x and y."""
        difference, own = np.broadcast_to(orders, self.rigorous.shape) - self.rigorous, self.rigorous
        return np.linalg.norm(difference.reshape(2, -1), axis=1) / np.linalg.norm(own.reshape(2, -1), axis=1)

    def zeroth(self, orders: Float[np.ndarray, "*any y x"]) -> Float[np.ndarray, "*any"]:
        """The 0th order."""
        return orders[..., orders.shape[-2] // 2, orders.shape[-1] // 2]


def thin_piece_amplitudes(
    height_m: Float[np.ndarray, "y x"],
    cell_m: float,
    wavelength_m: float,
    index: float,
    polarisation: str | None = None,
) -> Complex[np.ndarray, "v u"]:
    """Amplitudes of the orders of a square that repeats, within half a wave per cell, as a thin element.

    Args:
        height_m: height of every cell, in air.
        cell_m: width of a cell.
        wavelength_m: vacuum wavelength.
        index: refractive index of the glass.
        polarisation: "x" or "y", along which the electric field lies, whose edges are added; None for none. Walls
            across it are met by TM, walls along it by TE; corners do not tell.

    Returns:
        amplitudes over that of light through a bare face, the 0th order in the middle; the lowest corner of the first
        cell is the origin.
    """
    waves, top = 2 * np.pi / wavelength_m, float(np.max(height_m))
    light = np.exp(1j * waves * (index * height_m + top - height_m))
    cells, borders = zip(*(_transforms(count) for count in height_m.shape), strict=True)
    amplitude = cells[0] @ light @ cells[1].T
    if polarisation is not None:
        across: dict[str, tuple[Polarisation, Polarisation]] = {"x": ("TE", "TM"), "y": ("TM", "TE")}
        for axis, way in enumerate(across[polarisation]):
            plane_m = float(height_m.mean())
            before = np.roll(height_m, 1, axis)
            walls = light_of_walls(before, height_m, wavelength_m, index, way, plane_m=plane_m, top_m=top)
            count = height_m.shape[axis]
            number = np.arange(-(count // 2), count // 2 + 1)
            of_lines, along = borders[axis] / cell_m, cells[1 - axis]
            of_dipoles = (2j * np.pi * number / (count * cell_m))[:, None] * of_lines
            for of, transform in zip(walls, (of_lines, of_dipoles), strict=True):
                amplitude = amplitude + (transform @ of @ along.T if axis == 0 else along @ of @ transform.T)
        area = corner_unit(wavelength_m, index) / cell_m**2
        amplitude = amplitude + area * (
            borders[0] @ _light_of_corners(height_m, light, waves * (index - 1)) @ borders[1].T
        )
    return amplitude


def _light_of_corners(
    height_m: Float[np.ndarray, "y x"], light: Complex[np.ndarray, "y x"], rate: float
) -> Complex[np.ndarray, "y x"]:
    """Light of the corners before every cell of a square that repeats, for a phase per height."""

    def cell(y: int, x: int) -> CornerCell:
        height, real, imag = (np.roll(of, (1 - y, 1 - x), (0, 1)) for of in (height_m, np.real(light), np.imag(light)))
        return CornerCell(rate * height, real, imag)

    real, imag = corner_light((cell(0, 0), cell(0, 1), cell(1, 0), cell(1, 1)))
    return real + 1j * imag


def _transforms(cells: int) -> tuple[Complex[np.ndarray, "order cell"], Complex[np.ndarray, "order border"]]:
    """Amplitudes of the orders of one cell, and of one line of a cell's light on the border before it, of a period."""
    number, places = np.arange(-(cells // 2), cells // 2 + 1), np.arange(cells) / cells
    borders = np.exp(-2j * np.pi * np.outer(number, places)) / cells
    return borders * (np.exp(-1j * np.pi * number / cells) * np.sinc(number / cells))[:, None], borders


def compare_piece(
    height_m: Shaped[np.ndarray, "y x"], cell_m: float, wavelength_m: float, index: float, terms: int
) -> PieceComparison:
    """Orders of a square of glass cells in air that repeats along x and y, lit from the air at normal incidence.

    Squares that are their own mirror image, as those of 2 x 2 cells are, are solved by `mirrored_orders`, in a fraction
    of the time of others, which `crossed_orders` solves.

    Args:
        height_m: height of every cell.
        cell_m: width of a cell.
        wavelength_m: vacuum wavelength.
        index: refractive index of the glass.
        terms: orders of the rigorous solution (`travelling_terms`).

    Raises:
        InputError: fmmax is missing, and the square has no mirrors.
    """
    height_m = np.asarray(height_m, np.float64)
    given = (height_m, cell_m, wavelength_m, index)
    solve, face = mirrored_orders if is_mirrored(height_m) else crossed_orders, 4 * index / (1 + index) ** 2
    orders = solve(*given, terms)
    ny, nx = (count // 2 for count in height_m.shape)
    return PieceComparison(
        np.abs(thin_piece_amplitudes(*given)) ** 2,
        np.array([np.abs(thin_piece_amplitudes(*given, way)) ** 2 for way in CROSSED_POLARISATIONS]),
        orders.within(ny, nx) / face,
        orders.energy,
    )
