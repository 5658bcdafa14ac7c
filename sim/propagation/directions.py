"""Far field of a DOE in single directions: what a spot or a diffraction order receives.

For M directions the sum over all cells is two matrix products, exact for square cells, and needs no grid of samples on
the sensor: spots may lie anywhere.
"""

import numpy as np
from jaxtyping import Complex, Float

from fab.grid import Grid


class DirectionSum:
    """Sum over the square cells of a grid, lit by a plane wave, for plane waves that leave in some directions.

    Attributes:
        waves_per_m: `[direction, (y, x)]` direction sines over the wavelength.
        along_y: `[direction, y]` factors of the rows, exp(-2 pi i u y) with the cell's sinc.
        along_x: `[direction, x]` the same of the columns.
    """

    def __init__(self, grid: Grid, waves_per_m: Float[np.ndarray, "m 2"]) -> None:
        self.waves_per_m = np.asarray(waves_per_m, np.float64)
        factors = []
        for axis, waves in zip(("y", "x"), self.waves_per_m.T, strict=True):
            turns = np.outer(waves, grid.axis_m(axis))
            seen = np.sinc(waves * grid.pitch_m)[:, None]
            # Turns are large: they are wrapped before they become single precision.
            factors.append((seen * np.exp(-2j * np.pi * (turns - np.rint(turns)))).astype(np.complex64))
        self.along_y, self.along_x = factors

    def amplitudes(self, field: Complex[np.ndarray, "y x"]) -> Complex[np.ndarray, " m"]:
        """Sum of the field, `[direction]`; over the open area in cells, its square is an efficiency."""
        columns = np.asarray(field, np.complex64) @ self.along_x.T
        return np.einsum("my,ym->m", self.along_y, columns, dtype=np.complex128)

    def superposition(self, amplitudes: Complex[np.ndarray, " m"]) -> Complex[np.ndarray, "y x"]:
        """Field of plane waves of these amplitudes, at the cells: the adjoint of `amplitudes`."""
        rows = (self.along_y.conj() * np.asarray(amplitudes, np.complex64)[:, None]).T
        return rows @ self.along_x.conj()


def efficiencies(
    field: Complex[np.ndarray, "y x"],
    coverage: Float[np.ndarray, "y x"],
    grid: Grid,
    waves_per_m: Float[np.ndarray, "m 2"],
) -> Float[np.ndarray, " m"]:
    """Share of the light on the aperture that reaches each direction's diffraction peak, Fresnel loss left out.

    It is the square of what `peak_amplitudes` returns, and takes the same.

    Args:
        field: `[y, x]` field behind the DOE, of unit amplitude where it is open.
        coverage: `[y, x]` open share of every cell.
        grid: the cells.
        waves_per_m: `[direction, (y, x)]` direction sines over the wavelength.

    A peak in the direction u is |sum t exp(-2 pi i u x)|² / (open area)², 1 for a plane wave that goes there as a
    whole. For a plate of many equal periods it is the efficiency of an order.
    """
    return np.abs(peak_amplitudes(field, coverage, grid, waves_per_m)) ** 2


def peak_amplitudes(
    field: Complex[np.ndarray, "y x"],
    coverage: Float[np.ndarray, "y x"],
    grid: Grid,
    waves_per_m: Float[np.ndarray, "m 2"],
) -> Complex[np.ndarray, " m"]:
    """Amplitudes whose squares are `efficiencies`; their phases are those of the plane waves in the grid's middle."""
    light = DirectionSum(grid, waves_per_m).amplitudes(field)
    return light / float(np.sum(coverage, dtype=np.float64))
