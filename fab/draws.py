"""Draws of a process: which errors a plate comes back with, and which plates a study looks at.

Every sampler works on scores, the number of standard deviations by which each error strays from its mean, one column
per error that varies (`varying`). `draw_at` turns a row of scores into a `Variation`; `normal_draw` needs nothing but a
seed and a number. So every plate of a study has a key from which it can be made again alone (`variation_at`).

    nominal                             exactly as drawn
    expected                            every error at its mean
    normal/17                           draw 17 of the Monte-Carlo study, rare events included
    corners/3                           worst-case corner 3: every error two standard deviations off
    one_at_a_time/overlay_x_m[2]/+1     one error alone, one standard deviation off
    sobol/a/5, sobol/b/5                row 5 of two independent samples
    sobol/overlay/5                     row 5 of the first, with one source of error taken from the second
    budget/overlay/0.5/17               draw 17, with the deviations of some errors halved

Sources of error are those of `fab.process.DEVIATIONS`, and "defects": particles, pinholes, missed and doubled etches.
Which roughness a plate has, of all with the same statistics, belongs to the source "roughness".
"""

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import hadamard

from fab.errors import InputError
from fab.process import (
    DEVIATIONS,
    Disc,
    MaskDisc,
    Process,
    Variation,
    deviation_of,
    error_names,
    short_name,
    variation_of,
)
from fab.units import is_whole

_ALL_CORNERS = 6  # errors up to which every combination of signs is tried
NOMINAL, EXPECTED = "nominal", "expected"
DEFECTS, _ROUGHNESS = "defects", "roughness"
_REACHES = (-1.0, 1.0)
_MOST_ROWS = 1 << 20  # of a Sobol sequence, which is made as a whole


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


def sources_of(process: Process) -> tuple[str, ...]:
    """Sources of error by which plates of a process differ, in the order of `DEVIATIONS`, "defects" last."""
    found = {source_of(name) for name in varying(process)}
    if process.expected().roughness_m > 0:
        found.add(_ROUGHNESS)  # the same statistics, another surface
    defects = process.defects
    rates = (defects.particles_per_m2, defects.pinholes_per_m2, defects.missed, defects.doubled)
    known = dict.fromkeys(error.source for error in DEVIATIONS.values())
    return tuple(source for source in known if source in found) + ((DEFECTS,) if any(rates) else ())


def chosen_errors(process: Process, what: str) -> tuple[str, ...]:
    """Return the flat names of the varying errors that a source, an error, or an error of one mask means.

    `what` is "overlay", "overlay_x", "overlay_x_m", "overlay_x[2]" or "defects", for which no name is returned.

    Raises:
        InputError: nothing of that name varies in this process.
    """
    if what == DEFECTS and DEFECTS in sources_of(process):
        return ()
    names = varying(process)
    # "overlay_x_m[2]" is also "overlay_x[2]", "overlay_x_m", "overlay_x" and "overlay".
    keys = {name: name.partition("[")[0] for name in names}
    found = tuple(n for n, key in keys.items() if what in (n, short_name(n), key, short_name(key), source_of(n)))
    if not found:
        # Plates also differ by which roughness they have, which no budget scales.
        sources = [source for source in sources_of(process) if source == DEFECTS or source in map(source_of, names)]
        choices = ", ".join(dict.fromkeys((*sources, *map(short_name, keys.values()))))
        raise InputError("budget", "must name errors that vary in this process", f'"{what}"', f"One of {choices}.")
    return found


def normal_keys(count: int) -> list[str]:
    """Keys of the first `count` Monte-Carlo draws."""
    return [f"normal/{i}" for i in range(count)]


def corner_keys(process: Process) -> list[str]:
    """Keys of all worst-case corners; none where nothing varies."""
    return [f"corners/{i}" for i in range(len(corner_scores(process)))] if varying(process) else []


def one_at_a_time_keys(process: Process) -> list[str]:
    """Keys of every error alone, one sigma to either side; to one only if never negative and of mean zero."""
    return [
        f"one_at_a_time/{name}/{reach:+g}"
        for name in varying(process)
        for reach in _REACHES
        if reach > 0 or process.spreads[name].mean or not deviation_of(name).one_sided
    ]


def sobol_keys(process: Process, count: int) -> list[str]:
    """Keys of the plates from which Sobol indices of all sources are computed, `count` times (sources + 2)."""
    return [f"sobol/{half}/{i}" for half in ("a", "b", *sources_of(process)) for i in range(count)]


def budget_keys(what: str, factors: Iterable[float], count: int) -> list[str]:
    """Keys of `count` draws with the deviations of some errors scaled by each factor; at 1, the plain draws.

    Of rare events not even then: those of other factors have their events, or some of them.
    """
    plain = what != DEFECTS
    return [
        f"normal/{i}" if plain and factor == 1 else f"budget/{what}/{factor:g}/{i}"
        for factor in factors
        for i in range(count)
    ]


def variation_at(process: Process, seed: int, plate_m: float, key: str) -> Variation:
    """Return the plate that a key stands for, in a study of a seed; `plate_m` is as in `normal_draw`.

    Raises:
        InputError: no such key in a study of this process.
    """
    if not is_whole(seed, 0):
        raise InputError("seed", "must be a whole number of 0 or more", seed, "Change it.")
    seed, cause = int(seed), None
    try:
        match key.split("/") if isinstance(key, str) else []:
            case ["nominal"]:
                return Variation()
            case ["expected"]:
                return replace(process.expected(), seed=seed)
            case ["normal", index]:
                return normal_draw(process, seed, _index(index), plate_m)
            case ["corners", index]:
                return draw_at(process, corner_scores(process)[_index(index)], seed)
            case ["one_at_a_time", name, reach]:
                scores = one_at_a_time_scores(process, (_finite(reach),))
                return draw_at(process, scores[varying(process).index(name)], seed)
            case ["sobol", half, index]:
                return _sobol_draw(process, seed, plate_m, half, _index(index))
            case ["budget", what, factor, index]:
                return _scaled_draw(process, seed, plate_m, what, float(factor), _index(index))
    except InputError:
        raise
    except (ValueError, IndexError) as error:
        cause = error
    cure = "For example normal/17, expected, or a key of draws.csv."
    raise InputError("draw", "must be the key of a plate of this study", f'"{key}"', cure) from cause


def _index(text: str) -> int:
    if not text.isdecimal():
        raise ValueError(text)
    return int(text)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _sobol_draw(process: Process, seed: int, plate_m: float, half: str, index: int) -> Variation:
    names = varying(process)
    if index >= _MOST_ROWS:
        raise ValueError(index)
    row = sobol_scores(2 * len(names), max(index, 1).bit_length(), seed)[index]
    first, second = row[: len(names)], row[len(names) :]
    # Rare events and the roughness of the two samples are those of an even and of an odd Monte-Carlo draw.
    odd = half == "b"
    events = normal_draw(process, seed, 2 * index + odd, plate_m)
    if half in ("a", "b"):
        return _with_scores(process, second if odd else first, events)
    if half not in sources_of(process):
        raise ValueError(half)
    other = normal_draw(process, seed, 2 * index + 1, plate_m)
    replaced = np.array([source_of(name) == half for name in names], dtype=bool)
    if half == DEFECTS:
        events = replace(other, seed=events.seed)
    if half == _ROUGHNESS:
        events = replace(events, seed=other.seed)
    return _with_scores(process, np.where(replaced, second, first), events)


def _scaled_draw(process: Process, seed: int, plate_m: float, what: str, factor: float, index: int) -> Variation:
    if not 0 <= factor < np.inf:
        raise ValueError(factor)
    chosen = chosen_errors(process, what)
    drawn, scores = normal_draw(process, seed, index, plate_m), normal_scores(process, seed, index)
    if what == DEFECTS:
        return draw_at(process, scores, drawn.seed, **_scaled_events(process, [seed, index, 4], plate_m, factor))
    factors = np.array([factor if name in chosen else 1.0 for name in varying(process)])
    return _with_scores(process, factors * scores, drawn)


def _scaled_events(process: Process, seed: Sequence[int], side_m: float, factor: float) -> dict[str, object]:
    """Rare events `factor` times as frequent; a smaller factor has some of those of a larger one, and no others."""
    from scipy.stats import poisson

    defects, mean = process.defects, factor * side_m**2
    rng = np.random.default_rng([*seed, process.masks + 1])  # those before are of particles and pinholes
    chances, counts = rng.random(process.masks), rng.random(process.masks + 1)
    missed, doubled = (min(factor * chance, 1.0) for chance in (defects.missed, defects.doubled))
    repeats = np.where(chances < missed, -1, np.where(chances > 1 - doubled, 1, 0))

    def discs(place: int, per_m2: float, radius_m: float) -> list[Disc]:
        """As many as the same share of all plates has at most; the first of a stream of their own."""
        own = np.random.default_rng([*seed, place])
        made = (
            (own.random(2), own.exponential(radius_m)) for _ in range(int(poisson.ppf(counts[place], per_m2 * mean)))
        )
        return [Disc(float((y - 0.5) * side_m), float((x - 0.5) * side_m), float(radius)) for (y, x), radius in made]

    particles = [
        MaskDisc(mask, *disc)
        for mask in range(process.masks)
        for disc in discs(mask, defects.particles_per_m2, defects.particle_radius_m)
    ]
    pinholes = discs(process.masks, defects.pinholes_per_m2, defects.pinhole_radius_m)
    return {
        "repeats": tuple(int(n) for n in repeats) if repeats.any() else (),
        "particles": tuple(particles),
        "pinholes": tuple(pinholes),
    }


def _with_scores(process: Process, scores: Sequence[float] | NDArray[np.floating], events: Variation) -> Variation:
    """A plate with these scores, and the rare events and the roughness of another."""
    rest = {"repeats": events.repeats, "particles": events.particles, "pinholes": events.pinholes}
    return draw_at(process, np.asarray(scores), events.seed, **rest)
