"""Tolerances and calibration: tolerance, calibrate."""

import json
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from doedesign.cli.closing import say_closing
from doedesign.cli.console import print_results, print_text
from doedesign.cli.options import AsJson, Flag, Texts, length_of, refuse_options
from fab.errors import InputError


def tolerance(
    run: Path,
    *,
    draws: int = 100,
    seed: int = 0,
    sensitivity: Literal["one_at_a_time", "sobol", "none"] = "one_at_a_time",
    sobol: int | None = None,
    corners: Flag = False,
    budget: str | None = None,
    yield_: Annotated[float | None, Parameter(name="--yield")] = None,
    limit: Texts = (),
    process: str | None = None,
    masks: Path | None = None,
    draw: str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    out: Path | None = None,
    json_: AsJson = False,
) -> None:
    """Study what the errors of a process make of a run: yield, which errors matter, and how large they may be.

    Args:
        run: Run folder.
        draws: Plates of the Monte-Carlo study, and per point of the budget.
        seed: Seed of every draw.
        sensitivity: Which errors matter, each alone or as shares of variance.
        sobol: Rows of the samples behind Sobol indices, a power of two, 64 by default; each costs sources + 2 plates.
        corners: Look at worst-case corners, too.
        budget: Errors for which the largest sigma is sought, such as overlay, overlay_x or overlay_x[3].
        yield_: Yield that the budget is for; 0.9 by default.
        limit: What a good plate obeys, such as "zeroth_order <= 5 %"; the spec's limits by default.
        process: TOML file with a [process] table, or the name of a stock process; the run's own by default.
        masks: Its mask order; masks/NAME by default.
        draw: Repeat a single plate, such as normal/17, and print its errors as TOML and its numbers.
        workers: Worker processes; as many as there are cores and memory for by default.
        scheduler: Address of a Dask scheduler whose workers are taken instead.
        out: Folder; RUN/tolerance by default. The same command resumes a stopped study.
    """
    alone = draw is not None
    for option, given, needs, there in (
        ("--sobol", sobol is not None, "be given with --sensitivity sobol", sensitivity == "sobol" and not alone),
        ("--yield", yield_ is not None, "be given with --budget", budget is not None and not alone),
        ("--budget", budget is not None, "be left out with --draw", not alone),
        ("--corners", corners, "be left out with --draw", not alone),
    ):
        if given and not there:
            raise InputError(option, f"must {needs}", "a value", "Leave it out, or change the other.")
    settings: dict[str, Any] = {"process": process, "limits": limit or None, "seed": seed, "masks": masks}
    if draw is not None:
        idle: dict[str, object] = {"draws": draws, "sensitivity": sensitivity, "limit": limit, "workers": workers}
        cure = "Leave it out: a single plate takes --seed, --process, --masks and --scheduler."
        refuse_options(tolerance, idle | {"out": out}, "must be left out with --draw", cure)
        print_text(_one_draw(run, draw, json_, **settings, scheduler=scheduler).rstrip())
        return
    from doedesign.runs.costs import measured
    from doedesign.tolerancing.results import tolerance as study

    folder = out or run / "tolerance"
    settings |= {"draws": draws, "sensitivity": sensitivity, "corners": corners, "budget": budget}
    settings |= {name: value for name, value in (("sobol", sobol), ("wanted", yield_)) if value is not None}
    with measured(run, "tolerance", writes=folder) as taken:
        study(run, **settings, out=folder, workers=workers, scheduler=scheduler)
    print_results(folder, json_, results=str(folder / "results.json"))
    say_closing(folder, run, taken)


def _one_draw(run: Path, key: str, as_json: bool, **settings: Any) -> str:
    """One draw of a study: its errors as TOML that other commands read and its metrics in words, or both as JSON."""
    from doedesign.spec import variation_to_toml
    from doedesign.tolerancing.analysis import QUANTITIES
    from doedesign.tolerancing.pool import OutOfModel
    from doedesign.tolerancing.studies import study
    from fab.units import format_length

    asked = study(run, quiet=True, workers=1, **settings)
    variation = asked.variation(key)
    asked.sample([key])
    kept = asked.journal.finished[key]
    rows = [] if isinstance(kept, OutOfModel) else kept
    if as_json:
        return json.dumps({"key": key, "variation": vars(variation), "rows": rows}, sort_keys=True)
    lines = [f"draw {key} of {asked.design.name}, seed {asked.seed}"]
    for row in rows:
        found = {name: inf if row[name] is None else row[name] for name in QUANTITIES if name in row}
        place = "infinity" if row["depth_m"] is None else format_length(row["depth_m"])
        numbers = ", ".join(f"{name} {value:.6g}" for name, value in found.items())
        lines.append(f"{row['colour']} at {place}: {numbers}")
    return variation_to_toml(variation, lines)


def calibrate(
    run: Path,
    measurement: Path | None = None,
    *,
    errors: Texts = (),
    process: str | None = None,
    masks: Path | None = None,
    evaluations: int = 60,
    polish: int = 0,
    seed: int = 0,
    ring_to_disc: float | None = None,
    throughput: float | None = None,
    throughput_sigma: float = 0.02,
    probe: str | None = None,
    depth: str | None = None,
    pairs: bool = True,
    reach: float = 4.0,
    out: Path | None = None,
    json_: AsJson = False,
) -> None:
    """Find the process errors that explain measured PSFs, or list those that would explain a measured ring:disc ratio.

    With MEASUREMENT, the errors of the plate with their uncertainty go into process-estimate.toml. With --ring-to-disc
    instead, every error and pair of errors is found that would give this ratio.

    Args:
        run: Run folder.
        measurement: TOML file that names the images and says how they were taken.
        errors: Errors to look for, such as depth, overlay_x or cd_bias[3]; by default depth, line width and overlay.
        process: TOML file with a [process] table, or the name of a stock process, whose errors are the prior; the run's
            own by default.
        masks: The run's mask order; masks/NAME by default.
        evaluations: Plates of the global search, which begins only if it is needed.
        polish: Steps along the exact gradient at the end.
        seed: Seed of the global search.
        ring_to_disc: Measured ratio of the energy outside the geometric defocus disc to that inside.
        throughput: Measured share of the light that arrives in the sensor window, 0-1.
        throughput_sigma: Its standard deviation.
        probe: Wavelength at which the ratio was measured, such as "520 nm".
        depth: Depth at which it was measured, such as "10 cm".
        pairs: Look at two errors together, too.
        reach: Standard deviations to look at.
        out: Folder; RUN/calibration or RUN/explanations by default.
    """
    if (measurement is None) == (ring_to_disc is None):
        got = "neither" if measurement is None else "both"
        cure = "Give the measurement's TOML file, or --ring-to-disc with --probe and --depth."
        raise InputError("calibrate", "must be given a measurement or a ring:disc ratio", got, cure)
    from doedesign.runs.costs import measured

    if measurement is not None:
        of_ratio: dict[str, object] = {"throughput": throughput, "throughput_sigma": throughput_sigma, "probe": probe}
        of_ratio |= {"depth": depth, "pairs": pairs, "reach": reach}
        cure = "Leave it out: a measurement takes --errors, --process, --masks, --evaluations, --polish and --seed."
        refuse_options(calibrate, of_ratio, "goes with --ring-to-disc and not with a measurement", cure)
        from doedesign.calibration.estimate import calibrate as fit

        folder = out or run / "calibration"
        settings = {"process": process, "masks": masks, "evaluations": evaluations, "polish": polish, "seed": seed}
        with measured(run, "calibrate", writes=folder) as taken:
            result = fit(run, measurement, errors, **settings, out=folder)
        estimate = str(folder / "process-estimate.toml")
        print_results(folder, json_, estimate=estimate, explained=result.explained)
        say_closing(folder, run, taken)
        return
    of_search: dict[str, object] = {"evaluations": evaluations, "polish": polish, "seed": seed}
    cure = (
        "Leave it out: a ratio takes --errors, --process, --masks, --probe, --depth, --throughput, --pairs and --reach."
    )
    refuse_options(calibrate, of_search, "goes with a measurement and not with --ring-to-disc", cure)
    if throughput is None:
        idle: dict[str, object] = {"throughput_sigma": throughput_sigma}
        refuse_options(calibrate, idle, "must be given with --throughput", "Add it, or leave this out.")
    from doedesign.calibration.explanations import Targets, explain_ratio

    lengths = {}
    for option, text, example in (("--probe", probe, "520 nm"), ("--depth", depth, "10 cm")):
        cure = f'For example {option} "{example}".'
        if text is None:
            raise InputError(option, "must be given with --ring-to-disc", "nothing", cure)
        lengths[option] = length_of(option, text)
        if not lengths[option] > 0:
            raise InputError(option, "must be positive", text, cure)
    targets = Targets(lengths["--probe"], lengths["--depth"], ring_to_disc or 0.0, throughput, throughput_sigma)
    folder = out or run / "explanations"
    with measured(run, "calibrate", writes=folder) as taken:
        explain_ratio(run, targets, errors, process=process, masks=masks, pairs=pairs, reach=reach, out=folder)
    print_results(folder, json_)
    say_closing(folder, run, taken)
