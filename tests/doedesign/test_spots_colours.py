"""Spots of several colours at once: levels that suit all of them, and a plate judged by sums of its own."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import doedesign.optimization as optimization
import doedesign.spots.design as spots_design
from doedesign.optimization import optimize
from doedesign.overview.listing import list_results
from doedesign.prediction import on_target, predict
from doedesign.spec import Spec, load_spec, spec_to_toml
from doedesign.spots.design import SpotTask, orders_of_design
from doedesign.spots.exchange import exchange
from doedesign.spots.orders import OrderTables
from doedesign.spots.plates import SpotPlates
from doedesign.spots.problem import SharedProblem, SpotProblem
from doedesign.spots.search import search_phases, search_points
from doedesign.spots.spots import Spots
from doedesign.spots.superposition import Staircase, WaveSet, shared_level
from fab.errors import InputError
from fab.grid import Grid
from fab.levels import Levels
from fab.process import Process, Variation
from sim.material import refractive_index
from tests.doedesign.test_spots import PITCH_M, orders_of
from tests.doedesign.test_spots_run import SPEC
from tests.pictures import leave_out_pictures

WAVELENGTHS_M = (638e-9, 450e-9)
# Two and a half waves deep for red: what is one wave for blue is none for red.
TWO = ['optics.wavelengths=["638 nm", "450 nm"]', 'optics.design_wavelength="450 nm"', "process.levels=32",
       'process.level_step="106 nm"', 'spots.colours=["638nm", "450nm"]']  # fmt: skip


def spec_of(tmp_path: Path, *overrides: str) -> Spec:
    path = tmp_path / "fan.toml"
    path.write_text(SPEC)
    return load_spec(path, [*TWO, *overrides])


def staircases(count: int, step_m: float) -> list[Staircase]:
    rates = [(refractive_index("fused_silica", one) - 1) / one for one in WAVELENGTHS_M]
    return [Staircase.of(2 * np.pi * rate * step_m * np.arange(count)) for rate in rates]


def shared(cells: int, count: tuple[int, int]) -> SharedProblem:
    shape = (cells if count[1] > 1 else 1, cells if count[0] > 1 else 1)
    parts = [
        SpotProblem.on(Grid(shape, PITCH_M), np.ones(shape, np.float32), orders_of(count, cells), one)
        for one in staircases(16, 212e-9)
    ]
    return SharedProblem.of(parts)


def test_a_level_suits_the_fields_of_all_colours_best(rng: np.random.Generator):
    known = staircases(16, 150e-9)
    fields = [rng.normal(size=(5, 7)) + 1j * rng.normal(size=(5, 7)) for _ in known]
    score = sum(np.real(field[..., None] * one.light.conj()) for field, one in zip(fields, known, strict=True))
    np.testing.assert_array_equal(shared_level(fields, known), np.argmax(score, axis=-1))


def test_for_one_colour_that_is_the_level_nearest_to_the_phase(rng: np.random.Generator):
    """The real part of field times conjugate light is largest where the phases are nearest."""
    (one, _) = staircases(16, 85e-9)
    field = rng.normal(size=1000) + 1j * rng.normal(size=1000)
    score = np.real(field[:, None] * one.light.conj())
    np.testing.assert_array_equal(shared_level([field], [one]), np.argmax(score, axis=-1))


def test_light_is_the_mean_of_the_colours_and_uniformity_that_of_the_worst(rng: np.random.Generator):
    problem = shared(24, (3, 3))
    level = rng.integers(0, 16, (24, 24)).astype(np.uint8)
    each, both = [one.light(level) for one in problem.parts], problem.light(level)
    assert both.efficiency == pytest.approx(np.mean([one.efficiency for one in each]), rel=1e-12)
    assert both.uniformity_error == pytest.approx(max(one.uniformity_error for one in each), rel=1e-12)
    # The sums of an exchange are those of the problem, which has single precision.
    whole = (problem.cell_waves * problem.level_light[level.ravel()]).sum(0)
    np.testing.assert_allclose(whole, problem.amplitudes(level), atol=1e-6)


def test_spots_of_colours_are_joined_and_parted():
    own = orders_of((3, 1), 16)
    alike = Spots.joined([own, own])
    assert (alike.count, alike.colours, alike.lattice_per_m) == (6, 2, own.lattice_per_m)
    assert alike.shares.sum() == pytest.approx(1)
    for part in alike.parts:
        np.testing.assert_array_equal(part.orders, own.orders)
        np.testing.assert_allclose(part.shares, own.shares)
    other = Spots.joined([own, replace(own, lattice_per_m=(1.0, 1.0))])
    assert other.lattice_per_m is None


def test_weights_follow_every_colour_by_itself():
    """Spots of one colour are equal, of the other one is too dark: only the latter are changed."""
    spots = Spots.joined([orders_of((3, 1), 16)] * 2)
    before = WaveSet(np.full(6, np.sqrt(1 / 6)), np.zeros(6))
    after = before.improved(np.array([0.3, 0.3, 0.3, 0.2, 0.1, 0.2]) + 0j, spots)
    np.testing.assert_allclose(after.weights[:3], before.weights[:3], rtol=1e-12)
    assert after.weights[4] > after.weights[3]
    assert np.linalg.norm(after.weights[3:]) == pytest.approx(np.sqrt(1 / 2))


def test_an_exchange_makes_the_spots_of_every_colour_equal():
    problem = shared(24, (3, 3))
    points = search_points(problem.spots, 0, (1.0, 1.0))
    known = [one.staircase for one in problem.parts]
    found = search_phases(problem.spots, points, starts=10, seed=0, uniformity=1.0, staircases=known).waves[0]
    before = problem.level(found)
    after = exchange(problem, before, sweeps=200, seed=0, uniformity=3.0, heat=1e-4)
    merits = [problem.light(one).merit(3.0) for one in (before, after)]
    assert merits[1] > merits[0]
    assert problem.light(after).uniformity_error < 0.05


def sums_of(level: np.ndarray, step_m: float, wavelength_m: float, cells: int, orders: int) -> np.ndarray:
    """Shares of the orders -n to n of a unit cell, by sums over its cells in double precision."""
    rate = (refractive_index("fused_silica", wavelength_m) - 1) / wavelength_m
    field = np.exp(2j * np.pi * rate * step_m * level.astype(float))
    spectrum = np.fft.fft2(field) / field.size
    every = np.arange(-orders, orders + 1)
    seen = np.outer(np.sinc(every / cells), np.sinc(every / cells))
    return np.abs(spectrum[np.ix_(every, every)] * seen) ** 2


@pytest.mark.slow
def test_one_plate_makes_the_same_orders_of_two_colours(tmp_path: Path):
    design = optimize(spec_of(tmp_path, "spots.uniformity=3", "optimize.steps=40"))
    table = on_target(design, design.as_optic())
    assert isinstance(table, OrderTables)
    cell = design.level_map.level[24:48, 24:48]
    for one, wavelength in zip(table.tables, WAVELENGTHS_M, strict=True):
        found = sums_of(cell, 106e-9, wavelength, 24, 1)
        np.testing.assert_allclose(np.sort(one.efficiency), np.sort(found.ravel()), atol=1e-6)
        # 83 and 86 %, 0.5 and 0.4 %. A plate for one colour has 92 % there, 20 % in the other, 74 to 92 % off.
        assert found.sum() > 0.78
        assert np.ptp(found) / (found.max() + found.min()) < 0.02
    told = table.measures()
    assert told["on_target"] == min(one.total for one in table.tables)
    assert told["uniformity_error"] == max(one.uniformity_error for one in table.tables)
    rows = predict(design, design.process(), Variation()).rows
    assert [("on_target" in row, row["colour"]) for row in rows] == [(True, "638nm"), (False, "450nm")]
    assert rows[0]["uniformity_error"] == pytest.approx(told["uniformity_error"], abs=1e-4)
    lines = table.to_csv().splitlines()
    assert lines[0].startswith("colour,order_x,order_y,")
    assert [line.split(",")[0] for line in lines[1:]] == ["638nm"] * 9 + ["450nm"] * 9
    table.plot()


@pytest.mark.slow
def test_spots_of_two_colours_lie_in_the_same_places(tmp_path: Path):
    path = tmp_path / "free.toml"
    path.write_text(SPEC.replace('period = "48 um"', 'spacing = "150 um"'))
    spec = load_spec(path, [*TWO, "doe.samples=192", "doe.aperture=0.384 mm", "optimize.steps=30"])
    table = on_target(design := optimize(spec), design.as_optic())
    assert isinstance(table, OrderTables)
    red, blue = (one.places_m for one in table.tables)
    np.testing.assert_allclose(red, blue, atol=1e-12)
    assert sorted(set(np.round(red[:, 0] * 1e6, 6))) == [-150, 0, 150]
    for one in table.tables:
        assert one.total > 0.6
        assert one.uniformity_error < 0.05


@pytest.mark.slow
def test_a_run_of_two_colours_goes_on_where_it_was_and_is_told_by_the_worst(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    leave_out_pictures(monkeypatch, optimization)
    spec = spec_of(tmp_path)
    whole = optimize(spec, tmp_path / "whole")
    save, calls = optimization.save_checkpoint, list[int]()

    def once(*asked: object) -> None:
        save(*asked)  # type: ignore[arg-type]
        calls.append(1)
        raise KeyboardInterrupt

    monkeypatch.setattr(optimization, "save_checkpoint", once)
    with pytest.raises(KeyboardInterrupt):
        optimize(spec, tmp_path / "stopped")
    monkeypatch.setattr(optimization, "save_checkpoint", save)
    again = optimize(spec, tmp_path / "stopped")
    assert calls
    np.testing.assert_array_equal(again.level_map.level, whole.level_map.level)

    metrics = json.loads((tmp_path / "whole" / "metrics.json").read_text())["orders"]
    assert [one["colour"] for one in metrics] == ["638nm", "450nm"]
    (record,) = list_results([tmp_path / "whole"])
    numbers = {one.key: one.value for one in record.numbers}
    assert numbers["on_target"] == pytest.approx(100 * min(one["on_target"] for one in metrics))
    assert numbers["uniformity_error"] == pytest.approx(100 * max(one["uniformity_error"] for one in metrics))


def test_plates_are_looked_at_in_every_colour(rng: np.random.Generator):
    """Each colour is a set of plates of its own, told by sums for that colour alone."""
    problem, levels = shared(24, (3, 3)), Levels(16, 212e-9)
    level = rng.integers(0, 16, (24, 24)).astype(np.uint8)
    rates = [(refractive_index("fused_silica", one) - 1) / one for one in WAVELENGTHS_M]
    errors = [Variation(), Variation(overlay_x_m=(0.4e-6, -0.3e-6, 0.2e-6, 0.0), common_depth_scale=0.03)]
    both = SpotPlates.of(problem.parts[0], Process(levels), rates, errors)
    alone = [SpotPlates.of(problem.parts[0], Process(levels), [rate], errors) for rate in rates]
    found = np.concatenate([one.amplitudes(level) for one in alone], axis=1)
    np.testing.assert_allclose(both.amplitudes(level), found, atol=1e-12)
    each = np.array([one.uniformity_errors(level) for one in alone])
    np.testing.assert_allclose(both.uniformity_errors(level), each.max(axis=0), rtol=1e-12)
    # Without errors it is the light of the problem, which has single precision.
    drawn = [np.abs(one.amplitudes(level)) ** 2 for one in problem.parts]
    np.testing.assert_allclose(np.abs(both.amplitudes(level)[:, [0, 2]]) ** 2, np.transpose(drawn), atol=1e-6)
    assert both.merit(level, 0.0) == pytest.approx((np.abs(found) ** 2).sum(axis=0).mean(), rel=1e-12)


@pytest.mark.slow
def test_spots_of_colours_stay_more_equal_on_plates_that_no_step_has_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Judged by the whole model of the process. A quarter of the offers, for seconds."""
    for name in ("_TRIAL_OFFERS", "_LAST_OFFERS"):
        monkeypatch.setattr(spots_design, name, getattr(spots_design, name) // 4)
    row = ["spots.count=[3, 1]", "spots.period=192 um", "doe.samples=192", "doe.aperture=384 um"]
    errors, light = [], []
    for more in ([], ["spots.uniformity_as_fabricated=1"]):
        design = optimize(spec_of(tmp_path, *row, "process.stock=contact_aligner", *more))
        plates = [orders_of_design(design, design.fabricated(seed=99, draw=f"normal/{k}")) for k in range(40)]
        errors.append(np.mean([max(one.uniformity_error for one in plate) for plate in plates]))
        light.append(np.mean([one.total for plate in plates for one in plate]))
    assert errors[1] < errors[0] / 1.5
    assert light[1] > 0.95 * light[0]


def test_the_colours_of_a_spec_come_back(tmp_path: Path):
    spec = spec_of(tmp_path)
    path = tmp_path / "again.toml"
    path.write_text(spec_to_toml(spec))
    assert load_spec(path) == spec


def test_one_colour_may_be_another_than_the_first(tmp_path: Path):
    task = SpotTask.from_spec(spec_of(tmp_path, 'spots.colours=["450nm"]'))
    assert isinstance(task.problem, SpotProblem)
    rate = (refractive_index("fused_silica", 450e-9) - 1) / 450e-9
    assert task.problem.staircase.light[1] == pytest.approx(np.exp(2j * np.pi * rate * 106e-9), abs=1e-6)


@pytest.mark.parametrize(
    ("overrides", "where", "rule"),
    [
        (['spots.colours=["450nm", "532nm"]'], "spots.colours", "must be colour channels of the spec"),
        (['spots.colours=["450nm", "450nm"]'], "spots.colours", "each colour is named once"),
        (['spots.count=[2, 1]', 'spots.phases=["0 deg", "90 deg"]'], "spots.phases", "must be free"),
    ],
)  # fmt: skip
def test_what_colours_cannot_have_is_refused(tmp_path: Path, overrides: list[str], where: str, rule: str):
    with pytest.raises(InputError) as refused:
        spec_of(tmp_path, *overrides)
    assert where in str(refused.value)
    assert rule in str(refused.value)


@pytest.mark.parametrize(
    ("spacing", "does", "rule"),
    [
        # Two spot widths of 638 nm: 2 x 638 nm x 20 mm / 0.182 mm (chrome covers 5 um of the rim); blue needs 0.1 mm.
        ("0.12 mm", "450nm", "two spot widths"),
        # Cells of 2 um steer 450 nm light 20 mm x 450 nm / 4 um = 2.25 mm far, red light 3.19 mm.
        ("2.5 mm", "638nm", "steer light 2250 um far at most"),
    ],
)
def test_places_must_do_for_every_colour(tmp_path: Path, spacing: str, does: str, rule: str):
    path = tmp_path / "free.toml"
    path.write_text(SPEC.replace('period = "48 um"', f'spacing = "{spacing}"'))
    load_spec(path, [*TWO, f'spots.colours=["{does}"]'])
    with pytest.raises(InputError, match=rule):
        load_spec(path, TWO)
