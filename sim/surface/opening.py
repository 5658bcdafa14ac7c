"""Cells on the rim of the chrome's opening: where within the cell it is open.

Light that the rim lets through a cell comes from its open side. A cell that passes the mean of its open part, as if it
came from everywhere in it, has the wrong moments: the light of random plates of 128 cells, lit from nearby, is off by
2.5 % in red and 3.4 % in blue, that of 256 cells by 1.6 and 2.2 %. Here the moments of what is open are taken, as those
of the masks' pieces are (`sim.surface.cell`), before light is given to the cells around, so that none of it is cut off
by the rim.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim.aperture import BoxOutline, MaskOutline, RoundOutline
from sim.surface.cell import DEGREES, Cuts, axis_moments
from sim.surface.pieces import PRECISION, TILE
from sim.surface.relief import TilePlan

_SQUARES = 6  # per part of a cell and axis; within each the rim is straight, and light even


class Opening(NamedTuple):
    """The chrome's opening, as numbers that all tiles share."""

    centre_m: Float[Array, "2"]  # (y, x)
    outline: RoundOutline | BoxOutline | MaskOutline


def through_opening(
    moments: Float[Array, "m 2 w t t"],
    lines: Float[Array, "3 kind 2 w t t"],
    light: Float[Array, "piece 2 w cell"],
    along: tuple[Cuts, Cuts],
    coverage: Float[Array, "s s"],
    opening: Opening,
    start: tuple[Array, Array],
    plan: TilePlan,
) -> tuple[Float[Array, "m 2 w t t"], Float[Array, "3 kind 2 w t t"]]:
    """Moments of one tile's cells, and of lines, behind the chrome.

    `light` is that of the pieces into which the cells are cut `along` y and x; `coverage` the open share of every part
    of them; `start` the tile's first cell (y, x).
    """
    parts = plan.parts

    def cut() -> tuple[Array, Array]:
        own = jnp.transpose(coverage.reshape(TILE, parts, TILE, parts), (1, 3, 0, 2))
        more = _added(light, along, _shares(opening, own, start, plan), plan)
        seen = moments.reshape(parts, parts, -1, *moments.shape[1:]) * own[:, :, None, None, None] + more
        return seen.reshape(moments.shape), lines * jnp.mean(own, (0, 1))

    return jax.lax.cond(jnp.all(coverage == 1.0), lambda: (moments, lines), cut)


def _shares(
    opening: Opening, own: Float[Array, "p p t t"], start: tuple[Array, Array], plan: TilePlan
) -> Float[Array, "p p q q t t"]:
    """Open share of every square of the parts of cells, less the mean of its part, whose share is `own`."""
    squares = plan.parts * _SQUARES
    side = np.float32(plan.grid.pitch_m / squares)
    # Whole numbers of cells from the middle of the DOE, and of squares from the tile's first: single precision does.
    within = (jnp.arange(TILE * squares) + 0.5) / squares
    at = [
        ((first - n / 2) + within - centre / plan.grid.pitch_m) * squares
        for first, n, centre in zip(start, plan.grid.shape, opening.centre_m, strict=True)
    ]
    found = opening.outline.shares(at[0], at[1], side)
    found = found.reshape(TILE, plan.parts, _SQUARES, TILE, plan.parts, _SQUARES)
    found = jnp.transpose(found, (1, 4, 2, 5, 0, 3))
    # Where a pinhole opens the chrome, or where no square is cut, all squares are alike.
    edge = (own > 0) & (own < 1)
    return jnp.where(edge[:, :, None, None], found - jnp.mean(found, (2, 3), keepdims=True), 0.0)


def _added(
    light: Float[Array, "piece 2 w cell"],
    along: tuple[Cuts, Cuts],
    more: Float[Array, "p p q q t t"],
    plan: TilePlan,
) -> Float[Array, "p p m 2 w t t"]:
    """Moments of light through squares that are open by some `more` than their part of a cell is."""
    parts, squares = plan.parts, plan.parts * _SQUARES
    pieces = light.reshape(*(len(cuts.edges) - 1 for cuts in along), *light.shape[1:])
    of_squares = [axis_moments(cuts.edges, squares)[:, 0] for cuts in along]  # share of every segment in a square
    seen = jnp.einsum("ai,bj,ijcwn->abcwn", *of_squares, pieces, precision=PRECISION)
    seen = seen.reshape(parts, _SQUARES, parts, _SQUARES, *seen.shape[2:4], TILE, TILE)
    means = axis_moments(jnp.linspace(0, 1, _SQUARES + 1), 1)[0]  # integral of every polynomial over a square
    table = jnp.stack([jnp.einsum("a,b->ab", means[y], means[x]) for y, x in DEGREES])
    return jnp.einsum("paqbcwij,pqabij,mab->pqmcwij", seen, more, table, precision=PRECISION)
