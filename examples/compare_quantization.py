"""Which way of rounding to levels serves a design best? All of them on the same budget, for 2, 4, 8 and 16 levels.

    python examples/compare_quantization.py [SPEC] [--steps 120] [--levels 2 4 8 16] [--out FOLDER]

Every design is judged by PSFs that integrate every pixel, at all depths and colours, not by what its optimiser looked
at. A move of the descent on levels sees every depth twice; designs that end with one have as many fewer steps before.
Five minutes on two cores for examples/quick.toml.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from doedesign.cli import exit_code
from doedesign.design.descent import looks_of
from doedesign.design.design import Design
from doedesign.design.metrics import all_of, design_metrics
from doedesign.design.problem import losses, problem_of
from doedesign.optimization import optimize
from doedesign.spec import Spec, load_spec
from fab.figure import save
from fab.files import csv_table, write_atomic
from sim.aperture import open_cells
from sim.optic import HeightOptic
from sim.psf_bank import psf

HERE = Path(__file__).parent
WAVE_NM = 1200  # height of all levels together
POLISH = 10  # moves of the descent
_LEAST = 1e-4  # that is drawn on a logarithmic axis
STRATEGIES = {
    "continuous": ("none", 0),
    "at the end": ("at_end", 0),
    "at the end, descent": ("at_end", POLISH),
    "straight-through": ("straight_through", 0),
    "straight-through, descent": ("straight_through", POLISH),
    "annealed": ("annealed", 0),
    "Gumbel-softmax": ("gumbel", 0),
    "stochastic": ("stochastic", 0),
}


class Outcome(NamedTuple):
    """What a strategy reached; `edges_mm` is the length of all walls of all masks."""

    levels: int
    strategy: str
    loss: float
    far_spot: float
    concentration: float
    zeroth_order: float
    edges_mm: float
    seconds: float


def edge_length_m(design: Design) -> float:
    """Length of the edges of all masks within the aperture."""
    pitch_m = design.camera.grid.pitch_m
    level = np.where(open_cells(design.camera.grid, design.camera.opening), design.level_map.level, 0)
    planes = [level >> bit & 1 for bit in range(design.levels.bits)]
    walls = sum(np.sum(plane[1:] != plane[:-1]) + np.sum(plane[:, 1:] != plane[:, :-1]) for plane in planes)
    return float(walls) * pitch_m


def judged(spec: Spec, levels: int, strategy: str, design: Design, seconds: float) -> Outcome:
    """Numbers of a design, from exact PSFs."""
    problem, _ = problem_of(spec, {})
    near_m, far_m = spec.scene.near_m, spec.scene.far_m
    optic = HeightOptic.of(design.camera, design.nominal_height_m)
    bank, lens = (psf(each, depths=(*near_m, *far_m)) for each in (optic, HeightOptic.of(design.camera)))
    view = all_of(bank, lens, len(near_m))
    rows = design_metrics(optic, bank, near_m, lens)

    def mean(name: str) -> float:
        return float(np.mean([row[name] for row in rows if name in row]))

    numbers = float(losses(problem.terms, view)[0]), mean("far_spot"), mean("concentration"), mean("zeroth_order")
    return Outcome(levels, strategy, *numbers, edge_length_m(design) * 1e3, seconds)


def compare(spec: Path, levels: Sequence[int], steps: int) -> list[Outcome]:
    """Design with every strategy for every number of levels."""
    outcomes = []
    for count in levels:
        for name, (quantisation, polish) in STRATEGIES.items():
            sets = [f"process.levels={count}", f"process.level_step={WAVE_NM / count} nm"]
            sets += [f"optimize.quantisation={quantisation}", f"optimize.polish={polish}", "optimize.colours=together"]
            read = load_spec(spec, [*sets, "optimize.steps=1"])
            cost = polish * len(looks_of(problem_of(read, {})[1], 0)) if polish else 0
            read = load_spec(spec, [*sets, f"optimize.steps={max(steps - cost, 1)}"])
            start = time.perf_counter()
            design = optimize(read)
            outcomes.append(judged(read, count, name, design, time.perf_counter() - start))
            print(in_words(outcomes[-1]), flush=True)
    return outcomes


def in_words(one: Outcome) -> str:
    """A line of the table."""
    return (
        f"{one.levels:3} levels  {one.strategy:26} loss {one.loss:.4f}  spot {one.far_spot:6.1%}  "
        f"concentration {one.concentration:.4f}  0th order {one.zeroth_order:6.1%}  "
        f"edges {one.edges_mm:6.0f} mm  {one.seconds:4.0f} s"
    )


def plot(outcomes: Sequence[Outcome]) -> object:
    """Loss beyond that of continuous heights, and length of edges, of every strategy against the number of levels."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.5), layout="constrained")
    axes = figure.subplots(1, 2)
    best = {one.levels: one.loss for one in outcomes if one.strategy == "continuous"}
    for name in STRATEGIES:
        of = [one for one in outcomes if one.strategy == name != "continuous"]
        if of:
            beyond = [max(one.loss - best[one.levels], _LEAST) for one in of]
            axes[0].plot([one.levels for one in of], beyond, marker="o", label=name)
            axes[1].plot([one.levels for one in of], [one.edges_mm for one in of], marker="o", label=name)
    axes[0].set_yscale("log")
    counts = sorted({one.levels for one in outcomes})
    for axis, label in zip(axes, ("loss beyond that of continuous heights", "edges of all masks (mm)"), strict=True):
        axis.set_xscale("log", base=2)
        axis.set_xticks(counts, [str(count) for count in counts])
        axis.set_xlabel("levels")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    return figure


def run(spec: Path, levels: Sequence[int], steps: int, out: Path) -> None:
    """Compare, and write the table and the picture."""
    outcomes = compare(spec, levels, steps)
    out.mkdir(parents=True, exist_ok=True)
    write_atomic(out / "quantization.csv", csv_table(outcomes, 6).encode())
    save(plot(outcomes), out / "quantization.png")  # pyright: ignore[reportArgumentType]
    print(f"written to {out}/quantization.csv and .png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("spec", nargs="?", type=Path, default=HERE / "quick.toml")
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--levels", type=int, nargs="+", default=[2, 4, 8, 16])
    parser.add_argument("--out", type=Path, default=Path("compare-quantization"))
    given = parser.parse_args()
    sys.exit(exit_code(lambda: run(given.spec, given.levels, given.steps, given.out)))
