"""Robust designs: steps that look at plates as fabricated."""

from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doedesign import optimization
from doedesign.build import process_from_spec
from doedesign.design import robust as robust_steps
from doedesign.design.design import Design
from doedesign.design.problem import Problem, SourceSet, problem_of, value_and_slope
from doedesign.design.ranges import SourceRange
from doedesign.design.robust import RobustTask, risk_of, wall_costs
from doedesign.optimization import optimize
from doedesign.spec import RobustSpec, load_spec
from doedesign.spec.process import ErrorsSpec
from fab.draws import normal_draw, varying
from fab.errors import InputError
from fab.levels import Levels
from fab.process import Normal, Process
from sim.metrics import participation
from sim.optic import HeightOptic
from sim.psf_bank import psf
from sim.surface import as_fabricated
from tests.doedesign.small_runs import SPREAD

ROBUST = SPREAD.replace("steps = 0", "steps = 24\nlearning_rate = 0.5\nseed = 3\ncheckpoint_every = 1")
ROBUST += "\n[robust]\nsteps = 16\nlearning_rate = 0.05\n"


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(ROBUST)
    return path


def task_of(spec: Path) -> tuple[RobustTask, Problem, SourceSet]:
    read = load_spec(spec)
    problem, scene = problem_of(read, {})
    return RobustTask.of(read, problem, scene), problem, scene


def test_risks_and_their_derivatives() -> None:
    losses = np.array([1.0, 3.0, 2.0, 4.0])
    assert risk_of(losses, RobustSpec())[0] == 2.5
    worst = RobustSpec(measure="cvar", share=0.6)
    # 2.4 plates of the worst: 4, 3 and four tenths of 2.
    assert risk_of(losses, worst)[0] == pytest.approx((4 + 3 + 0.4 * 2) / 2.4, rel=1e-12)
    bad = RobustSpec(measure="yield", limit=2.5)
    assert risk_of(losses, bad)[0] == pytest.approx(0.5, abs=1e-4)  # edges are 0.05 wide, ten of them away
    for robust in (RobustSpec(), worst, RobustSpec(measure="yield", limit=2.95)):
        _, weights = risk_of(losses, robust)
        for place in range(4):
            moved = losses + 1e-6 * np.eye(4)[place]
            slope = (risk_of(moved, robust)[0] - risk_of(losses, robust)[0]) / 1e-6
            assert weights[place] == pytest.approx(slope, abs=1e-4)


def test_walls_cost_the_light_that_goes_astray_beside_them() -> None:
    """By many draws of the displacement of an edge, of a mask that etches a quarter wave."""
    levels = Levels(4, 300e-9)
    spreads = {
        "overlay_x_m[0]": Normal(0.0, 0.4e-6),
        "overlay_y_m[0]": Normal(0.0, 0.4e-6),
        "cd_bias_m[1]": Normal(0.1e-6),
    }
    costs = wall_costs(Process(levels, spreads=spreads), 2e-6)
    strips = np.abs(np.random.default_rng(0).normal(0, 0.4e-6, 200_000)) / 2e-6
    # 1 - cos of a quarter of a wave is 1, of half a wave 2. Four standard deviations of the mean: 0.0005.
    assert costs[0] == pytest.approx(strips.mean() * 1.0, abs=5e-4)
    assert costs[1] == pytest.approx(np.sqrt(2 / np.pi) * 0.1e-6 / 2e-6 * 2, rel=1e-9)


def test_plates_have_opposite_errors_and_the_worst_stays(spec: Path) -> None:
    task, _, _ = task_of(spec)
    drawn = task.variations(0, np.array([-1, -1]))
    overlay = [np.mean([float(x) for x in one.overlay_x_m]) for one in drawn]
    depth = [float(one.common_depth_scale) for one in drawn]
    for values in (overlay, depth):
        assert values[0] == -values[1] != 0
        assert values[2] == -values[3] != values[0]
    again = task.variations(1, np.array([0, 2]))
    assert again[-1] == drawn[2]
    assert again[0] != drawn[0]


def test_a_worst_plate_that_is_carried_on_keeps_its_errors(spec: Path) -> None:
    task, _, _ = task_of(spec)
    begun = task.initial_state(np.zeros((48, 48), np.uint8))
    assert task.worst_of(begun, -1).tolist() == [-1, -1]
    first = begun._replace(losses=np.array([1.0, 3.0, 2.0, 2.5]))
    assert task.worst_of(first, 0).tolist() == [0, 1]
    last = begun._replace(losses=np.array([1.0, 2.0, 2.0, 2.5]))
    assert task.worst_of(last, 0).tolist() == [0, 3]  # of the first round, which carries none
    # In the second round the last plate is that of the first one.
    carried = last._replace(worst=np.array([0, 1]))
    assert task.variations(1, task.worst_of(carried, 1))[-1] == task.variations(0, task.worst_of(begun, -1))[1]


def test_the_worst_plate_is_that_of_the_highest_mean(spec: Path) -> None:
    """Of six plates in twenty steps the first four are looked at seven times, the others six times."""
    task, _, _ = task_of(spec)
    task = task._replace(spec=load_spec(spec, ["robust.draws=6"]))
    begun = task.initial_state(np.zeros((48, 48), np.uint8))
    losses = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.1]) * [7, 7, 7, 7, 6, 6]
    assert task.worst_of(begun._replace(losses=losses), 0).tolist() == [0, 5]


def test_no_study_judges_by_plates_that_the_steps_saw(spec: Path) -> None:
    """Errors of a round are none of the draws of a tolerance study of the same seed."""
    read = load_spec(spec)
    process, nothing = process_from_spec(read.process), cast("Any", None)  # errors are drawn without light
    task = RobustTask(read, nothing, nothing, process, nothing)
    judged = [normal_draw(process, read.optimize.seed, index, 1e-3) for index in range(20)]
    known = {name: {draw.value(name) for draw in judged} for name in varying(process)}
    assert known
    for round_ in range(3):
        for plate in task.variations(round_, np.full(2, -1)):
            assert not any(plate.value(name) in values for name, values in known.items())


def test_roughness_is_drawn_anew_in_every_round(spec: Path) -> None:
    task, _, _ = task_of(spec)
    seeds = [one.seed for round_ in range(3) for one in task.variations(round_, np.array([-1, -1]))]
    assert len(set(seeds)) == len(seeds)


@pytest.mark.parametrize("draws", [1, 2, 3, 4])
def test_every_plate_counts_alike_in_the_mean(spec: Path, draws: int) -> None:
    task, _, _ = task_of(spec)
    count = -(-draws // 2)
    task = task._replace(spec=load_spec(spec, [f"robust.draws={draws}"]))
    weights = np.zeros(draws)
    for place in range(count):
        seen, share = task.seen(place)
        weights[seen.start : seen.stop] += share * risk_of(np.ones(len(seen)), task.robust)[1] / count
    assert weights == pytest.approx(np.full(draws, 1 / draws))
    compared = task._replace(spec=load_spec(spec, [f"robust.draws={draws}", "robust.measure=cvar"]))
    assert compared.seen(1) == (range(draws), 1.0)


@pytest.mark.slow
def test_a_plate_has_the_light_of_the_model_of_the_process(spec: Path) -> None:
    """The PSF of heights times their deviation is that of the DOE as fabricated, from the axis of a far source."""
    task, problem, _ = task_of(spec)
    level = np.random.default_rng(1).integers(0, 4, (48, 48)).astype(np.uint8)
    errors = task.variations(0, np.array([-1, -1]))[0]
    level = task.rules.blank.with_level(level).level
    plate = task.plate(level, errors)
    optic = plate.optic.with_heights(problem.parametrization.drawn_height(level))
    made = as_fabricated(level, problem.camera, task.process, errors)
    ours, due = (np.asarray(psf(one, depths=(np.inf,)).energy) for one in (optic, made))
    # Single precision of two ways to the same field.
    np.testing.assert_allclose(ours, due, atol=2e-5 * due.max(), rtol=0)


@pytest.mark.slow
def test_a_window_wider_than_moments_of_whole_cells_reach(spec: Path) -> None:
    """A plate as fabricated has halves of cells there; the steps stay on the cells, near to the light of those."""
    wide = ROBUST.replace('pitch = "1.85 um"\naperture = "88.8 um"', 'pitch = "3.7 um"\naperture = "177.6 um"')
    spec.write_text(wide.replace("window = 32", "window = 80"))
    task, problem, _ = task_of(spec)
    level = task.rules.blank.with_level(np.random.default_rng(1).integers(0, 4, (48, 48)).astype(np.uint8)).level
    errors = task.variations(0, np.array([-1, -1]))[0]
    made = as_fabricated(level, problem.camera, task.process, errors)
    assert made.grid.shape == (96, 96)
    optic = task.plate(level, errors).optic.with_heights(problem.parametrization.drawn_height(level))
    ours, due = (np.asarray(psf(one, depths=(np.inf,)).energy) for one in (optic, made))
    assert np.linalg.norm(ours - due) < 0.1 * np.linalg.norm(due)
    assert len(optimize(load_spec(spec, ["optimize.steps=2", "robust.steps=2"])).history) == 4


@pytest.mark.slow
def test_the_risk_of_plates_falls(spec: Path) -> None:
    task, problem, scene = task_of(spec)
    nominal = optimize(load_spec(spec, ["optimize.steps=80", "robust.steps=0"]))
    robust = optimize(load_spec(spec, ["optimize.steps=80", "robust.steps=48"]))
    unseen = task._replace(spec=load_spec(spec, ["optimize.seed=99"]))
    plates = unseen.variations(7, np.array([-1, -1]))

    def mean_loss(design: Design) -> float:
        level = design.level_map.level
        height = problem.parametrization.drawn_height(level)
        looks = [scene.look(5, step) for step in range(4)]
        return float(
            np.mean([float(value_and_slope(unseen.plate(level, v), height, k)[0]) for v in plates for k in looks])
        )

    assert mean_loss(robust) < mean_loss(nominal)
    assert len(robust.history) == 80 + 48
    assert robust.history[-1]["names"] == robust.history[0]["names"] == ["far_spot", "near_spread"]


@pytest.mark.slow
def test_a_stopped_run_goes_on_with_its_plates(spec: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robust_steps, "ROUND", 8)
    whole = optimize(spec, tmp_path / "whole")
    save, done = optimization.save_checkpoint, []

    def stop_late(*given: object) -> None:
        save(*given)  # pyright: ignore[reportArgumentType]
        done.append(given)
        if len(done) == 24 + 8 + 3:  # in the middle of the second round
            raise KeyboardInterrupt

    monkeypatch.setattr(optimization, "save_checkpoint", stop_late)
    with pytest.raises(KeyboardInterrupt):
        optimize(spec, tmp_path / "again")
    monkeypatch.setattr(optimization, "save_checkpoint", save)
    again = optimize(spec, tmp_path / "again")
    assert np.array_equal(whole.level_map.level, again.level_map.level)
    assert whole.history == again.history


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["robust.measure=yield"], "needs the loss of a good plate"),
        ([f"robust.draws={2 * robust_steps.ROUND + 1}"], f'"mean" looks at {2 * robust_steps.ROUND} plates at most'),
        (["robust.draws=0"], "robust.draws"),
        (["robust.share=0.0"], "robust.share"),
        (["optimize.polish=2"], "moves of cells would undo it"),
        (["optimize.quantisation=none"], "masks have levels"),
        (["optimize.parametrization=radial"], "masks are of cells"),
        (['process.etch_depths="optimize"'], "the depths must be known"),
        (["optics.light=edges"], "light is scalar"),
        (["robust.depths=range", "objective=[{name='far_spot', over='worst'}]"], "no objective may compare depths"),
        (["robust.field=random", "optics.mapping=tangent"], "the lens images sines"),
        (["robust.field=random", "illumination={kind='gaussian', diameter='50 um'}"], "a beam has its own direction"),
    ],
)
def test_what_cannot_be_is_told(spec: Path, change: list[str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_spec(spec, change)


def test_a_process_without_errors_has_no_risk(spec: Path) -> None:
    read = load_spec(spec)
    problem, scene = problem_of(read, {})
    exact = read.process.model_copy(update={"errors": ErrorsSpec()})
    with pytest.raises(InputError, match="plates must differ"):
        RobustTask.of(read.model_copy(update={"process": exact}), problem, scene)


def test_sources_lie_between_the_listed_depths_and_on_all_of_the_sensor(spec: Path) -> None:
    read = load_spec(
        spec,
        ["robust.depths=range", "robust.field=random", 'scene.near=["6 mm", "12 mm"]', 'scene.far=["0.5 m", "inf"]'],
    )
    problem, scene = problem_of(read, {})
    task = RobustTask.of(read, problem, scene)
    assert task.ranges is not None
    places = [task.ranges.places(((), ()), 3, step) for step in range(200)]
    near, far = (1 / np.array([getattr(one, side) for one in places])[:, 0] for side in ("near_m", "far_m"))
    tangents = np.tan([one.field_rad for one in places]) / (np.array([240, 320]) * 1.85e-6 / 1e-3)
    # Evenly over the inverse depths and over the sensor, whose half is 1 here: means within four standard deviations.
    for found, (low, high) in (
        (near, (1 / 12e-3, 1 / 6e-3)),
        (far, (0.0, 2.0)),
        (tangents[:, 0], (-1.0, 1.0)),
        (tangents[:, 1], (-1.0, 1.0)),
    ):
        assert found.min() > low - 1e-9
        assert found.max() < high + 1e-9
        assert abs(found.mean() - (low + high) / 2) < 4 * (high - low) / np.sqrt(12 * 200)
    look = task.look(3)
    drawn = task.ranges.places(((), ()), read.optimize.seed, 3)
    due = problem.optic.source(problem.optic.lines[0], drawn.near_m[0], drawn.field_rad)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(np.array_equal(a, b)), look.near[0][0].wave, due))


def test_the_plain_lens_is_known_between_the_listed_depths(spec: Path) -> None:
    read = load_spec(spec, ["robust.depths=range", 'scene.near=["6 mm", "12 mm"]'])
    problem, scene = problem_of(read, {})
    ranges = RobustTask.of(read, problem, scene).ranges
    assert ranges is not None
    for step in range(3):
        places = ranges.places(((), ()), 4, step)
        look = ranges.look(problem, scene.look(0, step), places)
        due = psf(HeightOptic.of(problem.camera), depths=places.near_m)
        # Interpolation between 9 depths whose blur differs by a factor of 4.
        assert np.asarray(look.lens) == pytest.approx(np.asarray(participation(jnp.asarray(due.energy))), rel=0.02)
        blurred_m = problem.camera.defocus_radius_m(places.near_m[0]) + problem.camera.pixel_m
        assert np.asarray(look.disc_radius_m) == pytest.approx(blurred_m, rel=1e-6)  # single precision


def test_listed_sources_on_the_axis_are_those_of_other_steps(spec: Path) -> None:
    """Ranges without width are the listed sources themselves."""
    task, problem, scene = task_of(spec)
    ranges = SourceRange.of(task.spec, problem, between=False, beside=False)
    look, listed = task._replace(ranges=ranges).look(5), scene.look(task.spec.optimize.seed, 5)
    same = jax.tree.map(lambda a, b: bool(np.allclose(a, b, rtol=1e-6)), look, listed)
    assert jax.tree.all(same)


@pytest.mark.slow
def test_a_robust_design_of_all_depths_and_angles(spec: Path) -> None:
    found = optimize(load_spec(spec, ["robust.depths=range", "robust.field=random", "optimize.steps=6"]))
    assert len(found.history) == 6 + 16
    assert all(np.isfinite(line["loss"]) for line in found.history)
