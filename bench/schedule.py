"""Loss against seconds of a plate to see through: how soon the loss of the first schedule is reached.

    python -m bench.schedule            N = 1200, minutes
    python -m bench.schedule --quick    N = 320

The first schedule: every step looks at all colours, Adam's step size falls from 0.2 along a cosine over 120 steps, and
the start is a ring of half ridges, a third of a wave at 550 nm. Beside it the schedule of the examples, in as few steps
as reach the same loss and in as many as they have; for the loss of those days and for today's. All take turns step by
step, so whatever else the machine does slows all of them; designs are judged by PSFs that integrate every pixel, at all
depths. Seconds are the median of a step times their number; what compiling takes stands beside them.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import optax

from doedesign.design.design import Design
from doedesign.design.metrics import all_of
from doedesign.design.optimize import (
    OptimizationState,
    finished_design,
    initial_state,
    make_update,
    optimiser_of,
    step_inputs,
)
from doedesign.design.problem import losses, problem_of
from doedesign.spec import Spec, load_spec
from sim.optic import HeightOptic
from sim.psf_bank import PsfBank, psf

EXAMPLES = Path(__file__).parent.parent / "examples"
# The automotive plate at half its size: aperture, focal length, depths and window shrink together.
HALF = (
    "doe.samples=1200",
    "doe.aperture=2.22 mm",
    "optics.focal_length=4 mm",
    'scene.near=["2.5 cm", "4 cm", "6 cm"]',
    'scene.far=["2.5 m", "5 m"]',
    "sensor.window=256",
)
FIRST_STEPS, TARGET = 120, 1 / 3
FIRST = (f"optimize.steps={FIRST_STEPS}", "optimize.learning_rate=0.2", "optimize.colours=together")
FIRST_RING = 'optimize.start_options={ height = "398 nm", duty = 0.5 }'


class Course(NamedTuple):
    """A schedule: its name, its spec and its optimiser."""

    name: str
    spec: Spec
    optimiser: optax.GradientTransformation


class Outcome(NamedTuple):
    """A design, seconds of its steps, and seconds that compiling took besides."""

    design: Design
    steps_s: float
    compiling_s: float


def with_first_loss(spec: Spec) -> Spec:
    """The spec with the terms of those days: any spot, as bright as it likes in any colour."""
    kept = [one for one in spec.objectives if one.name != "spot_energy"]
    terms = [one.model_copy(update={"weight": 1.0}) if one.name == "window_loss" else one for one in kept]
    return spec.model_copy(update={"objectives": tuple(terms)})


def courses(path: Path, sets: tuple[str, ...], few: int, of_then: bool) -> list[Course]:
    """The first schedule, that of the examples in a `few` steps, and in full; for the loss `of_then` or that of now."""
    specs = [load_spec(path, [*sets, *more]) for more in ((*FIRST, FIRST_RING), (f"optimize.steps={few}",), ())]
    specs = [with_first_loss(spec) if of_then else spec for spec in specs]
    schedule = optax.cosine_decay_schedule(specs[0].optimize.learning_rate, FIRST_STEPS, alpha=0.05)
    names = ["first schedule", *(f"examples, {spec.optimize.steps} steps" for spec in specs[1:])]
    optimisers = [optax.adam(schedule), *map(optimiser_of, specs[1:])]
    return [Course(*each) for each in zip(names, specs, optimisers, strict=True)]


def seconds(course: Course) -> Iterator[float | Outcome]:
    """Go along a course; yields the share of it that is done after every step, and the outcome in the end."""
    spec, optimiser = course.spec, course.optimiser
    problem, scene = problem_of(spec, {})
    first = initial_state(spec, problem, scene, {}, lambda path: np.load(path, allow_pickle=False)).parameters

    update, state, taken = make_update(optimiser), (first, optimiser.init(first)), []  # pyright: ignore[reportArgumentType]
    for step in range(spec.optimize.steps):
        start = time.perf_counter()
        state, loss, _ = update(step_inputs(spec, problem, scene, step), state)
        jax.block_until_ready((state, loss))
        taken.append(time.perf_counter() - start)
        yield (step + 1) / spec.optimize.steps
    steps_s = float(np.median(taken)) * len(taken)
    compiling_s = sum(one - np.median(taken) for one in taken[:3])
    last = OptimizationState(state[0], state[1], spec.optimize.steps)
    yield Outcome(finished_design(spec, problem, last), steps_s, float(compiling_s))


def in_turns(given: list[Course]) -> list[Outcome]:
    """Go along all courses at once: whichever is the least far takes the next step."""
    work, done, found = [seconds(course) for course in given], [0.0] * len(given), {}
    while len(found) < len(given):
        index = min((i for i in range(len(given)) if i not in found), key=done.__getitem__)
        reached = next(work[index])
        if isinstance(reached, Outcome):
            found[index] = reached
        else:
            done[index] = reached
    return [found[index] for index in range(len(given))]


def loss_of(design: Design, lens: PsfBank) -> float:
    """Loss of a design at all depths, by PSFs that integrate every pixel; `lens` are those of the plain lens."""
    assert design.spec is not None
    bank = psf(HeightOptic.of(design.camera, design.height_m), depths=design.depths_m)
    return float(losses(problem_of(design.spec, {})[0].terms, all_of(bank, lens, len(design.near_m)))[0])


def report(path: Path, sets: tuple[str, ...], few: int, of_then: bool) -> None:
    """Print the table of one loss."""
    given = courses(path, sets, few, of_then)
    outcomes = in_turns(given)
    design = outcomes[0].design
    lens = psf(HeightOptic.of(design.camera), depths=design.depths_m)
    reached = [loss_of(one.design, lens) for one in outcomes]
    print(
        f"See-through plate, N = {design.camera.grid.shape[0]}, loss {'of the first schedule' if of_then else 'of now'}"
    )
    for course, one, loss in zip(given, outcomes, reached, strict=True):
        print(f"  {course.name:20} {one.steps_s:7.1f} s (+ {one.compiling_s:4.1f} s to compile)  loss {loss:.4f}")
    ratio, lower = outcomes[1].steps_s / outcomes[0].steps_s, reached[1] <= reached[0]
    verdict = "ok" if lower and ratio <= TARGET else "missed"
    print(
        f"  {'that loss' if lower else 'NOT that loss'} in {ratio:.2f} of the time  (target <= {TARGET:.2f}: {verdict})"
    )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a small plate, in a minute")
    path, sets = (EXAMPLES / "automotive.toml", HALF)
    if parser.parse_args().quick:
        path, sets = EXAMPLES / "quick.toml", ()
    report(path, sets, few=90, of_then=True)
    report(path, sets, few=48, of_then=False)


if __name__ == "__main__":
    main()
