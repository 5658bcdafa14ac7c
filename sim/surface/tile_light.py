"""Light of one tile: moments of its cells, and what they add to the cells around."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim.surface.cell import DEGREE, DEGREES, DIPOLE, LINE_DEGREE, REACH, axis_moments, cuts, plane_moments, whole_cell
from sim.surface.edges import corners, walls
from sim.surface.lines import LINE_KINDS, line_moments
from sim.surface.opening import Opening, through_opening
from sim.surface.pieces import PRECISION, TILE, light_of, mask_states, own_states, summed
from sim.surface.relief import EtchParameters, TilePlan, effective_bias


def tile_moments(
    states: Float[Array, "mask side side"],
    relief: EtchParameters,
    bump: Float[Array, "t t"] | None,
    coverage: Float[Array, "s s"],
    opening: Opening,
    start: tuple[Array, Array],
    rates: Float[Array, " w"],
    plan: TilePlan,
) -> tuple[Float[Array, "moment 2 w t t"], Float[Array, "3 kind 2 w t t"], Float[Array, "w 2 s s"]]:
    """Moments of the transmission of one tile's cells (`sim.surface.cell.plane_moments` says which), and of lines.

    Then the mean of every part of the cells, without the chrome.
    """
    pitch, tile = plan.grid.pitch_m, TILE
    ny, nx = plan.grid.shape
    middle_y = (start[0] + (tile - ny) / 2) * pitch
    middle_x = (start[1] + (tile - nx) / 2) * pitch
    turned = jnp.stack([relief.turn * middle_x, -relief.turn * middle_y], 1)
    shift = (relief.shift_m + relief.growth[:, None] * jnp.stack([middle_y, middle_x]) + turned) / pitch
    if plan.cut:
        bias = effective_bias(relief) / pitch
        along_y, along_x = (cuts(shift[:, axis], bias) for axis in (0, 1))
        shares = mask_states(states, along_y, along_x, bias, plan)
        pieces = own_states(shares)
    else:
        along_y = along_x = whole_cell(plan.masks)
        inner = states[:, plan.reach : plan.reach + tile, plan.reach : plan.reach + tile]
        shares, pieces = None, jnp.broadcast_to(inner.reshape(plan.masks, 1, 1, -1), (plan.masks, 3, 3, tile * tile))
    chosen_y, chosen_x = (jax.nn.one_hot(c.state, 3, axis=1) for c in (along_y, along_x))
    taken = relief.depth_m[:, None, None, None, None] * jnp.einsum("kia,kjb->kijab", chosen_y, chosen_x)
    segments = along_y.state.shape[1], along_x.state.shape[1]
    taken = jnp.transpose(taken, (3, 4, 0, 1, 2)).reshape(segments[0] * segments[1], -1)
    axis = (jnp.arange(tile) - (tile - 1) / 2) * pitch
    y, x = middle_y + plan.die_m[0] + axis[:, None], middle_x + plan.die_m[1] + axis[None, :]
    uniform = 1.0 + relief.bowl * (y * y + x * x) + relief.tilt[0] * y + relief.tilt[1] * x
    # What differs from cell to cell goes into the product; after it, it would be computed again for every piece.
    uniform = uniform.reshape(-1)
    pieces = (pieces * uniform).reshape(-1, tile * tile)
    if bump is not None:
        pieces = jnp.concatenate([pieces, -bump.reshape(1, -1)])
        taken = jnp.concatenate([taken, jnp.ones((taken.shape[0], 1))], axis=1)
    depth = jnp.dot(taken, pieces, precision=PRECISION)
    light = light_of(relief.height_m - depth, rates)
    weights = plane_moments(axis_moments(along_y.edges, plan.parts), axis_moments(along_x.edges, plan.parts))
    moments = summed(weights, light)
    if plan.walls:
        moments = moments + walls(light, depth, along_y, along_x, relief, rates, plan)
    if shares is not None and plan.corners:
        moments = moments + corners(light, shares > 0, along_y, along_x, relief, rates, plan)
    lines = jnp.zeros((3, 0, *moments.shape[1:]))
    if plan.lines:
        lines = line_moments(states, uniform, 0.0 if bump is None else bump.reshape(-1), shift, relief, rates, plan)
    moments, lines = (part.reshape(*part.shape[:-1], tile, tile) for part in (moments, lines))
    means = _by_place(moments, plan)[0]
    return *through_opening(moments, lines, light, (along_y, along_x), coverage, opening, start, plan), means


def kinds_across(most: int, plan: TilePlan) -> list[int]:
    """Kinds of moments across y that are used: of cells to degree `most`, and of lines."""
    return [*range(most), *(DEGREE + kind for kind in (_line_kinds(LINE_DEGREE) if plan.lines else []))]


def _line_kinds(along: int) -> list[int]:
    """Moments across lines to a degree, with the dipole after all of them."""
    return [*range(along + 1), *([DIPOLE] if along == LINE_DEGREE else [])]


def tile_rows(
    moments: Float[Array, "m 2 w t t"],
    lines: Float[Array, "3 line 2 w t t"],
    along_x: Float[Array, "view kind in s out wide"],
    plan: TilePlan,
) -> list[list[Float[Array, "2 v u"]]]:
    """Moments along y of a tile's rows in every view, with what spills to `REACH` cells at either end.

    The first of a view are moments of cells, by degree; the others those of lines across y.
    """
    values = _by_place(moments, plan)
    if not plan.cut:
        return [[values[0, number]] for number, _ in plan.views]
    both = [_on_parts(of, across, plan) for of, across in zip(lines, ((0,), (1,), (0, 1)), strict=True)]
    across_y, across_x = (dict(zip(LINE_KINDS, of, strict=False)) for of in (both[0] + both[2], both[1]))

    def seen(number: int, most: int, weights: Array) -> list[Array]:
        of, rows = dict(zip(DEGREES, values[:, number], strict=True)), []
        for degree in range(most + 1):
            cells = [of[degree, x] for x in range(most - degree + 1)]
            kinds = _line_kinds(LINE_DEGREE - degree) if plan.lines else []
            rows.append(_row(cells, [across_x[degree, x][number] for x in kinds], weights))
        for y in _line_kinds(LINE_DEGREE) if plan.lines else []:
            rows.append(
                _row([across_y[x, y][number] for x in range(LINE_DEGREE + 1 - min(y, LINE_DEGREE))], [], weights)
            )
        return rows

    return [seen(*view, along_x[v]) for v, view in enumerate(plan.views)]


def _in_middle(of: Float[Array, "2 s t"], axis: int) -> Float[Array, "2 v u"]:
    """With `REACH` zeros at both ends of an axis."""
    around = [(0, 0)] * 3
    around[axis] = (REACH, REACH)
    return jnp.pad(of, around)


def _row(
    cells: list[Float[Array, "2 s t"]], lines: list[Float[Array, "2 s t"]], weights: Float[Array, "kind in t out wide"]
) -> Float[Array, "2 s wide"]:
    """Values of cells that look like moments along x: of cells, their means first, and of lines."""
    means, *higher = cells
    row = _in_middle(means, -1)
    row = row + _spread(higher, weights) if higher else row
    return row + _spread(lines, weights[DEGREE:]) if lines else row


def _spread(moments: list[Float[Array, "2 s t"]], weights: Float[Array, "kind in t out wide"]) -> Float[Array, "2 s w"]:
    """Values of cells that look like moments along x, of the first kinds of the weights."""
    _, inner, _, outer, wide = weights.shape
    matrix = weights[: len(moments)].reshape(-1, outer * wide)
    if inner == 1:
        return jnp.dot(jnp.concatenate(moments, -1), matrix, precision=PRECISION)
    parts = jnp.concatenate([part for one in moments for part in one], -1)
    return jnp.dot(parts, matrix, precision=PRECISION).reshape(-1, outer, wide).swapaxes(0, 1)


def _by_place(moments: Float[Array, "m 2 w t t"], plan: TilePlan) -> Float[Array, "degree w 2 s s"]:
    """Moments by degree, on the parts of a tile's cells."""
    parts, count, size = plan.parts, moments.shape[2], TILE * plan.parts
    moments = moments.reshape(parts, parts, -1, 2, count, TILE, TILE)
    # [degree, w, 2, (row, part), (column, part)]
    return jnp.transpose(moments, (2, 4, 3, 5, 0, 6, 1)).reshape(-1, count, 2, size, size)


def _on_parts(
    lines: Float[Array, "line 2 w t t"], across: tuple[int, ...], plan: TilePlan
) -> Float[Array, "line w 2 s s"]:
    """Moments of lines across an axis (0 or 1) on the parts of cells; across both they are points.

    A line lies on the lower border of its cell's first part, and along all of them.
    """
    found = jnp.swapaxes(lines, 1, 2)
    for axis in range(2) if plan.parts > 1 else ():
        found = jnp.repeat(found, plan.parts, axis=axis - 2)
        if axis in across:
            first = jnp.arange(found.shape[axis - 2]) % plan.parts == 0
            found = jnp.where(first[:, None] if axis == 0 else first, found, 0.0)
    return found


def strip_values(
    rows: list[Float[Array, "2 s x"]], weights: Float[Array, "kind in s out wide"], kinds: list[int]
) -> Float[Array, "2 wide x"]:
    """One row of tiles as values of its cells in one view, with what spills to `REACH` cells above and below.

    The first of the rows are means along y, the others moments of the given kinds.
    """
    plain, *higher = rows
    values = _in_middle(plain, -2)
    for kind, row in zip(kinds, higher, strict=True):
        inner, _, outer, wide = weights[kind].shape
        matrix = weights[kind].reshape(-1, outer * wide)
        if inner == 1:
            values = values + jnp.einsum("sw,psx->pwx", matrix, row, precision=PRECISION)
        else:
            product = jnp.dot(matrix.T, row.reshape(-1, row.shape[-1]), precision=PRECISION)
            values = values + product.reshape(outer, wide, -1)
    return values
