"""`doedesign optimize`: a spec becomes a run folder."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from doedesign.design.etch_depths import heights_of, light_cost
from doedesign.design.metrics import design_metrics, pattern_metrics
from doedesign.design.optimize import (
    Design,
    OptimizationState,
    finished_design,
    initial_state,
    learns_depths,
    optimiser_of,
    steps,
)
from doedesign.design.problem import Problem, SourceSet, problem_of
from doedesign.report.pictures import draw_encircled, draw_height, draw_history, draw_mtf, draw_pattern, draw_psfs
from doedesign.runs.folder import (
    Run,
    begin_run,
    claim_run,
    finish_run,
    input_digests,
    load_checkpoint,
    open_run,
    save_checkpoint,
    write_history,
)
from doedesign.runtime.progress import meter
from doedesign.spec import Spec, input_files, load_spec
from fab.files import canonical_json, write_atomic
from fab.levels import Levels
from fab.units import NM
from sim.aperture import circle_coverage
from sim.psf_bank import PsfBank, psf_bank
from sim.store import write_height
from sim.transfer import transfer_bank

Say = Callable[[str], None]


def optimize(spec_path: Path, out: Path | None, overrides: Sequence[str] = (), say: Say = lambda _: None) -> Run:
    """Optimise a spec, or go on where an earlier call was stopped.

    Args:
        spec_path: TOML spec.
        out: run folder; `runs/NAME` by default.
        overrides: changes to the spec, "table.key=value".
        say: told what is going on.

    Returns:
        the finished run.

    Raises:
        InputError: a mistake in the spec or its inputs, or a folder that belongs to something else.
    """
    spec = load_spec(spec_path, overrides)
    files = input_files(spec, spec_path)
    inputs = input_digests(files)
    with claim_run(out or Path("runs") / spec.name, spec, inputs) as run:
        if run.done:
            say(f"{run.folder} already holds the finished run of this spec")
            return open_run(run.folder)
        say("preparing sources and propagation")
        problem, scene = problem_of(spec, files)
        state, history = _resume(run, problem, scene, files, say)
        begin_run(run, inputs, overrides)
        state, history = _iterate(run, problem, scene, state, history)
        say("evaluating the design")
        design = finished_design(spec, problem, state)
        if spec.process.chooses_depths:
            say(f"chosen: {design.levels.told}")
        results = _write_results(run, problem, design, history)
        finish_run(run, inputs, overrides, results, design.levels.depths_m)
    return open_run(run.folder)


def _resume(
    run: Run, problem: Problem, scene: SourceSet, files: dict[str, Path], say: Say
) -> tuple[OptimizationState, list[dict[str, Any]]]:
    from doedesign.runs.level_maps import read_any_height

    optimiser = optimiser_of(run.spec)
    size = len(problem.camera.grid.axis_m("x"))
    shape = (ring_shape(problem),) if problem.radial else (size, size)
    # Depths that are learnt stand between the parameters and the moments.
    shapes = [shape, (run.spec.process.masks,)] if learns_depths(run.spec) else [shape]
    free = [np.zeros(each, np.float32) for each in shapes]
    template = jax.eval_shape(lambda: optimiser.init(tuple(free) if len(free) > 1 else free[0]))
    leaves, tree = jax.tree.flatten(template)
    stored = load_checkpoint(run, [*shapes, *(leaf.shape for leaf in leaves)])
    if stored is None:
        say(f'starting from "{run.spec.optimize.start}"')
        start = lambda path: np.asarray(read_any_height(path, pitch_m=run.spec.doe.pitch_m).height_m)  # noqa: E731
        return initial_state(run.spec, problem, scene, files, start), []
    arrays, step, history = stored
    say(f"resuming after step {step}")
    radians, *stretch = (jax.numpy.asarray(a) for a in arrays[: len(shapes)])
    adam = jax.tree.unflatten(tree, [jax.numpy.asarray(a) for a in arrays[len(shapes) :]])
    return OptimizationState(radians, adam, step, *stretch), history


def ring_shape(problem: Problem) -> int:
    """Number of parameters of a radial problem."""
    from sim.propagation.hankel import ring_count

    return ring_count(problem.camera)


def _iterate(
    run: Run, problem: Problem, scene: SourceSet, state: OptimizationState, history: list[dict[str, Any]]
) -> tuple[OptimizationState, list[dict[str, Any]]]:
    total, every = run.spec.optimize.steps, run.spec.optimize.checkpoint_every
    names = [term.name for term in problem.terms]
    with meter("optimising", total, state.step) as progress:
        for state, record in steps(run.spec, problem, scene, state):  # noqa: B020 - the last state is the result
            history.append({"step": record.step, "loss": record.loss, "terms": list(record.terms), "names": names})
            progress.advance(state.step, f"loss {record.loss:.4f}")
            if state.step % every == 0 or state.step == total:
                arrays = [np.asarray(leaf) for leaf in jax.tree.leaves((state.free, state.adam))]
                save_checkpoint(run, arrays, state.step, history)
    return state, history


def design_bank(spec: Spec, problem: Problem, height_m: np.ndarray) -> PsfBank:
    """The exact PSF bank of a height map at all depths of the spec."""
    depths = (*spec.scene.near_m, *spec.scene.far_m)
    return psf_bank(problem.camera, height_m, depths, propagation=spec.optics.propagation)


def _etch_metrics(problem: Problem, design: Design) -> dict[str, Any]:
    """The chosen depths, and what rounding to them costs beside 2^k steps (`doedesign.design.etch_depths`)."""
    camera, binary = problem.camera, Levels(design.levels.count, design.levels.step_m)
    area = circle_coverage(camera.grid, camera.aperture_m)
    heights = heights_of(design.continuous_m, area, binary.period_m, camera)
    return {
        "depths_nm": [round(depth / NM, 1) for depth in design.levels.depths_m],
        "light_cost": light_cost(heights, design.levels),
        "light_cost_of_equal_steps": light_cost(heights, binary),
    }


def _write_results(run: Run, problem: Problem, design: Design, history: list[dict[str, Any]]) -> list[str]:
    spec, camera = run.spec, problem.camera
    levels = None if spec.optimize.quantisation == "none" else design.levels
    write_height(run.path("height.exr"), design.drawn_m, camera.grid.pitch_m, spec.doe.aperture_m)
    write_height(run.path("height_continuous.exr"), design.continuous_m, camera.grid.pitch_m, spec.doe.aperture_m)
    write_history(run, history)
    near, far = spec.scene.near_m, spec.scene.far_m
    bank = design_bank(spec, problem, design.drawn_m)
    flat = np.zeros_like(design.drawn_m)
    lens = design_bank(spec, problem, flat)
    metrics: dict[str, Any] = {"psf": design_metrics(camera, design.drawn_m, bank, near, lens)}
    patterns = pattern_metrics(spec, camera, bank, problem.terms)
    if patterns:
        metrics["patterns"] = patterns
    if spec.process.chooses_depths:
        metrics["etches"] = _etch_metrics(problem, design)
    write_atomic(run.path("metrics.json"), canonical_json(metrics))
    draw_height(run.path("height.png"), design.drawn_m, levels, camera, spec.name)
    draw_psfs(run.path("psf.png"), camera, bank, near, far)
    transfers = [transfer_bank(camera, height, (*near, *far)) for height in (design.drawn_m, flat)]
    draw_mtf(run.path("mtf.png"), camera, transfers[0], near, far, transfers[1])
    draw_encircled(run.path("encircled.png"), camera, bank, near, far, lens)
    names = ["height.exr", "height_continuous.exr", "history.jsonl", "metrics.json", "spec.toml"]
    names += ["height.png", "psf.png", "mtf.png", "encircled.png"]
    if history:
        draw_history(run.path("history.png"), history)
        names.append("history.png")
    targets = [t for t, o in zip(problem.terms, spec.objectives, strict=True) if o.name == "target_pattern"]
    if targets:
        target = targets[0].value.keywords["target"]  # pyright: ignore[reportFunctionMemberAccess]
        achieved = bank.energy[0, bank.depths_m.index(far[0])]
        draw_pattern(run.path("pattern.png"), camera, target, achieved, **patterns[0])
        names.append("pattern.png")
    return names
