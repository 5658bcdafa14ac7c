"""Pre-compensation: etches commanded and masks drawn so that a known process makes the plate that was designed.

A process that etches 3 % too deep and widens every opening by 0.1 um makes the design from etches 3 % shallower and
openings drawn 0.1 um smaller. Where errors do not cancel like that (walls that lean, corners, etch lag, masks that lie
off), NLopt looks on from there, over a depth and a move of the edges for every mask, for the plate whose light comes
nearest to the design's: the least difference of the PSFs, or for spots, areas and foci the least loss of these. The
loss of a spec's objectives may be less than the design's own, with another light than was designed; it is taken on
request alone. The plate looked at is the one that the process makes with every error at its mean.
"""

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import count
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from doedesign.areas.shape import area_lights
from doedesign.build import process_from_spec, resolve_process, spec_from_process
from doedesign.calibration.unknowns import chosen_names
from doedesign.design.design import Design
from doedesign.design.levels.etch_depths import recipe_depth_m
from doedesign.design.objectives import Objective, PsfSet, Term, disc_radii_m, source_digests, terms_from_spec
from doedesign.focus.depth import FocusTable
from doedesign.optimization import write_results
from doedesign.prediction import on_target, predict
from doedesign.runs.folder import (
    AIM_DEPTHS,
    Run,
    begin_run,
    claim_run,
    finish_run,
    input_digests,
    inputs_of_run,
    is_finished,
    named,
    require_room,
    run_of,
)
from doedesign.runs.level_maps import open_design
from doedesign.runtime.progress import meter
from doedesign.search import least
from doedesign.spec import Spec, input_files
from doedesign.spots.orders import OrderTable, OrderTables
from fab.errors import InputError
from fab.files import canonical_json, csv_table, sha256_bytes, write_atomic
from fab.layout.geometry import pixel_edges
from fab.layout.polygons import smallest_runs
from fab.levels import Levels, planes
from fab.process import OVER_THE_WAFER, Normal, Process, Variation
from fab.units import NM, format_length
from sim.metrics import participation, without_infinities
from sim.optic import CellOptic, HeightOptic
from sim.psf_bank import psf
from sim.surface import FabricatedDoe, as_fabricated

log = logging.getLogger("doedesign")

EVALUATIONS, _MOST = 120, 10_000
_MASKS, _LIGHT = "precompensation.csv", "precompensation_light.csv"
# Steps of the search: depths as a share, edges in cells; and how many of them lie on either side of what undoes the
# mean errors.
_DEPTH_STEP, _EDGE_STEP, _REACH = 0.01, 0.02, 8.0
_SETTLED = 0.02  # of a step
_SAME_M = 0.5e-6  # by which radii of wafers may differ
_ROOM = 0.9  # of half the narrowest line and space that edges may take, so that nothing closes
_TOLD = ("ring_to_disc", "far_spot", "on_target")  # numbers of the light that are logged


class _Commands(NamedTuple):
    """Depth of the etch and move of the edges of every mask, metres."""

    depths_m: tuple[float, ...]
    moves_m: tuple[float, ...]


class _MaskRow(NamedTuple):
    """One mask, numbered from 1: lengths in nanometres, edges outward."""

    mask: int
    designed_nm: float
    commanded_nm: float
    expected_nm: float
    edge_move_nm: float
    expected_edge_nm: float

    def __str__(self) -> str:
        depths = f"{self.designed_nm:g} nm designed, {self.commanded_nm:g} commanded, {self.expected_nm:.4g} expected"
        way = "in" if self.edge_move_nm < 0 else "out"
        edges = f"drawn {abs(self.edge_move_nm):g} nm further {way}, expected {self.expected_edge_nm:.3g} nm out"
        return f"mask {self.mask}: {depths}; edges {edges}"


class _LightRow(NamedTuple):
    """A number of the light: of the plate as drawn, and as fabricated without and with what was found."""

    colour: str
    depth_m: float | None
    quantity: str
    drawn: float | None
    without: float | None
    compensated: float | None

    def __str__(self) -> str:
        at = "infinity" if self.depth_m is None else format_length(self.depth_m)
        drawn, *made = ("?" if n is None else f"{n:.4g}" for n in (self.drawn, self.without, self.compensated))
        words = f"{drawn} as designed; as fabricated {made[0]} without compensation, {made[1]} with it"
        return f"{self.colour} at {at}: {self.quantity} {words}"


@dataclass(frozen=True, eq=False)
class _Task:
    """A design as its plate should come out, the process that makes it, and the loss of a plate."""

    design: Design
    process: Process
    loss: Callable[[FabricatedDoe], float]

    @cached_property
    def mean(self) -> tuple[np.ndarray, np.ndarray]:
        """Share by which every etch goes too deep at the DOE, and growth of every mask's openings per edge, metres."""
        expected, zeros = self.process.expected(), (0.0,) * self.process.masks
        scale = (1 + expected.common_depth_scale) * (1 + np.array(expected.depth_scale or zeros))
        deep = scale * self.process.depth_at_die - 1
        return deep, expected.common_cd_bias_m + np.array(expected.cd_bias_m or zeros)

    @cached_property
    def room(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest move of the edges of every mask, metres, at which no line and no space closes."""
        runs = [smallest_runs(plane) for plane in planes(self.design.level_map.level, self.process.levels)]
        line, space = (np.array([each or 1 for each in kind]) for kind in zip(*runs, strict=True))
        half = _ROOM * self.design.camera.grid.pitch_m / 2
        return -half * line, half * space

    def commands(self, steps: Sequence[float] | np.ndarray) -> _Commands:
        """Commands so many steps beyond those that undo the mean errors: depths of all masks, then edges."""
        deeper, wider = np.array(steps).reshape(2, -1)
        deep, wide = self.mean
        depths = np.array(self.process.depths_m()) * (1 + _DEPTH_STEP * deeper) / (1 + deep)
        moves = np.clip(_EDGE_STEP * self.design.camera.grid.pitch_m * wider - wide, *self.room)
        return _Commands(tuple(depths.tolist()), tuple(moves.tolist()))

    def plate(self, commands: _Commands) -> FabricatedDoe:
        """The expected plate, with commands as errors of the design's own etches and masks."""
        expected, (deep, wide) = self.process.expected(), self.mean
        ratio = np.array(commands.depths_m) / np.array(self.process.depths_m())
        # Uniformity is an error of its own.
        scale = ratio * (1 + deep) / (1 + expected.common_depth_scale) / self.process.depth_at_die - 1
        bias = wide + np.array(commands.moves_m) - expected.common_cd_bias_m
        errors = replace(expected, depth_scale=tuple(scale.tolist()), cd_bias_m=tuple(bias.tolist()))
        level, camera = self.design.level_map.level, self.design.camera
        return as_fabricated(level, camera, self.process, errors, depths_m=self.design.depths_m)

    def search(self, evaluations: int) -> _Commands:
        """The commands of least loss, as recipe and drawing hold them."""
        (low, high), (_, wide) = self.room, self.mean
        for mask in np.flatnonzero((-wide < low) | (-wide > high)):
            way = "in" if wide[mask] > 0 else "out"
            text = f"edges of mask {mask + 1} should be drawn {format_length(abs(wide[mask]))} further {way}"
            log.warning(f"{text}, which would close its narrowest features: less has to do")
        values, worst, tried = 2 * self.process.masks, 0.0, count(1)
        with meter("compensating", evaluations) as progress:

            def judged(steps: np.ndarray) -> float:
                nonlocal worst
                try:
                    found = self.loss(self.plate(self.commands(steps)))
                except InputError:  # beyond the model
                    return worst + 1.0
                worst = max(worst, found)
                progress.advance(next(tried), f"loss {found:.4g}")
                return found

            # On the quick example with masks that lie off, Sbplx took 57 s to a loss for which MMA, with the exact
            # gradient, took 130 s; BOBYQA, COBYLA and SLSQP ended higher.
            ends, stages = ((-_REACH,) * values, (_REACH,) * values), (("sbplx", evaluations),) * (evaluations > 0)
            steps = least(judged, *ends, stages, step=1.0, start=(0.0,) * values, settled=_SETTLED)
        best, unit_m = self.commands(steps), pixel_edges(self.design.camera.grid).dbu_m
        moves_m = (float(f"{round(move / unit_m) * unit_m:.12g}") for move in best.moves_m)
        return _Commands(tuple(map(recipe_depth_m, best.depths_m)), tuple(moves_m))

    def mask_rows(self, commands: _Commands) -> list[_MaskRow]:
        """The table of masks."""
        deep, wide = self.mean
        each = zip(self.process.depths_m(), *commands, deep.tolist(), wide.tolist(), strict=True)
        lengths = ((designed, d, d * (1 + own), move, move + bias) for designed, d, move, own, bias in each)
        return [_MaskRow(k, *(float(f"{m / NM:.9g}") for m in row)) for k, row in enumerate(lengths, 1)]


def precompensate(
    source: Run | str | Path,
    out: str | Path | None = None,
    *,
    process: Process | str | Path | None = None,
    random: Sequence[str] = (),
    by: Literal["psfs", "loss"] | None = None,
    objectives: Mapping[str, Objective] | None = None,
    evaluations: int = EVALUATIONS,
    overwrite: bool = False,
) -> Design:
    """Find the depths to command and the moves of edges with which a process makes the plate of a finished run.

    The result is a run of its own with the same level numbers: its spec has the process, the commanded depths as those
    of the etches, and the moves of edges of the wafer, so that masks, predictions, studies and calibrations of it see
    the plate as the process makes it. As drawn it is what is commanded, which is not the design. Two tables say what
    was found, by mask, and by colour and depth; the manifest says which depths the plate is to come out with.

    Args:
        source: the run or its folder; one that was made here aims at the same plate again.
        out: folder of the new run; runs/NAME_v2 by default.
        process: a process, the name of a stock process or a TOML file, such as the estimate of a calibration; that of
            the run's spec by default.
        random: errors that are drawn anew for every plate, such as "overlay", by the names that a calibration takes: an
            estimate of them is that of one plate, so they are those of the run's own process.
        by: the least difference of the "psfs" from the design's, or the least "loss" of the spec's objectives, which
            may be less than the design's own, with another light; by default "loss" for spots, areas and foci, and
            "psfs" for all else.
        objectives: objectives of the user's own, by the names that the spec gives them.
        evaluations: plates of the search; 0 leaves it at what undoes the mean of depths and line widths.
        overwrite: where the folder has another run, remove it with all that was made of it.

    Returns:
        the new design, whose `aim` is the plate that should come out.

    Raises:
        InputError: a run that cannot be read, a process of other levels, without errors to make up for or with errors
            beyond the model, the loss of a spec without objectives, or a folder that belongs to something else.
    """
    if not 0 <= evaluations <= _MOST:
        raise InputError("evaluations", f"must lie from 0 to {_MOST}", evaluations, f"{EVALUATIONS} are usual.")
    run = run_of(source)
    drawn = open_design(run, False)
    assert drawn.spec is not None  # that of its run
    made_by = _repeating(resolve_process(process, drawn.levels, drawn.spec.process), drawn.spec, random)
    if made_by.expected().nominal:
        rule, cure = "must have errors whose means are not 0", "Give the estimate of a calibration."
        raise InputError("process", rule, made_by.name, cure)
    made_by = _on_wafer(made_by, drawn.spec)
    # Errors of depth are shares, whatever depths an earlier pre-compensation commanded.
    aim = drawn.aim or drawn.level_map
    design = replace(drawn, level_map=aim, edge_moves_m=(), aim=None)
    made_by = replace(made_by, levels=aim.levels)
    name = named(drawn.spec, _next_name(drawn)).name  # one that is too long is refused now
    folder = Path(out or Path("runs") / name)
    if folder.resolve() == run.folder.resolve():
        raise InputError(str(folder), "the new run needs a folder of its own", "that of the run", "Give another.")
    files, by = _files(drawn.spec), by or ("loss" if drawn.spec.aims else "psfs")
    if by == "loss" and not (drawn.spec.objectives or drawn.spec.aims):
        cure = "Leave it out: plates are then judged by their PSFs."
        raise InputError("by", "a loss must be that of objectives", "a spec without any", cure)
    about = {
        "run": drawn.spec.name,
        "level_map_sha256": aim.digest,
        "process": spec_from_process(made_by, drawn.spec.process).model_dump(mode="json"),
        "by": by,
        "evaluations": evaluations,
    }
    inputs = input_digests(files) | source_digests(drawn.spec, objectives or {})
    inputs |= {"precompensated": sha256_bytes(canonical_json(about))}
    if (found := _finished(folder, inputs, overwrite=overwrite)) is not None:
        return found
    terms = terms_from_spec(drawn.spec, design.camera, files, objectives)
    task = _Task(design, made_by, _loss_of(design, terms) if by == "loss" else _difference_from(design))
    commands = task.search(evaluations)
    compensated = _compensated(task, commands, name)
    assert compensated.spec is not None
    with claim_run(folder, compensated.spec, inputs, overwrite=overwrite) as claimed:
        _write(claimed, task, compensated, terms, commands, about)
    return open_design(folder, False)


def _finished(folder: Path, inputs: dict[str, str], *, overwrite: bool) -> Design | None:
    """The design of a folder that holds this pre-compensation, done; an InputError for one that holds another run."""
    # The spec of the new run is known after the search alone.
    require_room(folder)
    before = inputs_of_run(folder)
    if before == inputs:
        if not is_finished(folder):
            return None
        found = open_design(folder, False)
        log.info(f"{folder} already holds this pre-compensation")
        return found
    if before is not None and not overwrite:
        cure = "Choose another output folder, or give `overwrite` to remove that run and all that was made of it."
        raise InputError(str(folder), "the folder must belong to this pre-compensation", "another run", cure)
    return None


def _next_name(design: Design) -> str:
    """Name of the run that follows on that of a design: NAME_v2, or after one made here the next number."""
    again = re.fullmatch(r"(.*)_v(\d+)", design.name) if design.aim is not None else None
    return f"{again[1]}_v{int(again[2]) + 1}" if again else f"{design.name}_v2"


def _repeating(process: Process, spec: Spec, random: Sequence[str]) -> Process:
    """A process, with those errors that are drawn anew for every plate as in that of a spec."""
    if not random:
        return process
    usual = process_from_spec(spec.process).spreads
    anew = {name: usual.get(name, Normal()) for name in chosen_names(process.masks, random, "random")}
    return replace(process, spreads={**process.spreads, **anew})


def _files(spec: Spec) -> dict[str, Path]:
    """Files that the spec of a run names, other than the start of its optimisation."""
    return input_files(spec.model_copy(update={"optimize": spec.optimize.model_copy(update={"start": "flat"})}))


def _loss_of(design: Design, terms: tuple[Term, ...]) -> Callable[[FabricatedDoe], float]:
    """Loss of a plate: of the terms of a spec, or of its spots, areas or foci."""
    spec, camera, near = design.spec, design.camera, len(design.near_m)
    if spec is not None and spec.aims:
        return partial(_miss, design, spec)

    lens = participation(jnp.asarray(_energy(design, HeightOptic.of(camera))[:, :near]))
    disc_radius_m = jnp.asarray(disc_radii_m(camera, design.near_m))

    def loss(plate: FabricatedDoe) -> float:
        light = jnp.asarray(_energy(design, plate))
        psfs = PsfSet(light[:, :near], light[:, near:], lens, disc_radius_m, camera)
        return float(sum(term.weight * term.value(psfs) for term in terms))

    return loss


def _difference_from(design: Design) -> Callable[[FabricatedDoe], float]:
    """Mean squared difference of a plate's PSFs from those of a design, over the mean square of these."""
    wanted = _energy(design, design.as_optic())
    return lambda plate: float(np.mean((_energy(design, plate) - wanted) ** 2) / np.mean(wanted**2))


def _energy(design: Design, doe: CellOptic) -> Float[np.ndarray, "w d y x"]:
    """PSFs of a DOE at the depths of a design."""
    return psf(doe, depths=design.depths_m).energy


def _miss(design: Design, spec: Spec, plate: FabricatedDoe) -> float:
    """Loss of a plate that should make spots, areas or foci, as of its design; of several areas that of the worst."""
    if spec.areas:
        each = zip(spec.areas, area_lights(design, plate), strict=True)
        return max(float(light.loss(area.uniformity)) for area, light in each)
    found = on_target(design, plate)
    if isinstance(found, FocusTable):
        return found.loss
    assert spec.spots is not None
    if isinstance(found, OrderTables):
        light, unequal = float(np.mean([one.total for one in found.tables])), found.measures()["uniformity_error"]
        return 1.0 - light + spec.spots.uniformity * unequal
    assert isinstance(found, OrderTable)
    # Where phases are given, light counts in the wave that they make.
    light = found.total if found.wave is None else found.wave.share
    return 1.0 - light + spec.spots.uniformity * found.uniformity_error


def _on_wafer(process: Process, spec: Spec) -> Process:
    """The process on the wafer of a spec, whose size matters only to depths that differ over it."""
    radius_m = spec.wafer.diameter_m / 2
    if abs(process.wafer_radius_m - radius_m) < _SAME_M:
        return process
    if any(process.spreads.get(name, Normal()) != Normal() for name in OVER_THE_WAFER):
        rule = f"must be for the wafer of the run, of radius {format_length(radius_m)}, where depths differ over it"
        cure = "Calibrate for this wafer, or optimise for the wafer of the process."
        raise InputError("process: wafer_radius_m", rule, format_length(process.wafer_radius_m), cure)
    return replace(process, wafer_radius_m=radius_m)


def _compensated(task: _Task, commands: _Commands, name: str) -> Design:
    """The design as it is commanded."""
    design, spec = task.design, task.design.spec
    assert spec is not None
    aim = design.level_map
    try:
        levels = Levels(aim.levels.count, aim.levels.step_m, commands.depths_m)
    except InputError as error:
        rule = "must leave depths that make as many levels as the design has"
        cure = "Calibrate again, or find its depths closer to those of the design."
        raise InputError("process", rule, f"{error.where} that break a rule: {error.rule}", cure) from error
    process = spec_from_process(replace(task.process, levels=levels), spec.process)
    moves_m = commands.moves_m if any(commands.moves_m) else ()
    wafer = spec.wafer.model_copy(update={"edge_moves_m": moves_m, "compensate": False})
    spec = named(spec, name).model_copy(update={"process": process, "wafer": wafer})
    level_map = replace(aim, levels=levels, name=name)
    left_behind: dict[str, Any] = {"continuous_m": None, "history": (), "folder": None}
    return replace(design, level_map=level_map, edge_moves_m=moves_m, aim=aim, spec=spec, **left_behind)


def _write(
    run: Run, task: _Task, compensated: Design, terms: tuple[Term, ...], commands: _Commands, about: dict[str, Any]
) -> None:
    """Write all files of the new run."""
    begin_run(run)
    masks, light = task.mask_rows(commands), _light_rows(task, compensated)
    for row in masks:
        log.info(str(row))
    for row in light:
        if row.quantity in _TOLD:
            log.info(str(row))
    record = [row._asdict() for row in masks]
    names = write_results(run, terms, compensated, {"precompensation": record})
    for name, rows in ((_MASKS, masks), (_LIGHT, light)):
        write_atomic(run.path(name), csv_table(rows).encode())
    aim = {AIM_DEPTHS: list(task.process.depths_m())}
    finish_run(run, [*names, _MASKS, _LIGHT], about={"precompensated": about, **aim})


def _light_rows(task: _Task, compensated: Design) -> list[_LightRow]:
    """Numbers of the plate as designed, and of the expected plates without and with compensation."""
    design, process = task.design, task.process
    nominal = predict(design, Process(process.levels), Variation()).rows
    without = predict(design, process, process.expected()).rows
    # As any later command predicts it, and not as the search did.
    made = compensated.process()
    found = predict(compensated, made, made.expected()).rows
    return [
        _LightRow(three[0]["colour"], three[0]["depth_m"], quantity, *(row[quantity] for row in three))
        for three in zip(*map(without_infinities, (nominal, without, found)), strict=True)
        for quantity in three[0]
        if quantity not in ("colour", "depth_m")
    ]
