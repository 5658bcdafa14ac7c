"""Optimisation of a spec into a design, in memory or in a run folder."""

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from doedesign.capture.from_spec import require_options
from doedesign.design.accuracy import accuracies, in_words
from doedesign.design.descent import descend
from doedesign.design.design import Design
from doedesign.design.levels.etch_depths import height_histogram, light_cost
from doedesign.design.metrics import DrawnPattern, design_metrics, drawn_patterns
from doedesign.design.objectives import Objective, Term, source_digests
from doedesign.design.optimize import (
    OptimizationState,
    empty_state,
    finished_design,
    initial_state,
    steps,
)
from doedesign.design.problem import Problem, SourceSet, problem_of
from doedesign.prediction import on_target
from doedesign.report.history import history_note, plot_history, plot_spot_history
from doedesign.runs.curve_tables import encircled_csv, mtf_csv
from doedesign.runs.folder import (
    Run,
    begin_run,
    claim_run,
    finish_run,
    input_digests,
    load_checkpoint,
    save_checkpoint,
    steps_of_run,
    with_steps,
    write_history,
)
from doedesign.runs.level_maps import open_design, read_any_height, write_design
from doedesign.runtime.progress import meter
from doedesign.spec import Spec, input_files, load_spec, spec_warnings
from doedesign.spec.values import MOST_STEPS
from fab.errors import InputError
from fab.figure import drawn_beside
from fab.files import canonical_json, path_of, write_atomic
from fab.height import HeightMap
from fab.levels import Levels
from fab.plots.height import plot_height
from fab.units import NM, format_length
from sim.aperture import open_cells
from sim.camera import Camera
from sim.metrics import without_infinities
from sim.optic import HeightOptic
from sim.plots.curves import encircled_curves, plot_encircled, plot_mtf
from sim.plots.pattern import plot_pattern
from sim.plots.psfs import plot_psfs
from sim.psf_bank import psf
from sim.rigorous.edge_optic import optic_as_drawn
from sim.transfer import mtf

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

    from doedesign.areas.design import AreaState
    from doedesign.focus.design import FocusState
    from doedesign.spots.design import SpotState

log = logging.getLogger("doedesign")

_TRIED, _MANY = 4, 1000  # steps that are timed for a budget, of a run of so many
_SHORTEST_S = 1e-9  # time of a step, below what clocks tell


def optimize(
    spec: Spec | str | Path,
    out: str | Path | None = None,
    *,
    overrides: Sequence[str] = (),
    objectives: Mapping[str, Objective] | None = None,
    overwrite: bool = False,
) -> Design:
    """Optimise the design of a spec.

    Args:
        spec: the spec, or its TOML file.
        out: run folder, in which a stopped optimisation goes on where it was stopped and to which results and pictures
            are written; without one everything stays in memory.
        overrides: changes to the spec, "table.key=value"; of one that was read, only if it is as its file has it.
        objectives: objectives of your own, by the names "module:function" that the spec gives them
            (`doedesign.import_objectives` imports them). A run records the files they are in.
        overwrite: where the folder has the run of another spec, remove it with all that was made of it.

    Returns:
        the design: its level map, the heights before rounding (metres), and, without `out`, the history of its loss.

    Raises:
        InputError: a mistake in the spec or its inputs, or a folder that belongs to something else.
    """
    if isinstance(spec, Spec) and overrides and (spec.file is None or load_spec(spec.file) != spec):
        rule, cure = "change a spec as its file has it", "Make all changes where it is read, by load_spec."
        raise InputError("overrides", rule, "one that was changed before", cure)
    if not isinstance(spec, Spec) or overrides:
        spec = load_spec(spec.file or "" if isinstance(spec, Spec) else spec, overrides)
    for warning in spec_warnings(spec):
        log.warning(warning)
    require_options(spec, str(spec.file or spec.name))  # not first when captures are made
    files = input_files(spec)
    if out is not None:
        return _optimize_in(path_of(out, "out"), spec, files, overrides, objectives or {}, overwrite)
    if (aimed := _aimed_design(spec)) is not None:
        return replace(aimed, edge_moves_m=spec.wafer.edge_moves_m)
    problem, sources = problem_of(spec, files, objectives)
    state = initial_state(spec, problem, sources, files, _reader(spec))
    state, history = _iterate(steps(spec, problem, sources, state), spec, state, [])
    design = finished_design(spec, problem, _polished(spec, problem, sources, state), history)
    return replace(design, edge_moves_m=spec.wafer.edge_moves_m)


def steps_within(
    spec: Spec, budget_s: float, out: str | Path | None = None, objectives: Mapping[str, Objective] | None = None
) -> int:
    """Number of steps of a spec that this machine does in a time.

    A few steps are tried to learn how long one takes, which comes on top of the time.

    Args:
        spec: the spec; its own `optimize.steps` does not matter.
        budget_s: seconds from the beginning of a run to its last step, with the start and the compilation of the first
            step, or of each colour's where colours are taken in turn; robust steps, a descent on levels, cells that are
            exchanged and the look at the design at the end come on top.
        out: run folder; where it has a run of this spec but for the number of steps, that number is returned, so that a
            stopped run goes on.
        objectives: as in `optimize`.

    Returns:
        at least 1, however short the time, and at most the 10 million that a spec allows.

    Raises:
        InputError: a time that is not positive, nothing to improve, or as `optimize`.
    """
    if not 0 < budget_s < float("inf"):
        raise InputError("budget", "must be positive seconds", budget_s, "For example 60.")
    if out is not None and (kept := steps_of_run(path_of(out, "out"), spec)) is not None:
        return kept
    if not (spec.objectives or spec.aims):
        raise InputError("budget", "there must be something to improve", "no objective", "Leave it out.")
    start, ends = time.perf_counter(), []
    compiled = len(spec.optics.colours) if spec.optimize.colours == "in_turn" else 1  # steps that are compiled
    for _ in _trial(with_steps(spec, _MANY), objectives):
        ends.append(time.perf_counter())
        tried = len(ends) - compiled
        if tried >= _TRIED or (tried > 0 and ends[-1] - start > budget_s / 4):
            break
    first, each = ends[compiled - 1] - start, float(np.median(np.diff(ends[compiled - 1 :])))
    steps = max(1, int(min((budget_s - first) / max(each, _SHORTEST_S), MOST_STEPS)))
    log.info(f"a step takes {each:.2g} s after {first:.2g} s to begin with: {steps} steps in {budget_s:g} s")
    return steps


def _trial(spec: Spec, objectives: Mapping[str, Objective] | None) -> Iterator[Any]:
    """Steps of a spec from its start, one by one."""
    if (task := _aimed_task(spec)) is not None:
        yield from task.steps(task.initial_state())
        return
    files = input_files(spec)
    problem, sources = problem_of(spec, files, objectives)
    yield from steps(spec, problem, sources, initial_state(spec, problem, sources, files, _reader(spec)))


def _optimize_in(
    folder: Path,
    spec: Spec,
    files: dict[str, Path],
    overrides: Sequence[str],
    objectives: Mapping[str, Objective],
    overwrite: bool,
) -> Design:
    inputs = input_digests(files) | source_digests(spec, objectives)
    with claim_run(folder, spec, inputs, overrides, overwrite=overwrite) as run:
        if run.done:
            log.info(f"{folder} already holds the finished run of this spec")
            return open_design(folder, False)
        log.info("preparing sources and propagation")
        terms: tuple[Term, ...] = ()
        design = _aimed_design(spec, run)
        if design is None:
            problem, sources = problem_of(spec, files, objectives)
            state, history = _resume(run, problem, sources, files)
            begin_run(run)
            state, history = _iterate(steps(spec, problem, sources, state), spec, state, history, run)
            state = _polished(spec, problem, sources, state)
            design, terms = finished_design(spec, problem, state, history), problem.terms
        log.info("evaluating the design")
        if spec.process.chooses_depths:
            log.info(f"chosen: {design.levels}")
        results = write_results(run, terms, design)
        finish_run(run, results, design.levels.depths_m)
    return open_design(folder, False)


def _polished(spec: Spec, problem: Problem, sources: SourceSet, state: OptimizationState) -> OptimizationState:
    """The state after the descent on levels that a spec asks for."""
    if not spec.optimize.polish:
        return state
    with meter("polishing", spec.optimize.polish) as progress:

        def advance(move: int, loss: float) -> None:
            progress.advance(move, f"loss {loss:.4f}")

        parameters = descend(spec, problem, sources, state.settled, spec.optimize.polish, advance)
    return state._replace(parameters=parameters, mean=None)


def _reader(spec: Spec) -> Callable[[Path], np.ndarray]:
    return lambda path: np.asarray(read_any_height(path, pitch_m=spec.doe.pitch_m).height_m)


def _resume(
    run: Run, problem: Problem, sources: SourceSet, files: dict[str, Path]
) -> tuple[OptimizationState, list[dict[str, Any]]]:
    empty = empty_state(run.spec, problem, sources)
    leaves, tree = jax.tree.flatten(empty.kept)
    stored = load_checkpoint(run, leaves)
    if stored is None:
        log.info(f'starting from "{run.spec.optimize.start}"')
        return initial_state(run.spec, problem, sources, files, _reader(run.spec)), []
    arrays, step, history = stored
    log.info(f"resuming after step {step}")
    parameters, adam, printed, robust, mean = jax.tree.unflatten(tree, arrays)
    parameters, adam, mean = jax.tree.map(jnp.asarray, (parameters, adam, mean))
    return OptimizationState(parameters, adam, step, printed, robust, mean), history


def _aimed_task(spec: Spec) -> Any:
    """Task of the spots, the areas or the foci of a spec, which all have the same methods; None without them."""
    if spec.spots is not None:
        from doedesign.spots.design import SpotTask

        return SpotTask.from_spec(spec)
    if spec.areas:
        from doedesign.areas.design import AreaTask

        return AreaTask.from_spec(spec)
    if spec.focus is not None:
        from doedesign.focus.design import FocusTask

        return FocusTask.from_spec(spec)
    return None


def _aimed_design(spec: Spec, run: Run | None = None) -> Design | None:
    """Design what the spots, the areas or the foci of a spec ask for; in a run, go on from its checkpoint.

    None for a spec that has none of them.
    """
    if (task := _aimed_task(spec)) is None:
        return None
    stored, history = None if run is None else load_checkpoint(run, task.template), []
    if stored is None:
        log.info(task.begins)
        state: Any = task.initial_state()
    else:
        arrays, step, history = stored
        log.info(f"resuming after step {step}")
        state = task.state_of(arrays, step)
    if run is not None:
        begin_run(run)
    work: Any = task.steps(state)
    state, history = _iterate(work, spec, state, history, run)
    return task.finished(state, history)


_State = TypeVar("_State", OptimizationState, "SpotState", "AreaState", "FocusState")


def _iterate(
    work: Iterator[tuple[_State, dict[str, Any]]],
    spec: Spec,
    state: _State,
    history: list[dict[str, Any]],
    run: Run | None = None,
) -> tuple[_State, list[dict[str, Any]]]:
    """Do the steps that are left; in a run, keep a checkpoint every so many, and after the last one."""
    last, every = spec.all_steps, spec.optimize.checkpoint_every
    with meter("optimising", last, state.step) as progress:
        for state, record in work:
            history.append(record)
            progress.advance(state.step, f"loss {record['loss']:.4f}")
            if run is not None and (state.step % every == 0 or state.step == last):
                save_checkpoint(run, state.arrays, state.step, history)
    return state, history


def _etch_metrics(camera: Camera, design: Design) -> dict[str, Any]:
    """The chosen depths, and what rounding to them costs beside 2^k steps (`doedesign.design.levels.etch_depths`)."""
    binary = Levels(design.levels.count, design.levels.step_m)
    area = open_cells(camera.grid, camera.opening)
    heights = height_histogram(np.asarray(design.continuous_m), area, binary.period_m, camera)
    return {
        "depths_nm": [round(depth / NM, 1) for depth in design.levels.depths_m],
        "light_cost": light_cost(heights, design.levels),
        "light_cost_of_equal_steps": light_cost(heights, binary),
    }


def write_results(
    run: Run, terms: tuple[Term, ...], design: Design, more: Mapping[str, Any] | None = None
) -> list[str]:
    """Look at a design and write its files and pictures into its claimed run; returns their names.

    Args:
        run: the run.
        terms: of the loss.
        design: what was found.
        more: further metrics.
    """
    spec, camera, height = run.spec, design.camera, design.nominal_height_m
    near, far, propagation = spec.scene.near_m, spec.scene.far_m, spec.propagation or camera.propagation
    levels = None if spec.optimize.quantisation == "none" else design.levels
    names = [*write_design(run.folder, design), "history.jsonl", "metrics.json", "spec.toml"]
    write_history(run, design.history)
    with drawn_beside() as draw:
        heights = HeightMap(height, camera.grid, spec.doe.relief)
        draw(run.path("height.png"), plot_height, heights, levels, spec.name)
        if design.history:
            drawing, note = plot_history if spec.spots is None else plot_spot_history, history_note(spec)
            draw(run.path("history.png"), drawing, design.history, title=spec.name, note=note)
        drawn, flat = optic_as_drawn(camera, height, depths_m=(*near, *far)), HeightOptic.of(camera)
        bank, lens = (psf(each, depths=(*near, *far), propagation=propagation) for each in (drawn, flat))
        within = encircled_curves([bank, lens])
        picture = run.path("encircled.png")
        draw(picture, plot_encircled, bank, camera, near, far, lens, title=spec.name, curves=within)
        rows = design_metrics(drawn, bank, near, lens)
        metrics: dict[str, Any] = {"psf": rows, "lens": camera.lens_text, "light": camera.light, **(more or {})}
        if patterns := drawn_patterns(spec, camera, bank, terms):
            metrics["patterns"] = without_infinities([pattern.summary() for pattern in patterns])
        if spec.process.chooses_depths:
            metrics["etches"] = _etch_metrics(camera, design)
        remark = ""
        if propagation == "far_field":
            ends = sorted({min(near + far), max(near + far)})
            budget = accuracies(drawn, bank, ends)
            metrics["accuracy"] = without_infinities([one._asdict() for one in budget])
            remark = in_words(budget, camera)
            log.info(remark)
        draw(run.path("psf.png"), plot_psfs, bank, camera, near, far, title=spec.name, remark=remark)
        transfers = [mtf(each, depths=(*near, *far)) for each in (drawn, flat)]
        draw(run.path("mtf.png"), plot_mtf, transfers[0], camera, near, far, transfers[1], title=spec.name)
        if (aimed := on_target(design, drawn)) is not None:
            metrics[aimed.name] = aimed.summary()
            log.info(aimed.describe())
            write_atomic(run.path(f"{aimed.name}.csv"), aimed.to_csv().encode())
            draw(run.path(f"{aimed.name}.png"), aimed.plot)
            names += [f"{aimed.name}.csv", f"{aimed.name}.png"]
        write_atomic(run.path("metrics.json"), canonical_json(metrics))
        write_atomic(run.path("mtf.csv"), mtf_csv(*transfers).encode())
        write_atomic(run.path("encircled.csv"), encircled_csv(bank, within, camera).encode())
        for number, one in enumerate(patterns, 1):
            names.append("pattern.png" if number == 1 else f"pattern_{number}.png")
            draw(run.path(names[-1]), _pattern_picture, one, camera)
    names += ["height.png", "psf.png", "mtf.png", "mtf.csv", "encircled.png", "encircled.csv"]
    return [*names, "history.png"] if design.history else names


def _pattern_picture(one: DrawnPattern, camera: Camera) -> "FigureBase":
    """The light of a target beside it."""
    named = [] if one.colour is None or one.depth_m is None else [one.colour, format_length(one.depth_m)]
    return plot_pattern(
        one.target, one.light, camera, efficiency=one.efficiency, uniformity=one.uniformity, title=", ".join(named)
    )
