"""`doedesign tolerance`: what the plates a process makes are like, which errors matter, and how large they may be."""

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from doedesign.report.tolerance import plot_budget, plot_changes, plot_histograms, plot_shares, plot_yield
from doedesign.runs.folder import open_run
from doedesign.spec import variation_to_toml
from doedesign.tolerancing.analysis import QUANTITIES, limit_text, obeys, yield_of
from doedesign.tolerancing.budget import Budget
from doedesign.tolerancing.pool import DrawModel, OutOfModel, evaluate_here, predicted_bank
from doedesign.tolerancing.sensitivity import Change, Share, as_records, source_shares
from doedesign.tolerancing.studies import FORMAT, Plates, Study, study
from fab.draws import EXPECTED, NOMINAL, corner_keys, normal_keys, one_at_a_time_keys
from fab.errors import InputError
from fab.figure import save
from fab.files import MANIFEST_NAME, canonical_json, read_json, sha256_file, write_atomic
from fab.process import DEVIATIONS, error_names, short_name
from fab.units import format_length
from sim.plots.psfs import plot_psfs

Say = Callable[[str], None]


class StudyPlan(NamedTuple):
    """What is asked about a process.

    Attributes:
        draws: Monte-Carlo plates; also the plates per point of the budget.
        sensitivity: how it is found out which errors matter.
        sobol: rows of the samples for Sobol indices, a power of two.
        corners: whether worst-case corners are looked at.
        budget: the errors that get an inverse budget, such as "overlay".
        wanted: the yield it is for.
    """

    draws: int = 100
    sensitivity: Literal["one_at_a_time", "sobol", "none"] = "one_at_a_time"
    sobol: int = 64
    corners: bool = False
    budget: str | None = None
    wanted: float = 0.9

    def keys(self, of: Study) -> list[str]:
        """Every plate that the answers need."""
        if self.draws < 1:
            raise InputError("--draws", "must be at least 1", self.draws, "For example 100.")
        keys = [NOMINAL, EXPECTED, *normal_keys(self.draws)]
        if self.sensitivity == "one_at_a_time":
            keys += one_at_a_time_keys(of.process)
        if self.sensitivity == "sobol":
            keys += of.sobol_keys(self.sobol)
        if self.corners:
            keys += corner_keys(of.process)
        if self.budget is not None:
            keys += [key for some in of.budget_keys(self.budget, self.wanted, self.draws) for key in some]
        return list(dict.fromkeys(keys))


class StudyFindings(NamedTuple):
    """The answers; None to what was not asked."""

    nominal: Plates
    expected: Plates
    plates: Plates
    changes: list[Change] | None
    shares: list[Share] | None
    corners: Plates | None
    budget: Budget | None


def _found(asked: Study, plan: StudyPlan) -> StudyFindings:
    asked.plates(plan.keys(asked))  # all at once, so that no worker waits between two questions
    return StudyFindings(
        asked.plates([NOMINAL]),
        asked.plates([EXPECTED]),
        asked.monte_carlo(plan.draws),
        asked.one_at_a_time() if plan.sensitivity == "one_at_a_time" else None,
        asked.sobol(plan.sobol) if plan.sensitivity == "sobol" else None,
        asked.corners() if plan.corners else None,
        asked.budget(plan.budget, plan.wanted, plan.draws) if plan.budget is not None else None,
    )


def tolerance(
    run_folder: Path,
    plan: StudyPlan,
    out: Path | None = None,
    say: Say = lambda _: None,
    **settings: Any,
) -> Path:
    """Study the tolerances of a run and write what was found into RUN/tolerance.

    A study that was stopped goes on where it was; one that asks for more plates takes the finished ones over.

    Args:
        run_folder: a finished run.
        plan: what is asked.
        out: the folder; RUN/tolerance by default.
        say: told what was found.
        settings: `process`, `limits`, `seed`, `masks`, `workers`, `scheduler` of `doedesign.tolerancing.study`.

    Returns:
        the folder.

    Raises:
        InputError: something that cannot be used; see `study`.
    """
    run = open_run(run_folder)
    folder = out or run.path("tolerance")
    asked = study(run, out=folder, **settings)
    plan.keys(asked)  # mistakes in the plan are told before anything is computed
    with asked.journal.open():
        found = _found(asked, plan)
        _forget_results(folder)
        results = _results(asked, plan, found)
        _write(folder, asked, plan, found, results)
    say(summary(asked, plan, found, results))
    return folder


def one_draw(run_folder: Path, key: str, as_json: bool, **settings: Any) -> str:
    """One plate of a study again: its errors as TOML that other commands read, and its numbers.

    Args:
        run_folder: a finished run.
        key: the plate, such as "normal/17".
        as_json: write JSON instead, SI units.
        settings: as those of `tolerance`; draws depend on the seed and the process alone.

    Raises:
        InputError: no such plate, or something that cannot be used.
    """
    asked = study(open_run(run_folder), quiet=True, **{**settings, "workers": 1})
    variation = asked.variation(key)
    asked.plates([key])
    kept = asked.journal.finished[key]
    rows = [] if isinstance(kept, OutOfModel) else kept
    if as_json:
        return json.dumps({"key": key, "variation": vars(variation), "rows": rows}, sort_keys=True)
    lines = [f"draw {key} of {asked.design.name}, seed {asked.seed}"]
    for row in rows:
        found = {name: math.inf if row[name] is None else row[name] for name in QUANTITIES if name in row}
        place = "infinity" if row["depth_m"] is None else format_length(row["depth_m"])
        numbers = ", ".join(f"{name} {value:.6g}" for name, value in found.items())
        lines.append(f"{row['colour']} at {place}: {numbers}")
    return variation_to_toml(variation, lines)


def _forget_results(folder: Path) -> None:
    """Remove what an earlier call found, so that its pictures do not stand beside those of another plan."""
    if (folder / MANIFEST_NAME).is_file():
        for name in read_json(folder / MANIFEST_NAME).get("results_sha256", ()):
            if Path(name).name == name:
                (folder / name).unlink(missing_ok=True)
        (folder / MANIFEST_NAME).unlink()


def _results(asked: Study, plan: StudyPlan, found: StudyFindings) -> dict[str, Any]:
    """Everything that was found, as JSON."""
    out: dict[str, Any] = {
        "format": FORMAT,
        "design": asked.design.name,
        "seed": asked.seed,
        "plan": plan._asdict(),
        "units": "SI; a depth of null is infinity; a colour of null is the worst colour and depth of each plate",
        "nominal": found.nominal.rows,
        "expected": found.expected.rows,
        "beyond": asked.beyond(plan.keys(asked)),
        "plates": _told(asked, found.plates),
    }
    if found.changes is not None:
        out["one_at_a_time"] = as_records(found.changes)
        out["shares"] = {name: source_shares(found.changes, name) for name in found.plates.table.values}
    if found.shares is not None:
        out["sobol"] = as_records(found.shares)
        out["shares"] = {
            name: {one.source: one.total.value for one in found.shares if (one.quantity, one.colour) == (name, None)}
            for name in found.plates.table.values
        }
    if found.corners is not None:
        out["corners"] = _told(asked, found.corners)
    if found.budget is not None:
        out["budget"] = found.budget.as_record()
    return _plain(out)


def _told(asked: Study, plates: Plates) -> dict[str, Any]:
    return {
        "count": len(plates.table.keys),
        "statistics": plates.statistics(),
        "worst": {"key": plates.worst, "rows": asked.plates([plates.worst]).rows},
        "yield": _yields(plates),
    }


def _yields(plates: Plates) -> dict[str, Any] | None:
    together = plates.yield_
    if together is None:
        return None
    each = [{"limit": limit_text(one), **yield_of(obeys(plates.table, one))._asdict()} for one in plates.limits]
    return {**together._asdict(), "limits": each}


def _plain(value: Any) -> Any:
    """The same for JSON: what is not finite becomes None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _write(folder: Path, asked: Study, plan: StudyPlan, found: StudyFindings, results: Mapping[str, Any]) -> None:
    keys = plan.keys(asked)
    write_atomic(folder / "draws.csv", _csv(_draw_lines(asked, keys)))
    write_atomic(folder / "errors.csv", _csv(_error_lines(asked, keys)))
    write_atomic(folder / "results.json", canonical_json(results))
    pictures = _draw(folder, asked, found)
    digests = {name: sha256_file(folder / name) for name in ("draws.csv", "errors.csv", "results.json", *pictures)}
    manifest = {"format": FORMAT, "run": asked.design.name, "results_sha256": digests}
    write_atomic(folder / MANIFEST_NAME, canonical_json(manifest))


def _draw(folder: Path, asked: Study, found: StudyFindings) -> list[str]:
    """Draw what was found; returns the names of the pictures."""
    design, plates = asked.design, found.plates
    save(plot_histograms(plates.table, found.nominal.table, design.camera, asked.limits), folder / "histograms.png")
    save(plot_yield(plates.table, asked.limits), folder / "yield.png")
    names = ["histograms.png", "yield.png"]
    if found.changes is not None:
        save(plot_changes(found.changes), folder / "one_at_a_time.png")
        names.append("one_at_a_time.png")
    if found.shares is not None:
        save(plot_shares(found.shares, design.camera), folder / "sobol.png")
        names.append("sobol.png")
    if found.budget is not None:
        save(plot_budget(found.budget), folder / "budget.png")
        names.append("budget.png")
    shown = {NOMINAL: "nominal_psf.png", plates.worst: "worst_psf.png"}
    # By a worker: it finds there what the others have compiled, and gives the same bytes whatever this process is like.
    model = DrawModel(predicted_bank, design, asked.process)
    for key, bank in evaluate_here(model, {key: asked.variation(key) for key in shown}, 1):
        save(plot_psfs(bank, design.camera, design.near_m, design.far_m), folder / shown[key])
        names.append(shown[key])
    return names


def _draw_lines(asked: Study, keys: Sequence[str]) -> Iterable[Sequence[object]]:
    """One line per plate, colour and depth, with every number that was found; empty where a row has no such number."""
    plates = asked.journal.finished
    rows = (row for key in keys if not isinstance(found := plates[key], OutOfModel) for row in found)
    numbers = sorted({name for row in rows for name in row} - {"colour", "depth_m"})
    yield ("key", "colour", "depth_m", *numbers)
    for key in keys:
        found = plates[key]
        for row in [] if isinstance(found, OutOfModel) else found:
            depth = "inf" if row["depth_m"] is None else row["depth_m"]
            values = ("inf" if row.get(name, "") is None else row.get(name, "") for name in numbers)
            yield (key, row["colour"], depth, *values)


def _error_lines(asked: Study, keys: Sequence[str]) -> Iterable[Sequence[object]]:
    """One line per plate with every error in SI units, and the number of rare events."""
    names = error_names(asked.process.masks, *DEVIATIONS)
    yield ("key", *names, "missed_etches", "doubled_etches", "particles", "pinholes", "roughness_seed")
    for key in keys:
        plate = asked.variation(key)
        events = (plate.repeats.count(-1), plate.repeats.count(1), len(plate.particles), len(plate.pinholes))
        yield (key, *(plate.value(name) for name in names), *events, plate.seed)


def _csv(lines: Iterable[Sequence[object]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue().encode()


def summary(asked: Study, plan: StudyPlan, found: StudyFindings, results: Mapping[str, Any]) -> str:
    """What was found, on one line."""
    quantity = "strehl"
    if asked.limits:
        words = [f"yield {found.plates.yield_} of {plan.draws} plates"]
        failing = zip(results["plates"]["yield"]["limits"], asked.limits, strict=True)
        quantity = min(failing, key=lambda pair: pair[0]["share"])[1].quantity
    else:
        words = [f"{plan.draws} plates; without limits there is no yield (add [[limit]] to the spec, or --limit)"]
    shares = results.get("shares", {}).get(quantity)
    if shares:
        source = max(shares, key=lambda name: shares[name])
        label = QUANTITIES[quantity].label
        words.append(f"most important: {source}, {100 * shares[source]:.0f} % of the variance of the {label}")
    if found.budget is not None:
        words.append(f"{found.budget}{_sigmas(found.budget)}")
    if results["beyond"]:
        key, reason = next(iter(results["beyond"].items()))
        words.append(f"{len(results['beyond'])} plates beyond the model count as bad, such as {key} ({reason})")
    return "; ".join(words)


def _sigmas(budget: Budget) -> str:
    """The standard deviations of a budget: ": sigma of overlay_x 0.31 um"."""
    if budget.verdict == "out of reach":
        return ""
    named: dict[str, set[float]] = {}
    for name, sigma in budget.sigmas.items():
        named.setdefault(name.partition("[")[0], set()).add(sigma)
    alike = {key: of.pop() for key, of in named.items() if len(of) == 1}
    return "".join(f", sigma of {short_name(key)} {_sigma_text(key, sigma)}" for key, sigma in alike.items())


def _sigma_text(key: str, sigma: float) -> str:
    rounded = float(f"{sigma:.3g}")
    match DEVIATIONS[key].unit:
        case "m":
            return format_length(rounded)
        case "rad":
            return f"{rounded:g} rad"
        case _:
            return f"{rounded:g}"
