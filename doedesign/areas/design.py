"""From a spec with an area to a design: optimal transport, L-BFGS on the phase, and levels one by one.

First the phase is free. Then cells are set to their nearest levels a few at a time, those that are nearest to one
first, and the others make up for them (F. Wyrowski, J. Opt. Soc. Am. A 7, 961, 1990), so that the contrast that levels
make stays small.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from doedesign.areas.problem import AreaLight, AreaProblem, AreaSet
from doedesign.areas.target import AreaTarget, camera_for
from doedesign.areas.transport import transport_phase
from doedesign.build import camera_from_spec, levels_from_spec
from doedesign.design.design import Design
from doedesign.design.lbfgs import lbfgs_memory, lbfgs_step
from doedesign.design.problem import finite_loss
from doedesign.spec import Spec, input_files
from doedesign.spots.superposition import Staircase
from fab.errors import InputError
from fab.level_map import LevelMap
from fab.levels import Levels, quantise_wrapped
from fab.units import format_length
from sim.camera import Camera

_MEMORY = 8  # steps that L-BFGS remembers
_FREE = 0.5  # share of the steps with a free phase
_BLOCK = 5  # steps between two sets of cells that are set to levels
_TRIALS = 64  # phases per wave among which a start for several areas is sought


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
        targets: where light should go.
        problem: what is designed.
    """

    spec: Spec
    camera: Camera
    levels: Levels
    targets: tuple[AreaTarget, ...]
    problem: AreaSet

    @classmethod
    def from_spec(cls, spec: Spec) -> "AreaTask":
        """Prepare the task of a spec that has areas.

        Raises:
            InputError: a sensor without a lens that is too near, or a picture that cannot be drawn.
        """
        camera, levels, files = camera_from_spec(spec), levels_from_spec(spec.process), input_files(spec)
        first = camera.lines[0].wavelength_m
        targets, problems = [], []
        for index, area in enumerate(spec.areas):
            seen, key = camera_for(area, camera), spec.area_key(index)
            if seen.propagation != "far_field":
                least, got = (format_length(float(f"{d:.3g}")) for d in (seen.far_from_m, seen.distance_m or 0))
                rule = f"an area without a lens needs a sensor at least {least} away"
                cure = "Move the sensor, or choose a smaller aperture or window."
                where = "sensor.distance" if area.distance_m is None else f"{key}.distance"
                raise InputError(where, rule, got, cure)
            own = seen.lines[0].wavelength_m
            turn = 1.0 if own == first else float(camera.waves_per_metre(own) / camera.waves_per_metre(first))
            pictures = files.get(f"{key}.picture"), files.get(f"{key}.phase")
            targets.append(AreaTarget.of(area, seen, *pictures, key=key))
            problems.append(AreaProblem.of(targets[-1], seen, turn))
        one_colour = all(problem.turn == 1 for problem in problems)
        span = None if one_colour else float(2 * np.pi * camera.waves_per_metre(first) * levels.period_m)
        return cls(spec, camera, levels, tuple(targets), AreaSet(tuple(problems), span))

    def initial_state(self) -> AreaState:
        """The phase that carries the beam to the areas as rays would, or a random one.

        Where there are several, or one in another colour than the first, every cell has the phase, of the first colour
        and within a wave of the relief, whose light comes nearest to what all of them ask for.
        """
        grid = self.camera.grid
        if self._random:
            rng = np.random.default_rng(self.spec.optimize.seed)
            phase = rng.uniform(0, self.problem.span or 2 * np.pi, grid.shape)
        elif len(self.targets) == 1 and self.problem.span is None:
            phase = self._carrying(0)
        else:
            asked = [self._carrying(i) for i in range(len(self.targets))]
            phase = _nearest_to_all(asked, [p.turn for p in self.problem.problems], self.problem.span or 2 * np.pi)
        return self._begun(jnp.asarray(phase, jnp.float32), jnp.ones(grid.shape, jnp.float32), 0)

    @property
    def _random(self) -> bool:
        return self.spec.areas[0].start == "random"

    def _carrying(self, index: int) -> Float[np.ndarray, "y x"]:
        """The phase that carries the beam to an area as rays would, or that of the wave which is asked for there.

        It is of the wavelength that lights the area.
        """
        area, target, grid = self.spec.areas[index], self.targets[index], self.camera.grid
        problem = self.problem.problems[index]
        amplitudes = np.asarray(problem.amplitudes)
        if (wave := target.wave) is not None:
            back = np.asarray(problem.along_y).conj().T @ wave @ np.asarray(problem.along_x).conj()
            return self._diluted(back) - np.angle(amplitudes[0])
        light: Any = np.sum(np.abs(amplitudes) ** 2, axis=0, dtype=np.float64)
        wavelength = camera_for(area, self.camera).lines[0].wavelength_m
        moved_y, moved_x = self.camera.moved_sines()
        directions = (target.sines_y - moved_y) / wavelength, (target.sines_x - moved_x) / wavelength
        phase = transport_phase(light, (grid.axis_m("y"), grid.axis_m("x")), target.value, directions)
        # The wave has a phase already, that of the lowest mode and of a sensor out of focus.
        return phase - np.angle(amplitudes[0])

    def _diluted(self, wave: Complex[np.ndarray, "y x"]) -> Float[np.ndarray, "y x"]:
        """Phase of a wave, turned ahead or back at random where it is weak, by as much as makes it so on the average.

        Light of neighbours that differ goes far out, beyond the area (J. M. Cohn and M. Liang, Appl. Opt. 35, 2488,
        1996). The phase alone would be a start from which no gradient leads to a wave that is even or odd.
        """
        strength: Any = np.minimum(1, np.abs(wave) / max(np.abs(wave).mean(), 1e-30))
        sides = np.random.default_rng(self.spec.optimize.seed).choice([-1, 1], wave.shape)
        return np.angle(wave) + sides * np.arccos(strength)

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
        if self._random:
            return "starting from random phases"
        given = any(target.phase is not None for target in self.targets)
        return "starting from the wave of the area" if given else "carrying the beam to the area by optimal transport"

    def steps(self, state: AreaState) -> Iterator[tuple[AreaState, dict[str, Any]]]:
        """Do the remaining steps one by one; yields the state, and the line of the history.

        Raises:
            InputError: the loss is no longer finite.
        """
        areas, count = self.spec.areas, self.spec.optimize.steps
        names = [
            f"{name} {i}" if len(areas) > 1 else name for i, _ in enumerate(areas, 1) for name in AreaLight._fields
        ]
        weights = jnp.asarray([area.uniformity for area in areas], jnp.float32)
        while state.step < count:
            step = state.step
            if (share := self.settled(step)) and step % _BLOCK == 0:
                state = self._settle(state, share)
            phase, memory, loss, light = _step(self.problem, state.phase, state.free, state.memory, weights)
            state = AreaState(phase, state.free, memory, step + 1)
            value = finite_loss(loss, step, 'Choose another area, or area.start = "random".')
            terms = [float(part) for one in light for part in one]
            yield state, {"step": step, "loss": value, "terms": terms, "names": names}

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
        if (span := self.problem.span) is None:
            nearest = np.angle(self.staircase.light)[self.level(phase)]
            away = np.angle(np.exp(1j * (phase - nearest)))
        else:
            nearest = self._rate * self.levels.heights_m()[self.level(phase)]
            away = np.mod(phase - nearest + span / 2, span) - span / 2
        set_ = np.abs(away) <= share * np.abs(away).max()
        phase = np.where(set_, phase - away, phase)
        free = np.asarray(state.free) * ~set_
        return self._begun(jnp.asarray(phase, jnp.float32), jnp.asarray(free, jnp.float32), state.step)

    @property
    def staircase(self) -> Staircase:
        """Levels as light of the first wavelength sees them."""
        return Staircase.of(self._rate * self.levels.heights_m())

    @property
    def _rate(self) -> float:
        """Radians of phase of the first wavelength per metre of height."""
        return 2 * np.pi * self.camera.waves_per_metre(self.camera.lines[0].wavelength_m)

    def level(self, phase: Float[np.ndarray, "y x"]) -> Any:
        """Level nearest to every phase: in the light of the one colour, or in height where there are several."""
        if self.problem.span is None:
            return self.staircase.level(np.exp(1j * phase))
        return quantise_wrapped(phase / self._rate, self.levels)

    def finished(self, state: AreaState, history: list[dict[str, Any]]) -> Design:
        """The design of a state."""
        spec, grid = self.spec, self.camera.grid
        level_map = LevelMap(
            self.level(np.asarray(state.phase, np.float64)), self.levels, grid, spec.doe.relief, spec.name
        )
        return Design(level_map, self.camera, (), spec.scene.far_m, spec=spec, history=tuple(history))


def _nearest_to_all(
    asked: Sequence[Float[np.ndarray, "y x"]], turns: Sequence[float], span: float
) -> Float[np.ndarray, "y x"]:
    """Phases from 0 to a span whose light is nearest to several others, each `turns` times as fast."""
    best, light = np.zeros(asked[0].shape), np.full(asked[0].shape, -np.inf)
    for phase in np.arange(0, span, 2 * np.pi / _TRIALS):
        found = sum(np.cos(turn * phase - wanted) for turn, wanted in zip(turns, asked, strict=True))
        best, light = np.where(found > light, phase, best), np.maximum(found, light)
    return best


@eqx.filter_jit
def _step(
    problem: AreaSet, phase: Array, free: Array, memory: Any, weights: Array
) -> tuple[Array, Any, Array, tuple[AreaLight, ...]]:
    """One step of L-BFGS over the free cells: phase and memory; the loss before it and its parts."""
    start = phase

    def loss_of(moved: Array) -> Array:
        return problem.loss(jnp.where(free > 0, moved, start), weights)

    moved, memory, value = lbfgs_step(loss_of, phase, memory, _MEMORY)
    return moved, memory, value, problem.judge(phase)
