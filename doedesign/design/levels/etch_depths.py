"""Etch depths that round a design's heights at the least loss of light.

A height h that is rounded to q(h) turns the light of wavelength lambda by 2 pi (n - 1) (h - q(h)) / lambda. The cost of
a set of depths is what that takes from the amplitude, averaged over the DOE and the colours c with their weights:

    cost = sum_c w_c mean_h [1 - cos(2 pi (n_c - 1) (h - q(h)) / lambda_c)],    sum_c w_c = 1.

q is the nearest level where heights repeat after one wave of the design (`fab.levels.quantise_wrapped`). Between two
neighbouring edges of q all heights go to one level H, so with the heights in a histogram and its running sums
C_c(x) = sum over h < x of exp(2 pi i (n_c - 1) h / lambda_c) the cost is

    1 - sum_c w_c Re sum_levels [C_c(upper edge) - C_c(lower edge)] exp(-2 pi i (n_c - 1) H / lambda_c),

whatever the size of the DOE. NLopt searches it without gradient: DIRECT-L (D. R. Jones et al. 1993) over all sets,
then Sbplx from the best of them and from 2^k steps. The result is what a recipe can hold, whole tenths of a nanometre.

This serves designs that are optimised without rounding. With rounding in the loop the depths are parameters like the
others (`doedesign.design.optimize`): a set that is best for the heights of one step, put in between steps, disturbs
the optimisation and ends worse than 2^k steps where levels are few.
"""

import contextlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from fab.errors import InputError
from fab.levels import Levels, wrapped_cells
from fab.units import NM
from sim.camera import Camera

_BINS = 4096
_GLOBAL, _LOCAL = 3000, 1500
_WORST = 2.0
# Depths in steps: an etch that is shallower is hard to hold. Levels that are closer than that are one level made twice.
_SHALLOWEST, _CLOSEST = 0.25, 0.05


class HeightHistogram(NamedTuple):
    """Share of a DOE at every height, with the phase that light of each wavelength has there.

    `running` is the sum of share times exp(2 pi i waves_per_metre h) below each edge of the bins, `[line, edge]`, which
    divide one wave of the design, `period_m`, evenly. The weights of the lines sum to 1.
    """

    running: NDArray[np.complex128]
    waves_per_metre: NDArray[np.float64]
    weights: NDArray[np.float64]
    period_m: float


def height_histogram(
    height_m: Float[np.ndarray, "*s"], area: Float[np.ndarray, "*s"], period_m: float, camera: Camera
) -> HeightHistogram:
    """Return the histogram of a design's heights before rounding, metres, taken modulo one wave, `period_m`.

    `area` is how much each of them counts, such as the open share of its cell. The colours of the camera weigh alike,
    the lines of a colour by their weights.
    """
    lines = [(w, share) for c in camera.colours for w, share in zip(c.wavelengths_m, c.weights, strict=True)]
    waves_per_metre = np.array([camera.waves_per_metre(wavelength) for wavelength, _ in lines])
    weights = np.array([share for _, share in lines]) / len(camera.colours)
    place = (np.mod(np.asarray(height_m, np.float32), np.float32(period_m)) * np.float32(_BINS / period_m)).astype(int)
    counts = np.bincount(np.minimum(place, _BINS - 1).ravel(), np.asarray(area, np.float64).ravel(), _BINS)
    middles = (np.arange(_BINS) + 0.5) * period_m / _BINS
    shares = counts / counts.sum() * np.exp(2j * np.pi * waves_per_metre[:, None] * middles)
    running = np.zeros((len(lines), _BINS + 1), np.complex128)
    np.cumsum(shares, axis=1, out=running[:, 1:])
    return HeightHistogram(running, waves_per_metre, weights / weights.sum(), period_m)


def light_cost(heights: HeightHistogram, levels: Levels) -> float:
    """Return the light lost by rounding to a staircase, 0 to 2; the formula stands at the head of this file."""
    edges, cells = wrapped_cells(levels)
    places = np.clip(np.concatenate([[0.0], edges / heights.period_m, [1.0]]), 0, 1) * _BINS
    below = np.minimum(places.astype(int), _BINS - 1)
    part = places - below
    sums = heights.running[:, below] * (1 - part) + heights.running[:, below + 1] * part
    turned = np.exp(-2j * np.pi * heights.waves_per_metre[:, None] * levels.heights_m()[cells])
    kept = np.sum(np.diff(sums, axis=1) * turned, axis=1).real
    return float(1 - heights.weights @ kept)


def recipe_depths_m(depths_m: Sequence[float] | NDArray[np.floating], levels: Levels) -> tuple[float, ...]:
    """Return depths of the etches of a staircase as a recipe holds them, whole tenths of a nanometre.

    They go from shallow to deep where every set of masks makes a level; elsewhere other levels would come of that.
    """
    return tuple(map(recipe_depth_m, sorted(depths_m) if levels.is_full else depths_m))


def recipe_depth_m(depth_m: float | np.floating) -> float:
    """Return a depth as a recipe holds it, whole tenths of a nanometre."""
    # By way of text, so that 80.1 nm is the same number as in a spec.
    return float(f"{round(float(depth_m) / NM, 1)!r}e-9")


def optimal_levels(heights: HeightHistogram, start: Levels) -> Levels:
    """Return the staircase, `start` if none is better, that rounds a design's heights at the least loss of light."""
    import nlopt

    step = start.step_m
    tried: list[tuple[float, NDArray[np.float64]]] = []

    def cost(depths: NDArray[np.floating], _gradient: object) -> float:
        try:
            levels = Levels(start.count, step, tuple(float(depth) * step for depth in depths))
        except InputError:
            return _WORST
        gap = float(np.diff(levels.by_height()[1]).min()) / step
        found = light_cost(heights, levels) + max(0.0, _CLOSEST - gap)
        tried.append((found, np.array(depths, np.float64)))
        return found

    begun = np.array(start.depths_m) / step
    for algorithm, count, local in (
        (nlopt.GN_DIRECT_L, _GLOBAL, False),
        (nlopt.LN_SBPLX, _LOCAL, True),
        (nlopt.LN_SBPLX, _LOCAL, False),
    ):
        search = nlopt.opt(algorithm, start.bits)
        search.set_min_objective(cost)
        search.set_lower_bounds(_SHALLOWEST)
        search.set_upper_bounds(max(start.count, *begun))
        search.set_initial_step(0.1)
        search.set_xtol_abs(1e-4)
        search.set_maxeval(count)
        with contextlib.suppress(nlopt.RoundoffLimited):
            search.optimize(min(tried, key=lambda one: one[0])[1] if local and tried else begun)
    if not tried:
        return start
    try:
        best = Levels(start.count, step, recipe_depths_m(min(tried, key=lambda one: one[0])[1] * step, start))
    except InputError:
        return start
    return best if light_cost(heights, best) < light_cost(heights, start) else start
