"""Exchange of single cells of a small unit cell: what is left to win where few cells make few levels."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from doedesign.spots.problem import SharedProblem, SpotProblem

FLAT = 1.4  # (max - min) / (max + min) over that root, about
_ANY, _ANY_OF_TWO = 0.5, 0.1  # share of offers of another level than a neighbour's
_COLD = 0.3  # share of the sweeps that take improvements alone


def exchange(
    problem: SpotProblem | SharedProblem,
    level: NDArray[np.uint8],
    *,
    sweeps: int,
    seed: int,
    uniformity: float,
    heat: float = 2e-3,
) -> NDArray[np.uint8]:
    """Change cells of a level map one by one for efficiency less `uniformity` times how unequal spots are.

    That is the fourth root of the mean fourth power of their relative deviations, times 1.4: about as large as the
    uniformity error (max - min) / (max + min), and smoother. Where phases of spots are given, the efficiency is that of
    the wave that they make together.

    Simulated annealing (S. Kirkpatrick et al., Science 220, 671, 1983): a change that costs merit is taken with the
    probability exp(-cost / heat), and heat falls to zero over the first sweeps. A sweep offers every cell the level of
    a neighbour, which moves a border between levels, or now and then another, most often the next. The best map that
    was met is returned; by this measure it is never worse than the one given.
    """
    spots, waves, light_of = problem.spots, problem.cell_waves, problem.level_light
    wanted = np.zeros(0, complex) if spots.phases is None else spots.wave.conj()
    rng = np.random.default_rng((seed, 0xE8C4))
    own, count = level.reshape(-1).copy(), len(light_of)
    best = own.copy()
    for sweep in range(sweeps):
        offer = offers(rng, own.size, count, _ANY_OF_TWO if count == 2 else _ANY)
        heat_now = cooled(heat, sweep, sweeps)
        _sweep(own, best, waves, light_of, spots.shares, spots.colours, wanted, level.shape, *offer, heat_now,
               uniformity)  # fmt: skip
    return best.reshape(level.shape)


def cooled(heat: float, sweep: int, sweeps: int) -> float:
    """Heat of one of so many sweeps, which falls to zero before the last ones."""
    return heat * max(1.0 - sweep / max((1 - _COLD) * sweeps, 1), 0.0) ** 2


class Offers(NamedTuple):
    """Offers of a sweep: another level for every cell of a level map.

    Attributes:
        order: cells, in the order in which they are asked.
        chance: a random number from 0 to 1 for each offer, by which a worse one may be taken.
        others: levels by which an offer differs from the cell's own, or 0 for the level of a neighbour.
        sides: which neighbour: 0 below, 1 above, 2 behind, 3 before.
    """

    order: NDArray[np.int64]
    chance: NDArray[np.float64]
    others: NDArray[np.int64]
    sides: NDArray[np.int64]


def offers(rng: np.random.Generator, cells: int, levels: int, any_level: float) -> Offers:
    """Draw the offers of a sweep; a share `any_level` of them is of another level than a neighbour's."""
    order, chance = rng.permutation(cells), rng.random(cells)
    # A step up or down where there are many levels, or any other level.
    others = rng.choice([1, levels - 1], cells) if levels > 2 else np.ones(cells, int)
    others = np.where(rng.random(cells) < 0.5, others, rng.integers(1, max(levels, 2), cells))
    others = np.where(rng.random(cells) < any_level, others, 0)
    return Offers(order, chance, others, rng.integers(0, 4, cells))


@njit(cache=True, nogil=True)
def offered(level: Any, y: int, x: int, other: int, side: int, levels: int) -> int:
    """The level that a cell of a map is offered (`Offers`)."""
    if other:
        return (level[y, x] + other) % levels
    ny, nx = level.shape
    if side == 0:
        y = (y + 1) % ny
    elif side == 1:
        y = (y - 1) % ny
    elif side == 2:
        x = (x + 1) % nx
    else:
        x = (x - 1) % nx
    return level[y, x]


@njit(cache=True, nogil=True)
def _merit(light: Any, shares: Any, colours: int, wanted: Any, uniformity: float) -> float:
    total, spread, count = 0.0, 0.0, len(light) // colours
    for first in range(0, len(light), count):  # spots of every colour are held against their own mean
        over = 0.0
        for k in range(first, first + count):
            power = light[k].real ** 2 + light[k].imag ** 2
            total += power
            over += power / shares[k]
        mean = max(over / count, 1e-300)
        for k in range(first, first + count):
            off = (light[k].real ** 2 + light[k].imag ** 2) / shares[k] / mean - 1.0
            spread += off**4
    if len(wanted):
        wave = np.sum(wanted * light)
        total = wave.real**2 + wave.imag**2
    return total - uniformity * (spread / len(light)) ** 0.25 * FLAT


@njit(cache=True, nogil=True)
def _sweep(
    own: NDArray[np.uint8],
    best: NDArray[np.uint8],
    waves: NDArray[np.complex128],
    light_of: NDArray[np.complex128],
    shares: NDArray[np.float64],
    colours: int,
    wanted: NDArray[np.complex128],
    shape: tuple[int, int],
    order: Any,
    chance: Any,
    others: Any,
    sides: Any,
    heat: float,
    uniformity: float,
) -> None:
    """Offer every cell another level, in place; `best` is the best map met so far."""
    light, kept = np.zeros(len(shares), np.complex128), np.zeros(len(shares), np.complex128)
    for cell in range(len(own)):
        light += light_of[own[cell]] * waves[cell]
        kept += light_of[best[cell]] * waves[cell]
    merit = _merit(light, shares, colours, wanted, uniformity)
    highest = _merit(kept, shares, colours, wanted, uniformity)
    drawn, nx = own.reshape(shape), shape[1]
    for cell, throw, other, side in zip(order, chance, others, sides):  # noqa: B905 - numba knows no strict
        level = offered(drawn, cell // nx, cell % nx, other, side, len(light_of))
        if level == own[cell]:
            continue
        tried = light + (light_of[level] - light_of[own[cell]]) * waves[cell]
        found = _merit(tried, shares, colours, wanted, uniformity)
        if found >= merit or (heat > 0 and throw < np.exp((found - merit) / heat)):
            own[cell], light, merit = level, tried, found
            if merit > highest:
                highest = merit
                best[:] = own
