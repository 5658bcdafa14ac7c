"""Calibration: the process errors behind measured PSFs, how well they are known, and what two numbers alone may mean.

    measurement = load_shots(Path("measurement.toml"), design.camera)
    result = calibrate(design, process, measurement)
    result.process                      # the estimate, usable everywhere a process is
    explanations(design, process, targets)   # where only a ring:disc ratio and a throughput were measured

Reading order:

    measurement     the TOML file of a measurement and its images
    unknowns        which errors are looked for, and their prior
    forward_model   the model: from errors to images, and gradients back
    target          one measured image beside its model
    objective       all of it as one least-squares objective, with derivatives
    fit             the search
    uncertainty     the posterior, and checks of it
    explanations    errors that would explain two numbers

The model is `sim.surface.as_fabricated` and the far-field path, the same that design, tolerance and prediction use.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from doedesign.calibration.explanations import Explanation, Family, Targets, explanations
from doedesign.calibration.fit import Fit, search
from doedesign.calibration.forward_model import ForwardModel, probe_camera
from doedesign.calibration.measurement import Measurement, MeasurementSpec, load_measurement, load_shots
from doedesign.calibration.objective import FitObjective
from doedesign.calibration.target import MeasuredImage, likeness, target_of
from doedesign.calibration.uncertainty import (
    DETERMINED,
    EXPLAINED,
    LeftOut,
    Posterior,
    Reading,
    cost_rises,
    left_out,
    posterior_of,
    readings,
)
from doedesign.calibration.unknowns import Unknowns, relative, unknowns_of
from doedesign.design.design import Design
from fab.process import Normal, Process

__all__ = [
    "DETERMINED",
    "EXPLAINED",
    "Calibration",
    "Explanation",
    "Family",
    "Fit",
    "FitObjective",
    "LeftOut",
    "MeasuredImage",
    "Measurement",
    "MeasurementSpec",
    "Posterior",
    "Reading",
    "Targets",
    "Unknowns",
    "calibrate",
    "explanations",
    "load_measurement",
    "load_shots",
    "unknowns_of",
]


@dataclass(frozen=True, eq=False)
class Calibration:
    """A finished calibration.

    Attributes:
        objective: images and model.
        fit: where the search ended.
        posterior: values of the errors and their uncertainty.
        process: the process with what is now known: means are the estimates, standard deviations their uncertainty.
        left_out: every image predicted from the others; empty for a single image.
        readings: what a lab reads off the images, measured and predicted.
        rises: how much the cost rises where it should rise by one.
        remarks: what a user must know before relying on any of it, in sentences.
    """

    objective: FitObjective
    fit: Fit
    posterior: Posterior
    process: Process
    left_out: list[LeftOut]
    readings: list[Reading]
    rises: list[float]
    remarks: list[str]

    @property
    def explained(self) -> bool:
        """Whether the model explains the images to their noise."""
        return self.posterior.chi2_per_pixel <= EXPLAINED

    @property
    def determined(self) -> dict[str, bool]:
        """For every error whether the images, and not the prior, say what it is."""
        names = self.objective.unknowns.names
        return dict(zip(names, (bool(ratio < DETERMINED) for ratio in self.posterior.ratio), strict=True))


def calibrate(
    design: Design,
    process: Process,
    measurement: Measurement,
    errors: Sequence[str] = (),
    *,
    evaluations: int = 60,
    polish: int = 0,
    seed: int = 0,
    on_model: Callable[[str], None] = lambda _: None,
) -> Calibration:
    """Find the process errors that explain measured PSFs.

    Args:
        design: the design as drawn.
        process: the process, whose means and standard deviations are the prior.
        measurement: the images.
        errors: which errors to look for, see `unknowns_of`.
        evaluations: models that the global search may look at where it is needed.
        polish: exact gradients that the last stage may take.
        seed: seed of the global search.
        on_model: told of every plate that is computed, with words on how it goes.

    Raises:
        InputError: an unknown error, or an image that does not fit.
    """
    spec = measurement.spec
    fill = design.camera.fill if spec.fill_factor is None else spec.fill_factor
    camera = probe_camera(design.camera, spec.probe_m, spec.pixel_m, measurement.window, fill)
    unknowns = unknowns_of(process, errors, camera.grid.pitch_m)
    depths_m = tuple(shot.depth_m for shot in measurement.shots)
    model = ForwardModel(design.level_map.level, camera, process, unknowns, depths_m)
    nominal = model.plate(unknowns.start)
    expected = [nominal.image(i, np.zeros(3)) for i in range(len(measurement.shots))]
    each = zip(measurement.shots, expected, strict=True)
    objective = FitObjective(model, tuple(target_of(shot, measurement.window, image) for shot, image in each))
    fit = search(objective, evaluations=evaluations, polish=polish, seed=seed, on_model=on_model)
    posterior = posterior_of(objective, fit)
    others = left_out(objective, fit, posterior) if len(objective.targets) > 1 else []
    rising = cost_rises(objective, fit, posterior)
    result = Calibration(
        objective,
        fit,
        posterior,
        _estimate(process, unknowns, posterior),
        others,
        readings(objective, fit, posterior),
        rising,
        [],
    )
    return replace(result, remarks=_remarks(result, expected))


def _estimate(process: Process, unknowns: Unknowns, posterior: Posterior) -> Process:
    found = {
        name: Normal(float(value), float(sigma))
        for name, value, sigma in zip(unknowns.names, posterior.values, posterior.sigma, strict=True)
    }
    # The others' places are relative to mask 0.
    references = {f"{name.partition('[')[0]}[0]" for name in unknowns.names if relative(name)}
    still = {name: Normal(process.spreads.get(name, Normal()).mean, 0.0) for name in references}
    spreads = MappingProxyType({**process.spreads, **still, **found})
    return replace(process, spreads=spreads, name=f"{process.name}, calibrated")


def _remarks(result: Calibration, expected: Sequence[Float[np.ndarray, "y x"]]) -> list[str]:
    posterior, unknowns = result.posterior, result.objective.unknowns
    out = []
    if not result.explained:
        out.append(
            f"The model does not explain the images: chi2 per pixel is {posterior.chi2_per_pixel:.3g} where noise "
            f"alone gives 1. Standard deviations are {posterior.inflation:.2g} times as wide for it, which covers what "
            "is random in the misfit and nothing else."
        )
        out += _turned_remarks(result, expected)
    elif posterior.chi2_per_pixel < 1 / EXPLAINED:
        out.append(
            f"The images are less noisy than stated: chi2 per pixel is {posterior.chi2_per_pixel:.3g} where noise "
            "alone gives 1. Check gain and read noise."
        )
    open_ones = [name for name, determined in result.determined.items() if not determined]
    if open_ones:
        out.append(f"Not determined by the images, hardly better known than before: {', '.join(open_ones)}.")
    if unknowns.assumed:
        out.append(f"The process says nothing of {', '.join(unknowns.assumed)}; wide ranges were assumed.")
    slack = 1e-3 * unknowns.sigma
    at_end = (posterior.values <= unknowns.low + slack) | (posterior.values >= unknowns.high - slack)
    if at_end.any():
        names = [name for name, ends in zip(unknowns.names, at_end, strict=True) if ends]
        out.append(f"At the end of the range that was looked at: {', '.join(names)}.")
    if result.rises and not all(0.5 < rise < 2 for rise in result.rises):
        text = ", ".join(f"{rise:.2g}" for rise in result.rises)
        out.append(f"The posterior is not normal where it is widest: the cost rises by {text} instead of 1.")
    if any(relative(name) for name in unknowns.names):
        out.append("Places of masks are relative to mask 0; a common shift cannot be seen.")
    return out


def _turned_remarks(result: Calibration, expected: Sequence[Float[np.ndarray, "y x"]]) -> list[str]:
    """Whether the images look more like the model when they are turned or mirrored."""
    target, model = result.objective.targets[0], expected[0]
    ways = {
        (turns, mirrored): likeness(target, model, turns, mirrored) for mirrored in (False, True) for turns in range(4)
    }
    best = max(ways, key=lambda way: ways[way])
    if ways[best] < ways[0, False] + 0.02:
        return []
    turns, mirrored = best
    way = f"turned left by {turns} more quarter turns" + (" after mirroring them" if mirrored else "")
    return [f"The images look more like the design when {way}: check quarter_turns and mirrored in the measurement."]
