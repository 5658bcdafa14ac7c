"""`doedesign simulate`: what a camera with the DOE of a run will see through dirt, drops or a fence."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from doedesign.capture.folder import PlateErrors, SimulationResult, simulate_files
from doedesign.commands.fabricated import errors_of_plate
from doedesign.runs.folder import open_run, spec_with
from doedesign.runs.level_maps import open_design

# What may be changed after the DOE was designed.
_FREE = ("scene", "sensor", "obstruction")


class Fabrication(NamedTuple):
    """Which plate as fabricated to look through; see `doedesign.commands.fabricated`.

    Attributes:
        process: TOML file with a [process] table; the run's own process if None.
        variation: TOML file with the errors of the plate.
        seed: take the errors from this seed of the process.
        draw: which draw of it.
    """

    process: Path | None = None
    variation: Path | None = None
    seed: int | None = None
    draw: str = "normal/0"


def simulate(
    run_folder: Path,
    out: Path | None = None,
    *,
    overrides: Sequence[str] = (),
    masks: Path | None = None,
    fabrication: Fabrication | None = None,
    **how: Any,
) -> SimulationResult:
    """Write simulated captures of a run into OUT, RUN/simulated by default.

    Args:
        run_folder: a finished run.
        out: folder.
        overrides: changes to [scene], [sensor] and [obstruction] of the run's spec.
        masks: the run's mask order; `masks/NAME` if there is one.
        fabrication: look through a plate with errors instead of the plate as drawn.
        how: see `doedesign.capture.folder.simulate_files`.

    Raises:
        InputError: a run, picture, mask or number that cannot be used, or no occlusion model.
    """
    run = open_run(run_folder)
    design = replace(open_design(run, masks), spec=spec_with(run, overrides, _FREE))
    plate = None
    if fabrication is not None:
        process = design.process(fabrication.process)
        errors = errors_of_plate(design, process, fabrication.variation, fabrication.seed, fabrication.draw)
        plate = PlateErrors(process, *errors)
    return simulate_files(design, out or run.path("simulated"), plate=plate, **how)
