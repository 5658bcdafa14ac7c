"""`explain_ratio`: the process errors, one alone or two together, that would give a measured ring:disc ratio.

A lab that has measured the ring:disc ratio of a near PSF and a throughput cannot tell which errors made them. This
lists those that could: for every error the value, counted in standard deviations of the process, at which the model
gives the measured ratio, with the throughput and the zeroth order that come with it; and for every two errors the most
plausible pair. "None within reach" is an answer, too.

Throughput here is the energy in the sensor window per unit incident on the clear aperture, Fresnel loss included
(`doedesign.prediction`). A published throughput may be another one: the paper gives 86 % and does not say of what.

The ratio is followed along rays from the process's means, every standard deviation (and at half of one), and the first
crossing is closed in on by Brent's method. Two errors are mixed in the proportion that would be most plausible if their
effects added; where along it the ratio is met is then found with the model itself.
"""

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.optimize import brentq

from doedesign.calibration.estimate import models_meter
from doedesign.calibration.files import write_explanations
from doedesign.calibration.objective import OnModel
from doedesign.calibration.plots import plot_explanations
from doedesign.calibration.unknowns import chosen_names, definite_means, prior_sigma
from doedesign.design.design import Design
from doedesign.prediction import predict
from doedesign.report.labels import error_label, value_text
from doedesign.runs.folder import Run
from doedesign.runs.level_maps import open_design
from doedesign.runs.results import results_folder
from fab.errors import InputError
from fab.figure import html_of
from fab.process import Normal, Process, deviation_of, variation_of
from fab.units import number_of
from sim.camera import Colour

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

log = logging.getLogger("doedesign")

_DEFAULT = (
    *("common_depth_scale", "depth_scale", "radial_nonuniformity", "overlay_x_m", "common_cd_bias_m", "cd_bias_m"),
    *("corner_radius_m", "sidewall_rad", "etch_lag"),
)
_MOST_REACH = 1000  # standard deviations
_CLOSE = 0.01  # standard deviations to which a crossing is found
_ANGLES = 120  # proportions of a pair that are tried on the sum of effects
_LEAST_SHARE = 0.2  # of a pair's length that each of its errors has at least


class Targets(NamedTuple):
    """Measured numbers.

    Attributes:
        wavelength_m: of the probe.
        depth_m: of the source.
        ring_to_disc: energy outside the geometric defocus disc over that inside.
        throughput: energy in the window per unit incident on the clear aperture; None if it was not measured.
        throughput_sigma: its standard deviation.
    """

    wavelength_m: float
    depth_m: float
    ring_to_disc: float
    throughput: float | None = None
    throughput_sigma: float = 0.02


class Explanation(NamedTuple):
    """Errors by flat name, SI units, that give the measured ratio, and the model's metrics there.

    Scores are standard deviations from the means, `distance` those of all errors together. `fits` says whether the
    throughput is within two standard deviations of that measured; None if none was.
    """

    values: dict[str, float]
    scores: dict[str, float]
    distance: float
    ring_to_disc: float
    throughput: float
    zeroth_order: float
    strehl: float
    fits: bool | None


class Curve(NamedTuple):
    """The model's ratio and throughput along one error; scores are standard deviations from the mean, ascending."""

    scores: tuple[float, ...]
    ring_to_disc: tuple[float, ...]
    throughput: tuple[float, ...]


class ExplanationSet(NamedTuple):
    """All explanations of some measured numbers.

    Attributes:
        targets: the measured numbers.
        nominal: the model's row at the process's means.
        singles: explanations by one error, the most plausible first; `pairs` likewise by two.
        none: errors, or pairs, that do not reach the ratio.
        curves: the ratio along every error.
        assumed: errors on which the process is silent, with the standard deviations that were assumed.
        reach: standard deviations that were looked at.
    """

    targets: Targets
    nominal: dict[str, Any]
    singles: list[Explanation]
    pairs: list[Explanation]
    none: list[tuple[str, ...]]
    curves: dict[str, Curve]
    assumed: dict[str, float]
    reach: float

    @property
    def unreached(self) -> list[str]:
        """Errors that do not reach the ratio alone."""
        return [names[0] for names in self.none if len(names) == 1]

    def __str__(self) -> str:
        """The explanations as a table."""
        targets, nominal = self.targets, self.nominal
        throughput = "" if targets.throughput is None else f", throughput {100 * targets.throughput:.3g} %"
        lines = [
            f"measured: ring:disc {targets.ring_to_disc:.3g}{throughput}",
            f"model at the process's means: ring:disc {nominal['ring_to_disc']:.3g}, "
            f"throughput {100 * nominal['throughput']:.3g} %, zeroth order {100 * nominal['zeroth_order']:.2g} %",
            "",
            "sigmas  throughput  0th order  what would give the measured ratio"
            + ("" if targets.throughput is None else " (*: and the throughput, to two sigmas)"),
        ]
        for title, rows in (("one error", self.singles), ("two errors", self.pairs)):
            lines += [f"{title}:"] if rows else []
            for each in rows:
                values = ", ".join(f"{error_label(name)} {value_text(name, v)}" for name, v in each.values.items())
                light = f"{100 * each.throughput:8.1f} %{'*' if each.fits else ' '} {100 * each.zeroth_order:8.2f} %"
                lines.append(f"{each.distance:6.2f}  {light}  {values}")
        if self.unreached:
            lines.append(f"none within {self.reach:g} sigmas, where the ratio stays within:")
        for name in self.unreached:
            ratios = self.curves[name].ring_to_disc
            lines.append(f"  {min(ratios):5.3g} to {max(ratios):5.3g}  {error_label(name)}")
        if self.assumed:
            lines.append(f"sigmas that the process does not give were assumed: {', '.join(self.assumed)}")
        lines.append(
            "Throughput is the light in the sensor window per light on the clear aperture, Fresnel loss included; "
            "a published one may be another."
        )
        return "\n".join(lines)

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw the ratio along every error, and the explanations in order, in the place of axes or a new figure."""
        return plot_explanations(self, ax)

    def _repr_html_(self) -> str:
        rows = {
            " and ".join(map(error_label, each.values)): f"{each.distance:.2f} standard deviations"
            for each in [*self.singles, *self.pairs]
        }
        return html_of(f"ring:disc {self.targets.ring_to_disc:.3g}", rows or {"none": "within reach"}, self.plot())


@dataclass(frozen=True, eq=False)
class _ScoredModel:
    """The model's metrics as a function of the errors' scores, each computed once."""

    design: Design
    process: Process
    sigma: Mapping[str, float]
    targets: Targets
    reach: float
    on_model: OnModel
    computed: dict[tuple[tuple[str, float], ...], dict[str, Any] | None] = field(default_factory=dict)

    @property
    def lengths(self) -> list[float]:
        """Every standard deviation of the reach, and its end."""
        return [*map(float, range(1, math.ceil(self.reach))), float(self.reach)]

    def values(self, scores: Mapping[str, float]) -> dict[str, float]:
        means = self.process.spreads
        return {name: means.get(name, Normal()).mean + z * self.sigma[name] for name, z in scores.items()}

    def row(self, scores: Mapping[str, float]) -> dict[str, Any] | None:
        """The model's metrics; None where it does not describe an error."""
        key = tuple(sorted((name, round(z, 9)) for name, z in scores.items() if z))
        if key not in self.computed:
            self.computed[key] = self._row(scores)
            self.on_model(" and ".join(scores) or "means")
        return self.computed[key]

    def _row(self, scores: Mapping[str, float]) -> dict[str, Any] | None:
        values = self.values(scores)
        if any(value < 0 and deviation_of(name).one_sided for name, value in values.items()):
            return None
        variation = variation_of(self.process.masks, {**definite_means(self.process), **values})
        try:
            return predict(self.design, self.process, variation).rows[0]
        except InputError:
            if not scores:
                raise
            return None  # such as edges that move by more than half a cell

    def means(self) -> dict[str, Any]:
        """The model's metrics at the process's means."""
        row = self.row({})
        assert row is not None  # otherwise the model has refused it
        return row

    def excess(self, scores: Mapping[str, float]) -> float:
        """Logarithm of the model's ratio over the measured one; NaN where the model does not describe an error."""
        row = self.row(scores)
        return np.nan if row is None else float(np.log(max(row["ring_to_disc"], 1e-9) / self.targets.ring_to_disc))

    def crossing(self, direction: Mapping[str, float], start: float = 0.5) -> Mapping[str, float] | None:
        """First scores along a ray (a direction of length 1) at which the ratio is the measured one.

        The ray is looked at where it starts, at `start`, beyond it at every standard deviation, and at its end.
        """

        def at(length: float) -> dict[str, float]:
            return {name: length * share for name, share in direction.items()}

        start = min(start, self.reach)
        last, below = 0.0, self.excess({})
        for stop in [start, *(length for length in self.lengths if length > start)]:
            above = self.excess(at(stop))
            if np.isnan(above):
                return None
            if below * above <= 0:
                met: Any = brentq(lambda s: self.excess(at(s)), last, stop, xtol=_CLOSE)
                return at(float(met))
            last, below = stop, above
        return None

    def explanation(self, scores: Mapping[str, float]) -> Explanation:
        """The explanation by scores at which the ratio is met."""
        row, wanted = self.row(scores), self.targets.throughput
        assert row is not None  # it is one that was computed
        return Explanation(
            values=self.values(scores),
            scores={name: float(z) for name, z in scores.items()},
            distance=float(np.sqrt(sum(z * z for z in scores.values()))),
            **{name: row[name] for name in ("ring_to_disc", "throughput", "zeroth_order", "strehl")},
            fits=None if wanted is None else abs(row["throughput"] - wanted) <= 2 * self.targets.throughput_sigma,
        )

    def curve(self, name: str) -> Curve:
        """All that was computed along one error."""
        along = [(key[0][1], row) for key, row in self.computed.items() if [n for n, _ in key] == [name]]
        known = [(score, row) for score, row in [(0.0, self.means()), *along] if row is not None]
        points = sorted((score, row["ring_to_disc"], row["throughput"]) for score, row in known)
        return Curve(*zip(*points, strict=True))

    def whole_curve(self, name: str) -> Curve:
        """The curve of an error to the end of the reach, either way, or as far as the model describes it."""
        for sign in (1.0, -1.0):
            for score in self.lengths:
                if self.row({name: sign * score}) is None:
                    break
        return self.curve(name)


def explain_ratio(
    design: Design | Run | str | Path,
    targets: Targets,
    errors: Sequence[str] = (),
    *,
    process: Process | str | Path | None = None,
    masks: str | Path | None = None,
    pairs: bool = True,
    reach: float = 4.0,
    out: str | Path | None = None,
) -> ExplanationSet:
    """Find the process errors that would give a measured ring:disc ratio.

    The plate is lit evenly, or by the design's beam. The tip of a fibre (`mode_field` of a measurement) lights the rim
    less, so a ratio that was measured before one is explained a little off.

    Args:
        design: a design, a finished run or its folder.
        targets: what was measured.
        errors: errors to consider, as in `calibrate`; by default every kind that a DOE has in a definite way.
        process: the process, whose means and standard deviations say what is plausible; that of the design's spec by
            default. Errors on which it is silent are judged by `prior_sigma` of `fab.process.DEVIATIONS`.
        masks: mask order of the run; `masks/NAME` if there is one.
        pairs: whether to look at two errors together: of every kind of error the one that explains most easily.
        reach: standard deviations to look at.
        out: folder for the explanations and their picture; without one they stay in memory.

    Raises:
        InputError: an unknown error, a number that is not positive, or a depth at which there is no disc.
    """
    design = open_design(design, masks)
    prior = design.process(process)
    _require_possible(targets, reach)
    if design.camera.defocus_radius_m(targets.depth_m) < design.camera.pixel_m:
        rule = "the source must be near enough to be blurred by more than a pixel"
        raise InputError("depth", rule, f"{targets.depth_m:g} m", "Give the depth of the near PSF.")
    names = chosen_names(prior.masks, errors or _DEFAULT)
    writing = results_folder(out, design.name, design.folder, light=design.camera.light)
    # About ten models for every error and six for a pair; those of a pair are followed to the end.
    with writing as fresh, models_meter("explanations", 200) as on_model:
        camera = replace(design.camera, colours=(Colour("probe", (targets.wavelength_m,), (1.0,)),))
        probed = replace(design, camera=camera, near_m=(targets.depth_m,), far_m=())
        sigma = {name: prior_sigma(prior, name) for name in names}
        found = _explained(_ScoredModel(probed, prior, sigma, targets, reach, on_model), pairs)
        if fresh is not None:
            write_explanations(fresh, design.name, found)
    log.info(str(found))
    return found


def _require_possible(targets: Targets, reach: float) -> None:
    """Refuse numbers that nothing can have, or that cannot be looked at."""
    positive = "must be positive"
    for name, value, cure in (
        ("probe", targets.wavelength_m, 'For example "520 nm".'),
        ("depth", targets.depth_m, 'For example "10 cm".'),
        ("throughput_sigma", targets.throughput_sigma, "For example 0.02."),
    ):
        if not number_of(value) > 0:
            raise InputError(name, positive, repr(value), cure)
    if not 0 < number_of(targets.ring_to_disc) < np.inf:
        raise InputError("ring_to_disc", positive, repr(targets.ring_to_disc), "Give ring energy over disc energy.")
    if targets.throughput is not None and not 0 < number_of(targets.throughput) <= 1:
        rule = "must be a share of the light, above 0 and up to 1"
        raise InputError("throughput", rule, repr(targets.throughput), "Write 0.86.")
    if not 0 < number_of(reach) <= _MOST_REACH:
        raise InputError("reach", f"must be above 0 and up to {_MOST_REACH}", reach, "For example 4.")


def _explained(model: _ScoredModel, pairs: bool) -> ExplanationSet:
    nominal = model.means()
    singles, none = [], []
    for name in model.sigma:
        crossings = [model.crossing({name: sign}) for sign in (1.0, -1.0)]
        met = [model.explanation(scores) for scores in crossings if scores is not None]
        singles += met
        none += [] if met else [(name,)]
    both, apart = _pairs(model, singles) if pairs else ([], [])
    stated = {name for name, spread in model.process.spreads.items() if spread.sigma}
    return ExplanationSet(
        model.targets,
        nominal,
        sorted(singles, key=lambda e: e.distance),
        sorted(both, key=lambda e: e.distance),
        none + apart,
        {name: model.curve(name) for name in model.sigma},
        {name: sigma for name, sigma in model.sigma.items() if name not in stated},
        model.reach,
    )


def _pairs(model: _ScoredModel, singles: Sequence[Explanation]) -> tuple[list[Explanation], list[tuple[str, ...]]]:
    """Most plausible pairs of errors of different kinds, and the pairs that do not reach the ratio."""
    curves = {name: model.curve(name) for name in model.sigma}

    def promise(name: str) -> tuple[float, float]:
        """Sort key: what explains most easily alone, then what changes the ratio most."""
        alone = (each.distance for each in singles if name in each.scores)
        return min(alone, default=np.inf), -float(np.ptp(np.log(curves[name].ring_to_disc)))

    best: dict[str, str] = {}
    for name in curves:
        kind = name.partition("[")[0]
        best[kind] = min(best.get(kind, name), name, key=promise)
    # One error may go beyond where it meets the ratio alone if the other pulls back.
    curves = {name: model.whole_curve(name) for name in best.values()}
    met, apart = [], []
    for one, other in combinations(best.values(), 2):
        mixtures = list(_mixtures(model, curves[one], curves[other]))
        found = None
        if mixtures:
            length, angle = min(mixtures)[1:]
            found = model.crossing({one: float(np.cos(angle)), other: float(np.sin(angle))}, length)
        if found is None:
            apart.append((one, other))
        else:
            met.append(model.explanation(found))
    return met, apart


def _mixtures(model: _ScoredModel, one: Curve, other: Curve) -> Iterator[tuple[float, float, float]]:
    """Cost, length and angle of mixtures that would reach the ratio if effects added."""
    lengths = np.linspace(0, model.reach, 81)[1:]
    row, targets = model.means(), model.targets
    base = {"ring_to_disc": np.log(row["ring_to_disc"]), "throughput": row["throughput"]}

    def effect(curve: Curve, scores: np.ndarray, quantity: str) -> np.ndarray:
        values = np.asarray(getattr(curve, quantity))
        values = np.log(values) if quantity == "ring_to_disc" else values
        return np.interp(scores, curve.scores, values, left=np.nan, right=np.nan) - base[quantity]

    for angle in np.linspace(-np.pi, np.pi, _ANGLES, endpoint=False):
        first, second = np.cos(angle) * lengths, np.sin(angle) * lengths
        if min(abs(np.cos(angle)), abs(np.sin(angle))) < _LEAST_SHARE:
            continue
        ratio, throughput = (base[q] + effect(one, first, q) + effect(other, second, q) for q in base)
        start, measured = base["ring_to_disc"], np.log(targets.ring_to_disc)
        crossed = np.flatnonzero((ratio - measured) * (start - measured) <= 0)
        if crossed.size:
            length = float(lengths[crossed[0]])
            cost = length**2
            if targets.throughput is not None:
                off = float(throughput[crossed[0]]) - targets.throughput
                cost += (off / targets.throughput_sigma) ** 2
            yield cost, length, float(angle)
