"""From a spec with an area to a design: optimal transport, L-BFGS on the phase, and levels one by one.

First the phase is free. Then cells are set to their nearest levels a few at a time, those that are nearest to one
first, and the others make up for them (F. Wyrowski, J. Opt. Soc. Am. A 7, 961, 1990), so that the contrast that levels
make stays small.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doedesign.areas.problem import AreaLight, AreaProblem
from doedesign.areas.target import AreaTarget
from doedesign.areas.transport import transport_phase
from doedesign.build import camera_from_spec, levels_from_spec
from doedesign.design.design import Design
from doedesign.design.lbfgs import lbfgs_memory, lbfgs_step
from doedesign.spec import Spec, input_files
from doedesign.spots.superposition import Staircase
from fab.errors import InputError
from fab.level_map import LevelMap
from fab.levels import Levels
from fab.units import format_length
from sim.camera import Camera

_MEMORY = 8  # steps that L-BFGS remembers
_FREE = 0.5  # share of the steps with a free phase
_BLOCK = 5  # steps between two sets of cells that are set to levels


class AreaState(NamedTuple):
    """Everything a step changes: phase and which cells are set, what L-BFGS remembers, and the steps done."""

    phase: Float[Array, "y x"]
    free: Float[Array, "y x"]
    memory: Any
    step: int

    @property
    def arrays(self) -> list[np.ndarray]:
        """Arrays that a checkpoint keeps."""
        return [np.asarray(leaf) for leaf in jax.tree.leaves(tuple(self[:3]))]


@dataclass(frozen=True, eq=False)
class AreaTask:
    """The area of a spec, and the cells that light it.

    Attributes:
        spec: the spec.
        camera: its optics.
        levels: its staircase.
        target: where light should go.
        problem: what is designed.
    """

    spec: Spec
    camera: Camera
    levels: Levels
    target: AreaTarget
    problem: AreaProblem

    @classmethod
    def from_spec(cls, spec: Spec) -> "AreaTask":
        """Prepare the task of a spec that has an area.

        Raises:
            InputError: a sensor without a lens that is too near, or a picture that cannot be drawn.
        """
        assert spec.area is not None
        camera, levels = camera_from_spec(spec), levels_from_spec(spec.process)
        if camera.propagation != "far_field":
            least, got = (format_length(float(f"{d:.3g}")) for d in (camera.far_from_m, camera.distance_m or 0))
            rule = f"an area without a lens needs a sensor at least {least} away"
            cure = "Move the sensor, or choose a smaller aperture or window."
            raise InputError("sensor.distance", rule, got, cure)
        target = AreaTarget.of(spec.area, camera, input_files(spec).get("area.picture"))
        return cls(spec, camera, levels, target, AreaProblem.of(target, camera))

    def initial_state(self) -> AreaState:
        """The phase that carries the beam to the area as rays would, or a random one."""
        assert self.spec.area is not None
        if self.spec.area.start == "random":
            shape, rng = self.camera.grid.shape, np.random.default_rng(self.spec.optimize.seed)
            phase = jnp.asarray(rng.uniform(0, 2 * np.pi, shape), jnp.float32)
            return self._begun(phase, jnp.ones(shape, jnp.float32), 0)
        amplitudes, grid = np.asarray(self.problem.amplitudes), self.camera.grid
        light: Any = np.sum(np.abs(amplitudes) ** 2, axis=0, dtype=np.float64)
        wavelength = self.camera.lines[0].wavelength_m
        directions = self.target.sines_y / wavelength, self.target.sines_x / wavelength
        phase = transport_phase(light, (grid.axis_m("y"), grid.axis_m("x")), self.target.value, directions)
        # The wave has a phase already, that of the lowest mode and of a sensor out of focus.
        phase = jnp.asarray(phase - np.angle(amplitudes[0]), jnp.float32)
        return self._begun(phase, jnp.ones(grid.shape, jnp.float32), 0)

    def _begun(self, phase: Array, free: Array, step: int) -> AreaState:
        return AreaState(phase, free, lbfgs_memory(phase, _MEMORY), step)

    @property
    def _like(self) -> Any:
        empty = jnp.zeros(self.camera.grid.shape, jnp.float32)
        return jax.eval_shape(lambda: tuple(self._begun(empty, empty, 0)[:3]))

    @property
    def template(self) -> list[Any]:
        """Shapes and kinds of the arrays of a checkpoint."""
        return jax.tree.leaves(self._like)

    def state_of(self, arrays: list[np.ndarray], step: int) -> AreaState:
        """The state of a checkpoint."""
        phase, free, memory = jax.tree.unflatten(jax.tree.structure(self._like), map(jnp.asarray, arrays))
        return AreaState(phase, free, memory, step)

    @property
    def begins(self) -> str:
        """How a design begins, in words."""
        assert self.spec.area is not None
        random = self.spec.area.start == "random"
        return "starting from random phases" if random else "carrying the beam to the area by optimal transport"

    def steps(self, state: AreaState) -> Iterator[tuple[AreaState, dict[str, Any]]]:
        """Do the remaining steps one by one; yields the state, and the line of the history."""
        names, count = list(AreaLight._fields), self.spec.optimize.steps
        assert self.spec.area is not None
        while state.step < count:
            step = state.step
            if (share := self.settled(step)) and step % _BLOCK == 0:
                state = self._settle(state, share)
            uniformity = jnp.float32(self.spec.area.uniformity)
            phase, memory, loss, light = _step(self.problem, state.phase, state.free, state.memory, uniformity)
            state = AreaState(phase, state.free, memory, step + 1)
            terms = [float(part) for part in light]
            yield state, {"step": step, "loss": float(loss), "terms": terms, "names": names}

    def settled(self, step: int) -> float:
        """Distance to the nearest level, over the largest there is, up to which cells are set to it at a step."""
        count = self.spec.optimize.steps
        first = _BLOCK * round(_FREE * count / _BLOCK)
        blocks = max(1, (count - first) // _BLOCK)
        done = max(0.0, ((step - first) // _BLOCK + 1) / (blocks + 1))
        # Cells that are set last have nobody left to make up for them: few of them at a time.
        return 1 - (1 - done) ** 1.5

    def _settle(self, state: AreaState, share: float) -> AreaState:
        """Set cells near to a level to it, and forget what L-BFGS knows of the others."""
        phase = np.asarray(state.phase, np.float64)
        nearest = np.angle(self.staircase.light)[self.level(phase)]
        away = np.angle(np.exp(1j * (phase - nearest)))
        set_ = np.abs(away) <= share * np.abs(away).max()
        phase = np.where(set_, phase - away, phase)
        free = np.asarray(state.free) * ~set_
        return self._begun(jnp.asarray(phase, jnp.float32), jnp.asarray(free, jnp.float32), state.step)

    @property
    def staircase(self) -> Staircase:
        """Levels as light of the first wavelength sees them."""
        rate = self.camera.waves_per_metre(self.camera.lines[0].wavelength_m)
        return Staircase.of(2 * np.pi * rate * self.levels.heights_m())

    def level(self, phase: Float[np.ndarray, "y x"]) -> Any:
        """Level nearest to every phase."""
        return self.staircase.level(np.exp(1j * phase))

    def finished(self, state: AreaState, history: list[dict[str, Any]]) -> Design:
        """The design of a state."""
        spec, grid = self.spec, self.camera.grid
        level_map = LevelMap(
            self.level(np.asarray(state.phase, np.float64)), self.levels, grid, spec.doe.aperture_m, spec.name
        )
        return Design(level_map, self.camera, (), spec.scene.far_m, spec=spec, history=tuple(history))


@eqx.filter_jit
def _step(
    problem: AreaProblem, phase: Array, free: Array, memory: Any, uniformity: Array
) -> tuple[Array, Any, Array, AreaLight]:
    """One step of L-BFGS over the free cells: phase and memory; the loss before it and its parts."""
    start = phase

    def loss_of(moved: Array) -> Array:
        return problem.loss(jnp.where(free > 0, moved, start), uniformity)

    moved, memory, value = lbfgs_step(loss_of, phase, memory, _MEMORY)
    return moved, memory, value, problem.judge(phase)
