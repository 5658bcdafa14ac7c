"""Which plates a study looks at. Every plate has a key from which it can be made again alone.

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

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fab.errors import InputError
from fab.process import DEVIATIONS, Process, Variation, deviation_of, short_name
from fab.sampling import (
    corner_scores,
    draw_at,
    normal_draw,
    normal_scores,
    one_at_a_time_scores,
    sobol_scores,
    source_of,
    varying,
)

NOMINAL, EXPECTED = "nominal", "expected"
DEFECTS, _ROUGHNESS = "defects", "roughness"
_REACHES = (-1.0, 1.0)


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
    found = tuple(name for name in names if what in _words_for(name))
    if not found:
        choices = ", ".join(
            dict.fromkeys((*sources_of(process), *(short_name(name.partition("[")[0]) for name in names)))
        )
        raise InputError("budget", "must name errors that vary in this process", f'"{what}"', f"One of {choices}.")
    return found


def _words_for(name: str) -> tuple[str, ...]:
    """What a user may call an error: "overlay_x_m[2]", "overlay_x[2]", "overlay_x_m", "overlay_x", "overlay"."""
    key = name.partition("[")[0]
    return name, short_name(name), key, short_name(key), source_of(name)


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
    """Keys of `count` draws with the deviations of some errors scaled by each factor; at 1, the plain draws."""
    return [
        f"normal/{i}" if factor == 1 else f"budget/{what}/{factor:g}/{i}" for factor in factors for i in range(count)
    ]


def variation_at(process: Process, seed: int, plate_m: float, key: str) -> Variation:
    """Return the plate that a key stands for, in a study of a seed; `plate_m` is as in `fab.sampling.normal_draw`.

    Raises:
        InputError: no such key in a study of this process.
    """
    try:
        return _variation_at(process, seed, plate_m, key)
    except InputError:
        raise
    except (ValueError, IndexError) as error:
        cure = "For example normal/17, expected, or a key of draws.csv."
        raise InputError("draw", "must be the key of a plate of this study", f'"{key}"', cure) from error


def _variation_at(process: Process, seed: int, plate_m: float, key: str) -> Variation:
    match key.split("/"):
        case ["nominal"]:
            return Variation()
        case ["expected"]:
            return replace(process.expected(), seed=seed)
        case ["normal", index]:
            return normal_draw(process, seed, _index(index), plate_m)
        case ["corners", index]:
            return draw_at(process, corner_scores(process)[_index(index)], seed)
        case ["one_at_a_time", name, reach]:
            scores = one_at_a_time_scores(process, (float(reach),))
            return draw_at(process, scores[varying(process).index(name)], seed)
        case ["sobol", half, index]:
            return _sobol_draw(process, seed, plate_m, half, _index(index))
        case ["budget", what, factor, index]:
            return _scaled_draw(process, seed, plate_m, what, float(factor), _index(index))
        case _:
            raise ValueError(key)


def _index(text: str) -> int:
    if not text.isdecimal():
        raise ValueError(text)
    return int(text)


def _sobol_draw(process: Process, seed: int, plate_m: float, half: str, index: int) -> Variation:
    names = varying(process)
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
    if what == DEFECTS:
        defects = process.defects
        scaled = replace(
            defects,
            particles_per_m2=factor * defects.particles_per_m2,
            pinholes_per_m2=factor * defects.pinholes_per_m2,
            missed=min(factor * defects.missed, 1.0),
            doubled=min(factor * defects.doubled, 1.0),
        )
        return normal_draw(replace(process, defects=scaled), seed, index, plate_m)
    factors = np.array([factor if name in chosen else 1.0 for name in varying(process)])
    events = normal_draw(process, seed, index, plate_m)
    return _with_scores(process, factors * normal_scores(process, seed, index), events)


def _with_scores(process: Process, scores: Sequence[float] | NDArray[np.floating], events: Variation) -> Variation:
    """A plate with these scores, and the rare events and the roughness of another."""
    rest = {"repeats": events.repeats, "particles": events.particles, "pinholes": events.pinholes}
    return draw_at(process, np.asarray(scores), events.seed, **rest)
