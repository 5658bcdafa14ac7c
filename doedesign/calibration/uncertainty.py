"""How well the errors are known after a fit, and whether the fit is to be believed.

The posterior is normal round the best scores: its precision is the Gauss-Newton Hessian of the images' squares plus
that of what was believed. Nothing more is claimed than the images bear out:

* Where they are not explained to their noise (more than one square per pixel) the images' part is divided by the
  squares per pixel, which widens by its root what they determine, and never what they leave to belief.
* What differs from one part of an image to another without the noise explaining it (a model that is a little wrong)
  shows in the slopes of the parts: their scatter over blocks of pixels gives a second covariance, and of the two the
  larger variance of every error counts (the "sandwich" of P. Huber, with blocks as clusters).
* What the model gets wrong alike everywhere (`sim.surface`: some thousandths of the light) is in neither. On plates
  computed with finer cells than those of the fit it moved overlay by up to 30 nm, line width by 7 nm, depth by 0.1 %.
* An error counts as determined where its standard deviation is less than half of what was believed.

Checks: squares per pixel and image; one image predicted from the others; what a lab reads off an image (ring:disc
ratio, share in the spot) measured and predicted, each with its uncertainty; and whether the objective really rises by
one at a standard deviation along the least known directions.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from doedesign.calibration.fit import Fit
from doedesign.calibration.objective import FitObjective, look
from doedesign.calibration.target import Target, match
from fab.grid import Grid
from sim.aperture import circle_coverage
from sim.metrics import spot_radius_m

DETERMINED = 0.5  # of what was believed
EXPLAINED = 1.5  # squares per pixel up to which images count as explained
_DIRECTIONS = 2  # least known ones that are looked at
_BLOCKS = 6  # per side of an image


class Posterior(NamedTuple):
    """What is known afterwards.

    Attributes:
        scores: best scores, errors first.
        covariance: of all scores.
        values: best values of the errors.
        sigma: their standard deviations.
        correlation: of the errors.
        ratio: standard deviation over that believed beforehand.
        squares_per_pixel: of all images.
        inflation: factor on the standard deviation of what the images determine.
    """

    scores: Float[np.ndarray, " s"]
    covariance: Float[np.ndarray, "s s"]
    values: Float[np.ndarray, " p"]
    sigma: Float[np.ndarray, " p"]
    correlation: Float[np.ndarray, "p p"]
    ratio: Float[np.ndarray, " p"]
    squares_per_pixel: float
    inflation: float


def posterior(question: FitObjective, fit: Fit) -> Posterior:
    """Covariance of the scores and the errors."""
    lens, unknowns, count = fit.lens, question.bench.unknowns, question.errors
    images = sum(lens.hessians, np.zeros_like(lens.half_hessian))
    # Motions, gains and backgrounds are fitted to the last; of the errors, what the images and not belief determine.
    free = (
        len(question.motions)
        + 2 * len(question.targets)
        + float(np.trace(np.linalg.solve(lens.half_hessian, images)[:count, :count]))
    )
    per_pixel = lens.look.squares / max(question.pixels - free, 1.0)
    inflation = max(per_pixel, 1.0)
    belief = np.eye(len(lens.look.scores))
    covariance = np.linalg.inv(images / inflation + belief)
    scatter = np.linalg.inv(images + belief)
    scatter = scatter @ _scatter(question, fit) @ scatter
    larger = np.sqrt(np.maximum(np.diag(scatter) / np.diag(covariance), 1.0))
    covariance = covariance * np.outer(larger, larger)
    errors = unknowns.root @ covariance[:count, :count] @ unknowns.root.T
    sigma = np.sqrt(np.diag(errors))
    return Posterior(
        scores=lens.look.scores,
        covariance=covariance,
        values=question.values(lens.look.scores),
        sigma=sigma,
        correlation=errors / np.outer(sigma, sigma),
        ratio=sigma / unknowns.sigma,
        squares_per_pixel=per_pixel,
        inflation=float(np.sqrt(inflation)),
    )


def _scatter(question: FitObjective, fit: Fit) -> Float[np.ndarray, "s s"]:
    """Sum over blocks of pixels of the outer product of their slopes."""
    total = np.zeros_like(fit.lens.half_hessian)
    for target, weights, image, found, columns in zip(
        question.targets, fit.weights, fit.lens.look.images, fit.lens.look.matches, fit.lens.slopes.images, strict=True
    ):
        moved = _without_gain(target, weights, image, found.gain * columns)
        slopes = moved * (weights * found.residual)
        side = -(-image.shape[0] // _BLOCKS)
        pad = _BLOCKS * side - image.shape[0]
        parts = np.pad(slopes, ((0, 0), (0, pad), (0, pad))).reshape(len(slopes), _BLOCKS, side, _BLOCKS, side)
        each = parts.sum(axis=(2, 4)).reshape(len(slopes), -1)
        total += each @ each.T
    return total


def _without_gain(
    target: Target,
    weights: Float[np.ndarray, "y x"],
    image: Float[np.ndarray, "y x"],
    columns: Float[np.ndarray, "s y x"],
) -> Float[np.ndarray, "s y x"]:
    """What of a change gain and background cannot make up for."""
    solved = np.stack([image.ravel(), np.ones(image.size)])
    known = (solved * weights.ravel()) @ solved.T
    if target.gain:
        known[0, 0] += target.gain[1] ** -2
    flat = columns.reshape(len(columns), -1)
    shares = np.linalg.solve(known, (solved * weights.ravel()) @ flat.T)
    return (flat - shares.T @ solved).reshape(columns.shape)


class LeftOut(NamedTuple):
    """One image predicted from the others.

    Attributes:
        name: the image.
        together: its squares per pixel in the fit of all images.
        predicted: its squares per pixel at the errors that the others give.
        moved: by how many standard deviations the error that moves most moves without it, and which that is.
    """

    name: str
    together: float
    predicted: float
    moved: tuple[float, str]


def left_out(question: FitObjective, fit: Fit, known: Posterior) -> list[LeftOut]:
    """Predict every image from the others: one Gauss-Newton step on their part of the objective.

    Its own motion, gain and background stay what they were, for they say nothing of the plate.
    """
    lens, count = fit.lens, question.errors
    out = []
    for i, target in enumerate(question.targets):
        half = lens.half_hessian - lens.hessians[i]
        step = np.linalg.solve(half, sum(lens.descents, -lens.look.scores) - lens.descents[i])
        scores = lens.look.scores.copy()
        scores[:count] += step[:count]
        seen = question.bench.plate(question.values(scores))
        image = seen.image(i, question.motion(scores, i))
        pixels = max(int(target.psf.valid.sum()), 1)
        predicted = match(target, fit.weights[i], image).squares / pixels
        moves = np.abs(question.values(scores) - known.values) / known.sigma
        most = int(np.argmax(moves))
        name = question.bench.unknowns.names[most]
        out.append(LeftOut(target.name, lens.look.matches[i].squares / pixels, predicted, (float(moves[most]), name)))
    return out


class Reading(NamedTuple):
    """A number read off an image, as measured and as the fitted model has it, each with its standard deviation.

    Attributes:
        image: the image.
        quantity: "ring_to_disc", "far_spot" (share of the window's light), "throughput" or "zeroth_order".
        measured: as measured; None where an image cannot show it.
        predicted: by the model.
    """

    image: str
    quantity: str
    measured: tuple[float, float] | None
    predicted: tuple[float, float]


def readings(question: FitObjective, fit: Fit, known: Posterior) -> list[Reading]:
    """What a lab reads off every image, and the plate's zeroth order.

    Pixels that say nothing are taken from the model. Ring and disc are told apart as in `sim.metrics.ring_to_disc`,
    the spot as in `sim.metrics.spot_radius_m`, about where the fit finds the chief ray.
    """
    at, out = fit.lens.look, []
    camera = question.bench.camera
    for i, target in enumerate(question.targets):
        image, found = at.images[i], at.matches[i]
        disc_m = camera.defocus_radius_m(target.depth_m) + camera.pixel_m
        spot_m = spot_radius_m(camera, question.bench.wavelength_m)
        near = disc_m > spot_m
        y, x = (float(shift) * camera.pixel_m for shift in question.motion(at.scores, i)[:2])
        grid = Grid((camera.window, camera.window), camera.pixel_m)
        inner = circle_coverage(grid, 2 * (disc_m if near else spot_m), (y, x)).astype(np.float64)
        light = np.where(target.psf.valid, (target.psf.rate - found.background) / found.gain, image)
        noise = np.where(fit.weights[i] > 0, 1 / np.maximum(fit.weights[i], 1e-300), 0.0) / found.gain**2
        level = known.inflation**2 / (fit.weights[i].sum() * found.gain**2)  # variance of the background
        values, slopes = zip(*(_ratio(inner, picture, near) for picture in (light, image)), strict=True)
        spread = known.inflation**2 * float((slopes[0] ** 2 * noise).sum()) + level * float(slopes[0].sum()) ** 2
        columns = fit.lens.slopes.images[i]
        measured = (values[0], float(np.sqrt(spread)))
        predicted = (values[1], _spread(known, np.tensordot(columns, slopes[1], 2)))
        out.append(Reading(target.name, "ring_to_disc" if near else "far_spot", measured, predicted))
        total = (float(image.sum()), _spread(known, columns.sum(axis=(1, 2))))
        share = None
        if target.gain:
            share = (float(light.sum()) * found.gain, float(light.sum()) * target.gain[1])
        out.append(Reading(target.name, "throughput", share, total))
    order = (at.seen.zeroth_order(), _spread(known, fit.lens.slopes.zeroth_order))
    return [*out, Reading("plate", "zeroth_order", None, order)]


def _ratio(
    inner: Float[np.ndarray, "y x"], light: Float[np.ndarray, "y x"], near: bool
) -> tuple[float, Float[np.ndarray, "y x"]]:
    """Ring:disc ratio or share in the spot, and its derivative with respect to every pixel."""
    inside, total = float((inner * light).sum()), float(light.sum())
    if near:
        return total / inside - 1, 1 / inside - inner * total / inside**2
    return inside / total, inner / total - inside / total**2


def _spread(known: Posterior, slope: Float[np.ndarray, " s"]) -> float:
    return float(np.sqrt(max(slope @ known.covariance @ slope, 0.0)))


def rises(question: FitObjective, fit: Fit, known: Posterior) -> list[float]:
    """By how much the objective rises one standard deviation to either side along the least known directions.

    One everywhere if the posterior is the normal distribution that is claimed. Directions that end at the end of an
    error's range are left out.
    """
    count, at = question.errors, fit.lens.look
    images = sum(fit.lens.hessians, np.zeros_like(fit.lens.half_hessian)) / known.inflation**2
    covariance = np.linalg.inv(images + np.eye(len(images)))
    block = covariance[:count, :count]
    sizes, ways = np.linalg.eigh(block)

    def objective(scores: np.ndarray) -> float:
        squares = look(question, fit.weights, scores).squares
        return squares / known.inflation**2 + float(scores @ scores)

    low = at.squares / known.inflation**2 + float(at.scores @ at.scores)
    out = []
    for way in range(count - 1, max(count - 1 - _DIRECTIONS, -1), -1):
        # The other scores follow, as they would in a fit.
        step = covariance[:, :count] @ np.linalg.solve(block, np.sqrt(sizes[way]) * ways[:, way])
        for scores in (at.scores + step, at.scores - step):
            asked = question.bench.unknowns.values(scores[:count])
            if np.allclose(asked, question.values(scores), rtol=0, atol=1e-3 * question.bench.unknowns.sigma.min()):
                out.append(objective(scores) - low)
    return out
