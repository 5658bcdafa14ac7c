"""The search for the errors that make the model's images the measured ones.

1. Gauss-Newton steps with Levenberg's damping follow the model's slopes from what is believed. A step is the minimum of
   the linearised problem within the range; where that end is not free, NLopt's sequential quadratic programming (SLSQP)
   finds it.
2. If that leaves the images unexplained, NLopt's controlled random search (CRS2) looks through the whole range with a
   bounded number of models, and the steps begin again at the best of them.
3. On request SLSQP follows the exact gradient of the objective, taken backwards through light and plate.

Weights come from the measurement at first and from the model as soon as that explains what is seen.
"""

from collections.abc import Callable, Sequence
from itertools import count
from typing import NamedTuple

import nlopt
import numpy as np
from jaxtyping import Float

from doedesign.calibration.objective import (
    WIDEST_STEP,
    Evaluation,
    FitObjective,
    Linearization,
    OnModel,
    Weights,
    difference_steps,
    linearised,
    look,
    look_and_gradient,
    matched,
    slopes_at,
)
from doedesign.calibration.target import measured_weights, weights_at

_ROUNDS = 15
_GIVE_UP = 1e5  # damping at which no step helps any more
_SETTLED = 0.1  # standard deviations of the result that a last step may still move
# Relative error of the plate's light that the model expects of itself (`sim.surface`), beside the transform's.
_PLATE_ERROR = 4e-3
_EXPLAINED = 3.0  # squares per pixel below which the model knows the noise better than the pixels do


class Fit(NamedTuple):
    """Where the search ended.

    Attributes:
        lens: the linearised model.
        weights: inverse variance of every pixel.
        models: plates that were computed.
    """

    lens: Linearization
    weights: Weights
    models: int


def search(
    question: FitObjective,
    *,
    evaluations: int = 0,
    polish: int = 0,
    seed: int = 0,
    on_model: OnModel = lambda _: None,
) -> Fit:
    """Find the errors.

    Args:
        question: images and bench.
        evaluations: models that the global search may look at where steps from what is believed leave the images
            unexplained; 0 to leave it out.
        polish: exact gradients that the last stage may take; 0 to leave it out.
        seed: seed of the global search.
        on_model: told of every plate, with words on how it goes.

    Returns:
        the model at the best scores found, linearised, with weights from the model itself where that explains the
        images.
    """
    counted = count(1)

    def tell(words: str) -> None:
        next(counted)  # several threads count
        on_model(words)

    flat = question.bench.plate(question.bench.unknowns.start)
    errors = [float(np.hypot(flat.expected_error(i), _PLATE_ERROR)) for i in range(len(question.targets))]
    measured = tuple(measured_weights(t, e) for t, e in zip(question.targets, errors, strict=True))
    lens, weights = _gauss_newton(question, errors, measured, question.start(), tell)
    if evaluations and lens.look.squares > _EXPLAINED * question.pixels:
        again = _global(question, measured, question.start(), evaluations, seed, tell)
        other = _gauss_newton(question, errors, measured, again, tell)
        # Compared under the weights that know nothing of either.
        found = [_objective(question, measured, one.look) for one in (lens, other[0])]
        if found[1] < found[0]:
            lens, weights = other
    if polish:
        after = _polish(question, weights, lens, polish, tell)
        if after is not lens.look:
            slopes = slopes_at(question, after, difference_steps(lens.spread), tell)
            lens = linearised(question, weights, after, slopes)
    return Fit(lens, weights, next(counted) - 1)


def _objective(question: FitObjective, weights: Weights, at: Evaluation) -> float:
    return at._replace(matches=matched(question, weights, at.images)).objective


def _renewed(question: FitObjective, errors: Sequence[float], at: Evaluation) -> Weights:
    """Weights from the model's own images."""
    each = zip(question.targets, at.matches, at.images, errors, strict=True)
    return tuple(weights_at(t, m.gain * image, e, max(m.background, 0.0)) for t, m, image, e in each)


def _global(
    question: FitObjective,
    weights: Weights,
    scores: Float[np.ndarray, " s"],
    evaluations: int,
    seed: int,
    tell: OnModel,
) -> Float[np.ndarray, " s"]:
    """Best scores of a controlled random search over the errors; images stay where they were found."""
    unknowns, errors = question.bench.unknowns, question.errors
    best: list[tuple[float, np.ndarray]] = []

    def objective(point: np.ndarray, _: np.ndarray) -> float:
        # The range is a box in values; scores of related errors are not.
        value = np.clip(point, unknowns.low, unknowns.high)
        at = look(question, weights, np.concatenate([unknowns.scores(value), scores[errors:]]))
        if not best or at.objective < best[0][0]:
            best[:] = [(at.objective, at.scores)]
        tell(f"global, {best[0][0] / question.pixels:.4g} per pixel")
        return at.objective

    optimiser = nlopt.opt(nlopt.GN_CRS2_LM, errors)
    nlopt.srand(seed + 1)  # 0 would take the time
    # Twice the standard deviation: the local search finds what lies beyond.
    low = np.maximum(unknowns.low, unknowns.mean - 2 * unknowns.sigma)
    high = np.minimum(unknowns.high, unknowns.mean + 2 * unknowns.sigma)
    optimiser.set_lower_bounds(low)
    optimiser.set_upper_bounds(high)
    optimiser.set_population(min(5 * (errors + 1), max(evaluations // 2, errors + 1)))
    optimiser.set_min_objective(objective)
    optimiser.set_maxeval(evaluations)
    optimiser.optimize(np.clip(question.values(scores), low, high))
    return best[0][1]


def _gauss_newton(
    question: FitObjective, errors: Sequence[float], weights: Weights, scores: Float[np.ndarray, " s"], tell: OnModel
) -> tuple[Linearization, Weights]:
    """Damped Gauss-Newton steps until they no longer matter; returns the last linearised model and its weights."""
    at, damping = look(question, weights, scores), 1e-3
    steps = np.full(len(scores), WIDEST_STEP)
    for _ in range(_ROUNDS):
        slopes = slopes_at(question, at, steps, tell)
        if at.squares < _EXPLAINED * question.pixels:
            weights = _renewed(question, errors, at)
            at = at._replace(matches=matched(question, weights, at.images))
        lens = linearised(question, weights, at, slopes)
        spread = lens.spread
        while damping < _GIVE_UP:
            after = look(question, weights, at.scores + _bounded_step(question, lens, damping))
            tell(f"{min(after.squares, at.squares) / question.pixels:.4g} per pixel")
            if after.objective < at.objective:
                break
            if (np.abs(after.scores - at.scores) < _SETTLED * spread).all():
                return lens, weights
            damping *= 4
        else:
            return lens, weights
        at, damping, moved = after, max(damping / 5, 1e-6), np.abs(after.scores - at.scores)
        # So short a step leaves the slopes what they are.
        if (moved < _SETTLED * spread).all():
            return linearised(question, weights, at, slopes), weights
        steps = difference_steps(spread)
    return linearised(question, weights, at, slopes_at(question, at, steps, tell)), weights


def _bounded_step(question: FitObjective, lens: Linearization, damping: float) -> Float[np.ndarray, " s"]:
    """Minimum of the linearised objective, damped, within the range of every error."""
    scores = lens.look.scores
    half = lens.half_hessian
    damped = half + damping * np.diag(np.diag(half))
    downhill = sum(lens.descents, -scores)
    free = np.linalg.solve(damped, downhill)
    level, steep = _range(question, scores)
    if (level + steep @ free <= 0).all():
        return free
    turn = np.linalg.inv(np.linalg.cholesky(damped)).T
    centre = np.linalg.solve(turn, free)

    def objective(point: np.ndarray, gradient: np.ndarray) -> float:
        if gradient.size:
            gradient[:] = point - centre
        return 0.5 * float((point - centre) @ (point - centre))

    return turn @ _slsqp(objective, level, steep @ turn, 200, 1e-6)


def _range(question: FitObjective, scores: Float[np.ndarray, " s"]) -> tuple[np.ndarray, np.ndarray]:
    """The ends of the errors' range as level + steep @ step <= 0, in standard deviations."""
    unknowns, errors = question.bench.unknowns, question.errors
    side = np.concatenate([np.eye(errors), -np.eye(errors)]) / np.tile(unknowns.sigma, 2)[:, None]
    ends = np.concatenate([unknowns.high, -unknowns.low]) / np.tile(unknowns.sigma, 2)
    steep = np.zeros((2 * errors, len(scores)))
    steep[:, :errors] = side @ unknowns.root
    return side @ question.values(scores) - ends, steep


def _polish(question: FitObjective, weights: Weights, lens: Linearization, steps: int, tell: OnModel) -> Evaluation:
    """Follow the exact gradient from a linearised model, in scores turned so that its Hessian is the identity."""
    start = lens.look.scores
    turn = np.linalg.cholesky(np.linalg.inv(lens.half_hessian))
    best = [lens.look]

    def objective(point: np.ndarray, gradient: np.ndarray) -> float:
        at, slope = look_and_gradient(question, weights, start + turn @ point)
        if at.objective < best[0].objective:
            best[0] = at
        tell(f"{best[0].squares / question.pixels:.4g} per pixel")
        if gradient.size:
            gradient[:] = turn.T @ slope / 2
        return at.objective / 2

    level, steep = _range(question, start)
    _slsqp(objective, level, steep @ turn, steps, 1e-2)
    return best[0]


def _slsqp(
    objective: Callable[[np.ndarray, np.ndarray], float],
    level: Float[np.ndarray, " c"],
    steep: Float[np.ndarray, "c s"],
    steps: int,
    tolerance: float,
) -> Float[np.ndarray, " s"]:
    """Minimise from zero on with level + steep @ point <= 0."""
    last = [np.zeros(steep.shape[1])]

    def remembered(point: np.ndarray, gradient: np.ndarray) -> float:
        last[0] = point.copy()
        return objective(point, gradient)

    def beyond(result: np.ndarray, point: np.ndarray, gradient: np.ndarray) -> None:
        result[:] = level + steep @ point
        if gradient.size:
            gradient[:] = steep

    optimiser = nlopt.opt(nlopt.LD_SLSQP, steep.shape[1])
    optimiser.set_min_objective(remembered)
    optimiser.add_inequality_mconstraint(beyond, np.full(len(level), 1e-9))
    optimiser.set_maxeval(steps)
    optimiser.set_ftol_abs(tolerance)
    optimiser.set_xtol_abs(tolerance)
    try:
        return optimiser.optimize(last[0])
    except nlopt.RoundoffLimited:
        return last[0]  # single precision has no finer slope
    except RuntimeError as error:
        if not str(error).startswith("nlopt"):
            raise
        return last[0]
