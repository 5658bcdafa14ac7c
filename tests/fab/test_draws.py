"""Which plates a study looks at: every key stands for one plate, made again from nothing else."""

import dataclasses
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from fab.draws import (
    budget_keys,
    chosen_errors,
    corner_keys,
    normal_draw,
    normal_keys,
    one_at_a_time_keys,
    sobol_keys,
    sources_of,
    variation_at,
    varying,
)
from fab.errors import InputError
from fab.levels import Levels
from fab.process import Defects, Normal, Process, Variation

SIDE = 1e-3


@pytest.fixture(scope="module")
def fakes():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parents[1] / "doedesign")
        yield import_module("tolerance_fakes")


@pytest.fixture
def process(fakes) -> Process:
    """Errors of four sources, roughness and rare events among them; overlay and depth have a mean."""
    spreads = dict(fakes.process().spreads)
    spreads |= {"overlay_x_m[0]": Normal(0.1e-6, 0.5e-6), "roughness_m": Normal(2e-9), "correlation_m": Normal(1e-6)}
    return dataclasses.replace(fakes.process(), spreads=spreads, defects=Defects(particles_per_m2=3e6, missed=0.1))


def plate(process: Process, key: str, seed: int = 7) -> Variation:
    return variation_at(process, seed, SIDE, key)


def test_sources_are_those_by_which_plates_differ(fakes, process: Process):
    assert sources_of(fakes.process()) == ("depth", "overlay", "corners")
    # The same roughness everywhere still differs from plate to plate, in its bumps.
    assert sources_of(process) == ("depth", "overlay", "corners", "roughness", "defects")
    assert sources_of(Process(process.levels)) == ()


def test_the_plates_without_chance(process: Process):
    assert plate(process, "nominal") == Variation()
    assert plate(process, "expected") == dataclasses.replace(process.expected(), seed=7)


def test_a_normal_draw_is_that_of_the_sampler(process: Process):
    for key in normal_keys(5):
        assert plate(process, key) == normal_draw(process, 7, int(key.partition("/")[2]), SIDE)
    assert plate(process, "normal/3") != plate(process, "normal/3", seed=8)


def test_one_error_at_a_time_leaves_the_others_at_their_mean(process: Process):
    keys = one_at_a_time_keys(process)
    # Corner rounding is never negative, and its mean is zero: only one side.
    assert [key.rpartition("/")[0] for key in keys].count("one_at_a_time/corner_radius_m") == 1
    assert len(keys) == 2 * len(varying(process)) - 1
    expected = plate(process, "expected")
    for key in keys:
        _, name, reach = key.split("/")
        found = plate(process, key)
        spread = process.spreads[name]
        assert found.value(name) == pytest.approx(spread.mean + float(reach) * spread.sigma)
        others = [other for other in process.spreads if other != name]
        assert [found.value(other) for other in others] == [expected.value(other) for other in others]
        assert (found.seed, found.particles, found.repeats) == (expected.seed, (), ())


def test_corners_are_two_standard_deviations_away(process: Process):
    keys = corner_keys(process)
    assert len(keys) == 2 ** len(varying(process))
    spread = process.spreads["depth_scale[1]"]
    assert {plate(process, key).value("depth_scale[1]") for key in keys} == {-2 * spread.sigma, 2 * spread.sigma}


@pytest.mark.parametrize("source", ["depth", "overlay", "corners", "roughness", "defects"])
def test_a_mixed_row_takes_one_source_from_the_second_sample(process: Process, source: str):
    for i in range(6):
        first, second, mixed = (plate(process, f"sobol/{half}/{i}") for half in ("a", "b", source))
        parts = {
            "depth": ["depth_scale"],
            "overlay": ["overlay_x_m"],
            "corners": ["corner_radius_m"],
            "roughness": ["seed"],
            "defects": ["particles", "repeats", "pinholes"],
        }
        for name, attributes in parts.items():
            of = second if name == source else first
            assert [getattr(mixed, a) for a in attributes] == [getattr(of, a) for a in attributes]
        assert first.depth_scale != second.depth_scale
        assert first.seed != second.seed


def test_rows_of_the_samples_do_not_depend_on_how_many_there_are(process: Process):
    few, many = sobol_keys(process, 4), sobol_keys(process, 64)
    assert set(few) < set(many)
    assert len(many) == 64 * (len(sources_of(process)) + 2)
    # A key says all there is to know; here the first rows are asked for after later ones, and before.
    before = [plate(process, key) for key in few]
    _ = plate(process, "sobol/a/63")
    assert [plate(process, key) for key in few] == before


def test_the_samples_are_even_standard_normals(fakes):
    process = fakes.process()
    sigma = process.spreads["depth_scale[0]"].sigma
    scores = [plate(process, f"sobol/{half}/{i}").depth_scale[0] / sigma for half in "ab" for i in range(64)]
    # The mean of 128 random ones would stray by 0.09 and their deviation by 0.06; these are more even than random.
    assert np.mean(scores) == pytest.approx(0, abs=0.05)
    assert np.std(scores) == pytest.approx(1, abs=0.05)


def test_a_budget_scales_the_deviations_of_the_same_draws(process: Process):
    assert budget_keys("overlay", (0.0, 1.0), 2) == [
        "budget/overlay/0/0",
        "budget/overlay/0/1",
        "normal/0",
        "normal/1",
    ]
    for i in range(4):
        whole = plate(process, f"normal/{i}")
        assert plate(process, f"budget/overlay/1/{i}") == whole
        half = plate(process, f"budget/overlay/0.5/{i}")
        mean = process.spreads["overlay_x_m[0]"].mean
        assert half.overlay_x_m[0] - mean == pytest.approx((whole.overlay_x_m[0] - mean) / 2)
        assert dataclasses.replace(half, overlay_x_m=whole.overlay_x_m) == whole
        one = plate(process, f"budget/overlay_x[1]/0/{i}")
        assert one.overlay_x_m == (whole.overlay_x_m[0], 0.0)


def test_a_budget_for_rare_events_scales_their_rates(process: Process):
    counts = {f: sum(len(plate(process, f"budget/defects/{f}/{i}").particles) for i in range(40)) for f in (0, 1, 3)}
    assert counts[0] == 0
    # About 2 masks x 3 particles x 40 plates; a Poisson number of that mean strays by 6 %.
    assert counts[1] == pytest.approx(240, rel=0.2)
    assert counts[3] == pytest.approx(720, rel=0.2)
    assert plate(process, "budget/defects/0/3").depth_scale == plate(process, "normal/3").depth_scale
    # The same plates but for what is rarer or more frequent.
    for i in range(10):
        few, many = (plate(process, f"budget/defects/{factor}/{i}") for factor in (0.5, 2))
        assert set(few.particles) <= set(many.particles)
        assert set(few.pinholes) <= set(many.pinholes)
        none = {"particles": (), "pinholes": (), "repeats": ()}
        assert dataclasses.replace(few, **none) == dataclasses.replace(many, **none)
    assert budget_keys("defects", (1.0,), 2) == ["budget/defects/1/0", "budget/defects/1/1"]


def test_rare_events_of_a_budget_are_independent(process: Process):
    """Where a pinhole lies says nothing of whether an etch was missed."""
    defects = Defects(missed=0.5, pinholes_per_m2=1e6)
    rare = dataclasses.replace(process, defects=defects)
    found = [plate(rare, f"budget/defects/1/{i}") for i in range(400)]
    sides: dict[bool, list[bool]] = {True: [], False: []}
    for one in found:
        if one.pinholes:
            sides[bool(one.repeats) and one.repeats[0] == -1].append(one.pinholes[0].y_m > 0)
    # Some 100 or more each; half of them strays by 5 %.
    for side in sides.values():
        assert 0.3 < np.mean(side) < 0.7


@pytest.mark.parametrize(
    ("what", "count"),
    [("overlay", 2), ("overlay_x", 2), ("overlay_x_m", 2), ("overlay_x[1]", 1), ("overlay_x_m[1]", 1), ("defects", 0)],
)
def test_what_a_budget_is_for(process: Process, what: str, count: int):
    assert len(chosen_errors(process, what)) == count


def test_a_budget_for_what_does_not_vary_is_refused(process: Process):
    with pytest.raises(InputError, match=r"must name errors that vary.*One of depth, overlay, .*overlay_x"):
        chosen_errors(process, "rotation")


def test_a_refused_budget_proposes_nothing_that_would_be_refused():
    """Roughness of a fixed size is a source of error, for every plate has another one, but has no sigma to budget."""
    spreads = {"roughness_m": Normal(2e-9, 0.0), "overlay_x_m[0]": Normal(0.0, 1e-7)}
    process = Process(Levels(4, 75e-9), spreads=spreads)
    with pytest.raises(InputError, match=r'got "roughness"\. One of overlay, overlay_x\.$'):
        chosen_errors(process, "roughness")


@pytest.mark.parametrize(
    "key",
    [
        "normal",
        "normal/-1",
        "normal/x",
        "normal/1/2",
        "corners/9999",
        "one_at_a_time/rotation_rad[0]/+1",
        "one_at_a_time/overlay_x_m[0]/nan",
        "one_at_a_time/overlay_x_m[0]/1e999",
        "sobol/c/1",
        "sobol/a/9999999999",
        "sobol/rotation/1",
        "budget/overlay/-1/3",
        "budget/overlay/nan/3",
        "something",
        "",
    ],
)
def test_a_key_that_stands_for_nothing_is_refused(process: Process, key: str):
    with pytest.raises(InputError, match="must be the key of a plate"):
        plate(process, key)


def test_a_process_of_rare_events_alone_has_samples(process: Process):
    bare = dataclasses.replace(process, spreads={})
    assert sources_of(bare) == ("defects",)
    assert corner_keys(bare) == one_at_a_time_keys(bare) == []
    assert plate(bare, "sobol/defects/2").particles == plate(bare, "sobol/b/2").particles


@pytest.mark.parametrize("seed", [-1, 1.5, "x", True])
def test_a_wrong_seed_is_told_as_one(process: Process, seed: object):
    with pytest.raises(InputError, match="seed: must be a whole number of 0 or more"):
        plate(process, "normal/0", seed)  # pyright: ignore[reportArgumentType]
