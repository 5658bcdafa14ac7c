"""The transmission of a whole plate, tile by tile: moments of every cell, and their filters across cells."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, UInt8

from sim.surface.cell import DEGREES, FILTER_REACH, axis_moments, cuts, moment_filter, plane_moments, whole_cell
from sim.surface.edges import corners, walls
from sim.surface.pieces import PRECISION, TILE, light_of, mask_states, own_states, summed
from sim.surface.relief import EtchParameters, TilePlan, effective_bias


@partial(jax.jit, static_argnames=("plan",))
def transmission_of(
    etched: UInt8[Array, "y x"],
    widths: UInt8[Array, "mask y x"] | None,
    relief: EtchParameters,
    rates: Float[Array, " w"],
    left: Float[Array, " w"],
    plan: TilePlan,
) -> tuple[Complex[Array, "w v u"], Complex[Array, "w v u"]]:
    """Transmission of every cell, tile by tile: with the far field of the whole plate within the band, and its mean.

    `left` is the amplitude that roughness finer than a cell leaves of each wavelength.
    """
    ny, nx = plan.grid.shape
    count_y, count_x = -(-ny // TILE), -(-nx // TILE)
    missing = count_y * TILE - ny, count_x * TILE - nx
    # One pixel more on the upper side: corners of a cell are seen from up to two cells above it, but one below.
    halo = [(plan.reach, plan.reach + 1 + after) for after in missing]
    etched = jnp.pad(etched, halo)
    widths = None if widths is None else jnp.pad(widths, ((0, 0), *halo))
    rough = None if relief.rough_m is None else jnp.pad(relief.rough_m, [(0, after) for after in missing])

    def tile(start_y: Array, start_x: Array) -> Array:
        side = TILE + 2 * plan.reach + 1
        bits = jax.lax.dynamic_slice(etched, (start_y, start_x), (side, side))
        masks = (bits[None] >> jnp.arange(plan.masks, dtype=jnp.uint8)[:, None, None]) & 1
        states = masks.astype(jnp.float32)
        if widths is not None:
            width = jax.lax.dynamic_slice(widths, (0, start_y, start_x), (plan.masks, side, side)).astype(jnp.float32)
            lost = relief.lag * relief.depth_m[:, None, None] / (jnp.maximum(width, 1.0) * plan.grid.pitch_m)
            states = states * jnp.clip(1.0 - lost, 0.0, 1.0)
        bump = None if rough is None else jax.lax.dynamic_slice(rough, (start_y, start_x), (TILE, TILE))
        return _tile_moments(states, relief, bump, (start_y, start_x), rates, plan)

    def strip(start_y: Array) -> tuple[Array, Array]:
        starts = jnp.arange(count_x) * TILE
        moments = jax.lax.map(jax.checkpoint(lambda start_x: tile(start_y, start_x)), starts)
        return _strip_values(moments * left[:, None, None], plan)

    strips, means = jax.lax.map(strip, jnp.arange(count_y) * TILE)
    means = jnp.moveaxis(means, 0, 1).reshape(rates.shape[0], -1, means.shape[3])
    inside = (slice(None), slice(ny * plan.parts), slice(nx * plan.parts))
    return _joined(strips)[inside], means[inside]


def _tile_moments(
    states: Float[Array, "mask side side"],
    relief: EtchParameters,
    bump: Float[Array, "t t"] | None,
    start: tuple[Array, Array],
    rates: Float[Array, " w"],
    plan: TilePlan,
) -> Float[Array, "moment 2 w t t"]:
    """Moments of the transmission of one tile's cells (`sim.surface.cell.plane_moments` says which)."""
    pitch, tile = plan.grid.pitch_m, TILE
    ny, nx = plan.grid.shape
    middle_y = (start[0] + (tile - ny) / 2) * pitch
    middle_x = (start[1] + (tile - nx) / 2) * pitch
    if plan.cut:
        bias = effective_bias(relief) / pitch
        along_y = cuts((relief.shift_m[:, 0] + relief.growth * middle_y + relief.turn * middle_x) / pitch, bias)
        along_x = cuts((relief.shift_m[:, 1] + relief.growth * middle_x - relief.turn * middle_y) / pitch, bias)
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
    pieces = (pieces * uniform.reshape(-1)).reshape(-1, tile * tile)
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
    return moments.reshape(*moments.shape[:3], tile, tile)


def _strip_values(
    moments: Float[Array, "tile moment 2 w t t"], plan: TilePlan
) -> tuple[Complex[Array, "w v u"], Complex[Array, "w y u"]]:
    """One row of tiles as values of its cells, with what spills to `FILTER_REACH` cells above and below; and means."""
    count, _, _, lines = moments.shape[:4]
    parts, reach = plan.parts, FILTER_REACH
    moments = moments.reshape(count, parts, parts, len(DEGREES), 2, lines, TILE, TILE)
    # [degree, 2, w, (row, part), (tile, column, part)]
    moments = jnp.transpose(moments, (3, 4, 5, 6, 1, 0, 7, 2))
    values = moments.reshape(len(DEGREES), 2, lines, TILE * parts, count * TILE * parts)
    values = values.reshape(len(DEGREES), 2 * lines, *values.shape[-2:])
    spill = ((0, 0), (reach, reach), (0, 0))
    if not plan.cut:
        total = jnp.pad(values[0], spill)
    else:
        first, second = (moment_filter(q, plan.band) for q in (1, 2))
        of = dict(zip(DEGREES, values, strict=True))
        even = of[0, 0] + _filtered(of[0, 1], first, 2) + _filtered(of[0, 2], second, 2)
        odd = of[1, 0] + _filtered(of[1, 1], first, 2)
        wide = _filtered(jnp.pad(odd, spill), first, 1) + _filtered(jnp.pad(of[2, 0], spill), second, 1)
        total = jnp.pad(even, spill) + wide
    filtered, means = (part.reshape(2, lines, *part.shape[1:]) for part in (total, values[0]))
    return jax.lax.complex(*filtered), jax.lax.complex(*means)


def _filtered(values: Float[Array, "n v u"], weights: Float[np.ndarray, " tap"], axis: int) -> Float[Array, "n v u"]:
    """Convolution along an axis; beyond the ends there is nothing."""
    reach, size = len(weights) // 2, values.shape[axis]
    padded = jnp.pad(values, [(reach, reach) if a == axis else (0, 0) for a in range(values.ndim)])
    shifted = (
        jax.lax.slice_in_dim(padded, 2 * reach - tap, 2 * reach - tap + size, axis=axis) * jnp.float32(weight)
        for tap, weight in enumerate(weights)
        if weight
    )
    return sum(shifted, jnp.zeros_like(values))


def _joined(strips: Complex[Array, "strip w v u"]) -> Complex[Array, "w y u"]:
    """Strips side by side, what spills from each added to its neighbours."""
    reach = FILTER_REACH
    main = strips[:, :, reach:-reach]
    # Above the last strip and below the first one nothing is kept.
    from_next = jnp.concatenate([strips[1:, :, :reach], jnp.zeros_like(strips[:1, :, :reach])])
    from_last = jnp.concatenate([jnp.zeros_like(strips[:1, :, -reach:]), strips[:-1, :, -reach:]])
    main = main.at[:, :, -reach:].add(from_next).at[:, :, :reach].add(from_last)
    return jnp.moveaxis(main, 0, 1).reshape(strips.shape[1], -1, strips.shape[3])
