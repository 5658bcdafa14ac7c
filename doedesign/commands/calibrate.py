"""`doedesign calibrate`: the process errors behind measured PSFs, or what a single measured ratio can mean."""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from doedesign.build import process_spec_of, with_edge_moves
from doedesign.calibration import Calibration, Explanation, Family, Measurement, Targets, explanations, load_shots
from doedesign.calibration import calibrate as fitted
from doedesign.calibration.unknowns import unknowns_of
from doedesign.commands.psf import require_own
from doedesign.design.design import Design
from doedesign.report.calibration import plot_check, plot_estimates, plot_fitted_psfs
from doedesign.report.explanations import plot_explanations
from doedesign.report.labels import error_label, value_text
from doedesign.runs.folder import Run, alone_in, open_run
from doedesign.runs.level_maps import open_design
from doedesign.runtime.progress import meter
from doedesign.spec import ProcessSpec, load_process, process_to_toml, variation_to_toml
from fab.figure import save
from fab.files import MANIFEST_NAME, atomic_folder, canonical_json, sha256_file
from fab.process import Process

Say = Callable[[str], None]

ESTIMATE = "process-estimate.toml"


def calibrate(
    run_folder: Path,
    measurement: Path,
    errors: Sequence[str] = (),
    *,
    process: Path | None = None,
    masks: Path | None = None,
    evaluations: int = 60,
    polish: int = 0,
    seed: int = 0,
    out: Path | None = None,
    say: Say = lambda _: None,
) -> tuple[Path, Calibration]:
    """Fit process errors to measured PSFs and write what was found into RUN/calibration.

    Args:
        run_folder: a finished run.
        measurement: TOML file of the measurement.
        errors: which errors to look for; by default common depth and line width, and overlay.
        process: TOML file with a [process] table, for what is believed beforehand; the run's own by default.
        masks: the run's mask order; `masks/NAME` if there is one.
        evaluations: models that the global search may look at where it is needed.
        polish: exact gradients that the last stage may take.
        seed: seed of the global search.
        out: the folder; RUN/calibration by default.
        say: told what was found.

    Returns:
        the folder and the calibration.

    Raises:
        InputError: something that cannot be used.
    """
    run, folder, design, believed = _begun(run_folder, out, "calibration", masks, process)
    spec = _process_spec(run, process)
    unknowns = unknowns_of(believed, errors, design.camera.grid.pitch_m)  # mistakes are told before files are read
    measured = load_shots(measurement, design.camera, lambda name: say(f"reading {name}"))
    for name, pixels in measured.full.items():
        if pixels and measured.spec.channel is None:
            say(f"{name}: {pixels} pixels are full in every exposure and left out")
    with _written(run, folder) as fresh:
        # Usually seven rounds of slopes and a step.
        with _models("calibration", 7 * (len(unknowns.names) + 1)) as on_model:
            settings = {"evaluations": evaluations, "polish": polish, "seed": seed, "on_model": on_model}
            result = fitted(design, believed, measured, errors, **settings)
            # What was found is relative to the design; what the process does, to the masks.
            back = [-move for move in design.edge_moves_m]
            result = replace(result, process=with_edge_moves(result.process, back))
        _write(fresh, run, spec, measured, result)
    say(summary(result))
    return folder, result


def explain(
    run_folder: Path,
    targets: Targets,
    errors: Sequence[str] = (),
    *,
    process: Path | None = None,
    masks: Path | None = None,
    pairs: bool = True,
    reach: float = 4.0,
    out: Path | None = None,
    say: Say = lambda _: None,
) -> tuple[Path, Family]:
    """Find what would explain a measured ring:disc ratio and write it into RUN/explanations.

    Args:
        run_folder: a finished run.
        targets: what was measured.
        errors: errors to consider; by default every kind that a plate has in a definite way.
        process: TOML file with a [process] table; the run's own by default.
        masks: the run's mask order; `masks/NAME` if there is one.
        pairs: whether to look at two errors together.
        reach: standard deviations to look at.
        out: the folder; RUN/explanations by default.
        say: told what was found.

    Returns:
        the folder and the family.

    Raises:
        InputError: something that cannot be used.
    """
    run, folder, design, believed = _begun(run_folder, out, "explanations", masks, process)
    with _written(run, folder) as fresh:
        # About ten plates for every error and six for a pair.
        with _models("explanations", 200) as on_model:
            family = explanations(design, believed, targets, errors, pairs=pairs, reach=reach, on_model=on_model)
        text = family_text(family)
        (fresh / "explanations.json").write_bytes(canonical_json({"run": run.spec.name, **_family_record(family)}))
        (fresh / "explanations.txt").write_text(text + "\n", encoding="utf-8")
        save(plot_explanations(family), fresh / "explanations.png")
    say(text)
    return folder, family


def _begun(
    run_folder: Path, out: Path | None, name: str, masks: Path | None, process: Path | None
) -> tuple[Run, Path, Design, Process]:
    """A run, the folder for what is found, what its masks draw, and the process as the design sees it through them."""
    run = open_run(run_folder)
    folder = out or run.path(name)
    require_own(folder)
    design = open_design(run, masks)
    return run, folder, design, design.process(process)


def _process_spec(run: Run, process: Path | None) -> ProcessSpec:
    return run.spec.process if process is None else load_process(process)


@contextlib.contextmanager
def _models(title: str, likely: int) -> Iterator[Callable[[str], None]]:
    """A meter for plates, of which nobody knows beforehand how many it will be."""
    done = count(1)
    with meter(title, likely) as progress:
        yield lambda words: progress.advance(min(next(done), likely - 1), words)


@contextlib.contextmanager
def _written(run: Run, folder: Path) -> Iterator[Path]:
    """A folder that appears whole, with a manifest; nobody else may write into the run meanwhile."""
    inside = folder.resolve().is_relative_to(run.folder.resolve())
    with alone_in(run.folder) if inside else contextlib.nullcontext(), atomic_folder(folder) as fresh:
        yield fresh
        digests = {path.name: sha256_file(path) for path in sorted(fresh.iterdir())}
        manifest = {"format": f"doedesign {folder.name} 1", "run": run.spec.name, "results_sha256": digests}
        (fresh / MANIFEST_NAME).write_bytes(canonical_json(manifest))


def _write(folder: Path, run: Run, spec: ProcessSpec, measured: Measurement, result: Calibration) -> None:
    record = {"run": run.spec.name, "measurement_sha256": measured.digests, **calibration_record(result)}
    (folder / "calibration.json").write_bytes(canonical_json(record))
    comments = estimate_comments(result, measured)
    (folder / ESTIMATE).write_text(process_to_toml(process_spec_of(result.process, spec), comments), encoding="utf-8")
    plate = result.objective.unknowns.variation(result.posterior.values)
    (folder / "plate.toml").write_text(variation_to_toml(plate, comments), encoding="utf-8")
    save(plot_fitted_psfs(result), folder / "psfs.png")
    save(plot_estimates(result), folder / "errors.png")
    save(plot_check(result), folder / "check.png")


def estimate_comments(result: Calibration, measured: Measurement) -> list[str]:
    """What stands at the head of the estimate: where it comes from and how far it may be believed."""
    return [
        "Estimated from measured PSFs by doedesign calibrate.",
        "Means of the errors below are the estimates for one plate, sigmas how well they are known.",
        f"{result.posterior.chi2_per_pixel:.4g} chi2 per pixel (noise alone gives 1)",
        *result.remarks,
        *(f"{name}: sha256 {digest}" for name, digest in measured.digests.items()),
    ]


def calibration_record(result: Calibration) -> dict[str, Any]:
    """A calibration as plain values, SI units."""
    unknowns, posterior, at = result.objective.unknowns, result.posterior, result.fit.at
    others = {one.name: one for one in result.left_out}
    images = []
    for i, target in enumerate(result.objective.targets):
        motion, found = result.objective.motion(at.scores, i), at.matches[i]
        row = {
            "name": target.name,
            "depth_m": None if math.isinf(target.depth_m) else target.depth_m,
            "chi2_per_pixel": found.chi2 / max(int(target.psf.valid.sum()), 1),
            "pixels": int(target.psf.valid.sum()),
            "rate_per_unit_energy": found.gain * target.scale,
            "background": found.background * target.scale,
            "shift_px": [float(motion[0]), float(motion[1])],
            "defocus_per_m": float(motion[2]),
        }
        if target.name in others:
            row["chi2_per_pixel_from_the_others"] = others[target.name].predicted
        images.append(row)
    return {
        "errors": [
            {
                "name": name,
                "value": float(posterior.values[i]),
                "sigma": float(posterior.sigma[i]),
                "prior_mean": float(unknowns.mean[i]),
                "prior_sigma": float(unknowns.sigma[i]),
                "assumed": name in unknowns.assumed,
                "determined": result.determined[name],
            }
            for i, name in enumerate(unknowns.names)
        ],
        "correlation": np.round(posterior.correlation, 6).tolist(),
        "chi2_per_pixel": posterior.chi2_per_pixel,
        "inflation": posterior.inflation,
        "explained": result.explained,
        "images": images,
        "readings": [
            {
                "image": r.image,
                "quantity": r.quantity,
                "measured": list(r.measured) if r.measured else None,
                "predicted": list(r.predicted),
            }
            for r in result.readings
        ],
        "rises": result.rises,
        "models": result.fit.models,
        "remarks": result.remarks,
    }


def summary(result: Calibration) -> str:
    """What was found, for a person."""
    unknowns, posterior = result.objective.unknowns, result.posterior
    wide = max(len(error_label(name)) for name in unknowns.names)
    lines = [f"{posterior.chi2_per_pixel:.4g} chi2 per pixel after {result.fit.models} plates"]
    for i, name in enumerate(unknowns.names):
        note = "" if result.determined[name] else "  (not determined)"
        text = value_text(name, posterior.values[i], posterior.sigma[i])
        lines.append(f"{error_label(name):<{wide}}  {text}{note}")
    order = next(r for r in result.readings if r.quantity == "zeroth_order").predicted
    lines.append(f"zeroth order {100 * order[0]:.3g} ± {100 * order[1]:.2g} %")
    return "\n".join([*lines, *result.remarks])


def _family_record(family: Family) -> dict[str, Any]:
    record = family._asdict()
    record["targets"] = family.targets._asdict()
    record["singles"] = [each._asdict() for each in family.singles]
    record["pairs"] = [each._asdict() for each in family.pairs]
    record["none"] = [list(names) for names in family.none]
    record["curves"] = {name: {k: list(v) for k, v in c._asdict().items()} for name, c in family.curves.items()}
    return record


def family_text(family: Family) -> str:
    """The explanations as a table."""
    targets, nominal = family.targets, family.nominal
    throughput = "" if targets.throughput is None else f", throughput {100 * targets.throughput:.3g} %"
    lines = [
        f"measured: ring:disc {targets.ring_to_disc:.3g}{throughput}",
        f"model at the process's means: ring:disc {nominal['ring_to_disc']:.3g}, "
        f"throughput {100 * nominal['throughput']:.3g} %, zeroth order {100 * nominal['zeroth_order']:.2g} %",
        "",
        "sigmas  throughput  0th order  what would give the measured ratio"
        + ("" if targets.throughput is None else " (*: and the throughput, to two sigmas)"),
    ]
    for title, rows in (("one error", family.singles), ("two errors", family.pairs)):
        if rows:
            lines.append(f"{title}:")
            lines += [_explanation_text(each) for each in rows]
    alone = [names[0] for names in family.none if len(names) == 1]
    if alone:
        lines.append(f"none within {family.reach:g} sigmas, where the ratio stays within:")
        lines += [f"  {_reached(family, name)}  {error_label(name)}" for name in alone]
    if family.assumed:
        lines.append(f"sigmas that the process does not give were assumed: {', '.join(family.assumed)}")
    lines.append(
        "Throughput is the light in the sensor window per light on the clear aperture, Fresnel loss included; "
        "a published one may be another."
    )
    return "\n".join(lines)


def _reached(family: Family, name: str) -> str:
    ratios = family.curves[name].ring_to_disc
    return f"{min(ratios):5.3g} to {max(ratios):5.3g}"


def _explanation_text(each: Explanation) -> str:
    values = ", ".join(f"{error_label(name)} {value_text(name, value)}" for name, value in each.values.items())
    mark = {None: " ", True: "*", False: " "}[each.fits]
    # An asterisk: the throughput fits, too.
    return f"{each.distance:6.2f}  {100 * each.throughput:8.1f} %{mark} {100 * each.zeroth_order:8.2f} %  {values}"
