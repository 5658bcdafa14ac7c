"""The search for the errors that make the model's images the measured ones.

1. `scipy.optimize.least_squares` (dogbox: Gauss-Newton within a trust region and the errors' range) follows the model's
   differences from the prior means.
2. If that leaves the images unexplained, NLopt's controlled random search (CRS2) looks through the whole range with a
   bounded number of models, and the steps begin again at the best of them.
3. On request `scipy.optimize.minimize` (SLSQP) follows the exact gradient, taken backwards through light and DOE.

Weights come from the measurement at first and from the model as soon as that explains the images.
"""

from collections.abc import Sequence
from contextlib import suppress
from itertools import count
from typing import Any, NamedTuple

import nlopt
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.optimize import LinearConstraint, least_squares, minimize

from doedesign.calibration.objective import (
    WIDEST_STEP,
    Evaluation,
    FitObjective,
    Jacobian,
    Linearization,
    OnModel,
    Weights,
    difference_jacobian,
    difference_steps,
    evaluate,
    evaluate_with_gradient,
    image_jacobians,
    image_residuals,
    linearised,
    matched,
)
from doedesign.calibration.target import measured_weights, weights_at

_ROUNDS = 15
_MOST_TRIALS = 60  # of one round
_TRUSTED = 5.0  # prior standard deviations of the first step
_FINEST = 1e-6  # relative; such steps are lost in the single precision of the light
_SETTLED = 0.1  # standard deviations of the result that a last step may still move
# Relative error of the DOE's light that the model expects of itself (`sim.surface`), beside the transform's.
_DOE_ERROR = 4e-3
_EXPLAINED = 3.0  # chi2 per pixel below which the model knows the noise better than the pixels do


class Fit(NamedTuple):
    """Where the search ended.

    Attributes:
        linearization: the model at the best scores.
        weights: inverse variance of every pixel.
        models: fabricated DOEs that were computed; a central difference counts as one.
    """

    linearization: Linearization
    weights: Weights
    models: int

    @property
    def at(self) -> Evaluation:
        """The model at the best scores."""
        return self.linearization.at


def search(
    objective: FitObjective,
    *,
    evaluations: int = 0,
    polish: int = 0,
    seed: int = 0,
    on_model: OnModel = lambda _: None,
) -> Fit:
    """Find the errors.

    Args:
        objective: images and model.
        evaluations: models that the global search may compute where steps from the prior leave the images unexplained;
            0 to leave it out.
        polish: steps along the exact gradient at the end; 0 to leave it out.
        seed: seed of the global search.
        on_model: called after every model, with words on how it goes.

    Returns:
        the model at the best scores, linearised, with weights from the model itself where that explains the images.
    """
    counted = count(1)

    def tell(words: str) -> None:
        next(counted)  # several threads count
        on_model(words)

    nominal = objective.model.plate(objective.unknowns.start)
    errors = [float(np.hypot(nominal.expected_error(i), _DOE_ERROR)) for i in range(len(objective.targets))]
    measured = tuple(measured_weights(t, e) for t, e in zip(objective.targets, errors, strict=True))
    start = evaluate(objective, measured, objective.start(), nominal)
    found, weights = _local(objective, errors, measured, start, tell)
    if evaluations and found.at.chi2 > _EXPLAINED * objective.pixels:
        again = _global(objective, measured, start.scores, evaluations, seed, tell)
        other = _local(objective, errors, measured, again, tell)
        # Compared under the weights that know nothing of either.
        costs = [_reweighted(objective, measured, one.at).cost for one in (found, other[0])]
        if costs[1] < costs[0]:
            found, weights = other
    if polish:
        after = _polish(objective, weights, found, polish, tell)
        if after is not found.at:
            jacobian = difference_jacobian(objective, after, difference_steps(found.sigma), tell)
            found = linearised(objective, weights, after, jacobian)
    return Fit(found, weights, next(counted) - 1)


def _reweighted(objective: FitObjective, weights: Weights, at: Evaluation) -> Evaluation:
    return at._replace(matches=matched(objective, weights, at.images))


def _model_weights(objective: FitObjective, errors: Sequence[float], at: Evaluation) -> Weights:
    """Weights from the model's own images."""
    each = zip(objective.targets, at.matches, at.images, errors, strict=True)
    return tuple(weights_at(t, m.gain * image, e, max(m.background, 0.0)) for t, m, image, e in each)


def _global(
    objective: FitObjective,
    weights: Weights,
    scores: Float[np.ndarray, " s"],
    evaluations: int,
    seed: int,
    tell: OnModel,
) -> Evaluation:
    """Best model of a controlled random search over the errors; images stay where they were found."""
    unknowns, errors = objective.unknowns, objective.errors
    best: list[Evaluation] = []

    def cost(point: np.ndarray, _: np.ndarray) -> float:
        # The range is a box in values; scores of related errors are not.
        value = np.clip(point, unknowns.low, unknowns.high)
        at = evaluate(objective, weights, np.concatenate([unknowns.scores(value), scores[errors:]]))
        if not best or at.cost < best[0].cost:
            best[:] = [at]
        tell(f"global, {best[0].cost / objective.pixels:.4g} per pixel")
        return at.cost

    optimiser = nlopt.opt(nlopt.GN_CRS2_LM, errors)
    nlopt.srand(seed + 1)  # 0 would take the time
    # Twice the standard deviation: the local search finds what lies beyond.
    low = np.maximum(unknowns.low, unknowns.mean - 2 * unknowns.sigma)
    high = np.minimum(unknowns.high, unknowns.mean + 2 * unknowns.sigma)
    optimiser.set_lower_bounds(low)
    optimiser.set_upper_bounds(high)
    optimiser.set_population(min(5 * (errors + 1), max(evaluations // 2, errors + 1)))
    optimiser.set_min_objective(cost)
    optimiser.set_maxeval(evaluations)
    optimiser.optimize(np.clip(objective.values(scores), low, high))
    return best[0]


def _local(
    objective: FitObjective, errors: Sequence[float], weights: Weights, at: Evaluation, tell: OnModel
) -> tuple[Linearization, Weights]:
    """Least-squares fits from a model on, each with the weights of the last one's images."""
    jacobian = difference_jacobian(objective, at, np.full(len(at.scores), WIDEST_STEP), tell)
    for _ in range(_ROUNDS):
        explained = at.chi2 < _EXPLAINED * objective.pixels
        if explained:
            weights = _model_weights(objective, errors, at)
            at = _reweighted(objective, weights, at)
        fitting = _LeastSquares(objective, weights, linearised(objective, weights, at, jacobian), explained, tell)
        before, at, jacobian = at, *fitting.solve()
        if not at.chi2 < _EXPLAINED * objective.pixels or _settled(fitting.found, before, at):
            break
    return linearised(objective, weights, at, jacobian), weights


def _settled(around: Linearization, before: Evaluation, after: Evaluation) -> bool:
    """Whether a step is so short that the derivatives stay what they are."""
    return bool((np.abs(after.scores - before.scores) < _SETTLED * around.sigma).all())


class _Converged(Exception):
    """Ends a `least_squares` whose steps no longer matter; that function cannot count them in standard deviations."""


class _LeastSquares:
    """One bounded least-squares fit with constant weights.

    Its variables are the errors in standard deviations of their prior, whose range is a box, and the motions' scores;
    all are offset so that they begin at the size of the first trust region, which dogbox takes from them. A fit from
    images that are not yet explained ends as soon as they are, for then there are better weights.
    """

    def __init__(
        self, objective: FitObjective, weights: Weights, start: Linearization, explained: bool, tell: OnModel
    ) -> None:
        self.objective, self.weights, self.found, self.tell = objective, weights, start, tell
        self.best, self.explained = start.at, explained
        unknowns, motions = objective.unknowns, len(objective.motions)
        errors = np.linalg.solve(unknowns.root, np.diag(unknowns.sigma))
        self.scores_per_x = np.asarray(block_diag(errors, np.eye(motions)), np.float64)
        ends = [(end - unknowns.mean) / unknowns.sigma for end in (unknowns.low, unknowns.high)]
        free, start_x = np.full(motions, np.inf), np.linalg.solve(self.scores_per_x, start.at.scores)
        self.origin = np.clip(start_x, [*ends[0], *-free], [*ends[1], *free]) - _TRUSTED
        self.bounds = ([*ends[0], *-free] - self.origin, [*ends[1], *free] - self.origin)

    def solve(self) -> tuple[Evaluation, Jacobian]:
        """The best evaluation, and the derivatives there or next to it."""
        start = np.full(len(self.origin), _TRUSTED)
        stops: dict[str, Any] = {"ftol": None, "xtol": _FINEST, "gtol": None, "max_nfev": _MOST_TRIALS}
        with suppress(_Converged):
            least_squares(self._residuals, start, self._jacobian, self.bounds, method="dogbox", **stops)  # pyright: ignore
        return self.best, self.found.jacobian

    def _residuals(self, x: Float[np.ndarray, " x"]) -> Float[np.ndarray, " n"]:
        scores = self.scores_per_x @ (self.origin + x)
        at = self.best
        if not np.allclose(scores, at.scores, rtol=0, atol=1e-12):
            at = evaluate(self.objective, self.weights, scores)
            self.tell(f"{min(at.chi2, self.best.chi2) / self.objective.pixels:.4g} per pixel")
            if at.cost >= self.best.cost and _settled(self.found, self.best, at):
                raise _Converged
        if at.cost < self.best.cost:
            self.best = at
        return np.concatenate([*image_residuals(self.objective, self.weights, at), at.scores])

    def _jacobian(self, x: Float[np.ndarray, " x"]) -> Float[np.ndarray, "n x"]:
        """Derivatives at the best scores, for a step is taken only where the cost falls."""
        if (at := self.best) is not self.found.at:
            if _settled(self.found, self.found.at, at):
                raise _Converged
            jacobian = difference_jacobian(self.objective, at, difference_steps(self.found.sigma), self.tell)
            self.found = linearised(self.objective, self.weights, at, jacobian)
            if not self.explained and at.chi2 < _EXPLAINED * self.objective.pixels:
                raise _Converged
        rows = image_jacobians(self.objective, self.weights, at, self.found.jacobian)
        return np.concatenate([*rows, np.eye(len(at.scores))], axis=1).T @ self.scores_per_x


def _polish(objective: FitObjective, weights: Weights, found: Linearization, steps: int, tell: OnModel) -> Evaluation:
    """Follow the exact gradient, in scores turned so that the Hessian is the identity; within the errors' range."""
    start, unknowns = found.at.scores, objective.unknowns
    turn = np.linalg.cholesky(np.linalg.inv(found.half_hessian))
    best = [found.at]

    def cost(point: np.ndarray) -> tuple[float, np.ndarray]:
        at, gradient = evaluate_with_gradient(objective, weights, start + turn @ point)
        if at.cost < best[0].cost:
            best[0] = at
        tell(f"{best[0].chi2 / objective.pixels:.4g} per pixel")
        return at.cost / 2, turn.T @ gradient / 2

    # In prior standard deviations, so that all constraints are of a size.
    slope = (unknowns.root @ turn[: objective.errors]) / unknowns.sigma[:, None]
    room = [(end - objective.values(start)) / unknowns.sigma for end in (unknowns.low, unknowns.high)]
    inside = LinearConstraint(slope, *room)  # pyright: ignore[reportArgumentType] - bounds may be arrays
    options = {"maxiter": steps, "ftol": 1e-2}
    minimize(cost, np.zeros(len(start)), method="SLSQP", jac=True, constraints=inside, options=options)
    return best[0]
