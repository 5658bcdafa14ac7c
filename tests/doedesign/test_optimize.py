"""The optimisation loop: right gradients, falling loss, and the same bytes however often it was interrupted."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doedesign import optimization
from doedesign.design import optimize as optimization_loop
from doedesign.design.descent import descend, looks_of
from doedesign.design.optimize import OptimizationState, finished_design, initial_state, steps
from doedesign.design.problem import losses, problem_of, value_and_slope, view_of
from doedesign.runs.folder import begin_run, claim_run
from doedesign.spec import Spec, load_spec
from fab.errors import InputError
from fab.levels import quantise
from sim.propagation.hankel import radial_profile

EXAMPLES = Path(__file__).parents[2] / "examples"
SMALL = ["doe.samples=128", "doe.aperture=0.2368 mm", "sensor.window=96", "optimize.steps=12"]


def unread(path: Path) -> np.ndarray:
    raise AssertionError(path)


def run(
    spec: Spec, start: OptimizationState | None = None, stop: int | None = None
) -> tuple[OptimizationState, list[float]]:
    problem, scene = problem_of(spec, {})
    begun = start or initial_state(spec, problem, scene, {}, unread)
    state, history = begun, []
    for state, record in steps(spec, problem, scene, begun):
        history.append(record["loss"])
        if state.step == stop:
            break
    return jax.tree.map(np.asarray, state), history


@pytest.mark.slow
@pytest.mark.parametrize("parametrization", ["freeform", pytest.param("radial", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "quantisation",
    [
        "straight_through",
        "annealed",
        *(pytest.param(one, marks=pytest.mark.slow) for one in ("none", "gumbel", "stochastic")),
    ],
)
def test_loss_falls(parametrization: str, quantisation: str) -> None:
    overrides = [*SMALL, f"optimize.parametrization={parametrization}", f"optimize.quantisation={quantisation}"]
    _, history = run(load_spec(EXAMPLES / "quick.toml", [*overrides, "optimize.steps=30"]))
    # The mean over rounds of depths, so that a hard depth is not held against a step.
    assert np.mean(history[-6:]) < np.mean(history[:6])


@pytest.mark.slow
@pytest.mark.parametrize("parametrization", ["freeform", pytest.param("radial", marks=pytest.mark.slow)])
def test_gradient_of_the_whole_chain(parametrization: str) -> None:
    spec = load_spec(EXAMPLES / "quick.toml", [*SMALL, f"optimize.parametrization={parametrization}"])
    problem, scene = problem_of(spec, {})
    state = initial_state(spec, problem, scene, {}, unread)
    look = scene.look(0, 0)

    def loss(radians: jax.Array) -> jax.Array:
        height = radians * problem.parametrization.metres_per_radian  # no wrap: it has no derivative
        return losses(problem.terms, view_of(problem, height, look))[0]

    radians = state.parameters.radians
    direction = jnp.asarray(np.random.default_rng(0).normal(size=radians.shape), jnp.float32)
    slope = float(jnp.vdot(jax.grad(loss)(radians), direction))
    step = 3e-3
    difference = float(loss(radians + step * direction) - loss(radians - step * direction)) / (2 * step)
    # Central differences in float32: rounding 1e-7 / 6e-3 = 2e-5 of the loss, curvature of the same order.
    assert slope == pytest.approx(difference, rel=0.02, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "more", [[], ["optimize.colours=together"], ["optimize.drawn_pixel=3.7 um"], ["optics.light=edges"]]
)
def test_slope_from_images_side_by_side_is_that_of_one_program(more: list[str]) -> None:
    spec = load_spec(EXAMPLES / "quick.toml", [*SMALL, *more])
    problem, scene = problem_of(spec, {})
    block = problem.parametrization.block
    shape = tuple(count // block for count in problem.optic.shape)
    drawn = jnp.asarray(np.random.default_rng(1).uniform(0, 1.2e-6, shape), jnp.float32)
    look = scene.look(0, 0)
    assert (look.colour is None) == bool(more and "together" in more[0])

    def traced(drawn: jax.Array) -> tuple[jax.Array, jax.Array]:
        return losses(problem.terms, view_of(problem, problem.parametrization.cells(drawn), look))

    (loss, terms), slope = jax.value_and_grad(traced, has_aux=True)(drawn)
    found = value_and_slope(problem, drawn, look)
    # The same operations, fused and summed in another order in float32.
    assert float(found[0]) == pytest.approx(float(loss), rel=1e-5)
    np.testing.assert_allclose(found[1], terms, rtol=1e-5)
    assert np.linalg.norm(found[2] - slope) < 1e-4 * np.linalg.norm(slope)


@pytest.mark.slow
def test_the_loss_is_the_mean_of_what_steps_see_in_turn() -> None:
    spec = load_spec(EXAMPLES / "quick.toml", SMALL)
    problem, scene = problem_of(spec, {})
    assert [scene.look(0, step).colour for step in range(5)] == [0, 1, 2, 0, 1]
    heights = jnp.asarray(np.random.default_rng(1).uniform(0, 1.2e-6, problem.optic.shape), jnp.float32)
    look = scene.look(0, 0)
    whole = losses(problem.terms, view_of(problem, heights, look._replace(colour=None)))
    parts = [losses(problem.terms, view_of(problem, heights, look._replace(colour=colour))) for colour in range(3)]
    # Sums of about 1e4 pixels in float32, in another order.
    assert float(whole[0]) == pytest.approx(np.mean([float(loss) for loss, _ in parts]), rel=1e-5)
    np.testing.assert_allclose(whole[1], np.mean([terms for _, terms in parts], axis=0), rtol=1e-5)
    assert all(one.colour is None for one in looks_of(scene, 0))  # a descent on levels compares all colours


def test_colours_that_are_compared_cannot_be_looked_at_in_turn() -> None:
    for change in (
        'objective[3]={ name = "equal_colours" }',
        "objective[0].over=worst",
        'objective[0].colours=["486nm"]',
    ):
        with pytest.raises(InputError, match="must look at any colour alone"):
            load_spec(EXAMPLES / "quick.toml", [change])
        load_spec(EXAMPLES / "quick.toml", [change, "optimize.colours=together"])


@pytest.mark.slow
def test_long_runs_end_with_the_mean_of_their_last_phases(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimization_loop, "_LONG", 11)
    spec = load_spec(EXAMPLES / "quick.toml", SMALL)
    problem, scene = problem_of(spec, {})
    state = initial_state(spec, problem, scene, {}, unread)
    mean = np.asarray(state.parameters.radians)
    for state, _ in steps(spec, problem, scene, state):  # noqa: B020 - goes on from the one before
        mean = mean + np.float32(0.1) * (np.asarray(state.parameters.radians) - mean)
    assert state.mean is not None
    np.testing.assert_allclose(state.mean.radians, mean, atol=1e-5)  # float32 of some radians, twelve times
    design = finished_design(spec, problem, state)
    np.testing.assert_array_equal(design.continuous_m, problem.parametrization.continuous_m(state.mean.radians))
    short, _ = run(load_spec(EXAMPLES / "quick.toml", [*SMALL, "optimize.steps=11"]))
    assert short.mean is None
    printable, _ = run(load_spec(EXAMPLES / "quick.toml", [*SMALL, "optimize.min_feature=2 um"]))
    assert printable.mean is None


@pytest.mark.slow
@pytest.mark.parametrize("long", [False, True])
def test_resumed_run_has_the_same_bits(long: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if long:
        monkeypatch.setattr(optimization_loop, "_LONG", 11)
    spec = load_spec(EXAMPLES / "quick.toml", SMALL)
    whole, history = run(spec)
    half, first = run(spec, stop=5)
    resumed, second = run(spec, start=jax.tree.map(jnp.asarray, half)._replace(step=5))
    assert first + second == history
    assert np.array_equal(whole.parameters.radians, resumed.parameters.radians)
    assert np.array_equal(whole.settled.radians, resumed.settled.radians)


@pytest.mark.slow
def test_design_is_on_levels_and_radial_designs_are_radial() -> None:
    spec = load_spec(EXAMPLES / "quick.toml", [*SMALL, "optimize.parametrization=radial", "optimize.steps=2"])
    problem, scene = problem_of(spec, {})
    design = finished_design(spec, problem, initial_state(spec, problem, scene, {}, unread))
    level = quantise(design.height_m, problem.parametrization.levels)
    np.testing.assert_allclose(design.height_m, level * 75e-9, rtol=1e-6)
    assert radial_profile(np.asarray(design.continuous_m), problem.camera.grid) is not None


@pytest.mark.parametrize(
    ("override", "moved"),
    [
        ("optimize.sampling=sparse", True),
        ("optimize.sampling=exact", False),
        ("optics.propagation=fresnel", False),
        pytest.param("optimize.parametrization=radial", False, marks=pytest.mark.slow),
    ],
)
def test_the_image_is_moved_between_sparse_samples_alone(override: str, moved: bool) -> None:
    spec = load_spec(EXAMPLES / "quick.toml", [*SMALL, override])
    _, scene = problem_of(spec, {})
    assert scene.displacement_m == (spec.sensor.pixel_m / 2 if moved else 0)
    assert (scene.look(0, 0).offset_m is not None) == moved


def test_looks_see_every_depth_equally_often() -> None:
    spec = load_spec(EXAMPLES / "quick.toml", SMALL)
    _, scene = problem_of(spec, {})
    seen = [scene.look(7, step).near[0][0] for step in range(6)]
    counts = [sum(one is source for one in seen) for source in scene.near[0]]
    assert counts == [2, 2, 2]
    offsets = np.array([scene.look(7, step).offset_m for step in range(200)])
    assert np.abs(offsets).max() <= spec.sensor.pixel_m / 2
    # The mean of 200 uniform numbers of half-width 1/2 pixel is within 4 sigma = 4 x 0.29 / sqrt(200) = 8 % of a pixel.
    assert np.abs(offsets.mean(axis=0)).max() < 0.08 * spec.sensor.pixel_m


def test_a_budget_becomes_a_number_of_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that adds a tenth of a second per look, after a first step of two seconds; a run keeps its number.

    Where colours are looked at in turn, the first step of each takes two seconds.
    """
    together = [*SMALL, "optimize.colours=together"]
    spec = load_spec(EXAMPLES / "quick.toml", together)
    times = iter([0.0, 2.0, 2.1, 2.2, 2.3, 2.4, 2.5])
    monkeypatch.setattr(optimization, "_trial", lambda spec, objectives: iter(range(spec.optimize.steps)))
    monkeypatch.setattr(optimization.time, "perf_counter", lambda: next(times))
    assert optimization.steps_within(spec, 10.05) == 80  # (10.05 - 2) / 0.1
    times = iter([0.0, 2.0, 2.1, 2.2])
    assert optimization.steps_within(spec, 1.0) == 1  # too short a time for more
    times = iter([0.0, 2.0, 4.0, 6.0, 6.1, 6.2, 6.3, 6.4])
    assert optimization.steps_within(load_spec(EXAMPLES / "quick.toml", SMALL), 10.05) == 40  # (10.05 - 6) / 0.1
    times = iter([0.0, 1.0, 2.0, 2.1, 2.2, 2.3])
    assert optimization.steps_within(spec, 10.05) == 90  # one slow step of four is not what a step takes
    for instants in ([0.0, 1e-7, 2e-7, 3e-7, 4e-7, 5e-7], [0.0] * 6):
        times = iter(instants)
        steps = optimization.steps_within(spec, 1e6)  # as many as a spec allows
        assert load_spec(EXAMPLES / "quick.toml", [f"optimize.steps={steps}"]).optimize.steps == steps == 10_000_000
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="budget: must be positive seconds"):
            optimization.steps_within(spec, wrong)
    begun = load_spec(EXAMPLES / "quick.toml", [*together, "optimize.steps=7"])
    with claim_run(tmp_path / "run", begun, {}) as run:
        begin_run(run)
    assert optimization.steps_within(spec, 10.0, tmp_path / "run") == 7
    other = load_spec(EXAMPLES / "quick.toml", [*together, "optimize.seed=3"])
    times = iter([0.0, 2.0, 2.1, 2.2, 2.3, 2.4, 2.5])
    assert optimization.steps_within(other, 10.05, tmp_path / "run") == 80
    with pytest.raises(InputError, match="something to improve"):
        optimization.steps_within(load_spec(EXAMPLES / "quick.toml", ["objective=[]", "optimize.steps=0"]), 10.0)


@pytest.mark.slow
def test_a_descent_on_levels_lowers_the_loss_and_repeats() -> None:
    """Judged where it looks, a descent never ends higher; every cell ends on a level, and none went round."""
    spec = load_spec(EXAMPLES / "quick.toml", [*SMALL, "optimize.steps=4"])
    problem, scene = problem_of(spec, {})
    *_, (state, _) = steps(spec, problem, scene, initial_state(spec, problem, scene, {}, unread))
    staircase, losses_seen = problem.parametrization, []
    before = np.asarray(staircase.level(staircase.continuous_m(state.parameters.radians)))
    found = [
        descend(spec, problem, scene, state.parameters, 6, lambda move, loss: losses_seen.append((move, loss)))
        for _ in range(2)
    ]
    np.testing.assert_array_equal(found[0].radians, found[1].radians)
    once = [loss for _, loss in losses_seen[:6]]
    assert [move for move, _ in losses_seen] == [1, 2, 3, 4, 5, 6] * 2
    assert once == sorted(once, reverse=True)
    assert once[-1] < once[0]
    heights = np.asarray(staircase.continuous_m(found[0].radians)) / staircase.levels.step_m
    assert np.allclose(heights, np.round(heights), atol=1e-4)
    moved = np.round(heights) - before
    assert 0 < np.abs(moved).max() <= 6
    looks = looks_of(scene, spec.optimize.seed)
    assert len(looks) == 2 * max(len(scene.near[0]), len(scene.far[0]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["optimize.polish=3", "optimize.quantisation=none"], "a descent on levels needs levels of equal steps"),
        (["optimize.polish=-1"], "optimize.polish"),
        (["optimize.quantisation=gumbel", 'process.etch_depths="optimize"'], '"gumbel" draws levels of equal steps'),
        (["optimize.quantisation=sometimes"], "optimize.quantisation"),
    ],
)
def test_rounding_that_cannot_be_is_told(change: list[str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_spec(EXAMPLES / "quick.toml", change)


def test_overrides_go_with_a_spec_as_its_file_has_it() -> None:
    """They are put into the file's text, so that changes to the values would be lost without a word."""
    spec = load_spec(EXAMPLES / "quick.toml", steps=7)
    with pytest.raises(InputError, match="overrides: change a spec as its file has it, but got one that was changed"):
        optimization.optimize(spec, overrides=["process.levels=8"])


@pytest.mark.parametrize(
    "changes",
    [["optimize.polish=2"], ['optimize.start="nlopt"'], ['optimize.start="fresnel"', "optimize.start_options={}"]],
)
def test_what_a_loss_decides_needs_an_objective(changes: list[str], tmp_path: Path) -> None:
    path = tmp_path / "bare.toml"
    path.write_text((EXAMPLES / "quick.toml").read_text().partition("[[objective]]")[0].partition("[optimize]")[0])
    with pytest.raises(InputError, match="objective: an optimisation must have something to improve"):
        load_spec(path, ["optimize.steps=0", *changes])
    load_spec(path, ["optimize.steps=0"])
