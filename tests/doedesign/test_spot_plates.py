"""Spots of plates as fabricated: closed forms, a fine raster, the model of the process, and what an exchange gains."""

from pathlib import Path

import numpy as np
import pytest

from doedesign.build import process_from_spec
from doedesign.optimization import optimize
from doedesign.spec import Spec, load_spec
from doedesign.spec.targets.arrangements import grid_orders
from doedesign.spots import design, plate_sums
from doedesign.spots.design import SpotTask, orders_of_design
from doedesign.spots.plates import SpotPlates, plates_of
from doedesign.spots.problem import SpotProblem
from doedesign.spots.spots import Spots, shares_of
from doedesign.spots.superposition import Staircase
from fab.errors import InputError
from fab.grid import Grid
from fab.levels import Levels
from fab.process import Normal, Process, Variation
from tests.doedesign.test_spots_run import spec_of

PITCH_M, WAVES_PER_M = 2e-6, 1 / 1152e-9
ROW = (
    "process.levels=16", "process.level_step=72 nm", "process.stock=contact_aligner", "spots.count=[9, 1]",
    "spots.period=192 um", "spots.starts=200", "doe.samples=192", "doe.aperture=384 um",
)  # fmt: skip
MADE = "spots.uniformity_as_fabricated=1.5"


def problem(shape: tuple[int, int], count: tuple[int, int], levels: Levels) -> SpotProblem:
    orders, steps = grid_orders(count), (1 / (shape[0] * PITCH_M), 1 / (shape[1] * PITCH_M))
    spots = Spots(orders * np.array(steps), shares_of((), len(orders)), orders, steps)
    staircase = Staircase.of(2 * np.pi * WAVES_PER_M * levels.heights_m())
    return SpotProblem.on(Grid(shape, PITCH_M), np.ones(shape, np.float32), spots, staircase)


def plates(of: SpotProblem, levels: Levels, *errors: Variation) -> SpotPlates:
    return SpotPlates.of(of, Process(levels), [WAVES_PER_M], errors)


def test_a_grating_with_wide_openings_too_deep_and_displaced():
    """Orders of a rectangular groove: its width and depth count, not its place."""
    levels = Levels(2, 300e-9)
    row = problem((1, 200), (5, 1), levels)
    level = np.ones((1, 200), np.uint8)
    level[0, 30:110] = 0
    off = plates(row, levels, Variation(common_cd_bias_m=0.3e-6, common_depth_scale=0.1, overlay_x_m=(0.7e-6,)))
    found = np.abs(off.amplitudes(level)[:, 0]) ** 2
    step, duty = np.exp(-2j * np.pi * WAVES_PER_M * 330e-9) - 1, (80 + 2 * 0.15) / 200
    order = np.arange(-2, 3)
    wanted = np.abs(step * duty * np.sinc(order * duty) + (order == 0)) ** 2
    # Light of a strip lies at its wall instead of a quarter of a cell beside it, 0.016 radian at the second order, and
    # strips have 1/200 of the period: 1e-4 of the amplitude, which is below 1.
    assert found == pytest.approx(wanted, abs=2e-4)
    undone = np.abs(plates(row, levels, Variation()).amplitudes(level)[:, 0]) ** 2
    assert np.abs(undone - wanted).max() > 0.01


def test_without_errors_it_is_the_plate_as_drawn():
    levels = Levels(16, 72e-9)
    square = problem((12, 12), (3, 3), levels)
    level = np.random.default_rng(1).integers(0, 16, (12, 12)).astype(np.uint8)
    found = plates(square, levels, Variation()).amplitudes(level)[:, 0]
    # Heights are counted from the blank glass or from the deepest floor. The other is in single precision.
    raised = np.exp(2j * np.pi * WAVES_PER_M * levels.total_m)
    assert np.abs(found * raised - square.amplitudes(level)).max() < 1e-5


def raster(level: np.ndarray, levels: Levels, errors: Variation, fine: int) -> np.ndarray:
    """Field of a row made mask by mask, `fine` samples per cell: shifted, and dilated or eroded about every sample."""
    etched_m = np.zeros(level.size * fine)
    for mask, depth_m in enumerate(levels.depths_m):
        drawn = np.repeat((levels.count - 1 - level[0].astype(int)) >> mask & 1, fine)
        drawn = np.roll(drawn, round(errors.overlay_x_m[mask] / PITCH_M * fine))
        grown = round((errors.common_cd_bias_m + errors.cd_bias_m[mask]) / PITCH_M * fine)
        moved = [np.roll(drawn, by) for by in range(-abs(grown), abs(grown) + 1)]
        printed = np.max(moved, axis=0) if grown >= 0 else np.min(moved, axis=0)
        etched_m += printed * depth_m * (1 + errors.depth_scale[mask])
    return np.exp(-2j * np.pi * WAVES_PER_M * etched_m)


@pytest.mark.parametrize("count", [16, 11])  # 11: strips of masks that are no level
def test_walls_that_several_masks_share(count: int):
    levels = Levels(count, 1152e-9 / count)
    row = problem((1, 240), (5, 1), levels)
    rng = np.random.default_rng(count)
    level = np.repeat(rng.integers(0, count, (1, 24)), 10, axis=1).astype(np.uint8)
    errors = Variation(
        overlay_x_m=(0.5e-6, -0.3e-6, 0.9e-6, -0.7e-6),
        common_cd_bias_m=0.1e-6,
        cd_bias_m=(0.2e-6, -0.4e-6, 0.3e-6, 0.0),
        depth_scale=(0.03, -0.02, 0.01, 0.02),
    )
    fine = 200  # all edges lie on its samples
    field = raster(level, levels, errors, fine)
    place = (np.arange(field.size) + 0.5) / field.size - 0.5
    wanted = [np.mean(field * np.exp(-2j * np.pi * order * place)) for order in range(-2, 3)]
    found = plates(row, levels, errors).amplitudes(level)[:, 0]
    assert np.abs(found[2] - wanted[2]) < 1e-6  # single precision
    # In the others, light of 24 walls lies up to 0.02 radian beside them, in strips of 1/500 of the period.
    assert np.abs(found - wanted).max() < 5e-4
    undone = plates(row, levels, Variation()).amplitudes(level)[:, 0]
    assert np.abs(undone - wanted).max() > 0.02


def test_rows_and_columns_are_alike():
    levels = Levels(16, 72e-9)
    rng = np.random.default_rng(3)
    level = rng.integers(0, 16, (10, 10)).astype(np.uint8)
    y, x = (0.4e-6, 0.1e-6, 0.0, -0.6e-6), (-0.2e-6, 0.3e-6, 0.5e-6, 0.0)
    square = problem((10, 10), (3, 3), levels)
    found = plates(square, levels, Variation(overlay_y_m=y, overlay_x_m=x)).amplitudes(level)[:, 0]
    turned = plates(square, levels, Variation(overlay_y_m=x, overlay_x_m=y)).amplitudes(level.T.copy())[:, 0]
    assert np.abs(found.reshape(3, 3) - turned.reshape(3, 3).T).max() < 1e-6


@pytest.mark.parametrize("shape", [(5, 6), (1, 8), (7, 1), (2, 3)])
def test_a_cell_takes_its_light_and_that_of_its_walls_along(shape: tuple[int, int]):
    """What an exchange adds and takes away for one cell, against the sum of all cells and walls, at every cell."""
    levels, rng = Levels(8, 144e-9), np.random.default_rng(7)
    cells = problem(shape, (3 if shape[1] > 1 else 1, 3 if shape[0] > 1 else 1), levels)
    errors = Variation(overlay_x_m=(0.4e-6, -0.3e-6, 0.2e-6), overlay_y_m=(-0.5e-6, 0.1e-6, 0.6e-6))
    made = plates(cells, levels, errors, Variation(common_cd_bias_m=0.3e-6))
    level = rng.integers(0, 8, shape).astype(np.uint8)
    light = made.amplitudes(level)
    for y, x in np.ndindex(shape):
        other = level.copy()
        other[y, x] = (level[y, x] + rng.integers(1, 8)) % 8
        found = light.copy()
        for sign, own in ((-1.0, int(level[y, x])), (1.0, int(other[y, x]))):
            plate_sums._add_cell.py_func(found, level, y, x, own, sign, *made.tables)
        np.testing.assert_allclose(found, made.amplitudes(other), rtol=0, atol=1e-12)  # double precision


def test_the_merit_of_plates_is_that_of_its_formula():
    """Light of 2 spots with shares of 1 to 3 on 3 plates: their mean sum, and fourth powers of what is unequal."""
    rng, shares = np.random.default_rng(8), np.array([0.25, 0.75])
    light = rng.normal(size=(2, 3)) + 1j * rng.normal(size=(2, 3))
    power = np.abs(light) ** 2
    off = power / shares[:, None] / (power / shares[:, None]).mean(0) - 1
    wanted = power.sum() / 3 - 0.6 * 1.4 * np.mean(off**4) ** 0.25
    assert plate_sums.merit_of.py_func(light, shares, 0.6) == pytest.approx(wanted, rel=1e-12)
    assert np.isfinite(plate_sums.merit_of.py_func(0 * light, shares, 0.6))


def test_plates_come_in_opposite_pairs():
    process = Process(
        Levels(4, 288e-9), spreads={"overlay_x_m[0]": Normal(0.0, 1e-6), "cd_bias_m[1]": Normal(1e-7, 2e-7)}
    )
    found = plates_of(process, 6, 5)
    assert len(found) == 6
    for one, other in zip(found[::2], found[1::2], strict=True):
        assert one.overlay_x_m[0] == pytest.approx(-other.overlay_x_m[0])
        assert one.cd_bias_m[1] + other.cd_bias_m[1] == pytest.approx(2e-7)
    assert found == plates_of(process, 6, 5) != plates_of(process, 6, 6)


@pytest.mark.slow
def test_an_exchange_never_loses_and_repeats_itself():
    levels = Levels(8, 144e-9)
    square = problem((12, 12), (3, 3), levels)
    process = Process(levels, spreads={f"overlay_x_m[{mask}]": Normal(0.0, 4e-7) for mask in range(3)})
    made = SpotPlates.of(square, process, [WAVES_PER_M], plates_of(process, 8, 1))
    level = np.random.default_rng(2).integers(0, 8, (12, 12)).astype(np.uint8)
    one, again = (made.exchanged(level, sweeps=20, seed=4, uniformity=0.5, heat=1e-3) for _ in range(2))
    assert np.array_equal(one, again)
    # From noise much is to be won, and the merit that guided the exchange is that of its result, summed anew.
    assert made.merit(one, 0.5) > made.merit(level, 0.5) + 0.1
    unequal = made.uniformity_errors(one)
    assert unequal.shape == (8,)
    over = np.abs(made.amplitudes(one)) ** 2
    assert unequal == pytest.approx((over.max(axis=0) - over.min(axis=0)) / (over.max(axis=0) + over.min(axis=0)))


def cell_of(spec: Spec) -> tuple[SpotTask, SpotProblem, np.ndarray]:
    """Task of a spec with a row of orders, and the unit cell that is designed."""
    task = SpotTask.from_spec(spec)
    assert isinstance(task.problem, SpotProblem)
    level = optimize(spec).level_map.level
    return task, task.problem, level[level.shape[0] // 2, : task.problem.grid.shape[1]][None].copy()


@pytest.mark.slow
def test_spots_stay_more_equal_on_plates_that_no_step_has_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # A quarter of the offers, for seconds instead of half a minute.
    for name in ("_TRIAL_OFFERS", "_LAST_OFFERS"):
        monkeypatch.setattr(design, name, getattr(design, name) // 4)
    unseen, found = None, []
    for changes in (ROW, (*ROW, MADE)):
        spec = spec_of(tmp_path, *changes)
        task, own, cell = cell_of(spec)
        process = process_from_spec(spec.process)
        rate = task.camera.waves_per_metre(task.camera.lines[0].wavelength_m)
        unseen = unseen or plates_of(process, 400, 99)
        of = SpotPlates.of(own, process, [rate], unseen)
        light = np.abs(of.amplitudes(cell)) ** 2
        found.append((np.percentile(of.uniformity_errors(cell), 95), light.sum(axis=0).mean()))
    (nominal, light), (kept, kept_light) = found
    assert kept < nominal / 1.3
    assert kept_light > 0.97 * light


@pytest.mark.slow
def test_it_agrees_with_the_model_of_the_process(tmp_path: Path):
    """`sim.surface` cuts cells into pieces and keeps their moments; straight walls, so nothing is left out here."""
    spec = spec_of(tmp_path, *ROW)
    task, own, cell = cell_of(spec)
    drawn, process = optimize(spec), process_from_spec(spec.process)
    rate = task.camera.waves_per_metre(task.camera.lines[0].wavelength_m)
    drawn_light = np.abs(own.amplitudes(cell)) ** 2
    for errors in plates_of(process, 4, 7):
        alone = Variation(
            common_depth_scale=errors.common_depth_scale, depth_scale=errors.depth_scale,
            overlay_x_m=errors.overlay_x_m, cd_bias_m=errors.cd_bias_m, sidewall_rad=errors.sidewall_rad,
        )  # fmt: skip
        made = SpotPlates.of(own, process, [rate], [alone])
        light = np.abs(made.amplitudes(cell)[:, 0]) ** 2
        (table,) = orders_of_design(drawn, drawn.fabricated(variation=alone))
        # Light of strips lies up to 0.1 radian beside walls at the fourth order of 96 cells: found 1.6 % of a spot.
        assert table.efficiency == pytest.approx(light, abs=0.02 * light.mean())
        assert np.abs(table.efficiency - drawn_light).max() > 0.05 * light.mean()


def test_what_cannot_be_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="plates must differ"):
        SpotTask.from_spec(spec_of(tmp_path, MADE))
    with pytest.raises(InputError, match=r"unit cell are exchanged.*Give spots\.period"):
        load_spec(free_spec(tmp_path), [MADE, "process.stock=contact_aligner"])
    with pytest.raises(InputError, match="phases of spots must be free"):
        spec_of(
            tmp_path, MADE, "spots.count=[2, 1]", 'spots.phases=["0 rad", "1 rad"]', "process.stock=contact_aligner"
        )
    with pytest.raises(InputError, match="at most 65536 cells, but got 262144"):
        spec_of(tmp_path, "doe.samples=512", "doe.aperture=1.024 mm", "spots.period=1.024 mm", MADE)


def free_spec(tmp_path: Path) -> Path:
    """The spec without a unit cell."""
    path = tmp_path / "free.toml"
    path.write_text((tmp_path / "fan.toml").read_text().replace('period = "48 um"', 'spacing = "120 um"'))
    return path
