"""`calibrate`: the process errors that explain measured PSFs."""

import contextlib
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from doedesign.build import with_edge_moves
from doedesign.calibration.files import write_calibration
from doedesign.calibration.fit import search
from doedesign.calibration.forward_model import ForwardModel
from doedesign.calibration.geometry import QUANTITIES, geometry_label, geometry_text
from doedesign.calibration.measurement import Measurement, read_measurement
from doedesign.calibration.objective import FitObjective, Linearization, OnModel
from doedesign.calibration.plots import plot_fitted_psfs
from doedesign.calibration.target import likeness, target_of
from doedesign.calibration.uncertainty import Posterior, Reading, cost_rises, left_out, posterior_of, readings
from doedesign.calibration.unknowns import Unknowns, relative, unknowns_of
from doedesign.design.design import Design
from doedesign.report.labels import error_label, value_text
from doedesign.runs.folder import Run
from doedesign.runs.level_maps import open_design
from doedesign.runs.results import results_folder
from doedesign.runtime.progress import meter
from fab.errors import InputError
from fab.figure import html_of
from fab.files import path_of
from fab.process import Normal, Process
from sim.camera import Colour

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

log = logging.getLogger("doedesign")

_EXPLAINED = 1.5  # chi2 per pixel up to which images count as explained
_SEEDS = 2**63  # NLopt takes numbers of 64 bits
_SURPRISING = 3.0  # standard deviations of the prior, of the camera's geometry


@dataclass(frozen=True, eq=False)
class Calibration:
    """A finished calibration.

    Attributes:
        fit: images and model where the search ended, and derivatives there.
        posterior: values of the errors and their uncertainty.
        process: the process with what is now known: means are the estimates, standard deviations their uncertainty.
        left_out: chi2 per pixel of every image predicted from the others; empty for a single image.
        readings: what a lab reads off the images, measured and predicted.
        rises: how much the cost rises where it should rise by one.
        measurement: the images as they were read.
        models: fabricated DOEs that were computed; a central difference counts as one.
        remarks: what a user must know before relying on any of it, in sentences.
    """

    fit: Linearization
    posterior: Posterior
    process: Process
    left_out: list[float]
    readings: list[Reading]
    rises: list[float]
    measurement: Measurement
    models: int
    remarks: tuple[str, ...] = ()

    @property
    def objective(self) -> FitObjective:
        """Images and model."""
        return self.fit.at.objective

    @property
    def explained(self) -> bool:
        """Whether the model explains the images to their noise."""
        return self.posterior.chi2_per_pixel <= _EXPLAINED

    @property
    def determined(self) -> dict[str, bool]:
        """Whether the images, and not the prior, say what an error is, by its name."""
        return dict(zip(self.objective.unknowns.names, self.posterior.determined, strict=True))

    @property
    def estimates(self) -> dict[str, str]:
        """Every error in words, with its standard deviation: "-120 ± 4 nm"."""
        values = zip(self.objective.unknowns.names, self.posterior.values, self.posterior.sigma, strict=True)
        return {name: value_text(name, float(value), float(sigma)) for name, value, sigma in values}

    @property
    def camera(self) -> dict[str, str]:
        """Everything that was looked for of the camera, in words, with its standard deviation: "1.002 ± 0.004 °"."""
        values, sigmas = self.posterior.geometry, self.posterior.geometry_sigma
        unknown = self.objective.model.geometry.unknown
        return {QUANTITIES[k]: geometry_text(QUANTITIES[k], float(values[k]), float(sigmas[k])) for k in unknown}

    @property
    def rows(self) -> dict[str, str]:
        """Errors and camera in words, by their labels."""
        errors = {error_label(name): text for name, text in self.estimates.items()}
        return errors | {geometry_label(name): text for name, text in self.camera.items()}

    def __str__(self) -> str:
        """The estimates, a line per error and per unknown of the camera."""
        wide = max(map(len, self.rows))
        lines = [f"{self.posterior.chi2_per_pixel:.4g} chi2 per pixel after {self.models} plates"]
        loose = {error_label(name) for name, determined in self.determined.items() if not determined}
        for label, text in self.rows.items():
            lines.append(f"{label:<{wide}}  {text}{'  (not determined)' if label in loose else ''}")
        order = next(r for r in self.readings if r.quantity == "zeroth_order").predicted
        lines.append(f"zeroth order {100 * order[0]:.3g} ± {100 * order[1]:.2g} %")
        return "\n".join([*lines, *self.remarks])

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw every measured image beside the model's; other pictures are in `doedesign.calibration.plots`."""
        return plot_fitted_psfs(self, ax)

    def _repr_html_(self) -> str:
        title = f"{self.process.name}: {self.posterior.chi2_per_pixel:.3g} chi2 per pixel"
        return html_of(title, {**self.rows, "remarks": " ".join(self.remarks)}, self.plot())


def calibrate(
    design: Design | Run | str | Path,
    measurement: Measurement | str | Path,
    errors: Sequence[str] = (),
    *,
    process: Process | str | Path | None = None,
    masks: str | Path | None = None,
    evaluations: int = 60,
    polish: int = 0,
    seed: int = 0,
    out: str | Path | None = None,
) -> Calibration:
    """Find the process errors that explain measured PSFs.

    Args:
        design: a design, a finished run or its folder.
        measurement: the images, or the TOML file that names them (`doedesign.calibration.measurement`).
        errors: which errors to look for, such as "depth", "overlay_x" or "cd_bias[3]"; by default depth and line width
            common to all masks, and overlay.
        process: the process, whose means and standard deviations are the prior; the name of a stock process or a TOML
            file; that of the design's spec by default.
        masks: mask order of the run; `masks/NAME` if there is one.
        evaluations: models of the global search, which begins only where it is needed.
        polish: steps along the exact gradient at the end.
        seed: seed of the global search.
        out: folder for results, the estimate as TOML, and pictures; without one everything stays in memory.

    Raises:
        InputError: an unknown error, a measurement that does not fit, or a folder that holds something else.
    """
    for name, value in (("evaluations", evaluations), ("polish", polish), ("seed", seed)):
        if value < 0:
            raise InputError(name, "must be 0 or more", value, "Leave it out, or give another.")
    if seed >= _SEEDS:
        raise InputError("seed", "must be below 2^63", seed, "Leave it out, or give another.")
    design = open_design(design, masks)
    prior = design.process(process)
    grid = design.camera.grid
    corner_m = float(np.hypot(*grid.extent_m)) / 2
    unknowns = unknowns_of(prior, errors, grid.pitch_m, corner_m)  # refuses mistakes before files are read
    if not isinstance(measurement, Measurement):
        measurement = read_measurement(path_of(measurement, "measurement"), design.camera)
    if design.camera.beam is not None:
        log.warning("the plate is lit as the measurement says (mode_field), not by the beam of the design")
    about = {"level_map_sha256": design.level_map.digest, "light": design.camera.light}
    writing = results_folder(out, design.name, design.folder, **about)
    # Usually seven rounds of derivatives and a step.
    with writing as fresh, models_meter("calibration", 7 * (len(unknowns.names) + 1)) as on_model:
        result = _calibrated(design, unknowns, measurement, evaluations, polish, seed, on_model)
        if fresh is not None:
            write_calibration(fresh, design, result, process)
    log.info(str(result))
    return result


def _calibrated(
    design: Design,
    unknowns: Unknowns,
    measurement: Measurement,
    evaluations: int,
    polish: int,
    seed: int,
    on_model: OnModel,
) -> Calibration:
    spec, images, models = measurement.spec, measurement.images, count()

    def counted(words: str) -> None:
        next(models)
        on_model(words)

    fill = design.camera.fill if spec.fill_factor is None else spec.fill_factor
    probe = (Colour("probe", (spec.probe_m,), (1.0,)),)
    camera = replace(design.camera, colours=probe, pixel_m=spec.pixel_m, window=measurement.window, fill=fill)
    depths, geometry = tuple(image.depth_m for image in images), spec.camera.prior
    radii = tuple(image.beam_radius_m for image in images)
    model = ForwardModel(design.level_map.level, camera, unknowns, depths, geometry, radii)
    nominal = model.plate(unknowns.start)
    expected = [nominal.image(i, np.array([0.0, 0.0, 0.0, *geometry.mean])) for i in range(len(images))]
    targets = (target_of(image, measurement.window, like) for image, like in zip(images, expected, strict=True))
    objective = FitObjective(model, tuple(targets))
    fit = search(objective, evaluations=evaluations, polish=polish, seed=seed, on_model=counted)
    posterior = posterior_of(fit)
    result = Calibration(
        fit,
        posterior,
        _estimated(unknowns, posterior, design.edge_moves_m),
        left_out(fit) if len(images) > 1 else [],
        readings(fit, posterior),
        cost_rises(fit, posterior),
        measurement,
        next(models),
    )
    return replace(result, remarks=tuple(remarks_on(result, expected[0])))


@contextlib.contextmanager
def models_meter(title: str, likely: int) -> Iterator[Callable[[str], None]]:
    """A meter for models, of which nobody knows beforehand how many there will be."""
    done = count(1)
    with meter(title, likely) as progress:
        yield lambda words: progress.advance(min(next(done), likely - 1), words)


def _estimated(unknowns: Unknowns, posterior: Posterior, edge_moves_m: Sequence[float]) -> Process:
    prior = unknowns.process
    each = zip(unknowns.names, posterior.values, posterior.sigma, strict=True)
    found = {name: Normal(float(value), float(sigma)) for name, value, sigma in each}
    # The others' places are relative to mask 0.
    references = {f"{name.partition('[')[0]}[0]" for name in unknowns.names if relative(name)}
    still = {name: Normal(prior.spreads.get(name, Normal()).mean, 0.0) for name in references}
    process = replace(prior, spreads={**prior.spreads, **still, **found}, name=f"{prior.name}, calibrated")
    # What was found is relative to the design; what the process does, to the masks.
    return with_edge_moves(process, [-move for move in edge_moves_m])


def remarks_on(result: Calibration, expected: Float[np.ndarray, "y x"]) -> Iterator[str]:
    """Remarks on a calibration, given the first image as it was expected."""
    posterior, unknowns = result.posterior, result.objective.unknowns
    if not result.explained:
        yield (
            f"The model does not explain the images: chi2 per pixel is {posterior.chi2_per_pixel:.3g} where noise "
            f"alone gives 1. Standard deviations are {posterior.inflation:.2g} times as wide for it, which covers what "
            "is random in the misfit and nothing else."
        )
        turned = [(turns, mirrored) for mirrored in (False, True) for turns in range(4)]
        ways = {way: likeness(result.objective.targets[0], expected, *way) for way in turned}
        turns, mirrored = best = max(ways, key=lambda way: ways[way])
        if ways[best] >= ways[0, False] + 0.02:
            way = f"turned left by {turns} more quarter turns" + (" after mirroring them" if mirrored else "")
            cure = "check quarter_turns and mirrored in the measurement"
            yield f"The images look more like the design when {way}: {cure}."
    elif posterior.chi2_per_pixel < 1 / _EXPLAINED:
        yield (
            f"The images are less noisy than stated: chi2 per pixel is {posterior.chi2_per_pixel:.3g} where noise "
            "alone gives 1. Check gain and read noise."
        )
    open_ones = [name for name, determined in result.determined.items() if not determined]
    if open_ones:
        yield f"Not determined by the images, hardly better known than before: {', '.join(open_ones)}."
    if unknowns.assumed:
        yield f"The process says nothing of {', '.join(unknowns.assumed)}; wide ranges were assumed."
    slack = 1e-3 * unknowns.sigma
    at_end = (posterior.values <= unknowns.low + slack) | (posterior.values >= unknowns.high - slack)
    if at_end.any():
        names = [name for name, ends in zip(unknowns.names, at_end, strict=True) if ends]
        yield f"At the end of the range that was looked at: {', '.join(names)}."
    prior = result.objective.model.geometry
    for kind in prior.unknown:
        away = (posterior.geometry[kind] - prior.mean[kind]) / prior.sigma[kind]
        if abs(away) > _SURPRISING:
            found = f"The {geometry_label(QUANTITIES[kind])}, {result.camera[QUANTITIES[kind]]}, is {abs(away):.2g}"
            yield f"{found} standard deviations from what was expected: check the bench and the measurement's [camera]."
    if result.rises and not all(0.5 < rise < 2 for rise in result.rises):
        text = ", ".join(f"{rise:.2g}" for rise in result.rises)
        yield f"The posterior is not normal where it is widest: the cost rises by {text} instead of 1."
    if any(relative(name) for name in unknowns.names):
        yield "Places of masks are relative to the first one; a common shift cannot be seen."
