"""The choice of etch depths: what rounding costs in light, sets that beat 2^k steps, and depths as parameters."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doedesign.design.levels.etch_depths import height_histogram, light_cost, optimal_levels, recipe_depths_m
from doedesign.design.levels.parametrize import DEPTH_SCALE, LevelParametrization
from doedesign.design.levels.quantisation import ROUNDED, Rounding
from doedesign.design.optimize import OptimizationState, finished_design, initial_state, steps
from doedesign.design.problem import losses, problem_of, view_of
from doedesign.spec import Spec, load_spec
from fab.grid import Grid
from fab.levels import Levels, height_of, quantise, quantise_wrapped
from sim.camera import Camera, Colour
from sim.optic import HeightOptic

NM = 1e-9
QUICK = Path(__file__).parents[2] / "examples" / "quick.toml"
SMALL = ["doe.samples=96", "doe.aperture=0.1776 mm", "sensor.window=64", "optimize.steps=6"]
FOUR = ["process.levels=4", "process.level_step=300 nm"]
CHOSEN = [*FOUR, "process.etch_depths=optimize"]
UNEVEN = Levels(4, 300e-9, (250e-9, 600e-9))


def camera(*lines_m: float) -> Camera:
    colours = tuple(Colour(f"{line:g}", (line,), (1.0,)) for line in lines_m)
    return Camera(Grid((64, 64), 1.85e-6), 100e-6, "fused_silica", colours, 1e-3, 1.85e-6, 32)


def everywhere(height_m: np.ndarray) -> np.ndarray:
    return np.ones(height_m.shape)


def unread(path: Path) -> np.ndarray:
    raise AssertionError(path)


def run(spec: Spec, start: OptimizationState | None = None, stop: int | None = None) -> OptimizationState:
    problem, scene = problem_of(spec, {})
    state = start or initial_state(spec, problem, scene, {}, unread)
    for state, _ in steps(spec, problem, scene, state):  # noqa: B020 - the last state is the result
        if state.step == stop:
            break
    return jax.tree.map(jnp.array, state)


# --- what rounding costs ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [2, 4, 8, 16])
def test_even_levels_of_even_heights_cost_one_minus_the_sinc(count: int) -> None:
    # Rounding errors are even over one step, 1 / L of a wave: the mean of their cosine is sinc(1 / L), whose square is
    # the first-order efficiency of a blazed grating.
    line = camera(550e-9)
    wave = 1 / line.waves_per_metre(550e-9)
    heights = (np.arange(40_000) + 0.5) / 40_000 * wave
    seen = height_histogram(heights, everywhere(heights), wave, line)
    levels = Levels(count, wave / count)
    # The histogram and its rounded bins of 1 / 4096 wave: squares of 2 pi / 4096 over 24, far below 1e-6.
    assert light_cost(seen, levels) == pytest.approx(1 - np.sinc(1 / count), abs=1e-6)
    # No other set does better for even heights of one colour.
    assert light_cost(seen, optimal_levels(seen, levels)) >= 1 - np.sinc(1 / count) - 1e-6


@pytest.mark.parametrize("levels", [Levels(4, 300e-9), UNEVEN, Levels(8, 150e-9, (500e-9, 170e-9, 320e-9))])
def test_the_running_sums_give_what_every_single_height_gives(levels: Levels) -> None:
    colours = camera(486e-9, 656e-9)
    heights = np.random.default_rng(1).gamma(3.0, 150e-9, 20_000) % levels.period_m
    seen = height_histogram(heights, everywhere(heights), levels.period_m, colours)
    off = heights - height_of(quantise_wrapped(heights[None], levels), levels)[0]
    each = [np.mean(1 - np.cos(2 * np.pi * colours.waves_per_metre(w) * off)) for w in (486e-9, 656e-9)]
    # Heights in the middle of bins of 0.3 nm: 0.15 nm is 1e-3 of a radian.
    assert light_cost(seen, levels) == pytest.approx(np.mean(each), abs=1e-4)


def test_two_etches_of_one_wave_each_serve_two_colours_at_once() -> None:
    # An etch of a whole wave of one colour turns the other alone: heights 0, a, b and a + b give every combination of
    # 0 and a turn of either colour. The set (a, b) makes them exactly; four even steps of the same wave cannot.
    lines = (486e-9, 656e-9)
    colours = camera(*lines)
    rates = [colours.waves_per_metre(w) for w in lines]
    a, b = 1 / rates[0], 1 / rates[1]
    heights = np.repeat([0.0, a, b, a + b], 50)
    even = Levels(4, 660e-9)
    seen = height_histogram(heights, everywhere(heights), even.period_m, colours)
    # By hand: 0 -> 0, a = 1.05 um -> 1.32 um, b = 1.44 um -> 1.32 um, and a + b = 2.49 um -> 0, one wave less.
    rounded = np.array([0.0, 1320e-9, 1320e-9, 0.0])
    off = np.array([0.0, a, b, a + b]) - rounded
    lost = np.mean([1 - np.cos(2 * np.pi * rate * off) for rate in rates])
    assert lost > 0.3
    # Bins of 2640 nm / 4096 = 0.6 nm: their middles are 0.3 nm off, 4e-3 of a radian, against a slope of at most 1.
    assert light_cost(seen, even) == pytest.approx(lost, abs=4e-3)
    chosen = optimal_levels(seen, even)
    # 0.35 nm of bin and recipe is 5e-3 of a radian: 1e-5 of the light.
    assert light_cost(seen, chosen) < 2e-5
    np.testing.assert_allclose(chosen.depths_m, (a, b), atol=1 * NM)


def test_heights_outside_the_aperture_do_not_count() -> None:
    line = camera(550e-9)
    heights = np.array([0.0, 600e-9, 350e-9])
    seen = height_histogram(heights, np.array([1.0, 1.0, 0.0]), 1.2e-6, line)
    # 0.15 nm of a bin: 1e-3 of a radian.
    assert light_cost(seen, Levels(2, 600e-9)) < 1e-6


def test_depths_are_what_a_recipe_holds() -> None:
    assert recipe_depths_m([300.04e-9, 80.06e-9], UNEVEN) == (80.1e-9, 300.0e-9)
    # Of five levels, one is made by masks 0 and 1, none by 0 and 2: depths in another order would make others.
    assert recipe_depths_m([610e-9, 80.06e-9, 300.04e-9], Levels(5, 150e-9)) == (610.0e-9, 80.1e-9, 300.0e-9)


def test_where_nothing_is_better_2_to_the_k_steps_stay() -> None:
    line = camera(550e-9)
    seen = height_histogram(np.zeros(10), np.ones(10), 1.2e-6, line)
    assert optimal_levels(seen, Levels(16, 75e-9)) == Levels(16, 75e-9)


# --- depths as parameters ---------------------------------------------------------------------------------------------


STAIRCASES = [
    UNEVEN,
    Levels(4, 300e-9, (500e-9, 150e-9)),
    Levels(8, 150e-9, (1e-7, 3e-7, 7e-7)),
    Levels(3, 400e-9, (350e-9, 820e-9)),
    Levels(5, 240e-9, (600e-9, 250e-9, 700e-9)),  # the deepest floor is made by masks 0 and 1
    Levels(6, 200e-9, (210e-9, 380e-9, 830e-9)),
]


@pytest.mark.parametrize("levels", STAIRCASES)
def test_the_loop_takes_the_levels_that_are_drawn(levels: Levels) -> None:
    staircase = LevelParametrization.at("fused_silica", 550e-9, levels)
    radians = jnp.asarray(np.random.default_rng(2).uniform(-20, 20, 4000), jnp.float32)
    continuous = np.asarray(staircase.continuous_m(radians), np.float64)
    level = np.asarray(staircase.level(jnp.asarray(continuous, jnp.float32)))
    expected = quantise_wrapped(continuous[None], levels)[0]
    # Heights within single precision of an edge may fall on either side: 1e-7 of a wave, 4000 of them.
    assert np.mean(level != expected) < 1e-3
    for softness in (0.0, 0.5):
        height = np.asarray(staircase.height_m(radians, Rounding(jnp.float32(softness))))
        meant = softness * continuous + (1 - softness) * levels.heights_m()[level.astype(int)]
        np.testing.assert_allclose(height, meant, atol=1e-6 * levels.period_m)


@pytest.mark.slow
def test_depths_given_as_2_to_the_k_steps_change_no_bit() -> None:
    plain = load_spec(QUICK, [*SMALL, *FOUR])
    told = load_spec(QUICK, [*SMALL, *FOUR, 'process.etch_depths=["300 nm", "600 nm"]'])
    designs = []
    for spec in (plain, told):
        problem, _ = problem_of(spec, {})
        designs.append(finished_design(spec, problem, run(spec)))
    assert designs[0].levels == designs[1].levels == Levels(4, 300e-9)
    assert designs[0].height_m.tobytes() == designs[1].height_m.tobytes()
    assert designs[0].continuous_m.tobytes() == designs[1].continuous_m.tobytes()


@pytest.mark.parametrize("softness", [0.0, 0.5])
@pytest.mark.parametrize("levels", STAIRCASES)
def test_gradient_of_the_heights_by_the_depths(softness: float, levels: Levels) -> None:
    staircase = LevelParametrization.at("fused_silica", 550e-9, levels)
    rng = np.random.default_rng(3)
    radians, weight = (jnp.asarray(rng.uniform(0, 6, 500), jnp.float32) for _ in range(2))

    def total(depths: jax.Array) -> jax.Array:
        return jnp.vdot(weight, staircase.height_m(radians, Rounding(jnp.float32(softness)), depths))

    depths = jnp.asarray(levels.depths_m, jnp.float32)
    level = np.asarray(staircase.level(staircase.continuous_m(radians))).astype(int)
    for mask, slope in enumerate(np.asarray(jax.grad(total)(depths))):
        # Linear in a depth as long as no cell changes its level: the deepest floor less what the mask etches.
        deepest, own = (levels.count - 1 - n >> mask & 1 for n in (int(np.argmin(levels.heights_m())), level))
        due = (1 - softness) * float(np.sum(weight * (deepest - own)))
        assert slope == pytest.approx(due, rel=1e-5, abs=1e-3)
    # Straight through by the parameters, whatever the depths do.
    through = jax.grad(lambda r: jnp.vdot(weight, staircase.height_m(r, ROUNDED, depths)))(radians)
    np.testing.assert_allclose(through, weight * staircase.metres_per_radian, rtol=1e-5)


@pytest.mark.slow
def test_gradient_of_the_whole_chain_by_the_depths() -> None:
    start = "optimize.start_options={height='400 nm', duty=0.5}"  # levels 1 and 2: one mask each
    spec = load_spec(QUICK, [*SMALL, *CHOSEN, start])
    problem, scene = problem_of(spec, {})
    state = initial_state(spec, problem, scene, {}, unread)
    look, staircase = scene.look(0, 0), problem.parametrization
    # Heights in the middle of levels' shares, so that a step of a few nanometres moves no cell to another level.
    level = quantise_wrapped(np.asarray(staircase.continuous_m(state.parameters.radians)), staircase.levels)
    radians = jnp.asarray(staircase.radians_of(height_of(level, staircase.levels) + 20e-9))

    @jax.jit
    def loss(log_depth_ratio: jax.Array) -> jax.Array:
        height = staircase.height_m(radians, ROUNDED, staircase.depths_m(log_depth_ratio))
        return losses(problem.terms, view_of(problem, height, look))[0]

    slopes = np.asarray(jax.jit(jax.grad(loss))(jnp.zeros(2)))
    step = 0.25  # half a percent of a depth, 1.5 to 3 nm
    for mask in range(2):
        change = jnp.zeros(2).at[mask].set(step)
        difference = float(loss(change) - loss(-change)) / (2 * step)
        # Rounding 1e-7 / 0.1 = 1e-6 of the loss; the third derivative of a cosine of 0.02 rad is 1e-4 of the slope.
        assert slopes[mask] == pytest.approx(difference, rel=0.02, abs=4e-6)
        assert abs(slopes[mask]) > 2e-4


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        [],
        ["optimize.quantisation=annealed"],
        ["optimize.parametrization=radial"],
    ],
    ids=lambda changes: changes[0] if changes else "straight_through",
)
def test_chosen_depths_resume_to_the_last_bit(changes: list[str]) -> None:
    spec = load_spec(QUICK, [*SMALL, *CHOSEN, *changes])
    whole = run(spec)
    resumed = run(spec, run(spec, stop=3))
    assert whole.parameters.log_depth_ratio is not None
    assert np.any(whole.parameters.log_depth_ratio != 0)
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(resumed), strict=True):
        assert np.array_equal(one, other)


@pytest.mark.slow
def test_the_design_stands_on_the_chosen_levels() -> None:
    spec = load_spec(QUICK, [*SMALL, *CHOSEN])
    problem, _ = problem_of(spec, {})
    state = run(spec)
    design = finished_design(spec, problem, state)
    assert state.parameters.log_depth_ratio is not None
    learnt = np.array([300e-9, 600e-9]) * np.exp(DEPTH_SCALE * state.parameters.log_depth_ratio)
    # A recipe holds tenths of a nanometre.
    np.testing.assert_allclose(design.levels.depths_m, learnt, atol=0.051 * NM)
    assert not design.levels.is_binary
    assert np.array_equal(quantise(design.height_m, design.levels), design.level_map.level)


@pytest.mark.slow
def test_a_design_without_rounding_gets_the_set_that_suits_its_heights() -> None:
    spec = load_spec(QUICK, [*SMALL, *CHOSEN, "optimize.quantisation=none"])
    problem, _ = problem_of(spec, {})
    state = run(spec)
    assert state.parameters.log_depth_ratio is None
    design = finished_design(spec, problem, state)
    assert isinstance(problem.optic, HeightOptic)
    area = np.asarray(problem.optic.coverage)
    assert design.continuous_m is not None
    seen = height_histogram(design.continuous_m, area, design.levels.period_m, problem.camera)
    assert light_cost(seen, design.levels) < light_cost(seen, Levels(4, 300e-9))


@pytest.mark.slow
def test_chosen_depths_serve_the_objective_better_than_even_steps() -> None:
    # Two levels have one depth, and it should be half a wave in the middle of the colours: 600 nm, not 480.
    few = ["process.levels=2", "process.level_step=480 nm", "optimize.steps=30", "optimize.colours=together"]
    found = {}
    for name, change in (("even", []), ("chosen", ["process.etch_depths=optimize"])):
        spec = load_spec(QUICK, [*SMALL, *few, *change])
        problem, scene = problem_of(spec, {})
        drawn = finished_design(spec, problem, run(spec)).height_m
        found[name] = float(losses(problem.terms, view_of(problem, jnp.asarray(drawn), scene.first_look()))[0])
    assert found["chosen"] < 0.98 * found["even"]
