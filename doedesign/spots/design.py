"""From a spec with spots to a design: search, weighted Gerchberg-Saxton with levels, exchange of cells."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from doedesign.build import camera_from_spec, levels_from_spec, process_from_spec
from doedesign.design.design import Design
from doedesign.runtime.progress import meter
from doedesign.spec import Spec
from doedesign.spec.targets.arrangements import grid_orders
from doedesign.spec.targets.spots import MOST_CELLS, SpotsSpec, places_of
from doedesign.spots.exchange import exchange
from doedesign.spots.orders import OrderTable, order_table
from doedesign.spots.plates import SpotPlates, plates_of
from doedesign.spots.problem import SharedProblem, SpotProblem
from doedesign.spots.search import search_phases, search_points
from doedesign.spots.spots import Spots, shares_of
from doedesign.spots.superposition import SpotLight, Staircase, WaveSet
from fab.draws import varying
from fab.errors import InputError
from fab.grid import Grid
from fab.level_map import LevelMap
from fab.levels import Levels
from sim.aperture import open_cells
from sim.camera import Camera
from sim.optic import CellOptic

# Up to so many levels, phases are searched as the levels have them.
_FEW_LEVELS = 4
_TRIED, _TRIAL_STEPS = 4, 30  # candidates of the search, and steps with each before one is chosen
_SWEEPS, _OFFERS = 100, 2**20  # over such a cell: at least, and as many as make so many offers
_HEATS = (3e-5, 2.5e-4)  # of exchanges of which the best is taken
# The same for several colours, whose plane waves leave spots less equal: heat loses more light than it finds.
_SHARED_HEATS, _SHARED_OFFERS, _SHARED_TRIED = (0.0, 3e-6), 2**22, 12
_NARROWEST = 32  # cells of a row at which random starts of an exchange begin
# For plates as fabricated: how many are looked at to choose starts, and to exchange cells; starts tried, and finished;
# offers to the cells of each of either; heat; starts that are raised by every number of levels.
_FEW_PLATES, _PLATES, _TRIED_ON_PLATES, _FINISHED, _TRIAL_OFFERS, _LAST_OFFERS = 16, 64, 16, 2, 2**18, 2**21
_PLATE_HEAT, _MOST_RAISED = 1e-4, 400
_ROW_STARTS, _ROW_SWEEPS, _ROW_HEAT, _FINER_HEAT = 200, 1000, 0.05, 1e-4


class SpotState(NamedTuple):
    """Everything a step changes: the plane waves, the best ones so far with their merit, and the steps done."""

    waves: WaveSet
    best: WaveSet
    merit: float
    step: int

    @property
    def arrays(self) -> list[Float[np.ndarray, "*a"]]:
        """Arrays that a checkpoint keeps."""
        return [*self.waves, *self.best, np.array([self.merit])]


@dataclass(frozen=True, eq=False)
class SpotTask:
    """The spots of a spec, and the cells that are free: those of the DOE, or of one unit cell.

    Attributes:
        spec: the spec.
        table: its spots.
        camera: its optics.
        levels: its staircase.
        problem: what is designed.
    """

    spec: Spec
    table: SpotsSpec
    camera: Camera
    levels: Levels
    problem: SpotProblem | SharedProblem

    @classmethod
    def from_spec(cls, spec: Spec) -> "SpotTask":
        """Prepare the task of a spec that has spots.

        Raises:
            InputError: spots that stay equal on plates of a process without errors.
        """
        assert spec.spots is not None
        if spec.spots.uniformity_as_fabricated and not varying(process_from_spec(spec.process)):
            key, cure = "spots.uniformity_as_fabricated", 'For example process.stock = "contact_aligner".'
            raise InputError(key, "plates must differ", "a process without errors", cure)
        camera, levels = camera_from_spec(spec), levels_from_spec(spec.process)
        parts = [_problem_of(spec, camera, levels, colour) for colour in colour_numbers(spec.spots, camera)]
        return cls(spec, spec.spots, camera, levels, parts[0] if len(parts) == 1 else SharedProblem.of(parts))

    @property
    def periodic(self) -> bool:
        """Whether a unit cell is repeated."""
        return self.table.period_m is not None

    def initial_state(self) -> SpotState:
        """The most promising of the phases that a search finds, tried with levels on all cells, or the given ones."""
        problem = self.problem
        if problem.spots.phases is not None:
            waves = WaveSet(np.sqrt(problem.spots.shares), problem.spots.phases)
            return SpotState(waves, waves, -np.inf, 0)
        looked_at = self._staircases
        if isinstance(problem, SpotProblem) and self.levels.count <= _FEW_LEVELS:
            looked_at = (problem.staircase,)
        starts = [*self._found(_TRIED, looked_at), *self._crossed_rows()]
        tried = [self._after(SpotState(waves, waves, -np.inf, 0), _TRIAL_STEPS) for waves in starts]
        return max(tried, key=lambda state: state.merit)._replace(step=0)

    @property
    def _staircases(self) -> tuple[Staircase, ...]:
        """The levels in the light of several colours, which no cell can do without; none for one colour."""
        return tuple(one.staircase for one in self.problem.parts) if isinstance(self.problem, SharedProblem) else ()

    def _found(self, keep: int, staircases: Sequence[Staircase]) -> list[WaveSet]:
        """The best phases that a search finds, as these levels have them."""
        spots, table, seed = self.problem.spots, self.table, self.spec.optimize.seed
        points = search_points(spots, seed, self.problem.grid.extent_m)
        return search_phases(
            spots, points, starts=table.starts, seed=seed, uniformity=table.uniformity, staircases=staircases, keep=keep
        ).waves

    def _crossed_rows(self) -> list[WaveSet]:
        """For a grid of equal spots in one colour, the sums of the best phases of a row and of a column.

        The phase of such a plate is the sum of two that each part light along one axis, and its efficiency their
        product: of nine by nine more than a search of all phases finds.
        """
        problem, table = self.problem, self.table
        if isinstance(problem, SharedProblem) or table.arrangement != "grid" or problem.spots.lattice_per_m is None:
            return []
        assert table.count is not None
        assert problem.spots.orders is not None
        if min(table.count) == 1 or table.weights:
            return []
        seed, rows = self.spec.optimize.seed, []
        for axis, count in enumerate(reversed(table.count)):
            orders = grid_orders((1, count) if axis == 0 else (count, 1))
            waves = orders * np.array(problem.spots.lattice_per_m)
            row = Spots(waves, shares_of((), count), orders, problem.spots.lattice_per_m)
            points = search_points(row, seed, problem.grid.extent_m)
            found = search_phases(row, points, starts=table.starts, seed=seed, uniformity=table.uniformity, keep=2)
            rows.append(found.waves)
        return [
            WaveSet(np.outer(y.weights, x.weights).ravel(), np.add.outer(y.phases, x.phases).ravel())
            for y in rows[0]
            for x in rows[1]
        ]

    @property
    def template(self) -> list[np.ndarray]:
        """Arrays of the shapes and kinds of a checkpoint's."""
        return [*[np.zeros(self.problem.spots.count)] * 4, np.zeros(1)]

    def state_of(self, arrays: list[np.ndarray], step: int) -> SpotState:
        """The state of a checkpoint."""
        return SpotState(WaveSet(*arrays[:2]), WaveSet(*arrays[2:4]), float(arrays[4][0]), step)

    @property
    def begins(self) -> str:
        """How a design begins, in words."""
        if self.problem.spots.phases is not None:
            return f"starting from the phases of {self.problem.spots.count} spots"
        return f"searching phases of {self.problem.spots.count} spots, {self.table.starts} starts"

    def _after(self, state: SpotState, steps: int) -> SpotState:
        for _ in range(steps):
            state, _ = self.step(state)
        return state

    def step(self, state: SpotState) -> tuple[SpotState, SpotLight]:
        """One step, and the light before it."""
        waves, light = self.problem.step(state.waves)
        merit = light.merit(self.table.uniformity)
        best = (state.waves, merit) if merit > state.merit else (state.best, state.merit)
        return SpotState(waves, *best, state.step + 1), light

    def steps(self, state: SpotState) -> Iterator[tuple[SpotState, dict[str, Any]]]:
        """Do the remaining steps one by one; yields the state, and the line of the history."""
        names = ["efficiency", "uniformity_error"]
        while state.step < self.spec.optimize.steps:
            step = state.step
            state, light = self.step(state)
            loss = 1 - light.merit(self.table.uniformity)
            yield state, {"step": step, "loss": loss, "terms": [float(part) for part in light], "names": names}

    def finished(self, state: SpotState, history: list[dict[str, Any]]) -> Design:
        """The design of the best plane waves; the cells of a unit cell are exchanged, and it is repeated."""
        level = self.problem.level(state.best)
        if self.periodic:
            fabricated = self.table.uniformity_as_fabricated > 0
            level = self._kept_equal(level) if fabricated else self._exchanged(level)
            level = repeated(level, self.camera.grid)
        spec, far_m = self.spec, self.spec.scene.far_m
        level_map = LevelMap(level, self.levels, self.camera.grid, spec.doe.relief, spec.name)
        return Design(level_map, self.camera, (), far_m, spec=spec, history=tuple(history))

    def _exchanged(self, level: UInt8[np.ndarray, "y x"]) -> UInt8[np.ndarray, "y x"]:
        problem, seed, uniformity = self.problem, self.spec.optimize.seed, self.table.uniformity
        if level.size > MOST_CELLS:
            return level

        def merit(one: UInt8[np.ndarray, "y x"]) -> float:
            return problem.light(one).merit(uniformity)

        def exchanged(start: UInt8[np.ndarray, "y x"], sweeps: int, heats: Sequence[float]) -> UInt8[np.ndarray, "y x"]:
            # Merit counts uniformity as often as its weight says, and so does heat. An exchange has a smooth measure of
            # its own of how equal spots are, so it may spoil the one that is asked for.
            how: Any = {"sweeps": sweeps, "seed": seed, "uniformity": uniformity}
            found = [exchange(problem, start, heat=heat * (1 + uniformity), **how) for heat in heats]
            return max((start, *found), key=merit)

        if isinstance(problem, SharedProblem):
            # How much an exchange gains cannot be seen before: of three by three orders from 0.4 to 14 points.
            others = [SpotState(waves, waves, -np.inf, 0) for waves in self._found(_SHARED_TRIED, self._staircases)]
            starts = [level, *(problem.level(self._after(state, _TRIAL_STEPS).best) for state in others)]
            few, many = max(1, _TRIAL_OFFERS // level.size), max(_SWEEPS, _SHARED_OFFERS // level.size)
            found = _best_of(
                starts,
                lambda start: exchanged(start, few, (0.0,)),
                lambda start: exchanged(start, many, _SHARED_HEATS),
                len(_SHARED_HEATS) * many // few,
                merit,
            )
        else:
            found = exchanged(level, max(_SWEEPS, _OFFERS // level.size), _HEATS)
        row = [self._row()] if 1 in level.shape and self.levels.count <= _FEW_LEVELS else []
        return max((found, *row), key=merit)

    def plates(self, count: int) -> SpotPlates:
        """So many plates with the errors of the spec's process, in every colour that has spots."""
        problem, camera, process = self.problem, self.camera, process_from_spec(self.spec.process)
        first = problem.parts[0] if isinstance(problem, SharedProblem) else problem
        colours = colour_numbers(self.table, camera)
        rates = [camera.waves_per_metre(wavelength_of(camera, colour)) for colour in colours]
        return SpotPlates.of(first, process, rates, plates_of(process, count, self.spec.optimize.seed))

    def _kept_equal(self, level: UInt8[np.ndarray, "y x"]) -> UInt8[np.ndarray, "y x"]:
        """A unit cell whose spots stay equal on plates as fabricated.

        Starts are the level map of before and those of the best phases that the search finds, each raised by the number
        of levels that suits the plates best: what light does is the same, but not where walls of which masks lie.
        """
        uniformity, seed, size = self.table.uniformity_as_fabricated, self.spec.optimize.seed, level.size
        few, plates = self.plates(_FEW_PLATES), self.plates(_PLATES)
        searched = self._found(_MOST_RAISED, self._staircases)
        starts = [max(self._raised(waves), key=lambda one: few.merit(one, uniformity)) for waves in searched]
        starts = sorted(starts, key=lambda one: -few.merit(one, uniformity))[:_TRIED_ON_PLATES]

        def exchanged(level: UInt8[np.ndarray, "y x"], offers: int) -> UInt8[np.ndarray, "y x"]:
            sweeps, heat = max(1, offers // size), _PLATE_HEAT * (1 + uniformity)
            return plates.exchanged(level, sweeps=sweeps, seed=seed, uniformity=uniformity, heat=heat)

        return _best_of(
            (level, *starts),
            lambda start: exchanged(start, _TRIAL_OFFERS),
            lambda start: exchanged(start, _LAST_OFFERS),
            _LAST_OFFERS // _TRIAL_OFFERS,
            lambda one: plates.merit(one, uniformity),
        )

    def _raised(self, waves: WaveSet) -> list[UInt8[np.ndarray, "y x"]]:
        """Level maps of a sum of plane waves, raised by every number of levels, each colour by its own phase."""
        turns: Any = 2 * np.pi * np.arange(self.levels.count) / self.levels.count
        if isinstance(self.problem, SharedProblem):
            turns = np.angle(self.problem.level_light)
        return [self.problem.level(waves._replace(phases=waves.phases + turn)) for turn in turns]

    def _row(self) -> UInt8[np.ndarray, "y x"]:
        """A row of few levels, from random ones by exchange, first in wide cells and then in narrower ones."""
        problem, seed, uniformity = self.problem, self.spec.optimize.seed, self.table.uniformity
        finer: list[SpotProblem | SharedProblem] = [problem]
        while max(shape := finer[-1].grid.shape) % 2 == 0 and max(shape) // 2 >= _NARROWEST:
            finer.append(finer[-1].coarser())
        finer.reverse()
        rng, found = np.random.default_rng((seed, 0xD077)), []
        for start in range(_ROW_STARTS):
            level = rng.integers(0, self.levels.count, finer[0].grid.shape).astype(np.uint8)
            level = exchange(finer[0], level, sweeps=_ROW_SWEEPS, seed=start, uniformity=uniformity, heat=_ROW_HEAT)
            found.append((finer[0].light(level).merit(uniformity), start, level))
        found.sort(key=lambda each: (-each[0], each[1]))
        refined = [self._refined(level, finer[1:]) for _, _, level in found[: _ROW_STARTS // 10]]
        return max(refined, key=lambda level: problem.light(level).merit(uniformity))

    def _refined(
        self, level: UInt8[np.ndarray, "y x"], finer: list[SpotProblem | SharedProblem]
    ) -> UInt8[np.ndarray, "y x"]:
        """A row in narrower and narrower cells."""
        seed, uniformity = self.spec.optimize.seed, self.table.uniformity
        for one in finer:
            halves = np.repeat(level, 2, axis=int(np.argmax(level.shape)))
            level = exchange(one, halves, sweeps=_ROW_SWEEPS // 2, seed=seed, uniformity=uniformity, heat=_FINER_HEAT)
        return level


def _best_of(
    starts: Sequence[UInt8[np.ndarray, "y x"]],
    tried: Callable[[Any], UInt8[np.ndarray, "y x"]],
    finished: Callable[[Any], UInt8[np.ndarray, "y x"]],
    longer: int,
    merit: Callable[[Any], float],
) -> UInt8[np.ndarray, "y x"]:
    """The best level map of some starts, of which all are tried and the most promising are finished.

    Args:
        starts: level maps.
        tried: exchanges some cells of one.
        finished: exchanges many.
        longer: how many times as long that takes.
        merit: what is to be large.
    """
    done, found = 0, []
    with meter("exchanging cells", len(starts) + _FINISHED * longer) as progress:
        for start in starts:
            found.append(tried(start))
            progress.advance(done := done + 1)
        found.sort(key=lambda one: -merit(one))
        for number, one in enumerate(found[:_FINISHED]):
            found[number] = finished(one)
            progress.advance(done := done + longer)
    return max(found, key=merit)


def _problem_of(spec: Spec, camera: Camera, levels: Levels, colour: int) -> SpotProblem:
    """The spots of a spec in one of its colours."""
    assert spec.spots is not None
    wavelength_m, spots = wavelength_of(camera, colour), spots_from_spec(spec.spots, camera, colour)
    staircase = Staircase.of(2 * np.pi * camera.waves_per_metre(wavelength_m) * levels.heights_m())
    grid, coverage = camera.grid, open_cells(camera.grid, camera.opening)
    if camera.beam is not None:
        coverage = (coverage * camera.irradiance(wavelength_m)).astype(np.float32)
    if spec.spots.period_m is not None:
        grid = unit_cell(spec.spots, camera)
        coverage = np.ones(grid.shape, np.float32)
        # The first cell begins where the DOE does.
        y_m, x_m = ((own - whole) / 2 * grid.pitch_m for own, whole in zip(grid.shape, spec.doe.shape, strict=True))
        spots = spots.about((y_m, x_m))
    return SpotProblem.on(grid, coverage, spots, staircase)


def colour_numbers(table: SpotsSpec, camera: Camera) -> tuple[int, ...]:
    """Which of a camera's colours should get the spots."""
    names = [colour.name for colour in camera.colours]
    return tuple(map(names.index, table.colours)) or (0,)


def wavelength_of(camera: Camera, colour: int) -> float:
    """First wavelength of a colour, metres: the one that spots are designed and looked at for."""
    return next(line.wavelength_m for line in camera.lines if line.colour == colour)


def orders_of_design(design: Design, doe: CellOptic) -> tuple[OrderTable, ...]:
    """Tables of the spots of a design's spec, one for each colour, of the design as drawn or as fabricated."""
    assert design.spec is not None
    table, camera, levels = design.spec.spots, design.camera, design.levels.count
    assert table is not None

    return tuple(
        order_table(
            doe, spots_from_spec(table, camera, colour), period_m=table.period_m, count=table.count, levels=levels,
            colour=colour,
        )
        for colour in colour_numbers(table, camera)
    )  # fmt: skip


def unit_cell(table: SpotsSpec, camera: Camera) -> Grid:
    """Grid of the unit cell of a grid of orders, one cell wide along an axis with one spot."""
    assert table.count is not None
    assert table.period_m is not None
    count = round(table.period_m / camera.grid.pitch_m)
    ny, nx = (count if spots > 1 else 1 for spots in reversed(table.count))
    return Grid((ny, nx), camera.grid.pitch_m)


def repeated(level: UInt8[np.ndarray, "v u"], grid: Grid) -> UInt8[np.ndarray, "y x"]:
    """Repeat a unit cell over the cells of a grid, from its first one on."""
    (height, width), (ny, nx) = level.shape, grid.shape
    return np.tile(level, (-(-ny // height), -(-nx // width)))[:ny, :nx]


def spots_from_spec(table: SpotsSpec, camera: Camera, colour: int = 0) -> Spots:
    """Spots of a table, for the first wavelength of one of a camera's colours; from where light arrives."""
    wavelength = wavelength_of(camera, colour)
    shares = shares_of(table.weights, table.spot_count)
    phases = np.array(table.phases_rad) if table.phases_rad else None
    if table.period_m is not None:
        assert table.count is not None
        orders, step = grid_orders(table.count), 1 / table.period_m
        return Spots(orders * step, shares, orders, (step, step), phases)
    places = places_of(table)
    middle = np.array(table.offset_m[::-1])
    sines = np.stack(camera.sines_of(*(places + middle).T), axis=1) - np.array(camera.moved_sines())
    if table.arrangement != "grid" or middle.any() or not camera.images_alike:
        return Spots(sines / wavelength, shares, phases=phases)
    assert table.spacing_m is not None
    # An even count has no middle: its spots are the odd ones of a lattice twice as fine.
    spacing = table.spacing_m / (2 if any(n % 2 == 0 for n in table.count or ()) else 1)
    step = spacing / camera.sensor_distance_m / wavelength
    return Spots(sines / wavelength, shares, np.rint(places / spacing).astype(int), (step, step), phases)
