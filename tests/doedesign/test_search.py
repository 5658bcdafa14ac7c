"""Searches by NLopt over a few values."""

import numpy as np
import pytest

from doedesign.search import ALGORITHMS, least

LOW, HIGH, BEST = (-2.0, -2.0), (2.0, 2.0), np.array([0.7, -1.2])
GLOBAL = ("direct", "crs", "mlsl", "isres")


def bumpy(values: np.ndarray) -> float:
    """Rastrigin's function about `BEST`: a minimum every half, one of them lowest."""
    off = values - BEST
    return float(off @ off + 0.1 * np.sum(1 - np.cos(4 * np.pi * off)))


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_a_smooth_hollow_is_found_by_all(name: str):
    off = np.subtract(least(lambda v: float(np.sum((v - BEST) ** 2)), LOW, HIGH, [(name, 400)], step=0.1), BEST)
    # Random searches of 400 points alone come within a few hundredths of a range of 4, the others to the last digits.
    assert np.abs(off).max() < (0.1 if name in GLOBAL else 1e-4)


@pytest.mark.parametrize("name", GLOBAL)
def test_the_lowest_of_many_hollows_is_found(name: str):
    found = least(bumpy, LOW, HIGH, [(name, 800), ("sbplx", 200)], step=0.05, start=(-1.9, 1.9))
    # Its neighbours lie half a unit off; the local stage at the end goes to the bottom.
    assert np.abs(found - BEST).max() < 1e-3


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_the_same_seed_finds_the_same(name: str):
    found = [least(bumpy, LOW, HIGH, [(name, 60)], step=0.1, seed=seed) for seed in (3, 3, 4)]
    assert found[0] == found[1]
    assert (found[1] != found[2]) == (name in ("crs", "isres"))


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
@pytest.mark.parametrize("when", [3, 40])  # of the first points of a random search, and of those that follow
@pytest.mark.parametrize("kind", [KeyboardInterrupt, ZeroDivisionError])
def test_an_error_in_the_loss_ends_a_search_and_comes_back_as_it_is(name: str, when: int, kind: type[BaseException]):
    seen = []

    def loss(values: np.ndarray) -> float:
        seen.append(values)
        if len(seen) == when:
            raise kind
        return bumpy(np.clip(values, LOW, HIGH))

    with pytest.raises(kind):
        least(loss, LOW, HIGH, [(name, 60), ("sbplx", 20)], step=0.1)
    assert len(seen) == when


def test_evaluations_are_counted_and_the_best_of_all_is_kept():
    seen = []

    def loss(values: np.ndarray) -> float:
        seen.append((bumpy(values), values.tolist()))
        return seen[-1][0]

    found = least(loss, LOW, HIGH, [("crs", 50), ("sbplx", 25)], step=0.1)
    assert len(seen) == 75
    assert found == min(seen)[1]
    assert least(loss, LOW, HIGH, [], step=0.1, start=(0.5, 0.25)) == [0.5, 0.25]


def test_a_local_search_ends_where_its_steps_no_longer_matter():
    seen = []

    def loss(values: np.ndarray) -> float:
        seen.append(values)
        return float(np.sum((values - BEST) ** 2))

    least(loss, LOW, HIGH, [("sbplx", 1000)], step=0.1, settled=0.05)
    assert len(seen) < 100
