"""Optimisation of a height map: Adam on the parameters, quantisation in the loop, resumable at any moment.

A step looks at every colour, one near and one far depth (shuffled rounds), and a random displacement of the image by a
fraction of a pixel; all follow from the seed and the step number, so a run that was killed and resumed ends
with the same bytes as one that was not.

Where the depths of the etches are to be chosen, they are further parameters of the same optimisation
(`doedesign.design.parametrize.LevelParametrization.depths_m`): which level a cell takes is straight-through as ever,
and how high that level stands has a true gradient.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from doedesign.design.design import Design
from doedesign.design.etch_depths import height_histogram, optimal_levels, recipe_depths_m
from doedesign.design.parametrize import Free, softness_at
from doedesign.design.problem import Problem, SourceSet, StepSources, judge_height, losses, view_of
from doedesign.design.starts import StartSetup, start_heights
from doedesign.runtime.compiling import compiled_step
from doedesign.spec import STARTS, Spec
from fab.errors import InputError
from fab.level_map import LevelMap
from fab.levels import Levels
from sim.aperture import circle_coverage

Start = Callable[[Path], Float[np.ndarray, "y x"]]


class OptimizationState(NamedTuple):
    """Everything a step changes.

    Attributes:
        radians: parameters in radians.
        adam: Adam's moments of all that is free.
        step: number of steps done.
        log_depth_ratio: `[mask]` logarithm of every etch's depth over its first one, in units of
            `doedesign.design.parametrize.DEPTH_SCALE`; None where the depths are given.
    """

    radians: Array
    adam: optax.OptState
    step: int
    log_depth_ratio: Array | None = None

    @property
    def free(self) -> Free:
        """What Adam moves: the parameters, and the depths if they are free."""
        return self.radians if self.log_depth_ratio is None else (self.radians, self.log_depth_ratio)


class StepRecord(NamedTuple):
    """One line of the history: the loss of a step before its update, and every term's value."""

    step: int
    loss: float
    terms: tuple[float, ...]


def optimiser_of(spec: Spec) -> optax.GradientTransformation:
    """Adam whose step size falls to a tenth along a cosine, so that levels settle."""
    schedule = optax.cosine_decay_schedule(spec.optimize.learning_rate, max(spec.optimize.steps, 1), alpha=0.1)
    return optax.adam(schedule)


def initial_state(
    spec: Spec, problem: Problem, scene: SourceSet, files: Mapping[str, Path], read_start: Start
) -> OptimizationState:
    """Parameters and moments before the first step.

    Args:
        spec: the spec.
        problem: its problem.
        scene: its sources.
        files: input files by key.
        read_start: reads a height map in metres when the spec's start is a file.

    Raises:
        InputError: a start that does not fit the grid or is no raster of rings where rings are optimised.
    """
    camera = problem.camera
    if spec.optimize.start in STARTS:
        setup = StartSetup(
            camera,
            problem.radial,
            spec.optics.design_wavelength_m,
            spec.optimize.seed,
            lambda heights: judge_height(problem, scene, heights),
        )
        heights = start_heights(spec.optimize.start, spec.optimize.start_options, setup)
    else:
        path = files["optimize.start"]
        heights = read_start(path)
        if heights.shape != camera.grid.shape:
            raise InputError(
                str(path), f"a start must have the grid's shape {camera.grid.shape}", heights.shape, "Resample it."
            )
        heights = problem.optic.heights_of(heights)
        if heights is None:
            raise InputError(
                str(path),
                "the start of a radial design must be a raster of rings one cell wide",
                "a map with other structure",
                'Use parametrization = "freeform", or another start.',
            )
    radians = jnp.asarray(problem.parametrization.radians_of(heights))
    log_depth_ratio = jnp.zeros(spec.process.masks, jnp.float32) if learns_depths(spec) else None
    free = radians if log_depth_ratio is None else (radians, log_depth_ratio)
    return OptimizationState(radians, optimiser_of(spec).init(free), 0, log_depth_ratio)


def learns_depths(spec: Spec) -> bool:
    """Whether depths are parameters of the optimisation; without rounding nothing depends on them."""
    return spec.process.chooses_depths and spec.optimize.quantisation != "none"


def _loss(free: Free, problem: Problem, look: StepSources, softness: Array) -> tuple[Array, Array]:
    return losses(problem, view_of(problem, problem.parametrization.height_of(free, softness), look))


Constants = tuple[Problem, StepSources, Array]
Update = Callable[[Constants, tuple[Free, optax.OptState]], tuple[tuple[Free, optax.OptState], Array, Array]]


def make_update(spec: Spec) -> Update:
    """The compiled update (constants, (free, adam)) -> ((free, adam), loss, terms); see `OptimizationState.free`.

    It reuses the memory of the state it is given.
    """
    optimiser = optimiser_of(spec)

    def update(constants: Constants, state: tuple[Free, optax.OptState]) -> Any:
        free, adam = state
        (loss, terms), gradient = jax.value_and_grad(_loss, has_aux=True)(free, *constants)
        updates, adam = optimiser.update(gradient, adam)
        return (optax.apply_updates(free, updates), adam), loss, terms

    return compiled_step(update)


def constants_at(spec: Spec, problem: Problem, scene: SourceSet, step: int) -> Constants:
    """What the update of step number `step` is given besides the state."""
    softness = softness_at(spec.optimize.quantisation, step, spec.optimize.steps)
    return problem, scene.look(spec.optimize.seed, step), jnp.float32(softness)


def steps(
    spec: Spec, problem: Problem, scene: SourceSet, state: OptimizationState
) -> Iterator[tuple[OptimizationState, StepRecord]]:
    """Run the remaining steps one by one.

    Yields:
        the state after each step and its record. A state is valid until the next one is asked for.

    Raises:
        InputError: the loss is no longer finite.
    """
    update = make_update(spec)
    for step in range(state.step, spec.optimize.steps):
        constants = constants_at(spec, problem, scene, step)
        (free, adam), loss, terms = update(constants, (state.free, state.adam))
        radians, log_depth_ratio = free if isinstance(free, tuple) else (free, None)
        state = OptimizationState(radians, adam, step + 1, log_depth_ratio)
        record = StepRecord(step, float(loss), tuple(float(t) for t in terms))
        if not np.isfinite(record.loss):
            raise InputError(
                f"optimize, step {step}", "the loss must stay finite", record.loss, "Lower optimize.learning_rate."
            )
        yield state, record


def finished_design(
    spec: Spec, problem: Problem, state: OptimizationState, history: Sequence[Mapping[str, Any]] = ()
) -> Design:
    """Return the design of the parameters: every cell at its nearest level, and the heights before rounding."""
    parametrization, camera = problem.parametrization, problem.camera
    continuous = problem.optic.raster(np.asarray(parametrization.continuous_m(state.radians)))
    levels = _chosen_levels(spec, problem, state, continuous) if spec.process.chooses_depths else parametrization.levels
    level = np.asarray(replace(parametrization, levels=levels).level(jnp.asarray(continuous))).astype(np.uint8)
    level_map = LevelMap(level, levels, camera.grid, spec.doe.aperture_m, spec.name)
    near_m, far_m = spec.scene.near_m, spec.scene.far_m
    return Design(level_map, camera, near_m, far_m, continuous_m=continuous, spec=spec, history=tuple(history))


def _chosen_levels(
    spec: Spec, problem: Problem, state: OptimizationState, continuous_m: Float[np.ndarray, "y x"]
) -> Levels:
    """Return the chosen staircase as a recipe holds it: the one learnt, or that which suits the heights best."""
    parametrization, camera = problem.parametrization, problem.camera
    start = parametrization.levels
    if state.log_depth_ratio is not None:
        depths_m = recipe_depths_m(np.asarray(parametrization.depths_m(state.log_depth_ratio)))
        with contextlib.suppress(InputError):  # two levels met
            return Levels(start.count, start.step_m, depths_m)
    area = circle_coverage(camera.grid, camera.aperture_m)
    return optimal_levels(height_histogram(continuous_m, area, start.period_m, camera), start)
