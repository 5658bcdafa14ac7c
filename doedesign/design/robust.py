"""Robust design: steps that minimise the risk of plates as fabricated, not the loss of the plate as drawn.

They begin at the level map that the other steps found. Of every round of steps the plates are drawn anew, in pairs with
errors of opposite sign, and the worst one of the round before is looked at again; within a round a step looks at one
pair, the next step at the next, or at all plates where the risk compares them. `sim.surface.as_fabricated` says what
each does to the map: the deviation of its transmission from that of the heights, which holds for the steps of a round.
The gradient of the losses is taken with that deviation, so that phases make up for what the errors do on average. What
it cannot see are walls, where the errors act: they have a cost in the moves by which the level map follows the phases
(`fab.rules.repair.follow`), by the light that they send astray.

Sources: J. Jung et al., BOSON-1, arXiv:2411.08210 (worst cases in the loop); R. T. Rockafellar and S. Uryasev, J. Risk
2, 21 (2000) (the mean of the worst, CVaR).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, UInt8

from doedesign.build import process_from_spec
from doedesign.design.levels.parametrize import Parameters
from doedesign.design.levels.printable import PrintableLevels, moved_phases
from doedesign.design.problem import Problem, SourceSet, StepSources, value_and_slope
from doedesign.design.ranges import SourceRange
from doedesign.spec import RobustSpec, Spec
from fab.draws import draw_at, varying
from fab.errors import InputError
from fab.levels import height_of
from fab.process import Normal, Process, Variation
from sim.optic import HeightOptic
from sim.surface import as_fabricated
from sim.threads import at_once

# Steps that look at the same plates, after which the level map follows the phases: a plate's deviation is that of the
# walls that it has. Measured on the quick example, two seeds: rounds of 40 end 0.02 to 0.05 higher, by too few plates.
ROUND = 20
_SOFT = 0.02  # of the limit, over which a plate turns from good to bad
_SALT = 3  # of the random numbers, beside those of looks


class RobustState(NamedTuple):
    """Everything that a robust step changes, beside the number of steps.

    Attributes:
        parameters: phases.
        adam: Adam's moments of them.
        level: `[y, x]` levels that can be printed, of the pixels that are drawn.
        worst: round and place in it of the worst plate of the round before; -1 in the first round.
        losses: `[draw]` summed losses of this round, of every plate in the steps that looked at it.
    """

    parameters: Parameters
    adam: Any
    level: UInt8[np.ndarray, "y x"]
    worst: np.ndarray
    losses: np.ndarray


class RobustTask(NamedTuple):
    """A robust design: what stays the same from step to step.

    Attributes:
        spec: the spec.
        problem: its problem.
        scene: its sources.
        process: the process, whose errors plates have.
        rules: rules of its masks, and the cost of their walls.
        ranges: where sources may lie beside the listed depths and the axis; None if nowhere.
    """

    spec: Spec
    problem: Problem
    scene: SourceSet
    process: Process
    rules: PrintableLevels
    ranges: SourceRange | None = None

    @classmethod
    def of(cls, spec: Spec, problem: Problem, scene: SourceSet) -> "RobustTask":
        """The task of a spec with a table [robust].

        Raises:
            InputError: a process without errors.
        """
        process, pitch_m = process_from_spec(spec.process), problem.camera.grid.pitch_m
        if not varying(process):
            cure = 'For example process.stock = "contact_aligner".'
            raise InputError("robust", "plates must differ", "a process without errors", cure)
        parametrization, optimize = problem.parametrization, spec.optimize
        costs = wall_costs(process, pitch_m * parametrization.block)
        assert spec.robust is not None
        by_errors = [spec.robust.walls * cost for cost in costs]
        rules = PrintableLevels.on(
            problem.camera.grid, spec.doe.relief, parametrization, optimize.min_feature_m or 0.0, optimize.wall_weight
        ).with_costs(by_errors)
        between, beside = spec.robust.depths == "range", spec.robust.field == "random"
        ranges = SourceRange.of(spec, problem, between=between, beside=beside) if between or beside else None
        return cls(spec, problem, scene, process, rules, ranges)

    @property
    def robust(self) -> RobustSpec:
        """The table [robust]."""
        assert self.spec.robust is not None
        return self.spec.robust

    @property
    def optimiser(self) -> optax.GradientTransformation:
        """Adam whose step size grows over a round and falls to a tenth along a cosine."""
        rate, count = self.robust.learning_rate, max(self.robust.steps, 2)
        schedule = optax.warmup_cosine_decay_schedule(rate / 5, rate, min(ROUND, count // 2), count, rate / 10)
        return optax.adam(schedule)

    def initial_state(self, level: UInt8[np.ndarray, "y x"]) -> RobustState:
        """State before the first robust step, of levels of the pixels that are drawn."""
        parametrization = self.problem.parametrization
        level = self.rules.blank.with_level(level).level  # blank outside the relief
        if self.spec.optimize.min_feature_m is not None:
            level = self.rules.first(level)
        radians = jnp.asarray(parametrization.radians_of(height_of(level, parametrization.levels)))
        parameters: Any = Parameters(radians)
        none, losses = np.full(2, -1, np.int32), np.zeros(self.robust.draws, np.float32)
        return RobustState(parameters, self.optimiser.init(parameters), level, none, losses)

    def variations(self, round_: int, worst: np.ndarray) -> list[Variation]:
        """Errors of the plates of a round; the last one is the worst of the round before."""
        drawn = [self._variation(round_, place) for place in range(self.robust.draws)]
        if worst[0] >= 0 and len(drawn) > 2:
            drawn[-1] = self._variation(int(worst[0]), int(worst[1]))
        return drawn

    def worst_of(self, state: RobustState, round_: int) -> np.ndarray:
        """Round and place of the worst plate of a round that has ended; -1 before the first one."""
        if round_ < 0:
            return np.full(2, -1, np.int32)
        looks = np.zeros_like(state.losses)
        for step in range(ROUND):
            seen = self.seen(step)[0]
            looks[seen.start : seen.stop] += 1
        place = int(np.argmax(state.losses / np.maximum(looks, 1)))
        if place == self.robust.draws - 1 > 1 and state.worst[0] >= 0:
            return state.worst  # it was there from an earlier round
        return np.array([round_, place], np.int32)

    def seen(self, place: int) -> tuple[range, float]:
        """Plates that a step of a round looks at, and the factor of its gradient by which all plates count alike."""
        count = self.robust.draws
        if self.robust.measure != "mean":
            return range(count), 1.0  # which ones are the worst shows in the same light alone
        pairs = -(-count // 2)
        pair = place
        if self.spec.optimize.colours == "in_turn" and math.gcd(pairs, len(self.problem.camera.colours)) > 1:
            pair += place // pairs  # or every plate would be seen in some colours alone
        first = 2 * (pair % pairs)
        seen = range(first, min(first + 2, count))
        return seen, len(seen) * pairs / count

    def _variation(self, round_: int, place: int) -> Variation:
        # The last word is not 0: numpy takes [seed, 3, 0, 0] for [seed, 3], the seed of draw 3 of a tolerance study.
        seed = [self.spec.optimize.seed, _SALT, round_, place // 2, 1]
        rng = np.random.default_rng(seed)
        scores, roughness = rng.standard_normal(len(varying(self.process))), int(rng.integers(2**31))
        return draw_at(self.process, scores if place % 2 == 0 else -scores, roughness + place % 2)

    def look(self, step: int) -> StepSources:
        """Sources of a step: those of other steps, or others about them."""
        seed, scene = self.spec.optimize.seed, self.spec.scene
        look = self.scene.look(seed, step)
        if self.ranges is None:
            return look
        near, far = self.scene.chosen_depths(seed, step)
        depths_m = [scene.near_m[number] for number in near], [scene.far_m[number] for number in far]
        return self.ranges.look(self.problem, look, self.ranges.places(depths_m, seed, step))

    def plate(self, level: UInt8[np.ndarray, "y x"], variation: Variation) -> Problem:
        """The problem with a plate as fabricated: its deviation from the heights of a level map."""
        parametrization, optic = self.problem.parametrization, self.problem.optic
        cells = np.asarray(parametrization.cells(jnp.asarray(level)))
        camera = self.problem.camera
        cells = np.where(self.spec.doe.relief.inside(camera.grid), cells, parametrization.levels.count - 1)
        made = as_fabricated(cells.astype(np.uint8), camera, self.process, variation, whole_cells=True)
        assert isinstance(optic, HeightOptic)
        made_as = optic.made_as(made, parametrization.drawn_height(cells))
        return replace(self.problem, optic=jax.block_until_ready(made_as))

    def steps(self, state: RobustState, done: int) -> Iterator[tuple[RobustState, dict[str, Any]]]:
        """Run the robust steps that are left.

        Args:
            state: that before.
            done: number of robust steps done.

        Yields:
            the state after each step, and the line of the history: the risk before it, and every term's mean over the
            plates.

        Raises:
            InputError: errors beyond what the model describes, or a loss that is no longer finite.
        """
        optimiser, parametrization = self.optimiser, self.problem.parametrization
        plates: list[Problem] = []
        for step in range(done, self.robust.steps):
            round_, place = divmod(step, ROUND)
            if place == 0:
                state = state._replace(worst=self.worst_of(state, round_ - 1), losses=np.zeros_like(state.losses))
            level = state.level
            if not plates or place == 0:
                plates = []  # before others take memory
                plates = list(at_once(partial(self.plate, level), self.variations(round_, state.worst)))
            height = parametrization.drawn_height(level)
            look = self.look(self.spec.optimize.steps + step)
            seen, share = self.seen(place)
            found = [value_and_slope(plates[number], height, look) for number in seen]
            losses = np.array([float(loss) for loss, _, _ in found], np.float32)
            if not np.all(np.isfinite(losses)):
                cure = "Lower robust.learning_rate."
                raise InputError(f"robust, step {step}", "losses must stay finite", losses.tolist(), cure)
            risk, weights = risk_of(losses, self.robust)
            slope = _weighted([gradient for _, _, gradient in found], share * weights)
            before = state.parameters, state.adam
            parameters, adam = moved_phases(optimiser, parametrization, before, slope, height)
            if place + 1 == ROUND or step + 1 == self.robust.steps:
                wanted = parametrization.level(parametrization.continuous_m(parameters.radians))
                level = self.rules.nearer(level, np.asarray(wanted).astype(np.uint8))
            summed = state.losses.copy()
            summed[seen.start : seen.stop] += losses
            state = RobustState(parameters, adam, level, state.worst, summed)
            terms = np.mean([np.asarray(terms) for _, terms, _ in found], axis=0)
            record = {"step": self.spec.optimize.steps + step, "loss": risk, "terms": terms.tolist()}
            yield state, record | {"names": [term.name for term in self.problem.terms]}


def wall_costs(process: Process, pixel_m: float) -> list[float]:
    """Cost of a wall of every mask, as long as a pixel: the light that goes astray beside it.

    The edges of a mask are off by overlay and line width; a strip as wide as the mean of that, sqrt(2 / pi) times its
    root mean square for normal errors, has the phase of the mask's depth too much or too little, and 1 - cos of it
    counts as in `fab.rules.repair`. The waves of depth are those of the period of the staircase.

    Args:
        process: the process.
        pixel_m: side of a pixel, metres.
    """
    levels, costs = process.levels, []
    for mask, depth_m in enumerate(levels.depths_m):
        overlay = [process.spreads.get(f"overlay_{axis}_m[{mask}]", Normal()) for axis in "yx"]
        width = [process.spreads.get(name, Normal()) for name in ("common_cd_bias_m", f"cd_bias_m[{mask}]")]
        square = sum(one.mean**2 + one.sigma**2 for one in overlay) / 2
        square += sum(one.sigma**2 for one in width) + sum(one.mean for one in width) ** 2
        strip = min(np.sqrt(2 / np.pi * square) / pixel_m, 1.0)
        costs.append(float(strip * (1 - np.cos(2 * np.pi * depth_m / levels.period_m))))
    return costs


def risk_of(losses: Float[np.ndarray, " draw"], robust: RobustSpec) -> tuple[float, Float[np.ndarray, " draw"]]:
    """Risk of the losses of some plates, and its derivative with respect to each.

    Args:
        losses: `[draw]`.
        robust: which risk (`RobustSpec.measure`).
    """
    count = len(losses)
    if robust.measure == "cvar":
        # The mean of the worst share; of the last plate that belongs to it, the part that does.
        left = robust.share * count
        weights = np.zeros(count)
        for number in np.argsort(-losses, kind="stable"):
            weights[number] = min(left, 1.0) / (robust.share * count)
            left -= min(left, 1.0)
        return float(weights @ losses), weights
    if robust.measure == "yield":
        assert robust.limit is not None
        width = _SOFT * robust.limit
        bad = 1 / (1 + np.exp(-(losses - robust.limit) / width))
        return float(bad.mean()), bad * (1 - bad) / width / count
    return float(losses.mean()), np.full(count, 1 / count)


@jax.jit
def _weighted(slopes: Sequence[Array], weights: Array) -> Array:
    return sum((weight * slope for weight, slope in zip(weights, slopes, strict=True)), jnp.zeros(()))
