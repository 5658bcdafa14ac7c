"""The cell of a DOE: its planes, drawn as the process needs them, and its chrome."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.grid import Grid
from fab.layout.compensation import grown
from fab.layout.geometry import Cell, Chrome, Layout, chrome_layer, chrome_shapes, etch_layer, pixel_edges, require_name
from fab.levels import Levels
from fab.masks import planes, unetched_outside
from fab.units import format_length

__all__ = ["mask_layout"]


def mask_layout(
    level_map: NDArray[np.integer],
    levels: Levels,
    grid: Grid,
    aperture_m: float,
    cell: str,
    chrome: Chrome | None = None,
    edge_moves: Sequence[int] = (),
    bits: Sequence[int] = (),
) -> Layout:
    """Draw the planes and the chrome of one DOE as one cell, centred on the clear aperture.

    Args:
        level_map: level numbers ``[y, x]``; outside the clear aperture the glass is left blank.
        levels: the staircase.
        grid: the raster of the map.
        aperture_m: diameter of the clear aperture, metres.
        cell: name of the cell.
        chrome: how the chrome is drawn; the defaults of `Chrome` if left out.
        edge_moves: per mask, how far every edge of an etched area is moved outward, database units; nowhere if left
            out (`fab.layout.compensation`).
        bits: which plane each mask draws, its own if left out (`fab.layout.split`).

    Returns:
        One layer per etch mask, mask 0 first, and the chrome last.

    Raises:
        InputError: the map does not belong to the levels or the grid, or a number is out of range.
    """
    side_m = min(grid.extent_m)
    if not 0 < aperture_m <= side_m * (1 + 1e-9):
        rule = f"must lie from 0 to the shorter side of the raster, {format_length(side_m)}"
        raise InputError("aperture", rule, format_length(aperture_m), "Give the diameter of the clear aperture.")
    edges = pixel_edges(grid)
    inside = unetched_outside(level_map, levels, grid, aperture_m)
    moves = edge_moves or (0,) * levels.bits
    drawn = planes(inside, levels)[list(bits)] if bits else planes(inside, levels)
    # The kernel lets go of the interpreter lock, so the planes share the cores.
    with ThreadPoolExecutor() as pool:
        found = pool.map(lambda plane, move: grown(plane, edges, move), drawn, moves)
        shapes = {etch_layer(mask, levels): rectangles for mask, rectangles in enumerate(found)}
    shapes[chrome_layer(levels)] = chrome_shapes(grid, aperture_m, edges.dbu_m, chrome or Chrome())
    return Layout(edges.dbu_m, (Cell(require_name(cell), shapes),))
