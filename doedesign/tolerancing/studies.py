"""A study: one design and one process, and the draws that were evaluated so far."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from itertools import pairwise
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from doedesign import __version__
from doedesign.build import resolve_process, with_edge_moves
from doedesign.runs.folder import Run
from doedesign.runs.journal import Journal
from doedesign.runs.level_maps import open_design
from doedesign.runtime.cluster import evaluate_there
from doedesign.runtime.pool import default_workers, evaluate_here
from doedesign.runtime.progress import meter
from doedesign.spec import LimitSpec
from doedesign.tolerancing.analysis import Sample, limit_from_text, sample_of, yield_of
from doedesign.tolerancing.budget import FACTORS, Budget, budget_of
from doedesign.tolerancing.journal import DrawLines
from doedesign.tolerancing.pool import BYTES_PER_CELL, DrawModel, Evaluate, OutOfModel, predicted_rows
from doedesign.tolerancing.sensitivity import Effect, VarianceShare, one_at_a_time, sobol
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
from fab.files import path_of, sha256_bytes
from fab.process import DEVIATIONS, Process, Variation, error_names
from fab.units import is_whole, require_kind
from sim.camera import Camera

if TYPE_CHECKING:
    from doedesign.design.design import Design

FORMAT = "doedesign tolerance 1"
# Folders of studies know the prediction by the module in which it once was.
_EARLIER = {"doedesign.tolerancing.pool:predicted_rows": "doedesign.tolerance.pool:predicted_rows"}
# Draws times cells below which a study in memory is evaluated in this process: a worker starts in five seconds or so.
_FEW_CELLS = 3_000_000


@dataclass(frozen=True)
class Study:
    """A design and a process, and the draws that were evaluated so far. Made by `study`.

    Every question evaluates what it needs and has not been evaluated before: each draw by `evaluate`, all of them by
    `run`, here or on a cluster. `quiet` shows no progress.
    """

    design: "Design"
    process: Process
    limits: tuple[LimitSpec, ...]
    seed: int
    journal: Journal
    evaluate: Evaluate
    run: Callable[[DrawModel, Mapping[str, Variation]], Iterator[tuple[str, Any]]]
    quiet: bool = False

    @property
    def sources(self) -> tuple[str, ...]:
        """Sources of error by which the draws differ."""
        return sources_of(self.process)

    def variation(self, key: str) -> Variation:
        """The errors of a draw; see `fab.draws`.

        Raises:
            InputError: no such key.
        """
        # Particles and pinholes fall on the whole grid of the DOE.
        return variation_at(self.process, self.seed, max(self.design.camera.grid.extent_m), key)

    def sample(self, keys: Sequence[str]) -> Sample:
        """Evaluate some draws.

        Raises:
            InputError: no such key, none of the draws can be evaluated (nor the nominal or the expected one, where
                they are asked for), a limit that concerns none of their rows, or a folder that cannot be used.
        """
        keys = list(dict.fromkeys(keys))
        if not all(key in self.journal.finished for key in keys):
            with self.journal.open():
                missing = [key for key in keys if key not in self.journal.finished]
                self._evaluate({key: self.variation(key) for key in missing}, len(keys))
        beyond = self.beyond(keys)
        for key in keys if len(beyond) == len(keys) else (NOMINAL, EXPECTED):
            if key in beyond:
                rule, cure = "must be within what can be evaluated", "Lower the means and sigmas of the errors."
                raise InputError(f"draw {key}", rule, f'"{beyond[key]}"', cure)
        try:
            found = sample_of({key: self.journal.finished[key] for key in keys}, self.limits)
        except ValueError as error:
            if self.journal.folder is None:
                raise
            path = self.journal.folder / DrawLines.file
            cure = f"Remove {path} to compute all draws again."
            raise InputError(str(path), "all draws must have the same rows", f'"{error}"', cure) from error
        # Of draws that were all there, too, a limit that concerns none of the rows is refused before it is counted on.
        _ = found.good
        return found

    def beyond(self, keys: Sequence[str]) -> dict[str, str]:
        """Why some of these draws could not be evaluated, by key; they count as bad."""
        found = ((key, self.journal.finished.get(key)) for key in keys)
        return {key: one.reason for key, one in found if isinstance(one, OutOfModel)}

    def _evaluate(self, draws: Mapping[str, Variation], total: int) -> None:
        if not draws:
            return
        progress = nullcontext() if self.quiet else meter("plates", total, total - len(draws))
        model = DrawModel(self.evaluate, self.design, self.process)
        with progress as shown, closing(self.run(model, draws)) as finished:  # pyright: ignore[reportArgumentType]
            for count, (key, found) in enumerate(finished, 1):
                if count == 1 and not isinstance(found, OutOfModel):
                    # A limit that concerns none of the rows is refused now, and not after all draws.
                    _ = sample_of({key: found}, self.limits).good
                self.journal.add(key, found)
                if shown is not None:
                    shown.advance(total - len(draws) + count)

    def monte_carlo(self, draws: int = 100) -> Sample:
        """DOEs as the process makes them, rare events included."""
        return self.sample(normal_keys(at_least_one("draws", draws)))

    def corner_keys(self) -> list[str]:
        """Keys of `corners`; an InputError where nothing but rare events varies."""
        keys = corner_keys(self.process)
        if not keys:
            raise InputError("corners", "must have errors with a sigma", "rare events only", "Leave them out.")
        return keys

    def corners(self) -> Sample:
        """DOEs with every error two standard deviations to one side or the other.

        Raises:
            InputError: nothing but rare events varies.
        """
        return self.sample(self.corner_keys())

    def one_at_a_time(self) -> list[Effect]:
        """Effect of every error alone, one standard deviation to either side."""
        return one_at_a_time(self.process, self.sample([EXPECTED, *one_at_a_time_keys(self.process)]))

    def sobol_keys(self, count: int) -> list[str]:
        """The draws that `sobol` needs."""
        if count < 2 or count & (count - 1):
            raise InputError("sobol", "must be a power of two, at least 2", count, "For example 64 or 256.")
        return sobol_keys(self.process, count)

    def sobol(self, count: int = 64) -> list[VarianceShare]:
        """Sobol indices of every source from `count` times (sources + 2) draws; 64 find the important sources.

        Raises:
            InputError: `count` is no power of two.
        """
        return sobol(self.process, self.sample(self.sobol_keys(count)), count, self.seed)

    def budget_keys(
        self, what: str, wanted: float = 0.9, draws: int = 100, factors: Sequence[float] = FACTORS
    ) -> list[list[str]]:
        """The draws that `budget` needs, a list per factor."""
        if not self.limits:
            raise InputError("budget", "a yield needs limits", "none", 'Give limits, such as "strehl >= 0.8".')
        if not 0 < wanted < 1:
            raise InputError("yield", "must lie between 0 and 1", wanted, "Write 90 % as 0.9.")
        if len(factors) < 2 or factors[0] != 0 or any(b <= a for a, b in pairwise(factors)):
            raise InputError("factors", "must grow from 0", tuple(factors), "For example 0, 0.5, 1, 2.")
        chosen_errors(self.process, what)
        return [budget_keys(what, [factor], at_least_one("draws", draws)) for factor in factors]

    def budget(self, what: str, wanted: float = 0.9, draws: int = 100, factors: Sequence[float] = FACTORS) -> Budget:
        """Find how large some errors may be for a wanted yield, all others as they are.

        The same draws are scaled by every factor, so that the yields differ by the factor alone.

        Args:
            what: a source ("overlay"), an error ("overlay_x"), or that of one mask ("overlay_x[3]").
            wanted: the wanted yield, between 0 and 1.
            draws: draws per factor.
            factors: growing, the first of them 0.

        Raises:
            InputError: no limits, nothing of that name varies, or a yield that is none.
        """
        keys = self.budget_keys(what, wanted, draws, factors)
        sample = self.sample([key for some in keys for key in some])
        yields = [yield_of(sample.of(some).good) for some in keys]
        return budget_of(self.process, what, wanted, factors, yields)


def study(
    design: "Design | Run | str | Path",
    *,
    process: "Process | str | Path | None" = None,
    errors: Mapping[str, Any] | None = None,
    limits: Sequence[str | LimitSpec] | None = None,
    seed: int = 0,
    masks: str | Path | None = None,
    out: str | Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    evaluate: Evaluate = predicted_rows,
    quiet: bool = False,
) -> Study:
    """Begin a study, of which questions can be asked one by one; `tolerance` asks the usual ones.

    Args:
        design: a design, a finished run or its folder.
        process: a process, the name of a stock process ("contact_aligner") or a TOML file; that of the design's spec
            by default.
        errors: errors to be changed, as text with a unit, `{"overlay_x": "0.5 um"}`, or as SI numbers under names with
            a unit, `{"overlay_x_m": 0.5e-6}`; a standard deviation, or `{"mean": ..., "sigma": ...}`.
        limits: what a good DOE obeys, such as "zeroth_order <= 5 %"; the limits of the design's spec by default.
        seed: seed of every draw.
        masks: mask order of the run; `masks/NAME` if there is one.
        out: folder in which finished draws are kept and found again; without one they are kept in memory.
        workers: worker processes on this machine; as many as there are cores and memory for by default. Their numbers
            do not depend on how many there are. Without this and `out`, few draws of a small design are evaluated in
            this process, whose numbers may differ in the last digits of single precision.
        scheduler: address of a Dask scheduler, whose workers are taken instead.
        evaluate: evaluation of a draw, by default the prediction of `doedesign.prediction`: a function that returns
            rows as that does, and raises `InputError` for errors it cannot describe.
        quiet: show no progress.

    Raises:
        InputError: a design, process, error or limit that cannot be used, or a process without errors.
    """
    design = open_design(design, masks)
    made = resolve_process(process, design.levels, design.spec and design.spec.process)
    # Errors are those of the lab; the design sees them through its masks.
    made = with_edge_moves(made if errors is None else _with_errors(made, errors), design.edge_moves_m)
    if not sources_of(made):
        rule = "a tolerance study needs errors that vary"
        cure = 'Give a process with errors, such as "contact_aligner".'
        raise InputError("process", rule, "none with a sigma above zero", cure)
    if not is_whole(seed, 0):
        raise InputError("seed", "must not be negative, a whole number", repr(seed), "For example 0.")
    if not hasattr(evaluate, "__qualname__"):  # by which its draws are known
        raise InputError("evaluate", "must be a function", type(evaluate).__name__, "Write one with def.")
    if out is not None and "<" in evaluate.__qualname__:
        rule = "must be a function at the top of a module, for a study on disk is known by its name"
        raise InputError("evaluate", rule, evaluate.__qualname__, "Move it there.")
    given: Any = limits if limits is not None else design.spec.limits if design.spec else ()
    given = given if isinstance(given, tuple | list) else [given]
    if not all(isinstance(one, str | LimitSpec) for one in given):
        raise InputError("limits", "must be several conditions, as text", repr(given), 'For example ["strehl >= 0.6"].')
    obeyed = tuple(limit_from_text(one) if isinstance(one, str) else one for one in given)
    bare = _for_workers(design)
    journal = Journal(None if out is None else path_of(out, "out"), _identity(bare, made, seed, evaluate), DrawLines())
    run = _runner(design, workers, scheduler, out is None)
    return Study(bare, made, obeyed, seed, journal, evaluate, run, quiet)


def _with_errors(process: Process, errors: Mapping[str, Any]) -> Process:
    """A process with some errors changed as in `study`."""
    from doedesign.spec import ErrorsSpec, process_from_json, validated

    require_kind("errors", errors, Mapping, 'For example {"overlay_x": "0.5 um"}.')
    _require_units(errors)
    in_si = {name: value for name, value in errors.items() if name in DEVIATIONS and DEVIATIONS[name].unit != "1"}
    read = validated(ErrorsSpec, {name: value for name, value in errors.items() if name not in in_si}, "errors")
    levels = {"levels": process.levels.count, "level_step_m": process.levels.step_m}
    whole = process_from_json({**levels, "errors": {**read.model_dump(), **in_si}}, "errors")
    spreads = dict(process.spreads)
    for key, given in whole.errors.given().items():
        names = error_names(process.masks, key)
        spreads |= dict(zip(names, given.spreads(len(names)), strict=True))
    return replace(process, spreads=spreads)


def _require_units(errors: Mapping[str, Any]) -> None:
    """Raise an `InputError` for a bare number under the name of an error that has a unit."""
    for key, value in errors.items():
        unit = next((unit for unit in ("m", "rad") if f"{key}_{unit}" in DEVIATIONS), None)
        parts = tuple(value.values()) if isinstance(value, Mapping) else value
        parts = parts if isinstance(parts, list | tuple) else (parts,)
        if unit is None or not any(isinstance(part, Real) for part in parts):
            continue
        name, example = f"{key}_{unit}", '"0.5 um"' if unit == "m" else '"2 deg"'
        rule = f"must be text with a unit such as {example}; a number goes by the name `{name}`"
        alike = all(isinstance(part, Real) for part in parts)
        cure = f'Write {{"{name}": {value}}}, or give a unit.' if alike else "Give every number a unit."
        raise InputError(f"errors: {key}", rule, value, cure)


def _runner(design: "Design", workers: int | None, scheduler: str | None, in_memory: bool) -> Any:
    if scheduler is not None:
        if workers is not None:
            cure = "Leave the number of workers out; they are started where the cluster is."
            raise InputError("workers", "a cluster brings its own workers", workers, cure)
        return partial(evaluate_there, address=scheduler)
    cells = design.level_map.level.size
    if workers is not None:
        return partial(evaluate_here, workers=at_least_one("workers", workers))
    several = default_workers(cells * BYTES_PER_CELL)

    def run(model: DrawModel, draws: Mapping[str, Variation]) -> Iterator[tuple[str, Any]]:
        return evaluate_here(model, draws, 0 if in_memory and len(draws) * cells < _FEW_CELLS else several)

    return run


def at_least_one(name: str, value: int) -> int:
    """Return a whole number of at least 1, the value of `name`; an InputError for anything else."""
    if not is_whole(value, 1):
        raise InputError(name, "must be at least 1, a whole number", repr(value), "For example 2.")
    return value


def _given(camera: Camera) -> dict[str, Any]:
    """A camera without what is as it was before there was a choice, so that earlier studies go on."""
    usual = {field.name: field.default for field in fields(Camera) if field.name not in ("fill", "defocus_m")}
    given = {name: value for name, value in asdict(camera).items() if name not in usual or value != usual[name]}
    del given["aperture"]
    return {**_recorded(given), "aperture_m": camera.opening.record()}


def _recorded(value: Any) -> Any:
    """A value for JSON, which has neither infinity (no lens, a far source) nor pictures (a measured beam)."""
    if isinstance(value, Mapping):
        return {name: _recorded(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_recorded(one) for one in value]
    if isinstance(value, np.ndarray):
        return {"shape": list(value.shape), "sha256": sha256_bytes(np.ascontiguousarray(value, np.float64).tobytes())}
    return "inf" if isinstance(value, float) and math.isinf(value) else value


def _for_workers(design: "Design") -> "Design":
    """A design as small as it can be sent with every draw, and with the pictures of its areas read.

    Raises:
        InputError: a picture that is missing or cannot be drawn.
    """
    bare = design.bare()
    if bare.spec is None or not any(area.picture or area.phase_picture for area in bare.spec.areas):
        return bare
    from doedesign.areas.shape import targets_of_design

    return replace(bare, area_targets=targets_of_design(bare))


def _target(design: "Design") -> dict[str, Any]:
    """Record of what light should make: the tables of the spec and digests of pictures; empty for nothing."""
    spec = design.spec
    if spec is None or not spec.aims:
        return {}
    tables = [("focus", spec.focus), ("spots", spec.spots), *(("area", area) for area in spec.areas)]
    asked = [{name: one.model_dump(mode="json", exclude_defaults=True)} for name, one in tables if one is not None]
    arrays = [array for one in design.area_targets for array in (one.value, one.phase) if array is not None]
    drawn = any(area.picture or area.phase_picture for area in spec.areas)
    pixels = {"pixels_sha256": sha256_bytes(b"".join(array.tobytes() for array in arrays))} if drawn else {}
    return {"target": {"tables": asked, **pixels}}


def _identity(design: "Design", process: Process, seed: int, evaluate: Evaluate) -> dict[str, Any]:
    """Everything a draw's numbers depend on besides its key, as JSON.

    How many draws there are, and the limits they are judged by, are no part of it: a study may grow.
    """
    level, levels = design.level_map.level, design.levels
    # Depths that follow from the step are left out, as they were before there were others.
    depths = {} if levels.is_binary else {"depths_m": list(levels.depths_m)}
    aim = {} if design.aim is None else {"aim_depths_m": list(design.aim.levels.depths_m)}
    name = f"{evaluate.__module__}:{evaluate.__qualname__}"
    return {
        "format": FORMAT,
        "version": __version__,
        "design": {
            "name": design.name,
            "level_sha256": sha256_bytes(level.tobytes()),
            "shape": list(level.shape),
            "levels": {"count": levels.count, "step_m": levels.step_m, **depths, **aim},
            "camera": _given(design.camera),
            "depths_m": ["inf" if math.isinf(depth) else depth for depth in (*design.near_m, *design.far_m)],
            "near": len(design.near_m),
        },
        "process": {
            "order": list(process.order),
            "errors": {name: spread._asdict() for name, spread in sorted(process.spreads.items())},
            "defects": asdict(process.defects),
            "die_m": list(process.die_m),
            "wafer_radius_m": process.wafer_radius_m,
        },
        "seed": seed,
        "evaluate": _EARLIER.get(name, name),
        # Without it where there is none, so that earlier studies go on; earlier ones of spots had no numbers of spots.
        **_target(design),
    }
