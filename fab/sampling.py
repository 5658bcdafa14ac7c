"""Draws of a process: which errors a plate comes back with.

Every sampler works on scores, the number of standard deviations by which each error strays from its mean, one column
per error that varies (`varying`). `draw_at` turns a row of scores into a `Variation`; `normal_draw` needs nothing but a
seed and a number, so any draw of a study can be repeated alone.
"""

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import hadamard

from fab.process import Disc, MaskDisc, Process, Variation, deviation_of, error_names, variation_of

_ALL_CORNERS = 6  # errors up to which every combination of signs is tried


def varying(process: Process) -> tuple[str, ...]:
    """Flat names of the errors with a standard deviation above zero, in the order of `DEVIATIONS`."""
    return tuple(
        name for name in error_names(process.masks) if name in process.spreads and process.spreads[name].sigma > 0
    )


def source_of(name: str) -> str:
    """Group of a flat error name, such as "overlay"."""
    return deviation_of(name).source


def draw_at(process: Process, scores: NDArray[np.floating], seed: int = 0, **rest: object) -> Variation:
    """Return the plate whose errors stray by scores, one per name of `varying`, in standard deviations from the mean.

    One-sided errors are the absolute value of mean + score * sigma (a folded normal distribution). `seed` is that of
    the roughness, `rest` may be `repeats`, `particles`, `pinholes`.
    """
    strayed = dict(zip(varying(process), (float(s) for s in scores), strict=True))
    values = {}
    for name, spread in process.spreads.items():
        value = spread.mean + strayed.get(name, 0.0) * spread.sigma
        values[name] = abs(value) if deviation_of(name).one_sided else value
    return variation_of(process.masks, values, seed=seed, **rest)


def normal_scores(process: Process, seed: int, index: int) -> NDArray[np.float64]:
    """Scores of draw `index`: independent standard normals from the stream (seed, index)."""
    return np.random.default_rng([seed, index]).standard_normal(len(varying(process)))


def normal_draw(process: Process, seed: int, index: int, plate_m: float) -> Variation:
    """Draw `index` of a Monte-Carlo study of a seed, rare events included; it depends on nothing else.

    Particles and pinholes fall on a square of side `plate_m`.
    """
    # A second stream, so that rare events do not shift the scores.
    rng = np.random.default_rng([seed, index, 1])
    scores = normal_scores(process, seed, index)
    events = _events(process, rng, plate_m)
    return draw_at(process, scores, int(rng.integers(2**31)), **events)


def _events(process: Process, rng: np.random.Generator, side_m: float) -> dict[str, object]:
    defects, area = process.defects, side_m**2
    chances = rng.random(process.masks)
    repeats = np.where(chances < defects.missed, -1, np.where(chances > 1 - defects.doubled, 1, 0))
    particles = []
    for mask in range(process.masks):
        for disc in _discs(rng, defects.particles_per_m2 * area, defects.particle_radius_m, side_m):
            particles.append(MaskDisc(mask, *disc))
    pinholes = _discs(rng, defects.pinholes_per_m2 * area, defects.pinhole_radius_m, side_m)
    return {
        "repeats": tuple(int(r) for r in repeats) if repeats.any() else (),
        "particles": tuple(particles),
        "pinholes": tuple(pinholes),
    }


def _discs(rng: np.random.Generator, mean_count: float, radius_m: float, side_m: float) -> list[Disc]:
    places = (rng.random((rng.poisson(mean_count), 2)) - 0.5) * side_m
    return [
        Disc(float(y), float(x), float(r))
        for (y, x), r in zip(places, rng.exponential(radius_m, len(places)), strict=True)
    ]


def corner_scores(process: Process, reach: float = 2.0) -> NDArray[np.float64]:
    """Return scores ``[corner, error]`` of the worst cases, every varying error at `reach` sigma to either side.

    Up to six errors give every combination of signs; more give the rows of a Hadamard matrix and their opposites, in
    which every pair of errors meets in all four combinations equally often.
    """
    count = len(varying(process))
    if count <= _ALL_CORNERS:
        return reach * np.array(list(itertools.product((-1.0, 1.0), repeat=count))).reshape(2**count, count)
    size = 2 ** math.ceil(math.log2(count + 1))
    signs = hadamard(size)[:, 1 : count + 1].astype(np.float64)
    return reach * np.concatenate([signs, -signs])


@lru_cache(maxsize=32)
def sobol_scores(errors: int, power: int, seed: int = 0) -> NDArray[np.float64]:
    """Return `2**power` rows ``[draw, error]`` of a scrambled Sobol sequence as normal scores, read-only."""
    if errors == 0:
        return np.zeros((2**power, 0))
    from scipy.stats import norm, qmc

    points = qmc.Sobol(errors, rng=np.random.default_rng([seed, 2])).random_base2(power)
    # A point on the border would be an infinite score.
    scores = norm.ppf(np.clip(points, 2.0**-33, 1 - 2.0**-33))
    scores.setflags(write=False)
    return scores


def one_at_a_time_scores(process: Process, reaches: Sequence[float] = (-1.0, 1.0)) -> NDArray[np.float64]:
    """Return scores ``[error * reach, error]`` of each varying error alone, reaches of the first error first."""
    count = len(varying(process))
    return np.repeat(np.eye(count), len(reaches), axis=0) * np.tile(np.asarray(reaches, np.float64), count)[:, None]
