"""The transmission of a whole plate, tile by tile: each spills some of its light over to its neighbours."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, UInt8

from sim.surface.cell import REACH
from sim.surface.opening import Opening
from sim.surface.pieces import TILE
from sim.surface.relief import EtchParameters, TilePlan
from sim.surface.tile_light import kinds_across, strip_values, tile_moments, tile_rows
from sim.threads import at_once
from sim.tracing import compiled_quickly, in_jit, is_traced

# Rows of tiles that are computed together. Where two such parts meet, light is summed in another order, so that as many
# as there are cores would give other bytes on other machines.
_ROWS = 8


class CellMaps(NamedTuple):
    """All that differs from cell to cell of a plate, numpy's arrays or jax's.

    Attributes:
        etched: etches of every cell, one bit each.
        widths: of openings, in cells, where etches lag.
        rough_m: height of the roughness.
        coverage: open share of every part of a cell.
    """

    etched: UInt8[Any, "y x"]
    widths: UInt8[Any, "mask y x"] | None
    rough_m: Float[Any, "y x"] | None
    coverage: Float[Any, "v u"]

    def of_tiles(self, plan: TilePlan, first: int, count: int) -> "CellMaps":
        """So many rows of whole tiles from a first one, with a halo of blank glass; dark beyond the plate."""
        across = _tiles_along(plan)[1]

        def cut(of: Any, parts: int = 1, before: int = 0, after: int = 0) -> Any:
            if of is None:
                return None
            size, (ny, nx) = TILE * parts, of.shape[-2:]
            start, stop = first * size - before, (first + count) * size + after
            top, bottom, right = max(-start, 0), max(stop - ny, 0), across * size + after - nx
            rows = of[..., start + top : stop - bottom, :]
            pad = jnp.pad if isinstance(of, jax.Array) else np.pad
            return pad(rows, [*[(0, 0)] * (of.ndim - 2), (top, bottom), (before, right)])

        # One pixel more on the upper side: corners of a cell are seen from up to two cells above it, but one below.
        halo = {"before": plan.reach, "after": plan.reach + 1}
        coverage = cut(self.coverage, plan.parts)
        return CellMaps(cut(self.etched, **halo), cut(self.widths, **halo), cut(self.rough_m), coverage)


def _tiles_along(plan: TilePlan) -> tuple[int, int]:
    """Tiles along y and x."""
    ny, nx = plan.grid.shape
    return -(-ny // TILE), -(-nx // TILE)


def _reach(plan: TilePlan) -> int:
    """Parts of cells to either side of one with which it shares its light."""
    return REACH if plan.cut else 0


def transmission_of(
    plan: TilePlan,
    along: tuple[Any, Any],
    maps: CellMaps,
    relief: EtchParameters,
    rates: Any,
    left: Any,
    opening: Opening,
) -> tuple[Complex[Array, "view v u"], Complex[Array, "w v u"]]:
    """Transmission of every cell, tile by tile, with the far field of plate and chrome in every view; means without.

    Rows of tiles are computed side by side (`sim.threads`), except in a trace.

    Args:
        plan: what is compiled.
        along: the `view_weights` along y and x, numpy's.
        maps: of the cells.
        relief: the errors as numbers, numpy's or jax's, like the rest.
        rates: waves per metre of height of every wavelength.
        left: amplitude that roughness finer than a cell leaves of each.
        opening: that of the chrome.
    """
    (weights_y, weights_x), (count, _), numbers = along, _tiles_along(plan), (relief, rates, left, opening)
    if is_traced(maps, *numbers) or in_jit():
        return _compiled(plan, weights_y, weights_x, maps, *numbers)
    rows_of, long = _compiled_quickly(), min(_ROWS, count)
    weights_x = jnp.asarray(weights_x)  # once for all rows
    maps = jax.tree.map(np.asarray, maps)
    plate = _Plate.empty(plan, len(rates))

    def part(first: int) -> tuple[int, Any]:
        own = weights_y[np.minimum(np.arange(first, first + long), count - 1)]
        rows = rows_of(plan, np.int32(first), own, weights_x, maps.of_tiles(plan, first, long), *numbers)
        light, spilt, means = jax.tree.map(np.asarray, rows)
        plate.put(first, light, means)
        return first + long, spilt

    # What a part spills is added where the next has been put.
    for last, spilt in list(at_once(part, range(0, count, long))):
        plate.add(last, spilt)
    return jnp.asarray(plate.light), jnp.asarray(plate.means)


class _Plate(NamedTuple):
    """All rows of tiles together, without what is beyond the plate; filled in place."""

    plan: TilePlan
    light: Complex[np.ndarray, "view v u"]
    means: Complex[np.ndarray, "w v u"]

    @classmethod
    def empty(cls, plan: TilePlan, wavelengths: int) -> "_Plate":
        """Without any light."""
        shape = [n * plan.parts for n in plan.grid.shape]
        light, means = (np.zeros((count, *shape), np.complex64) for count in (len(plan.views), wavelengths))
        return cls(plan, light, means)

    def put(self, first: int, light: list[Complex[np.ndarray, "v u"]], means: Complex[np.ndarray, "w v x"]) -> None:
        """Rows of tiles from a first one."""
        for whole, blocks, reach in ((self.light, light, _reach(self.plan)), (self.means, means, 0)):
            for own, block in zip(whole, blocks, strict=True):
                within, found = self._overlap(own, block, first, reach)
                within[...] = found

    def add(self, first: int, light: list[Complex[np.ndarray, "v u"]]) -> None:
        """Light that is spilt about the upper border of a row of tiles."""
        for own, block in zip(self.light, light, strict=True):
            within, found = self._overlap(own, block, first, _reach(self.plan))
            within += found

    def _overlap(self, whole: np.ndarray, block: np.ndarray, first: int, reach: int) -> tuple[np.ndarray, np.ndarray]:
        """The part of a block that lies on the plate, and where it does; it reaches beyond its first row and column."""
        start = first * TILE * self.plan.parts - reach
        stop = max(min(start + len(block), len(whole)), start, 0)
        within = whole[max(start, 0) : stop]
        return within, block[max(start, 0) - start : stop - start, reach : reach + whole.shape[1]]


def _rows_of_tiles(
    plan: TilePlan,
    first: Any,
    weights_y: Float[Array, "strip view kind in s out wide"],
    weights_x: Float[Array, "tile_x view kind in s out wide"],
    maps: CellMaps,
    relief: EtchParameters,
    rates: Float[Array, " w"],
    left: Float[Array, " w"],
    opening: Opening,
) -> tuple[list[Complex[Array, "tall u"]], list[Complex[Array, "spilt u"]], Complex[Array, "w v x"]]:
    """Rows of tiles that follow each other from a first one: light in every view, and means.

    Light begins `REACH` parts of cells above the first row and before the first column, and goes on for as many beyond
    the last ones; what is beyond the last row is apart.
    """
    reach, across = _reach(plan), _tiles_along(plan)[1]

    def tile(start_y: Array, start_x: Array, along_x: Array) -> tuple[Any, Array]:
        side = TILE + 2 * plan.reach + 1
        bits = jax.lax.dynamic_slice(maps.etched, (start_y, start_x), (side, side))
        masks = (bits[None] >> jnp.arange(plan.masks, dtype=jnp.uint8)[:, None, None]) & 1
        states = masks.astype(jnp.float32)
        if maps.widths is not None:
            width = jax.lax.dynamic_slice(maps.widths, (0, start_y, start_x), states.shape).astype(jnp.float32)
            lost = relief.lag * relief.depth_m[:, None, None] / (jnp.maximum(width, 1.0) * plan.grid.pitch_m)
            states = states * jnp.clip(1.0 - lost, 0.0, 1.0)
        rough = maps.rough_m
        bump = None if rough is None else jax.lax.dynamic_slice(rough, (start_y, start_x), (TILE, TILE))
        start = first * TILE + start_y, start_x
        moments, lines, means = tile_moments(
            states, relief, bump, open_at(start_y, start_x), opening, start, rates, plan
        )
        moments, lines = (part * left[:, None, None] for part in (moments, lines))
        return tile_rows(moments, lines, along_x, plan), means * left[:, None, None, None]

    def open_at(start_y: Array, start_x: Array) -> Array:
        corner, size = (start_y * plan.parts, start_x * plan.parts), TILE * plan.parts
        return jax.lax.dynamic_slice(maps.coverage, corner, (size, size))

    @jax.checkpoint
    def lit_tile(start_y: Array, number: Array) -> tuple[Any, Array]:
        """Nothing under the chrome, where a fifth of the tiles of a square around a circle lie, and beyond the last."""
        at = start_y, number * TILE, weights_x[jnp.minimum(number, across - 1)]
        lit = (number < across) & jnp.any(open_at(*at[:2]) > 0)
        dark = jax.tree.map(lambda part: jnp.zeros(part.shape, part.dtype), jax.eval_shape(tile, *at))
        return jax.lax.cond(lit, lambda: tile(*at), lambda: dark)

    def strip(place: tuple[Array, Array]) -> tuple[list[Array], Array]:
        start_y, along_y = place
        # One tile more takes what the last one spills.
        numbers = jnp.arange(across + 1 if reach else across)
        (rows, means), _ = _in_turn(lambda number: lit_tile(start_y, number), numbers, reach, -1)
        laid = [[_laid(row) for row in own] for own in rows]
        if not plan.cut:
            return [plain for (plain,) in laid], _laid(means)
        kinds = [kinds_across(most, plan) for _, most in plan.views]
        return [strip_values(*of) for of in zip(laid, along_y, kinds, strict=True)], _laid(means)

    starts = jnp.arange(len(weights_y)) * TILE
    (light, means), spilt = _in_turn(strip, (starts, weights_y), reach, -2)
    return [_complex(_stacked(of)) for of in light], [_complex(of) for of in spilt], _complex(_stacked(means))


def _in_turn(
    block_of: Callable[[Any], tuple[Any, Any]], places: Any, reach: int, axis: int
) -> tuple[tuple[Any, Any], Any]:
    """Blocks of light that follow each other along an axis, with others that do not spill; and what the last spill.

    Each reaches so far beyond both of its ends, and what overlaps is added. So each that is returned begins where its
    own part does, less that reach.
    """

    def cut(one: Array, start: int, stop: int) -> Array:
        return jax.lax.slice_in_dim(one, start, stop, axis=axis)

    def joined(one: Array, before: Array) -> Array:
        behind = [(0, 0)] * one.ndim
        behind[axis] = (0, one.shape[axis] - 2 * reach)
        return one + jnp.pad(before, behind)

    def put(spilt: Any, place: Any) -> tuple[Any, tuple[Any, Any]]:
        light, others = block_of(place)
        light = jax.tree.map(joined, light, spilt)
        done = jax.tree.map(lambda one: cut(one, 0, one.shape[axis] - 2 * reach), light)
        return jax.tree.map(lambda one: cut(one, one.shape[axis] - 2 * reach, one.shape[axis]), light), (done, others)

    light, _ = jax.eval_shape(block_of, jax.tree.map(lambda of: of[0], places))
    none = jax.tree.map(lambda one: cut(jnp.zeros(one.shape, one.dtype), 0, 2 * reach), light)
    spilt, done = jax.lax.scan(put, none, places)
    return done, spilt


def _laid(blocks: Float[Array, "n *any s t"]) -> Float[Array, "*any s nt"]:
    """Blocks side by side."""
    moved = jnp.moveaxis(blocks, 0, -2)
    return moved.reshape(*moved.shape[:-2], -1)


def _stacked(blocks: Float[Array, "n *any s t"]) -> Float[Array, "*any ns t"]:
    """Blocks one below the other."""
    moved = jnp.moveaxis(blocks, 0, -3)
    return moved.reshape(*moved.shape[:-3], -1, moved.shape[-1])


def _complex(parts: Float[Array, "*any 2 v u"]) -> Complex[Array, "*any v u"]:
    return jax.lax.complex(parts[..., 0, :, :], parts[..., 1, :, :])


def _transmission(
    plan: TilePlan, weights_y: Array, weights_x: Array, maps: CellMaps, *numbers: Any
) -> tuple[Complex[Array, "view v u"], Complex[Array, "w v u"]]:
    rows = maps.of_tiles(plan, 0, _tiles_along(plan)[0])
    light, spilt, means = _rows_of_tiles(plan, 0, weights_y, weights_x, rows, *numbers)
    reach, (height, width) = _reach(plan), (n * plan.parts for n in plan.grid.shape)
    whole = [jnp.concatenate(both)[reach:, reach:][:height, :width] for both in zip(light, spilt, strict=True)]
    return jnp.stack(whole), means[:, :height, :width]


_compiled = jax.jit(_transmission, static_argnames=("plan",))


@lru_cache(maxsize=1)
def _compiled_quickly() -> Callable[..., Any]:
    """Rows of tiles, which a trace cannot hold: the same but for the last bit, compiled in two thirds of the time."""
    return jax.jit(_rows_of_tiles, static_argnames=("plan",), compiler_options=compiled_quickly())
