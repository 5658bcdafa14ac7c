"""The search for the errors that make the model's images the measured ones.

1. `scipy.optimize.least_squares` (dogbox: Gauss-Newton within a trust region and the errors' range) follows the model's
   differences from the prior means.
2. If that explains hardly more than the design does, the same begins again with all images a pixel elsewhere: found by
   their likeness to a plate that is quite different, they may lie off by more than a grain of the light.
   If the images stay unexplained, NLopt's controlled random search (CRS2) looks through the whole range with a bounded
   number of models, and the steps begin again at the best of them.
3. On request `scipy.optimize.minimize` (SLSQP) follows the exact gradient, taken backwards through light and DOE.

Weights come from the measurement at first and from the model as soon as that explains the images.
"""

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import nlopt
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.optimize import LinearConstraint, least_squares, minimize

from doedesign.calibration.geometry import REACH
from doedesign.calibration.objective import WIDEST_STEP, Evaluation, FitObjective, Jacobian, Linearization, OnModel
from doedesign.calibration.target import measured_weights, weights_at
from doedesign.search import run_search
from fab.errors import InputError

_ROUNDS = 15
_MOST_TRIALS = 60  # of one round
_TRUSTED = 5.0  # prior standard deviations of the first step
_FINEST = 1e-6  # relative; such steps are lost in the single precision of the light
_SETTLED = 0.1  # standard deviations of the result that a last step may still move
# Relative error of the DOE's light that the model expects of itself (`sim.surface`), beside the transform's.
_DOE_ERROR = 4e-3
# Pixels (y, x) by which images may lie off where they look most like the design, beside a fraction of one.
_SHIFTS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
_ASTRAY = 0.05  # of the chi2 of the plate that the search begins with: where more is left, it went astray
_EXPLAINED = 3.0  # chi2 per pixel below which the model knows the noise better than the pixels do


def search(
    objective: FitObjective,
    *,
    evaluations: int = 0,
    polish: int = 0,
    seed: int = 0,
    on_model: OnModel = lambda _: None,
) -> Linearization:
    """Find the errors.

    Args:
        objective: images and model.
        evaluations: models that the global search may compute; 0 to leave it and the shifted starts out.
        polish: steps along the exact gradient at the end; 0 to leave it out.
        seed: seed of the global search.
        on_model: called after every model (a central difference counts as one) from several threads, with words on how
            it goes.

    Returns:
        the model at the best scores, linearised, with weights from the model itself where that explains the images.
    """
    model, unknowns, targets = objective.model, objective.unknowns, objective.targets
    nominal = model.plate(unknowns.start)
    transforms = (model.optic(i, nominal.grid).plan for i in range(len(targets)))
    errors = [float(np.hypot(plan.expected_error, _DOE_ERROR)) for plan in transforms]
    measured = tuple(map(measured_weights, targets, errors))
    scores = np.concatenate([unknowns.scores(unknowns.start), np.zeros(objective.scores - objective.errors)])
    start = objective.evaluate(measured, scores, nominal)
    found = _local(start, errors, on_model)
    for shift in _SHIFTS if evaluations else ():
        if found.at.chi2 <= max(_ASTRAY * start.chi2, _EXPLAINED * objective.pixels):
            break
        other = _local(_shifted(start, shift), errors, on_model)
        found = min(found, other, key=lambda one: one.at.reweighted(measured).cost)
    if evaluations and found.at.chi2 > _EXPLAINED * objective.pixels:
        other = _local(_global(start, evaluations, seed, on_model), errors, on_model)
        # Compared under the weights that know nothing of either.
        found = min(found, other, key=lambda one: one.at.reweighted(measured).cost)
    if polish:
        after = _polish(found, polish, on_model)
        if after is not found.at:
            found = after.linearised(after.difference_jacobian(found.steps, on_model))
    return found


def _shifted(start: Evaluation, shift: tuple[int, int]) -> Evaluation:
    """The same model with all images moved by some pixels."""
    objective, scores = start.objective, start.scores.copy()
    for i in range(len(objective.targets)):
        for place, (kind, unit) in objective.motion_units(i).items():
            scores[place] += shift[kind] / unit if kind < len(shift) else 0.0
    return objective.evaluate(start.weights, scores, start.doe)


def _global(start: Evaluation, evaluations: int, seed: int, on_model: OnModel) -> Evaluation:
    """Best model of a controlled random search over the errors; images stay where they were found."""
    objective = start.objective
    unknowns, errors = objective.unknowns, objective.errors
    best: Evaluation | None = None
    worst = start.cost

    def cost(point: np.ndarray, _: np.ndarray) -> float:
        nonlocal best, worst
        # The range is a box in values; scores of related errors are not.
        value = np.clip(point, unknowns.low, unknowns.high)
        try:
            at = objective.evaluate(start.weights, np.concatenate([unknowns.scores(value), start.scores[errors:]]))
        except InputError:  # errors that are beyond the model together
            return 2 * worst
        best, worst = min(best or at, at, key=lambda one: one.cost), max(worst, at.cost)
        on_model(f"global, {best.cost / objective.pixels:.4g} per pixel")
        return at.cost

    optimiser = nlopt.opt(nlopt.GN_CRS2_LM, errors)
    nlopt.srand(seed + 1)  # 0 would take the time
    # Twice the standard deviation: the local search finds what lies beyond. The mean may lie outside the range.
    middle = np.clip(unknowns.mean, unknowns.low, unknowns.high)
    low = np.maximum(unknowns.low, middle - 2 * unknowns.sigma)
    high = np.minimum(unknowns.high, middle + 2 * unknowns.sigma)
    optimiser.set_lower_bounds(low)
    optimiser.set_upper_bounds(high)
    optimiser.set_population(min(5 * (errors + 1), max(evaluations // 2, errors + 1)))
    optimiser.set_maxeval(evaluations)
    run_search(optimiser, cost, np.clip(objective.values(start.scores), low, high))
    return best or start


def _local(at: Evaluation, errors: Sequence[float], on_model: OnModel) -> Linearization:
    """Least-squares fits from a model on, each with the weights of the last one's images."""
    most = _EXPLAINED * at.objective.pixels
    jacobian = at.difference_jacobian(np.full(len(at.scores), WIDEST_STEP), on_model)
    for _ in range(_ROUNDS):
        explained = bool(at.chi2 < most)
        if explained:
            each = zip(at.matches, errors, strict=True)
            at = at.reweighted(
                tuple(weights_at(m.target, m.gain * m.model, e, max(m.background, 0.0)) for m, e in each)
            )
        fitting = _LeastSquares(at.linearised(jacobian), explained, on_model)
        before, at, jacobian = at, *fitting.solve()
        if not at.chi2 < most or _settled(fitting.found, before, at):
            break
    return at.linearised(jacobian)


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

    def __init__(self, start: Linearization, explained: bool, on_model: OnModel) -> None:
        self.found, self.best, self.explained, self.on_model = start, start.at, explained, on_model
        self.objective = start.at.objective
        unknowns, motions = self.objective.unknowns, self.objective.scores - self.objective.errors
        errors = np.linalg.solve(unknowns.root, np.diag(unknowns.sigma))
        self.scores_per_x = np.asarray(block_diag(errors, np.eye(motions)), np.float64)
        ends = [(end - unknowns.mean) / unknowns.sigma for end in (unknowns.low, unknowns.high)]
        start_x = np.linalg.solve(self.scores_per_x, start.at.scores)
        # Images may move anywhere, the camera only as far as the model follows it.
        free = np.full(motions, np.inf)
        free[: self.objective.shared - self.objective.errors] = REACH
        self.origin = np.clip(start_x, [*ends[0], *-free], [*ends[1], *free]) - _TRUSTED
        # Where it begins at an end of the range, rounding may not put it beyond.
        low, high = [*ends[0], *-free] - self.origin, [*ends[1], *free] - self.origin
        self.bounds = (np.minimum(low, _TRUSTED), np.maximum(high, _TRUSTED))

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
            try:
                at = self.objective.evaluate(at.weights, scores)
            except InputError:  # errors that are beyond the model together: dogbox takes a shorter step
                return np.full(sum(len(found.residuals()) for found in at.matches) + len(scores), np.nan)
            self.on_model(f"{min(at.chi2, self.best.chi2) / self.objective.pixels:.4g} per pixel")
            if at.cost >= self.best.cost and _settled(self.found, self.best, at):
                raise _Converged
        if at.cost < self.best.cost:
            self.best = at
        return np.concatenate([*(found.residuals() for found in at.matches), at.scores])

    def _jacobian(self, x: Float[np.ndarray, " x"]) -> Float[np.ndarray, "n x"]:
        """Derivatives at the best scores, for a step is taken only where the cost falls."""
        if (at := self.best) is not self.found.at:
            if _settled(self.found, self.found.at, at):
                raise _Converged
            self.found = at.linearised(at.difference_jacobian(self.found.steps, self.on_model))
            if not self.explained and at.chi2 < _EXPLAINED * self.objective.pixels:
                raise _Converged
        rows = self.found.jacobian.of_residuals(at)
        return np.concatenate([*rows, np.eye(len(at.scores))], axis=1).T @ self.scores_per_x


def _polish(found: Linearization, steps: int, on_model: OnModel) -> Evaluation:
    """Follow the exact gradient, in scores turned so that the Hessian is the identity; within the errors' range."""
    objective, start = found.at.objective, found.at.scores
    unknowns = objective.unknowns
    turn = np.linalg.cholesky(np.linalg.inv(found.half_hessian))
    best = [found.at]

    def cost(point: np.ndarray) -> tuple[float, np.ndarray]:
        at, gradient = objective.evaluate_with_gradient(found.at.weights, start + turn @ point)
        if at.cost < best[0].cost:
            best[0] = at
        on_model(f"{best[0].chi2 / objective.pixels:.4g} per pixel")
        return at.cost / 2, turn.T @ gradient / 2

    # In prior standard deviations, so that all constraints are of a size.
    slope = (unknowns.root @ turn[: objective.errors]) / unknowns.sigma[:, None]
    room = [(end - objective.values(start)) / unknowns.sigma for end in (unknowns.low, unknowns.high)]
    inside = LinearConstraint(slope, *room)  # pyright: ignore[reportArgumentType] - bounds may be arrays
    options = {"maxiter": steps, "ftol": 1e-2}
    minimize(cost, np.zeros(len(start)), method="SLSQP", jac=True, constraints=inside, options=options)
    return best[0]
