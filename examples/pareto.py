"""How good is a plate to see through? Sharp spot, near concentration and light in the window, beside classic plates.

    python examples/pareto.py [SPEC] [--spots 0.25 0.4 0.6] [--evaluations 40] [--out FOLDER]

For every spot energy asked for, the spec's free form is designed and put beside what formulas give: a flat plate, a
random one, the Fresnel lens of the least loss, the ring that the free form starts from, and the best circular grating,
whose height, duty and period NLopt searches for the same loss. The best grating keeps its height to the nanometre,
which no etch would; all others have the levels of the spec. A second free form may lose light as gratings do: beyond
the window it costs a quarter. Everything is judged by PSFs that integrate every pixel, at all depths and colours. Half
an hour on two cores for examples/automotive.toml, two minutes for examples/quick.toml; plates that the table of FOLDER
already has are not made again.
"""

import argparse
import csv
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from doedesign.build import camera_from_spec
from doedesign.cli import exit_code
from doedesign.design.design import Design
from doedesign.design.metrics import all_of
from doedesign.design.objectives import terms_from_spec
from doedesign.design.problem import judge_height, problem_of
from doedesign.design.starts import Ridge, StartSetup, grating, ring_period_m
from doedesign.optimization import optimize
from doedesign.runs.journal import study_folder
from doedesign.search import least
from doedesign.spec import Spec, load_spec, spec_digest
from fab.errors import InputError
from fab.figure import FAINT, INK, SERIES, panels, save
from fab.files import csv_table, write_atomic
from fab.units import NM, UM
from sim.metrics import metric_rows
from sim.optic import HeightOptic
from sim.psf_bank import PsfBank, psf

HERE = Path(__file__).parent
FREE_FORM, LOSING, GRATING, RING = "free form", "free form, losing light", "best grating", "ring"
TABLE, WORDS = "pareto.csv", ("kind", "made_with")
SAME = ("random", "flat")  # whatever is asked for
KINDS = {  # marks of the picture
    FREE_FORM: ("o", SERIES[0]),
    LOSING: ("v", SERIES[5]),
    GRATING: ("s", SERIES[1]),
    RING: ("D", SERIES[2]),
    "Fresnel lens": ("^", SERIES[3]),
    "random": ("x", SERIES[4]),
    "flat": ("+", INK),
}


class Plate(NamedTuple):
    """A plate and its numbers, means over colours and depths unless said otherwise; `asked` is the spot asked for."""

    kind: str
    asked: float
    loss: float
    far_spot: float
    least_spot: float
    most_spot: float
    concentration: float
    over_bound: float
    window_share: float
    seconds: float
    made_with: str


def asking(path: Path, spot: float, *sets: str) -> Spec:
    """The spec with another spot energy, in its objectives and in its start.

    Raises:
        InputError: a mistake in the spec, or none of its objectives is `spot_energy`.
    """
    names = [objective.name for objective in load_spec(path).objectives]
    if "spot_energy" not in names:
        raise InputError(str(path), "an objective must be spot_energy", names, "Add it, as examples/quick.toml does.")
    where = f"objective[{names.index('spot_energy')}].options"
    return load_spec(
        path, [f"{where}={{ energy = {spot} }}", f"optimize.start_options={{ far_energy = {spot} }}", *sets]
    )


def best_grating(spec: Spec, evaluations: int) -> dict[str, str | float]:
    """Options of the ring of the least loss at the first near and far depth, as the optimiser samples it, by NLopt."""
    problem, scene = problem_of(spec, {})
    longest_m = 2.5 * ring_period_m(problem.camera)
    setup = StartSetup(problem.camera, False, spec.optics.design_wavelength_m)

    def loss(values: np.ndarray) -> float:
        ridge = Ridge(float(values[0]) * setup.wave_m, float(values[1]))
        return judge_height(problem, scene, grating(setup, ridge, float(values[2]) * longest_m))

    stages = (("direct", evaluations * 2 // 3), ("sbplx", evaluations // 3))
    high, duty, period = least(loss, (0.0, 0.02, 0.3), (1.0, 0.5, 1.0), stages, step=0.02)
    lengths = {"height": f"{high * setup.wave_m / NM:.1f} nm", "period": f"{period * longest_m / UM:.4f} um"}
    return {**lengths, "duty": round(duty, 4), "roughness": 0.0}


def plates(path: Path, spot: float, evaluations: int, kinds: Sequence[str]) -> Iterator[tuple[str, Design, float]]:
    """Plates of some kinds for a spot energy, with their kinds and the seconds they took."""
    at_start = ("optimize.steps=0", "optimize.polish=0")
    for kind in kinds:
        begun = time.perf_counter()
        spec = asking(path, spot, *at_start)
        if kind == FREE_FORM:
            spec = asking(path, spot)
        elif kind == LOSING:
            index = [objective.name for objective in spec.objectives].index("window_loss")
            spec = asking(path, spot, f"objective[{index}].weight={spec.objectives[index].weight / 4}")
        elif kind == GRATING:
            found = best_grating(spec, evaluations)
            options = ", ".join(f"{key} = {value!r}" for key, value in found.items())
            options = f"optimize.start_options={{ {options} }}"
            spec = asking(path, spot, *at_start, options, "optimize.quantisation=none", "optimize.start=ring")
        elif kind == RING:
            spec = asking(path, spot, *at_start, "optimize.start=ring")
        else:
            start = kind.partition(" ")[0].lower()
            spec = asking(path, spot, *at_start, "optimize.start_options={}", f"optimize.start={start}")
        design = optimize(spec)
        yield kind, design, time.perf_counter() - begun


def judged(kind: str, spec: Spec, design: Design, seconds: float, bank: PsfBank, lens: PsfBank) -> Plate:
    """Numbers of a plate for a spec, from its exact PSFs; `lens` are those of the plain lens."""
    assert design.spec is not None
    near, optic = len(design.near_m), HeightOptic.of(design.camera, design.nominal_height_m)
    rows = metric_rows(bank.metric_inputs(design.near_m, optic, lens=lens), "design")
    terms = terms_from_spec(spec, design.camera, {})
    loss = sum(term.weight * float(term.value(all_of(bank, lens, near))) for term in terms)

    def mean(name: str) -> float:
        return float(np.mean([row[name] for row in rows if name in row]))

    spots = [row["far_spot"] for row in rows if "far_spot" in row]
    ratios = [row["concentration"] / row["concentration_bound"] for row in rows if "concentration" in row]
    numbers = loss, mean("far_spot"), min(spots), max(spots), mean("concentration"), float(np.mean(ratios))
    asked = next(objective.options["energy"] for objective in spec.objectives if objective.name == "spot_energy")
    return Plate(kind, asked, *numbers, mean("throughput"), seconds, in_short(design.spec))


def in_short(spec: Spec) -> str:
    """What a plate was made with."""
    optimize = spec.optimize
    if optimize.steps:
        return f"{optimize.steps} steps"
    return " ".join(f"{key} {value}" for key, value in optimize.start_options.items())


def bound(lens: PsfBank, near: int) -> tuple[np.ndarray, np.ndarray]:
    """Spot energies from 0 to 1, and the least concentration of each, a mean over colours and near depths.

    As in `sim.metrics.MetricInputs.concentration_bound`, of the light that the faces let pass.
    """
    energy = np.asarray(lens.energy)[:, :near].astype(np.float64)
    passed = energy.sum((-2, -1))
    area = passed**2 / np.square(energy).sum((-2, -1)) / energy.shape[-1] ** 2
    spot = np.linspace(0, 1, 201)
    kept = spot[:, None, None] / passed
    least_of = np.where(kept <= 1, kept**2 + (1 - kept) ** 2 * area, np.nan)
    return spot, least_of.mean((1, 2))


def in_words(one: Plate) -> str:
    """A line of the table."""
    return (
        f"asked {one.asked:.2f}  {one.kind:23} loss {one.loss:7.4f}  spot {one.far_spot:.3f} "
        f"({one.least_spot:.3f}-{one.most_spot:.3f})  concentration {one.concentration:.4f} "
        f"({one.over_bound:.2f} of its bound)  in the window {one.window_share:.3f}  {one.seconds:4.0f} s"
    )


def kept(path: Path) -> list[Plate]:
    """The plates of a table that was written before; none if there is none."""
    if not path.is_file():
        return []
    rows = csv.DictReader(path.read_text().splitlines())
    read: list[dict[str, Any]] = [
        {key: text if key in WORDS else float(text) for key, text in row.items()} for row in rows
    ]
    return [Plate(**row) for row in read]


def plot(found: Sequence[Plate], curve: tuple[np.ndarray, np.ndarray], title: str) -> object:
    """Concentration of near light, the same over its bound, and light in the window, against the sharp spot."""
    labels = {
        "concentration": "concentration of near light (plain lens: 1)",
        "over_bound": "concentration over its bound",
        "window_share": "light in the window",
    }
    words = f"{title}: a sharp spot for the scene, spread light for what is near"
    with panels(None, (11.4, 3.8), words, "The bound is that of a plate that keeps all light in the window.") as figure:
        axes = figure.subplots(1, 3)
        axes[0].plot(*curve, color=FAINT, label="bound: spot and even rest")
        axes[1].axhline(1, color=FAINT)
        for axis, (value, label) in zip(axes, labels.items(), strict=True):
            for kind, (mark, colour) in KINDS.items():
                of = [one for one in found if one.kind == kind]
                line = "-" if kind in (FREE_FORM, LOSING, GRATING) else ""
                places = [one.far_spot for one in of], [getattr(one, value) for one in of]
                axis.plot(*places, marker=mark, color=colour, linestyle=line, label=kind)
            axis.set(xlim=(-0.02, 1), xlabel="light of the scene in its sharp spot", ylabel=label)
            axis.grid()
        axes[0].set_yscale("log")
        axes[1].set_ylim(0.8, 1.5)  # of the Fresnel lens and the random plate, what stays far from any spot is left out
        axes[2].set_ylim(0, 1)
        axes[0].legend()
    return figure


def run(path: Path, spots: Sequence[float], evaluations: int, out: Path) -> list[Plate]:
    """Design, judge, and write the table and the picture."""
    spec = load_spec(path)
    with study_folder(out, {"spec_sha256": spec_digest(spec), "evaluations": evaluations}):
        return _run(path, spec, spots, evaluations, out)


def _run(path: Path, spec: Spec, spots: Sequence[float], evaluations: int, out: Path) -> list[Plate]:
    found = kept(out / TABLE)
    camera, near = camera_from_spec(spec), len(spec.scene.near_m)
    lens = psf(HeightOptic.of(camera), depths=(*spec.scene.near_m, *spec.scene.far_m))
    banks: dict[str, PsfBank] = {}
    for spot in sorted(spots):
        have = [one.kind for one in found if one.asked == spot]
        for kind, design, seconds in plates(path, spot, evaluations, [kind for kind in KINDS if kind not in have]):
            bank = banks.get(kind) or psf(HeightOptic.of(camera, design.nominal_height_m), depths=design.depths_m)
            if kind in SAME:
                banks[kind] = bank
            found.append(judged(kind, asking(path, spot), design, seconds, bank, lens))
            print(in_words(found[-1]), flush=True)
            found.sort(key=lambda one: (one.asked, [*KINDS].index(one.kind)))
            write_atomic(out / TABLE, csv_table(found, 5).encode())
    save(plot(found, bound(lens, near), spec.name), out / "pareto.png")  # pyright: ignore[reportArgumentType]
    print(f"written to {out}/pareto.csv and .png")
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("spec", nargs="?", type=Path, default=HERE / "automotive.toml")
    parser.add_argument("--spots", type=float, nargs="+", default=[0.25, 0.4, 0.6])
    parser.add_argument("--evaluations", type=int, default=40)
    parser.add_argument("--out", type=Path, default=Path("pareto"))
    given = parser.parse_args()
    sys.exit(exit_code(lambda: run(given.spec, given.spots, given.evaluations, given.out)))
