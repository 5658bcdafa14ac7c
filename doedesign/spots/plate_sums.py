"""Sums over the cells and walls of a level map for many plates at once, and a sweep of exchanges: compiled loops.

Arrays are those of `doedesign.spots.plates.SpotPlates.tables`, plates last.
"""

from typing import Any

import numpy as np
from numba import njit

from doedesign.spots.exchange import FLAT, offered


@njit(cache=True, nogil=True)
def merit_of(light: Any, shares: Any, uniformity: float) -> float:
    """Mean efficiency of plates less `uniformity` times how unequal their spots are, from amplitudes `[spot, plate]`.

    Unequal is 1.4 times the fourth root of the mean fourth power of the relative deviations of all spots of all plates.
    """
    spots, plates = light.shape
    over = np.zeros(plates)
    total, spread = 0.0, 0.0
    for m in range(spots):
        for n in range(plates):
            power = light[m, n].real ** 2 + light[m, n].imag ** 2
            total += power
            over[n] += power / shares[m]
    for n in range(plates):
        over[n] = spots / max(over[n], 1e-300)
    for m in range(spots):
        for n in range(plates):
            off = (light[m, n].real ** 2 + light[m, n].imag ** 2) / shares[m] * over[n] - 1.0
            spread += off * off * off * off
    return total / plates - uniformity * FLAT * (spread / (plates * spots)) ** 0.25


@njit(cache=True, nogil=True)
def amplitudes_of(
    level: Any, light_of: Any, across_y: Any, across_x: Any, rows: Any, columns: Any, upper: Any, left: Any
) -> Any:
    """Amplitudes `[spot, plate]` of a level map, from the tables of `SpotPlates`."""
    ny, nx = level.shape
    light = np.zeros((rows.shape[1], light_of.shape[1]), np.complex128)
    for y in range(ny):
        for x in range(nx):
            own = level[y, x]
            _add(light, light_of[own], 1.0, rows[y], columns[x])
            behind, below = level[y, (x + 1) % nx], level[(y + 1) % ny, x]
            if behind != own:
                _add(light, across_x[own, behind], 1.0, rows[y], left[x + 1])
            if below != own:
                _add(light, across_y[own, below], 1.0, upper[y + 1], columns[x])
    return light


@njit(cache=True, nogil=True)
def _add(light: Any, value: Any, sign: float, along_y: Any, along_x: Any) -> None:
    """Add the light of one cell or wall to all spots of all plates."""
    for m in range(light.shape[0]):
        factor = sign * along_y[m] * along_x[m]
        for n in range(light.shape[1]):
            light[m, n] += value[n] * factor


@njit(cache=True, nogil=True)
def _add_cell(
    light: Any, level: Any, y: int, x: int, own: int, sign: float, light_of: Any, across_y: Any, across_x: Any,
    rows: Any, columns: Any, upper: Any, left: Any,
) -> None:  # fmt: skip
    """Add a cell of some level and its four walls."""
    ny, nx = level.shape
    _add(light, light_of[own], sign, rows[y], columns[x])
    if nx > 1:
        before, behind = level[y, (x - 1) % nx], level[y, (x + 1) % nx]
        if before != own:
            _add(light, across_x[before, own], sign, rows[y], left[x])
        if behind != own:
            _add(light, across_x[own, behind], sign, rows[y], left[x + 1])
    if ny > 1:
        above, below = level[(y - 1) % ny, x], level[(y + 1) % ny, x]
        if above != own:
            _add(light, across_y[above, own], sign, upper[y], columns[x])
        if below != own:
            _add(light, across_y[own, below], sign, upper[y + 1], columns[x])


@njit(cache=True, nogil=True)
def sweep(own: Any, best: Any, tables: Any, shares: Any, offers: Any, heat: float, uniformity: float) -> None:
    """Offer every cell another level, in place; `best` is the best map met so far."""
    light = amplitudes_of(own, *tables)
    merit = merit_of(light, shares, uniformity)
    highest = merit_of(amplitudes_of(best, *tables), shares, uniformity)
    nx, tried = own.shape[1], np.empty_like(light)
    order, chance, others, sides = offers
    for cell, throw, other, side in zip(order, chance, others, sides):  # noqa: B905 - numba knows no strict
        y, x = cell // nx, cell % nx
        level = offered(own, y, x, other, side, len(tables[0]))
        if level == own[y, x]:
            continue
        tried[:] = light
        _add_cell(tried, own, y, x, own[y, x], -1.0, *tables)
        _add_cell(tried, own, y, x, level, 1.0, *tables)
        found = merit_of(tried, shares, uniformity)
        if found >= merit or (heat > 0 and throw < np.exp((found - merit) / heat)):
            own[y, x], merit = level, found
            light[:] = tried
            if merit > highest:
                highest = merit
                best[:] = own
