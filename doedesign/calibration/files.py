"""Files of a calibration and of explanations; `doedesign.runs.results` adds the manifest.

calibration.json        everything that was found
process-estimate.toml   the estimate, which every command takes as a process
plate.toml              the errors of this DOE, which the prediction of a DOE with given errors reads
explanations.json/.txt  errors that would give a measured ring:disc ratio
"""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from doedesign.build import is_process_file, spec_from_process
from doedesign.calibration.geometry import QUANTITIES
from doedesign.calibration.plots import plot_check, plot_estimates, plot_explanations, plot_fitted_psfs
from doedesign.design.design import Design
from doedesign.spec import load_process, process_to_toml, variation_to_toml
from fab.figure import save
from fab.files import canonical_json
from fab.process import Process

if TYPE_CHECKING:
    from doedesign.calibration.estimate import Calibration
    from doedesign.calibration.explanations import ExplanationSet


def write_calibration(
    folder: Path, design: Design, result: "Calibration", process: Process | str | Path | None
) -> None:
    """Write a calibration; the spec of the process says how far the chrome reaches, which a process does not know."""
    digests = result.measurement.digests
    record = {"run": design.name, "measurement_sha256": digests, **_record(result)}
    (folder / "calibration.json").write_bytes(canonical_json(record))
    like = design.spec and design.spec.process
    if is_process_file(process):
        like = load_process(process, design.levels)
    # Where the estimate comes from and how far it may be relied on.
    comments = [
        "Estimated from measured PSFs by doedesign calibrate.",
        "Means of the errors below are the estimates for one plate, sigmas how well they are known.",
        f"{result.posterior.chi2_per_pixel:.4g} chi2 per pixel (noise alone gives 1)",
        *result.remarks,
        *(f"{name}: sha256 {digest}" for name, digest in digests.items()),
    ]
    estimate = process_to_toml(spec_from_process(result.process, like), comments)
    (folder / "process-estimate.toml").write_text(estimate, encoding="utf-8")
    doe = result.objective.unknowns.variation(result.posterior.values)
    (folder / "plate.toml").write_text(variation_to_toml(doe, comments), encoding="utf-8")
    save(plot_fitted_psfs(result), folder / "psfs.png")
    save(plot_estimates(result), folder / "errors.png")
    save(plot_check(result), folder / "check.png")


def _record(result: "Calibration") -> dict[str, Any]:
    """A calibration as plain values, SI units; errors come before the camera in correlations."""
    unknowns, posterior, at = result.objective.unknowns, result.posterior, result.fit.at
    images = []
    for i, found in enumerate(at.matches):
        target, motion = found.target, result.objective.motion(at.scores, i)
        row = {
            "name": target.name,
            "depth_m": None if math.isinf(target.image.depth_m) else target.image.depth_m,
            "chi2_per_pixel": found.chi2_per_pixel,
            "pixels": target.pixels,
            "rate_per_unit_energy": found.gain * target.scale,
            "background": found.background * target.scale,
            "shift_px": [float(motion[0]), float(motion[1])],
            "defocus_per_m": float(motion[2]),
        }
        if result.left_out:
            row["chi2_per_pixel_from_the_others"] = result.left_out[i]
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
        "camera": [
            {
                "name": name,
                "value": float(posterior.geometry[kind]),
                "sigma": float(posterior.geometry_sigma[kind]),
                "prior_mean": result.objective.model.geometry.mean[kind],
                "prior_sigma": result.objective.model.geometry.sigma[kind],
            }
            for kind, name in enumerate(QUANTITIES)
        ],
        "correlation": np.round(posterior.correlation, 6).tolist(),
        "chi2_per_pixel": posterior.chi2_per_pixel,
        "inflation": posterior.inflation,
        "explained": result.explained,
        "images": images,
        "readings": [reading._asdict() for reading in result.readings],
        "rises": result.rises,
        "models": result.models,
        "remarks": list(result.remarks),
    }


def write_explanations(folder: Path, design: str, found: "ExplanationSet") -> None:
    """Write explanations as JSON, text and a picture."""
    record = {
        **found._asdict(),
        "targets": found.targets._asdict(),
        "singles": [each._asdict() for each in found.singles],
        "pairs": [each._asdict() for each in found.pairs],
        "curves": {name: curve._asdict() for name, curve in found.curves.items()},
    }
    (folder / "explanations.json").write_bytes(canonical_json({"run": design, **record}))
    (folder / "explanations.txt").write_text(f"{found}\n", encoding="utf-8")
    save(plot_explanations(found), folder / "explanations.png")
