"""Plates for `wide_aperture.toml`: classic ones at their best strength, and what the optimiser makes of each.

    python examples/wide_plates.py [--steps 1000] [--out runs/wide_plates]

A lens of 16 mm at f/1.4 is to be in focus from 2 m to infinity. A plate is judged as that spec judges it, by
`filtered_error`: what the best linear filter leaves of a picture's variance. One filter for all depths counts, by
the depth and colour it serves worst; beside it stand the mean, and what a filter for every depth would leave. Every
kind of plate is tried at several strengths (`TRIES`), in 16 levels; the best is the start of the optimiser. Rings
start from all but the cubic, which has none and is optimised cell by cell. Written to OUT:

    NAME/       the optimised run that starts from there
    plates.csv  a row per plate: as it stands, and optimised

Work that was stopped goes on with the same command; half an hour on one core. `examples/results/wide_plates.csv` is
its table.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import wide_cameras as cameras

from doedesign.cli import exit_code
from doedesign.design.design import Design
from doedesign.design.objectives import PsfSet, filtered_error
from doedesign.optimization import optimize
from doedesign.spec import Spec, load_spec
from fab.files import csv_table, write_atomic
from sim.psf_bank import psf

TRIES: Mapping[str, Sequence[Mapping[str, Any]]] = {
    "flat": [{}],
    "random": [{"feature": feature} for feature in ("100 um", "300 um", "1 mm")],
    "quartic": [{"waves": sign * waves} for waves in (7.4, 9.0, 12.0, 16.0, 20.0) for sign in (1, -1)],
    "logarithmic_asphere": [{"near": "2 m", "far": far} for far in ("5 m", "7 m", "10 m", "20 m", "40 m")],
    "cubic": [{"waves": waves} for waves in (8.0, 12.0, 16.0, 24.0)],
}
CELL_BY_CELL = ("cubic",)


class Plate(NamedTuple):
    """A plate and its errors, as shares of a picture's variance."""

    start: str
    options: str
    steps: int
    worst: float
    mean: float
    known: float


def spec_of(start: str, options: Mapping[str, Any], steps: int) -> Spec:
    """The spec with another start and number of steps."""
    words = [f"optimize.steps={steps}", f'optimize.start="{start}"', f"optimize.start_options={_toml(options)}"]
    words += ['optimize.parametrization="freeform"'] if start in CELL_BY_CELL else []
    return load_spec(cameras.SPEC, words + cameras.focus_words(start))


def _toml(options: Mapping[str, Any]) -> str:
    parts = (
        f'{name} = "{value}"' if isinstance(value, str) else f"{name} = {value}" for name, value in options.items()
    )
    return f"{{ {', '.join(parts)} }}"


def errors_of(design: Design) -> dict[str, float]:
    """Errors of a design as drawn: worst and mean by one filter for all depths, and the worst by one for each."""
    spec = load_spec(cameras.SPEC)
    camera = replace(design.camera, window=spec.sensor.window)
    far = psf(design.nominal_height_m, camera, cameras.depths_of(spec)).energy
    near = jnp.zeros((3, 0, camera.window, camera.window))
    view = PsfSet(near, jnp.asarray(far), jnp.zeros((3, 0)), jnp.zeros(0), camera)
    options: dict[str, Any] = dict(spec.objectives[0].options)
    at_worst = replace(view, worst=True)
    return {
        "worst": float(filtered_error(at_worst, **options)),
        "mean": float(filtered_error(view, **options)),
        "known": float(filtered_error(at_worst, known=True, **options)),
    }


def plate(start: str, options: Mapping[str, Any], steps: int = 0, folder: Path | None = None) -> Plate:
    """A plate from a start, optimised for so many steps; with a folder its run is kept there."""
    design = optimize(spec_of(start, options, steps), folder)
    words = " ".join(f"{name} {value}" for name, value in options.items())
    return Plate(start, words, steps, **errors_of(design))


def best_start(start: str) -> tuple[Plate, Mapping[str, Any]]:
    """The strength of a classic plate that leaves least, and its options."""
    return min(((plate(start, options), options) for options in TRIES[start]), key=lambda found: found[0].worst)


def run(out: Path, steps: int) -> list[Plate]:
    """Judge and optimise every kind of plate, and write the table after each."""
    rows: list[Plate] = []
    for start in TRIES:
        found, options = best_start(start)
        rows += [found, plate(start, options, steps, out / start)]
        write_atomic(out / "plates.csv", csv_table(rows, 4).encode())
    return rows


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=1000, help="steps of the optimiser")
    parser.add_argument("--out", type=Path, default=Path("runs/wide_plates"))
    given = parser.parse_args()

    def work() -> None:
        for row in run(given.out, given.steps):
            print(
                f"{row.start:20} {row.options:20} {row.steps:5} steps  {row.worst:.3f} {row.mean:.3f} {row.known:.3f}"
            )

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
