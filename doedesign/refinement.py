"""Refinement of the cell of a periodic run by Maxwell's equations, into a run of its own."""

import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from doedesign.design.design import Design
from doedesign.optimization import write_results
from doedesign.runs.folder import (
    Run,
    begin_run,
    claim_run,
    finish_run,
    input_digests,
    load_checkpoint,
    named,
    run_of,
    save_checkpoint,
)
from doedesign.runs.level_maps import open_design
from doedesign.runtime.progress import meter
from doedesign.spec import Spec, input_files
from doedesign.spots.design import repeated, spots_from_spec, unit_cell
from doedesign.spots.refinement import RefinementTask, places_of, ranks
from doedesign.spots.spots import Spots
from doedesign.spots.superposition import spot_light
from fab.errors import InputError
from fab.files import canonical_json, csv_table, sha256_bytes, write_atomic
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.rules.check import Rules, check
from fab.rules.repair import repair
from fab.rules.strokes import Strokes
from fab.units import format_length
from sim.material import refractive_index
from sim.propagation.directions import efficiencies
from sim.rigorous.crossed import require_fmmax
from sim.rigorous.slab_cell import SlabCell, gradient_bytes, usual_terms

STEPS, ROW_STEPS = 60, 300
_MORE = 1.5  # terms of the judge over those of the solver
_MOST_BYTES = 8 * 10**9
_FEWEST_TERMS, _MOST_STEPS, _WIDEST = 9, 10_000, 32
_WAYS = {"unpolarised": (0.5, 0.5), "x": (1.0, 0.0), "y": (0.0, 1.0)}
_FILE = "refinement.csv"

log = logging.getLogger("doedesign")


class _Row(NamedTuple):
    """Light of a cell: which cell, which light, and its spots."""

    cell: str
    light: str
    terms: int
    on_target: float
    uniformity_error: float
    zeroth_order_efficiency: float


class _Cell(NamedTuple):
    """Unit cell of a run: its design and spec, orders, cells, levels, wavelength and index of the glass."""

    design: Design
    spec: Spec
    spots: Spots
    grid: Grid
    level: UInt8[np.ndarray, "y x"]
    wavelength_m: float
    glass: float

    def solver(self, terms: int) -> SlabCell:
        """Light of its slabs."""
        heights = self.design.levels.by_height()[1]
        slabs = np.diff(heights)[::-1]
        return SlabCell(self.grid.shape, self.grid.pitch_m, slabs, self.wavelength_m, self.glass, terms)


def refine(
    source: Run | str | Path,
    out: str | Path | None = None,
    *,
    terms: int | None = None,
    steps: int | None = None,
    overwrite: bool = False,
) -> Design:
    """Refine the unit cell of a finished run by rigorous light, into a run of its own, where a stopped one goes on.

    The objective is that of its spec: light of the orders, as shares of the incident light (behind the relief, in the
    glass), less what unequal orders are worth; of unpolarised light, or polarised as the spec says. Levels and their
    heights stay. Cells of two levels keep to the narrowest line and space of the process.

    Args:
        source: the run or its folder.
        out: folder of the new run; runs/NAME_refined by default.
        terms: orders of the rigorous solution; by default those that travel in the glass and somewhat more. The cells
            are judged with half as many again.
        steps: gradients that are computed; 60 by default, 300 of a row of cells.
        overwrite: where the folder has another run, remove it with all that was made of it.

    Raises:
        InputError: fmmax is missing, a run that cannot be read, has no unit cell or is pre-compensated, given phases,
            several wavelengths, tilted light, a cell that is too large, or a folder that belongs to something else.
    """
    require_fmmax()
    run = run_of(source)
    cell = _cell_of(open_design(run, False))
    terms = _terms_of(cell, terms)
    steps = steps if steps is not None else ROW_STEPS if 1 in cell.grid.shape else STEPS
    if not 1 <= steps <= _MOST_STEPS:
        raise InputError("steps", f"must lie from 1 to {_MOST_STEPS}", steps, f"{STEPS} are usual.")
    spec = named(cell.spec, f"{cell.spec.name}_refined")
    folder = Path(out or Path("runs") / spec.name)
    if folder.resolve() == run.folder.resolve():
        raise InputError(str(folder), "a refined run needs a folder of its own", "that of the run", "Give another.")
    task = _task_of(cell, terms, steps)
    about = {
        "run": cell.spec.name,
        "level_map_sha256": cell.design.level_map.digest,
        "terms": task.solver.terms,
        "steps": steps,
        "polarisation": cell.design.camera.polarisation,
    }
    inputs = input_digests(input_files(spec)) | {"refined": sha256_bytes(canonical_json(about))}
    with claim_run(folder, spec, inputs, overwrite=overwrite) as claimed:
        if claimed.done:
            log.info(f"{folder} already holds the finished refinement of this run")
        else:
            _refine_in(claimed, cell, task, about)
    return open_design(folder, False)


def _refine_in(run: Run, cell: _Cell, task: RefinementTask, about: dict[str, Any]) -> None:
    stored, state, history = load_checkpoint(run, task.template), task.initial_state(), []
    if stored is not None:
        arrays, step, history = stored
        log.info(f"resuming after step {step}")
        state = type(state)(*arrays, step)  # type: ignore[arg-type]
    begin_run(run)
    ny, nx = cell.grid.shape
    log.info(f"refining a cell of {ny} x {nx} with {task.solver.terms} terms and {task.count - 1} slabs")
    with meter("refining", task.steps, state.step) as progress:
        for state, record in task.run(state):  # noqa: B020 - goes on from it
            history.append(record)
            progress.advance(state.step, f"loss {record['loss']:.4f}")
            save_checkpoint(run, state.arrays, state.step, history)
    level = ranks(cell.design.levels)[0][state.best]
    rows = _table(cell, task, level)
    for row in rows:
        log.info(
            f"{row.cell}, {row.light}: {100 * row.on_target:.2f} % of the light, uniformity error "
            f"{100 * row.uniformity_error:.2f} %, 0th order {100 * row.zeroth_order_efficiency:.2f} %"
        )
    design = _repeated(cell, run.spec, level, tuple(history))
    names = write_results(run, (), design, {"refinement": [row._asdict() for row in rows]})
    write_atomic(run.path(_FILE), csv_table(rows).encode())
    finish_run(run, [*names, _FILE], about={"refined": about})


def _cell_of(design: Design) -> _Cell:
    spec, camera = design.spec, design.camera
    if spec is None or spec.spots is None or spec.spots.period_m is None:
        rule, cure = "only the unit cell of a grid of orders can be refined", "Give a run whose spots have a period."
        raise InputError(design.name, rule, "a run without one", cure)
    if spec.spots.phases_rad:
        rule, cure = "orders are refined for their light alone", "Leave out spots.phases."
        raise InputError(design.name, rule, "phases that are given", cure)
    if design.aim is not None:
        rule, cure = "a cell is refined for the depths that come out", "Refine the run that it was made from instead."
        raise InputError(design.name, rule, "etches that make up for a process (precompensate)", cure)
    wavelengths = sorted({line.wavelength_m for line in camera.lines})
    if len(wavelengths) > 1:
        got = ", ".join(map(format_length, wavelengths))
        raise InputError(design.name, "a cell is refined for one wavelength", got, "Design for one of them.")
    tilt_rad = camera.light_rad((0.0, 0.0))
    if any(tilt_rad):
        angles = ", ".join(f"{np.degrees(angle):.3g}" for angle in tilt_rad) + " degrees along y and x"
        raise InputError(design.name, "a cell is refined for light at normal incidence", angles, "Take the tilt away.")
    grid, period = unit_cell(spec.spots, camera), round(spec.spots.period_m / camera.grid.pitch_m)
    first = [count // 2 // period * period for count in camera.grid.shape]
    part = tuple(slice(at, at + count) for at, count in zip(first, grid.shape, strict=True))
    if not design.level_map.relief.inside(camera.grid)[part].all():
        rule = f"the aperture must hold a whole period of {format_length(spec.spots.period_m)} in its middle"
        raise InputError(design.name, rule, str(design.level_map.relief), "Choose a larger aperture.")
    wavelength_m, spots = wavelengths[0], spots_from_spec(spec.spots, camera)
    index = refractive_index(camera.material, wavelength_m)
    return _Cell(design, spec, spots, grid, design.level_map.level[part], wavelength_m, index)


def _terms_of(cell: _Cell, terms: int | None) -> int:
    """The number asked for, or the usual one, if it fits into memory and holds all orders."""
    shape, pitch_m, slabs = cell.grid.shape, cell.grid.pitch_m, cell.design.levels.count - 1
    usual = usual_terms(shape, pitch_m, cell.wavelength_m, cell.glass)
    wanted = usual if terms is None else terms
    most = int(np.sqrt(_MOST_BYTES / gradient_bytes(1, slabs)))
    if not _FEWEST_TERMS <= wanted <= most:
        side = format_length(float(f"{max(shape) * pitch_m * (most / usual) ** (1.0 if 1 in shape else 0.5):.3g}"))
        rule = f"must lie from {_FEWEST_TERMS} to {most}, which {slabs} slabs take {_MOST_BYTES / 1e9:.3g} GB for"
        ny, nx = shape
        got = f"{wanted} for a cell of {ny} x {nx}, {format_length(pitch_m)} wide"
        raise InputError(
            "terms", rule, got, f"Refine a cell of {side} at most, take fewer levels, or give fewer terms."
        )
    return wanted


def _task_of(cell: _Cell, terms: int, steps: int) -> RefinementTask:
    design, levels = cell.design, cell.design.levels
    solver = cell.solver(terms)
    try:
        places_of(cell.spots, solver.number)
    except KeyError as error:
        got = f"{solver.terms}, without the order (y, x) = {error.args[0]}"
        raise InputError("terms", "must hold all orders that are wanted", got, "Give more terms.") from error
    strokes = None
    if levels.count == 2:
        strokes = Strokes.of(Rules.from_process(design.process()), cell.grid.pitch_m)
        if max(strokes[:2]) > _WIDEST:
            rule = f"the narrowest line and space must be {_WIDEST} cells wide at most"
            raise InputError("process", rule, f"{max(strokes[:2])} cells", "Choose larger cells.")
    start, ways = ranks(levels)[1][cell.level], np.array(_WAYS[design.camera.polarisation])
    assert cell.spec.spots is not None
    uniformity = cell.spec.spots.uniformity
    seed = cell.spec.optimize.seed
    return RefinementTask(solver, cell.spots, uniformity, ways, start, levels.count, strokes, steps, seed)


def _table(cell: _Cell, task: RefinementTask, level: UInt8[np.ndarray, "y x"]) -> list[_Row]:
    """Light of the cell before and after, scalar and rigorous, the latter with more terms, too.

    Where the process cannot print the cell before, that of the nearest one that it prints stands between them.
    """
    judge, rows = cell.solver(round(_MORE * task.solver.terms)), list[_Row]()
    order, rank = ranks(cell.design.levels)
    cells = {"before": cell.level, "printable": order[task.first], "refined": level}
    for name, own in cells.items():
        if name == "printable" and np.array_equal(own, cell.level):
            continue
        rows.append(_Row(name, "scalar", 0, *_scalar_light(cell, own)))
        filled = task.filled(rank[own])
        for solver in (task.solver, judge):
            orders = solver.transmitted(filled)
            light = task.light(orders, solver.number)
            zeroth = float(task.ways @ orders[:, (solver.number == 0).all(1)][:, 0])
            rows.append(_Row(name, f"rigorous, {solver.terms} terms", solver.terms, *light, zeroth))
    return rows


def _scalar_light(cell: _Cell, level: UInt8[np.ndarray, "y x"]) -> tuple[float, float, float]:
    """Efficiency, uniformity error and 0th order of a thin element."""
    waves = cell.design.camera.waves_per_metre(cell.wavelength_m)
    field = np.exp(2j * np.pi * waves * cell.design.levels.heights_m()[level])
    asked = np.concatenate([cell.spots.waves_per_m, np.zeros((1, 2))])
    found: Float[np.ndarray, " m"] = efficiencies(field, np.ones(cell.grid.shape), cell.grid, asked)
    light = spot_light(found[:-1], cell.spots.shares)
    return light.efficiency, light.uniformity_error, float(found[-1])


def _repeated(cell: _Cell, spec: Spec, level: UInt8[np.ndarray, "y x"], history: tuple[Any, ...]) -> Design:
    """The design of a cell; of two levels, nothing is too narrow for the process at the rim either."""
    design = cell.design
    level_map = LevelMap(
        repeated(level, design.camera.grid), design.levels, design.camera.grid, spec.doe.relief, spec.name
    )
    process = design.process()
    if design.levels.count == 2 and not check(level_map, process).clean:
        mended = repair(level_map, process, float(design.camera.waves_per_metre(cell.wavelength_m)))
        log.info(f"at the rim: {mended.cost}")
        level_map = mended.level_map
    return Design(level_map, design.camera, (), design.far_m, spec=spec, history=history)
