"""From free parameters to a height map that can be drawn.

The parameters are phases at the design wavelength in radians, one per cell (free-form) or per ring (radial),
unbounded. Their height is taken modulo the full staircase, L steps, which is close to one wave there. Every colour
sees that same height, so a wrap is a real step for the others, and the optimiser pays for it.

How heights are rounded in the loop is a strategy's (`doedesign.design.levels.quantisation`).

The depths of the etches may be parameters, too. Cells then take the nearest of the levels that these depths make.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped, UInt8

from doedesign.design.levels.quantisation import Rounding, blended_level, stochastic_level
from fab.levels import Levels, height_of
from sim.material import full_wave_height_m

# A depth moves all cells at once, so it takes smaller steps than they do: with the usual step size, 1 % at a time.
DEPTH_SCALE = 0.02


class Parameters(NamedTuple):
    """All that an optimisation moves.

    Attributes:
        radians: phase at the design wavelength, of every cell or ring.
        log_depth_ratio: `[mask]` logarithm of every etch's depth over its first one, in units of `DEPTH_SCALE`; None
            where the depths are given.
    """

    radians: Array
    log_depth_ratio: Array | None = None


class LevelParametrization(eqx.Module):
    """Heights on a staircase from phases: one radian at the design wavelength is `metres_per_radian` high.

    What is drawn are pixels of `block` by `block` of the optic's cells.
    """

    metres_per_radian: float = eqx.field(static=True)
    levels: Levels = eqx.field(static=True)
    quantisation: str = eqx.field(static=True, default="straight_through")
    block: int = eqx.field(static=True, default=1)

    @staticmethod
    def at(
        material: str,
        design_wavelength_m: float,
        levels: Levels,
        quantisation: str = "straight_through",
        block: int = 1,
    ) -> "LevelParametrization":
        """The staircase of a substrate at a design wavelength.

        Rounded by a strategy of `doedesign.design.levels.quantisation`, on pixels of `block` by `block` cells.
        """
        metres_per_radian = full_wave_height_m(material, design_wavelength_m) / (2 * np.pi)
        return LevelParametrization(metres_per_radian, levels, quantisation, block)

    def cells(self, drawn: Shaped[Array, "*s"]) -> Shaped[Array, "*t"]:
        """Values of the optic's cells, of those of the pixels that are drawn."""
        return drawn if self.block == 1 else jnp.repeat(jnp.repeat(drawn, self.block, 0), self.block, 1)

    def drawn(self, cells: Float[np.ndarray, "*t"]) -> Float[np.ndarray, "*s"]:
        """Values of the pixels that are drawn, each that of the cell in its middle."""
        block = self.block
        return cells if block == 1 else cells[block // 2 :: block, block // 2 :: block]

    def continuous_m(self, radians: Float[Array, "*s"]) -> Float[Array, "*s"]:
        """Wrapped height before quantisation, 0 up to L steps, metres."""
        return jnp.mod(radians * self.metres_per_radian, self.levels.period_m)

    def level(self, height_m: Float[Array, "*s"]) -> Float[Array, "*s"]:
        """Nearest level of a wrapped height, 0 .. L-1 (the top half step belongs to level 0 of the next wave)."""
        if not self.levels.is_binary:
            return self._nearest(height_m, jnp.asarray(self.levels.depths_m, jnp.float32)).astype(jnp.float32)
        nearest = jnp.round(height_m / self.levels.step_m)
        return jnp.where(nearest >= self.levels.count, 0.0, nearest)

    def height_m(
        self, radians: Float[Array, "*s"], rounding: Rounding, depths_m: Float[Array, " k"] | None = None
    ) -> Float[Array, "*s"]:
        """Height that is optimised: quantised at softness 0, continuous at 1, blended between, or as chance has it.

        Without Gumbel's blend, the gradient with respect to `radians` is that of the continuous height. `depths_m` are
        the depths of the etches, first mask first, if they are not those of the staircase; the gradient with respect to
        them is that of the levels' heights, at the same nearest level.
        """
        height, softness = self.continuous_m(radians), rounding.softness
        if rounding.key is not None:
            return self._at_random(height, rounding)
        if depths_m is None and self.levels.is_binary:
            stepped = jax.lax.stop_gradient(self.level(height) * self.levels.step_m)
        else:
            stepped = self._stepped(height, jnp.asarray(self.levels.depths_m) if depths_m is None else depths_m)
        blended = softness * jax.lax.stop_gradient(height) + (1.0 - softness) * stepped
        return _add_tangent(jnp.where(softness > 0, blended, stepped), height)

    def _stepped(self, height_m: Float[Array, "*s"], depths_m: Float[Array, " k"]) -> Float[Array, "*s"]:
        """Height of the nearest level, with its gradient with respect to the depths alone."""
        level = self._nearest(height_m, depths_m)
        if self.levels.is_full:
            return sum((jnp.where(level >> k & 1, depth, 0.0) for k, depth in enumerate(depths_m)), jnp.zeros(()))
        rises = self._closed(jax.lax.stop_gradient(depths_m)).T
        return sum((d * rise[level] for d, rise in zip(depths_m, rises, strict=True)), jnp.zeros(()))

    def height_of(self, parameters: Parameters, rounding: Rounding) -> Float[Array, "*s"]:
        """`height_m` of all that an optimisation moves, of the pixels that are drawn."""
        ratio = parameters.log_depth_ratio
        return self.height_m(parameters.radians, rounding, None if ratio is None else self.depths_m(ratio))

    def _at_random(self, height_m: Float[Array, "*s"], rounding: Rounding) -> Float[Array, "*s"]:
        """Heights of levels drawn at random, on even steps, which go round: level L is level 0 of the next wave."""
        level = height_m / self.levels.step_m
        if self.quantisation == "gumbel":
            return jnp.mod(blended_level(level, rounding), self.levels.count) * self.levels.step_m
        drawn = jnp.mod(stochastic_level(jax.lax.stop_gradient(level), rounding), self.levels.count)
        return _add_tangent(drawn * self.levels.step_m, height_m)

    def _nearest(self, height_m: Float[Array, "*s"], depths_m: Float[Array, " k"]) -> Int[Array, "*s"]:
        """Nearest level of a wrapped height if the etches have these depths (`fab.levels.wrapped_cells`)."""
        count, period = self.levels.count, self.levels.period_m
        depths = jax.lax.stop_gradient(depths_m)
        places = jnp.mod(self._closed(depths) @ depths, period)
        order = jnp.argsort(places)
        places = places[order]
        # One comparison per level is faster than a search, and what follows fuses with it.
        cell = sum((height_m >= edge).astype(jnp.int32) for edge in (places[1:] + places[:-1]) / 2)
        edge = (places[-1] + places[0] + period) / 2
        cell = jnp.where(height_m >= edge, 0, jnp.where(height_m < edge - period, count - 1, cell))
        return order[cell]

    def _closed(self, depths_m: Float[Array, " k"]) -> Float[Array | np.ndarray, "level k"]:
        """By how many of each depth a level stands above the deepest floor: masks that it closes, less those it opens.

        "Closed" and "opened" as against the deepest level of these depths, which opens all masks if every set of them
        makes a level.
        """
        count, bits = self.levels.count, np.arange(self.levels.bits)
        opened = ((np.arange(count)[::-1, None] >> bits) & 1).astype(np.float32)
        if self.levels.is_full:
            return 1 - opened
        return jnp.asarray(opened)[jnp.argmax(opened @ depths_m)] - opened

    def depths_m(self, log_depth_ratio: Float[Array, " k"]) -> Float[Array, " k"]:
        """Depths of the etches from free parameters, 0 for those of the staircase; always positive."""
        return jnp.asarray(self.levels.depths_m, jnp.float32) * jnp.exp(DEPTH_SCALE * log_depth_ratio)

    def drawn_height(self, level: UInt8[np.ndarray, "*s"]) -> Float[Array, "*s"]:
        """Heights of levels as steps take them, metres, float32."""
        return jnp.asarray(height_of(level, self.levels).astype(np.float32))

    def radians_of(self, height_m: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
        """Parameters that make a given height, float32."""
        return (np.asarray(height_m) / self.metres_per_radian).astype(np.float32)


@jax.custom_jvp
def _add_tangent(stepped_m: Array, height_m: Array) -> Array:
    """`stepped_m`, exactly, with the gradients of both."""
    del height_m
    return stepped_m


@_add_tangent.defjvp
def _add_tangent_tangent(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    return primals[0], tangents[0] + tangents[1]
