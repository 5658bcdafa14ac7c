"""A study: one design and one process, and what is asked about the plates it makes."""

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from doedesign import __version__
from doedesign.runs.folder import Run, open_run
from doedesign.runtime.progress import meter
from doedesign.spec import LimitSpec
from doedesign.tolerancing.analysis import (
    PlateTable,
    Yield,
    good_plates,
    limit_from_text,
    statistics,
    table_of,
    worst_plate,
    yield_of,
)
from doedesign.tolerancing.budget import FACTORS, Budget, budget_of
from doedesign.tolerancing.cluster import evaluate_there
from doedesign.tolerancing.journal import Journal
from doedesign.tolerancing.pool import (
    DrawModel,
    Evaluate,
    OutOfModel,
    Rows,
    default_workers,
    evaluate_here,
    predicted_rows,
)
from doedesign.tolerancing.sensitivity import Change, Share, one_at_a_time, sobol
from fab.draws import (
    EXPECTED,
    NOMINAL,
    budget_keys,
    chosen_errors,
    corner_keys,
    normal_keys,
    one_at_a_time_keys,
    sobol_keys,
    sources_of,
    variation_at,
)
from fab.errors import InputError
from fab.files import sha256_bytes
from fab.levels import Levels
from fab.process import DEVIATIONS, Normal, Process, Variation, error_names

if TYPE_CHECKING:
    from doedesign.design.design import Design

FORMAT = "doedesign tolerance 1"
# Folders of studies know the prediction by the module in which it once was.
_EARLIER = {"doedesign.tolerancing.pool:predicted_rows": "doedesign.tolerance.pool:predicted_rows"}


@dataclass(frozen=True)
class Plates:
    """Some plates of a study.

    Attributes:
        table: their numbers.
        limits: what a good plate obeys.
    """

    table: PlateTable
    limits: tuple[LimitSpec, ...]

    @property
    def rows(self) -> list[dict[str, Any]]:
        """One dictionary per plate, colour and depth; a number that the row does not have is missing."""
        return [
            {"key": key, "colour": colour, "depth_m": depth}
            | {name: float(values[i, j]) for name, values in self.table.values.items() if not math.isnan(values[i, j])}
            for i, key in enumerate(self.table.keys)
            for j, (colour, depth) in enumerate(self.table.places)
            if self.table.within[i]
        ]

    @property
    def yield_(self) -> Yield | None:
        """Share of plates that obey every limit; None where there are no limits.

        Raises:
            InputError: a limit that speaks of no colour and depth of the design.
        """
        return yield_of(good_plates(self.table, self.limits)) if self.limits else None

    @property
    def worst(self) -> str:
        """Key of the worst plate."""
        return worst_plate(self.table, self.limits)

    def statistics(self) -> list[dict[str, Any]]:
        """Mean, spread and percentiles; see `doedesign.tolerancing.analysis.statistics`."""
        return statistics(self.table)


@dataclass(frozen=True)
class Study:
    """A design and a process, and the plates that were evaluated so far. Made by `study`.

    Every question evaluates what it needs and has not been evaluated before.

    Attributes:
        design: the design.
        process: the process.
        limits: what a good plate obeys.
        seed: seed of every draw.
        journal: the finished plates.
        evaluate: what is asked of every plate.
        run: how plates are handed to workers.
        quiet: whether no progress is shown.
    """

    design: "Design"
    process: Process
    limits: tuple[LimitSpec, ...]
    seed: int
    journal: Journal
    evaluate: Evaluate
    run: Callable[[DrawModel, Mapping[str, Variation]], Iterator[tuple[str, Rows]]]
    quiet: bool = False

    @property
    def plate_m(self) -> float:
        """Side of the square on which particles and pinholes fall: the whole grid of the DOE."""
        return max(self.design.camera.grid.extent_m)

    @property
    def sources(self) -> tuple[str, ...]:
        """Sources of error by which the plates differ."""
        return sources_of(self.process)

    def variation(self, key: str) -> Variation:
        """The plate a key stands for; see `fab.draws`.

        Raises:
            InputError: no such key.
        """
        return variation_at(self.process, self.seed, self.plate_m, key)

    def plates(self, keys: Sequence[str]) -> Plates:
        """Evaluate some plates.

        Raises:
            InputError: no such key, none of the plates can be evaluated (nor the plate as drawn or as expected, where
                they are asked for), or a folder that cannot be used.
        """
        keys = list(dict.fromkeys(keys))
        missing = [key for key in keys if key not in self.journal.finished]
        if missing:
            with self.journal.open():
                missing = [key for key in keys if key not in self.journal.finished]
                self._evaluate({key: self.variation(key) for key in missing}, len(keys))
        found = {key: self.journal.finished[key] for key in keys}
        self._require_some(keys)
        return Plates(table_of(found), self.limits)

    def beyond(self, keys: Sequence[str]) -> dict[str, str]:
        """Why some of these plates could not be evaluated, by key; they count as bad plates."""
        found = ((key, self.journal.finished.get(key)) for key in keys)
        return {key: one.reason for key, one in found if isinstance(one, OutOfModel)}

    def _require_some(self, keys: Sequence[str]) -> None:
        beyond = self.beyond(keys)
        needed = keys if len(beyond) == len(keys) else (NOMINAL, EXPECTED)
        for key in needed:
            if key in beyond:
                rule, cure = "must be within what can be evaluated", "Lower the means and sigmas of the errors."
                raise InputError(f"draw {key}", rule, f'"{beyond[key]}"', cure)

    def _evaluate(self, plates: Mapping[str, Variation], total: int) -> None:
        if not plates:
            return
        done = total - len(plates)
        progress = nullcontext() if self.quiet else meter("plates", total, done)
        model = DrawModel(self.evaluate, self.design, self.process)
        with progress as shown, closing(self.run(model, plates)) as finished:  # pyright: ignore[reportArgumentType]
            for count, (key, found) in enumerate(finished):
                if count == 0 and not isinstance(found, OutOfModel):
                    # A limit that speaks of none of the plates' rows is told now, and not after all of them.
                    good_plates(table_of({key: found}), self.limits)
                self.journal.add(key, found)
                done += 1
                if shown is not None:
                    shown.advance(done)

    def monte_carlo(self, draws: int = 100) -> Plates:
        """Plates as the process makes them, rare events included."""
        return self.plates(normal_keys(_at_least(1, "draws", draws)))

    def corners(self) -> Plates:
        """Plates with every error two standard deviations to one side or the other.

        Raises:
            InputError: nothing but rare events varies.
        """
        keys = corner_keys(self.process)
        if not keys:
            raise InputError("corners", "must have errors with a sigma", "rare events only", "Leave them out.")
        return self.plates(keys)

    def one_at_a_time(self) -> list[Change]:
        """What every error does alone, one standard deviation to either side."""
        return one_at_a_time(self.process, self.plates([EXPECTED, *one_at_a_time_keys(self.process)]).table)

    def sobol_keys(self, count: int) -> list[str]:
        """The plates that `sobol` needs."""
        if count < 2 or count & (count - 1):
            raise InputError("sobol", "must be a power of two, at least 2", count, "For example 64 or 256.")
        return sobol_keys(self.process, count)

    def sobol(self, count: int = 64) -> list[Share]:
        """Sobol indices of every source from `count` times (sources + 2) plates.

        Args:
            count: a power of two; 64 tell the important sources from the others.

        Raises:
            InputError: not a power of two.
        """
        return sobol(self.process, self.plates(self.sobol_keys(count)).table, count, self.seed)

    def budget_keys(
        self, what: str, wanted: float = 0.9, draws: int = 100, factors: Sequence[float] = FACTORS
    ) -> list[list[str]]:
        """The plates that `budget` needs, a list per factor."""
        if not self.limits:
            raise InputError("budget", "a yield needs limits", "none", "Add [[limit]] to the spec, or --limit.")
        if not 0 < wanted < 1:
            raise InputError("yield", "must lie between 0 and 1", wanted, "Write 90 % as 0.9.")
        if len(factors) < 2 or factors[0] != 0 or any(b <= a for a, b in pairwise(factors)):
            raise InputError("factors", "must grow from 0", tuple(factors), "For example 0, 0.5, 1, 2.")
        chosen_errors(self.process, what)
        return [budget_keys(what, [factor], _at_least(1, "draws", draws)) for factor in factors]

    def budget(self, what: str, wanted: float = 0.9, draws: int = 100, factors: Sequence[float] = FACTORS) -> Budget:
        """How large some errors may be for a wanted yield, all others as they are.

        The same draws are scaled by every factor, so that the yields differ by the factor alone.

        Args:
            what: a source ("overlay"), an error ("overlay_x"), or that of one mask ("overlay_x[3]").
            wanted: the wanted yield, between 0 and 1.
            draws: plates per factor.
            factors: growing, the first of them 0.

        Raises:
            InputError: no limits, nothing of that name varies, or a yield that is none.
        """
        keys = self.budget_keys(what, wanted, draws, factors)
        table = self.plates([key for some in keys for key in some]).table
        yields = [yield_of(good_plates(table.of(some), self.limits)) for some in keys]
        return budget_of(self.process, what, wanted, factors, yields)


def study(
    design: "str | Path | Run | Design",
    *,
    process: "str | Path | Process | None" = None,
    errors: Mapping[str, Any] | None = None,
    limits: Sequence[str | LimitSpec] | None = None,
    seed: int = 0,
    masks: Path | None = None,
    out: str | Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    evaluate: Evaluate = predicted_rows,
    quiet: bool = False,
) -> Study:
    """Begin a study.

    Args:
        design: a finished run or its folder, or a design as drawn.
        process: a process, or a TOML file with one; that of the run's spec by default.
        errors: errors to be changed, as in [process.errors] of a spec: `{"overlay_x": "0.5 um"}`; or SI numbers under
            names with a unit, `{"overlay_x_m": 0.5e-6}`.
        limits: what a good plate obeys, such as "zeroth_order <= 5 %"; the limits of the run's spec by default.
        seed: seed of every draw.
        masks: mask order of the run; `masks/NAME` if there is one.
        out: folder in which finished plates are kept and found again; without one they are kept in memory.
        workers: worker processes on this machine; as many as there are cores and memory for by default.
        scheduler: address of a Dask scheduler, whose workers are taken instead.
        evaluate: what is asked of every plate; the prediction of `doedesign.prediction` by default. A function at the
            top of a module, which returns rows as that does, and raises `InputError` for errors it cannot describe.
        quiet: show no progress.

    Raises:
        InputError: a run, process, error or limit that cannot be used, or a process without errors.
    """
    chosen, spec = _drawn_and_spec(design, masks)
    made = _process(process, spec, chosen)
    if errors:
        made = with_errors(made, errors)
    if chosen.edge_moves_m:
        from doedesign.build import with_edge_moves

        made = with_edge_moves(made, chosen.edge_moves_m)
    if not sources_of(made):
        raise InputError(
            "process.errors",
            "a tolerance study needs errors that vary",
            "none with a sigma above zero",
            'Add stock = "contact_aligner" to [process], or give a file with such a table (--process).',
        )
    if seed < 0:
        raise InputError("seed", "must not be negative", seed, "For example 0.")
    obeyed = tuple(limit_from_text(one) if isinstance(one, str) else one for one in limits or ())
    if limits is None and spec is not None:
        obeyed = spec.limits
    if out is not None and "<" in evaluate.__qualname__:
        rule = "must be a function at the top of a module, for a study on disk is known by its name"
        raise InputError("evaluate", rule, evaluate.__qualname__, "Move it there.")
    journal = Journal(None if out is None else Path(out), identity(chosen, made, seed, evaluate))
    return Study(
        chosen.bare(), made, obeyed, seed, journal, evaluate, _runner(chosen, workers, scheduler, quiet), quiet
    )


def _drawn_and_spec(design: "str | Path | Run | Design", masks: Path | None) -> "tuple[Design, Any]":
    if not isinstance(design, str | Path | Run):
        return design, design.spec
    from doedesign.runs.level_maps import open_design

    run = design if isinstance(design, Run) else open_run(Path(design))
    return open_design(run, masks), run.spec


def _process(given: "str | Path | Process | None", spec: Any, design: "Design") -> Process:
    from doedesign.build import resolve_process

    return resolve_process(given, design.levels, None if spec is None else spec.process)


def with_errors(process: Process, errors: Mapping[str, Any]) -> Process:
    """A process with some errors changed; see `study`.

    Raises:
        InputError: no such error, or a value it cannot have.
    """
    from pydantic import ValidationError

    from doedesign.spec import ErrorsSpec, explain, process_from_json, spec_error
    from doedesign.spec.values import FROM_TOML

    in_si = {name: value for name, value in errors.items() if name in DEVIATIONS and DEVIATIONS[name].unit != "1"}
    as_toml = {name: value for name, value in errors.items() if name not in in_si}
    try:
        read = ErrorsSpec.model_validate(as_toml, by_alias=True, by_name=False, context=FROM_TOML)
    except ValidationError as error:
        raise spec_error("errors", explain(error, as_toml, ErrorsSpec)) from None
    levels = {"levels": process.levels.count, "level_step_m": process.levels.step_m}
    whole = process_from_json({**levels, "errors": {**read.model_dump(), **in_si}}, "errors")
    spreads = dict(process.spreads)
    for key, given in whole.errors.given().items():
        names = error_names(process.masks, key)
        spreads |= dict(zip(names, given.spreads(len(names)), strict=True))
    return replace(process, spreads=spreads)


def _runner(design: "Design", workers: int | None, scheduler: str | None, quiet: bool) -> Any:
    if scheduler is not None:
        if workers is not None:
            cure = "Leave --workers out; workers are started where the cluster is."
            raise InputError("--workers", "a cluster brings its own workers", workers, cure)
        say = (lambda _: None) if quiet else (lambda text: print(text, file=sys.stderr, flush=True))
        return lambda model, draws: evaluate_there(model, draws, scheduler, say)
    ny, nx = design.level_map.level.shape
    count = default_workers(ny * nx) if workers is None else _at_least(1, "--workers", workers)
    return lambda model, draws: evaluate_here(model, draws, count)


def _at_least(least: int, name: str, value: int) -> int:
    if value < least:
        raise InputError(name, f"must be at least {least}", value, f"For example {max(least, 2)}.")
    return value


def _levels_record(levels: Levels) -> dict[str, Any]:
    """A staircase as JSON; depths that follow from the step stay unsaid, as they were before there were others."""
    depths = {} if levels.is_binary else {"depths_m": list(levels.depths_m)}
    return {"count": levels.count, "step_m": levels.step_m, **depths}


def identity(design: "Design", process: Process, seed: int, evaluate: Evaluate) -> dict[str, Any]:
    """Everything a plate's numbers depend on besides its key, as JSON.

    How many plates are looked at, and the limits they are judged by, are no part of it: a study may grow.
    """
    ny, nx = design.level_map.level.shape
    spreads: Mapping[str, Normal] = process.spreads
    name = f"{evaluate.__module__}:{evaluate.__qualname__}"
    return {
        "format": FORMAT,
        "version": __version__,
        "design": {
            "name": design.name,
            "level_sha256": sha256_bytes(design.level_map.level.tobytes()),
            "shape": [ny, nx],
            "levels": _levels_record(design.levels),
            "camera": asdict(design.camera),
            "depths_m": ["inf" if math.isinf(depth) else depth for depth in (*design.near_m, *design.far_m)],
            "near": len(design.near_m),
        },
        "process": {
            "order": list(process.order),
            "errors": {name: spread._asdict() for name, spread in sorted(spreads.items())},
            "defects": asdict(process.defects),
            "die_m": list(process.die_m),
            "wafer_radius_m": process.wafer_radius_m,
        },
        "seed": seed,
        "evaluate": _EARLIER.get(name, name),
    }
