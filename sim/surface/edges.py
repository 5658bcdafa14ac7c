"""Tilted walls and rounded corners: what edges of openings do besides their place."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sim.surface.cell import Cuts, axis_moments, axis_values, plane_moments, point_moments
from sim.surface.pieces import Pair, share_of, summed, turned
from sim.surface.relief import EtchParameters, TilePlan, effective_bias


def walls(
    light: Float[Array, "p 2 w c"],
    depth: Float[Array, "p c"],
    along_y: Cuts,
    along_x: Cuts,
    relief: EtchParameters,
    rates: Float[Array, " w"],
    plan: TilePlan,
) -> Float[Array, "m 2 w c"]:
    """Change that tilted walls make along every line, besides shifting the wall (`effective_bias`).

    On a strip of width depth tan(angle) the light of the floor, B (1 above), is replaced by the mean over the slope,
    A = exp(-i pi d) sinc(d), d being the etch's depth in waves. (A - B) = (B - 1) (-1/2 + i g) with
    g = (sinc d - cos(pi d)) / (2 sin(pi d)): the -1/2 is a wall moved by half the strip, the rest is added here. It is
    a small part of a small strip, so along the wall the cell is taken to be as in its longest segment.
    """
    segments = along_y.state.shape[1], along_x.state.shape[1]
    lit = light.reshape(*segments, *light.shape[1:])
    deep = depth.reshape(*segments, -1)
    waves = rates[:, None] * relief.depth_m[None, :]  # [w, mask]
    sine = jnp.sin(jnp.pi * waves)
    # At whole waves there is no step for the formula to scale.
    bounded = jnp.where(jnp.abs(sine) < 1e-2, 1e-2, sine)
    quadrature = jnp.where(waves == 0, 0.0, (jnp.sinc(waves) - jnp.cos(jnp.pi * waves)) / (2 * bounded))
    strength = quadrature * relief.depth_m * relief.slope / plan.grid.pitch_m  # [w, mask], cells

    def over(across: Cuts, along: Cuts, axis: int) -> Array:
        longest = jnp.argmax(jnp.diff(along.edges))
        lit_there, deep_there = (
            jax.lax.dynamic_index_in_dim(a, longest, 1 - axis, keepdims=False) for a in (lit, deep)
        )
        owner = jnp.zeros((plan.masks, across.edges.shape[0] - 2))
        owner = owner.at[jnp.arange(plan.masks)[:, None], across.line].add(1.0)

        def strip(line: tuple[Array, Array]) -> Array:
            number, share = line
            toward_floor = jnp.sign(deep_there[number + 1] - deep_there[number])
            return (lit_there[number + 1] - lit_there[number]) * toward_floor * share[:, None]

        # A loop compiles to passes over rows; in one expression, every element would look for its line.
        strips = jax.lax.map(strip, (jnp.arange(owner.shape[1]), owner.T @ strength.T))
        # A strip's share of a part of the cell is as many times larger as the part is smaller.
        points, lengths = axis_values(across.edges[1:-1], plan.parts), axis_moments(jnp.array([0.0, 1.0]), plan.parts)
        weights = plane_moments(points, lengths) if axis == 0 else plane_moments(lengths, points)
        return summed(weights, strips)

    return turned(over(along_y, along_x, 0) + over(along_x, along_y, 1))


# Where the middle of the area between a square corner and its rounding lies, along each axis, in radii.
_CORNER_MIDDLE = (1 / 2 - np.pi / 4 * (1 - 4 / (3 * np.pi))) / (1 - np.pi / 4)
_ALONE = 1e-6  # share of the area at a corner that two masks may have in common as if it were none


def corners(
    light: Float[Array, "p 2 w c"],
    is_open: Bool[Array, "mask 2 2 window window"],
    along_y: Cuts,
    along_x: Cuts,
    relief: EtchParameters,
    rates: Float[Array, " w"],
    plan: TilePlan,
) -> Float[Array, "m 2 w c"]:
    """Change that rounding makes where exactly one of the four pieces around a crossing of a mask's lines differs.

    The odd piece loses (1 - pi/4) r^2 to the state of its neighbours in that mask, in the middle of that area, with the
    other masks as they are there; where several masks have the same corner they change it together. Every crossing is
    looked at from its four sides; seen from a side that lies in the next cell, it is a crossing of that cell.

    Against a raster, the change is right to 3-6 % for corners that are alone or the same in all masks, to 16-23 % where
    other masks' edges run through the area, and no better than to its own size where the corners of different masks lie
    within a third of the radius of each other. All of it is 0.03-0.3 % of a PSF.
    """
    radius = relief.corner_m / plan.grid.pitch_m
    bias = effective_bias(relief) / plan.grid.pitch_m
    # Openings that touch at a corner: rounding takes from both what it gives to both gaps, unless the bias has clearly
    # joined or parted them.
    apart = jnp.clip(2 * jnp.abs(bias) / jnp.maximum(radius, 1e-6), 0.0, 1.0)
    shared = _shared_corners(along_y, along_x, bias, radius)
    step = _CORNER_MIDDLE * radius

    viewpoints: Any = tuple(np.indices((plan.masks, 2, 2, 2)).reshape(4, -1))
    mask, opening, side_y, side_x = viewpoints
    beside = jax.vmap(_beside, (None, 0, 0, 0, 0, None))
    y, row, *below_y = beside(along_y, mask, side_y, opening, bias[mask], step)
    x, column, *below_x = beside(along_x, mask, side_x, opening, bias[mask], step)

    def seen_from(viewpoint: tuple[Sequence[Array], ...]) -> Array:
        """Amount `[y, x]` of a mask's odd openings (or gaps) seen from one side."""
        (k, opening, side_y, side_x), (low_y, outer_y), (low_x, outer_x) = viewpoint
        own, other_y, other_x, far = (
            share_of(is_open, k, low_y + (side_y ^ dy), low_x + (side_x ^ dx))
            for dy, dx in ((0, 0), (1, 0), (0, 1), (1, 1))
        )
        around = [share_of(is_open, k, outer_y + dy, outer_x + dx) for dy, dx in ((0, 0), (2, 2), (0, 2), (2, 0))]
        touching = (around[0] == around[1]) & (around[2] == around[3]) & (around[0] != around[2])
        odd = (own == opening) & (own != other_y) & (own != other_x) & (own != far)
        return odd * jnp.where(touching, apart[k], 1.0)

    # Where a mask's etch is missing from an opening, or added to a gap, by what the light changes: factor - 1.
    phase = 2 * jnp.pi * jnp.array([-1, 1])[:, None] * rates * relief.depth_m[:, None, None]
    turns = jnp.stack([jnp.cos(phase) - 1, jnp.sin(phase)], axis=2)  # [mask, opening, 2, w]

    # Loops, because their results exist: fused into what follows, they would be computed again for every colour.
    amounts = jax.lax.map(seen_from, (viewpoints, below_y, below_x))
    amounts = amounts.reshape(len(amounts), -1)
    each = row * along_x.state.shape[1] + column, amounts, turns[mask, opening]
    gained = Pair(*jax.lax.map(lambda at: _gain(*at[1:]).times(Pair(*light[at[0]])), each))
    points = point_moments(axis_values(y, plan.parts), axis_values(x, plan.parts))

    def total(real: Array, imaginary: Array) -> tuple[Array, Array]:
        return summed(points, real, kept=2), summed(points, imaginary, kept=2)

    alone = jnp.max(jnp.tril(shared, -1)) < _ALONE
    changed = jax.lax.cond(
        alone, lambda: total(*gained), lambda: total(*_in_common(gained, amounts, turns, shared, plan.masks))
    )
    return (1 - np.pi / 4) * radius**2 * jnp.stack(changed, axis=1)


def _gain(amount: Float[Array, "... c"], turn: Float[Array, "2 w"]) -> Pair:
    return Pair(turn[0, :, None] * amount, turn[1, :, None] * amount)


def _in_common(
    gained: Pair,
    amounts: Float[Array, "seen c"],
    turns: Float[Array, "mask opening 2 w"],
    shared: Float[Array, "mask mask"],
    masks: int,
) -> Pair:
    """Light that masks gain, `[seen, w, c]`, where an earlier one with a corner in common changes what they find."""
    own = Pair(*(part.reshape(masks, 2, 4, *part.shape[1:]) for part in gained))
    found = amounts.reshape(masks, 2, 4, 1, -1)

    def after(gained: Pair, earlier: tuple[Array, ...]) -> tuple[Pair, None]:
        amount, turn, share = earlier
        # On one side a cell has an odd opening or an odd gap of a mask, not both.
        gaps, openings = (_gain(amount[o], turn[o]) for o in (0, 1))
        return gained.plus(gained.times(gaps.plus(openings)), share), None

    each = [
        jax.lax.scan(after, Pair(own.real[k], own.imaginary[k]), (found[:k], turns[:k], shared[k, :k]))[0]
        for k in range(masks)
    ]
    return Pair(*(jnp.stack(parts).reshape(gained.real.shape) for parts in zip(*each, strict=True)))


def _beside(
    along: Cuts, mask: Array, side: Array, opening: Array, bias: Array, step: Array
) -> tuple[Array, Array, Array, Array]:
    """The point `step` to one side (0 or 1) of a mask's line, in the cell where it lies, and the segment there.

    An opening above its line (or a gap below it) begins at shift - bias, all others at shift + bias. The last two are
    the states (`mask_states`) of the mask below that line and below both lines.
    """
    upper = (side != opening) ^ (bias < 0)
    rank = along.line[mask]
    line = jnp.where(upper, rank[1], rank[0])
    second = (line == rank.max()).astype(jnp.int32)
    at = along.edges[1 + line] + (2 * side - 1) * step
    cell = jnp.floor(at).astype(jnp.int32)
    at = at - cell
    # A binary search would be a loop of its own for every viewpoint.
    segment = jnp.searchsorted(along.edges, at, side="right", method="compare_all") - 1
    segment = jnp.clip(segment, 0, along.state.shape[1] - 1)
    below_both = -2 * cell
    return at, segment, below_both + second, below_both


def _shared_corners(along_y: Cuts, along_x: Cuts, bias: Array, radius: Array) -> Float[Array, "mask mask"]:
    """How much of the area at a corner two masks change together, 1 where their edges coincide."""

    def apart(along: Cuts) -> Array:
        # From the lower line: modulo one cell, the upper one may lie below it.
        middle = along.edges[1 + along.line[:, 0]] + jnp.abs(bias)
        gap = middle[:, None] - middle[None, :]
        return gap - jnp.round(gap)

    squared = apart(along_y) ** 2 + apart(along_x) ** 2 + (bias[:, None] - bias[None, :]) ** 2
    # Fitted to rasters. The area is a hook 0.4 radii deep; apart by less than that, each mask still cuts the other's.
    return jnp.exp(-squared / jnp.maximum((0.3 * radius) ** 2, 1e-12))
