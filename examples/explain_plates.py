"""The plates of explain_1to1.py: a design at every lift, its errors alone and together, and what light does then."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import ceil, degrees, radians, tan
from typing import Any, NamedTuple

import numpy as np

from doedesign.build import camera_from_spec
from doedesign.calibration.explanations import ExplanationSet, Targets, explain_ratio
from doedesign.design.design import Design
from doedesign.prediction import Prediction, predict
from doedesign.runs.folder import Run
from doedesign.runs.level_maps import level_map_of_run
from fab.level_map import LevelMap
from fab.process import Normal, Process, Variation
from fab.units import NM, UM
from sim.camera import Camera, Colour
from sim.metrics import energy_within

FULL_WAVE, PROBE = "552 nm", "520 nm"
LINES = (Colour(FULL_WAVE, (552 * NM,), (1.0,)), Colour(PROBE, (520 * NM,), (1.0,)))
MEASURED_RATIO, MEASURED_THROUGHPUT = 1.0, 0.86
REACHED = 1.1  # a ratio up to here counts as 1:1
CLOSE = 0.02  # of the throughput

# What a careful lab without statistics of its own would not exceed.
OVERLAY_M, DEPTH, WIDTH_M = 1 * UM, 0.05, 0.5 * UM
CORNER_M, WALL_RAD, LAG, ROUGHNESS_M, GRAIN_M = 0.8 * UM, radians(10), 0.1, 5 * NM, 200 * NM
CHROME_M, BOWL = 5 * UM, 0.1

ALL_LIFTS = tuple(range(16))
# Errors that are looked at on every lift; of missed etches the deepest.
WIDTH_ERROR, DEPTH_ERROR, OVERLAY_ERROR, MISSED = (
    "line width, all masks",
    "depth, all etches",
    "overlay, masks in turn",
    "etch missed",
)
DEEPEST = "mask 3"
RELAY_RAD = radians(10)  # what two f/2.8 lenses of 75 mm relay from a pupil of 4.4 mm


def say(text: str) -> None:
    """Tell what is going on."""
    print(f"  {text}", file=sys.stderr, flush=True)


@dataclass(frozen=True, eq=False)
class Bench:
    """A design before light of two wavelengths."""

    drawing: LevelMap
    camera: Camera
    near_m: float

    @property
    def process(self) -> Process:
        """The etches; errors are given plate by plate."""
        return Process(self.drawing.levels)

    @property
    def passed(self) -> float:
        """Share of the probe's light that passes both faces of a plate."""
        return self.camera.transmission(LINES[1].wavelengths_m[0])


def bench_of(run: Run, light: str = "scalar") -> Bench:
    """The bench of a finished run, in scalar light or in light with "edges"."""
    camera = replace(camera_from_spec(run.spec), colours=LINES, light=light)
    return Bench(level_map_of_run(run), camera, run.spec.scene.near_m[0])


@lru_cache(maxsize=32)
def lifted(bench: Bench, lift: int) -> Design:
    """The design raised by some steps, modulo one wave. Kept, since predictions know a design by its level map."""
    drawing = bench.drawing
    raised = (drawing.level + lift) % drawing.levels.count
    level_map = replace(drawing, level=raised, name=f"lift {lift}")
    return Design(level_map, bench.camera, (bench.near_m,), ())


@dataclass(frozen=True)
class Plate:
    """One plate to look at.

    Attributes:
        group: "drawn", "single", "lifted", "together", "draw", "frail draw" or "compared".
        error: what is wrong with it.
        size: by how much.
        lift: steps by which the design is raised.
        variation: its errors.
    """

    group: str
    error: str
    size: str
    lift: int
    variation: Variation


class Seen(NamedTuple):
    """A plate and the numbers of its near PSF by wavelength (`doedesign.prediction.plate_rows`)."""

    plate: Plate
    light: dict[str, dict[str, Any]]

    @property
    def ratio(self) -> float:
        """Ring over disc at the probe."""
        return self.light[PROBE]["ring_to_disc"]

    @property
    def throughput(self) -> float:
        """Energy in the window at the probe."""
        return self.light[PROBE]["throughput"]

    @property
    def reaches(self) -> bool:
        """Whether the ratio is down to 1:1."""
        return self.ratio <= REACHED

    @property
    def slip(self) -> bool:
        """Whether an etch was forgotten or done twice, which a lab would notice."""
        return any(self.plate.variation.repeats)


def look(bench: Bench, plate: Plate) -> Prediction:
    """Predict a plate."""
    return predict(lifted(bench, plate.lift), bench.process, plate.variation)


def look_at(bench: Bench, plates: Sequence[Plate], words: str) -> list[Seen]:
    """Predict plates; neighbours should be of one lift."""
    say(f"{len(plates)} plates: {words}")
    return [Seen(plate, {row["colour"]: row for row in look(bench, plate).rows}) for plate in plates]


def one(mask: int, value: float) -> tuple[float, ...]:
    """A value for one mask and zero for the others."""
    return tuple(value if k == mask else 0.0 for k in range(4))


def in_turn(shift_m: float) -> tuple[float, ...]:
    """Every mask to the other side of where its neighbours lie."""
    return (shift_m, -shift_m, shift_m, -shift_m)


def singles() -> Iterator[Plate]:
    """Every error alone, within its range, on the design as the optimiser left it."""

    def plate(error: str, size: str, **values: Any) -> Plate:
        return Plate("single", error, size, 0, Variation(**values))

    for share in (-1, -0.5, 0.5, 1):
        depth, width = share * DEPTH, share * WIDTH_M
        yield plate(DEPTH_ERROR, f"{depth:+.1%}", common_depth_scale=depth)
        yield plate(WIDTH_ERROR, f"{width / UM:+.2f} um", common_cd_bias_m=width)
    for mask in range(4):
        for depth, width in ((-DEPTH, -WIDTH_M), (DEPTH, WIDTH_M)):
            yield plate("depth, one etch", f"{mask}: {depth:+.1%}", depth_scale=one(mask, depth))
            yield plate("line width, one mask", f"{mask}: {width / UM:+.2f} um", cd_bias_m=one(mask, width))
        yield plate("overlay, one mask", f"{mask}: {OVERLAY_M / UM:.1f} um", overlay_x_m=one(mask, OVERLAY_M))
        for repeats, error in ((-1, MISSED), (1, "etch doubled")):
            yield plate(error, f"mask {mask}", repeats=tuple(int(r) for r in one(mask, repeats)))
    for shift in (OVERLAY_M / 2, OVERLAY_M):
        yield plate(OVERLAY_ERROR, f"+-{shift / UM:.1f} um", overlay_x_m=in_turn(shift))
    yield plate("rounded corners", f"{CORNER_M / UM:.1f} um", corner_radius_m=CORNER_M)
    yield plate("tilted walls", f"{degrees(WALL_RAD):.0f} deg", sidewall_rad=WALL_RAD)
    yield plate("etch lag", f"{LAG:.2f}", etch_lag=LAG)
    yield plate("roughness", f"{ROUGHNESS_M / NM:.1f} nm", roughness_m=ROUGHNESS_M, correlation_m=GRAIN_M)
    yield plate("uniformity", f"{BOWL:.0%} to the edge", radial_nonuniformity=BOWL)
    for diameter in (-CHROME_M, CHROME_M):
        yield plate("chrome", f"{diameter / UM:+.0f} um wide", chrome_diameter_m=diameter)


def on_every_lift(lifts: Sequence[int]) -> list[Plate]:
    """The errors that matter, on the design at other lifts: line width at four sizes, the others at their limits."""
    sizes = {
        WIDTH_ERROR: tuple(p.size for p in singles() if p.error == WIDTH_ERROR),
        DEPTH_ERROR: (f"{-DEPTH:+.1%}", f"{DEPTH:+.1%}"),
        OVERLAY_ERROR: (f"+-{OVERLAY_M / UM:.1f} um",),
        MISSED: (DEEPEST,),
    }
    chosen = [plate for plate in singles() if plate.size in sizes.get(plate.error, ())]
    return [replace(plate, group="lifted", lift=lift) for lift in lifts if lift for plate in chosen]


def together(alone: Sequence[Seen], lift: int) -> list[Plate]:
    """Errors at their limits together, depth and line width to the side on which each lowers the ratio alone.

    Args:
        alone: single errors, among them those at this lift.
        lift: steps.
    """

    def lowering(error: str) -> Variation:
        here = [seen for seen in alone if (seen.plate.error, seen.plate.lift) == (error, lift)]
        return min(here, key=lambda seen: seen.ratio).plate.variation

    depth = {"common_depth_scale": lowering(DEPTH_ERROR).common_depth_scale}
    width = {"common_cd_bias_m": lowering(WIDTH_ERROR).common_cd_bias_m}
    overlay = {"overlay_x_m": in_turn(OVERLAY_M)}
    shape = {"corner_radius_m": CORNER_M, "sidewall_rad": WALL_RAD, "etch_lag": LAG}
    rough = {"roughness_m": ROUGHNESS_M, "correlation_m": GRAIN_M}
    sizes = {
        "width": f"width {width['common_cd_bias_m'] / UM:+.2f} um",
        "depth": f"depth {depth['common_depth_scale']:+.1%}",
    }
    mixtures: dict[str, dict[str, Any]] = {
        "width and depth": width | depth,
        "overlay and depth": overlay | depth,
        "overlay and width": overlay | width,
        "overlay, width, depth": overlay | width | depth,
        "overlay / 4, width, depth": {"overlay_x_m": in_turn(OVERLAY_M / 4)} | width | depth,
        "everything": overlay | width | depth | shape | rough,
    }
    return [
        Plate(
            "together",
            error,
            ", ".join(text for name, text in sizes.items() if name in error or error == "everything"),
            lift,
            Variation(**values),
        )
        for error, values in mixtures.items()
    ]


def draws(group: str, count: int, lifts: Sequence[int], seed: int) -> list[Plate]:
    """Plates with overlay, line width and depth anywhere within their ranges.

    Of line width and depth one half of the range is common to all masks and the other each mask's own.
    """
    rng = np.random.default_rng(seed)

    def four(size: float) -> tuple[float, ...]:
        return tuple(float(v) for v in rng.uniform(-size, size, 4))

    plates = []
    for index in range(count):
        variation = Variation(
            overlay_y_m=four(OVERLAY_M),
            overlay_x_m=four(OVERLAY_M),
            common_cd_bias_m=float(rng.uniform(-WIDTH_M / 2, WIDTH_M / 2)),
            cd_bias_m=four(WIDTH_M / 2),
            common_depth_scale=float(rng.uniform(-DEPTH / 2, DEPTH / 2)),
            depth_scale=four(DEPTH / 2),
        )
        lift = int(rng.choice(np.asarray(lifts)))
        plates.append(Plate(group, "overlay, width, depth", f"draw {index}", lift, variation))
    return sorted(plates, key=lambda plate: plate.lift)


# Steps in which the ratio is looked at beyond the ranges: eight of depth, three of line width (then cells are lost).
BEYOND = {"common_depth_scale": 0.05, "common_cd_bias_m": 0.3 * UM}


def needed(bench: Bench, lift: int) -> ExplanationSet:
    """How large single errors must be for 1:1 at the probe, within their ranges or not."""
    say(f"how large would single errors have to be at lift {lift}?")
    process = replace(bench.process, spreads={name: Normal(0.0, step) for name, step in BEYOND.items()})
    targets = Targets(LINES[1].wavelengths_m[0], bench.near_m, MEASURED_RATIO, MEASURED_THROUGHPUT, CLOSE / 2)
    return explain_ratio(lifted(bench, lift), targets, tuple(BEYOND), process=process, pairs=False, reach=8.0)


@dataclass(frozen=True)
class Answer:
    """All that was found.

    Attributes:
        bench: design and optics.
        seen: all plates, first the one without errors.
        frail: the lift at which an error of line width lowers the ratio most.
        needed: by lift (0 and the frail one), what single errors would have to be.
        shown: predictions of three plates: without errors, one at 1:1 or next to it, and its errors at another lift.
        relayed: of the first two the energy that the paper's relay would pass, at the probe.
    """

    bench: Bench
    seen: list[Seen]
    frail: int
    needed: dict[int, ExplanationSet]
    shown: list[tuple[Seen, Prediction]]
    relayed: list[float]

    def of(self, *groups: str) -> list[Seen]:
        """Plates of some groups."""
        return [seen for seen in self.seen if seen.plate.group in groups]

    def alone(self, error: str) -> list[Seen]:
        """Plates with one error, at any lift."""
        return [seen for seen in self.of("single", "lifted") if seen.plate.error == error]


def explain(bench: Bench, lifts: Sequence[int] = ALL_LIFTS, count: int = 24) -> Answer:
    """Look at everything.

    Args:
        bench: design and optics.
        lifts: steps by which the design is raised, 0 first.
        count: random plates, at any lift and once more at the frail one.
    """
    seen = look_at(bench, [Plate("drawn", "none", "", k, Variation()) for k in lifts], "without errors, at every lift")
    seen += look_at(bench, list(singles()), "every error alone")
    seen += look_at(bench, on_every_lift(lifts), "those that matter, at every lift")
    frail = min((s for s in seen if s.plate.error == WIDTH_ERROR), key=lambda s: s.ratio).plate.lift
    both = tuple(dict.fromkeys((0, frail)))
    seen += look_at(bench, [p for lift in both for p in together(seen, lift)], "errors at their limits together")
    random = draws("draw", count, lifts, seed=1) + draws("frail draw", count, (frail,), seed=2)
    seen += look_at(bench, random, "drawn at random")
    # Of those at 1:1 the one with most light.
    candidates = [s for s in seen if not s.slip]
    reaching = [s for s in candidates if s.reaches]
    found = max(reaching, key=lambda s: s.throughput) if reaching else min(candidates, key=lambda s: s.ratio)
    other = replace(found.plate, group="compared", lift=(found.plate.lift + 8) % 16)
    seen += look_at(bench, [other], "one for comparison")
    shown = [(each, look(bench, each.plate)) for each in (seen[0], found, seen[-1])]
    relayed = [relay_throughput(bench, each.plate) for each, _ in shown[:2]]
    return Answer(bench, seen, frail, {lift: needed(bench, lift) for lift in both}, shown, relayed)


def relay_throughput(bench: Bench, plate: Plate) -> float:
    """Energy of the probe within the angle that the paper's relay passes, on a sensor wide enough for it."""
    camera = bench.camera
    radius = camera.focal_length_m * tan(RELAY_RAD)
    wide = replace(camera, window=2 * ceil(radius / camera.pixel_m) + 2, colours=LINES[1:])
    psf = predict(replace(lifted(bench, plate.lift), camera=wide), bench.process, plate.variation).bank.energy[0, 0]
    return float(energy_within(psf, camera.pixel_m, radius))
