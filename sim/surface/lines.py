"""Lines of light along the walls of a plate whose masks lie off.

A wall adds a line of light to that of thin cells (`sim.rigorous.edge_widths`), and every mask has its own wall at the
border between two cells: where the mask lies, and moved by half of what its openings grew. Up to `masks` walls stand
side by side there. Each passes the light of the glass on its lower side, in the order in which they stand.

Two walls much nearer to each other than a wavelength act as one of their joint height; far apart each acts for itself.
Solved rigorously, rows of random cells change from one to the other where walls are about 60 nm apart: of a wall's
height, the share exp(-(distance / 60 nm)²) is handed on to the next wall. Masks off by up to 0.7 um at random, that is
right to 2.7 % of the orders (root mean square), where a thin element misses 7 to 18 %.

A line is described by its moments about the border, across it and along it, as a cell is by those of the cell
(`sim.surface.cell`); its dipole by the first of these.
"""

from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from sim.camera import Camera
from sim.material import refractive_index
from sim.rigorous.edge_widths import series_at
from sim.rigorous.width_tables import edge_table
from sim.surface.cell import DIPOLE, LINE_DEGREE
from sim.surface.pieces import TILE, Pair, light_of
from sim.surface.relief import EtchParameters, TilePlan, effective_bias

# Moments kept: degree along the line and across it, and the dipole.
_DEGREES = tuple((along, across) for along in range(LINE_DEGREE + 1) for across in range(LINE_DEGREE + 1 - along))
LINE_KINDS = (*_DEGREES, (0, DIPOLE))
_TOGETHER_M = 60e-9  # distance at which walls act together


class WallNumbers(NamedTuple):
    """Light of walls across y and across x over that of the lower side (`sim.rigorous.width_tables.edge_table`)."""

    width: Float[np.ndarray, "axis part w term"]  # series, over the pitch
    dipole: Float[np.ndarray, "axis part w 4"]  # over the pitch squared
    foot: Float[np.ndarray, " w"]  # dipole per height of the foot and step of the light, over i and the pitch squared
    highest_m: np.float32


@lru_cache(maxsize=16)
def wall_numbers(camera: Camera, wavelengths_m: tuple[float, ...], highest_m: float) -> WallNumbers:
    """Light of all walls up to a highest."""
    index = [refractive_index(camera.material, wavelength) for wavelength in wavelengths_m]
    found = [
        edge_table(highest_m, *of, camera.polarisation, axis)
        for axis in ("y", "x")
        for of in zip(wavelengths_m, index, strict=True)
    ]
    terms, pitch = max(len(one.width_m) for one in found), camera.grid.pitch_m
    width = np.array([np.pad(one.width_m, (0, terms - len(one.width_m))) for one in found]) / pitch
    dipole = np.array([one.dipole for one in found]) / pitch**2

    def parts(values: Complex[np.ndarray, "n m"]) -> Float[np.ndarray, "axis part w m"]:
        values = values.reshape(2, len(wavelengths_m), -1)
        return np.stack([np.real(values), np.imag(values)], 1).astype(np.float32)

    foot = np.array(wavelengths_m) / np.array(index) / (4 * np.pi * pitch**2)
    return WallNumbers(parts(width), parts(dipole), foot.astype(np.float32), np.float32(highest_m))


class _Wall(NamedTuple):
    """A wall that the next may still join, `[cell]` each: what is left of its height, its place, and the glass."""

    rise_m: Array
    across: Array  # place across the border, cells
    along: Array  # displacement along itself, cells
    height_m: Array  # of the glass behind it


def line_moments(
    states: Float[Array, "mask side side"],
    uniform: Float[Array, " cell"],
    bump: Float[Array, " cell"] | float,
    shift: Float[Array, "mask axis"],
    relief: EtchParameters,
    rates: Float[Array, " w"],
    plan: TilePlan,
) -> Float[Array, "axis kind 2 w cell"]:
    """Moments of the lines at the lower borders of a tile's cells, across y and across x, for `LINE_KINDS`.

    Args:
        states: open share of every mask's pixels, with a halo.
        uniform: depth of etches over the nominal.
        bump: height of the roughness.
        shift: displacement of every mask (y, x), cells.
        relief: errors and depths.
        rates: waves per metre of height.
        plan: of the tile.
    """
    pitch, whole = plan.grid.pitch_m, jnp.round(shift).astype(jnp.int32)
    place, bias = shift - whole, effective_bias(relief) / pitch
    assert relief.walls is not None
    numbers = relief.walls

    def across(axis: int) -> Array:
        def pixels(mask: Array) -> Array:
            start = plan.reach - whole[mask] - jnp.array([1 - axis, axis])
            size = (1, TILE + 1 - axis, TILE + axis)
            return jax.lax.dynamic_slice(states, (mask, start[0], start[1]), size)[0]

        seen = jax.lax.map(pixels, jnp.arange(plan.masks))
        before, behind = (
            jax.lax.slice_in_dim(seen, start, start + TILE, axis=1 + axis).reshape(plan.masks, -1) for start in (0, 1)
        )
        opens = behind - before
        height = relief.height_m + bump - jnp.tensordot(relief.depth_m, before, 1) * uniform
        # The lower side of an opening moves down as it grows.
        at = place[:, axis, None] - bias[:, None] * jnp.sign(opens)
        rise, along = -relief.depth_m[:, None] * opens * uniform, jnp.broadcast_to(place[:, 1 - axis, None], at.shape)
        walls = _sorted(at, rise, along)

        def light(wall: _Wall) -> tuple[Array, Array]:
            """Line and dipole, `[2, w, cell]` each."""
            lower = wall.height_m - jnp.maximum(wall.rise_m, 0.0)
            height = jnp.abs(wall.rise_m)
            size = height / numbers.highest_m
            terms = jnp.moveaxis(numbers.width[axis], -1, 0)[..., None]  # [term, part, w, 1]
            own = Pair(*(series_at(terms, 2 * size - 1) * (size * plan.parts)))
            low, high = (Pair(*light_of(at[None], rates)[0]) for at in (lower, lower + height))
            a, b, c, d = jnp.moveaxis(numbers.dipole[axis], -1, 0)[..., None]  # [part, w, 1]
            foot = numbers.foot[:, None] * (lower - relief.height_m / 2)  # the plane is halfway up the relief
            near, far = height * (a + b * height), height * (c + d * height)
            dipole = low.times(Pair(near[0], near[1] - foot)).plus(high.times(Pair(far[0], far[1] + foot)))
            return jnp.stack(low.times(own)), jnp.stack(dipole) * (jnp.sign(wall.rise_m) * plan.parts**2)

        def moments(wall: _Wall, amount: Array | float) -> Array:
            lit, dipole = (part * amount for part in light(wall))
            along, at = wall.along * plan.parts, wall.across * plan.parts
            # Of the Legendre polynomials over a wall that is displaced as a whole.
            displaced = (1.0, 2 * along, 6 * along**2)
            return jnp.stack([*(lit * (displaced[a] * at**b) for a, b in _DEGREES), dipole])

        def meet(last: tuple[_Wall, Array], next_wall: tuple[Array, ...]) -> tuple[tuple[_Wall, Array], None]:
            (wall, total), (at, rise, along) = last, next_wall
            stands = rise != 0
            joint = jnp.exp(-(((at - wall.across) * (pitch / _TOGETHER_M)) ** 2))
            total = total + moments(wall, jnp.where(stands, 1 - joint, 0.0))
            met = _Wall(rise + joint * wall.rise_m, at, along, wall.height_m + rise)
            return (_Wall(*(jnp.where(stands, new, old) for new, old in zip(met, wall, strict=True))), total), None

        none = jnp.zeros_like(height)
        empty = jnp.zeros((len(LINE_KINDS), 2, len(rates), len(none)))
        (wall, total), _ = jax.lax.scan(meet, (_Wall(none, none, none, height), empty), walls)
        return total + moments(wall, 1.0)

    return jnp.stack([across(0), across(1)])


def _sorted(key: Float[Array, "n cell"], *others: Float[Array, "n cell"]) -> tuple[Float[Array, "n cell"], ...]:
    """Arrays in the order of the first, cell by cell: for a few values, swaps of neighbours are fastest."""
    columns = list(zip(key, *others, strict=True))
    for last in range(len(columns) - 1, 0, -1):
        for k in range(last):
            low, high = columns[k], columns[k + 1]
            swap = low[0] > high[0]
            columns[k] = tuple(jnp.where(swap, b, a) for a, b in zip(low, high, strict=True))
            columns[k + 1] = tuple(jnp.where(swap, a, b) for a, b in zip(low, high, strict=True))
    return tuple(jnp.stack(rows) for rows in zip(*columns, strict=True))
