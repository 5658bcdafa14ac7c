"""The cell of a DOE: its planes, drawn as the process needs them, and its chrome."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from fab.layout.compensation import grown
from fab.layout.geometry import Cell, Chrome, Layout, chrome_layer, chrome_shapes, etch_layer, pixel_edges, require_name
from fab.level_map import LevelMap


def mask_layout(
    level_map: LevelMap,
    cell: str,
    chrome: Chrome | None = None,
    edge_moves: Sequence[int] = (),
    bits: Sequence[int] = (),
) -> Layout:
    """Draw planes and chrome of one DOE as one cell, centred on the aperture: a layer per etch mask, the chrome last.

    `edge_moves` says per mask how far every edge of an etched area is moved outward, database units
    (`fab.layout.compensation`), `bits` which plane each mask draws, its own by default (`fab.layout.split`).
    """
    levels, edges = level_map.levels, pixel_edges(level_map.grid)
    moves = edge_moves or (0,) * levels.bits
    drawn = level_map.planes()[list(bits)] if bits else level_map.planes()
    # The kernel lets go of the interpreter lock, so the planes share the cores.
    with ThreadPoolExecutor() as pool:
        found = pool.map(lambda plane, move: grown(plane, edges, move), drawn, moves)
        shapes = {etch_layer(mask, levels): rectangles for mask, rectangles in enumerate(found)}
    shapes[chrome_layer(levels)] = chrome_shapes(level_map, edges.dbu_m, chrome or Chrome())
    return Layout(edges.dbu_m, (Cell(require_name(cell), shapes),))
