"""Draws of a process. Tolerances are statistical: five standard errors, so that one check in a million fails by chance
(and none does twice, for the draws are seeded)."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fab.draws import (
    corner_scores,
    draw_at,
    normal_draw,
    normal_scores,
    one_at_a_time_scores,
    sobol_scores,
    source_of,
    varying,
)
from fab.levels import Levels
from fab.process import DEVIATIONS, Defects, Normal, Process, Variation, error_names

SIXTEEN = Levels(16, 75e-9)
PLATE_M = 4.44e-3
SIGMAS = 5.0

ALL = Process(SIXTEEN, spreads={name: Normal(0.0, 1e-3) for name in error_names(4)})
SOME = Process(
    SIXTEEN,
    spreads={
        "corner_radius_m": Normal(0.0, 2e-7),
        "overlay_x_m[2]": Normal(1e-7, 5e-7),
        "common_depth_scale": Normal(-0.01, 0.02),
        "etch_lag": Normal(0.05, 0.02),
        "sidewall_rad": Normal(0.1, 0.0),
    },
    defects=Defects(particles_per_m2=2e5, pinholes_per_m2=1e5, missed=0.2, doubled=0.1),
)


def with_errors(count: int) -> Process:
    return Process(SIXTEEN, spreads={name: Normal(0.0, 1.0) for name in error_names(4)[:count]})


# --- which errors -----------------------------------------------------------------------------------------------------


def test_errors_vary_in_the_order_of_the_table():
    assert varying(SOME) == ("common_depth_scale", "overlay_x_m[2]", "corner_radius_m", "etch_lag")
    assert varying(ALL) == error_names(4)
    assert varying(Process(SIXTEEN)) == ()


def test_every_error_belongs_to_a_source():
    assert {source_of(name) for name in error_names(4)} == {error.source for error in DEVIATIONS.values()}
    assert source_of("overlay_x_m[2]") == "overlay"


def test_scores_are_standard_deviations_from_the_mean():
    variation = draw_at(SOME, np.array([2.0, -1.0, 0.0, 1.0]), seed=5, repeats=(0, 1, 0, 0))
    assert variation == Variation(
        common_depth_scale=-0.01 + 2 * 0.02,
        overlay_x_m=(0.0, 0.0, 1e-7 - 5e-7, 0.0),
        etch_lag=0.05 + 0.02,
        sidewall_rad=0.1,
        repeats=(0, 1, 0, 0),
        seed=5,
    )
    assert draw_at(SOME, np.zeros(4)) == SOME.expected()


def test_scores_must_be_one_per_error():
    with pytest.raises(ValueError, match="zip"):
        draw_at(SOME, np.zeros(3))


@given(st.lists(st.floats(-8, 8), min_size=len(error_names(4)), max_size=len(error_names(4))))
def test_folded_errors_are_never_negative(scores: list[float]):
    variation = draw_at(ALL, np.array(scores))
    for name, score in zip(error_names(4), scores, strict=True):
        folded = DEVIATIONS[name.partition("[")[0]].one_sided
        assert variation.value(name) == (abs(score) if folded else score) * 1e-3


# --- Monte Carlo ------------------------------------------------------------------------------------------------------


def test_a_draw_depends_on_its_number_alone():
    study = [normal_draw(SOME, 3, index, PLATE_M) for index in range(12)]
    assert [normal_draw(SOME, 3, index, PLATE_M) for index in (11, 4, 0)] == [study[11], study[4], study[0]]
    assert len({variation.common_depth_scale for variation in study}) == 12
    assert len({variation.seed for variation in study}) == 12
    assert normal_draw(SOME, 4, 0, PLATE_M) != study[0]


def test_rare_events_do_not_shift_the_scores():
    calm = Process(SIXTEEN, spreads=SOME.spreads)
    for index in range(5):
        stormy, quiet = normal_draw(SOME, 1, index, PLATE_M), normal_draw(calm, 1, index, PLATE_M)
        assert [stormy.value(name) for name in varying(SOME)] == [quiet.value(name) for name in varying(SOME)]
        assert (quiet.repeats, quiet.particles, quiet.pinholes) == ((), (), ())


def test_scores_are_independent_standard_normals():
    draws = 2000
    scores = np.stack([normal_scores(ALL, 11, index) for index in range(draws)])
    columns = scores.shape[1]
    # Standard errors of the mean 1/sqrt(n), the variance sqrt(2/n), the fourth moment sqrt(96/n) and a correlation
    # 1/sqrt(n).
    assert np.abs(scores.mean(0)).max() < SIGMAS / math.sqrt(draws)
    assert np.abs(scores.var(0) - 1).max() < SIGMAS * math.sqrt(2 / draws)
    assert np.abs((scores**4).mean(0) - 3).max() < SIGMAS * math.sqrt(96 / draws)
    correlation = np.asarray(np.corrcoef(scores.T))[np.triu_indices(columns, 1)]
    assert np.abs(correlation).max() < SIGMAS / math.sqrt(draws)
    # Neighbouring draws, too, have nothing to do with each other.
    assert abs((scores[1:] * scores[:-1]).mean()) < SIGMAS / math.sqrt((draws - 1) * columns)


def test_moments_of_the_drawn_errors():
    draws = 4000
    plates = [normal_draw(SOME, 2, index, PLATE_M) for index in range(draws)]
    root = math.sqrt(draws)

    def values(name: str) -> np.ndarray:
        return np.array([plate.value(name) for plate in plates])

    overlay = values("overlay_x_m[2]")
    assert overlay.mean() == pytest.approx(1e-7, abs=SIGMAS * 5e-7 / root)
    assert overlay.std() == pytest.approx(5e-7, rel=SIGMAS / math.sqrt(2 * draws))
    # A normal distribution folded at its mean of zero: mean sigma sqrt(2/pi), variance sigma^2 (1 - 2/pi).
    radius = values("corner_radius_m")
    spread = 2e-7 * math.sqrt(1 - 2 / math.pi)
    assert radius.min() >= 0
    assert radius.mean() == pytest.approx(2e-7 * math.sqrt(2 / math.pi), abs=SIGMAS * spread / root)
    # What does not vary stays where it is.
    assert set(values("sidewall_rad")) == {0.1}


def test_rates_and_sizes_of_rare_events():
    draws = 2000
    plates = [normal_draw(SOME, 9, index, PLATE_M) for index in range(draws)]
    area = PLATE_M**2
    # Poisson: the variance of a count is its mean.
    particles = [disc for plate in plates for disc in plate.particles]
    expected = 2e5 * area * 4 * draws
    assert len(particles) == pytest.approx(expected, abs=SIGMAS * math.sqrt(expected))
    holes = [disc for plate in plates for disc in plate.pinholes]
    expected = 1e5 * area * draws
    assert len(holes) == pytest.approx(expected, abs=SIGMAS * math.sqrt(expected))
    per_mask = np.bincount([disc.mask for disc in particles], minlength=4)
    assert per_mask == pytest.approx(np.full(4, len(particles) / 4), abs=SIGMAS * math.sqrt(len(particles) / 4))
    # Exponential radii: standard deviation equal to the mean; places uniform over the square.
    radii = np.array([disc.radius_m for disc in (*particles, *holes)])
    assert radii.mean() == pytest.approx(2e-6, rel=SIGMAS / math.sqrt(radii.size))
    places = np.array([(disc.y_m, disc.x_m) for disc in particles])
    assert np.abs(places).max() <= PLATE_M / 2
    assert np.abs(places.mean(0)).max() < SIGMAS * PLATE_M / math.sqrt(12 * len(particles))
    # Binomial: every mask of every plate is missed with chance 0.2, doubled with 0.1.
    repeats = np.array([plate.repeats or (0, 0, 0, 0) for plate in plates])
    for value, chance in ((-1, 0.2), (1, 0.1)):
        error = math.sqrt(chance * (1 - chance) / repeats.size)
        assert (repeats == value).mean() == pytest.approx(chance, abs=SIGMAS * error)
    assert set(np.unique(repeats)) == {-1, 0, 1}


def test_certain_events_always_happen():
    plate = normal_draw(Process(SIXTEEN, defects=Defects(missed=1.0)), 0, 0, PLATE_M)
    assert plate.repeats == (-1, -1, -1, -1)
    assert normal_draw(Process(SIXTEEN, defects=Defects(doubled=1.0)), 0, 0, PLATE_M).repeats == (1, 1, 1, 1)
    assert normal_draw(Process(SIXTEEN), 0, 0, PLATE_M).nominal


# --- designs of experiments -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", range(7))
def test_few_errors_meet_in_every_combination(count: int):
    corners = corner_scores(with_errors(count), reach=3.0)
    assert sorted(map(tuple, corners)) == sorted(itertools.product((-3.0, 3.0), repeat=count))


@settings(max_examples=20)
@given(count=st.integers(7, len(error_names(4))))
def test_many_errors_meet_pairwise_in_all_four_combinations_equally_often(count: int):
    corners = corner_scores(with_errors(count))
    rows = corners.shape[0]
    assert corners.shape[1] == count
    # No more than a Hadamard matrix of the next power of two and its opposite.
    assert rows == 2 * 2 ** math.ceil(math.log2(count + 1)) <= 4 * (count + 1)
    assert set(np.unique(corners)) == {-2.0, 2.0}
    assert not corners.sum(0).any()
    assert np.array_equal(corners.T @ corners, 4 * rows * np.eye(count))
    # Every corner comes with its opposite, so interactions of two errors do not pass for effects of one.
    assert {tuple(row) for row in corners} == {tuple(-row) for row in corners}


def test_sobol_scores_are_balanced_and_repeat():
    scores = sobol_scores(40, 8, seed=1)
    assert scores.shape == (256, 40)
    assert np.array_equal(scores, sobol_scores(40, 8, seed=1))
    assert not np.array_equal(scores, sobol_scores(40, 8, seed=2))
    # A scrambled net of 2^8 points puts exactly one into each of 256 slices of equal probability, in every direction.
    assert all(len({int(256 * p) for p in column}) == 256 for column in _probabilities(scores).T)
    # So the mean is within a slice of zero: far nearer than the 1/16 of as many independent draws.
    assert np.abs(scores.mean(0)).max() < 0.01


def _probabilities(scores: np.ndarray) -> np.ndarray:
    return np.vectorize(lambda score: 0.5 * math.erfc(-score / math.sqrt(2)))(scores)


@pytest.mark.parametrize("power", [0, 1, 3, 6])
def test_sobol_scores_of_any_number_are_the_first_of_more(power: int):
    scores = sobol_scores(4, power)
    assert scores.shape == (2**power, 4)
    assert np.isfinite(scores).all()
    assert np.array_equal(scores, sobol_scores(4, 7)[: 2**power])


def test_one_error_at_a_time():
    scores = one_at_a_time_scores(SOME, (-2.0, 1.0))
    assert scores.shape == (8, 4)
    for index, row in enumerate(scores):
        error, reach = divmod(index, 2)
        assert np.flatnonzero(row).tolist() == [error]
        assert row[error] == (-2.0, 1.0)[reach]


def test_nothing_varies_in_an_ideal_process():
    ideal = Process(SIXTEEN)
    assert one_at_a_time_scores(ideal).shape == (0, 0)
    assert sobol_scores(0, 3).shape == (8, 0)
    assert draw_at(ideal, corner_scores(ideal)[0]).nominal
