"""Certificate of a design: rows cut out of it, as thin elements, with edges, and by Maxwell's equations."""

import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from fab.grid import Grid
from sim.camera import Camera
from sim.material import refractive_index
from sim.rigorous.comparison import RowComparison, compare_row

# Shares of the way from the axis to the rim at which rows are cut out.
SHARES = (0.0, 0.25, 0.5, 0.75, 0.9)
# Orders of the rigorous solutions over those that travel in glass: the finer is believed, the other tells how far.
_WAVES = (1.5, 2.0)


class Row(NamedTuple):
    """Cells side by side, cut out of a height map.

    Attributes:
        axis: along which they lie.
        centre_m: where the middle of the row lies (y, x), metres from the middle of the DOE.
        height_m: of every cell.
    """

    axis: Literal["x", "y"]
    centre_m: tuple[float, float]
    height_m: Float[np.ndarray, " cell"]


class CertifiedRow(NamedTuple):
    """A row at one wavelength.

    Attributes:
        row: the cells.
        wavelength_m: vacuum wavelength.
        orders: thin, with edges and rigorous.
        unsettled: relative change of the rigorous orders from three quarters of the waves, for TE and TM.
    """

    row: Row
    wavelength_m: float
    orders: RowComparison
    unsettled: Float[np.ndarray, "2"]


def cut_rows(
    height_m: Float[np.ndarray, "y x"], grid: Grid, aperture_m: float, cells: int, shares: Sequence[float] = SHARES
) -> list[Row]:
    """Cut rows of `cells` cells: along x on the x axis, along y on the y axis, and along x on the diagonal.

    On the axes of a design of rings they cross the rings, where walls stand closest. Rows without relief are left out,
    and parts of rows beyond the aperture (a diameter, metres).
    """
    found = []
    for share in shares:
        reach = share * aperture_m / 2
        slanted = reach / np.sqrt(2)
        places: list[tuple[Literal["x", "y"], tuple[float, float]]] = [("x", (0.0, reach))]
        if share:
            places += [("y", (reach, 0.0)), ("x", (slanted, slanted))]
        for axis, (y_m, x_m) in places:
            row = int(np.argmin(np.abs(grid.axis_m("y") - y_m)))
            column = int(np.argmin(np.abs(grid.axis_m("x") - x_m)))
            line, middle = (height_m[row], column) if axis == "x" else (height_m[:, column], row)
            across_m = grid.axis_m("y")[row] if axis == "x" else grid.axis_m("x")[column]
            start = int(np.clip(middle - cells // 2, 0, len(line) - cells))
            along_m = grid.axis_m(axis)[start : start + cells]
            inside = np.hypot(along_m, across_m) <= aperture_m / 2
            part = np.asarray(line[start : start + cells], np.float64)[inside]
            if len(part) > 1 and np.ptp(part) > 0:
                own, other = float(along_m[inside].mean()), float(across_m)
                found.append(Row(axis, (own, other) if axis == "y" else (other, own), part))
    return found


def certify_rows(
    rows: Sequence[Row], camera: Camera, wavelengths_m: Sequence[float], on_row: Callable[[], None] = lambda: None
) -> tuple[CertifiedRow, ...]:
    """Solve rows that repeat, lit from the air at normal incidence, at every wavelength.

    Args:
        rows: of `cut_rows`.
        camera: pitch and substrate.
        wavelengths_m: vacuum wavelengths.
        on_row: called after every one, for progress.
    """

    def solved(wavelength_m: float, row: Row) -> CertifiedRow:
        index = refractive_index(camera.material, wavelength_m)
        coarse, fine = (
            compare_row(row.height_m, camera.grid.pitch_m, wavelength_m, index, waves=waves) for waves in _WAVES
        )
        return CertifiedRow(row, wavelength_m, fine, fine.error(coarse.rigorous))

    found = []
    # Several threads make one of these matrices slower: twice with nothing else to do, and twenty times beside others.
    with threadpool_limits(1), ThreadPoolExecutor(os.cpu_count()) as pool:
        for one in pool.map(solved, *zip(*itertools.product(wavelengths_m, rows), strict=True)):
            found.append(one)
            on_row()
    return tuple(found)
