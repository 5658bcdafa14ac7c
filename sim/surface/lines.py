"""Lines of light along the walls of a plate whose masks lie off.

A wall adds a line of light to that of thin cells (`sim.rigorous.edge_widths`), and every mask has its own wall at the
border between two cells: where the mask lies, and moved by half of what its openings grew. Up to `masks` walls stand
side by side there. Each passes the light of the glass on its lower side, in the order in which they stand.

Light spreads as it passes the depth of the relief, so walls near to each other share some. In one place two walls are
one of their joint height; what its light has beyond that of both alone is what they share, and of it `shared_light` is
left where they stand apart: light that crosses both as diffraction spreads it over the depth between, over that in one
place, to second order in the phase of the relief. Nothing is fitted. Against rigorous solutions of 50 rows of random
cells, masks off by up to 0.5 um and openings wider or narrower by up to 0.2 um, both polarisations, at 552 nm and half
of them at 450 and 656 nm, the sum over walls leaves 0.8 to 1.1 % of the orders (root mean square; 2.4 % at most), walls
that share nothing 4.1 to 5.7 %, a thin element 9 to 11 %.

A line is described by its moments about the border, across it and along it, as a cell is by those of the cell
(`sim.surface.cell`); its dipole by the first of these. Where borders of both axes meet is the light of a corner
(`sim.rigorous.corner_light`), that of the four cells as if their masks lay together, at the mean of where these do.

The walls of such rows are alike all along. Where masks lie off along both axes, some are in the next row of cells
already where others are not, which the lines of a row do not know: against wave propagation through 25 random squares,
masks off by up to 0.1, 0.3 and 0.5 um along both axes, 5, 10 and 15 % of the light of walls and corners are missed (the
0th order at 552 nm, root mean square; 6, 11 and 14 % without corners; 1 and 5 % where the masks lie together).
"""

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from numpy.polynomial.chebyshev import chebfit, chebpts1
from scipy.special import factorial, rgamma

from sim.camera import Camera
from sim.material import refractive_index
from sim.rigorous.corner_light import CornerCell, corner_light, corner_unit
from sim.rigorous.edge_widths import series_at
from sim.rigorous.width_tables import edge_table
from sim.surface.cell import DIPOLE, LINE_DEGREE
from sim.surface.pieces import TILE, Pair, light_of
from sim.surface.relief import EtchParameters, TilePlan, effective_bias

# Moments kept: degree along the line and across it, and the dipole.
_DEGREES = tuple((along, across) for along in range(LINE_DEGREE + 1) for across in range(LINE_DEGREE + 1 - along))
LINE_KINDS = (*_DEGREES, (0, DIPOLE))
_FARTHEST, _SHARED_TERMS = 3.0, 10  # of `shared_light`: 0.2 % is left there; terms leave 0.1 %


class WallNumbers(NamedTuple):
    """Light of walls across y and across x over that of the lower side (`sim.rigorous.width_tables.edge_table`)."""

    width: Float[np.ndarray, "axis part w term"]  # series, over the pitch
    dipole: Float[np.ndarray, "axis part w 4"]  # over the pitch squared
    foot: Float[np.ndarray, " w"]  # dipole per height of the foot and step of the light, over i and the pitch squared
    apart: Float[np.ndarray, " w"]  # a cell over sqrt(highest wavelength / pi)
    highest_m: np.float32
    corner: Float[np.ndarray, " w"]  # unit of the light of corners, over the pitch squared


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
    apart = pitch * np.sqrt(np.pi / (highest_m * np.array(wavelengths_m)))
    corner = np.array([corner_unit(*of) for of in zip(wavelengths_m, index, strict=True)]) / pitch**2
    foot, apart, corner = (of.astype(np.float32) for of in (foot, apart, corner))
    return WallNumbers(parts(width), parts(dipole), foot, apart, np.float32(highest_m), corner)


def shared_light(distance: Any) -> tuple[Any, Any]:
    """Part of the light shared by two walls of one height that is left where they stand apart.

    Their light spreads by diffraction. To second order in the phase, what crosses both is an integral of
    (height - z) f(z) over the depth z between the crossings, f(z) = E[max(x - d, 0)] for walls at a distance d and x of
    the normal distribution of variance i z wavelength / (2 pi). Over its value at d = 0 that is the fifth repeated
    integral of the complementary error function (Abramowitz and Stegun, 7.2), over its own at 0, at exp(-i pi / 4)
    times the distance in the units below. Light is taken to spread as in air: as in glass fits a little worse.

    Args:
        distance: of the walls over sqrt(height wavelength / pi); not negative. Beyond 3, 0.2 % stand for less.

    Returns:
        real and imaginary part, 1 and 0 where the walls are one, to 0.001.
    """
    place = jnp.minimum(distance, _FARTHEST) * (2 / _FARTHEST) - 1
    real, imaginary = (series_at(series, place) for series in _shared_series())
    return real, imaginary


@lru_cache(maxsize=1)
def _shared_series() -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Chebyshev series of real and imaginary part, from the power series of the integral."""
    k, place = np.arange(90), chebpts1(64)
    of = (-2.0) ** k * rgamma(3.5 - k / 2) / (factorial(k) * rgamma(3.5))
    exact = (np.exp(-0.25j * np.pi) * _FARTHEST / 2 * (place[:, None] + 1)) ** k @ of
    series = chebfit(place, exact, _SHARED_TERMS - 1)
    return tuple(np.real(series).tolist()), tuple(np.imag(series).tolist())


def line_moments(
    states: Float[Array, "mask side side"],
    uniform: Float[Array, " cell"],
    bump: Float[Array, " cell"] | float,
    shift: Float[Array, "mask axis"],
    relief: EtchParameters,
    rates: Float[Array, " w"],
    plan: TilePlan,
) -> Float[Array, "3 kind 2 w cell"]:
    """Moments of the lines at the lower borders of a tile's cells, across y and across x, for `LINE_KINDS`.

    Then those of the points where these borders meet, as parts of lines across y that are no longer than they.

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
        at, rise, along = _sorted(at, rise, along)
        heights = jnp.concatenate([height[None], height + jnp.cumsum(rise, 0)])
        (before_m, behind_m), (before, behind) = _ends(heights, 1), _ends(light_of(heights, rates), 1)
        sides = _Side(before_m, before), _Side(behind_m, behind)
        first, last = (_Wall(*of) for of in zip(*(_ends(of, 1) for of in (heights[:-1], heights[1:], at)), strict=True))
        # Loops keep the compiler from computing their values anew wherever one is read.
        joined = jax.lax.map(lambda of: _as_one_wall(of[0], of[1], axis, relief), sides)
        left = jax.lax.map(lambda of: _left(of[0], of[1], numbers), (first, last))
        line, dipole = (_shared(one, left, plan.masks) for one in joined)
        # What several share is in the middle between the first and the last.
        middle_along, middle = (jnp.add(*_ends(of, 0)) * (plan.parts / 2) for of in (along, at))
        return _moments(line, dipole, middle_along, middle, plan.parts)

    def points() -> Array:
        def pixels(mask: Array) -> Array:
            start = plan.reach - 1 - whole[mask]
            return jax.lax.dynamic_slice(states, (mask, start[0], start[1]), (1, TILE + 1, TILE + 1))[0]

        seen = jax.lax.map(pixels, jnp.arange(plan.masks))
        near, rough = (_with_one_before(jnp.asarray(of)) if jnp.ndim(of) else of for of in (uniform, bump))
        height = relief.height_m + rough - jnp.tensordot(relief.depth_m, seen, 1) * near
        light = jax.lax.map(lambda rate: light_of(height.reshape(1, -1), rate[None])[0, :, 0], rates)
        light = light.reshape(-1, 2, TILE + 1, TILE + 1)

        def cell(y: int, x: int) -> CornerCell:
            def own(of: Array) -> Array:
                return of[..., y : y + TILE, x : x + TILE].reshape(*of.shape[:-2], -1)

            return CornerCell(2 * np.pi * rates[:, None] * own(height), own(light[:, 0]), own(light[:, 1]))

        found = corner_light((cell(0, 0), cell(0, 1), cell(1, 0), cell(1, 1)))
        real, imaginary = (part * numbers.corner[:, None] * plan.parts**2 for part in found)
        # Where no mask took anything, anywhere will do.
        at, along = jnp.dot(relief.depth_m, place) / jnp.maximum(jnp.sum(relief.depth_m), 1e-12) * plan.parts
        displaced = (jnp.ones(()), 2 * along - 1, 6 * along * (along - 1) + 1)  # Legendre polynomials, from -1/2 on
        factors = jnp.stack([*(displaced[a] * at**b for a, b in _DEGREES), jnp.zeros(())])
        return factors[:, None, None, None] * jnp.stack([real, imaginary])

    return jnp.stack([across(0), across(1), points()])


def _with_one_before(of: Float[Array, " cell"]) -> Float[Array, "side side"]:
    """A tile with a row and a column before it that are like its first."""
    return jnp.pad(of.reshape(TILE, TILE), ((1, 0), (1, 0)), mode="edge")


def _ends(of: Float[Array, "n ..."], fewest: int) -> tuple[Float[Array, "group ..."], Float[Array, "group ..."]]:
    """Values at either end of all groups of neighbours that are so many places apart: at first the fewest, then more.

    Groups of walls, from one on, are those of the heights between them, from two on.
    """
    apart = range(fewest, len(of))
    first, last = [of[: len(of) - count] for count in apart], [of[count:] for count in apart]
    return (jnp.concatenate(first), jnp.concatenate(last)) if apart else (of[:0], of[:0])


class _Side(NamedTuple):
    """Glass on one side of a wall."""

    height_m: Array  # `[cell]`
    light: Array  # `[2, w, cell]`


class _Wall(NamedTuple):
    """Heights before and behind a wall, and its place across the border in cells, `[cell]` each."""

    before_m: Array
    behind_m: Array
    at: Array


def _as_one_wall(before: _Side, behind: _Side, axis: int, relief: EtchParameters) -> tuple[Pair, Pair]:
    """Line and dipole, `[w, cell]` each, of a wall between two sides."""
    assert relief.walls is not None
    numbers, rise = relief.walls, behind.height_m - before.height_m
    rises, foot_m = rise > 0, jnp.minimum(before.height_m, behind.height_m)
    # Beyond the highest wall the series know nothing: it counts as that one, as in plates as drawn.
    rise = jnp.clip(rise, -numbers.highest_m, numbers.highest_m)
    height = jnp.abs(rise)
    lower, higher = (
        Pair(*(jnp.where(rises, one[part], other[part]) for part in (0, 1)))
        for one, other in ((before.light, behind.light), (behind.light, before.light))
    )
    size = height / numbers.highest_m
    terms = jnp.moveaxis(numbers.width[axis], -1, 0)[..., None]  # [term, part, w, 1]
    width = Pair(*(series_at(terms[:, part], 2 * size - 1) * size for part in (0, 1)))
    a, b, c, d = (Pair(*of) for of in jnp.moveaxis(numbers.dipole[axis], -1, 0)[..., None])  # [w, 1]
    near, far = (Pair(*(rise * (one + height * two) for one, two in zip(*of, strict=True))) for of in ((a, b), (c, d)))
    # Light is told halfway up the relief.
    step = Pair(jnp.zeros_like(rise), jnp.sign(rise) * numbers.foot[:, None] * (foot_m - relief.height_m / 2))
    return lower.times(width), lower.times(near.plus(step, -1.0)).plus(higher.times(far.plus(step)))


def _left(first: _Wall, last: _Wall, numbers: WallNumbers) -> Pair:
    """Part of the light that two walls share that is left, `[w, cell]`."""
    a, b, c, d = (of / numbers.highest_m for of in (*first[:2], *last[:2]))

    def power(depth: Array) -> Array:
        depth = jnp.abs(depth)
        return depth**2 * jnp.sqrt(depth + 1e-9)  # 5 / 2, with a slope at 0

    # The mean root of the depth between two layers, over that of a layer within itself: 8 / 15 of its height's root.
    sums = power(d - a) + power(c - b) - power(d - b) - power(c - a)
    root = jnp.maximum(jnp.abs(sums), 1e-12) / 2
    return Pair(*shared_light((last.at - first.at) * jnp.abs((b - a) * (d - c)) / root * numbers.apart[:, None]))


def _shared(whole: Pair, left: Pair, walls: int) -> Pair:
    """Light of single walls, and what is left of that which groups share beyond any smaller ones."""

    def beyond(whole: Array) -> tuple[Array, Array]:
        sizes = np.arange(walls, 0, -1)
        single, *several = jnp.split(whole, np.cumsum(sizes)[:-1])
        smaller, shared = [jnp.zeros_like(whole[: walls + 1]), single], []
        for one in several:
            shared.append(one - smaller[-1][:-1] - smaller[-1][1:] + smaller[-2][1:-1])
            smaller.append(one)
        return single, jnp.concatenate([single[:0], *shared])

    single, several = zip(*(beyond(part) for part in whole), strict=True)
    kept = Pair(*several).times(left)
    return Pair(*(jnp.concatenate(of) for of in zip(single, kept, strict=True)))


def _moments(
    line: Pair, dipole: Pair, along: Float[Array, "group cell"], at: Float[Array, "group cell"], parts: int
) -> Float[Array, "kind 2 w cell"]:
    """Sums over groups of the moments of lines and dipoles that are displaced along the border and across it."""

    def add(total: list[Pair], group: tuple[Pair, Pair, Array, Array]) -> tuple[list[Pair], None]:
        line, dipole, along, at = group
        displaced = (1.0, 2 * along, 6 * along**2)  # Legendre polynomials over a line
        lines = [one.plus(line, parts * displaced[a] * at**b) for one, (a, b) in zip(total, _DEGREES, strict=False)]
        return [*lines, total[-1].plus(dipole, parts**2)], None

    none = jnp.zeros_like(line.real[0])
    total, _ = jax.lax.scan(add, [Pair(none, none) for _ in LINE_KINDS], (line, dipole, along, at))
    return jnp.stack([jnp.stack(one) for one in total])


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
