"""From a spec with foci to a design: L-BFGS on the heights of rings, then level by level.

First heights are free. Then every ring takes its nearest level, and ring after ring is given the level that serves all
foci best, until none has a better one.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from doedesign.build import camera_from_spec, levels_from_spec
from doedesign.design.design import Design
from doedesign.design.lbfgs import lbfgs_memory, lbfgs_step
from doedesign.design.problem import finite_loss
from doedesign.focus.foci import Foci
from doedesign.focus.problem import FINER, FocusLight, FocusProblem, ring_count, ring_numbers
from doedesign.spec import Spec
from doedesign.spots.superposition import Staircase
from fab.level_map import LevelMap
from fab.levels import Levels
from sim.camera import Camera

_MEMORY = 16  # steps that L-BFGS remembers
_FREE = 0.8  # share of the steps with free heights


class FocusState(NamedTuple):
    """Everything a step changes.

    Attributes:
        radians: `[ring]` free parameters.
        level: `[ring]` levels, once they are drawn.
        settled: whether no ring has a better level.
        memory: of L-BFGS.
        step: steps done.
    """

    radians: Float[Array, " ring"]
    level: Int[Array, " ring"]
    settled: Any
    memory: Any
    step: int

    @property
    def arrays(self) -> list[np.ndarray]:
        """Arrays that a checkpoint keeps."""
        return [np.asarray(leaf) for leaf in jax.tree.leaves(tuple(self[:4]))]


class RingHeights(eqx.Module):
    """Heights of rings from free parameters.

    Light of one wavelength does not see whole waves, so that any height will do. Several wavelengths see them all, and
    heights stay between the lowest and the highest level.

    Attributes:
        wave_m: height of a wave for the only wavelength; 0 for several.
        top_m: height of the highest level.
    """

    wave_m: float = eqx.field(static=True)
    top_m: float = eqx.field(static=True)

    def height_m(self, radians: Float[Array, " ring"]) -> Float[Array, " ring"]:
        """Heights of free parameters."""
        if self.wave_m:
            return radians * (self.wave_m / (2 * np.pi))
        return self.top_m * jnp.sin(radians / 2) ** 2

    def radians(self, height_m: Float[np.ndarray, " ring"]) -> Float[np.ndarray, " ring"]:
        """Free parameters of heights."""
        if self.wave_m:
            return height_m * (2 * np.pi / self.wave_m)
        # At either end heights do not move at first.
        share = np.clip(height_m / self.top_m, 0.02, 0.98)
        return 2 * np.arcsin(np.sqrt(share))


@dataclass(frozen=True, eq=False)
class FocusTask:
    """The foci of a spec, and the rings that make them.

    Attributes:
        spec: the spec.
        camera: its optics.
        levels: its staircase.
        rings: heights of the rings.
        problem: what is designed.
    """

    spec: Spec
    camera: Camera
    levels: Levels
    rings: RingHeights
    problem: FocusProblem

    @classmethod
    def from_spec(cls, spec: Spec) -> "FocusTask":
        """Prepare the task of a spec that has foci.

        Raises:
            InputError: more planes than can be designed for.
        """
        assert spec.focus is not None
        camera, levels = camera_from_spec(spec), levels_from_spec(spec.process)
        waves = {line.wavelength_m for line in camera.lines}
        wave_m = float(1 / camera.waves_per_metre(waves.pop())) if len(waves) == 1 else 0.0
        rings = RingHeights(wave_m, float(levels.heights_m().max()))
        return cls(spec, camera, levels, rings, FocusProblem.of(Foci.wanted(spec.focus, camera), camera))

    def initial_state(self) -> FocusState:
        """RingHeights that bend light to the foci as rays would."""
        radians = self.rings.radians(self._first_heights())
        return self._begun(jnp.asarray(radians, jnp.float32))

    def _begun(self, radians: Array) -> FocusState:
        level = jnp.zeros(radians.shape, jnp.int32)
        return FocusState(radians, level, jnp.asarray(False), lbfgs_memory(radians, _MEMORY), 0)

    def _first_heights(self) -> Float[np.ndarray, " ring"]:
        focus: Any = self.spec.focus
        wavelength, ring_m = self.camera.lines[0].wavelength_m, self.camera.grid.pitch_m / FINER
        radius = (np.arange(ring_count(self.camera)) + 0.5) * ring_m
        distances = np.array(focus.distances_m)
        if focus.through:  # zones of equal area for equal logarithms of distance, the nearest on the axis
            distance = distances[0] * (distances[1] / distances[0]) ** (radius / radius[-1]) ** 2
            waves = -np.cumsum(radius / np.hypot(radius, distance)) * ring_m / wavelength
        else:  # all lenses at once
            paths = np.hypot(radius[:, None], distances) - distances
            weights = np.sqrt(focus.weights or np.ones(len(distances)))
            waves = np.angle(np.exp(-2j * np.pi * paths / wavelength) @ weights) / (2 * np.pi)
        wave_m = 1 / self.camera.waves_per_metre(wavelength)
        return waves * wave_m if self.rings.wave_m else np.mod(waves, 1.0) * min(wave_m, self.rings.top_m)

    @property
    def _like(self) -> Any:
        empty = jnp.zeros(ring_count(self.camera), jnp.float32)
        return jax.eval_shape(lambda: tuple(self._begun(empty)[:4]))

    @property
    def template(self) -> list[Any]:
        """Shapes and kinds of the arrays of a checkpoint."""
        return jax.tree.leaves(self._like)

    def state_of(self, arrays: list[np.ndarray], step: int) -> FocusState:
        """The state of a checkpoint."""
        kept = jax.tree.unflatten(jax.tree.structure(self._like), map(jnp.asarray, arrays))
        radians, level, settled, memory = kept
        return FocusState(radians, level, settled, memory, step)

    @property
    def begins(self) -> str:
        """How a design begins, in words."""
        return f"bending light to {len(self.problem.weight)} foci as rays would"

    def steps(self, state: FocusState) -> Iterator[tuple[FocusState, dict[str, Any]]]:
        """Do the remaining steps one by one; yields the state, and the line of the history.

        Raises:
            InputError: the loss is no longer finite.
        """
        count, names = self.spec.optimize.steps, list(FocusLight._fields)
        free, heights = round(_FREE * count), jnp.asarray(self.levels.heights_m(), jnp.float32)
        while state.step < count:
            step = state.step
            radians, level, settled, memory, _ = state
            if step < free:
                radians, memory, loss, light = _free_step(self.problem, self.rings, radians, memory)
            else:
                if step == free:
                    level = jnp.asarray(self.nearest_level(radians))
                if step == free or not settled:
                    level, settled = _sweep(self.problem, level, heights)
                field = self.problem.field(heights[level])
                loss, light = self.problem.loss(field), self.problem.judge(field)
            state = FocusState(radians, level, settled, memory, step + 1)
            value = finite_loss(loss, step, "Choose other focus.distances or focus.widths.")
            yield state, {"step": step, "loss": value, "terms": [float(part) for part in light], "names": names}

    def nearest_level(self, radians: Float[Array, " ring"]) -> Int[np.ndarray, " ring"]:
        """Level nearest to every free height; of a single wavelength, as light sees it."""
        height, own = np.asarray(self.rings.height_m(radians), np.float64), self.levels.heights_m()
        if self.rings.wave_m:
            turns = 2 * np.pi / self.rings.wave_m
            return Staircase.of(turns * own).level(np.exp(1j * turns * height)).astype(np.int32)
        return np.abs(height[:, None] - own).argmin(1).astype(np.int32)

    def finished(self, state: FocusState, history: list[dict[str, Any]]) -> Design:
        """The design of a state."""
        spec, grid = self.spec, self.camera.grid
        drawn = state.step > round(_FREE * spec.optimize.steps)
        level = np.asarray(state.level) if drawn else self.nearest_level(state.radians)
        number = ring_numbers(self.camera)
        level_map = LevelMap(level.astype(np.uint8)[number], self.levels, grid, spec.doe.relief, spec.name)
        return Design(level_map, self.camera, (), spec.scene.far_m, spec=spec, history=tuple(history))


@eqx.filter_jit
def _free_step(
    problem: FocusProblem, rings: RingHeights, radians: Array, memory: Any
) -> tuple[Array, Any, Array, FocusLight]:
    """One step of L-BFGS: parameters and memory; the loss before it and its parts."""

    def loss_of(radians: Array) -> Array:
        return problem.loss(problem.field(rings.height_m(radians)))

    moved, memory, value = lbfgs_step(loss_of, radians, memory, _MEMORY)
    return moved, memory, value, problem.judge(problem.field(rings.height_m(radians)))


@eqx.filter_jit
def _sweep(problem: FocusProblem, level: Array, heights_m: Array) -> tuple[Array, Array]:
    """Give every ring, from the rim inward, the level of least loss; also whether all had it already."""
    waves = problem.waves(heights_m)  # [part, level]

    def one(carry: tuple[Array, Array], ring: Array) -> tuple[tuple[Array, Array], Array]:
        level, field = carry
        own = problem.kernel[:, :, ring]
        others = field - own * waves[:, level[ring]][:, None]
        choices = others[:, :, None] + own[:, :, None] * waves[:, None, :]
        loss = problem.loss(choices)
        # An equal one is no better.
        best = jnp.where(loss.min() < loss[level[ring]] - 1e-6, loss.argmin().astype(level.dtype), level[ring])
        return (level.at[ring].set(best), choices[:, :, best]), best == level[ring]

    order = jnp.arange(len(level) - 1, -1, -1)
    (level, _), same = jax.lax.scan(one, (level, problem.field(heights_m[level])), order)
    return level, same.all()
