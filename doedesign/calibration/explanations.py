"""What two numbers can mean: the process errors, one alone or two together, that would give a measured ring:disc ratio.

A lab that has measured the ring:disc ratio of a near PSF and a throughput cannot tell which errors made them. This
lists those that could: for every error the value, counted in standard deviations of the process, at which the model
gives the measured ratio, with the throughput and the zeroth order that come with it; and for every two errors the most
plausible pair. "None within reach" is an answer, too.

Throughput here is the energy in the sensor window per unit incident on the clear aperture, Fresnel loss included
(`doedesign.prediction`). A published throughput may be another one: the paper gives 86 % and does not say of what.

Errors are walked along rays from the process's means. Along a ray the ratio is looked at every standard deviation (and
at half of one), and the first crossing is closed in on by Brent's method. Two errors are mixed in the proportion that
would be most plausible if their effects added; where along it the ratio is met is then found with the model itself.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq

from doedesign.calibration.unknowns import chosen_names, definite_means, prior_sigma
from doedesign.design.design import Design
from doedesign.prediction import predict
from fab.errors import InputError
from fab.process import Process, deviation_of, variation_of
from sim.camera import Colour

_DEFAULT = (
    "common_depth_scale",
    "depth_scale",
    "radial_nonuniformity",
    "overlay_x_m",
    "common_cd_bias_m",
    "cd_bias_m",
    "corner_radius_m",
    "sidewall_rad",
    "etch_lag",
)
_CLOSE = 0.01  # standard deviations to which a crossing is found
_ANGLES = 120  # proportions of a pair that are tried on the sum of effects
_LEAST_SHARE = 0.2  # of a pair's length that each of its errors has at least


class Targets(NamedTuple):
    """What was measured.

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
    """Errors that give the measured ratio.

    Attributes:
        values: the errors by flat name, SI units.
        scores: how many standard deviations each lies from its mean.
        distance: how many they lie from it together.
        ring_to_disc: the model's ratio there.
        throughput: its throughput.
        zeroth_order: its zeroth order.
        strehl: overlap with the field that the design means to make.
        fits: whether the throughput is within two standard deviations of that measured; None if none was.
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
    """The ratio along one error.

    Attributes:
        scores: standard deviations from the mean, ascending.
        ring_to_disc: the model's ratio there.
        throughput: the model's throughput there.
    """

    scores: tuple[float, ...]
    ring_to_disc: tuple[float, ...]
    throughput: tuple[float, ...]


class Family(NamedTuple):
    """All explanations.

    Attributes:
        targets: what was measured.
        nominal: the model's row at the process's means.
        singles: explanations by one error, the most plausible first.
        pairs: explanations by two errors, likewise.
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


@dataclass(frozen=True, eq=False)
class _Walk:
    """The model as a function of scores, remembered."""

    design: Design
    process: Process
    sigma: Mapping[str, float]
    targets: Targets
    reach: float
    on_model: Callable[[str], None]
    seen: dict[tuple[tuple[str, float], ...], dict[str, Any] | None] = field(default_factory=dict)

    def values(self, scores: Mapping[str, float]) -> dict[str, float]:
        spreads = self.process.spreads
        return {n: (spreads[n].mean if n in spreads else 0.0) + z * self.sigma[n] for n, z in scores.items()}

    def row(self, scores: Mapping[str, float]) -> dict[str, Any] | None:
        """The model's numbers; None where an error is beyond what can be."""
        key = tuple(sorted((name, round(z, 9)) for name, z in scores.items() if z))
        if key not in self.seen:
            self.seen[key] = self._row(scores)
            self.on_model(" and ".join(scores) or "as believed")
        return self.seen[key]

    def _row(self, scores: Mapping[str, float]) -> dict[str, Any] | None:
        values = self.values(scores)
        if any(value < 0 and deviation_of(name).one_sided for name, value in values.items()):
            return None
        means = definite_means(self.process)
        try:
            rows = predict(self.design, self.process, variation_of(self.process.masks, {**means, **values})).rows
        except InputError:
            if not scores:
                raise
            return None  # such as edges that move by more than half a cell
        return rows[0]

    def excess(self, scores: Mapping[str, float]) -> float:
        """Logarithm of the model's ratio over the measured one; NaN beyond what can be."""
        row = self.row(scores)
        return np.nan if row is None else float(np.log(max(row["ring_to_disc"], 1e-9) / self.targets.ring_to_disc))

    def crossing(self, way: Mapping[str, float], start: float = 0.5) -> Mapping[str, float] | None:
        """First scores along a ray at which the ratio is the measured one.

        Args:
            way: direction, of length 1.
            start: where to look first; beyond it every standard deviation.
        """

        def at(length: float) -> dict[str, float]:
            return {name: length * share for name, share in way.items()}

        last, below = 0.0, self.excess({})
        stops = [start, *np.arange(np.floor(start) + 1, self.reach + 1e-9)]
        for stop in stops:
            above = self.excess(at(stop))
            if np.isnan(above):
                return None
            if below * above <= 0:
                met: Any = brentq(lambda s: self.excess(at(s)), last, stop, xtol=_CLOSE)
                return at(float(met))
            last, below = stop, above
        return None


def explanations(
    design: Design,
    process: Process,
    targets: Targets,
    errors: Sequence[str] = (),
    *,
    pairs: bool = True,
    reach: float = 4.0,
    on_model: Callable[[str], None] = lambda _: None,
) -> Family:
    """Find what would explain a measured ring:disc ratio.

    Args:
        design: the design as drawn.
        process: the process, whose means and standard deviations say what is plausible.
        targets: what was measured.
        errors: errors to consider, as in `unknowns_of`; by default every kind that a plate has in a definite way.
        pairs: whether to look at two errors together: of every kind of error the one that explains most easily.
        reach: standard deviations to look at.
        on_model: told of every plate that is computed.

    Returns:
        the family; errors on which the process is silent are judged by `prior_sigma` of `fab.process.DEVIATIONS`.

    Raises:
        InputError: an unknown error, a ratio that is not positive, or a depth at which there is no disc.
    """
    probe = Colour("probe", (targets.wavelength_m,), (1.0,))
    design = replace(design, camera=replace(design.camera, colours=(probe,)), near_m=(targets.depth_m,), far_m=())
    if not 0 < targets.ring_to_disc < np.inf:
        raise InputError("ring_to_disc", "must be positive", targets.ring_to_disc, "Give ring energy over disc energy.")
    if design.camera.defocus_radius_m(targets.depth_m) < design.camera.pixel_m:
        rule = "the source must be near enough to be blurred by more than a pixel"
        raise InputError("depth", rule, f"{targets.depth_m:g} m", "Give the depth of the near PSF.")
    names = chosen_names(process.masks, errors or _DEFAULT)
    sigma = {name: prior_sigma(process, name) for name in names}
    assumed = {name: sigma[name] for name in names if not (name in process.spreads and process.spreads[name].sigma)}
    walk = _Walk(design, process, sigma, targets, reach, on_model)
    nominal = walk.row({})
    assert nominal is not None  # otherwise the model has refused it
    singles, none = [], []
    for name in names:
        found = [walk.crossing({name: sign}) for sign in (1.0, -1.0)]
        met = [_explanation(walk, scores) for scores in found if scores is not None]
        singles += met
        none += [] if met else [(name,)]
    curves = {name: _curve(walk, name) for name in names}
    both, apart = _pairs(walk, curves, singles) if pairs else ([], [])
    return Family(
        targets,
        nominal,
        sorted(singles, key=lambda e: e.distance),
        sorted(both, key=lambda e: e.distance),
        none + apart,
        curves,
        assumed,
        reach,
    )


def _explanation(walk: _Walk, scores: Mapping[str, float]) -> Explanation:
    row = walk.row(scores)
    assert row is not None  # it is one that was looked at
    wanted, sigma = walk.targets.throughput, walk.targets.throughput_sigma
    return Explanation(
        values=walk.values(scores),
        scores={name: float(z) for name, z in scores.items()},
        distance=float(np.sqrt(sum(z * z for z in scores.values()))),
        ring_to_disc=row["ring_to_disc"],
        throughput=row["throughput"],
        zeroth_order=row["zeroth_order"],
        strehl=row["strehl"],
        fits=None if wanted is None else abs(row["throughput"] - wanted) <= 2 * sigma,
    )


def _curve(walk: _Walk, name: str) -> Curve:
    """All that was seen along one error."""
    points = [(0.0, walk.row({}))] + [
        (key[0][1], row) for key, row in walk.seen.items() if [n for n, _ in key] == [name]
    ]
    known = sorted((score, row) for score, row in points if row is not None)
    return Curve(
        tuple(score for score, _ in known),
        tuple(row["ring_to_disc"] for _, row in known),
        tuple(row["throughput"] for _, row in known),
    )


def _pairs(
    walk: _Walk, curves: Mapping[str, Curve], singles: Sequence[Explanation]
) -> tuple[list[Explanation], list[tuple[str, ...]]]:
    """Most plausible pairs of errors of different kinds."""
    alone: dict[str, float] = {}
    for each in singles:
        (name,) = each.scores
        alone[name] = min(each.distance, alone.get(name, np.inf))
    best: dict[str, str] = {}
    for name in curves:
        kind = name.partition("[")[0]
        if kind not in best or _promise(curves, alone, name) < _promise(curves, alone, best[kind]):
            best[kind] = name
    met, apart = [], []
    for one, other in combinations(best.values(), 2):
        ways = list(_ways(walk, curves[one], curves[other]))
        found = None
        if ways:
            length, angle = min(ways)[1:]
            way = {one: float(np.cos(angle)), other: float(np.sin(angle))}
            found = walk.crossing(way, length)
        if found is None:
            apart.append((one, other))
        else:
            met.append(_explanation(walk, found))
    return met, apart


def _promise(curves: Mapping[str, Curve], alone: Mapping[str, float], name: str) -> tuple[float, float]:
    """Sort key: what explains most easily alone, then what changes the ratio most."""
    ratios = np.log(curves[name].ring_to_disc)
    return alone.get(name, np.inf), -float(np.ptp(ratios))


def _ways(walk: _Walk, one: Curve, other: Curve) -> Iterator[tuple[float, float, float]]:
    """Cost, length and angle of mixtures that would reach the ratio if effects added."""
    lengths = np.linspace(0, walk.reach, 81)[1:]
    row = walk.row({})
    assert row is not None  # the model has not refused what is believed
    base = {"ring_to_disc": np.log(row["ring_to_disc"]), "throughput": row["throughput"]}

    def effect(curve: Curve, scores: np.ndarray, quantity: str) -> np.ndarray:
        values = np.asarray(getattr(curve, quantity))
        values = np.log(values) if quantity == "ring_to_disc" else values
        return np.interp(scores, curve.scores, values, left=np.nan, right=np.nan) - base[quantity]

    for angle in np.linspace(-np.pi, np.pi, _ANGLES, endpoint=False):
        shares = np.cos(angle), np.sin(angle)
        if min(map(abs, shares)) < _LEAST_SHARE:
            continue
        sums = {
            quantity: base[quantity]
            + effect(one, shares[0] * lengths, quantity)
            + effect(other, shares[1] * lengths, quantity)
            for quantity in base
        }
        excess = sums["ring_to_disc"] - np.log(walk.targets.ring_to_disc)
        start = base["ring_to_disc"] - np.log(walk.targets.ring_to_disc)
        crossed = np.flatnonzero(excess * start <= 0)
        if crossed.size:
            length, throughput = float(lengths[crossed[0]]), float(sums["throughput"][crossed[0]])
            cost = length**2
            if walk.targets.throughput is not None:
                cost += ((throughput - walk.targets.throughput) / walk.targets.throughput_sigma) ** 2
            yield cost, length, float(angle)
