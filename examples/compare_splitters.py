"""Do spots stay equal on the wafer? Beam splitters designed as drawn and for plates as fabricated, side by side.

    python examples/compare_splitters.py [--draws 200] [--processes contact_aligner direct_write] [--out FOLDER]

One beam becomes nine in a row, by unit cells of 1024 um, and five by five, by unit cells of 384 um, 16 levels each: the
smaller a cell, the more it suffers from masks that lie apart. Three lasers of different colours become three by three
each on one plate of 32 levels; their worst colour counts. `spots.uniformity_as_fabricated` is the only difference
between two designs. Plates are then drawn from every process, the first of which is the one that the designs know, with
errors that no design has seen, and judged by the whole model of the process (`sim.surface`). Forty minutes for
400 plates each.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from doedesign.cli import exit_code
from doedesign.design.design import Design
from doedesign.optimization import optimize
from doedesign.spec import load_spec
from doedesign.spots.design import orders_of_design
from doedesign.templates import template_text
from fab.figure import panels, save
from fab.files import csv_table, write_atomic
from sim.optic import CellOptic, HeightOptic

SEED = 4711  # of the plates, which no design draws from
DESIGNS = ("as drawn", "as fabricated")
SMALL = ("doe.samples=768", "doe.aperture=1.536 mm")  # one period or more in the largest square of the aperture
LASERS = (
    'optics.wavelengths=["638 nm", "520 nm", "450 nm"]',
    "optics.design_wavelength=520 nm",
    'spots.colours=["638nm", "520nm", "450nm"]',
    "process.levels=32",
    "process.level_step=106 nm",
)


class Task(NamedTuple):
    """Spots along x and y, period, and what equal light is worth, as drawn and as fabricated; other changes."""

    spots: tuple[int, int]
    period: str
    uniformity: float
    as_fabricated: float
    changes: tuple[str, ...] = ()


SPLITTERS = {
    "1 x 9": Task((9, 1), "1024 um", 3.0, 6.0),
    "5 x 5": Task((5, 5), "384 um", 3.0, 1.0),
    "3 x 3, three lasers": Task((3, 3), "192 um", 3.0, 1.0, LASERS),
}


class Splitter(NamedTuple):
    """Plates of a design and a process; `p95` is what 95 % of them stay below.

    Of several colours, light is the mean and the uniformity error that of the worst.
    """

    splitter: str
    design: str
    process: str
    drawn_efficiency: float
    drawn_uniformity_error: float
    mean_efficiency: float
    mean_uniformity_error: float
    p95_uniformity_error: float


def design_of(splitter: str, name: str, process: str, folder: Path, more: Sequence[str] = ()) -> Design:
    """Design a splitter for the plate as drawn, or for plates of a stock process."""
    task = SPLITTERS[splitter]
    path = folder / "fan_out.toml"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, template_text("fan_out").encode())
    changes = [f"spots.count={list(task.spots)}", f"spots.period={task.period}", f"spots.uniformity={task.uniformity}"]
    if name == "as fabricated":
        changes.append(f"spots.uniformity_as_fabricated={task.as_fabricated}")
    return optimize(load_spec(path, [*SMALL, f"process.stock={process}", *task.changes, *changes, *more]))


def judged(design: Design, doe: CellOptic) -> tuple[float, float]:
    """Light on the spots, the mean of all colours, and the uniformity error of the worst colour."""
    tables = orders_of_design(design, doe)
    return float(np.mean([one.total for one in tables])), max(one.uniformity_error for one in tables)


def uniformity_errors(design: Design, process: str, draws: int) -> tuple[np.ndarray, np.ndarray]:
    """Efficiency and uniformity error of so many plates of a stock process."""
    plates = (design.fabricated(process, seed=SEED, draw=f"normal/{number}") for number in range(draws))
    light, unequal = zip(*(judged(design, plate) for plate in plates), strict=True)
    return np.array(light), np.array(unequal)


def in_words(one: Splitter) -> str:
    """A line of the table."""
    return (
        f"{one.splitter:19} {one.design:13} {one.process:16} drawn {one.drawn_efficiency:6.2%}, u "
        f"{one.drawn_uniformity_error:5.2%};  plates {one.mean_efficiency:6.2%}, u {one.mean_uniformity_error:6.2%} in "
        f"the mean, below {one.p95_uniformity_error:6.2%} in 95 %"
    )


def plot(errors: dict[tuple[str, str, str], np.ndarray]) -> object:
    """How unequal spots are on the plates, as the share of plates that stay below."""
    splitters, processes = (list(dict.fromkeys(keys)) for keys in list(zip(*errors, strict=True))[::2])
    words = "How unequal the spots of plates are that come back, by what their splitter was designed for"
    with panels(None, (5 * len(splitters), 4), words, f"{len(next(iter(errors.values())))} plates each") as figure:
        axes = np.atleast_1d(figure.subplots(1, len(splitters)))
        for axis, splitter in zip(axes, splitters, strict=True):
            for process, line in zip(processes, ("-", "--", ":"), strict=False):
                for number, name in enumerate(DESIGNS):
                    found = np.sort(errors[splitter, name, process])
                    share = (np.arange(len(found)) + 1) / len(found)
                    label = f"designed {name}, made by {process.replace('_', ' ')}"
                    axis.plot(100 * found, share, line, color=f"C{number}", label=label)
            axis.axhline(0.95, color="0.7", linewidth=0.8)
            axis.set(title=splitter, xlabel="uniformity error (%)", ylabel="share of plates below", ylim=(0, 1))
            axis.set_xlim(left=0)
            axis.grid(alpha=0.3)
        axes[0].legend(fontsize=8, loc="lower right")
    return figure


def run(draws: int, processes: Sequence[str], out: Path, more: Sequence[str] = ()) -> list[Splitter]:
    """Design, judge, and write the table and the picture."""
    found, errors = [], {}
    for splitter in SPLITTERS:
        for name in DESIGNS:
            design = design_of(splitter, name, processes[0], out, more)
            drawn, drawn_unequal = judged(design, HeightOptic.of(design.camera, design.nominal_height_m))
            for process in processes:
                light, unequal = uniformity_errors(design, process, draws)
                errors[splitter, name, process] = unequal
                numbers = (
                    drawn,
                    drawn_unequal,
                    light.mean(),
                    unequal.mean(),
                    np.percentile(unequal, 95),
                )
                found.append(Splitter(splitter, name, process, *map(float, numbers)))
                print(in_words(found[-1]), flush=True)
    write_atomic(out / "splitters.csv", csv_table(found, 5).encode())
    save(plot(errors), out / "splitters.png")  # pyright: ignore[reportArgumentType]
    print(f"written to {out}/splitters.csv and .png")
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--processes", nargs="+", default=["contact_aligner", "direct_write"])
    parser.add_argument("--out", type=Path, default=Path("compare-splitters"))
    given = parser.parse_args()
    sys.exit(exit_code(lambda: run(given.draws, given.processes, given.out) and None))
