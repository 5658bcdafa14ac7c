"""Least-squares objective of a calibration: measured images, the model that should explain them, and how well it does.

Errors, the camera's geometry and motions are scores, in standard deviations of their prior, so the objective is

    chi2 + prior  =  sum over images of sum of weight * residual²  +  sum of score²

Jacobians are central differences. They are quick: all of them together cost what one exact gradient does, for a
derivative through a fabricated DOE takes twenty to forty times as long as the DOE. And they are what is wanted: where
edges of two masks coincide, as all do without errors, slivers open whichever way a mask moves, so the light has a cusp
there and a derivative to one side says nothing of the other. The exact gradient serves the last polish of a fit.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.calibration.forward_model import DoeImages, ForwardModel, Motion
from doedesign.calibration.target import Image, Match, Target, match
from doedesign.calibration.unknowns import Unknowns
from sim.threads import cores

_SHIFT_SIGMA = 2.0  # pixels by which an image may lie off where it was found
WIDEST_STEP, _NARROWEST_STEP = 0.05, 0.004  # scores, for central differences
_MOST_THREADS = 8  # each holds a fabricated DOE, 0.3 GB for 2400 x 2400 cells

Scores = Float[np.ndarray, " s"]
Weights = tuple[Image, ...]
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
        """Number of errors, whose scores come first."""
        return len(self.unknowns.names)

    @property
    def shared(self) -> int:
        """Number of scores that all images share: errors, then the camera's geometry; motions come after them."""
        return self.errors + len(self.model.geometry.unknown)

    @property
    def motions(self) -> tuple[tuple[int, int], ...]:
        """Image and kind (0 y, 1 x, 2 defocus) of every score after the shared ones."""
        return tuple(
            (i, kind) for i, t in enumerate(self.targets) for kind in range(3) if kind < 2 or t.image.defocus_sigma > 0
        )

    @property
    def pixels(self) -> int:
        """Number of pixels that count."""
        return sum(target.pixels for target in self.targets)

    def values(self, scores: Scores) -> Float[np.ndarray, " p"]:
        """Values of the errors, SI units; clipped to their range, which a step may leave by a rounding error."""
        unknowns = self.unknowns
        return np.clip(unknowns.values(scores[: self.errors]), unknowns.low, unknowns.high)

    def motion(self, scores: Scores, image: int) -> Motion:
        """Motion of an image, the camera's geometry included."""
        out = np.array([*self.targets[image].shift_px, 0.0, *self.model.geometry.mean])
        for place, (kind, unit) in self.motion_units(image).items():
            out[kind] += unit * scores[place]
        return out

    def motion_units(self, image: int) -> dict[int, tuple[int, float]]:
        """Place in an image's motion and unit of every score that moves it, by its position among the scores."""
        units = (_SHIFT_SIGMA, _SHIFT_SIGMA, self.targets[image].image.defocus_sigma, *self.model.geometry.sigma)
        common = (3 + kind for kind in self.model.geometry.unknown)
        kinds = dict(enumerate(common, self.errors))
        kinds |= {self.shared + k: kind for k, (index, kind) in enumerate(self.motions) if index == image}
        return {place: (kind, units[kind]) for place, kind in kinds.items()}

    @property
    def scores(self) -> int:
        """Number of all scores."""
        return self.shared + len(self.motions)

    def evaluate(self, weights: Weights, scores: Scores, doe: DoeImages | None = None) -> "Evaluation":
        """The model at some scores; `doe` is the fabricated DOE there where it is known already."""
        doe = doe or self.model.plate(self.values(scores))
        images = (doe.image(i, self.motion(scores, i)) for i in range(len(self.targets)))
        return Evaluation(self, scores, doe, tuple(map(match, self.targets, weights, images)))

    def evaluate_with_gradient(self, weights: Weights, scores: Scores) -> tuple["Evaluation", Scores]:
        """The model at some scores and the exact gradient of the cost with respect to them."""
        doe, doe_vjp = self.model.plate_and_vjp(self.values(scores))
        gradient, matches, total = 2 * scores, [], None
        for i, target in enumerate(self.targets):
            image, image_vjp = doe.image_and_vjp(i, self.motion(scores, i))
            found = match(target, weights[i], image)
            to_doe, to_motion = image_vjp(-2 * found.gain * weights[i] * found.residual)
            for place, (kind, unit) in self.motion_units(i).items():
                gradient[place] += unit * to_motion[kind]
            matches.append(found)
            total = to_doe if total is None else total + to_doe
        assert total is not None  # there is at least one image
        gradient[: self.errors] += self.unknowns.root.T @ doe_vjp(total)
        return Evaluation(self, scores, doe, tuple(matches)), gradient


class Evaluation(NamedTuple):
    """The model at some scores (errors, geometry, then motions) beside the measurement."""

    objective: FitObjective
    scores: Scores
    doe: DoeImages
    matches: tuple[Match, ...]

    @property
    def weights(self) -> Weights:
        """Inverse variances of all pixels."""
        return tuple(found.weights for found in self.matches)

    @property
    def chi2(self) -> float:
        """Weighted squares of all images."""
        return sum(found.chi2 for found in self.matches)

    @property
    def cost(self) -> float:
        """Objective: chi2 and the squares of the scores, which stand for the prior."""
        return self.chi2 + float(self.scores @ self.scores)

    def reweighted(self, weights: Weights) -> "Evaluation":
        """The same images matched with other weights."""
        images = (found.model for found in self.matches)
        return self._replace(matches=tuple(map(match, self.objective.targets, weights, images)))

    def difference_jacobian(self, steps: Scores, on_model: OnModel = lambda _: None) -> "Jacobian":
        """Derivatives with respect to all scores by central differences; `on_model` is called after every error."""
        objective, scores, unknowns = self.objective, self.scores, self.objective.unknowns
        columns = tuple(np.zeros((len(scores), *found.model.shape)) for found in self.matches)
        zeroth = np.zeros(len(scores))
        slack = 1e-3 * unknowns.sigma

        def within(end: Scores) -> bool:
            values = unknowns.values(end[: objective.errors])
            return bool(((values >= unknowns.low - slack) & (values <= unknowns.high + slack)).all())

        def difference(k: int) -> None:
            ends = [scores + sign * steps[k] * np.eye(len(scores))[k] for sign in (1, -1)]
            if k < objective.errors:
                # At the end of an error's range the derivative is that to one side.
                inside = [within(end) for end in ends]
                ends = [e if fits or not any(inside) else scores for e, fits in zip(ends, inside, strict=True)]
                does = [objective.model.plate(objective.values(e)) for e in ends]
                on_model("derivatives")
            else:
                does = [self.doe, self.doe]
            width = float(ends[0][k] - ends[1][k])
            zeroth[k] = (does[0].zeroth_order() - does[1].zeroth_order()) / width
            for i, column in enumerate(columns):
                if k < objective.errors or k in objective.motion_units(i):
                    high, low = (s.image(i, objective.motion(e, i)) for s, e in zip(does, ends, strict=True))
                    column[k] = (high - low) / width

        # A DOE keeps one core busy.
        with ThreadPoolExecutor(min(len(scores), cores(), _MOST_THREADS)) as pool:
            list(pool.map(difference, range(len(scores))))
        return Jacobian(columns, zeroth)

    def linearised(self, jacobian: "Jacobian") -> "Linearization":
        """The objective's Hessians and gradients from the derivatives of the images."""
        rows = jacobian.of_residuals(self)
        descents = tuple(-j @ found.residuals() for j, found in zip(rows, self.matches, strict=True))
        return Linearization(self, jacobian, tuple(j @ j.T for j in rows), descents)


class Jacobian(NamedTuple):
    """Derivatives of every image and of the DOE's zeroth order with respect to every score."""

    images: tuple[Float[np.ndarray, "s y x"], ...]
    zeroth_order: Scores

    def of_residuals(self, at: Evaluation) -> list[Float[np.ndarray, "s n"]]:
        """Derivatives of every image's residuals with respect to the scores."""
        return [found.residual_jacobian(columns) for found, columns in zip(at.matches, self.images, strict=True)]


class Linearization(NamedTuple):
    """The model linearised at some scores: half the Gauss-Newton Hessian and negative gradient of each image's chi2."""

    at: Evaluation
    jacobian: Jacobian
    hessians: tuple[Float[np.ndarray, "s s"], ...]
    descents: tuple[Scores, ...]

    @property
    def half_hessian(self) -> Float[np.ndarray, "s s"]:
        """Half the Hessian of the objective."""
        return sum(self.hessians, np.eye(len(self.at.scores)))

    @property
    def sigma(self) -> Scores:
        """Standard deviation of every score if noise alone counts."""
        return np.sqrt(np.diag(np.linalg.inv(self.half_hessian)))

    @property
    def steps(self) -> Scores:
        """Steps of central differences: as wide as what is not yet known."""
        return np.clip(2 * self.sigma, _NARROWEST_STEP, WIDEST_STEP)
