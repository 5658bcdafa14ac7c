"""Tilted walls and rounded corners: what edges of openings do besides their place."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sim.surface.cell import Cuts, axis_moments, axis_values, plane_moments, point_moments
from sim.surface.pieces import STATES, Pair, summed, turned
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
        toward_floor = jnp.diff(lit_there, axis=0) * jnp.sign(jnp.diff(deep_there, axis=0))[:, None, None]
        owner = jnp.zeros((plan.masks, across.edges.shape[0] - 2))
        owner = owner.at[jnp.arange(plan.masks)[:, None], across.line].add(1.0)
        # A strip's share of a part of the cell is as many times larger as the part is smaller.
        points, lengths = axis_values(across.edges[1:-1], plan.parts), axis_moments(jnp.array([0.0, 1.0]), plan.parts)
        weights = plane_moments(points, lengths) if axis == 0 else plane_moments(lengths, points)
        return summed(weights, toward_floor * (owner.T @ strength.T)[:, None, :, None])

    return turned(over(along_y, along_x, 0) + over(along_x, along_y, 1))


# Where the middle of the area between a square corner and its rounding lies, along each axis, in radii.
_CORNER_MIDDLE = (1 / 2 - np.pi / 4 * (1 - 4 / (3 * np.pi))) / (1 - np.pi / 4)
_SIDE_Y, _SIDE_X = np.indices((2, 2)).reshape(2, -1)  # of a crossing: 0 below the line, 1 above


def corners(
    light: Float[Array, "p 2 w c"],
    kinds: Bool[Array, "mask j i c"],
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
    segments_x = along_x.state.shape[1]

    def seen_from_sides(mask_and_opening: tuple[Array, Array]) -> tuple[Array, Array, Array, Array]:
        """Places (y, x) and amounts `[side, cell]` of a mask's odd openings (or gaps), and the light there."""
        k, opening = mask_and_opening
        step, own_kinds = _CORNER_MIDDLE * radius, kinds[k]
        y, row, low_y, outer_y = _beside(along_y, k, _SIDE_Y, opening, bias[k], step)
        x, column, low_x, outer_x = _beside(along_x, k, _SIDE_X, opening, bias[k], step)
        own, other_y, other_x, far = (
            own_kinds[low_y + (_SIDE_Y ^ dy), low_x + (_SIDE_X ^ dx)] for dy, dx in ((0, 0), (1, 0), (0, 1), (1, 1))
        )
        around = [own_kinds[outer_y + dy, outer_x + dx] for dy, dx in ((0, 0), (2, 2), (0, 2), (2, 0))]
        touching = (around[0] == around[1]) & (around[2] == around[3]) & (around[0] != around[2])
        odd = (own == opening) & (own != other_y) & (own != other_x) & (own != far)
        return y, x, odd * jnp.where(touching, apart[k], 1.0), light[row * segments_x + column]

    # A loop, because its results exist: fused into what follows, they would be computed again for every colour.
    masks, openings = np.indices((plan.masks, 2)).reshape(2, -1)
    ys, xs, amounts, found = jax.lax.map(seen_from_sides, (masks, openings > 0))
    total, earlier = jnp.zeros(()), []
    for k in range(plan.masks):
        # What the masks before this one change on each side, and with it the light that this one finds there.
        changed = Pair(jnp.ones(()), jnp.zeros(()))
        for other, before in enumerate(earlier):
            changed = changed.plus(changed.times(before), shared[k, other])
        gains = []
        for opening in range(2):
            at = 2 * k + opening
            # Light gained where this mask's etch is missing from an opening, or added to a gap: factor - 1.
            phase = 2 * jnp.pi * (2 * opening - 1) * rates * relief.depth_m[k]
            turn = jnp.cos(phase) - 1, jnp.sin(phase)
            gain = Pair(*(part[:, None] * amounts[at][:, None] for part in turn))
            gained = changed.times(gain).times(Pair(found[at, :, 0], found[at, :, 1]))
            points = point_moments(axis_values(ys[at], plan.parts), axis_values(xs[at], plan.parts))
            total = total + jnp.stack([summed(points, part, kept=2) for part in gained], axis=1)
            gains.append(gain)
        # On one side a cell has an odd opening or an odd gap of this mask, not both.
        earlier.append(gains[0].plus(gains[1], jnp.ones(())))
    return (1 - np.pi / 4) * radius**2 * total


def _beside(
    along: Cuts, mask: Array, side: Int[np.ndarray, " side"], opening: Array, bias: Array, step: Array
) -> tuple[Array, Array, Array, Array]:
    """Points `step` to one side of a mask's lines in the cells where they lie, segments there, and indices of `STATES`.

    An opening above its line (or a gap below it) begins at shift - bias, all others at shift + bias. The indices are of
    the mask below each line and below both lines.
    """
    upper = (side != opening) ^ (bias < 0)
    rank = along.line[mask]
    line = jnp.where(upper, rank[1], rank[0])
    second = (line == rank.max()).astype(jnp.int32)
    at = along.edges[1 + line] + (2 * side - 1) * step
    cell = jnp.floor(at).astype(jnp.int32)
    at = at - cell
    segment = jnp.clip(jnp.searchsorted(along.edges, at, side="right") - 1, 0, along.state.shape[1] - 1)
    below_both = -2 * cell - STATES[0]
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
