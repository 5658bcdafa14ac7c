"""The transmission of a whole plate, tile by tile: moments of every cell, and what they add to the cells around."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int, UInt8

from sim.surface.cell import DEGREE, DEGREES, DIPOLE, LINE_DEGREE, REACH, axis_moments, cuts, plane_moments, whole_cell
from sim.surface.edges import corners, walls
from sim.surface.lines import LINE_KINDS, line_moments
from sim.surface.opening import Opening, through_opening
from sim.surface.pieces import PRECISION, TILE, light_of, mask_states, own_states, summed
from sim.surface.relief import EtchParameters, TilePlan, effective_bias
from sim.threads import at_once
from sim.tracing import compiled_quickly, in_jit, is_traced

# Rows of tiles that are computed together. Where two such parts meet, light is summed in another order, so that as many
# as there are cores would give other bytes on other machines.
_ROWS = 8


def transmission_of(
    plan: TilePlan, along: tuple[Any, Any], *arrays: Any
) -> tuple[Complex[Array, "view v u"], Complex[Array, "w v u"]]:
    """Transmission of every cell, tile by tile, with the far field of plate and chrome in every view; means without.

    Rows of tiles are computed side by side (`sim.threads`), except in a trace.

    Args:
        plan: what is compiled.
        along: the `view_weights` along y and x, numpy's.
        arrays: numpy's or jax's: etches of every cell, one bit each; widths of openings in cells, where etches lag;
            `relief`; waves per metre of height of every wavelength; the amplitude that roughness finer than a cell
            leaves of each; and the chrome's `Opening`.
    """
    (weights_y, weights_x), count = along, len(along[0])
    if is_traced(*arrays) or in_jit():
        return _compiled(plan, np.arange(count, dtype=np.int32), weights_y, weights_x, *arrays)
    rows_of, plate_of = _compiled_quickly()
    long = min(_ROWS, count)
    numbers = np.arange(-(-count // long) * long, dtype=np.int32).reshape(-1, long)

    def part(rows: np.ndarray) -> Any:
        of_rows = np.where(rows < count, rows, -1), weights_y[np.minimum(rows, count - 1)]
        return jax.block_until_ready(rows_of(plan, *of_rows, weights_x, *arrays))

    return plate_of(plan, list(at_once(part, list(numbers))))


def _rows_of_tiles(
    plan: TilePlan,
    numbers: Int[Array, " strip"],
    weights_y: Float[Array, "strip view part kind s wide"],
    weights_x: Float[Array, "tile_x view part kind s wide"],
    etched: UInt8[Array, "y x"],
    widths: UInt8[Array, "mask y x"] | None,
    relief: EtchParameters,
    rates: Float[Array, " w"],
    left: Float[Array, " w"],
    opening: Opening,
) -> tuple[Float[Array, "view 2 tall u"], Float[Array, "w 2 v u"]]:
    """Rows of tiles that follow each other, -1 for none: their light, with what spills to either side, and means.

    The axis with two places is real and imaginary part.
    """
    reach = REACH if plan.cut else 0
    ny, nx = plan.grid.shape
    count_y, count_x = -(-ny // TILE), -(-nx // TILE)
    missing = count_y * TILE - ny, count_x * TILE - nx
    # One pixel more on the upper side: corners of a cell are seen from up to two cells above it, but one below.
    halo = [(plan.reach, plan.reach + 1 + after) for after in missing]
    etched = jnp.pad(etched, halo)
    widths = None if widths is None else jnp.pad(widths, ((0, 0), *halo))
    rough = None if relief.rough_m is None else jnp.pad(relief.rough_m, [(0, after) for after in missing])
    opening = opening._replace(coverage=jnp.pad(opening.coverage, [(0, after * plan.parts) for after in missing]))

    def tile(start_y: Array, start_x: Array, along_x: Array) -> tuple[Array, Array]:
        side = TILE + 2 * plan.reach + 1
        bits = jax.lax.dynamic_slice(etched, (start_y, start_x), (side, side))
        masks = (bits[None] >> jnp.arange(plan.masks, dtype=jnp.uint8)[:, None, None]) & 1
        states = masks.astype(jnp.float32)
        if widths is not None:
            width = jax.lax.dynamic_slice(widths, (0, start_y, start_x), (plan.masks, side, side)).astype(jnp.float32)
            lost = relief.lag * relief.depth_m[:, None, None] / (jnp.maximum(width, 1.0) * plan.grid.pitch_m)
            states = states * jnp.clip(1.0 - lost, 0.0, 1.0)
        bump = None if rough is None else jax.lax.dynamic_slice(rough, (start_y, start_x), (TILE, TILE))
        start = start_y, start_x
        moments, lines, means = _tile_moments(states, relief, bump, opening, start, rates, plan)
        moments, lines = (part * left[:, None, None] for part in (moments, lines))
        return _tile_rows(moments, lines, along_x, plan), means * left[:, None, None, None]

    def lit_tile(*at: Array) -> tuple[Array, Array]:
        """Nothing under the chrome, where a fifth of the tiles of a square around a circle lie, and in no row."""
        size = TILE * plan.parts, TILE * plan.parts
        corner = at[0] * plan.parts, at[1] * plan.parts
        lit = (at[0] >= 0) & jnp.any(jax.lax.dynamic_slice(opening.coverage, corner, size) > 0)
        dark = jax.tree.map(lambda part: jnp.zeros(part.shape, part.dtype), jax.eval_shape(tile, *at))
        return jax.lax.cond(lit, lambda: tile(*at), lambda: dark)

    def strip(start_y: Array, along_y: Array) -> tuple[Array, Array]:
        values = jax.checkpoint(lambda at: lit_tile(start_y, *at))
        rows, means = jax.lax.map(values, (jnp.arange(count_x) * TILE, weights_x))
        rows = _joined(rows, 5, reach)
        if not plan.cut:
            return rows[:, 0], _joined(means, 4, 0)
        views = []
        for v, (_, most) in enumerate(plan.views):
            kinds = _kinds(most, LINE_DEGREE, plan)
            views.append(_strip_values(rows[v, np.array([0, *kinds + 1])], along_y[v][:, kinds]))
        return jnp.stack(views), _joined(means, 4, 0)

    strips, means = jax.lax.map(lambda at: strip(*at), (numbers * TILE, weights_y))
    # Rows of nothing on either side take what spills.
    none, size = jnp.zeros_like(strips[:1]), TILE * plan.parts
    joined = _joined(jnp.concatenate([none, strips, none]), 3, reach)
    return joined[:, :, size - reach : joined.shape[2] - size + reach], _joined(means, 3, 0)


def _plate(
    plan: TilePlan, parts: list[tuple[Float[Array, "view 2 tall wide"], Float[Array, "w 2 low wide"]]]
) -> tuple[Complex[Array, "view v u"], Complex[Array, "w v u"]]:
    """All rows of tiles together, without what is beyond the plate."""
    ny, nx = plan.grid.shape
    inside = (slice(None), slice(ny * plan.parts), slice(nx * plan.parts))

    def whole(blocks: tuple[Array, ...], reach: int) -> Array:
        joined = _joined(jnp.stack(blocks), 3, reach)
        return jax.lax.complex(joined[:, 0], joined[:, 1])[inside]

    light, means = zip(*parts, strict=True)
    return whole(light, REACH if plan.cut else 0), whole(means, 0)


def _transmission(plan: TilePlan, *arrays: Any) -> tuple[Complex[Array, "view v u"], Complex[Array, "w v u"]]:
    return _plate(plan, [_rows_of_tiles(plan, *arrays)])


_compiled = jax.jit(_transmission, static_argnames=("plan",))


@lru_cache(maxsize=1)
def _compiled_quickly() -> tuple[Callable[..., Any], Callable[..., Any]]:
    """The same to the last bit but one, which a trace cannot hold: as fast, and compiled in two thirds of the time."""
    how: Any = {"static_argnames": ("plan",), "compiler_options": compiled_quickly()}
    return jax.jit(_rows_of_tiles, **how), jax.jit(_plate, **how)


def _tile_moments(
    states: Float[Array, "mask side side"],
    relief: EtchParameters,
    bump: Float[Array, "t t"] | None,
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
    return *through_opening(moments, lines, light, (along_y, along_x), opening, start, plan), means


def _kinds(most: int, along: int, plan: TilePlan) -> Int[np.ndarray, " kind"]:
    """Which kinds of moments across an axis are used: of cells to degree `most`, of lines to degree `along`."""
    lines = [DEGREE + kind for kind in _line_kinds(along)] if plan.lines else []
    return np.array([*range(most), *lines], int)


def _line_kinds(along: int) -> list[int]:
    """Moments across lines to a degree, with the dipole after all of them."""
    return [*range(along + 1), *([DIPOLE] if along == LINE_DEGREE else [])]


def _tile_rows(
    moments: Float[Array, "m 2 w t t"],
    lines: Float[Array, "3 line 2 w t t"],
    along_x: Float[Array, "view part kind s wide"],
    plan: TilePlan,
) -> Float[Array, "view row 2 v u"]:
    """Moments along y of a tile's rows in every view, with what spills to `REACH` cells at either end.

    The first rows are moments of cells, by degree; the others those of lines across y.
    """
    values = _by_place(moments, plan)
    if not plan.cut:
        return values[:1, jnp.array([number for number, _ in plan.views])].swapaxes(0, 1)
    both = [_on_parts(of, across, plan) for of, across in zip(lines, ((0,), (1,), (0, 1)), strict=True)]
    across_y, across_x = (dict(zip(LINE_KINDS, of, strict=False)) for of in (both[0] + both[2], both[1]))

    def spread(first: Array, higher: list[Array], weights: Array) -> Array:
        """Values of cells that look like moments along x: those of degree 0, and others with their weights."""
        row = jnp.pad(first, ((0, 0), (0, 0), (REACH, REACH)))
        if not higher:
            return row
        matrix = weights.reshape(weights.shape[0], -1, weights.shape[-1])
        product = jnp.tensordot(jnp.concatenate(higher, axis=2), matrix, (2, 1), precision=PRECISION)
        return row + _complex_sum(jnp.moveaxis(product, 2, 0))

    def seen(number: int, most: int, weights: Array) -> Array:
        of, rows = dict(zip(DEGREES, values[:, number], strict=True)), []
        for degree in range(DEGREE + 1):
            top = max(most - degree, 0)
            higher = [of[degree, x] for x in range(1, top + 1)]
            higher += [across_x[degree, x][number] for x in _line_kinds(LINE_DEGREE - degree) if plan.lines]
            rows.append(spread(of[degree, 0], higher, weights[:, _kinds(top, LINE_DEGREE - degree, plan)]))
        for y in _line_kinds(LINE_DEGREE) if plan.lines else []:
            higher = [across_y[x, y][number] for x in range(1, LINE_DEGREE + 1 - y)]
            rows.append(spread(across_y[0, y][number], higher, weights[:, : len(higher)]))
        return jnp.stack(rows)

    return jnp.stack([seen(*view, along_x[v]) for v, view in enumerate(plan.views)])


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


def _strip_values(
    rows: Float[Array, "row 2 s x"], weights: Float[Array, "part kind s wide"]
) -> Float[Array, "2 wide x"]:
    """One row of tiles as values of its cells in one view, with what spills to `REACH` cells above and below."""
    product = jnp.tensordot(weights, rows[1:], ((1, 2), (0, 2)), precision=PRECISION)  # [part, wide, 2, x]
    return jnp.pad(rows[0], ((0, 0), (REACH, REACH), (0, 0))) + _complex_sum(jnp.moveaxis(product, 2, 1))


def _complex_sum(parts: Float[Array, "part 2 v u"]) -> Float[Array, "2 v u"]:
    """The sum of real parts of the weights times values, and, if there are any, i times the imaginary ones."""
    if len(parts) == 1:
        return parts[0]
    return parts[0] + jnp.stack([-parts[1, 1], parts[1, 0]])


def _joined(parts: Float[Array, "part ..."], axis: int, reach: int) -> Float[Array, "..."]:
    """Parts side by side along an axis of all of them; the first and last `reach` are added to the neighbours."""
    size = parts.shape[axis] - 2 * reach

    def cut(of: Array, start: int, stop: int) -> Array:
        return jax.lax.slice_in_dim(of, start, stop, axis=axis)

    main = cut(parts, reach, reach + size)
    if reach:
        # Beyond the first and the last part nothing is kept.
        none = jnp.zeros_like(cut(parts[:1], 0, reach))
        above = jnp.concatenate([cut(parts[1:], 0, reach), none])
        below = jnp.concatenate([none, cut(parts[:-1], reach + size, size + 2 * reach)])
        before, behind = [(0, 0)] * axis, [(0, 0)] * (main.ndim - axis - 1)
        main = main + jnp.pad(above, [*before, (size - reach, 0), *behind])
        main = main + jnp.pad(below, [*before, (0, size - reach), *behind])
    moved = jnp.moveaxis(main, 0, axis - 1)
    return moved.reshape(*moved.shape[: axis - 1], -1, *moved.shape[axis + 1 :])
