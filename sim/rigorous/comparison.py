"""One row of cells, three ways: as a thin element, as one with edges, and by Maxwell's equations."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from sim.rigorous.edge_widths import light_of_walls
from sim.rigorous.rows import POLARISATIONS, Polarisation, orders_of, row_slabs


class RowComparison(NamedTuple):
    """Orders of a row that repeats, as shares of the light that a bare face lets through.

    Attributes:
        number: of every order that a DOE's band holds, half a wave per cell to either side.
        scalar: thin element, the same for both polarisations.
        edges: `[TE and TM, order]` thin element with edges.
        rigorous: `[TE and TM, order]` coupled waves.
        energy: `[TE and TM]` reflected and transmitted light of the rigorous solution over the incident.
    """

    number: Int[np.ndarray, " order"]
    scalar: Float[np.ndarray, " order"]
    edges: Float[np.ndarray, "2 order"]
    rigorous: Float[np.ndarray, "2 order"]
    energy: Float[np.ndarray, "2"]

    def error(self, orders: Float[np.ndarray, " order"] | Float[np.ndarray, "2 order"]) -> Float[np.ndarray, "2"]:
        """How far some orders are from the rigorous ones: root sum of squares over theirs, for TE and TM."""
        return np.linalg.norm(orders - self.rigorous, axis=1) / np.linalg.norm(self.rigorous, axis=1)

    def zeroth(self, orders: Float[np.ndarray, "*any order"]) -> Float[np.ndarray, "*any"]:
        """The 0th order."""
        return orders[..., int(-self.number[0])]


def thin_amplitudes(
    height_m: Float[np.ndarray, " cell"],
    cell_m: float,
    wavelength_m: float,
    index: float,
    polarisation: Polarisation | None = None,
) -> tuple[Int[np.ndarray, " order"], Complex[np.ndarray, " order"]]:
    """Number and amplitude of the orders of a row that repeats, within half a wave per cell, as a thin element.

    Args:
        height_m: height of every cell, in air.
        cell_m: width of a cell.
        wavelength_m: vacuum wavelength.
        index: refractive index of the glass.
        polarisation: whose edges are added; None for none.

    Returns:
        amplitudes over that of light through a bare face; the middle of the row is the origin.
    """
    cells, top = len(height_m), float(np.max(height_m))
    waves = 2 * np.pi / wavelength_m
    number = np.arange(-(cells // 2), cells // 2 + 1)
    middles = (np.arange(cells) - (cells - 1) / 2) / cells
    light = np.exp(1j * waves * (index * height_m + top - height_m))
    amplitude = np.exp(-2j * np.pi * np.outer(number, middles)) @ light / cells * np.sinc(number / cells)
    if polarisation is not None:
        walls = light_of_walls(
            np.roll(height_m, 1), height_m, wavelength_m, index, polarisation, plane_m=float(height_m.mean()), top_m=top
        )
        places = middles - 0.5 / cells
        lit = np.exp(-2j * np.pi * np.outer(number, places)) @ np.stack(walls, 1) / (cells * cell_m)
        amplitude = amplitude + lit[:, 0] + 2j * np.pi * number / (cells * cell_m) * lit[:, 1]
    return number, amplitude


def compare_row(
    height_m: Float[np.ndarray, " cell"],
    cell_m: float,
    wavelength_m: float,
    index: float,
    *,
    waves: float = 1.5,
) -> RowComparison:
    """Orders of a row of glass cells in air that repeats, lit from the air at normal incidence.

    Args:
        height_m: `[cell]` height of every cell, metres.
        cell_m: width of a cell, metres.
        wavelength_m: vacuum wavelength, metres.
        index: refractive index of the glass.
        waves: orders of the rigorous solution over those that travel in the glass.

    Raises:
        ValueError: a row without relief.
    """
    height_m = np.asarray(height_m, np.float64)
    period_m, face = len(height_m) * cell_m, 4 * index / (1 + index) ** 2
    number, scalar = thin_amplitudes(height_m, cell_m, wavelength_m, index)
    kept = int(np.ceil(waves * period_m * index / wavelength_m))
    edges, rigorous, energy = [], [], []
    for polarisation in POLARISATIONS:
        edges.append(np.abs(thin_amplitudes(height_m, cell_m, wavelength_m, index, polarisation)[1]) ** 2)
        orders = orders_of(row_slabs(height_m, cell_m, index), wavelength_m, index, polarisation, kept)
        first = orders.at(int(number[0]))
        rigorous.append(orders.transmitted[first : first + len(number)] / face)
        energy.append(orders.energy)
    return RowComparison(number, np.abs(scalar) ** 2, np.array(edges), np.array(rigorous), np.array(energy))
