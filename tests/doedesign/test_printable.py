"""Designs whose masks obey rules at every step."""

import contextlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doedesign.design.design import Design
from doedesign.design.levels.parametrize import LevelParametrization
from doedesign.design.levels.printable import PrintableLevels
from doedesign.design.problem import problem_of
from doedesign.optimization import optimize
from doedesign.spec import Spec, load_spec
from fab.aperture import RoundAperture
from fab.errors import InputError
from fab.grid import Grid
from fab.levels import Levels, planes
from fab.rules.check import Rules, check
from tests.doedesign.small_runs import SPREAD

UM = 1e-6


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SPREAD.replace("steps = 0", "steps = 24\nlearning_rate = 0.5\nseed = 3"))
    return path


def last_losses(design: Design) -> float:
    return float(np.mean([one["loss"] for one in design.history[-3:]]))


@pytest.mark.slow
@pytest.mark.parametrize("sets", [[], ["optimize.drawn_pixel=3.7 um"]])
def test_no_rule_is_ever_broken_and_little_is_lost(spec: Path, sets: list[str]) -> None:
    free, bound = (optimize(load_spec(spec, [*sets, *more])) for more in ([], ["optimize.min_feature=3.7 um"]))
    rules = Rules(3.7 * UM, 3.7 * UM)
    assert not check(free.level_map, rules).clean
    assert check(bound.level_map, rules).clean
    # Flat glass has a loss of 2 here (all light in a spot as sharp as the lens's), so the gain is 2 - loss.
    assert 2 - last_losses(bound) > 0.8 * (2 - last_losses(free))


@pytest.mark.slow
def test_pixels_that_are_drawn_are_whole_cells(spec: Path) -> None:
    level = optimize(load_spec(spec, ["optimize.drawn_pixel=3.7 um", "optimize.steps=4"])).level_map
    inside = level.relief.inside(level.grid)
    blocks = level.level.reshape(24, 2, 24, 2).swapaxes(1, 2).reshape(24, 24, 4)
    whole = inside.reshape(24, 2, 24, 2).swapaxes(1, 2).reshape(24, 24, 4).all(2)
    assert np.all(blocks[whole] == blocks[whole][:, :1])
    assert len(np.unique(blocks[whole])) > 2


def test_the_gradient_of_a_pixel_is_that_of_its_cells(spec: Path) -> None:
    problem, _ = problem_of(load_spec(spec, ["optimize.drawn_pixel=3.7 um"]), {})
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(48, 48)), jnp.float32)
    slope = jax.grad(lambda drawn: jnp.vdot(weight, problem.parametrization.cells(drawn)))(jnp.zeros((24, 24)))
    np.testing.assert_allclose(slope, np.asarray(weight).reshape(24, 2, 24, 2).sum((1, 3)), atol=1e-6)


@pytest.mark.slow
def test_edges_are_fewer_where_walls_cost(spec: Path) -> None:
    def depth_of_walls(weight: float) -> int:
        design = optimize(load_spec(spec, ["optimize.min_feature=1 um", f"optimize.wall_weight={weight}"]))
        every = planes(design.level_map.level, design.levels)
        return sum(2**k * int(np.sum(np.diff(p, axis=a) != 0)) for k, p in enumerate(every.astype(int)) for a in (0, 1))

    assert depth_of_walls(3.0) < 0.8 * depth_of_walls(0.0)


@pytest.mark.slow
def test_a_stopped_run_goes_on_with_its_printed_map(
    spec: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sets = ["optimize.min_feature=3.7 um", "optimize.checkpoint_every=1"]
    whole = optimize(spec, tmp_path / "whole", overrides=sets)
    from doedesign import optimization

    save, done = optimization.save_checkpoint, []

    def stop_late(*given: object) -> None:
        save(*given)  # pyright: ignore[reportArgumentType]
        done.append(given)
        if len(done) == 19:  # in the second half, which looks at printed maps
            raise KeyboardInterrupt

    monkeypatch.setattr(optimization, "save_checkpoint", stop_late)
    with contextlib.suppress(KeyboardInterrupt):
        optimize(spec, tmp_path / "again", overrides=sets)
    assert len(done) == 19
    monkeypatch.undo()
    again = optimize(spec, tmp_path / "again", overrides=sets)
    assert np.array_equal(whole.level_map.level, again.level_map.level)
    assert whole.history == again.history


def test_coarse_pixels_that_the_rim_cuts_stay_blank() -> None:
    staircase = LevelParametrization.at("fused_silica", 550e-9, Levels(4, 300e-9), block=2)
    rules = PrintableLevels.on(Grid((48, 48), UM), RoundAperture(40 * UM), staircase, 2 * UM)
    level = rules.first(np.zeros((24, 24), np.uint8))
    inside = RoundAperture(40 * UM).inside(Grid((48, 48), UM)).reshape(24, 2, 24, 2).all((1, 3))
    assert np.array_equal(level == 0, inside)
    with pytest.raises(InputError, match="must not exceed 32 pixels"):
        PrintableLevels.on(Grid((48, 48), UM), RoundAperture(40 * UM), staircase, 66 * UM)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["optimize.min_feature=2 um", "optimize.polish=3"], "moves of cells would break it"),
        (["optimize.min_feature=2 um", "optimize.quantisation=none"], "masks have levels"),
        (["optimize.min_feature=2 um", "optimize.parametrization=radial"], "rings break it"),
        (["optimize.min_feature=2 um", 'process.etch_depths="optimize"'], "the depths must be known"),
        (["optimize.wall_weight=0.1"], "goes with a min_feature"),
        (["optimize.min_feature=0 um"], "optimize.min_feature"),
        (["optimize.drawn_pixel=2 um"], "whole number of cells"),
        (["optimize.drawn_pixel=9.25 um"], "must divide the 48 x 48 cells"),
        (["optimize.drawn_pixel=3.7 um", "optimize.parametrization=radial"], "rings are drawn of cells"),
    ],
)
def test_what_cannot_be_is_told(spec: Path, change: list[str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_spec(spec, change)


def test_learnt_optics_do_not_break_it_unawares(spec: Path) -> None:
    from doedesign.capture.from_spec import obstruction_from_spec
    from doedesign.training.joint import Trainer

    read: Spec = load_spec(spec, ["optimize.min_feature=2 um", "obstruction.kind=dirt"])
    with pytest.raises(InputError, match="would not keep it"):
        Trainer.of(read, "small.toml", "radiometric", obstruction_from_spec(read, "small.toml"), np.zeros((48, 48)))
