"""`tolerance`: the usual questions of a tolerance study, and its result as a value."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from doedesign.runs.folder import Run
from doedesign.spec import LimitSpec
from doedesign.spec.process import leading_quantity
from doedesign.tolerancing.analysis import QUANTITIES, Sample, Yield, limit_text, yield_of
from doedesign.tolerancing.budget import Budget
from doedesign.tolerancing.plots import plot_histograms
from doedesign.tolerancing.pool import Evaluate, predicted_rows
from doedesign.tolerancing.result_files import write_results
from doedesign.tolerancing.sensitivity import Effect, VarianceShare, source_shares
from doedesign.tolerancing.studies import FORMAT, Study, at_least_one, study
from fab.draws import EXPECTED, NOMINAL, normal_keys, one_at_a_time_keys
from fab.errors import InputError
from fab.figure import html_of
from fab.process import DEVIATIONS, Process, short_name
from fab.units import format_length

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    from doedesign.design.design import Design

log = logging.getLogger("doedesign")

Sensitivity = Literal["one_at_a_time", "sobol", "none"]


@dataclass(frozen=True)
class ToleranceResult:
    """Result of a tolerance study; None where a question was not asked.

    Attributes:
        study: design, process and evaluated draws, of which more can be asked.
        plan: arguments of `tolerance` that say what was asked; `keys` are all draws that the answers needed.
        nominal: the DOE exactly as designed.
        expected: the DOE with every error at its mean.
        sample: the Monte-Carlo draws; `corners` those of the worst case.
        effects: effect of every error alone.
        variance_shares: Sobol indices of every source of error.
        budget: how large some errors may be.
    """

    study: Study
    plan: Mapping[str, Any]
    keys: Sequence[str]
    nominal: Sample
    expected: Sample
    sample: Sample
    effects: list[Effect] | None
    variance_shares: list[VarianceShare] | None
    corners: Sample | None
    budget: Budget | None

    @property
    def yield_(self) -> Yield | None:
        """Share of the Monte-Carlo draws that obey every limit; None without limits."""
        return self.sample.yield_

    @property
    def worst(self) -> str:
        """Key of the worst Monte-Carlo draw, for `study.variation`."""
        return self.sample.worst_draw

    def statistics(self) -> list[dict[str, Any]]:
        """Mean, spread and percentiles of every metric; see `Sample.statistics`."""
        return self.sample.statistics()

    @property
    def shares(self) -> dict[str, dict[str, float]]:
        """Share of every source in the variance of each metric, the worst row of a draw; empty if not asked."""
        quantities = self.sample.values
        if self.variance_shares is not None:
            of = [one for one in self.variance_shares if one.colour is None]
            return {name: {one.source: one.total.value for one in of if one.quantity == name} for name in quantities}
        return {name: source_shares(self.effects, name) for name in quantities} if self.effects is not None else {}

    def record(self) -> dict[str, Any]:
        """Everything that was found as plain values for JSON, SI units; what is not finite is None."""
        answers = {
            "one_at_a_time": self.effects,
            "sobol": self.variance_shares,
            "shares": self.shares or None,
            "corners": self.corners and _sample_record(self.corners),
            "budget": self.budget,
        }
        out = {
            "format": FORMAT,
            "design": self.study.design.name,
            "light": self.study.design.camera.light,
            "seed": self.study.seed,
            "plan": self.plan,
            "units": "SI; a depth of null is infinity; a colour of null is the worst colour and depth of each plate",
            "nominal": self.nominal.rows,
            "expected": self.expected.rows,
            "beyond": self.study.beyond(self.keys),
            "plates": _sample_record(self.sample),
            **{name: found for name, found in answers.items() if found is not None},
        }
        return plain(out)

    def __str__(self) -> str:
        """Yield, the most important source of error and the budget, on one line."""
        limits, draws = self.study.limits, len(self.sample.keys)
        quantity = leading_quantity(self.sample.values)
        words = [f"{draws} plates; without limits there is no yield"]
        if limits:
            words = [f"yield {self.yield_} of {draws} plates"]
            # The limit that most draws break.
            quantity = min(limits, key=lambda one: yield_of(self.sample.obeys(one)).share).quantity
        if shares := self.shares.get(quantity):
            source = max(shares, key=lambda name: shares[name])
            label = QUANTITIES[quantity].label
            words.append(f"most important: {source}, {100 * shares[source]:.0f} % of the variance of the {label}")
        if self.budget is not None:
            words.append(f"{self.budget}{_sigmas(self.budget)}")
        if beyond := self.study.beyond(self.keys):
            key, reason = next(iter(beyond.items()))
            words.append(f"{len(beyond)} plates beyond the model count as bad, such as {key} ({reason})")
        return "; ".join(words)

    def plot(self, ax: "Axes | None" = None) -> "FigureBase":
        """Draw how every metric is distributed over the draws, in the place of axes or a new figure.

        Other pictures are in `doedesign.tolerancing.plots`.
        """
        return plot_histograms(self.sample, self.nominal, self.study.design.camera, ax)

    def _repr_html_(self) -> str:
        drawn = {row["quantity"]: row for row in self.statistics() if row["colour"] is None}
        rows: dict[str, object] = {"yield": self.yield_ or "no limits"}
        for name, row in drawn.items():
            nominal = float(self.nominal.worst(name)[0])
            rows[QUANTITIES[name].label] = (
                f"mean {row['mean']:.4g}, 5 to 95 %: {row['p05']:.4g} to {row['p95']:.4g}, as drawn {nominal:.4g}"
            )
        return html_of(f"Tolerance of {self.study.design.name}, {len(self.sample.keys)} draws", rows, self.plot())


def tolerance(
    design: "Design | Run | str | Path",
    *,
    process: "Process | str | Path | None" = None,
    errors: Mapping[str, Any] | None = None,
    limits: Sequence[str | LimitSpec] | None = None,
    draws: int = 100,
    sensitivity: Sensitivity = "one_at_a_time",
    sobol: int = 64,
    corners: bool = False,
    budget: str | None = None,
    wanted: float = 0.9,
    seed: int = 0,
    masks: str | Path | None = None,
    out: str | Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    evaluate: Evaluate = predicted_rows,
) -> ToleranceResult:
    """Study what the errors of a process make of a design: yield, which errors matter, and how large they may be.

    Args:
        design: a design, a finished run or its folder.
        process: a process, its name or a TOML file; that of the design's spec by default.
        errors: errors to be changed, `{"overlay_x": "0.5 um"}` or, in SI units, `{"overlay_x_m": 0.5e-6}`.
        limits: what a good DOE obeys, such as "strehl >= 0.6"; the limits of the design's spec by default.
        draws: Monte-Carlo draws; also the draws per point of the budget.
        sensitivity: which errors matter: each alone, as Sobol indices (shares of variance), or not at all.
        sobol: rows of the samples behind Sobol indices, a power of two; each costs sources + 2 draws.
        corners: whether worst-case corners are looked at, too.
        budget: errors for which the largest sigma is sought, such as "overlay", "overlay_x" or "overlay_x[3]".
        wanted: yield that the budget is for, 0-1.
        seed: seed of every draw.
        masks: mask order of the run; see `study`.
        out: folder for draws, results and pictures, in which a stopped study goes on where it was stopped, and one that
            asks for more takes the finished draws over; without one everything stays in memory.
        workers: worker processes; see `study`.
        scheduler: address of a Dask scheduler; see `study`.
        evaluate: evaluation of a draw; see `study`.

    Raises:
        InputError: something that cannot be used; see `study`.
    """
    if sensitivity not in get_args(Sensitivity):
        rule = f"must be one of {', '.join(get_args(Sensitivity))}"
        raise InputError("sensitivity", rule, repr(sensitivity), "Choose one of them.")
    settings: dict[str, Any] = {"process": process, "errors": errors, "limits": limits, "seed": seed, "masks": masks}
    where: dict[str, Any] = {"out": out, "workers": workers, "scheduler": scheduler, "evaluate": evaluate}
    asked = study(design, **settings, **where)
    # All draws first: mistakes in the questions show before anything is computed, and no worker waits between two.
    keys = [NOMINAL, EXPECTED, *normal_keys(at_least_one("draws", draws))]
    if sensitivity == "one_at_a_time":
        keys += one_at_a_time_keys(asked.process)
    if sensitivity == "sobol":
        keys += asked.sobol_keys(sobol)
    if corners:
        keys += asked.corner_keys()
    if budget is not None:
        keys += [key for some in asked.budget_keys(budget, wanted, draws) for key in some]
    keys = list(dict.fromkeys(keys))
    plan = {"draws": draws, "sensitivity": sensitivity, "sobol": sobol}
    plan |= {"corners": corners, "budget": budget, "wanted": wanted}
    with asked.journal.open():
        # The expected DOE last: it is often the nominal one, and two workers had better compile different programs.
        asked.sample(sorted(keys, key=EXPECTED.__eq__))
        result = ToleranceResult(
            asked,
            plan,
            keys,
            asked.sample([NOMINAL]),
            asked.sample([EXPECTED]),
            asked.monte_carlo(draws),
            asked.one_at_a_time() if sensitivity == "one_at_a_time" else None,
            asked.sobol(sobol) if sensitivity == "sobol" else None,
            asked.corners() if corners else None,
            asked.budget(budget, wanted, draws) if budget is not None else None,
        )
        if out is not None:
            write_results(Path(out), result)
    log.info(str(result))
    return result


def _sample_record(sample: Sample) -> dict[str, Any]:
    together = sample.yield_
    each = [{"limit": limit_text(one), **yield_of(sample.obeys(one))._asdict()} for one in sample.limits]
    return {
        "count": len(sample.keys),
        "statistics": sample.statistics(),
        "worst": {"key": sample.worst_draw, "rows": sample.of([sample.worst_draw]).rows},
        "yield": None if together is None else {**together._asdict(), "limits": each},
    }


def plain(value: Any) -> Any:
    """Plain values for JSON: a NamedTuple becomes a dictionary, and what is not finite None."""
    if isinstance(value, Mapping) or hasattr(value, "_asdict"):
        named = value if isinstance(value, Mapping) else value._asdict()
        return {str(key): plain(one) for key, one in named.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _sigmas(budget: Budget) -> str:
    """The standard deviations of a budget: ": sigma of overlay_x 0.31 um"."""
    if budget.verdict == "out of reach":
        return ""
    named: dict[str, set[float]] = {}
    for name, sigma in budget.sigmas.items():
        named.setdefault(name.partition("[")[0], set()).add(sigma)
    words = []
    for key, sigmas in named.items():
        if len(sigmas) == 1:
            sigma, unit = float(f"{sigmas.pop():.3g}"), DEVIATIONS[key].unit
            text = format_length(sigma) if unit == "m" else f"{sigma:g}{' rad' if unit == 'rad' else ''}"
            words.append(f", sigma of {short_name(key)} {text}")
    return "".join(words)
