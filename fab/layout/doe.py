"""The cell of a DOE: its planes, drawn as the process needs them, and its chrome."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from fab.layout.arrays import arrayed, period_of
from fab.layout.compensation import MovedPlane, moved
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

    A relief that repeats is drawn as arrays of a second cell, which comes before that of the DOE (`fab.layout.arrays`).

    `edge_moves` says per mask how far every edge of an etched area is moved outward, database units
    (`fab.layout.compensation`), `bits` which plane each mask draws, its own by default (`fab.layout.split`).
    """
    levels, edges = level_map.levels, pixel_edges(level_map.grid)
    moves = edge_moves or (0,) * levels.bits
    drawn = level_map.planes()[list(bits)] if bits else level_map.planes()
    # The kernel lets go of the interpreter lock, so the planes share the cores.
    with ThreadPoolExecutor() as pool:
        found = list(pool.map(lambda plane, move: moved(plane, edges, move), drawn, moves))
        planes = {etch_layer(mask, levels): plane for mask, plane in enumerate(found)}
        shapes = dict(zip(planes, pool.map(MovedPlane.shapes, found), strict=True))
    chromed = {chrome_layer(levels): chrome_shapes(level_map, edges.dbu_m, chrome or Chrome())}
    whole = Cell(require_name(cell), shapes | chromed)
    period = period_of(level_map.level)
    *one, doe = (arrayed(whole, planes, edges, period) if period else None) or [whole]
    return Layout(edges.dbu_m, (*one, doe))
