"""What does a robust design gain on the wafer? Designs with and without [robust], under errors that no step saw.

    python examples/compare_robust.py [SPEC] [--steps 120] [--draws 32] [--processes contact_aligner direct_write]

Every design is drawn by the same spec: as it is; with masks that obey `min_feature`; the same with walls that cost;
with robust steps beside; with walls that cost and a ring:disc ratio asked for; and with a ratio and pixels of two by
two cells. Then plates are drawn from every process, the first of which is the one the robust steps know, and judged by
PSFs that integrate every pixel: the spec's own loss, the 0th order, and the ring:disc ratio of the worst colour and
depth, with the value that 90 % of plates reach.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from doedesign.cli import exit_code
from doedesign.design.design import Design
from doedesign.design.metrics import all_of
from doedesign.design.objectives import Term
from doedesign.design.problem import losses, problem_of
from doedesign.optimization import optimize
from doedesign.prediction import predict
from doedesign.spec import load_spec
from fab.files import csv_table, write_atomic
from fab.process import Process, Variation
from sim.optic import HeightOptic
from sim.psf_bank import psf

HERE = Path(__file__).parent
SEED = 4711  # of the plates, which no step draws from
_WALLS = ("optimize.min_feature=2 um", "optimize.wall_weight=0.3")
DESIGNS = {
    "nominal": (),
    "min_feature": ("optimize.min_feature=2 um",),
    "walls that cost": _WALLS,
    "robust": (*_WALLS, "robust.walls=0.0", "robust.steps=120"),
    "ring:disc": _WALLS,
    "coarse ring:disc": ("optimize.drawn_pixel=3.7 um",),
}
# Weights of an objective that is added to those of some, which take half as many steps more. No plate reaches this
# ratio: its slope is what counts.
RINGS = {"ring:disc": 0.3, "coarse ring:disc": 0.2}
RING = '{{ name = "ring_to_disc", weight = {}, options = {{ least = 2.5 }} }}'


class Plates(NamedTuple):
    """Some plates of a design and a process, and the design as drawn.

    0th order and ring:disc ratio are those of the worst colour and depth of a plate, far spots the mean over all.
    """

    design: str
    process: str
    drawn_loss: float
    mean_loss: float
    worst_loss: float
    drawn_zeroth_order: float
    median_zeroth_order: float
    drawn_ring_to_disc: float
    ring_to_disc_of_90_percent: float
    drawn_far_spot: float
    median_far_spot: float


def judge(design: Design, process: Process, terms: tuple[Term, ...]) -> Any:
    """A function of errors: loss by some terms, 0th order, least ring:disc ratio and mean far spot of a plate."""
    near = len(design.near_m)
    lens = psf(HeightOptic.of(design.camera), depths=design.depths_m)

    def look(errors: Variation) -> tuple[float, float, float, float]:
        found = predict(design, process, errors)
        loss = float(losses(terms, all_of(found.bank.with_camera(design.camera), lens, near))[0])
        leaked = max(row["zeroth_order"] for row in found.rows)
        ratio = min(row["ring_to_disc"] for row in found.rows if "ring_to_disc" in row)
        spot = float(np.mean([row["far_spot"] for row in found.rows if "far_spot" in row]))
        return loss, leaked, ratio, spot

    return look


def plates_of(name: str, design: Design, stock: str, draws: int, terms: tuple[Term, ...]) -> Plates:
    """Judge plates of a stock process."""
    process = design.process(stock)
    look = judge(design, process, terms)
    drawn = look(Variation())
    every = [look(design.plate_errors(process, seed=SEED, draw=f"normal/{i}")[0]) for i in range(draws)]
    loss, leaked, ratio, spot = np.array(every).T
    return Plates(
        name,
        stock,
        drawn[0],
        float(loss.mean()),
        float(loss.max()),
        drawn[1],
        float(np.median(leaked)),
        drawn[2],
        float(np.percentile(ratio, 10)),
        drawn[3],
        float(np.median(spot)),
    )


def in_words(one: Plates) -> str:
    """A line of the table."""
    return (
        f"{one.design:16} {one.process:16} loss {one.drawn_loss:.3f}, plates {one.mean_loss:.3f}, worst "
        f"{one.worst_loss:.3f};  0th order {one.drawn_zeroth_order:6.1%} -> {one.median_zeroth_order:6.1%};  ring:disc "
        f"{one.drawn_ring_to_disc:.2f} -> {one.ring_to_disc_of_90_percent:.2f};  far spot {one.drawn_far_spot:5.1%} -> "
        f"{one.median_far_spot:5.1%}"
    )


def run(spec: Path, steps: int, draws: int, processes: Sequence[str], out: Path) -> list[Plates]:
    """Design, judge, and write the table."""
    plain, found = load_spec(spec), []
    terms = problem_of(plain, {})[0].terms  # every design is judged by these
    for name, sets in DESIGNS.items():
        known = [f"process.stock={processes[0]}", f"optimize.steps={steps}"]
        if name in RINGS:
            asked = RING.format(RINGS[name])
            known += [f"optimize.steps={steps * 3 // 2}", f"objective[{len(plain.objectives)}]={asked}"]
        design = optimize(load_spec(spec, [*known, *sets]))
        for stock in processes:
            found.append(plates_of(name, design, stock, draws, terms))
            print(in_words(found[-1]), flush=True)
    write_atomic(out, csv_table(found, 6).encode())
    print(f"written to {out}")
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("spec", nargs="?", type=Path, default=HERE / "quick.toml")
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--draws", type=int, default=32)
    parser.add_argument("--processes", nargs="+", default=["contact_aligner", "direct_write"])
    parser.add_argument("--out", type=Path, default=Path("compare-robust.csv"))
    given = parser.parse_args()
    sys.exit(exit_code(lambda: run(given.spec, given.steps, given.draws, given.processes, given.out) and None))
