"""Uncertainty of the errors after a fit, and checks of the fit.

The posterior is normal round the best scores: its precision is the Gauss-Newton Hessian of the images' chi2 plus that
of the prior. Nothing more is claimed than the images bear out:

* Where they are not explained to their noise (chi2 above one per pixel) the images' part is divided by the chi2 per
  pixel, which widens by its root what they determine, and never what they leave to the prior.
* What differs from one part of an image to another without the noise explaining it (a model that is a little wrong)
  shows in the gradients of the parts: their scatter over blocks of pixels gives a second covariance, and of the two the
  larger variance of every error counts (the "sandwich" of P. Huber, with blocks as clusters).
* What the model gets wrong alike everywhere (`sim.surface`: some thousandths of the light) is in neither. The same
  DOE, computed once more with cells half as wide, says where the fit would then have ended, and that counts as one more
  standard deviation.
* An error counts as determined where its standard deviation is less than half of that of the prior.
"""

from contextlib import suppress
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from doedesign.calibration.forward_model import DoeImages
from doedesign.calibration.geometry import REACH
from doedesign.calibration.objective import Evaluation, Linearization, Scores
from doedesign.calibration.target import Image, match
from fab.errors import InputError
from fab.grid import Grid
from sim.aperture import circle_coverage
from sim.metrics import disc_radius_m, spot_radius_m

DETERMINED = 0.5  # of the prior's standard deviation
_DIRECTIONS = 2  # least known ones that are looked at
_BLOCKS = 6  # per side of an image


class Posterior(NamedTuple):
    """Errors and their uncertainty after a fit.

    Attributes:
        covariance: of all scores, errors first.
        values: best values of the errors, SI units, and `sigma` their standard deviations.
        geometry: values of the camera's `QUANTITIES`, and `geometry_sigma` their standard deviations, 0 where known.
        correlation: of the errors and of what is unknown of the camera, in this order.
        ratio: standard deviation of every error over that of the prior.
        chi2_per_pixel: of all images; 1 where noise alone is left.
        inflation: factor on the standard deviation of what the images determine.
    """

    covariance: Float[np.ndarray, "s s"]
    values: Float[np.ndarray, " p"]
    sigma: Float[np.ndarray, " p"]
    geometry: Float[np.ndarray, "4"]
    geometry_sigma: Float[np.ndarray, "4"]
    correlation: Float[np.ndarray, "q q"]
    ratio: Float[np.ndarray, " p"]
    chi2_per_pixel: float
    inflation: float

    @property
    def determined(self) -> list[bool]:
        """Whether the images, and not the prior, say what an error is."""
        return (self.ratio < DETERMINED).tolist()

    def spread(self, gradient: Scores) -> float:
        """Standard deviation of a number with this gradient with respect to the scores."""
        return float(np.sqrt(max(gradient @ self.covariance @ gradient, 0.0)))


def posterior_of(fit: Linearization) -> Posterior:
    """Covariance of the scores and the errors."""
    objective, at = fit.at.objective, fit.at
    unknowns, count, shared = objective.unknowns, objective.errors, objective.shared
    images, prior = sum(fit.hessians, np.zeros_like(fit.half_hessian)), np.eye(len(at.scores))
    # Motions, gains and backgrounds are fitted to the last; of what is shared, what the images determine.
    determined = float(np.trace(np.linalg.solve(fit.half_hessian, images)[:shared, :shared]))
    free = len(objective.motions) + 2 * len(objective.targets) + determined
    per_pixel = at.chi2 / max(objective.pixels - free, 1.0)
    inflation = max(per_pixel, 1.0)
    covariance = np.linalg.inv(images / inflation + prior)
    scatter = np.linalg.inv(images + prior)
    scatter = scatter @ _scatter(fit) @ scatter
    larger = np.sqrt(np.maximum(np.diag(scatter) / np.diag(covariance), 1.0))
    systematic = _step_of_finer_cells(fit)
    covariance = covariance * np.outer(larger, larger) + np.outer(systematic, systematic)
    prior_geometry = np.array(objective.model.geometry.sigma)
    unknown = list(objective.model.geometry.unknown)
    root = np.asarray(block_diag(unknowns.root, np.diag(prior_geometry[unknown])), np.float64)
    found = root @ covariance[:shared, :shared] @ root.T
    sigma = np.sqrt(np.diag(found))
    geometry_sigma = np.zeros_like(prior_geometry)
    geometry_sigma[unknown] = sigma[count:]
    return Posterior(
        covariance=covariance,
        values=objective.values(at.scores),
        sigma=sigma[:count],
        geometry=objective.motion(at.scores, 0)[3:],
        geometry_sigma=geometry_sigma,
        correlation=found / np.outer(sigma, sigma),
        ratio=sigma[:count] / unknowns.sigma,
        chi2_per_pixel=per_pixel,
        inflation=float(np.sqrt(inflation)),
    )


def _step_of_finer_cells(fit: Linearization) -> Scores:
    """How far one Gauss-Newton step would lead if the model's cells were half as wide; zero where none can be made."""
    objective, at = fit.at.objective, fit.at
    doe = _finer_doe(at)
    if doe is None:
        return np.zeros(len(at.scores))
    descent = np.zeros(len(at.scores))
    for i, (found, rows) in enumerate(zip(at.matches, fit.jacobian.of_residuals(at), strict=True)):
        change = doe.image(i, objective.motion(at.scores, i)) - found.model
        descent -= rows @ found.residual_jacobian(change[None])[0]
    return np.linalg.solve(fit.half_hessian, descent)


def _finer_doe(at: Evaluation) -> DoeImages | None:
    """The DOE of cells half as wide, or as narrow as its edges, which stay within half a cell, allow."""
    model, values = at.objective.model, at.objective.values(at.scores)
    parts = at.doe.parts
    for finer in range(2 * parts, parts, -1):
        with suppress(InputError):
            return model.finer(finer).plate(values)
    return None


def _scatter(fit: Linearization) -> Float[np.ndarray, "s s"]:
    """Sum over blocks of pixels of the outer product of their gradients."""
    total = np.zeros_like(fit.half_hessian)
    for found, j in zip(fit.at.matches, fit.jacobian.of_residuals(fit.at), strict=True):
        shape = found.model.shape
        gradients = (j * found.residuals())[:, : found.model.size].reshape(-1, *shape)
        side = -(-shape[0] // _BLOCKS)
        pad = _BLOCKS * side - shape[0]
        parts = np.pad(gradients, ((0, 0), (0, pad), (0, pad))).reshape(len(j), _BLOCKS, side, _BLOCKS, side)
        blocks = parts.sum(axis=(2, 4)).reshape(len(j), -1)
        total += blocks @ blocks.T
    return total


def left_out(fit: Linearization) -> list[float]:
    """Chi2 per pixel of every image predicted from the others: one Gauss-Newton step on their part of the objective."""
    objective, at, out = fit.at.objective, fit.at, []
    for i, found in enumerate(at.matches):
        step = np.linalg.solve(fit.half_hessian - fit.hessians[i], sum(fit.descents, -at.scores) - fit.descents[i])
        scores = at.scores.copy()
        # The image's own motion stays what it was; the camera is off by no more than the model follows.
        scores[: objective.shared] += step[: objective.shared]
        camera = slice(objective.errors, objective.shared)
        scores[camera] = np.clip(scores[camera], -REACH, REACH)
        image = objective.model.plate(objective.values(scores)).image(i, objective.motion(scores, i))
        out.append(match(found.target, found.weights, image).chi2_per_pixel)
    return out


class Reading(NamedTuple):
    """A number read off an image, measured (None where an image cannot show it) and predicted by the fitted model.

    Each with its standard deviation: "ring_to_disc", "far_spot" (share of the window's light), "throughput" or
    "zeroth_order".
    """

    image: str
    quantity: str
    measured: tuple[float, float] | None
    predicted: tuple[float, float]


def readings(fit: Linearization, posterior: Posterior) -> list[Reading]:
    """Numbers that a lab reads off every image, and the DOE's zeroth order.

    Unusable pixels are taken from the model. Ring and disc are told apart as in `sim.metrics.ring_to_disc`, the spot as
    in `sim.metrics.spot_radius_m`, about where the fit finds the chief ray.
    """
    at, out, jacobian, objective = fit.at, [], fit.jacobian, fit.at.objective
    camera = objective.model.camera
    grid = Grid((camera.window, camera.window), camera.pixel_m)
    spot_m = spot_radius_m(camera, objective.model.wavelength_m)
    for i, found in enumerate(at.matches):
        target, image, weights = found.target, found.model, found.weights
        disc_m = disc_radius_m(camera, target.image.depth_m)
        near = disc_m > spot_m
        y, x = (float(shift) * camera.pixel_m for shift in objective.motion(at.scores, i)[:2])
        inner = circle_coverage(grid, 2 * (disc_m if near else spot_m), (y, x)).astype(np.float64)
        light = np.where(target.psf.valid, (target.psf.rate - found.background) / found.gain, image)
        noise = np.where(weights > 0, 1 / np.maximum(weights, 1e-300), 0.0) / found.gain**2
        background = posterior.inflation**2 / (weights.sum() * found.gain**2)  # its variance
        values, gradients = zip(*(_ratio(inner, picture, near) for picture in (light, image)), strict=True)
        variance = posterior.inflation**2 * float((gradients[0] ** 2 * noise).sum())
        measured = (values[0], float(np.sqrt(variance + background * float(gradients[0].sum()) ** 2)))
        columns = jacobian.images[i]
        predicted = (values[1], posterior.spread(np.tensordot(columns, gradients[1], 2)))
        out.append(Reading(target.name, "ring_to_disc" if near else "far_spot", measured, predicted))
        total = (float(image.sum()), posterior.spread(columns.sum(axis=(1, 2))))
        share = None
        if target.gain_sigma:
            share = (float(light.sum()) * found.gain, float(light.sum()) * target.gain_sigma)
        out.append(Reading(target.name, "throughput", share, total))
    order = (at.doe.zeroth_order(), posterior.spread(jacobian.zeroth_order))
    return [*out, Reading("plate", "zeroth_order", None, order)]


def _ratio(inner: Image, light: Image, near: bool) -> tuple[float, Image]:
    """Ring:disc ratio or share in the spot, and its derivative with respect to every pixel."""
    inside, total = float((inner * light).sum()), float(light.sum())
    if near:
        return total / inside - 1, 1 / inside - inner * total / inside**2
    return inside / total, inner / total - inside / total**2


def cost_rises(fit: Linearization, posterior: Posterior) -> list[float]:
    """Rises of the cost one standard deviation to either side along the least known directions.

    One everywhere if the posterior is the normal distribution that is claimed. Directions that end at the end of an
    error's range are left out.
    """
    objective, at = fit.at.objective, fit.at
    count, unknowns = objective.errors, objective.unknowns
    images = fit.half_hessian - np.eye(len(at.scores))
    covariance = np.linalg.inv(images / posterior.inflation**2 + np.eye(len(images)))
    block = covariance[:count, :count]
    variances, directions = np.linalg.eigh(block)

    def cost(chi2: float, scores: np.ndarray) -> float:
        return chi2 / posterior.inflation**2 + float(scores @ scores)

    lowest, out = cost(at.chi2, at.scores), []
    for k in range(count - 1, max(count - 1 - _DIRECTIONS, -1), -1):
        # The other scores follow, as they would in a fit.
        step = covariance[:, :count] @ np.linalg.solve(block, np.sqrt(variances[k]) * directions[:, k])
        for scores in (at.scores + step, at.scores - step):
            free = unknowns.values(scores[:count])
            if np.allclose(free, objective.values(scores), rtol=0, atol=1e-3 * unknowns.sigma.min()):
                out.append(cost(objective.evaluate(at.weights, scores).chi2, scores) - lowest)
    return out
