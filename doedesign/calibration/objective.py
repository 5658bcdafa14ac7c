"""The question of a calibration: measured images, the bench that should explain them, and how well it does.

Errors and motions are scores, in standard deviations of what is believed beforehand, so the objective is

    sum over images of sum of weight * residual²  +  sum of score²

Slopes are central differences. They are quick: all of them together cost what one exact gradient does, for a derivative
through a plate takes twenty to forty times as long as the plate. And they are what is wanted: where edges of two masks
coincide, as all do on a plate without errors, slivers open whichever way a mask moves, so the light has a cusp there
and a derivative to one side says nothing of the other. The exact gradient is there for the last polish of a fit.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.calibration.forward_model import DoeImages, ForwardModel, VariedDoe
from doedesign.calibration.target import Match, Target, match, projected
from doedesign.calibration.unknowns import Unknowns

_SHIFT_SIGMA = 2.0  # pixels by which an image may lie off where it was found
WIDEST_STEP, _NARROWEST_STEP = 0.05, 0.004  # scores, for central differences
_MOST_THREADS = 8  # each holds a plate, 0.3 GB for a plate of 2400 x 2400 cells

Weights = tuple[Float[np.ndarray, "y x"], ...]
OnModel = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class FitObjective:
    """Measured images and the bench that should explain them."""

    bench: ForwardModel
    targets: tuple[Target, ...]

    @property
    def errors(self) -> int:
        """Number of errors looked for; the scores after them are motions."""
        return len(self.bench.unknowns.names)

    @property
    def motions(self) -> tuple[tuple[int, int], ...]:
        """Image and kind (0 y, 1 x, 2 defocus) of every score after the errors."""
        return tuple(
            (i, kind) for i, t in enumerate(self.targets) for kind in range(3) if kind < 2 or t.defocus_sigma > 0
        )

    @property
    def pixels(self) -> int:
        """Number of pixels that say something."""
        return sum(int(target.psf.valid.sum()) for target in self.targets)

    def values(self, scores: Float[np.ndarray, " s"]) -> Float[np.ndarray, " p"]:
        """Values of the errors; a step that ends a rounding error beyond their range ends at its end."""
        unknowns = self.bench.unknowns
        return np.clip(unknowns.values(scores[: self.errors]), unknowns.low, unknowns.high)

    def start(self) -> Float[np.ndarray, " s"]:
        """Scores at which the search begins."""
        unknowns = self.bench.unknowns
        return np.concatenate([unknowns.scores(unknowns.start), np.zeros(len(self.motions))])

    def motion(self, scores: Float[np.ndarray, " s"], image: int) -> Float[np.ndarray, "3"]:
        """Shift (y, x) in pixels and defocus in 1/m of an image."""
        target = self.targets[image]
        out = np.array([*target.shift_px, 0.0])
        units = (_SHIFT_SIGMA, _SHIFT_SIGMA, target.defocus_sigma)
        for (index, kind), score in zip(self.motions, scores[self.errors :], strict=True):
            if index == image:
                out[kind] += units[kind] * score
        return out

    def motion_units(self, image: int) -> dict[int, tuple[int, float]]:
        """Position among the scores of every motion of an image: its kind and what one score of it is."""
        units = (_SHIFT_SIGMA, _SHIFT_SIGMA, self.targets[image].defocus_sigma)
        return {self.errors + k: (kind, units[kind]) for k, (index, kind) in enumerate(self.motions) if index == image}


class Evaluation(NamedTuple):
    """The model at some scores beside the measurement.

    Attributes:
        scores: where.
        seen: the plate.
        images: the model's images.
        matches: their matches.
        squares: sum of the images' weighted squares.
    """

    scores: Float[np.ndarray, " s"]
    seen: DoeImages
    images: tuple[Float[np.ndarray, "y x"], ...]
    matches: tuple[Match, ...]

    @property
    def squares(self) -> float:
        """Weighted squares of all images."""
        return sum(found.squares for found in self.matches)

    @property
    def objective(self) -> float:
        """Squares and what is believed beforehand."""
        return self.squares + float(self.scores @ self.scores)


class Jacobian(NamedTuple):
    """How the model changes with every score.

    Attributes:
        images: `[image]` derivatives `[score, y, x]`.
        zeroth_order: `[score]` derivative of the plate's zeroth order.
    """

    images: tuple[Float[np.ndarray, "s y x"], ...]
    zeroth_order: Float[np.ndarray, " s"]


class Linearization(NamedTuple):
    """The model linearised at some scores.

    Attributes:
        look: the model there.
        slopes: its derivatives.
        hessians: `[image]` half the Hessian of each image's squares.
        descents: `[image]` half the negative gradient of each image's squares.
    """

    look: Evaluation
    slopes: Jacobian
    hessians: tuple[Float[np.ndarray, "s s"], ...]
    descents: tuple[Float[np.ndarray, " s"], ...]

    @property
    def half_hessian(self) -> Float[np.ndarray, "s s"]:
        """Half the Hessian of the objective."""
        return sum(self.hessians, np.eye(len(self.look.scores)))

    @property
    def spread(self) -> Float[np.ndarray, " s"]:
        """Standard deviation of every score if noise alone counts."""
        return np.sqrt(np.diag(np.linalg.inv(self.half_hessian)))


def look(question: FitObjective, weights: Weights, scores: Float[np.ndarray, " s"]) -> Evaluation:
    """Evaluate the model."""
    seen = question.bench.plate(question.values(scores))
    images = tuple(seen.image(i, question.motion(scores, i)) for i in range(len(question.targets)))
    return Evaluation(scores, seen, images, matched(question, weights, images))


def matched(question: FitObjective, weights: Weights, images: Sequence[np.ndarray]) -> tuple[Match, ...]:
    """Match every image of a model with its measurement."""
    return tuple(match(*each) for each in zip(question.targets, weights, images, strict=True))


def look_and_gradient(
    question: FitObjective, weights: Weights, scores: Float[np.ndarray, " s"]
) -> tuple[Evaluation, Float[np.ndarray, " s"]]:
    """Evaluate the model and the gradient of the objective."""
    seen, pull = question.bench.plate_and_pull(question.values(scores))
    gradient, images, matches, total = 2 * scores, [], [], None
    for i, target in enumerate(question.targets):
        image, back = seen.image_and_pull(i, question.motion(scores, i))
        found = match(target, weights[i], image)
        to_plate, to_motion = back(-2 * found.gain * weights[i] * found.residual)
        for place, (kind, unit) in question.motion_units(i).items():
            gradient[place] += unit * to_motion[kind]
        images.append(image)
        matches.append(found)
        total = to_plate if total is None else VariedDoe(*(a + b for a, b in zip(total, to_plate, strict=True)))
    assert total is not None  # there is at least one image
    gradient[: question.errors] += question.bench.unknowns.root.T @ pull(total)
    return Evaluation(scores, seen, tuple(images), tuple(matches)), gradient


def difference_steps(spread: Float[np.ndarray, " s"]) -> Float[np.ndarray, " s"]:
    """Steps of central differences for scores that are known to `spread`: as wide as what is not yet known."""
    return np.clip(2 * spread, _NARROWEST_STEP, WIDEST_STEP)


def slopes_at(
    question: FitObjective, at: Evaluation, steps: Float[np.ndarray, " s"], on_model: OnModel = lambda _: None
) -> Jacobian:
    """Derivatives of all images with respect to all scores, by central differences.

    Args:
        question: images and bench.
        at: the model there.
        steps: how far to go to either side, scores.
        on_model: told of every score that is done.
    """
    scores, unknowns = at.scores, question.bench.unknowns
    columns = tuple(np.zeros((len(scores), *image.shape)) for image in at.images)
    zeroth = np.zeros(len(scores))

    def difference(k: int) -> None:
        ends = [scores + sign * steps[k] * np.eye(len(scores))[k] for sign in (1, -1)]
        if k < question.errors:
            # At the end of an error's range the derivative is that to one side.
            inside = [_within(unknowns, unknowns.values(e[: question.errors])) for e in ends]
            ends = [e if fits or not any(inside) else scores for e, fits in zip(ends, inside, strict=True)]
            seen = [question.bench.plate(question.values(e)) for e in ends]
            on_model("slopes")
        else:
            seen = [at.seen, at.seen]
        width = float(ends[0][k] - ends[1][k])
        zeroth[k] = (seen[0].zeroth_order() - seen[1].zeroth_order()) / width
        for i, column in enumerate(columns):
            if k < question.errors or k in question.motion_units(i):
                high, low = (s.image(i, question.motion(e, i)) for s, e in zip(seen, ends, strict=True))
                column[k] = (high - low) / width

    # A plate keeps one core busy.
    with ThreadPoolExecutor(min(len(scores), os.cpu_count() or 1, _MOST_THREADS)) as pool:
        list(pool.map(difference, range(len(scores))))
    return Jacobian(columns, zeroth)


def linearised(question: FitObjective, weights: Weights, at: Evaluation, slopes: Jacobian) -> Linearization:
    """Objective's slopes from those of the images."""
    each = zip(question.targets, weights, at.images, at.matches, slopes.images, strict=True)
    halves = [projected(*one) for one in each]
    return Linearization(at, slopes, tuple(h for h, _ in halves), tuple(d for _, d in halves))


def _within(unknowns: Unknowns, values: Float[np.ndarray, " p"]) -> bool:
    slack = 1e-3 * unknowns.sigma
    return bool(((values >= unknowns.low - slack) & (values <= unknowns.high + slack)).all())
