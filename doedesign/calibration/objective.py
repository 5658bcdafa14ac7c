"""Least-squares objective of a calibration: measured images, the model that should explain them, and how well it does.

Errors and motions are scores, in standard deviations of their prior, so the objective is

    chi2 + prior  =  sum over images of sum of weight * residual²  +  sum of score²

Jacobians are central differences. They are quick: all of them together cost what one exact gradient does, for a
derivative through a fabricated DOE takes twenty to forty times as long as the DOE. And they are what is wanted: where
edges of two masks coincide, as all do without errors, slivers open whichever way a mask moves, so the light has a cusp
there and a derivative to one side says nothing of the other. The exact gradient serves the last polish of a fit.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.calibration.forward_model import DoeImages, ForwardModel, VariedDoe
from doedesign.calibration.target import Match, Target, match, residual_jacobian, residuals
from doedesign.calibration.unknowns import Unknowns

_SHIFT_SIGMA = 2.0  # pixels by which an image may lie off where it was found
WIDEST_STEP, _NARROWEST_STEP = 0.05, 0.004  # scores, for central differences
_MOST_THREADS = 8  # each holds a fabricated DOE, 0.3 GB for 2400 x 2400 cells

Weights = tuple[Float[np.ndarray, "y x"], ...]
OnModel = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class FitObjective:
    """Measured images and the model that should explain them."""

    model: ForwardModel
    targets: tuple[Target, ...]

    @property
    def unknowns(self) -> Unknowns:
        """The errors looked for."""
        return self.model.unknowns

    @property
    def errors(self) -> int:
        """Number of errors looked for; the scores after them are motions."""
        return len(self.unknowns.names)

    @property
    def motions(self) -> tuple[tuple[int, int], ...]:
        """Image and kind (0 y, 1 x, 2 defocus) of every score after the errors."""
        return tuple(
            (i, kind) for i, t in enumerate(self.targets) for kind in range(3) if kind < 2 or t.defocus_sigma > 0
        )

    @property
    def pixels(self) -> int:
        """Number of pixels that count."""
        return sum(target.pixels for target in self.targets)

    def values(self, scores: Float[np.ndarray, " s"]) -> Float[np.ndarray, " p"]:
        """Values of the errors, SI units; clipped to their range, which a step may leave by a rounding error."""
        unknowns = self.unknowns
        return np.clip(unknowns.values(scores[: self.errors]), unknowns.low, unknowns.high)

    def start(self) -> Float[np.ndarray, " s"]:
        """Scores at which the search begins."""
        return np.concatenate([self.unknowns.scores(self.unknowns.start), np.zeros(len(self.motions))])

    def motion(self, scores: Float[np.ndarray, " s"], image: int) -> Float[np.ndarray, "3"]:
        """Shift (y, x) in pixels and defocus in 1/m of an image."""
        out = np.array([*self.targets[image].shift_px, 0.0])
        for place, (kind, unit) in self.motion_units(image).items():
            out[kind] += unit * scores[place]
        return out

    def motion_units(self, image: int) -> dict[int, tuple[int, float]]:
        """Kind and unit of every motion of an image, by its position among the scores."""
        units = (_SHIFT_SIGMA, _SHIFT_SIGMA, self.targets[image].defocus_sigma)
        return {self.errors + k: (kind, units[kind]) for k, (index, kind) in enumerate(self.motions) if index == image}


class Evaluation(NamedTuple):
    """The model at some scores beside the measurement.

    Attributes:
        scores: errors, then motions.
        doe: the fabricated DOE.
        images: the model's images.
        matches: their matches with the measured ones.
    """

    scores: Float[np.ndarray, " s"]
    doe: DoeImages
    images: tuple[Float[np.ndarray, "y x"], ...]
    matches: tuple[Match, ...]

    @property
    def chi2(self) -> float:
        """Weighted squares of all images."""
        return sum(found.chi2 for found in self.matches)

    @property
    def cost(self) -> float:
        """Objective: chi2 and the squares of the scores, which stand for the prior."""
        return self.chi2 + float(self.scores @ self.scores)


class Jacobian(NamedTuple):
    """Derivatives of the model with respect to every score.

    Attributes:
        images: `[image]` derivatives `[score, y, x]`.
        zeroth_order: `[score]` derivative of the DOE's zeroth order.
    """

    images: tuple[Float[np.ndarray, "s y x"], ...]
    zeroth_order: Float[np.ndarray, " s"]


class Linearization(NamedTuple):
    """The model linearised at some scores.

    Attributes:
        at: the model there.
        jacobian: its derivatives.
        hessians: `[image]` half the Gauss-Newton Hessian of each image's chi2.
        descents: `[image]` half the negative gradient of each image's chi2.
    """

    at: Evaluation
    jacobian: Jacobian
    hessians: tuple[Float[np.ndarray, "s s"], ...]
    descents: tuple[Float[np.ndarray, " s"], ...]

    @property
    def half_hessian(self) -> Float[np.ndarray, "s s"]:
        """Half the Hessian of the objective."""
        return sum(self.hessians, np.eye(len(self.at.scores)))

    @property
    def sigma(self) -> Float[np.ndarray, " s"]:
        """Standard deviation of every score if noise alone counts."""
        return np.sqrt(np.diag(np.linalg.inv(self.half_hessian)))


def evaluate(
    objective: FitObjective, weights: Weights, scores: Float[np.ndarray, " s"], doe: DoeImages | None = None
) -> Evaluation:
    """Evaluate the model; `doe` is the fabricated DOE at these scores where it is known already."""
    doe = doe or objective.model.plate(objective.values(scores))
    images = tuple(doe.image(i, objective.motion(scores, i)) for i in range(len(objective.targets)))
    return Evaluation(scores, doe, images, matched(objective, weights, images))


def matched(objective: FitObjective, weights: Weights, images: Sequence[np.ndarray]) -> tuple[Match, ...]:
    """Match every image of a model with its measurement."""
    return tuple(match(*each) for each in zip(objective.targets, weights, images, strict=True))


def evaluate_with_gradient(
    objective: FitObjective, weights: Weights, scores: Float[np.ndarray, " s"]
) -> tuple[Evaluation, Float[np.ndarray, " s"]]:
    """Evaluate the model and the exact gradient of the cost with respect to the scores."""
    doe, doe_vjp = objective.model.plate_and_pull(objective.values(scores))
    gradient, images, matches, total = 2 * scores, [], [], None
    for i, target in enumerate(objective.targets):
        image, image_vjp = doe.image_and_pull(i, objective.motion(scores, i))
        found = match(target, weights[i], image)
        to_doe, to_motion = image_vjp(-2 * found.gain * weights[i] * found.residual)
        for place, (kind, unit) in objective.motion_units(i).items():
            gradient[place] += unit * to_motion[kind]
        images.append(image)
        matches.append(found)
        total = to_doe if total is None else VariedDoe(*(a + b for a, b in zip(total, to_doe, strict=True)))
    assert total is not None  # there is at least one image
    gradient[: objective.errors] += objective.unknowns.root.T @ doe_vjp(total)
    return Evaluation(scores, doe, tuple(images), tuple(matches)), gradient


def difference_steps(sigma: Float[np.ndarray, " s"]) -> Float[np.ndarray, " s"]:
    """Steps of central differences for scores known to `sigma`: as wide as what is not yet known."""
    return np.clip(2 * sigma, _NARROWEST_STEP, WIDEST_STEP)


def difference_jacobian(
    objective: FitObjective, at: Evaluation, steps: Float[np.ndarray, " s"], on_model: OnModel = lambda _: None
) -> Jacobian:
    """Derivatives of all images with respect to all scores, by central differences of `steps` scores.

    `on_model` is called after every error.
    """
    scores, unknowns = at.scores, objective.unknowns
    columns = tuple(np.zeros((len(scores), *image.shape)) for image in at.images)
    zeroth = np.zeros(len(scores))

    def difference(k: int) -> None:
        ends = [scores + sign * steps[k] * np.eye(len(scores))[k] for sign in (1, -1)]
        if k < objective.errors:
            # At the end of an error's range the derivative is that to one side.
            inside = [_within(unknowns, unknowns.values(e[: objective.errors])) for e in ends]
            ends = [e if fits or not any(inside) else scores for e, fits in zip(ends, inside, strict=True)]
            does = [objective.model.plate(objective.values(e)) for e in ends]
            on_model("derivatives")
        else:
            does = [at.doe, at.doe]
        width = float(ends[0][k] - ends[1][k])
        zeroth[k] = (does[0].zeroth_order() - does[1].zeroth_order()) / width
        for i, column in enumerate(columns):
            if k < objective.errors or k in objective.motion_units(i):
                high, low = (s.image(i, objective.motion(e, i)) for s, e in zip(does, ends, strict=True))
                column[k] = (high - low) / width

    # A DOE keeps one core busy.
    with ThreadPoolExecutor(min(len(scores), os.cpu_count() or 1, _MOST_THREADS)) as pool:
        list(pool.map(difference, range(len(scores))))
    return Jacobian(columns, zeroth)


def _within(unknowns: Unknowns, values: Float[np.ndarray, " p"]) -> bool:
    slack = 1e-3 * unknowns.sigma
    return bool(((values >= unknowns.low - slack) & (values <= unknowns.high + slack)).all())


def image_jacobians(
    objective: FitObjective, weights: Weights, at: Evaluation, jacobian: Jacobian
) -> list[Float[np.ndarray, "s n"]]:
    """Derivatives of every image's residuals with respect to the scores."""
    each = zip(objective.targets, weights, at.images, at.matches, jacobian.images, strict=True)
    return [residual_jacobian(*one) for one in each]


def image_residuals(objective: FitObjective, weights: Weights, at: Evaluation) -> list[Float[np.ndarray, " n"]]:
    """Residuals of every image, in standard deviations; their squares add up to `Evaluation.chi2`."""
    return [residuals(*one) for one in zip(objective.targets, weights, at.matches, strict=True)]


def linearised(objective: FitObjective, weights: Weights, at: Evaluation, jacobian: Jacobian) -> Linearization:
    """The objective's Hessians and gradients from the derivatives of the images."""
    rows = image_jacobians(objective, weights, at, jacobian)
    left = image_residuals(objective, weights, at)
    descents = tuple(-j @ r for j, r in zip(rows, left, strict=True))
    return Linearization(at, jacobian, tuple(j @ j.T for j in rows), descents)
